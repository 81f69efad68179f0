"""First pass: every method on every pair, in a process of its own that may be stopped.

A method that raises, or takes longer than it may, costs that pair only: the failure is recorded
and the run goes on. Matches are found once per pair and matcher, and kept in files. What is done
is not done again.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from itertools import groupby
from multiprocessing.context import BaseContext
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from pebble import ProcessExpired, ProcessPool

from flowrect.evaluation import predictions, stamp
from flowrect.evaluation.delivered import Delivered, Delivery, Translation, prior
from flowrect.evaluation.kept import read_arrays, write_arrays
from flowrect.evaluation.predictions import Origin, Prediction
from flowrect.matchers import PARTS, joined, load_matcher
from flowrect.matches import Matches
from flowrect.memory import keep_freed_memory
from flowrect.methods import FromMatches, Method, PoseEstimate, Seconds, load_method
from flowrect.sample import Pair, Prepared
from flowrect.solvers import NoSolution
from simgen.errors import UserError
from simgen.geometry import Array

FAULT = "fault of the machine"
"""begins a failure that is not the method's: such a pair is tried again by the next run"""
TOO_LONG = "took longer than {:g} s and was stopped"
"""a failure that a run with more time tries again"""
FLUSH_S = 10.0
"""between two writings of what was predicted"""


@dataclass(frozen=True)
class Run:
    """What is to be predicted, and where it goes."""

    delivery: Delivery
    methods: tuple[str, ...]
    translations: tuple[Translation, ...]
    out: Path
    time_limit_s: float = 120.0
    """that a method may take for one pair, the first time with what it loads"""
    jobs: int = 1
    """processes, each of which takes whole pairs"""

    def path(self, method: str, translation: Translation) -> Path:
        """Where a method's predictions are."""
        return self.out / "predictions" / f"{predictions.file_name(method)}.{translation}.h5"


@dataclass
class _File:
    """The predictions of one method under work."""

    path: Path
    origin: Origin
    translation: Translation
    rows: dict[int, Prediction]
    changed: bool = False
    """since it was written"""

    @property
    def method(self) -> str:
        return self.origin.method


OnProgress = Callable[[int, int], None]
"""called with tasks done, and of all"""


Load = Callable[[str], Method]
"""makes a method of its name, in the process that runs it: a function of some module"""


def predict(
    run: Run, report: OnProgress = lambda done, of: None, load: Load = load_method
) -> dict[str, str]:
    """Predicts what is missing; returns why methods that cannot run here cannot."""
    pairs = run.delivery.open()
    files = _files(run, pairs.fingerprint)
    todo = [(i, f) for i in range(len(pairs)) for f in files if i not in f.rows]
    unavailable: dict[str, str] = {}
    done, of = len(pairs) * len(files) - len(todo), len(pairs) * len(files)
    report(done, of)
    written = time.monotonic()
    try:
        for file, row in _predicted(run, pairs.fingerprint, todo, unavailable, load):
            file.rows[row.index], file.changed = row, True
            done += 1
            report(done, of)
            if time.monotonic() - written > FLUSH_S:
                _flush(files)
                written = time.monotonic()
    finally:
        _flush(files)
    return unavailable


def _files(run: Run, fingerprint: str) -> list[_File]:
    found = []
    for method in run.methods:
        for translation in run.translations:
            path = run.path(method, translation)
            origin = Origin(method, translation, fingerprint, stamp.of_method(method))
            rows = predictions.read(path, origin) if path.exists() else []
            kept = {r.index: r for r in rows if not _to_be_tried_again(r, run.time_limit_s)}
            found.append(_File(path, origin, translation, kept))
    return found


def _to_be_tried_again(row: Prediction, time_limit_s: float) -> bool:
    """Whether it was no fault of the method, or there is more time now."""
    before, _, after = TOO_LONG.partition("{:g}")
    if row.failure.startswith(before) and row.failure.endswith(after):
        return float(row.failure[len(before) : -len(after)]) < time_limit_s
    return row.failure.startswith(FAULT)


