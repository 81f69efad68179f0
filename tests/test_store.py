from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import fakes
import h5py
import numpy as np
import pytest

from simgen import store
from simgen.errors import UserError
from simgen.schema import FIELDS, PER_PIXEL
from simgen.shards import ZSTD_FILTER_ID
from simgen.store import Source, assemble, content_sha256, read_frame, stored_content, write_frame

ATTRIBUTES = {"schema_version": 1, "dataset_seed": 0}
COMPRESSIONS = ("gzip", "zstd")


def _write(path: Path, index: int, compression: str = "gzip") -> Source:
    frame = fakes.make_frame(0, index)
    digest = write_frame(path, frame, pairs=fakes.PAIRS, compression=compression)
    return Source(path, 0, digest)


def _assemble(path: Path, sources: list[Source], compression: str = "gzip"):
    return assemble(path, sources, attributes=ATTRIBUTES, split="train", compression=compression)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_h5py_reads_what_write_frame_wrote(tmp_path, compression):
    frame = fakes.make_frame(0, 5)
    write_frame(tmp_path / "f.h5", frame, pairs=fakes.PAIRS, compression=compression)
    with h5py.File(tmp_path / "f.h5") as file:
        assert file["pairs"][:].tolist() == [list(p) for p in fakes.PAIRS]
        for name, field in FIELDS.items():
            if field.dtype != "json":
                assert file[name].shape == (1, *np.shape(frame[name]))
                assert file[name].dtype == np.dtype(field.dtype)
                np.testing.assert_array_equal(file[name][0], frame[name], err_msg=name)
        assert read_frame(file, 0)["spec"] == frame["spec"]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_each_camera_and_pair_is_one_shuffled_compressed_chunk(tmp_path, compression):
    _write(tmp_path / "f.h5", 0, compression)
    with h5py.File(tmp_path / "f.h5") as file:
        for name in PER_PIXEL:
            dataset = file[name]
            assert dataset.chunks == (1, 1, *dataset.shape[2:])
            assert dataset.shuffle
            filters = dataset.id.get_create_plist()
            ids = [filters.get_filter(i)[0] for i in range(filters.get_nfilters())]
            assert (h5py.h5z.FILTER_DEFLATE if compression == "gzip" else ZSTD_FILTER_ID) in ids


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_the_same_content_gives_the_same_bytes(tmp_path, compression):
    for name in ("a.h5", "b.h5"):
        _write(tmp_path / name, 7, compression)
        _assemble(tmp_path / f"shard-{name}", [Source(tmp_path / name, 0,
                  stored_content(tmp_path / name))], compression)  # fmt: skip
    assert _sha256(tmp_path / "a.h5") == _sha256(tmp_path / "b.h5")
    assert _sha256(tmp_path / "shard-a.h5") == _sha256(tmp_path / "shard-b.h5")


@pytest.mark.parametrize("compression", ["gzip", "zstd"])
def test_bytes_do_not_depend_on_what_was_written_before(tmp_path, compression):
    """A compressor that keeps its tables from call to call writes others now and then."""

    def written(index):
        path = tmp_path / "frame.h5"
        write_frame(path, fakes.make_frame(0, index), pairs=fakes.PAIRS, compression=compression)
        return path.read_bytes()

    forwards = [written(i) for i in range(25)]
    backwards = [written(i) for i in reversed(range(25))]
    assert forwards == backwards[::-1]


def test_the_content_hash_does_not_depend_on_the_compression(tmp_path):
    a, b = (_write(tmp_path / f"{c}.h5", 3, c) for c in COMPRESSIONS)
    assert a.content == b.content == content_sha256(fakes.make_frame(0, 3))


@pytest.mark.parametrize("name", FIELDS)
def test_the_content_hash_depends_on_every_field(name):
    frame = fakes.make_frame(0, 1)
    changed = dict(frame)
    if name == "spec":
        changed[name] = {**frame[name], "attempt": 1}
    else:
        array = np.array(frame[name])
        array.flat[-1] += 1
        changed[name] = array
    without = {k: v for k, v in frame.items() if k != name}
    hashes = {content_sha256(f) for f in (frame, changed, without)}
    assert len(hashes) == 3


def test_the_content_hash_does_not_depend_on_the_order_of_fields_or_keys():
    frame = fakes.make_frame(0, 1)
    turned = dict(reversed(frame.items()))
    turned["spec"] = dict(reversed(frame["spec"].items()))
    assert content_sha256(turned) == content_sha256(frame)


def test_the_content_hash_depends_on_shape_and_type():
    frame = fakes.make_frame(0, 1)
    reshaped = {**frame, "depth": frame["depth"].reshape(3, 8, 6)}
    retyped = {**frame, "semantic": frame["semantic"].view(np.int8)}
    assert len({content_sha256(f) for f in (frame, reshaped, retyped)}) == 3


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_shard_is_the_concatenation_of_its_frames(tmp_path, compression):
    indices = [4, 9, 2]
    sources = [_write(tmp_path / f"{i}.h5", i, compression) for i in indices]
    entry = _assemble(tmp_path / "train-00000.h5", sources, compression)
    with h5py.File(tmp_path / "train-00000.h5") as file:
        assert file.attrs["schema_version"] == 1
        for row, index in enumerate(indices):
            frame, read = fakes.make_frame(0, index), read_frame(file, row)
            assert list(read) == list(FIELDS)
            for name in FIELDS:
                np.testing.assert_array_equal(read[name], frame[name], err_msg=name)
    assert entry.frames == indices
    assert entry.content == [content_sha256(fakes.make_frame(0, i)) for i in indices]
    assert entry.sha256 == _sha256(tmp_path / "train-00000.h5")
    assert entry.bytes == (tmp_path / "train-00000.h5").stat().st_size
    assert not list(tmp_path.glob(".*"))


