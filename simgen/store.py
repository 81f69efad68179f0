"""Writing: finished frames as small files of their own, and shards assembled from them.

A frame that was rendered is at once a file under ``.frames/``, written to a temporary name and
renamed, so that nothing which ends the process can cost more than the frame in work. When all
frames of a shard are there, their compressed chunks are copied into it unchanged.

A frame file has the layout of a shard with one frame. Nothing in a file depends on time, so the
same content gives the same bytes.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from simgen.errors import UserError
from simgen.schema import FIELDS, PER_PIXEL
from simgen.shards import ShardEntry, load_zstd, write_atomically

GZIP_LEVELS = {"u": 2, "f": 1}
"""Of zlib-ng, for integers and floats: level 2 makes images a fifth smaller, but depth and flow
only a tenth, and would take half as long again. ISA-L took an eighth of the time, but what it
wrote depended on what it had compressed before."""
_NUM_PROBES, _PROBE = 16, 1 << 12
"""stretches of so many bytes, spread over a plane, tell whether it can be compressed at all"""
ZSTD_LEVEL = 3

Arrays = Mapping[str, Any]


@dataclass(frozen=True)
class Source:
    """A finished frame in a file."""

    path: Path
    row: int
    content: str
    """sha256 that it was written with"""


def content_sha256(frame: Arrays) -> str:
    """Hash of a frame's arrays and spec, in the order of the schema."""
    digest = hashlib.sha256()
    for name in FIELDS:
        if name in frame:
            value = frame[name]
            if name == "spec":
                digest.update(_canonical_json(value).encode())
            else:
                array = np.ascontiguousarray(value)
                digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
                digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _canonical_json(spec: Mapping[str, Any]) -> str:
    return json.dumps(spec, sort_keys=True, separators=(",", ":"))


def write_frame(
    path: Path, frame: Arrays, *, pairs: Sequence[tuple[int, int]], compression: str
) -> str:
    """Writes one finished frame atomically; returns its content hash.

    The file is built in memory: where the disk is full, HDF5 itself ends the process.
    """
    _check_layout(frame, len(pairs))
    layout = _layout(frame)
    with (
        ThreadPoolExecutor(max_workers=1) as pool,
        h5py.File(path, "w", driver="core", backing_store=False, libver="v110") as file,
    ):
        content = pool.submit(content_sha256, frame)
        _create_datasets(file, layout, 1, pairs, compression)
        for name in layout:
            value = frame[name]
            if name in PER_PIXEL:
                _write_images(file[name], np.asarray(value), compression)
            else:
                file[name][0] = _canonical_json(value) if name == "spec" else value
        file.attrs["content_sha256"] = content.result()
        file.flush()
        image = file.id.get_file_image()
    write_atomically(path, image)
    return content.result()


def _check_layout(frame: Arrays, num_pairs: int) -> None:
    cameras, height, width = np.shape(frame["image"])[:3]
    sizes = {"C": cameras, "P": num_pairs, "H": height, "W": width}
    for name, field in FIELDS.items():
        if field.dtype == "json" or (name == "flow" and name not in frame):
            continue
        if name not in frame:
            raise ValueError(f"write_frame: the frame has no {name!r}")
        found, shape = np.asarray(frame[name]), field.resolved(sizes)
        if (found.shape, found.dtype) != (shape, field.dtype):
            raise ValueError(
                f"write_frame: {name!r} is {found.dtype} {found.shape}, the schema wants "
                f"{field.dtype} {shape}"
            )


