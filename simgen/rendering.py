"""``simgen render``: says what it will do, does it, says what came of it."""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from simgen import __version__, engine, given_map, progress, run
from simgen.config import Job, RenderOptions, draw_spec, resolve
from simgen.daylight import night_share
from simgen.errors import UserError
from simgen.page import size_text
from simgen.rig import drive_length
from simgen.schema import SCHEMA_VERSION
from simgen.shards import MANIFEST, Manifest
from simgen.survey import read_log
from simgen.workers import num_cores, num_workers, threads_of_worker

UNITS = "metres, pixels, degrees where a name ends in _deg"
CONVENTIONS = (
    "Camera axes: x right, y down, z forward. World: x ahead where the drive begins, y left, z up. "
    "Pixel centre of the top-left pixel: (0, 0). T_world_cam takes camera to world. flow: "
    "uv_right = uv_left + flow. See CONVENTIONS.md."
)

# Compressed bytes per pixel, and seconds, as measured in benchmarks/ with the default options on
# two cores of an x86-64 server: the estimate before a set has timings of its own.
_BYTES_PER_CAMERA_PIXEL = 4.4
_BYTES_PER_PAIR_PIXEL = 4.3
_SECONDS_FIXED = 6.0
_SECONDS_PER_CAMERA_MEGAPIXEL = 2.1
_SECONDS_PER_MEGASAMPLE = 0.6
_SCALAR_FACTOR = 4.0
_SECONDS_OF_WORKER = 1.7
"""of a worker that has one core, over those of one with two"""

SCENES_TRIED = 3
"""of a map, before a set is begun"""


@dataclass(frozen=True)
class Estimate:
    """What a set will cost."""

    bytes_per_frame: float
    seconds_per_frame: float
    """of the clock, by all workers together"""


def render(options: RenderOptions) -> int:
    """The command; returns its exit status."""
    console = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
    chosen = engine.choose(options.variant)
    job = resolve(options, chosen.variant)
    if chosen.notice:
        console.print(chosen.notice)
    set_plan = run.plan(
        options.n,
        len(job.rig.pairs),
        frames_per_scene=job.frames_per_scene,
        frames_per_shard=options.frames_per_shard,
        split=options.split,
    )
    folder = run.SetFolder(options.out)
    folder.check_is_ours()
    left = len(set_plan.frames) - folder.num_done(set_plan)
    if options.opendrive and left and not (options.out / MANIFEST).exists():
        _require_buildable(options.opendrive, job, set_plan.scenes[:SCENES_TRIED])
    workers = options.workers or num_workers(job.wh, len(job.rig.camera_y_m), left)
    estimate = _estimate(job, options.out, workers)
    _announce(console, job, options, set_plan, left, estimate, workers)
    run.check_disk(options.out, left * estimate.bytes_per_frame, force=options.force)
    with folder.locked():
        manifest = folder.open_manifest(
            job.content(), options.frames_per_shard, options.n, options.split
        )
        given_map.keep(job.opendrive, options.out)
        pool = run.Pool(_render_one(), _start_worker(),
                        (chosen, threads_of_worker(workers), job.wh),
                        workers, options.recycle)  # fmt: skip
        with _Display(console, len(job.rig.pairs)) as display:
            manifest = run.render_set(
                job, set_plan, folder, manifest, pool, attributes=_attributes(job),
                compression=options.compression, progress=display.hooks,
            )  # fmt: skip
    return _conclude(console, manifest, options.out)


def _require_buildable(path: Path, job: Job, scenes: Sequence[int]) -> None:
    """UserError if the roads of these scenes break in every draw: so would all, or most, others'.

    Before the folder is made, which would then be bound to this map.
    """
    from simgen import roads  # not needed without a map

    draws = list(itertools.product(scenes, range(run.MAX_ATTEMPTS)))
    for scene, attempt in draws:
        try:
            roads.build(draw_spec(job, scene, attempt), job.opendrive,
                        drive_m=drive_length(job.frames_per_scene))  # fmt: skip
            return
        except (ValueError, RuntimeError, LookupError, ArithmeticError) as error:
            reason = str(error).partition("\n")[0]
    raise UserError(
        f"--opendrive {path}: its roads cannot be built, wherever the rig starts ({len(draws)} "
        f"places tried); of the last: {reason}. Mend the map, cut it down to sound roads, or try "
        "other places by another --seed."
    )


def _render_one() -> run.RenderOne:
    from simgen.produce import render_frame_file

    return render_frame_file


def _start_worker() -> Callable[..., None]:
    from simgen.produce import start

    return start


def _attributes(job: Job) -> dict[str, object]:
    return {
        "schema_version": SCHEMA_VERSION,
        "units": UNITS,
        "conventions": CONVENTIONS,
        "dataset_seed": job.seed,
        "config": json.dumps(job.content(), sort_keys=True),
        "package_version": __version__,
    }


# --- saying what will happen ---------------------------------------------------------------------


