"""One frame, from its number to arrays: spec → world → images and ground truth.

Everything about frame i follows from (dataset seed, i, attempt), never from what was rendered
before, by whom, or in which order. Where several frames share a scene, attempts change what is a
frame's own: rig, shower, paths and noise.
"""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import drjit as dr
import numpy as np
import psutil
from numpy.typing import NDArray

from simgen import (
    __version__,
    daylight,
    glow,
    groundtruth,
    halos,
    rain,
    render,
    samples,
    scene,
    sensor,
    spray,
    world,
)
from simgen.checks import check_frame
from simgen.config import Job, draw_spec
from simgen.engine import Engine, activate
from simgen.ground import Optics
from simgen.metering import Exposure, expose
from simgen.recipe import SceneSpec, SkySpec, stream
from simgen.rig import PosedRig, pose
from simgen.run import MAX_ATTEMPTS, FrameRejected, FrameResult, FrameTask
from simgen.store import write_frame
from simgen.versions import versions

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""of glibc's malloc.h"""
LARGEST_INT, LARGEST_KEPT_BEFORE_2_35 = (1 << 31) - 1, 32 << 20
"""what mallopt can be told, and what older versions of glibc accept as M_MMAP_THRESHOLD"""
KEPT_BYTES = 24
"""of a block per pixel of an image, up to which memory is kept: three planes of 64 bits"""
SMALL_BLOCK = 1 << 20
"""bytes up to which memory is always kept for the next use"""
KERNEL_FOLDER = Path.home() / ".drjit"
"""where Dr.Jit leaves the kernels that it compiled, if it can"""
NIGHT_LAMPS = 17
"""light slots of a night scene, one of them dark, see scene.load"""


class Stopwatch:
    """Seconds per stage of a frame."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class FramePlan:
    """What was drawn for a frame; no pixel yet."""

    index: int
    attempt: int
    scene_index: int
    spec: SceneSpec
    drive: world.Drive
    posed: PosedRig
    shower: rain.Shower | None


def scene_of(frame_index: int, frames_per_scene: int) -> int:
    """Frames i of one scene are consecutive."""
    return frame_index // frames_per_scene


def plan_frame(job: Job, index: int, attempt: int) -> FramePlan:
    """Draws the scene and poses the rig in it."""
    scene_index = scene_of(index, job.frames_per_scene)
    step = index - scene_index * job.frames_per_scene
    if job.frames_per_scene == 1:
        spec = draw_spec(job, scene_index, attempt)
        drive = world.drive(spec, step, job.opendrive)
    else:
        spec, drive = _shared_scene(job, scene_index, step)
    rng = stream(job.seed, index, attempt, "rig")
    posed = pose(job.rig, drive.T_world_vehicle, job.wh, rng=rng)
    shower = rain.draw_shower(
        spec.sky.rain_mm_h, spec.road.kind, dark=daylight.is_night(spec.sky),
        num_lenses=0 if job.sensor == "ideal" else len(posed.cameras),
        rng=stream(job.seed, index, attempt, "shower"),
    )  # fmt: skip
    return FramePlan(index, attempt, scene_index, spec, drive, posed, shower)


def _shared_scene(job: Job, scene_index: int, step: int) -> tuple[SceneSpec, world.Drive]:
    """The first draw of a scene whose road can be built and is long enough, and the rig in it.

    It follows from the scene alone: a frame that is drawn again stays in the scene of the others.
    """
    for attempt in range(MAX_ATTEMPTS):
        spec = draw_spec(job, scene_index, attempt)
        try:
            return spec, world.drive(spec, step, job.opendrive, num_steps=job.frames_per_scene)
        except Exception as error:  # as with one frame to a scene: whatever a road breaks on
            reason = f"{type(error).__name__}: {error}"
    raise RuntimeError(f"no road for scene {scene_index} in {MAX_ATTEMPTS} draws: {reason}")


def make_frame(job: Job, index: int, attempt: int) -> tuple[dict[str, Any], dict[str, float]]:
    """Renders frame ``index``: arrays by schema field (one frame), and seconds per stage."""
    watch = Stopwatch()
    with watch("draw"):
        plan = plan_frame(job, index, attempt)
    loaded, sky = load(plan, job, watch)
    radiances = radiance(plan, job, loaded, sky, watch)
    with watch("develop"):
        images, exposures = _develop(plan, job, radiances)
    del radiances
    with watch("ground truth"):
        truth = _ground_truth(plan, job, loaded)
    frame = {
        "image": images,
        **truth,
        **_cameras(plan),
        "frame_index": np.int64(plan.index),
        "scene_index": np.int64(plan.scene_index),
        "spec": _spec_json(plan, job, exposures, loaded.movers),
    }
    del loaded
    free_memory()
    return frame, watch.seconds


def load(plan: FramePlan, job: Job, watch: Stopwatch) -> tuple[scene.Scene, Any]:
    """Builds the frame's world and hands it to Mitsuba; returns it with the sky."""
    with watch("build"):
        built = world.build(plan.spec, plan.drive, optics(plan, job))
    with watch("load"):
        night = daylight.is_night(plan.spec.sky)
        loaded = scene.load(built, num_lamps=NIGHT_LAMPS if night else 0)
        sky = built.sky
        del built
        trim()  # before the tracer takes most of what a frame needs
        return loaded, sky


