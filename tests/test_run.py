from __future__ import annotations

import errno
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import fakes
import h5py
import pytest
from fakes import FakeJob

import simgen
from simgen import run
from simgen.errors import UserError
from simgen.run import FRAMES_DIR, LOG, Pool, Progress, SetFolder, plan, render_set, split_of
from simgen.shards import MANIFEST, Manifest, ShardSet
from simgen.store import content_sha256, write_frame

PAIRS_PER_FRAME = len(fakes.PAIRS)
CODE_PATHS = os.pathsep.join(map(str, (Path(fakes.__file__).parent, Path(run.__file__).parents[1])))


def _plan(num_frames: int, split: str = "all", per_scene: int = 1, per_shard: int = 3):
    return plan(num_frames * PAIRS_PER_FRAME, PAIRS_PER_FRAME, frames_per_scene=per_scene,
                frames_per_shard=per_shard, split=split)  # fmt: skip


def _render(
    path: Path,
    num_frames: int,
    render_one: run.RenderOne = fakes.render,
    *,
    job: FakeJob | None = None,
    workers: int = 1,
    split: str = "all",
    per_scene: int = 1,
    initializer: Any = fakes.start,
    recycle: int = 50,
    start_method: str = "forkserver",
    **hooks: Any,
) -> Manifest:
    """What ``simgen render`` does, with a fake renderer, in workers that begin in no time."""
    multiprocessing.set_forkserver_preload(["simgen.run"])
    job = job or FakeJob(marks=path.parent)
    folder = SetFolder(path)
    folder.check_is_ours()
    with folder.locked():
        manifest = folder.open_manifest(job.content(), 3, num_frames * PAIRS_PER_FRAME)
        return render_set(
            job, _plan(num_frames, split, per_scene), folder, manifest,
            Pool(render_one, initializer, (), workers, recycle, start_method),
            attributes={"schema_version": 1, "config": json.dumps(job.content())},
            compression=job.compression, progress=Progress(**hooks),
        )  # fmt: skip


def _files(path: Path) -> dict[str, bytes]:
    """All that a set consists of; the log tells of time and process, and is no part of it."""
    assert not list((path / FRAMES_DIR).iterdir()), "frames were left over"
    return {p.name: p.read_bytes() for p in [*path.glob("*.h5"), path / MANIFEST]}


def _frames(manifest: Manifest) -> list[int]:
    return sorted(i for shard in manifest.shards for i in shard.frames)


def _log(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / LOG).read_text().splitlines()]


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Path:
    """Seven frames rendered without any interruption."""
    path = tmp_path_factory.mktemp("whole") / "set"
    assert _frames(_render(path, 7)) == list(range(7))
    return path


# --- planning ------------------------------------------------------------------------------------


def test_the_full_set_has_774_test_and_6948_train_pairs():
    full = plan(7722, 3, frames_per_scene=1, frames_per_shard=16, split="all")
    count = {side: sum(len(s.frames) for s in full.shards if s.split == side)
             for side in ("train", "test")}  # fmt: skip
    assert full.num_frames == 2574
    assert count == {"train": 2316, "test": 258}
    assert (3 * count["train"], 3 * count["test"]) == (6948, 774)


@pytest.mark.parametrize("num_pairs, num_frames", [(1, 1), (3, 1), (4, 2), (9, 3), (10, 4)])
def test_pairs_are_rounded_up_to_whole_rig_frames(num_pairs, num_frames):
    found = plan(num_pairs, 3, frames_per_scene=1, frames_per_shard=16, split="all")
    assert found.frames == list(range(num_frames))


@pytest.mark.parametrize("per_scene", (1, 4))
def test_a_larger_set_begins_with_the_smaller_one(per_scene):
    small, large = (_plan(n, per_scene=per_scene).shards for n in (25, 131))
    longer = {s.name: s for s in large}
    for shard in small:
        assert longer[shard.name].split == shard.split
        assert longer[shard.name].frames[: len(shard.frames)] == shard.frames


