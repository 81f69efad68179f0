from __future__ import annotations

import json
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import fakes
import h5py
import numpy as np
import pytest

from simgen import shards
from simgen.errors import UserError
from simgen.schema import FIELDS
from simgen.shards import Manifest, ShardSet, open_shard
from simgen.store import Source, assemble, write_frame

SHARDS = {"train-00000.h5": ("train", (3, 1)), "test-00000.h5": ("test", (0, 10))}


def _set(folder: Path, *, flow: bool = True, compression: str = "gzip") -> Path:
    """A set of two shards, whose rows are not in the order of their indices."""
    folder.mkdir()
    entries = []
    for name, (split, indices) in SHARDS.items():
        sources = []
        for i in indices:
            waiting = folder / f"{i}.h5"
            digest = write_frame(waiting, fakes.make_frame(0, i, flow=flow), pairs=fakes.PAIRS,
                                 compression=compression)  # fmt: skip
            sources.append(Source(waiting, 0, digest))
        entries.append(assemble(folder / name, sources, attributes={"schema_version": 1},
                                split=split, compression=compression))  # fmt: skip
        for source in sources:
            source.path.unlink()
    Manifest(1, 0, "0", fakes.FakeJob().content(), 2, 12, entries).save(folder)
    return folder


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    return _set(tmp_path_factory.mktemp("shards") / "stored")


@pytest.fixture(scope="module")
def derived(tmp_path_factory) -> Path:
    return _set(tmp_path_factory.mktemp("shards") / "derived", flow=False)


@pytest.fixture
def copy(stored, tmp_path) -> Path:
    return shutil.copytree(stored, tmp_path / "copy")


def test_frames_come_in_the_order_of_their_indices(stored):
    frames = ShardSet(stored)
    assert len(frames) == 4
    assert frames.indices == [0, 1, 3, 10]
    assert [int(frame.frame_index) for frame in frames] == [0, 1, 3, 10]
    assert int(frames[2].frame_index) == int(frames.frame(3).frame_index) == 3
    assert int(frames[-1].frame_index) == 10


@pytest.mark.parametrize(
    "split, indices", [("train", [1, 3]), ("test", [0, 10]), (None, [0, 1, 3, 10])]
)
def test_split_selects_its_side(stored, split, indices):
    assert ShardSet(stored, split=split).indices == indices


def test_every_field_reads_back_whole_and_by_camera(stored):
    frame, written = ShardSet(stored).frame(10), fakes.make_frame(0, 10)
    for name in FIELDS:
        if name not in ("spec", "flow"):
            np.testing.assert_array_equal(getattr(frame, name), written[name])
    for name in ("image", "depth", "flow", "flow_status", "K"):
        np.testing.assert_array_equal(frame.read(name, 2), written[name][2])
    assert frame.spec == written["spec"]
    assert frame.pairs == list(fakes.PAIRS)


def test_derived_flow_is_stored_flow_bit_for_bit(stored, derived):
    for frame, without in zip(ShardSet(stored), ShardSet(derived), strict=True):
        for pair in range(len(fakes.PAIRS)):
            assert frame.flow(pair).dtype == np.float32
            assert frame.flow(pair).tobytes() == without.flow(pair).tobytes()
            assert frame.reverse_flow(pair).tobytes() == without.reverse_flow(pair).tobytes()


def test_reverse_flow_is_the_flow_of_the_turned_pair(derived):
    frame = ShardSet(derived).frame(3)
    K, T = frame.K, frame.T_world_cam
    uv = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1)
    for pair, (left, right) in enumerate(frame.pairs):
        z = frame.depth[right].astype(np.float64)[..., None]
        near = z[..., 0] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            points = np.concatenate([uv, np.ones_like(z)], axis=-1) @ np.linalg.inv(K[right]).T * z
            world = points @ T[right, :3, :3].T + T[right, :3, 3]
            seen = (world - T[left, :3, 3]) @ T[left, :3, :3] @ K[left].T
            expected = seen[..., :2] / seen[..., 2:] - uv
        np.testing.assert_allclose(frame.reverse_flow(pair)[near], expected[near], atol=1e-4)