def _layout(frame: Arrays) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and type of each field that a frame has, in the order of the schema."""
    return {
        name: ((), "json") if f.dtype == "json" else (np.asarray(frame[name]).shape, f.dtype)
        for name, f in FIELDS.items()
        if name in frame
    }


def _create_datasets(
    file: h5py.File,
    layout: Mapping[str, tuple[tuple[int, ...], str]],
    num_frames: int,
    pairs: Any,
    compression: str,
) -> None:
    file.create_dataset("pairs", data=np.asarray(pairs, dtype=np.uint8))
    for name, (shape, dtype) in layout.items():
        if dtype == "json":
            file.create_dataset(name, (num_frames,), dtype=h5py.string_dtype("utf-8"))
        elif name in PER_PIXEL:
            file.create_dataset(name, (num_frames, *shape), dtype, chunks=(1, 1, *shape[1:]),
                                **_filters(compression, dtype))  # fmt: skip
        else:
            file.create_dataset(name, (num_frames, *shape), dtype)


def _filters(compression: str, dtype: str) -> dict[str, Any]:
    if compression == "gzip":
        level = GZIP_LEVELS[np.dtype(dtype).kind]
        return {"shuffle": True, "compression": "gzip", "compression_opts": level}
    if compression == "zstd":
        plugin = load_zstd("--compression zstd")
        return {"shuffle": True, **plugin.Zstd(clevel=ZSTD_LEVEL)}
    raise UserError(f"--compression {compression}: expected gzip or zstd.")


def _write_images(dataset: h5py.Dataset, images: NDArray[Any], compression: str) -> None:
    """One chunk per camera or pair; gzip chunks are made here, in threads."""
    if compression != "gzip":
        dataset[0] = images
        return
    with ThreadPoolExecutor() as pool:
        for k, chunk in enumerate(pool.map(_deflated, images)):
            offset = (0, k) + (0,) * (images.ndim - 1)
            dataset.id.write_direct_chunk(offset, chunk)


def _deflated(image: NDArray[Any]) -> bytes:
    """HDF5's shuffle filter (byte planes) and deflate, as one zlib stream (RFC 1950).

    The low bytes of floats are as good as random: deflating those of flow took most of the time and
    made them larger. Such planes are stored.
    """
    planes = np.ascontiguousarray(image).reshape(-1).view(np.uint8).reshape(-1, image.itemsize)
    level = GZIP_LEVELS[image.dtype.kind]
    stream = [b"\x78\x01"]
    checksum = zlib_ng.adler32(b"")
    for plane in np.ascontiguousarray(planes.T):
        deflate = zlib_ng.compressobj(level if _shrinks(plane) else 0, wbits=-zlib_ng.MAX_WBITS)
        stream += [deflate.compress(plane.data), deflate.flush(zlib_ng.Z_FULL_FLUSH)]
        checksum = zlib_ng.adler32(plane.data, checksum)
    last = zlib_ng.compressobj(0, wbits=-zlib_ng.MAX_WBITS).flush(zlib_ng.Z_FINISH)
    return b"".join([*stream, last, checksum.to_bytes(4, "big")])


def _shrinks(plane: NDArray[np.uint8]) -> bool:
    starts = np.linspace(0, max(0, len(plane) - _PROBE), _NUM_PROBES).astype(int)
    probe = b"".join(plane[i : i + _PROBE].tobytes() for i in starts)
    return len(zlib_ng.compress(probe, 1)) < 0.99 * len(probe)


def _publish(temporary: Path, path: Path) -> None:
    with open(temporary, "rb") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)


# --- shards --------------------------------------------------------------------------------------


def assemble(
    path: Path,
    sources: Sequence[Source],
    *,
    attributes: Mapping[str, Any],
    split: str,
    compression: str,
) -> ShardEntry:
    """Builds a shard from finished frames, verifies it, and puts it in place of an older one.

    Raises UserError if a source does not decode to the content that it was written with, and
    OSError (ENOSPC) if the disk has no room for the shard.
    """
    _require_room(path.parent, sum(p.stat().st_size for p in {s.path for s in sources}))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with h5py.File(temporary, "w", libver="v110") as file:
            _copy_frames(file, sources, compression)
            for name, value in attributes.items():
                file.attrs[name] = value
        with h5py.File(temporary, "r") as file:
            frames = [int(i) for i in file["frame_index"][:]]
            for row, source in enumerate(sources):
                _require_content(file, row, source)
        entry = ShardEntry(path.name, split, frames, temporary.stat().st_size,
                           file_sha256(temporary), [s.content for s in sources])  # fmt: skip
        _publish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return entry


def _require_room(folder: Path, num_bytes: int) -> None:
    """OSError before anything is written: HDF5 would end the process in the middle of it."""
    if shutil.disk_usage(folder).free < num_bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def _copy_frames(file: h5py.File, sources: Sequence[Source], compression: str) -> None:
    for row, source in enumerate(sources):
        with _explained(source), h5py.File(source.path, "r") as data:
            if row == 0:
                layout = {n: (data[n].shape[1:], FIELDS[n].dtype) for n in FIELDS if n in data}
                _create_datasets(file, layout, len(sources), data["pairs"][:], compression)
            for name in layout:
                if name in PER_PIXEL:
                    _copy_chunks(data[name], source.row, file[name], row)
                else:
                    file[name][row] = data[name][source.row]


def _copy_chunks(source: h5py.Dataset, source_row: int, target: h5py.Dataset, row: int) -> None:
    zeros = (0,) * (source.ndim - 2)
    for k in range(source.shape[1]):
        skipped_filters, chunk = source.id.read_direct_chunk((source_row, k, *zeros))
        target.id.write_direct_chunk((row, k, *zeros), chunk, skipped_filters)


def read_frame(file: h5py.File, row: int) -> dict[str, Any]:
    """All fields of one frame, decoded."""
    return {
        name: json.loads(file[name].asstr()[row]) if f.dtype == "json" else file[name][row]
        for name, f in FIELDS.items()
        if name in file
    }


def _require_content(file: h5py.File, row: int, source: Source) -> None:
    with _explained(source):
        found = content_sha256(read_frame(file, row))
        if found != source.content:
            raise ValueError(f"sha256 {found[:12]}…, expected {source.content[:12]}…")


@contextmanager
def _explained(source: Source) -> Iterator[None]:
    """Turns what a damaged file may cause into a UserError."""
    try:
        yield
    except (OSError, KeyError, ValueError) as error:
        raise UserError(
            f"{source.path}: row {source.row} is not as it was written ({error}): a failing disk? "
            "Delete the file and run the same command again: it makes the missing frames anew."
        ) from error


def stored_content(path: Path) -> str | None:
    """The content hash that a frame file carries; None if it is not there, or not whole."""
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs["content_sha256"])
    except (OSError, KeyError):
        return None


def file_sha256(path: Path) -> str:
    """Hash of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