def test_a_shard_made_longer_equals_one_made_at_once(tmp_path):
    sources = [_write(tmp_path / f"{i}.h5", i) for i in range(4)]
    shard = tmp_path / "train-00000.h5"
    first = _assemble(shard, sources[1:3])
    rows = [Source(shard, row, content) for row, content in enumerate(first.content)]
    longer = _assemble(shard, [sources[0], *rows, sources[3]])
    at_once = _assemble(tmp_path / "other.h5", sources)
    assert (longer.sha256, longer.content) == (at_once.sha256, at_once.content)


def test_a_frame_without_flow_gives_a_shard_without_flow(tmp_path):
    frame = fakes.make_frame(0, 0, flow=False)
    digest = write_frame(tmp_path / "f.h5", frame, pairs=fakes.PAIRS, compression="gzip")
    _assemble(tmp_path / "train-00000.h5", [Source(tmp_path / "f.h5", 0, digest)])
    with h5py.File(tmp_path / "train-00000.h5") as file:
        assert "flow" not in file
        assert "flow_status" in file


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("name", ("depth", "K"))
def test_a_flipped_bit_in_a_frame_file_is_detected(tmp_path, name, compression):
    source = _write(tmp_path / "f.h5", 1, compression)
    with h5py.File(source.path) as file:
        dataset = file[name]
        info = dataset.id.get_chunk_info(0) if dataset.chunks else None
        offset = info.byte_offset + info.size // 2 if info else dataset.id.get_offset() + 7
    data = bytearray(source.path.read_bytes())
    data[offset] ^= 0x10
    source.path.write_bytes(data)
    with pytest.raises(UserError, match=r"f\.h5: row 0 is not as it was written .* failing disk"):
        _assemble(tmp_path / "train-00000.h5", [source])
    assert [p.name for p in tmp_path.iterdir()] == ["f.h5"]


def test_a_damaged_row_of_the_older_shard_is_detected(tmp_path):
    shard = tmp_path / "train-00000.h5"
    entry = _assemble(shard, [_write(tmp_path / "0.h5", 0)])
    with h5py.File(shard, "a") as file:
        file["T_world_cam"][0, 1, 0, 3] += 1e-9
    sources = [Source(shard, 0, entry.content[0]), _write(tmp_path / "1.h5", 1)]
    with pytest.raises(UserError, match=r"train-00000\.h5: row 0 is not as it was written"):
        _assemble(shard, sources)


@pytest.mark.parametrize("keep", (0, 100, 3000))
def test_a_truncated_frame_file_does_not_count_as_finished(tmp_path, keep):
    source = _write(tmp_path / "f.h5", 1)
    assert stored_content(source.path) == source.content
    os.truncate(source.path, keep)
    assert stored_content(source.path) is None
    assert stored_content(tmp_path / "missing.h5") is None


def test_a_failed_write_leaves_nothing(tmp_path):
    frame = {**fakes.make_frame(0, 1), "spec": {"not json": object()}}
    with pytest.raises(TypeError):
        write_frame(tmp_path / "f.h5", frame, pairs=fakes.PAIRS, compression="gzip")
    assert not list(tmp_path.iterdir())


def test_unknown_compression_is_refused_by_name(tmp_path):
    with pytest.raises(UserError, match="--compression lz4: expected gzip or zstd"):
        _write(tmp_path / "f.h5", 1, "lz4")


def test_zstd_without_hdf5plugin_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(
        UserError, match=r"--compression zstd, which needs .* pip install hdf5plugin"
    ):
        _write(tmp_path / "f.h5", 1, "zstd")


_WRITE_UNDER_A_LIMIT = """
import resource, sys
from pathlib import Path
import fakes
from simgen.store import write_frame
frame = fakes.make_frame(0, 1)
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
try:
    write_frame(Path(sys.argv[1]), frame, pairs=fakes.PAIRS, compression="gzip")
except OSError as error:
    print(error.errno)
"""


def test_a_frame_that_the_disk_cannot_hold_is_an_oserror_and_leaves_nothing(tmp_path):
    """A file size limit stands in for a full disk; HDF5's own writing would end the process."""
    child = subprocess.run(
        [sys.executable, "-c", _WRITE_UNDER_A_LIMIT, tmp_path / "f.h5"],
        capture_output=True, text=True, cwd=Path(fakes.__file__).parent,
        env={**os.environ, "PYTHONPATH": str(Path(store.__file__).parents[1])},
    )  # fmt: skip
    assert (child.returncode, child.stdout, child.stderr) == (0, "27\n", "")  # EFBIG
    assert not list(tmp_path.iterdir())


def test_a_shard_that_the_disk_cannot_hold_is_not_begun(tmp_path, monkeypatch):
    source = _write(tmp_path / "f.h5", 1)
    usage = store.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(store.shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(OSError, match="No space left on device"):
        _assemble(tmp_path / "train-00000.h5", [source])
    assert [p.name for p in tmp_path.iterdir()] == ["f.h5"]