def test_nothing_is_opened_before_a_field_is_read(copy):
    frames = ShardSet(copy)
    (copy / "train-00000.h5").unlink()
    frame = frames.frame(1)
    assert frames.frame(0).image.shape == (3, 6, 8, 3)
    with pytest.raises(
        UserError, match=r"train-00000\.h5: no such file, though the manifest lists"
    ):
        _ = frame.image


def test_a_set_and_its_frames_can_be_sent_to_another_process(stored):
    frames = ShardSet(stored)
    _ = frames[0].image
    for copy in (pickle.loads(pickle.dumps(frames))[0], pickle.loads(pickle.dumps(frames[0]))):
        np.testing.assert_array_equal(copy.image, frames[0].image)
    frames.close()
    assert frames[0].image.any()


def test_a_closed_set_reads_again(stored):
    frames = ShardSet(stored)
    before = frames[1].depth
    frames.close()
    np.testing.assert_array_equal(frames[1].depth, before)


def test_a_zstd_set_reads_the_same(stored, tmp_path):
    packed = ShardSet(_set(tmp_path / "zstd", compression="zstd"))
    np.testing.assert_array_equal(packed[1].image, ShardSet(stored)[1].image)


# --- what can be wrong ---------------------------------------------------------------------------


def test_an_unknown_field_names_the_known_ones(stored):
    with pytest.raises(AttributeError, match=r"no field 'disparity'; known: image, depth, "):
        _ = ShardSet(stored)[0].disparity


def test_an_absent_frame_says_which_there_are(stored, tmp_path):
    with pytest.raises(UserError, match=r"no frame 2; it has 4 frames, 0 to 10\."):
        ShardSet(stored).frame(2)
    Manifest(1, 0, "0", fakes.FakeJob().content(), 2, 12).save(tmp_path)
    with pytest.raises(UserError, match=r"no frame 2; it has 0 frames\."):
        ShardSet(tmp_path).frame(2)


def test_an_unknown_split_is_refused(stored):
    with pytest.raises(
        UserError, match="split 'val': expected one of train, test, or None for all"
    ):
        ShardSet(stored, split="val")


@pytest.mark.parametrize("place", ("empty", "not there"))
def test_a_folder_without_a_manifest_says_what_was_expected(tmp_path, place):
    (tmp_path / "empty").mkdir()
    expected = r'no manifest\.json here\. Expected the folder of a set that "simgen render --out'
    with pytest.raises(UserError, match=expected):
        ShardSet(tmp_path / place)


def test_a_file_instead_of_a_folder_is_refused(stored):
    with pytest.raises(UserError, match=r"manifest\.json: cannot be read as JSON"):
        ShardSet(stored / "test-00000.h5")


@pytest.mark.parametrize("text, reason", [
    ("{", r"cannot be read as JSON"),
    ("[1]", r"schema None, but this version reads schema 1"),
    ('{"schema_version": 7}', r"schema 7, but this version reads schema 1\. Install the simgen"),
    ('{"schema_version": 1}', r"not a manifest of simgen \('shards'\)"),
    ('{"schema_version": 1, "shards": [{"name": "x"}]}', r"not a manifest of simgen"),
    ('{"schema_version": 1, "shards": [], "x": 1}', r"not a manifest of simgen .*'x'"),
])  # fmt: skip
def test_a_foreign_manifest_is_refused(tmp_path, text, reason):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(UserError, match=rf"manifest\.json: {reason}"):
        ShardSet(tmp_path)


