"""Exported files: all of a frame's, or none and no folder."""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_set import HW, PAIRS, make_frame, write_set

from simgen import export
from simgen.errors import UserError
from simgen.shards import Manifest, ShardSet

FILES = sorted(
    [f"camera-{c}.{kind}" for c in range(3) for kind in ("exr", "png")]
    + [f"pair-{a}-{b}.{kind}" for a, b in PAIRS for kind in ("exr", "yaml")]
    + ["frame.json"]
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set"), [make_frame(1)])


@pytest.fixture(autouse=True)
def black(monkeypatch: pytest.MonkeyPatch) -> None:
    """Radiance without a renderer."""
    monkeypatch.setattr(export, "_render_again", lambda job, frame: [np.zeros((*HW, 3), "f4")] * 3)


def test_all_files_of_a_frame_and_nothing_else_are_written(folder, tmp_path):
    paths = export.export_frame(folder, 1, tmp_path / "new" / "out")
    assert [path.name for path in paths] == FILES
    assert sorted((tmp_path / "new" / "out").iterdir()) == paths
    frame = ShardSet(folder)[0]
    image = cv2.imread(str(tmp_path / "new" / "out" / "camera-2.png"))[..., ::-1]
    np.testing.assert_array_equal(image, frame.image[2])
    assert json.loads(paths[FILES.index("frame.json")].read_text())["spec"] == frame.spec


def test_files_of_others_stay_and_older_ones_are_replaced(folder, tmp_path):
    for name in ("holiday.jpg", "frame.json"):
        (tmp_path / name).write_text("old")
    export.export_frame(folder, 1, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*FILES, "holiday.jpg"])
    assert (tmp_path / "holiday.jpg").read_text() == "old"
    assert (tmp_path / "frame.json").stat().st_size > 1000


def _raises(error: Exception) -> Callable[..., None]:
    def broken(*_: object) -> None:
        raise error

    return broken


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("owner, name, broken, reason", [
    (export, "_write_exr", _raises(RuntimeError("Failed to write pixel data")), "Failed to write"),
    (export, "_write_png", _raises(FULL), "No space left"),
    (export, "write_nominal_rig", _raises(FULL), "No space left"),
    (cv2, "imencode", _raises(cv2.error("no encoder")), "no encoder"),
    (cv2, "imencode", lambda *_: (False, None), r"OpenCV cannot encode camera-0\.png"),
])  # fmt: skip
def test_a_disk_that_is_full_on_the_way_leaves_nothing(
    folder, tmp_path, monkeypatch, owner, name, broken, reason
):
    monkeypatch.setattr(owner, name, broken)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "frame.json").write_text("old")
    for to in (tmp_path / "new" / "out", tmp_path / "there"):
        with pytest.raises(
            UserError, match=rf"--to {to}: cannot be written to \({reason}.*Nothing"
        ):
            export.export_frame(folder, 1, to)
    assert [p.name for p in tmp_path.iterdir()] == ["there"]
    assert [p.read_text() for p in (tmp_path / "there").iterdir()] == ["old"]


def _replacing_breaks(monkeypatch: pytest.MonkeyPatch, broken: Callable[[Path], bool]) -> None:
    replace = Path.replace

    def replaced(path: Path, target: Path) -> Path:
        if broken(path):
            raise FULL
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", replaced)


@pytest.mark.parametrize("place", [".export-", "there"])
def test_a_replacement_that_fails_midway_is_taken_back(folder, tmp_path, monkeypatch, place):
    """Of the new file, or of the older one."""
    to = tmp_path / "there"
    to.mkdir()
    older = {name: f"old {name}" for name in (FILES[0], "pair-0-1.exr", FILES[-1], "holiday.jpg")}
    for name, text in older.items():
        (to / name).write_text(text)
    _replacing_breaks(
        monkeypatch, lambda p: p.name == "pair-0-1.exr" and p.parent.name.startswith(place)
    )
    with pytest.raises(UserError, match=r"cannot be written to \(No space.* Nothing was exported"):
        export.export_frame(folder, 1, to)
    assert {p.name: p.read_text() for p in to.iterdir()} == older


def test_older_files_that_cannot_be_put_back_are_kept_and_named(folder, tmp_path, monkeypatch):
    (tmp_path / FILES[0]).write_text("old")
    _replacing_breaks(
        monkeypatch, lambda p: p.name == FILES[1] or p.parent.name.startswith(".replaced-")
    )
    expected = r"files could neither be replaced nor put back \(No space left.* are in (.*): move"
    with pytest.raises(UserError, match=expected) as error:
        export.export_frame(folder, 1, tmp_path)
    aside = re.search(expected, str(error.value))
    assert aside is not None
    assert (Path(aside[1]) / FILES[0]).read_text() == "old"


def test_a_folder_in_the_way_of_a_file_is_named_before_anything_is_written(folder, tmp_path):
    (tmp_path / "pair-0-1.exr").mkdir()
    with pytest.raises(UserError, match=r"\(pair-0-1\.exr is a folder there\)"):
        export.export_frame(folder, 1, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["pair-0-1.exr"]


def test_a_file_in_the_way_of_the_folder_is_refused(folder, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"--to .*out: cannot be written to \(Not a directory\)"):
        export.export_frame(folder, 1, tmp_path / "file" / "out")


def test_a_frame_that_cannot_be_rendered_again_leaves_no_folder(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "_render_again", _raises(UserError("is drawn otherwise")))
    with pytest.raises(UserError, match="is drawn otherwise"):
        export.export_frame(folder, 1, tmp_path / "new" / "out")
    assert not list(tmp_path.iterdir())


def test_a_set_from_before_maps_is_exported(folder, tmp_path):
    manifest = Manifest.load(folder)
    older = {k: v for k, v in manifest.config.items() if k != "opendrive"}
    copy = tmp_path / "older"
    copy.mkdir()
    for shard in manifest.shards:
        (copy / shard.name).symlink_to(folder / shard.name)
    replace(manifest, config=older).save(copy)
    assert len(export.export_frame(copy, 1, tmp_path / "out")) == len(FILES)