def radiance(
    plan: FramePlan, job: Job, loaded: scene.Scene, sky: Any, watch: Stopwatch
) -> list[render.Image]:
    """Linear radiance (H, W, 3) of every camera, haze, spray and rain included."""
    air = daylight.airlight(sky)
    visibility_m = plan.spec.sky.visibility_m
    clear, spp = [], frame_samples(plan, job)["spp"]
    for number, camera in enumerate(plan.posed.cameras):
        seed = int(stream(job.seed, plan.index, plan.attempt, f"paths {number}").integers(1 << 31))
        image, features, seconds = render.render(
            loaded, camera, spp=spp, denoise=job.denoise, seed=seed
        )
        clear.append((image, features, camera))
        for stage, spent in asdict(seconds).items():
            watch.seconds[stage] = watch.seconds.get(stage, 0.0) + spent
    with watch("haze"), ThreadPoolExecutor() as pool:
        images = list(
            pool.map(lambda c: render.through_haze(c[0], c[1], c[2], air, visibility_m), clear)
        )
        if len(loaded.glow.face):
            for image, camera in zip(images, plan.posed.cameras, strict=True):
                image += glow.emitted(loaded, camera, visibility_m)
    distances = [np.where(f.coverage > 0, f.distance_m, np.inf) for _, f, _ in clear]
    del clear
    with watch("haze"):
        images = _with_halos(plan, loaded, images, distances)
        images = _in_spray(plan, loaded, images, distances, air)
    if plan.shower is None:
        return images
    with watch("rain"):
        return _in_rain(plan, job, plan.shower, images, distances, sky)


def frame_samples(plan: FramePlan, job: Job) -> dict[str, Any]:
    """As the frame's spec holds them; "spp" is the path tracer's."""
    return samples.of_frame(job.samples, night=daylight.is_night(plan.spec.sky))


def _foggy_night(sky: SkySpec) -> bool:
    """Whether lamps have halos."""
    return daylight.is_night(sky) and sky.visibility_m < halos.BELOW_M


def _with_halos(
    plan: FramePlan, loaded: scene.Scene, images: list[render.Image], distances: list[render.Image]
) -> list[render.Image]:
    """Radiances with the light that fog scatters around lamps."""
    cameras, visibility_m = plan.posed.cameras, plan.spec.sky.visibility_m
    if not _foggy_night(plan.spec.sky):
        return images
    shining = halos.lights(loaded, cameras, visibility_m)

    def one(c: int) -> render.Image:
        return images[c] + halos.scattered(shining, cameras[c], distances[c], visibility_m)

    with ThreadPoolExecutor() as pool:
        return list(pool.map(one, range(len(images))))


def _plumes(plan: FramePlan, movers: list[dict[str, Any]]) -> list[spray.Plume]:
    return spray.plumes(movers, plan.spec.sky.wetness, rng=plan.spec.stream("spray"))


def _in_spray(
    plan: FramePlan,
    loaded: scene.Scene,
    images: list[render.Image],
    distances: list[render.Image],
    air: render.Image,
) -> list[render.Image]:
    """Radiances behind what wheels throw up, which all cameras see."""
    plumes = _plumes(plan, loaded.movers)
    if not plumes:
        return images
    cloud, cameras = spray.puffs(plumes, loaded.movers), plan.posed.cameras

    def one(c: int) -> render.Image:
        return spray.seen_in_spray(images[c], cloud, cameras[c], distances[c], air)

    with ThreadPoolExecutor() as pool:
        return list(pool.map(one, range(len(images))))


