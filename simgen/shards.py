"""Reading a set: the manifest, and frames that load what is asked for.

    frames = ShardSet("shards")          # a folder with manifest.json
    frame = frames[0]                    # cheap: nothing is read yet
    frame.image                          # (C, H, W, 3) uint8, read now
    frame.flow(0)                        # (H, W, 2) float32 of pair 0, stored or derived: same bits

Imports neither Mitsuba nor the generator. Files are opened on first use in each process, so a set
may be handed to the workers of a data loader.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from simgen.errors import RESTORE, UserError
from simgen.flowfield import flow_from_depth
from simgen.geometry import inverse
from simgen.schema import FIELDS, SCHEMA_VERSION

MANIFEST = "manifest.json"
ZSTD_FILTER_ID = 32015
SPLITS = ("train", "test")
CONFIG_KEYS = ("seed", "rig", "size", "spp", "denoise", "sensor", "recipes", "daylight", "weather",
               "frames_per_scene", "flow", "compression", "variant")  # fmt: skip
"""of a manifest's config, in sets of all versions"""
RIG_KEYS = ("name", "pairs")


@dataclass(frozen=True)
class ShardEntry:
    """One finished file of a set."""

    name: str
    split: str
    frames: list[int]
    """frame indices, in the order of the rows"""
    bytes: int
    sha256: str
    """of the file"""
    content: list[str]
    """sha256 of each frame's decoded arrays and spec"""


@dataclass(frozen=True)
class Manifest:
    """manifest.json: what a set holds."""

    schema_version: int
    dataset_seed: int
    package_version: str
    config: dict[str, Any]
    frames_per_shard: int
    num_pairs_asked: int
    """of whichever side of the split more was asked for"""
    shards: list[ShardEntry] = field(default_factory=list)
    redrawn: list[dict[str, Any]] = field(default_factory=list)
    """frames that failed a check and were drawn again: frame, attempt, reasons"""
    failures: list[dict[str, Any]] = field(default_factory=list)
    """frames that failed three times: frame, seed, reasons"""
    pairs_asked: dict[str, int] = field(default_factory=dict)
    """of each side of the split; empty in sets of older versions"""
    versions: dict[str, str] = field(default_factory=dict)
    """of the packages that decide pixels; empty in sets of older versions"""

    def save(self, folder: Path) -> None:
        """Writes manifest.json atomically."""
        write_atomically(folder / MANIFEST, json.dumps(asdict(self), indent=1).encode())

    @classmethod
    def load(cls, folder: Path) -> Manifest:
        """Reads a folder's manifest; UserError if there is none or it is of another schema."""
        path = Path(folder) / MANIFEST
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise UserError(
                f"{folder}: no {MANIFEST} here. Expected the folder of a set that "
                '"simgen render --out FOLDER" has written.'
            ) from error
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: cannot be read as JSON ({error}).") from error
        if not isinstance(data, dict) or data.get("schema_version") != SCHEMA_VERSION:
            found = data.get("schema_version") if isinstance(data, dict) else None
            raise UserError(
                f"{path}: schema {found}, but this version reads schema {SCHEMA_VERSION}. Install "
                "the simgen that wrote it, or render the set again."
            )
        try:
            manifest = cls(**{**data, "shards": [ShardEntry(**s) for s in data["shards"]]})
            lacking = [k for k in CONFIG_KEYS if k not in manifest.config]
            if "rig" in manifest.config:
                lacking += [f"rig.{k}" for k in RIG_KEYS if k not in manifest.config["rig"]]
        except (KeyError, TypeError) as error:
            raise UserError(f"{path}: not a manifest of simgen ({error}).") from error
        if lacking:
            raise UserError(
                f"{path}: its config lacks {', '.join(lacking)}; expected all that simgen render "
                "writes there. Put the original back, or render the set again."
            )
        return manifest


def write_atomically(path: Path, content: bytes) -> None:
    """All of the file or nothing, also when the power fails."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def open_shard(path: Path) -> h5py.File:
    """Opens a shard for reading; UserError if it is not one, or of another schema."""
    try:
        # Shards are replaced, never changed: no lock is needed, and some file systems have none.
        file = h5py.File(path, "r", locking=False)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file, though the manifest lists it.") from error
    except OSError as error:
        raise UserError(
            f"{path}: not a readable HDF5 file ({error}). If it is truncated or foreign, {RESTORE}."
        ) from error
    try:
        _require_schema(file, path)
        _require_filters(file, path)
    except UserError:
        file.close()
        raise
    return file


def _require_schema(file: h5py.File, path: Path) -> None:
    version = file.attrs.get("schema_version")
    if version is None or not {"frame_index", "image", "pairs"} <= file.keys():
        raise UserError(
            f"{path}: an HDF5 file, but no shard of simgen: no schema_version, or no images. Take "
            "it out of the folder and run the same render command again."
        )
    if version != SCHEMA_VERSION:
        raise UserError(
            f"{path}: schema {version}, but this version reads schema {SCHEMA_VERSION}. Install "
            "the simgen that wrote it, or render the set again."
        )


def _require_filters(file: h5py.File, path: Path) -> None:
    filters = file["image"].id.get_create_plist()
    ids = {filters.get_filter(i)[0] for i in range(filters.get_nfilters())}
    if ZSTD_FILTER_ID in ids:
        load_zstd(f"{path} is compressed with zstd")


def load_zstd(why: str) -> Any:
    """Registers hdf5plugin's filters; UserError if it is not installed."""
    try:
        import hdf5plugin
    except ImportError as error:
        raise UserError(
            f"{why}, which needs the package hdf5plugin: pip install hdf5plugin (or render with "
            "--compression gzip, which every HDF5 reader has)."
        ) from error
    return hdf5plugin


