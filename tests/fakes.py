"""Frames of 8×6 pixels from arithmetic alone, and workers that fail in every way.

Imports no Mitsuba, so that a spawned worker starts quickly. A run's ``job`` is any picklable
value; here it is a :class:`FakeJob`.
"""

from __future__ import annotations

import errno
import os
import signal
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simgen.flowfield import flow_from_depth
from simgen.geometry import intrinsics, inverse, transform
from simgen.run import FrameRejected, FrameResult, FrameTask
from simgen.store import write_frame

WH = (8, 6)
PAIRS = ((0, 1), (1, 2), (0, 2))
NUM_CAMERAS = 3


@dataclass(frozen=True)
class FakeJob:
    """What decides a fake frame, and where its worker leaves marks."""

    seed: int = 0
    flow: bool = True
    compression: str = "gzip"
    marks: Path = Path()
    """folder for traces that outlive a process; no part of the content"""

    def content(self) -> dict[str, Any]:
        """As of a real job."""
        own = {k: v for k, v in asdict(self).items() if k != "marks"}
        rig = {"name": "fake", "pairs": [list(pair) for pair in PAIRS]}
        tables: dict[str, Any] = {"recipes": {}, "daylight": {}, "weather": {}}
        return {"rig": rig, "size": "8x6", "spp": 1, "denoise": False, "sensor": "ideal", **tables,
                "frames_per_scene": 1, "variant": "fake", **own}  # fmt: skip


def make_frame(seed: int, index: int, attempt: int = 0, *, flow: bool = True) -> dict[str, Any]:
    """All fields of the schema, a pure function of the arguments."""
    rng = np.random.default_rng([seed, index, attempt])
    w, h = WH
    c, p = NUM_CAMERAS, len(PAIRS)
    K = np.stack([intrinsics(WH, 80 + camera + rng.random()) for camera in range(c)])
    T = np.stack([transform(_rotation(rng), [0.8 * camera, 0.0, 1.6]) for camera in range(c)])
    depth = rng.uniform(4, 90, (c, h, w)).astype(np.float32)
    depth[:, 0] = 0  # sky
    frame = {
        "image": rng.integers(0, 256, (c, h, w, 3), dtype=np.uint8),
        "depth": depth,
        "semantic": rng.integers(0, 34, (c, h, w), dtype=np.uint8),
        "instance": rng.integers(0, 900, (c, h, w), dtype=np.uint16),
        "flow": np.stack([_flow(depth, K, T, a, b) for a, b in PAIRS]),
        "flow_status": rng.choice(np.array([1, 2, 4, 9], np.uint8), (p, h, w)),
        "flow_status_reverse": rng.choice(np.array([1, 2, 4, 9], np.uint8), (p, h, w)),
        "K": K,
        "T_world_cam": T,
        "T_world_cam_nominal": T + 0.01,
        "perturbation_deg": rng.uniform(-1, 1, (c, 3)),
        "frame_index": np.int64(index),
        "scene_index": np.int64(index),
        "spec": {"recipe": "fäke", "attempt": attempt, "draws": rng.random(3).tolist()},
    }
    if not flow:
        del frame["flow"]
    return frame


def _rotation(rng: np.random.Generator) -> np.ndarray:
    """A random rotation near the identity, exactly as float64 rounds it."""
    Q, _ = np.linalg.qr(np.eye(3) + 0.02 * rng.standard_normal((3, 3)))
    return Q * np.sign(np.diag(Q))


def _flow(depth: np.ndarray, K: np.ndarray, T: np.ndarray, a: int, b: int) -> np.ndarray:
    return flow_from_depth(depth[a], K[a], K[b], inverse(T[b]) @ T[a])


# --- workers -------------------------------------------------------------------------------------


def start(*_: object) -> None:
    """An initializer that has nothing to load, whatever it is told."""