def _flush(files: Sequence[_File]) -> None:
    for file in files:
        if file.changed:
            predictions.write(file.path, file.rows.values(), file.origin)
            file.changed = False


@dataclass
class _Lane:
    """A process and its tasks: those of one pair, so that it is read and matched in one process."""

    pool: ProcessPool
    tasks: deque[tuple[int, _File]] = field(default_factory=deque)


def _predicted(
    run: Run, data: str, todo: Sequence[tuple[int, _File]], unavailable: dict[str, str], load: Load
) -> Iterator[tuple[_File, Prediction]]:
    """Predictions as they come, pair by pair."""
    folder = run.out / "matches" / data
    pairs = deque(deque(tasks) for _, tasks in groupby(todo, key=itemgetter(0)))
    running: dict[Any, tuple[int, _File, _Lane]] = {}

    def go_on(lane: _Lane) -> None:
        while lane.tasks or pairs:
            lane.tasks = lane.tasks or pairs.popleft()
            i, file = lane.tasks.popleft()
            if file.method not in unavailable:
                args = (load, run.delivery, file.method, file.translation, i, folder)
                future = lane.pool.schedule(_predict_one, args=args, timeout=run.time_limit_s)
                running[future] = i, file, lane
                return

    context = fork_server()
    with ExitStack() as stack:
        for _ in range(run.jobs):
            pool = stack.enter_context(ProcessPool(
                max_workers=1, context=context, initializer=share_cores, initargs=[run.jobs]
            ))  # fmt: skip
            stack.push(partial(stop_if_interrupted, pool))
            go_on(_Lane(pool))
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                i, file, lane = running.pop(future)
                row = _settled(future, i, run.time_limit_s)
                if isinstance(row, str):
                    unavailable[file.method] = row
                go_on(lane)  # before whoever takes the row does anything with it
                if isinstance(row, Prediction):
                    yield file, row


def stop_if_interrupted(pool: ProcessPool, error: object, *_: object) -> None:
    """A pool that is left by an error would wait for its task, however long that takes."""
    if error is not None:
        pool.stop()