@pytest.mark.parametrize("per_scene", (1, 4))
def test_the_sides_of_the_split_share_no_scene_and_make_up_all(per_scene):
    sides = {s: _plan(100, s, per_scene).frames for s in ("train", "test")}
    assert sorted(sides["train"] + sides["test"]) == _plan(100, per_scene=per_scene).frames
    for side, frames in sides.items():
        assert {split_of(i // per_scene) for i in frames} == {side}
    scenes = {s: {i // per_scene for i in frames} for s, frames in sides.items()}
    assert not scenes["train"] & scenes["test"]


# --- one run -------------------------------------------------------------------------------------


def test_a_set_holds_each_frame_once_and_its_content(whole):
    manifest = Manifest.load(whole)
    assert [(s.name, s.frames) for s in manifest.shards] == [
        ("train-00000.h5", [1, 2, 3]), ("train-00001.h5", [4, 5, 6]), ("test-00000.h5", [0])
    ]  # fmt: skip
    assert (manifest.redrawn, manifest.failures) == ([], [])
    for shard in manifest.shards:
        assert shard.content == [content_sha256(fakes.make_frame(0, i)) for i in shard.frames]


def test_a_complete_set_is_left_as_it_is(whole):
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in whole.glob("*.h5")}
    started = []
    _render(whole, 7, fakes.reject_always, started=lambda *counts: started.append(counts))
    assert started == [(7, 7)]
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in whole.glob("*.h5")} == before


def test_neither_the_number_of_workers_nor_the_order_matters(whole, tmp_path):
    done = []
    _render(tmp_path / "set", 7, fakes.render_first_last, workers=2, recycle=2,
            frame_done=lambda result: done.append(result.index))  # fmt: skip
    assert done.index(3) < done.index(0)
    assert _files(tmp_path / "set") == _files(whole)


def test_workers_are_replaced_after_recycle_frames(tmp_path):
    pids = []
    _render(tmp_path / "set", 4, recycle=2, frame_done=lambda result: pids.append(result.pid))
    assert pids[0] == pids[1] != pids[2] == pids[3]


def test_a_larger_n_continues_to_the_bytes_of_one_go(whole, tmp_path):
    _render(tmp_path / "set", 5)
    _render(tmp_path / "set", 7)
    assert _files(tmp_path / "set") == _files(whole)


def test_a_smaller_n_takes_nothing_away(whole):
    before = _files(whole)
    assert _frames(_render(whole, 2)) == list(range(7))
    assert _files(whole) == before


def test_the_two_sides_rendered_apart_make_the_whole_set(whole, tmp_path):
    manifest = _render(tmp_path / "set", 7, split="test")
    assert _frames(manifest) == [0]
    assert len(ShardSet(tmp_path / "set", split="test")) == 1
    _render(tmp_path / "set", 7, split="train")
    assert _files(tmp_path / "set") == _files(whole)


def test_a_set_without_flow_reads_as_one_with_it(whole, tmp_path):
    _render(tmp_path / "set", 2, job=FakeJob(flow=False))
    for frame, full in zip(ShardSet(tmp_path / "set"), ShardSet(whole), strict=False):
        assert (frame.flow(1) == full.flow(1)).all()


def test_a_line_of_the_log_that_was_cut_off_takes_no_other_with_it(tmp_path):
    _render(tmp_path / "set", 1)
    log = tmp_path / "set" / LOG
    log.write_text(log.read_text()[:-20])
    _render(tmp_path / "set", 3)
    cut, *lines = log.read_text().splitlines()
    assert cut.startswith('{"index": 0')
    assert [json.loads(line)["index"] for line in lines] == [1, 2]


def test_the_log_has_one_line_per_frame_with_its_seconds(tmp_path):
    _render(tmp_path / "set", 3)
    lines = _log(tmp_path / "set")
    assert [line["index"] for line in lines] == [0, 1, 2]
    assert all(line["seconds"] == {"fake": 0.001} and line["host"] for line in lines)


# --- interruptions -------------------------------------------------------------------------------

_SCRIPT = """
import sys
from pathlib import Path
import fakes
import test_run
if __name__ == "__main__":
    path = Path(sys.argv[1])
    test_run._render(path, int(sys.argv[3]), getattr(fakes, sys.argv[2]),
                     start_method="spawn",  # as a renderer's
                     frame_done=lambda result: print(result.index, flush=True))
"""


@contextmanager
def _running(
    path: Path, render_one: str, num_done: int, num_frames: int = 7
) -> Iterator[subprocess.Popen]:
    """A run in a process of its own that has finished ``num_done`` frames."""
    script = path.parent / "script.py"
    script.write_text(_SCRIPT)
    with subprocess.Popen(
        [sys.executable, script, path, render_one, str(num_frames)], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": CODE_PATHS},
    ) as child:  # fmt: skip
        assert child.stdout is not None
        for _ in range(num_done):
            assert child.stdout.readline(), child.stderr.read()
        yield child


def _workers_end(folder: Path) -> bool:
    pids = [int(p.name.removeprefix("worker-")) for p in folder.glob("worker-*")]
    assert pids
    for _ in range(100):
        if not any(_alive(pid) for pid in pids):
            return True
        time.sleep(0.05)
    return False


def _alive(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def test_kill_9_in_the_middle_of_a_shard_changes_nothing_in_the_end(whole, tmp_path):
    path = tmp_path / "set"
    with _running(path, "render_slowly", num_done=3) as child:
        child.kill()
    assert child.returncode == -signal.SIGKILL
    assert _workers_end(tmp_path)
    done = {p.name for p in (path / FRAMES_DIR).glob("*.h5")}
    assert {"00000001.h5", "00000002.h5"} <= done
    assert [s.name for s in Manifest.load(path).shards] == ["test-00000.h5"]
    (path / FRAMES_DIR / ".00000003.h5.1.tmp").write_bytes(b"half")
    (path / ".train-00000.h5.1.tmp").write_bytes(b"half")
    rendered = []
    _render(path, 7, frame_done=lambda result: rendered.append(result.index))
    assert rendered == [i for i in range(7) if i and f"{i:08d}.h5" not in done]
    assert _files(path) == _files(whole)
    assert not list(path.glob(".*.tmp"))


def test_kill_9_between_two_attempts_does_not_record_a_rejection_twice(tmp_path):
    _render(tmp_path / "whole", 2, fakes.reject_first_attempt)
    path = tmp_path / "set"
    with _running(path, "reject_first_attempt_slowly", num_done=1, num_frames=2) as child:
        deadline = time.monotonic() + 20
        while not Manifest.load(path).redrawn and time.monotonic() < deadline:
            time.sleep(0.01)
        child.kill()
    assert [r["frame_index"] for r in Manifest.load(path).redrawn] == [1]
    _render(path, 2, fakes.reject_first_attempt)
    assert _files(path) == _files(tmp_path / "whole")


@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 143), (signal.SIGINT, -signal.SIGINT)])
def test_a_signal_stops_at_once_and_keeps_what_is_finished(whole, tmp_path, number, status):
    path = tmp_path / "set"
    with _running(path, "render_slowly", num_done=2) as child:
        start = time.monotonic()
        child.send_signal(number)
        _, errors = child.communicate(timeout=20)
    assert time.monotonic() - start < 5
    assert child.returncode == status
    assert ("KeyboardInterrupt" in errors) == (number == signal.SIGINT)
    assert _workers_end(tmp_path)
    assert (path / FRAMES_DIR / "00000001.h5").exists()
    _render(path, 7)
    assert _files(path) == _files(whole)