def _in_rain(
    plan: FramePlan,
    job: Job,
    shower: rain.Shower,
    images: list[render.Image],
    distances: list[render.Image],
    sky: render.Image,
) -> list[render.Image]:
    """Radiances behind falling drops, which all cameras see, and behind those on each's glass."""
    cameras, seed = plan.posed.cameras, (job.seed, plan.index, plan.attempt)
    drops = rain.falling(shower, cameras, plan.drive.T_world_vehicle, rng=stream(*seed, "rain"))

    def one(c: int) -> render.Image:
        hidden = rain.streaks(drops, cameras[c], distances[c])
        outside = rain.seen_through(images[c], hidden, sky)
        num = shower.lens_drops[c] if shower.lens_drops else 0
        return rain.through_wet_glass(outside, num, rng=stream(*seed, f"glass {c}"))

    with ThreadPoolExecutor() as pool:
        return list(pool.map(one, range(len(images))))


def _develop(
    plan: FramePlan, job: Job, radiances: list[render.Image]
) -> tuple[NDArray[np.uint8], list[Exposure]]:
    """Images (C, H, W, 3) of a rig that exposes together; each camera has noise of its own."""
    draws = stream(job.seed, plan.index, plan.attempt, "sensor")
    exposures = expose(job.sensor, radiances, rng=draws)
    with ThreadPoolExecutor() as pool:
        images = pool.map(
            lambda c: sensor.develop(radiances[c], exposures[c], rng=noise_stream(plan, job, c)),
            range(len(radiances)),
        )
        return np.stack(list(images)), exposures


def noise_stream(plan: FramePlan, job: Job, camera: int) -> np.random.Generator:
    """The generator of one camera's noise."""
    return stream(job.seed, plan.index, plan.attempt, f"noise {camera}")


def free_memory() -> None:
    """Returns what a scene held; without it memory creeps up from frame to frame.

    glibc keeps freed memory in the arenas of its threads: without trimming, a worker that needs
    300 MiB between two small frames had grown to 1 GiB after 25 of them. Dr.Jit keeps each kernel
    that it has met, 20 MiB after a dozen frames; to read those on disk again takes up to 0.2 s of
    CPU a frame.
    """
    gc.collect()
    dr.flush_malloc_cache()
    if os.access(KERNEL_FOLDER, os.W_OK):
        dr.flush_kernel_cache()
    trim()


def trim() -> None:
    """Gives freed memory back to the system."""
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)


def optics(plan: FramePlan, job: Job) -> Optics:
    """What the rig sees of the ground."""
    K = plan.posed.cameras[0].K
    lowest = np.arctan2(job.wh[1] / 2, K[1, 1]) + np.deg2rad(job.rig.perturbation_deg)
    nearest = plan.posed.height_m / np.tan(min(lowest, 1.2))
    return Optics(float(K[0, 0]), float(np.deg2rad(job.rig.hfov_deg)), float(nearest))


def _ground_truth(plan: FramePlan, job: Job, loaded: scene.Scene) -> dict[str, Any]:
    cameras = plan.posed.cameras
    views = [groundtruth.look(loaded, camera) for camera in cameras]
    depth = [groundtruth.depth(v) for v in views]
    pairs = job.rig.pairs
    truth = {
        "depth": np.stack(depth),
        "semantic": np.stack([groundtruth.semantic(v, loaded.faces) for v in views]),
        "instance": np.stack([groundtruth.instance(v, loaded.faces) for v in views]),
        "flow_status": np.stack(
            [groundtruth.flow_status(loaded, views[a], views[b]) for a, b in pairs]
        ),
        "flow_status_reverse": np.stack(
            [groundtruth.flow_status(loaded, views[b], views[a]) for a, b in pairs]
        ),
    }
    if job.flow:
        truth["flow"] = np.stack(
            [groundtruth.flow(depth[a], cameras[a], cameras[b]) for a, b in pairs]
        )
    return truth


def _cameras(plan: FramePlan) -> dict[str, Any]:
    posed = plan.posed
    return {
        "K": np.stack([c.K for c in posed.cameras]),
        "T_world_cam": np.stack([c.T_world_cam for c in posed.cameras]),
        "T_world_cam_nominal": posed.T_world_cam_nominal,
        "perturbation_deg": posed.perturbation_deg,
    }