def share_cores(jobs: int) -> None:
    """Called in one of so many processes: torch and OpenCV take its share of the cores."""
    keep_freed_memory()
    threads = max(1, min(torch.get_num_threads(), (os.cpu_count() or 1) // jobs))
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def fork_server() -> BaseContext:
    """Processes begin with all modules loaded: one that follows a stopped one begins at once.

    The server computes nothing: it has neither a GPU nor threads in use when it forks.
    """
    context = multiprocessing.get_context("forkserver")
    # What the command imports, but not itself: of that Python would warn whoever runs it by -m.
    context.set_forkserver_preload(["flowrect.evaluation.report", "flowrect.methods"])
    return context


def _settled(future: Any, i: int, time_limit_s: float) -> Prediction | str:
    """The prediction, or why the method cannot run at all."""
    try:
        result: Prediction | str = future.result()
        return result
    except TimeoutError:
        return Prediction(i, "", None, TOO_LONG.format(time_limit_s))
    except ProcessExpired as error:
        return Prediction(i, "", None, f"{FAULT}: its process died ({error})")


# --- in the process ------------------------------------------------------------------------------


def _predict_one(
    load: Load, delivery: Delivery, name: str, translation: Translation, i: int, folder: Path
) -> Prediction | str:
    """One method on one pair; a text if the method cannot be loaded here: it may want weights."""
    pair = _pair(delivery, i).input
    try:
        method = _method(load, name)
    except UserError as error:
        return str(error)
    except Exception as error:  # a broken package, a damaged file: it costs that method only
        return f"it cannot be loaded: {type(error).__name__}: {error}"
    row = partial(Prediction, i, pair.name, made_on=_made_on())
    try:
        found = _matched(method, pair, folder, i)
        row = partial(row, made_on=_made_on(m.made_on for m in found))
        estimate = _estimated(method, pair, prior(pair, translation), found)
        _require_pose(estimate)
        return row(estimate)
    except NoSolution as error:
        return row(None, _said(error), num_matches=error.num_matches, seconds=error.seconds)
    except UserError as error:
        return row(None, _said(error))
    except Exception as error:  # whatever else it is, it is this method's failure on this pair
        what = f"{type(error).__name__}: {error}"
        return row(None, f"{FAULT}: {what}" if _is_fault(error) else what)


def _said(error: Exception) -> str:
    """Its text: what has none would be no failure."""
    return str(error) or type(error).__name__


def _is_fault(error: Exception) -> bool:
    """Whether the machine is to blame; torch and OpenCV have their own ways of lacking memory."""
    if isinstance(error, RuntimeError):
        return "allocate memory" in str(error) or isinstance(error, torch.OutOfMemoryError)
    if isinstance(error, cv2.error):
        return error.code == cv2.Error.StsNoMem
    return isinstance(error, OSError | MemoryError)


def _made_on(matched_on: Iterable[str] = ()) -> str:
    """Machine and threads of this process, and those that matches were found on if others."""
    machine = platform.processor() or platform.machine()
    here = f"{machine}, torch {torch.get_num_threads()}, OpenCV {cv2.getNumThreads()} threads"
    others = dict.fromkeys(f" (matching: {m})" for m in matched_on if m != here)
    return "".join([here, *others])


def _require_pose(estimate: PoseEstimate) -> None:
    R, t = estimate.R, estimate.t
    if not (np.isfinite(R).all() and np.isfinite(t).all() and np.any(t)
            and np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0):  # fmt: skip
        raise NoSolution(f"its answer is no pose: R =\n{R}\nt = {t}")


class _Matched(NamedTuple):
    """What a matcher found, once for all methods."""

    matches: Matches
    seconds: float
    made_on: str
    """machine and threads"""


def _matched(method: Method, pair: Pair, folder: Path, i: int) -> list[_Matched]:
    """What a method begins with, by each part of its matcher; nothing if it looks for itself."""
    if not isinstance(method, FromMatches):
        return []
    parts = PARTS.get(method.matcher, (method.matcher,))
    return [_matches(folder / name / f"{i:06d}.npz", name, pair) for name in parts]


def _estimated(method: Method, pair: Pair, start: Array, found: Sequence[_Matched]) -> PoseEstimate:
    given = pair.left, pair.right, pair.K_left, pair.K_right, start
    if not isinstance(method, FromMatches):
        return method(*given)
    seconds = Seconds(matching=sum(m.seconds for m in found))
    return method.of_matches(joined([m.matches for m in found]), seconds, *given)


@lru_cache(maxsize=1)
def _delivered(delivery: Delivery) -> Delivered:
    return delivery.open()


@lru_cache(maxsize=1)
def _pair(delivery: Delivery, i: int) -> Prepared:
    return _delivered(delivery)[i]


@cache
def _method(load: Load, name: str) -> Method:
    method = load(name)
    if isinstance(method, FromMatches):
        load_matcher(method.matcher)  # says now if its weights are missing
    return method


_ARRAYS = ("uv_left", "uv_right", "score", "weight", "seen_px")


def _matches(path: Path, matcher: str, pair: Pair) -> _Matched:
    """The matches of a pair, from their file if there is one."""
    made_by = stamp.of_matcher(matcher)
    if (kept := read_arrays(path, "stamp", "seconds", "made_on", *_ARRAYS)) is not None:
        known_by, took_s, made_on, *points, seen_px = kept
        if str(known_by) == made_by:
            return _Matched(Matches(*points, seen_px=float(seen_px)), float(took_s), str(made_on))
    seconds = Seconds()
    with seconds.of("matching"):
        found = load_matcher(matcher)(pair.left, pair.right)
    made = _Matched(found, seconds["matching"], _made_on())
    arrays = {name: getattr(found, name) for name in _ARRAYS}
    write_arrays(path, seconds=made.seconds, made_on=made.made_on, stamp=made_by, **arrays)
    return made