def test_a_worker_that_dies_is_replaced_and_its_frame_redone(whole, tmp_path):
    notes = []
    _render(tmp_path / "set", 7, fakes.die_once, note=notes.append)
    assert len(notes) == 1
    assert notes[0].startswith("worker of frame 2: ProcessExpired: ")
    assert notes[0].endswith("; the frame is redone.")
    assert _files(tmp_path / "set") == _files(whole)


def test_a_worker_that_dies_while_idle_is_replaced(whole, tmp_path):
    def kill(result: run.FrameResult) -> None:
        if result.index == 2:
            os.kill(result.pid, signal.SIGKILL)
            time.sleep(0.5)

    _render(tmp_path / "set", 7, frame_done=kill)
    assert _files(tmp_path / "set") == _files(whole)


def test_a_frame_that_kills_every_worker_is_listed_and_the_rest_finished(whole, tmp_path):
    manifest = _render(tmp_path / "set", 7, fakes.die_always, workers=2)
    assert _frames(manifest) == [0, 1, 3, 4, 5, 6]
    (failure,) = manifest.failures
    assert (failure["frame_index"], failure["attempt"]) == (2, 0)
    assert "ProcessExpired" in failure["reasons"][0]
    assert "3 times (out of memory?)" in failure["reasons"][0]
    _render(tmp_path / "set", 7)
    assert _files(tmp_path / "set") == _files(whole)


