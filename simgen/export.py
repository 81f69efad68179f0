"""One frame as files that image tools read: OpenEXR with named channels, and PNG.

Per camera ``camera-<c>.exr`` holds linear radiance R, G, B (rendered again from the spec) as it
reaches the sensor, through haze, rain and the drops on the glass; depth.Z [m], ids semantic and
instance. Per pair ``pair-<left>-<right>.exr`` holds flow.u, flow.v [px] and the status of both
directions. Floats are 32 bit, so nothing is rounded. ``pair-<left>-<right>.yaml`` is the *nominal*
rig as OpenCV YAML, which flowrect.rectify starts from.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from simgen import engine, given_map
from simgen.config import Job
from simgen.errors import UserError
from simgen.geometry import inverse
from simgen.rig import Camera
from simgen.shards import Frame, ShardSet


def export_frame(folder: Path, index: int, to: Path) -> list[Path]:
    """Writes the files of one frame and returns their paths: all of them, or none.

    Raises UserError if the set has no such frame, renders otherwise than it did, or cannot be
    written.
    """
    frames = ShardSet(folder)
    frame = frames.frame(index)
    config = frames.manifest.config
    # Sets from before maps do not name theirs.
    job = Job.from_content(config, given_map.kept(folder, config.get("opendrive", "")))
    with _waiting_folder(to) as waiting:
        radiances = _render_again(job, frame)
        with _writing(to):
            _write(waiting, frame, radiances)
            return _moved(waiting, to)


@contextmanager
def _waiting_folder(to: Path) -> Iterator[Path]:
    """A folder within ``to``, so on its disk; what was made for it and stays empty is removed."""
    made = [folder for folder in (to, *to.parents) if not folder.exists()]
    try:
        with _writing(to):
            to.mkdir(parents=True, exist_ok=True)
            waiting = tempfile.TemporaryDirectory(prefix=".export-", dir=to)
        with waiting as name:
            yield Path(name)
    finally:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def _writing(to: Path) -> Iterator[None]:
    """OpenEXR raises RuntimeError, and OpenCV its own, where a disk is full or not there."""
    try:
        yield
    except (OSError, RuntimeError, cv2.error) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise UserError(
            f"--to {to}: cannot be written to ({reason}). Nothing was exported; free some space, "
            "or choose another folder."
        ) from error


def _write(folder: Path, frame: Frame, radiances: Sequence[NDArray[np.float32]]) -> None:
    for c, radiance in enumerate(radiances):
        _write_exr(folder / f"camera-{c}.exr", camera_channels(frame, c, radiance))
        _write_png(folder / f"camera-{c}.png", frame.read("image", c))
    for p, (left, right) in enumerate(frame.pairs):
        _write_exr(folder / f"pair-{left}-{right}.exr", pair_channels(frame, p))
        write_nominal_rig(folder / f"pair-{left}-{right}.yaml", frame, p)
    (folder / "frame.json").write_text(json.dumps(_cameras(frame), indent=1), encoding="utf-8")


def _moved(waiting: Path, to: Path) -> list[Path]:
    """Puts the finished files into place; on a failure, what was there before is put back."""
    paths = sorted(waiting.iterdir())
    for path in paths:
        if (to / path.name).is_dir():
            raise IsADirectoryError(errno.EISDIR, f"{path.name} is a folder there")
    aside = Path(tempfile.mkdtemp(prefix=".replaced-", dir=to))
    try:
        for path in paths:
            if os.path.lexists(to / path.name):
                (to / path.name).replace(aside / path.name)
            path.replace(to / path.name)
    except BaseException:
        _take_back(paths, aside, to)
        raise
    shutil.rmtree(aside, ignore_errors=True)  # all is in place: no reason to say otherwise
    return [to / path.name for path in paths]


def _take_back(paths: Sequence[Path], aside: Path, to: Path) -> None:
    """Undoes what was moved from ``paths``, and from ``to`` aside."""
    try:
        for path in paths:
            if os.path.lexists(aside / path.name):
                (aside / path.name).replace(to / path.name)
            elif not path.exists():
                (to / path.name).unlink()
        aside.rmdir()
    except OSError as error:
        raise UserError(
            f"--to {to}: files could neither be replaced nor put back ({error.strerror}). Some of "
            f"those of this frame are new; the others' older ones are in {aside}: move them back, "
            "or export again."
        ) from error


def camera_channels(frame: Frame, c: int, radiance: NDArray[np.float32]) -> dict[str, Any]:
    """Channels of one camera's EXR."""
    return {
        **{name: radiance[..., k] for k, name in enumerate("RGB")},
        "depth.Z": frame.read("depth", c),
        "id.semantic": frame.read("semantic", c).astype(np.uint32),
        "id.instance": frame.read("instance", c).astype(np.uint32),
    }