class Frame:
    """One rig frame; every attribute is read from the file when it is asked for.

    Per-pixel fields of one camera or pair are cheaper by :meth:`read`: ``frame.read("image", 0)``.
    """

    def __init__(self, files: _Files, path: Path, row: int) -> None:
        self._files, self._path, self._row = files, path, row

    def read(self, name: str, which: int | None = None) -> NDArray[Any]:
        """A field of the schema, whole or only one camera's (or pair's) slice of it."""
        dataset = self._file[name]
        with self._decoding(name):
            return np.asarray(dataset[self._row] if which is None else dataset[self._row, which])

    @contextmanager
    def _decoding(
        self, name: str, errors: tuple[type[Exception], ...] = (OSError,)
    ) -> Iterator[None]:
        try:
            yield
        except errors as error:
            raise UserError(
                f"{self._path}: {name!r} of row {self._row} cannot be decoded ({error}): the file "
                f"is damaged; {RESTORE}."
            ) from error

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name not in FIELDS:
            raise AttributeError(f"a frame has no field {name!r}; known: {', '.join(FIELDS)}")
        return self.read(name)

    @property
    def _file(self) -> h5py.File:
        return self._files.get(self._path)

    @property
    def spec(self) -> dict[str, Any]:
        """What was drawn, and how it was rendered."""
        dataset = self._file["spec"]
        with self._decoding("spec", (OSError, ValueError, TypeError)):
            return dict(json.loads(dataset.asstr()[self._row]))

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Camera indices (left, right)."""
        dataset = self._file["pairs"]
        with self._decoding("pairs"):
            return [(int(a), int(b)) for a, b in dataset[:]]

    def flow(self, pair: int) -> NDArray[np.float32]:
        """Left to right flow (H, W, 2) [px] on the left pixels: stored, or derived bit for bit."""
        if "flow" in self._file:
            return self.read("flow", pair)
        left, right = self.pairs[pair]
        return self._derived(left, right)

    def reverse_flow(self, pair: int) -> NDArray[np.float32]:
        """Right to left flow (H, W, 2) [px] on the right pixels, derived from the right depth."""
        left, right = self.pairs[pair]
        return self._derived(right, left)

    def _derived(self, source: int, target: int) -> NDArray[np.float32]:
        K, T = self.K, self.T_world_cam
        T_target_source = inverse(T[target]) @ T[source]
        return flow_from_depth(self.read("depth", source), K[source], K[target], T_target_source)


class _Files:
    """Open files of this process, by path."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, Path], h5py.File] = {}

    def get(self, path: Path) -> h5py.File:
        key = (os.getpid(), path)
        if key not in self._open:
            self._open[key] = open_shard(path)
        return self._open[key]

    def close(self) -> None:
        for (pid, _), file in self._open.items():
            if pid == os.getpid():
                file.close()
        self._open.clear()

    def __getstate__(self) -> dict[str, Any]:
        return {"_open": {}}


class ShardSet:
    """All frames of a folder, or of one split of it, by frame index."""

    def __init__(self, folder: str | Path, split: str | None = None) -> None:
        self.folder = Path(folder)
        self.manifest = Manifest.load(self.folder)
        if split not in (None, *SPLITS):
            raise UserError(
                f"split {split!r}: expected one of {', '.join(SPLITS)}, or None for all."
            )
        self._files = _Files()
        places = [
            (index, self.folder / shard.name, row)
            for shard in self.manifest.shards
            if split in (None, shard.split)
            for row, index in enumerate(shard.frames)
        ]
        self._places = {index: (path, row) for index, path, row in sorted(places)}

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, position: int) -> Frame:
        return self.frame(self.indices[position])

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(i) for i in self.indices)

    @property
    def indices(self) -> list[int]:
        """Frame indices, ascending."""
        return list(self._places)

    def frame(self, index: int) -> Frame:
        """A frame by its index in the set; UserError if the set does not have it."""
        if index not in self._places:
            have = f"{len(self)} frames" + (
                f", {self.indices[0]} to {self.indices[-1]}" if self else ""
            )
            raise UserError(f"{self.folder}: no frame {index}; it has {have}.")
        path, row = self._places[index]
        return Frame(self._files, path, row)

    def close(self) -> None:
        """Closes the files of this process."""
        self._files.close()
