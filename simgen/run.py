"""From a job to a folder of shards: planning, workers, resuming.

Which frames a set has, and which shard each belongs to, follows from their numbers alone. Workers
are spawned processes that render one frame at a time into ``.frames/``; the parent assembles
shards. Running the same command again goes on with whatever is missing.
"""

from __future__ import annotations

import errno
import fcntl
import functools
import json
import multiprocessing
import os
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pebble import ProcessPool

from simgen import __version__
from simgen.errors import UserError
from simgen.page import size_text
from simgen.schema import SCHEMA_VERSION
from simgen.shards import MANIFEST, Manifest, ShardEntry, open_shard
from simgen.store import Source, assemble, file_sha256, stored_content
from simgen.versions import versions

FRAMES_DIR = ".frames"
LOCK = ".lock"
LOG = "render.jsonl"
MAX_ATTEMPTS = 3
GIVE_UP_AFTER = 5
"""Scenes of which a frame failed for good, in a set without any frame that succeeded: then none is
likely to."""
POLL_S = 0.25
"""How often a run looks up from waiting, to see whether it was told to stop."""
TEST_EVERY = 10
"""A scene whose number is divisible by this is a test scene."""


class FrameRejected(Exception):
    """A rendered frame failed its check."""

    def __init__(self, reasons: Sequence[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)


@dataclass(frozen=True)
class FrameTask:
    """One attempt at one frame, as it is sent to a worker."""

    job: Any
    index: int
    attempt: int
    path: Path
    """where the finished frame goes"""


@dataclass(frozen=True)
class FrameResult:
    """What a worker tells of a finished frame."""

    index: int
    attempt: int
    seconds: dict[str, float]
    rss_bytes: int
    pid: int


RenderOne = Callable[[FrameTask], FrameResult]


# --- planning ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ShardPlan:
    """A shard and the frames that belong into it."""

    name: str
    split: str
    frames: tuple[int, ...]


@dataclass(frozen=True)
class SetPlan:
    """All frames of a set, shard by shard."""

    num_frames: int
    """rig frames of both splits"""
    shards: tuple[ShardPlan, ...]
    frames_per_scene: int

    @property
    def frames(self) -> list[int]:
        """Frame indices to render, ascending."""
        return sorted(i for shard in self.shards for i in shard.frames)

    @property
    def scenes(self) -> list[int]:
        """Scenes of these frames, ascending."""
        return sorted({i // self.frames_per_scene for i in self.frames})


SIDES = ("train", "test")


def split_of(scene_index: int) -> str:
    """The side of the split that a scene is on, for ever."""
    return "test" if scene_index % TEST_EVERY == 0 else "train"


def plan(
    num_pairs: int,
    pairs_per_frame: int,
    *,
    frames_per_scene: int,
    frames_per_shard: int,
    split: str,
) -> SetPlan:
    """Lays a set out; ``num_pairs`` is rounded up to whole rig frames."""
    num_frames = -(-num_pairs // pairs_per_frame)
    shards = []
    for side in SIDES:
        frames = [i for i in range(num_frames) if split_of(i // frames_per_scene) == side]
        if split in ("all", side):
            for k in range(0, len(frames), frames_per_shard):
                name = f"{side}-{k // frames_per_shard:05d}.h5"
                shards.append(ShardPlan(name, side, tuple(frames[k : k + frames_per_shard])))
    return SetPlan(num_frames, tuple(shards), frames_per_scene)


# --- the folder ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class SetFolder:
    """A set's place on disk."""

    path: Path

    def frame_path(self, index: int) -> Path:
        """Where frame ``index`` waits for its shard."""
        return self.path / FRAMES_DIR / f"{index:08d}.h5"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Makes the folder ours; UserError if it cannot be written, or another run has it.

        A disk that fills up while it is ours is a UserError, too.
        """
        with self._writing():
            (self.path / FRAMES_DIR).mkdir(parents=True, exist_ok=True)
            lock = open(self.path / LOCK, "w")  # noqa: SIM115
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UserError(
                    f"{self.path}: another simgen is rendering into this folder. Wait for it, stop "
                    "it, or choose another --out."
                ) from error
            except OSError as error:
                raise UserError(
                    f"{self.path}: cannot be locked ({error.strerror}), so two runs could write "
                    "here at once: a file system without locks? Choose --out on another one."
                ) from error
            with _full_disk_explained(self.path):
                yield

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UserError(
                f"{self.path}: cannot write here ({error.strerror}). Choose another folder with "
                "--out, or mend its permissions."
            ) from error

    def check_is_ours(self) -> None:
        """UserError if the folder holds files but no set."""
        with self._writing():
            names = sorted(p.name for p in self.path.iterdir()) if self.path.is_dir() else []
        foreign = [name for name in names if name not in (FRAMES_DIR, LOCK)]
        if MANIFEST in names:
            return
        if foreign:
            raise UserError(
                f"{self.path}: holds files that simgen did not write ({', '.join(foreign[:3])}"
                f"{', …' if len(foreign) > 3 else ''}) and no {MANIFEST}. Choose an empty or new "
                "folder with --out."
            )

    def num_done(self, set_plan: SetPlan) -> int:
        """How many of a plan's frames are there already, in shards or waiting for one."""
        if not (self.path / MANIFEST).exists():
            return 0
        in_shards = {i for s in Manifest.load(self.path).shards for i in s.frames}
        return sum(i in in_shards or self.frame_path(i).exists() for i in set_plan.frames)

    def open_manifest(
        self, config: dict[str, Any], frames_per_shard: int, n: int, split: str = "all"
    ) -> Manifest:
        """The manifest to go on with; UserError if the folder was made with other options."""
        asked = {side: n for side in SIDES if split in ("all", side)}
        if not (self.path / MANIFEST).exists():
            for path in (self.path / FRAMES_DIR).glob("*.h5"):
                path.unlink()  # without a manifest, nobody knows how they were made
            fresh = Manifest(
                SCHEMA_VERSION, config["seed"], __version__, config, frames_per_shard, n,
                pairs_asked=asked, versions=versions(),
            )  # fmt: skip
            fresh.save(self.path)
            return fresh
        found = Manifest.load(self.path)
        own = {"frames_per_shard": frames_per_shard, "package_version": __version__,
               "versions": versions()}  # fmt: skip
        kept = {k: getattr(found, k) or None for k in own}  # older sets do not tell of versions
        differences = _differences({**found.config, **kept}, {**config, **own})
        if differences:
            raise UserError(
                f"{self.path}: was rendered with other options: {'; '.join(differences)}. Ask for "
                "the same, with the same versions installed, or choose another folder with --out."
            )
        before = found.pairs_asked or dict.fromkeys(SIDES, found.num_pairs_asked)
        for side, num in before.items():
            asked[side] = max(num, asked.get(side, 0))
        most = max(n, found.num_pairs_asked)
        return replace(found, num_pairs_asked=most, pairs_asked=asked)

    def clean(self, done: set[int]) -> None:
        """Removes half-written files, and frames that are already in a shard."""
        for path in (self.path / FRAMES_DIR).iterdir():
            if path.name.endswith(".tmp") or (path.stem.isdigit() and int(path.stem) in done):
                path.unlink()
        for path in self.path.glob(".*.tmp"):
            path.unlink()


def _differences(found: Any, asked: Any, key: str = "") -> list[str]:
    """What differs between two plain values, key by key."""
    if isinstance(found, dict) and isinstance(asked, dict):
        return [
            text
            for k in sorted({*found, *asked})
            for text in _differences(found.get(k), asked.get(k), f"{key}.{k}" if key else k)
        ]
    if isinstance(asked, tuple):
        asked = list(asked)
    if found == asked:
        return []
    if found is None or asked is None:
        return [f"{key}: {'not in the folder' if found is None else 'only in the folder'}"]
    return [f"{key}: the folder has {found}, you asked for {asked}"]


def check_disk(path: Path, bytes_needed: float, *, force: bool) -> None:
    """UserError if the set will not fit."""
    existing = next(p for p in (path, *path.absolute().parents) if p.exists())
    free = shutil.disk_usage(existing).free
    if bytes_needed > free and not force:
        raise UserError(
            f"{path}: the set needs about {size_text(bytes_needed)}, but only "
            f"{size_text(free)} are free. Free some space, choose another disk with "
            "--out, a smaller --n or --size, --no-flow or --compression zstd, or start anyway "
            "with --force."
        )


# --- rendering -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pool:
    """How frames are rendered."""

    render_one: RenderOne
    initializer: Callable[..., None]
    initargs: tuple[Any, ...] = ()
    workers: int = 1
    recycle: int = 50
    start_method: str = "spawn"
    """of multiprocessing; a renderer shares no memory with what started it"""


@dataclass
class Progress:
    """What happens, for whoever shows it."""

    started: Callable[[int, int], None] = lambda done, total: None
    frame_done: Callable[[FrameResult], None] = lambda result: None
    note: Callable[[str], None] = lambda text: None


@dataclass
class _State:
    """A set under work."""

    folder: SetFolder
    plan: SetPlan
    manifest: Manifest
    attributes: dict[str, Any]
    compression: str
    workers: int
    attempts: dict[int, int] = field(default_factory=dict)
    faults: dict[int, int] = field(default_factory=dict)

    def in_shards(self) -> dict[int, ShardEntry]:
        """Frames that are in a finished shard, and which."""
        return {i: s for s in self.manifest.shards for i in s.frames}

    def save(self, **changes: Any) -> None:
        """Changes the manifest, and writes it in an order that does not tell who was first."""
        self.manifest = replace(self.manifest, **changes)
        self.manifest = replace(
            self.manifest,
            shards=sorted(self.manifest.shards, key=lambda s: (s.split != "train", s.name)),
            redrawn=sorted(self.manifest.redrawn, key=lambda r: (r["frame_index"], r["attempt"])),
            failures=sorted(self.manifest.failures, key=lambda f: int(f["frame_index"])),
        )
        self.manifest.save(self.folder.path)

    def failed(self) -> set[int]:
        """Frames that could not be made."""
        return {f["frame_index"] for f in self.manifest.failures}


def render_set(
    job: Any,
    set_plan: SetPlan,
    folder: SetFolder,
    manifest: Manifest,
    pool: Pool,
    *,
    attributes: dict[str, Any],
    compression: str,
    progress: Progress | None = None,
) -> Manifest:
    """Renders what is missing and assembles all shards; the folder must be locked.

    Returns the final manifest, whose ``failures`` lists frames that could not be made. Raises
    KeyboardInterrupt or SystemExit when it is told to stop: everything finished is kept.
    """
    progress = progress or Progress()
    state = _State(folder, set_plan, manifest, attributes, compression, pool.workers)
    with _StopSignals() as stop:
        _restore(state, progress, stop)
        finished = set(state.in_shards())
        folder.clean(finished)
        finished |= {i for i in set_plan.frames if stored_content(folder.frame_path(i))}
        _assemble_complete(state, finished)
        todo = [i for i in set_plan.frames if i not in finished]
        progress.started(len(set_plan.frames) - len(todo), len(set_plan.frames))
        _render(job, todo, state, pool, finished, progress, stop)
        _assemble_complete(state, finished, partial=True)
    return state.manifest


def _restore(state: _State, progress: Progress, stop: _StopSignals) -> None:
    """Takes up what an earlier run left: forgets broken shards, tries failed frames again."""
    kept = []
    _announce_hashing(state, progress)
    for shard in state.manifest.shards:
        stop.obey()  # until all are looked at, the manifest stays as it was
        if (entry := _intact(state, shard)) is not None:
            kept.append(entry)
        else:
            path = state.folder.path / shard.name
            progress.note(f"{path} is missing or damaged: its frames are rendered again.")
            path.unlink(missing_ok=True)
    retried = state.failed() & set(state.plan.frames)
    redrawn = [r for r in state.manifest.redrawn if r["frame_index"] not in retried]
    failures = [f for f in state.manifest.failures if f["frame_index"] not in retried]
    state.attempts = {r["frame_index"]: r["attempt"] + 1 for r in redrawn}
    state.save(shards=kept, redrawn=redrawn, failures=failures)


def _intact(state: _State, shard: ShardEntry) -> ShardEntry | None:
    """The entry of a shard that is as it was written, or could be made so from its own rows.

    A run that is killed between replacing a shard and saying so leaves a longer one.
    """
    path = state.folder.path / shard.name
    if _has_its_size(state, shard) and _unchanged(state, shard):
        return shard
    try:
        with open_shard(path) as file:
            rows = {int(index): row for row, index in enumerate(file["frame_index"][:])}
        sources = [Source(path, rows[i], content)
                   for i, content in zip(shard.frames, shard.content, strict=True)]  # fmt: skip
        return _assembled(state, shard.name, shard.split, sources)
    except (UserError, KeyError):
        return None


def _announce_hashing(state: _State, progress: Progress) -> None:
    """Says so where it takes long: a copy may have made all shards later than the manifest."""
    sizes = [s.bytes for s in state.manifest.shards if _has_its_size(state, s) and _late(state, s)]
    if sizes:
        progress.note(
            f"{state.folder.path}: {len(sizes)} shards are later than the manifest, as in a copy; "
            f"comparing their {size_text(sum(sizes))} with its hashes first."
        )


def _has_its_size(state: _State, shard: ShardEntry) -> bool:
    path = state.folder.path / shard.name
    return path.exists() and path.stat().st_size == shard.bytes


def _late(state: _State, shard: ShardEntry) -> bool:
    path, manifest = state.folder.path / shard.name, state.folder.path / MANIFEST
    return path.stat().st_mtime_ns >= manifest.stat().st_mtime_ns


def _unchanged(state: _State, shard: ShardEntry) -> bool:
    """Whether a shard of the right size has its bytes, as far as its time does not tell.

    Every run writes the manifest after the shards, so a later shard was written by somebody else.
    To hash all of a large set would take minutes at each start: what changed without a new time,
    on a failing disk, is found by ``simgen validate``.
    """
    return not _late(state, shard) or file_sha256(state.folder.path / shard.name) == shard.sha256


def _render(
    job: Any,
    todo: Sequence[int],
    state: _State,
    pool: Pool,
    finished: set[int],
    progress: Progress,
    stop: _StopSignals,
) -> None:
    queue, again = list(reversed(todo)), list[int]()
    running: dict[Any, FrameTask] = {}
    processes = _processes(pool)
    try:
        while queue or again or running:
            if not processes.active:  # pebble gives up when a process dies while all are idle
                processes = _processes(pool)
            # Frames that were begun are finished before all is given up: failures come fast.
            new = queue if finished or _has_hope(state) else []
            while (again or new) and len(running) < pool.workers:
                index = (again or new).pop()
                task = FrameTask(job, index, state.attempts.get(index, 0),
                                 state.folder.frame_path(index))  # fmt: skip
                running[processes.schedule(_work, args=[pool, task])] = task
            if not running:
                break
            done = wait(running, timeout=POLL_S, return_when=FIRST_COMPLETED).done
            stop.obey()
            for future in done:
                task = running.pop(future)
                if _settle(future, task, state, progress):
                    finished.add(task.index)
                elif task.index not in state.failed():
                    again.append(task.index)
            if done:
                _assemble_complete(state, finished)
        if not finished:
            _require_hope(state)
    finally:
        processes.stop()
        processes.join()


def _failures(state: _State) -> list[dict[str, Any]]:
    """Of the frames that are asked for."""
    asked = set(state.plan.frames)
    return [f for f in state.manifest.failures if f["frame_index"] in asked]


def _failed_scenes(state: _State) -> set[int]:
    """Scenes of which a frame failed for good; frames of one scene fail together."""
    return {f["frame_index"] // state.plan.frames_per_scene for f in _failures(state)}


def _has_hope(state: _State) -> bool:
    """Whether a set without any finished frame may still come to one."""
    return len(_failed_scenes(state)) < GIVE_UP_AFTER


def _require_hope(state: _State) -> None:
    """UserError if so many scenes failed for good, in a set without any finished frame."""
    if _has_hope(state):
        return
    failures, scenes = _failures(state), _failed_scenes(state)
    reasons = dict.fromkeys(" ".join(r.split()) for f in failures for r in f["reasons"])
    raise UserError(
        f"{state.folder.path}: {len(failures)} frames of {len(scenes)} scenes failed "
        f"{MAX_ATTEMPTS} times each, and none succeeded: {'; '.join(reasons)}. "
        "Expected most to succeed, so the run stops here: mend the cause (simgen doctor tells of "
        "this machine; a recipe or map of your own may ask for what cannot be built), and run the "
        "same command again: it tries these frames anew."
    )


def _processes(pool: Pool) -> ProcessPool:
    return ProcessPool(
        max_workers=pool.workers,
        max_tasks=pool.recycle,
        initializer=_start_worker,
        context=multiprocessing.get_context(pool.start_method),
    )


def _settle(future: Any, task: FrameTask, state: _State, progress: Progress) -> bool:
    """Takes a worker's answer; True if the frame is done."""
    try:
        result: FrameResult = future.result()
    except UserError:
        raise
    except FrameRejected as rejection:
        _redraw(rejection.reasons, task, state, progress)
    except (OSError, MemoryError, BrokenProcessPool) as fault:  # ProcessExpired is an OSError
        if _is_full_disk(fault):
            raise
        _redo(fault, task, state, progress)
    except Exception as error:  # one scene that cannot be built must not end a long run
        _redraw([f"{type(error).__name__}: {error}"], task, state, progress)
    else:
        _log(state, {**asdict(result), "workers": state.workers, "host": socket.gethostname(),
                     "time": time.time()})  # fmt: skip
        progress.frame_done(result)
        return True
    return False


def _redraw(reasons: Sequence[str], task: FrameTask, state: _State, progress: Progress) -> None:
    """Counts a failed attempt; the next one is drawn from (seed, i, attempt + 1)."""
    record = _record(reasons, task, state)
    _log(state, {**record, "time": time.time()})
    if task.attempt + 1 >= MAX_ATTEMPTS:
        progress.note(f"Frame {task.index} failed {MAX_ATTEMPTS} times: {'; '.join(reasons)}")
        state.save(failures=[*state.manifest.failures, record])
    else:
        progress.note(f"Frame {task.index} is drawn again: {'; '.join(reasons)}")
        state.attempts[task.index] = task.attempt + 1
        state.save(redrawn=[*state.manifest.redrawn, record])


def _redo(fault: Exception, task: FrameTask, state: _State, progress: Progress) -> None:
    """Counts a fault of the machine, not of the draw: the same attempt is made again."""
    faults = state.faults[task.index] = state.faults.get(task.index, 0) + 1
    reason = f"worker of frame {task.index}: {type(fault).__name__}: {fault}"
    progress.note(f"{reason}; the frame is redone.")
    _log(state, {"frame_index": task.index, "fault": reason, "time": time.time()})
    if faults >= MAX_ATTEMPTS:
        reason = f"{reason}, {faults} times (out of memory?)"
        state.save(failures=[*state.manifest.failures, _record([reason], task, state)])


def _record(reasons: Sequence[str], task: FrameTask, state: _State) -> dict[str, Any]:
    return {"frame_index": task.index, "attempt": task.attempt, "reasons": list(reasons),
            "seed": state.manifest.dataset_seed}  # fmt: skip


def _log(state: _State, record: dict[str, Any]) -> None:
    """Adds a line, which begins on its own even if the last one was cut off by a kill."""
    with open(state.folder.path / LOG, "ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
        whole = file.read(1) in (b"", b"\n")
        file.write(b"\n" * (not whole) + json.dumps(record).encode() + b"\n")


def _assemble_complete(state: _State, finished: set[int], partial: bool = False) -> None:
    """Assembles every shard whose frames are all there (or, at the end, what is there)."""
    in_shards = state.in_shards()
    for shard in state.plan.shards:
        ready = [i for i in shard.frames if i in finished]
        complete = len(ready) == len(shard.frames)
        if (complete or partial) and any(i not in in_shards for i in ready):
            beyond = [i for i, s in in_shards.items() if s.name == shard.name]  # of a larger n
            sources = [_source(state, i) for i in sorted({*ready, *beyond})]
            entry = _assembled(state, shard.name, shard.split, sources)
            others = [s for s in state.manifest.shards if s.name != shard.name]
            state.save(shards=[*others, entry])
            for i in ready:
                state.folder.frame_path(i).unlink(missing_ok=True)


def _assembled(state: _State, name: str, split: str, sources: Sequence[Source]) -> ShardEntry:
    return assemble(state.folder.path / name, sources, attributes=state.attributes, split=split,
                    compression=state.compression)  # fmt: skip


def _source(state: _State, index: int) -> Source:
    """Where a finished frame is: in its shard, or waiting for one."""
    if (shard := state.in_shards().get(index)) is not None:
        row = shard.frames.index(index)
        return Source(state.folder.path / shard.name, row, shard.content[row])
    path = state.folder.frame_path(index)
    if (content := stored_content(path)) is None:
        raise UserError(f"{path}: the frame is gone. Run the same command again: it is redone.")
    return Source(path, 0, content)


# --- processes -----------------------------------------------------------------------------------


def _start_worker() -> None:
    """Ctrl-C is the parent's business; a worker dies with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _die_with_parent()


def _work(pool: Pool, task: FrameTask) -> FrameResult:
    """Renders one frame in a worker."""
    _initialize(pool.initializer, pool.initargs)
    return pool.render_one(task)


@functools.cache
def _initialize(initializer: Callable[..., None], initargs: tuple[Any, ...]) -> None:
    """Once per process, within the first task, so that what goes wrong is told to the parent."""
    try:
        initializer(*initargs)
    except Exception as error:
        raise UserError(
            f"The renderer cannot start ({type(error).__name__}: {error}). Run simgen doctor to "
            "see what this machine can render with."
        ) from error


def _die_with_parent() -> None:
    """Linux only: elsewhere an orphan finishes its frame and ends."""
    import ctypes

    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):
        pr_set_pdeathsig = 1
        libc.prctl(pr_set_pdeathsig, signal.SIGKILL)


class _StopSignals:
    """Takes Ctrl-C and SIGTERM while a set is rendered, to be obeyed between two steps.

    An exception that a handler raises can hit any line, also one that holds a lock of the pool,
    which then never ends. A second Ctrl-C is not taken.
    """

    def __init__(self) -> None:
        self.received = 0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> _StopSignals:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _take(self, number: int, frame: object) -> None:
        self.received = number
        signal.signal(number, self._previous[number])

    def obey(self) -> None:
        """Raises KeyboardInterrupt or SystemExit(143) if a signal came."""
        if self.received == signal.SIGINT:
            raise KeyboardInterrupt
        if self.received:
            raise SystemExit(128 + self.received)


# --- the disk ------------------------------------------------------------------------------------


def _is_full_disk(error: Exception) -> bool:
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def _full_disk_explained(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if not _is_full_disk(error):
            raise
        raise UserError(
            f"{folder}: the disk is full. All finished frames are kept; free some space and run "
            "the same command again."
        ) from error