def pair_channels(frame: Frame, p: int) -> dict[str, Any]:
    """Channels of one pair's EXR."""
    flow = frame.flow(p)
    return {
        "flow.u": flow[..., 0],
        "flow.v": flow[..., 1],
        "status.forward": frame.read("flow_status", p).astype(np.uint32),
        "status.reverse": frame.read("flow_status_reverse", p).astype(np.uint32),
    }


def write_nominal_rig(path: Path, frame: Frame, p: int) -> Path:
    """Intrinsics and nominal pose of a pair: X_right = R X_left + T."""
    left, right = frame.pairs[p]
    T_world = frame.T_world_cam_nominal
    T_right_left = inverse(T_world[right]) @ T_world[left]
    height, width = frame.read("image", left).shape[:2]
    # In memory: a file on a full disk would be cut off without a word.
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.write("K_left", frame.K[left])
    storage.write("K_right", frame.K[right])
    storage.write("R", T_right_left[:3, :3])
    storage.write("T", T_right_left[:3, 3:])
    path.write_text(storage.releaseAndGetString(), encoding="utf-8")
    return path


def _render_again(job: Job, frame: Frame) -> list[NDArray[np.float32]]:
    index, attempt = int(frame.spec["frame_index"]), int(frame.spec["attempt"])
    engine.activate(_engine_of(job.variant))
    from simgen import produce

    watch = produce.Stopwatch()
    frame_plan = produce.plan_frame(job, index, attempt)
    samples = produce.frame_samples(frame_plan, job)
    _require_same(frame, frame_plan.spec.to_json(), frame_plan.posed.cameras, samples)
    loaded, sky = produce.load(frame_plan, job, watch)
    return produce.radiance(frame_plan, job, loaded, sky, watch)


def _engine_of(variant: str) -> engine.Engine:
    """What the set was rendered with; UserError where it cannot be had here."""
    if variant == "llvm_ad_rgb" and engine.find_llvm() is None:
        raise UserError(
            f"the set was rendered with {variant}, and so must be its radiance, but no libLLVM "
            f"{engine.MIN_LLVM} or newer was found on this system. Run "
            f'"{engine.install_hint()}", or set {engine.LLVM_PATH_VARIABLE}.'
        )
    return engine.choose(variant)


def _require_same(
    frame: Frame, spec: dict[str, Any], cameras: Sequence[Camera], samples: dict[str, Any]
) -> None:
    """Raises UserError if what is drawn today is not what was rendered."""
    same_scene = json.loads(json.dumps(spec)) == frame.spec["scene"]
    same_scene &= samples == frame.spec["samples"]
    poses = [camera.T_world_cam for camera in cameras]
    if not (same_scene and np.allclose(poses, frame.read("T_world_cam"), rtol=0, atol=1e-9)):
        raise UserError(
            f"frame {frame.spec['frame_index']} was rendered by simgen "
            f"{frame.spec['versions']['simgen']} of another day, and is drawn otherwise by this "
            "one: its radiance cannot be had again. Render the set anew, or use that version."
        )


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise RuntimeError(f"OpenCV cannot encode {path.name}")
    path.write_bytes(data.tobytes())


def _write_exr(path: Path, channels: Mapping[str, NDArray[Any]]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    data = {name: np.ascontiguousarray(value) for name, value in channels.items()}
    with OpenEXR.File(header, data) as file:
        file.write(str(path))


def read_exr(path: Path) -> dict[str, NDArray[Any]]:
    """The channels of an EXR file, each (H, W) under its own name."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def _cameras(frame: Frame) -> dict[str, Any]:
    names = ("K", "T_world_cam", "T_world_cam_nominal", "perturbation_deg")
    return {**{n: getattr(frame, n).tolist() for n in names}, "pairs": frame.pairs,
            "spec": frame.spec}  # fmt: skip