def cannot_start() -> None:
    """An initializer that fails."""
    raise RuntimeError("no such renderer")


def render(task: FrameTask) -> FrameResult:
    """Makes and writes a frame."""
    job: FakeJob = task.job
    frame = make_frame(job.seed, task.index, task.attempt, flow=job.flow)
    write_frame(task.path, frame, pairs=PAIRS, compression=job.compression)
    return FrameResult(task.index, task.attempt, {"fake": 0.001}, 1, os.getpid())


def render_slowly(task: FrameTask) -> FrameResult:
    """Takes long enough for a test to interrupt the run, and tells its process id."""
    (task.job.marks / f"worker-{os.getpid()}").touch()
    time.sleep(0.25)
    return render(task)


def render_first_last(task: FrameTask) -> FrameResult:
    """Frame 0 waits for frame 3, so that two workers finish out of order."""
    deadline = time.monotonic() + 30
    while task.index == 0 and not (task.job.marks / "third").exists():
        assert time.monotonic() < deadline
        time.sleep(0.2)
    result = render(task)
    if task.index == 3:
        (task.job.marks / "third").touch()
    elif task.index == 0:
        time.sleep(1.0)  # until the other result has arrived
    return result


def die_once(task: FrameTask) -> FrameResult:
    """Frame 2 kills its process, the first time."""
    if task.index == 2 and _first_time(task, "died"):
        os.kill(os.getpid(), signal.SIGKILL)
    return render(task)


def die_always(task: FrameTask) -> FrameResult:
    """Frame 2 kills its process, every time."""
    if task.index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return render(task)


def reject_first_attempt(task: FrameTask) -> FrameResult:
    """Frames 1 and 4 fail their check at attempt 0."""
    if task.index in (1, 4) and task.attempt == 0:
        raise FrameRejected(["depth 7 (limit 3) [camera 0]", "too dark"])
    return render(task)


def reject_first_attempt_slowly(task: FrameTask) -> FrameResult:
    """As reject_first_attempt, and slow."""
    time.sleep(0.25)
    return reject_first_attempt(task)


def reject_always(task: FrameTask) -> FrameResult:
    """Frame 1 fails its check at every attempt."""
    if task.index == 1:
        raise FrameRejected([f"attempt {task.attempt} is bad"])
    return render(task)


def crash_always(task: FrameTask) -> FrameResult:
    """No frame can be built."""
    raise ImportError(f"no sky,\nnot even {task.index % 2}")


def succeed_last(task: FrameTask) -> FrameResult:
    """Frames 1 to 5 fail; frame 0 is begun before them and fails after them, but only once."""
    marks = [task.job.marks / f"failed-{i}" for i in range(1, 6)]
    if 1 <= task.index <= 5:
        (marks[task.index - 1]).touch()
        raise FrameRejected(["no sky"])
    if task.index == 0 and task.attempt == 0:
        deadline = time.monotonic() + 30
        while not all(mark.exists() for mark in marks):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        time.sleep(1.0)  # until the last failures have arrived
        raise FrameRejected(["too dark"])
    return render(task)


def crash_on_first_attempt(task: FrameTask) -> FrameResult:
    """Frame 1 cannot be built at attempt 0."""
    if task.index == 1 and task.attempt == 0:
        raise ZeroDivisionError("no road")
    return render(task)


def fault_once(task: FrameTask) -> FrameResult:
    """The machine, not the draw, fails frame 1 once."""
    if task.index == 1 and _first_time(task, "fault"):
        raise OSError(errno.EIO, "Input/output error")
    return render(task)


def disk_full(task: FrameTask) -> FrameResult:
    """From frame 2 on there is no space."""
    if task.index >= 2:
        raise OSError(errno.ENOSPC, "No space left on device")
    return render(task)


def _first_time(task: FrameTask, mark: str) -> bool:
    path: Path = task.job.marks / mark
    if path.exists():
        return False
    path.touch()
    return True