def _estimate(job: Job, folder: Path, workers: int) -> Estimate:
    """From the folder's own timings by as many workers if it has any, else from the benchmark's.

    The benchmark had two cores for itself; a folder's log holds the seconds of each worker.
    """
    megapixels = job.wh[0] * job.wh[1] / 1e6
    cameras, pairs = len(job.rig.camera_y_m), len(job.rig.pairs)
    flow_bytes = _BYTES_PER_PAIR_PIXEL * pairs if job.flow else 0.1 * pairs
    size = megapixels * 1e6 * (_BYTES_PER_CAMERA_PIXEL * cameras + flow_bytes)
    by_day, at_night = job.samples["day_spp"], job.samples["night_spp"]
    spp = by_day + (at_night - by_day) * night_share(job.daylight)
    seconds = _SECONDS_FIXED + cameras * megapixels * (
        _SECONDS_PER_CAMERA_MEGAPIXEL + _SECONDS_PER_MEGASAMPLE * spp
    )
    if job.variant == "scalar_rgb":
        seconds *= _SCALAR_FACTOR
    if workers > 1:
        seconds *= _SECONDS_OF_WORKER / min(workers, num_cores())
    logged = _logged_seconds(folder, workers)
    return Estimate(size, logged / workers if logged else seconds)


def _logged_seconds(folder: Path, workers: int) -> float | None:
    """Of a worker for a frame, while so many shared the machine."""
    log = [r for r in read_log(folder).finished if r.get("workers") == workers]
    spent = [sum(r["seconds"].values()) for r in log]
    return float(np.median(spent)) if spent else None


def _announce(
    console: Console,
    job: Job,
    options: RenderOptions,
    plan: run.SetPlan,
    left: int,
    estimate: Estimate,
    workers: int,
) -> None:
    num_pairs = len(job.rig.pairs)
    num = len(plan.frames)
    if plan.num_frames * num_pairs != options.n:
        console.print(
            f"--n {options.n} is rounded up to {plan.num_frames * num_pairs} pairs: a rig frame "
            f"has {num_pairs}."
        )
    what = (
        f"{num} rig frames, {num * num_pairs} pairs, {job.wh[0]}x{job.wh[1]}, seed {job.seed}, "
        f"{job.variant}"
    )
    if not left:
        console.print(f"{what}: all there in {options.out}")
        return
    still = f"the {left} frames left take " if left < num else ""
    hours = left * estimate.seconds_per_frame / 3600
    time_text = f"{hours:.1f} h" if hours >= 1 else f"{max(1, round(hours * 60))} min"
    size = size_text(left * estimate.bytes_per_frame)
    console.print(
        f"{what}: {still}about {time_text} and {size} in {options.out}"
        + f", by {workers} workers" * (workers > 1)
    )


# --- saying what happens -------------------------------------------------------------------------


class _Display:
    """A progress bar on a terminal, a line per frame elsewhere."""

    def __init__(self, console: Console, pairs_per_frame: int) -> None:
        self.console, self.pairs = console, pairs_per_frame
        self.bar = progress.bar(
            TextColumn("rig frames"), BarColumn(), MofNCompleteColumn(),
            TextColumn("{task.fields[pairs]} pairs"),
            TextColumn("{task.fields[pace]}"), TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
        )  # fmt: skip
        self.hooks = run.Progress(self._started, self._frame_done, self._note)
        self.total = self.done = self.first = 0
        self.start = time.monotonic()

    def __enter__(self) -> _Display:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def _started(self, done: int, total: int) -> None:
        self.done, self.first, self.total = done, done, total
        self.start = time.monotonic()
        if done:
            self.console.print(f"Going on: {done} of {total} rig frames are there already.")
        self.task = self.bar.add_task(
            "", total=total, completed=done, pairs=done * self.pairs, pace=""
        )

    def _frame_done(self, result: run.FrameResult) -> None:
        self.done += 1
        pace = (time.monotonic() - self.start) / (self.done - self.first)
        self.bar.update(self.task, completed=self.done, pairs=self.done * self.pairs,
                        pace=f"{pace:.1f} s/frame")  # fmt: skip
        if not self.console.is_terminal:
            left = (self.total - self.done) * pace / 60
            self.console.print(
                f"frame {result.index}: {self.done} of {self.total}, "
                f"{self.done * self.pairs} pairs, {pace:.1f} s/frame, {left:.0f} min left"
            )

    def _note(self, text: str) -> None:
        self.console.print(text)


def _conclude(console: Console, manifest: Manifest, folder: Path) -> int:
    num = sum(len(s.frames) for s in manifest.shards)
    console.print(f"{num} rig frames in {len(manifest.shards)} shards: {folder}")
    if not manifest.failures:
        return 0
    for failure in manifest.failures:
        reasons = "; ".join(failure["reasons"])
        console.print(f"Frame {failure['frame_index']} failed: {reasons}", style="red")
    print(f"simgen: {len(manifest.failures)} frames could not be made", file=sys.stderr)
    return 1