def test_a_fault_of_the_machine_does_not_change_the_draw(whole, tmp_path):
    notes = []
    _render(tmp_path / "set", 7, fakes.fault_once, note=notes.append)
    assert notes == ["worker of frame 1: OSError: [Errno 5] Input/output error; "
                     "the frame is redone."]  # fmt: skip
    assert _files(tmp_path / "set") == _files(whole)


def test_a_renderer_that_cannot_start_ends_the_run_with_a_reason(tmp_path):
    expected = r"The renderer cannot start \(RuntimeError: no such renderer\)\. Run simgen doctor"
    with pytest.raises(UserError, match=expected):
        _render(tmp_path / "set", 2, initializer=fakes.cannot_start)


def test_a_full_disk_stops_the_run_and_keeps_what_is_finished(whole, tmp_path):
    with pytest.raises(UserError, match=r"set: the disk is full\. All finished frames are kept"):
        _render(tmp_path / "set", 7, fakes.disk_full)
    rendered = []
    _render(tmp_path / "set", 7, frame_done=lambda result: rendered.append(result.index))
    assert rendered == [2, 3, 4, 5, 6]
    assert _files(tmp_path / "set") == _files(whole)


# --- rejected frames -----------------------------------------------------------------------------


def test_a_rejected_frame_is_drawn_again_and_recorded(tmp_path):
    notes = []
    manifest = _render(tmp_path / "set", 7, fakes.reject_first_attempt, workers=2,
                       note=notes.append)  # fmt: skip
    reasons = ["depth 7 (limit 3) [camera 0]", "too dark"]
    assert manifest.redrawn == [
        {"frame_index": i, "attempt": 0, "reasons": reasons, "seed": 0} for i in (1, 4)
    ]
    assert manifest.failures == []
    assert sorted(notes)[0] == f"Frame 1 is drawn again: {'; '.join(reasons)}"
    frames = ShardSet(tmp_path / "set")
    assert [frame.spec["attempt"] for frame in frames] == [0, 1, 0, 0, 1, 0, 0]
    assert [r["frame_index"] for r in _log(tmp_path / "set") if "reasons" in r] == [1, 4]


def test_a_scene_that_cannot_be_built_is_drawn_again(tmp_path):
    manifest = _render(tmp_path / "set", 3, fakes.crash_on_first_attempt)
    assert [r["reasons"] for r in manifest.redrawn] == [["ZeroDivisionError: no road"]]
    assert _frames(manifest) == [0, 1, 2]


def test_three_rejections_are_a_failure_and_the_rest_is_finished(tmp_path):
    manifest = _render(tmp_path / "set", 7, fakes.reject_always)
    assert _frames(manifest) == [0, 2, 3, 4, 5, 6]
    assert [r["attempt"] for r in manifest.redrawn] == [0, 1]
    assert manifest.failures == [
        {"frame_index": 1, "attempt": 2, "reasons": ["attempt 2 is bad"], "seed": 0}
    ]
    assert Manifest.load(tmp_path / "set") == manifest


def test_a_run_in_which_nothing_succeeds_gives_up_and_can_be_continued(whole, tmp_path):
    path = tmp_path / "set"
    with pytest.raises(
        UserError, match="5 frames of 5 scenes failed 3 times each, and none succeeded"
    ) as error:
        _render(path, 7, fakes.crash_always)
    said = str(error.value)
    assert "succeeded: ImportError: no sky, not even 0; ImportError: no sky, not even 1. " in said
    assert "mend the cause" in said
    assert "\n" not in said
    assert [f["frame_index"] for f in Manifest.load(path).failures] == [0, 1, 2, 3, 4]
    _render(path, 7)
    assert _files(path) == _files(whole)