@pytest.mark.parametrize("change, lacking", [
    ({}, "seed, rig, size, spp, "), ({"size": "8x6", "seed": 0}, "rig, spp, denoise"),
    ({**fakes.FakeJob().content(), "rig": {"name": "x"}}, r"rig\.pairs; expected all that simgen"),
    (None, "argument of type 'NoneType'"),
])  # fmt: skip
def test_a_manifest_without_its_config_is_refused(stored, tmp_path, change, lacking):
    replace(Manifest.load(stored), config=change).save(tmp_path)
    with pytest.raises(
        UserError, match=rf"manifest\.json: (its config lacks|not a .*) \(?{lacking}"
    ):
        Manifest.load(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[1]", "7"])
def test_a_spec_that_is_not_json_is_refused(copy, text):
    with h5py.File(copy / "train-00000.h5", "a") as file:
        file["spec"][0] = text
    frame = ShardSet(copy).frame(3)
    with pytest.raises(
        UserError,
        match=r"train-00000\.h5: 'spec' of row 0 cannot be decoded .*is damaged; "
        "move the file away and run the same render command again with the same versions installed",
    ):
        _ = frame.spec
    assert ShardSet(copy).frame(1).spec


@pytest.mark.parametrize("name", ["spec", "pairs", "image"])
def test_a_field_that_cannot_be_decoded_is_named(stored, monkeypatch, name):
    class Damaged:
        def __getitem__(self, key: object) -> None:
            raise OSError("inflate() failed")

        def asstr(self) -> Damaged:
            return self

    monkeypatch.setattr(shards.Frame, "_file", {name: Damaged()})
    with pytest.raises(UserError, match=rf"h5: '{name}' of row 1 cannot be decoded \(inflate"):
        getattr(ShardSet(stored).frame(1), name)


def test_a_manifest_reads_as_it_was_saved(stored, tmp_path):
    manifest = replace(Manifest.load(stored), failures=[{"frame_index": 3, "reasons": ["ä"]}])
    manifest.save(tmp_path)
    assert Manifest.load(tmp_path) == manifest
    assert json.loads((tmp_path / "manifest.json").read_text())["shards"][0]["frames"] == [3, 1]
    assert [p.name for p in tmp_path.iterdir()] == ["manifest.json"]


@pytest.mark.parametrize("content", (b"", b"not HDF5", None))
def test_a_truncated_or_foreign_file_is_refused(copy, content):
    shard = copy / "train-00000.h5"
    shard.write_bytes(shard.read_bytes()[:5000] if content is None else content)
    expected = r"train-00000\.h5: not a readable HDF5 file .*foreign, move the file away and"
    with pytest.raises(UserError, match=expected):
        _ = ShardSet(copy).frame(1).image


def test_an_hdf5_file_of_others_is_refused(copy):
    with h5py.File(copy / "train-00000.h5", "w") as file:
        file["frame_index"] = [1]
    with pytest.raises(UserError, match=r"an HDF5 file, but no shard of simgen"):
        _ = ShardSet(copy).frame(1).image


@pytest.mark.parametrize("version", (2, "2.0"))
def test_a_shard_of_another_schema_is_refused(copy, version):
    with h5py.File(copy / "train-00000.h5", "a") as file:
        file.attrs["schema_version"] = version
    expected = rf"train-00000\.h5: schema {version}, but this version reads schema 1\. Install"
    with pytest.raises(UserError, match=expected):
        _ = ShardSet(copy).frame(1).image


def test_a_refused_file_is_not_kept_open(copy):
    with h5py.File(copy / "train-00000.h5", "a") as file:
        file.attrs["schema_version"] = 2
    with pytest.raises(UserError):
        open_shard(copy / "train-00000.h5")
    with h5py.File(copy / "train-00000.h5", "a") as file:
        file.attrs["schema_version"] = 1
    open_shard(copy / "train-00000.h5").close()


def test_a_zstd_shard_without_hdf5plugin_says_what_to_install(tmp_path, monkeypatch):
    folder = _set(tmp_path / "zstd", compression="zstd")
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    expected = r"train-00000\.h5 is compressed with zstd, which needs .* pip install hdf5plugin"
    with pytest.raises(UserError, match=expected):
        _ = ShardSet(folder).frame(1).image


def test_an_interrupted_atomic_write_keeps_the_older_file(tmp_path, monkeypatch):
    path = tmp_path / "manifest.json"
    shards.write_atomically(path, b"old")

    def fails(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards.os, "fsync", fails)
    with pytest.raises(OSError, match="No space"):
        shards.write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["manifest.json"]