def _spec_json(
    plan: FramePlan, job: Job, exposures: list[Exposure], movers: list[dict[str, Any]]
) -> dict[str, Any]:
    """All that is needed to render the frame again."""
    sky = plan.spec.sky
    return {
        "frame_index": plan.index,
        "scene_index": plan.scene_index,
        "attempt": plan.attempt,
        "dataset_seed": job.seed,
        "recipe": plan.spec.recipe,
        "daylight": {"name": sky.daylight, "sun_elevation_deg": sky.sun_elevation_deg,
                     "sun_azimuth_deg": sky.sun_azimuth_deg},
        "weather": {"name": sky.weather, "cloud_cover": sky.cloud_cover,
                    "turbidity": sky.turbidity, "visibility_m": sky.visibility_m},
        "rig": {"name": job.rig_name, "height_m": plan.posed.height_m,
                "perturbation_deg": job.rig.perturbation_deg, "hfov_deg": job.rig.hfov_deg},
        "T_world_vehicle": plan.drive.T_world_vehicle.tolist(),
        "scene": plan.spec.to_json(),
        "movers": movers,
        "opendrive": job.opendrive_sha256,
        "rain": asdict(plan.shower) if plan.shower else None,
        "spray": [asdict(p) for p in _plumes(plan, movers)] or None,
        "halos": {"g": halos.FORWARD, "lights": halos.MOST_LIGHTS} if _foggy_night(sky) else None,
        "sensor": job.sensor,
        "exposure": [asdict(e) for e in exposures],
        "samples": frame_samples(plan, job),
        "denoiser": "Open Image Denoise, fast, on irradiance" if job.denoise else "none",
        "engine": job.variant,
        "versions": {"simgen": __version__, **versions()},
    }  # fmt: skip


# --- in a worker ---------------------------------------------------------------------------------


def start(engine: Engine, threads: int, wh: tuple[int, int]) -> None:
    """Loads Mitsuba in a worker process that will render images of size ``wh``."""
    os.environ["RUST_BACKTRACE"] = "0"  # of roadgen's panics: 50 MiB of symbols, kept for good
    _keep_memory_flat(largest_kept=max(SMALL_BLOCK, KEPT_BYTES * wh[0] * wh[1]))
    activate(engine, threads)
    cv2.setNumThreads(threads)


def _keep_memory_flat(largest_kept: int) -> None:
    """Lets all threads allocate in one place, and blocks of more bytes than that stay out of it.

    What is freed in arenas of a thread's own stays there. In the common one, arrays of some
    megabytes leave holes between what lives longer: a worker kept between 360 and 410 MiB after
    small frames, and 334 to 338 so. But each block that comes fresh from the system costs page
    faults, a fifth of the time that a full-size scene takes to build: so arrays up to the size of
    an image are kept, and the end of the heap is not given back with each of them, but only by
    :func:`trim`. That left 550,000 of 800,000 faults of a frame, 40,000 instead of 230,000 of
    them outside of the tracer.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_ARENA_MAX, 1)
        for threshold in (largest_kept, LARGEST_KEPT_BEFORE_2_35):
            if libc.mallopt(M_MMAP_THRESHOLD, min(threshold, LARGEST_INT)):
                break
        libc.mallopt(M_TRIM_THRESHOLD, min(8 * largest_kept, LARGEST_INT))


def render_frame_file(task: FrameTask) -> FrameResult:
    """Renders, checks and writes one frame; raises FrameRejected if the check fails."""
    watch = Stopwatch()
    job: Job = task.job
    frame, seconds = make_frame(job, task.index, task.attempt)
    with watch("check"):
        findings = check_frame(frame, np.array(job.rig.pairs, dtype=np.uint8), thorough=False)
        failed = [f for f in findings if not f.passed]
    if failed:
        raise FrameRejected(
            [f"{f.check} {f.value:g} (limit {f.limit:g}) {f.where}" for f in failed]
        )
    with watch("write"):
        write_frame(task.path, frame, pairs=job.rig.pairs, compression=job.compression)
    del frame
    free_memory()
    memory = psutil.Process()
    return FrameResult(task.index, task.attempt, {**seconds, **watch.seconds},
                       memory.memory_info().rss, memory.pid)  # fmt: skip