@pytest.mark.parametrize("num_frames, gives_up", [(11, False), (12, False), (13, True)])
def test_a_run_gives_up_after_failures_of_five_scenes(tmp_path, num_frames, gives_up):
    """Of three frames each; no matter how many of their frames fail."""
    render_all = partial(_render, tmp_path / "set", num_frames, fakes.crash_always, per_scene=3)
    if gives_up:
        with pytest.raises(UserError, match="13 frames of 5 scenes failed 3 times each"):
            render_all()
    else:
        assert len(render_all().failures) == num_frames


def test_frames_in_work_are_finished_before_a_run_gives_up(tmp_path):
    manifest = _render(tmp_path / "set", 7, fakes.succeed_last, workers=2)
    assert [f["frame_index"] for f in manifest.failures] == [1, 2, 3, 4, 5]
    assert _frames(manifest) == [0, 6]


def test_a_set_that_has_a_frame_does_not_give_up(tmp_path):
    _render(tmp_path / "set", 1)
    manifest = _render(tmp_path / "set", 7, fakes.crash_always)
    assert [f["frame_index"] for f in manifest.failures] == [1, 2, 3, 4, 5, 6]


def test_failures_are_tried_again_by_the_next_run(whole, tmp_path):
    failed = _render(tmp_path / "set", 7, fakes.reject_always)
    assert _render(tmp_path / "set", 7, fakes.reject_always) == failed
    assert _render(tmp_path / "set", 1).failures == failed.failures  # not asked for: stays listed
    _render(tmp_path / "set", 7)
    assert _files(tmp_path / "set") == _files(whole)


# --- damage between runs -------------------------------------------------------------------------


def _deleted(shard: Path) -> None:
    shard.unlink()


def _truncated(shard: Path) -> None:
    os.truncate(shard, shard.stat().st_size // 2)


def _emptied(shard: Path) -> None:
    shard.write_bytes(b"")


def _foreign(shard: Path) -> None:
    with h5py.File(shard, "w") as file:
        file["image"] = [1, 2, 3]


@pytest.mark.parametrize("damage", (_deleted, _truncated, _emptied, _foreign))
def test_frames_of_a_lost_or_damaged_shard_are_redone(whole, tmp_path, damage):
    path, notes, rendered = shutil.copytree(whole, tmp_path / "set"), [], []
    damage(path / "train-00001.h5")
    _render(path, 7, note=notes.append, frame_done=lambda result: rendered.append(result.index))
    assert rendered == [4, 5, 6]
    assert notes == [
        f"{path / 'train-00001.h5'} is missing or damaged: its frames are rendered again."
    ]
    assert _files(path) == _files(whole)


@pytest.mark.parametrize("changed, again", [(True, [4, 5, 6]), (False, [])])
def test_a_shard_that_is_later_than_the_manifest_is_held_to_its_hash(
    whole, tmp_path, changed, again
):
    path, rendered = shutil.copytree(whole, tmp_path / "set"), []
    shard = path / "train-00001.h5"
    content = bytearray(shard.read_bytes())
    with h5py.File(shard, "r") as file:
        content[file["image"].id.get_chunk_info(0).byte_offset + 20] ^= changed
    shard.write_bytes(content)
    _render(path, 7, frame_done=lambda result: rendered.append(result.index))
    assert rendered == again
    assert _files(path) == _files(whole)


def test_one_note_tells_that_the_shards_of_a_copy_are_hashed(whole, tmp_path):
    path, notes = shutil.copytree(whole, tmp_path / "set"), []
    size = sum(shard.stat().st_size for shard in path.glob("*.h5"))
    for shard in path.glob("*.h5"):
        shard.touch()
    for _ in range(2):
        _render(path, 7, note=notes.append)
    assert notes == [
        f"{path}: 3 shards are later than the manifest, as in a copy; comparing their "
        f"{run.size_text(size)} with its hashes first."
    ]


def test_ctrl_c_while_a_copy_is_hashed_is_obeyed_after_that_shard(whole, tmp_path, monkeypatch):
    path, hashed = shutil.copytree(whole, tmp_path / "set"), []
    for shard in path.glob("*.h5"):
        shard.touch()

    def interrupted(shard: Path) -> str:
        hashed.append(shard)
        os.kill(os.getpid(), signal.SIGINT)
        return "another"

    monkeypatch.setattr(run, "file_sha256", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _render(path, 7)
    assert len(hashed) == 1
    monkeypatch.undo()
    _render(path, 7)
    assert _files(path) == _files(whole)


def test_a_shard_with_something_appended_is_restored(whole, tmp_path):
    path, rendered = shutil.copytree(whole, tmp_path / "set"), []
    with open(path / "train-00000.h5", "ab") as file:
        file.write(b"garbage")
    _render(path, 7, frame_done=lambda result: rendered.append(result.index))
    assert rendered == []
    assert _files(path) == _files(whole)


@pytest.mark.parametrize("num_frames", (2, 7))
def test_a_run_killed_between_a_longer_shard_and_its_manifest_loses_nothing(
    whole, tmp_path, num_frames
):
    """What is on disk then: the longer shard, the older manifest, the new frames still waiting."""
    path, rendered = tmp_path / "set", []
    _render(path, 2)
    before = _files(path)
    (path / "train-00000.h5").write_bytes((whole / "train-00000.h5").read_bytes())
    for i in (2, 3):
        write_frame(SetFolder(path).frame_path(i), fakes.make_frame(0, i), pairs=fakes.PAIRS,
                    compression="gzip")  # fmt: skip
    _render(path, num_frames, frame_done=lambda result: rendered.append(result.index))
    if num_frames == 2:
        assert rendered == []
        assert (path / "train-00000.h5").read_bytes() == before["train-00000.h5"]
    else:
        assert rendered == [4, 5, 6]
        assert _files(path) == _files(whole)


def test_a_damaged_waiting_frame_is_redone(whole, tmp_path):
    path = tmp_path / "set"
    with SetFolder(path).locked():
        SetFolder(path).open_manifest(FakeJob().content(), 3, 3)
    SetFolder(path).frame_path(2).write_bytes(b"\x89HDF\r\n\x1a\n")
    _render(path, 7)
    assert _files(path) == _files(whole)


def test_frames_without_a_manifest_are_not_taken_over(whole, tmp_path):
    path = tmp_path / "set"
    (path / FRAMES_DIR).mkdir(parents=True)
    write_frame(SetFolder(path).frame_path(2), fakes.make_frame(99, 2), pairs=fakes.PAIRS,
                compression="gzip")  # fmt: skip
    _render(path, 7)
    assert _files(path) == _files(whole)


# --- refusals ------------------------------------------------------------------------------------


def test_a_second_run_into_the_same_folder_is_refused(tmp_path):
    folder = SetFolder(tmp_path / "set")
    expected = r"set: another simgen is rendering into this folder\. Wait for it, stop it"
    with folder.locked(), pytest.raises(UserError, match=expected):
        _render(tmp_path / "set", 1)


def test_a_file_system_without_locks_is_said(tmp_path, monkeypatch):
    def refuse(file, how):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(run.fcntl, "flock", refuse)
    expected = r"cannot be locked \(No locks available\).* Choose --out on another"
    with pytest.raises(UserError, match=expected), SetFolder(tmp_path / "set").locked():
        pytest.fail("locked")


def test_what_was_asked_of_each_side_is_kept(tmp_path):
    folder = SetFolder(tmp_path)
    folder.open_manifest(FakeJob().content(), 16, 30, "train").save(tmp_path)
    grown = folder.open_manifest(FakeJob().content(), 16, 9, "all")
    assert (grown.pairs_asked, grown.num_pairs_asked) == ({"train": 30, "test": 9}, 30)
    replace(grown, pairs_asked={}).save(tmp_path)  # as older versions left it
    grown = folder.open_manifest(FakeJob().content(), 16, 60, "train")
    assert grown.pairs_asked == {"train": 60, "test": 30}


def test_other_options_are_refused_and_listed(whole):
    before = _files(whole)
    with pytest.raises(UserError) as error:
        _render(whole, 1, job=FakeJob(seed=5, compression="zstd"))
    assert "was rendered with other options" in str(error.value)
    assert "compression: the folder has gzip, you asked for zstd; " in str(error.value)
    assert "seed: the folder has 0, you asked for 5. " in str(error.value)
    assert _files(whole) == before


def test_other_shard_sizes_and_versions_are_refused(tmp_path, monkeypatch):
    folder = SetFolder(tmp_path)
    folder.open_manifest(FakeJob().content(), 16, 9)
    with pytest.raises(UserError, match="frames_per_shard: the folder has 16, you asked for 8"):
        folder.open_manifest(FakeJob().content(), 8, 9)
    monkeypatch.setattr(run, "__version__", "99.0")
    with pytest.raises(UserError, match=f"package_version: the folder has {simgen.__version__}, "
                                        "you asked for 99.0"):  # fmt: skip
        folder.open_manifest(FakeJob().content(), 16, 9)


def test_other_versions_of_what_decides_pixels_are_refused(tmp_path, monkeypatch):
    folder = SetFolder(tmp_path)
    config = {**FakeJob().content(), "samples": {"night_spp": 4}}
    folder.open_manifest(config, 16, 9)
    assert set(Manifest.load(tmp_path).versions) == {
        "mitsuba", "drjit", "pyoidn", "roadgen", "numpy", "opencv-python-headless"
    }  # fmt: skip
    here = run.versions()
    monkeypatch.setattr(run, "versions", lambda: {**here, "mitsuba": "9.9"})
    expected = (f"versions.mitsuba: the folder has {here['mitsuba']}, you asked for 9.9. Ask for "
                "the same, with the same versions installed, or")  # fmt: skip
    with pytest.raises(UserError, match=expected):
        folder.open_manifest(config, 16, 9)


def test_a_set_of_another_rule_for_samples_or_of_none_is_refused(tmp_path):
    folder = SetFolder(tmp_path)
    config = FakeJob().content()
    fresh = folder.open_manifest({**config, "samples": {"night_spp": 4}}, 16, 9)
    with pytest.raises(UserError, match=r"samples\.night_spp: the folder has 4, you asked for 8"):
        folder.open_manifest({**config, "samples": {"night_spp": 8}}, 16, 9)
    replace(fresh, config=config, versions={}).save(tmp_path)  # as older versions left it
    with pytest.raises(UserError, match=r"options: samples: not in the folder; versions: not in"):
        folder.open_manifest(fresh.config, 16, 9)


def test_differences_are_named_key_by_key(tmp_path):
    folder = SetFolder(tmp_path)

    def content(hfov_deg: float, size: Sequence[int], **more: object) -> dict[str, object]:
        rig = {**FakeJob().content()["rig"], "hfov_deg": hfov_deg, "size": size}
        return {**FakeJob().content(), "rig": rig, **more}

    folder.open_manifest(content(90, [4, 3], old=1), 16, 9)
    folder.open_manifest(content(90, (4, 3), old=1), 16, 9)
    with pytest.raises(UserError) as error:
        folder.open_manifest(content(30, [4, 3], new=1), 16, 9)
    assert (
        "new: not in the folder; old: only in the folder; "
        "rig.hfov_deg: the folder has 90, you asked for 30." in str(error.value)
    )


def test_a_folder_with_files_of_others_is_refused_and_left_alone(tmp_path):
    for name in ("a.txt", "b.txt", "thesis.docx", "z.txt"):
        (tmp_path / name).touch()
    expected = r"holds files that simgen did not write \(a\.txt, b\.txt, thesis\.docx, …\) and no"
    with pytest.raises(UserError, match=expected):
        _render(tmp_path, 1)
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("place", ("file", "file/below", "/proc/simgen"))
def test_a_folder_that_cannot_be_written_is_refused(tmp_path, place):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write here \(.+\)\. Choose another folder"):
        _render(tmp_path / place, 1)


def test_a_folder_that_cannot_be_listed_is_refused(tmp_path, monkeypatch):
    def denied(path: Path) -> Iterator[Path]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(UserError, match=r"cannot write here \(Permission denied\)"):
        SetFolder(tmp_path).check_is_ours()


def test_a_disk_that_is_too_small_is_refused_unless_forced(tmp_path, monkeypatch):
    usage = run.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(run.shutil, "disk_usage", lambda path: usage._replace(free=2e9))
    path = tmp_path / "not" / "yet"
    run.check_disk(path, 1.9e9, force=False)
    run.check_disk(path, 3e9, force=True)
    with pytest.raises(UserError, match=r"needs about 3 GB, but only 2 GB are free.*--force"):
        run.check_disk(path, 3e9, force=False)
    assert not path.parent.exists()
