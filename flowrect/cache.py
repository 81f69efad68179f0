"""A reduced copy of a source on disk, for sets whose images take longer to decode than to use.

Images are area-filtered once to a given size and stored as plain arrays, read by memory map; K
follows, ground truth is copied as it is. Take a size somewhat above the network's window, so that
rotations still have pixels to interpolate. A copy belongs to the content of its source (the
shards' sha256, or the files' sizes and times): another content makes another copy.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from flowrect.correspondences import Correspondences
from flowrect.resize import resized
from flowrect.sample import Pair
from flowrect.sources.pairs import Pairs, digest
from simgen.errors import UserError

VERSION = "1"  # of the files below
IMAGES, CAMERAS, WORDS = "images.npy", "cameras.npz", "words.json"
_CAMERA_FIELDS = ("K_left", "K_right", "T_right_left", "T_right_left_nominal", "turn_left",
                  "turn_right")  # fmt: skip
_WORD_FIELDS = ("name", "scene", "weather", "daylight")
_TRUTH_FIELDS = tuple(f.name for f in fields(Correspondences))


def cached(
    pairs: Pairs[Any],
    folder: str | Path,
    wh: tuple[int, int],
    *,
    workers: int = 2,
    report: Callable[[int, int], None] | None = None,
) -> Pairs[int]:
    """The same pairs at a smaller size, from a copy below ``folder`` that is made if need be.

    Args:
      wh: (width, height) [px] of the copy, for all pairs.
      workers: processes that read while the copy is made.
      report: called with the number of pairs done and of all, while the copy is made.
    """
    key = digest([pairs.fingerprint, str(wh), VERSION])[:16]
    path = Path(folder) / f"pairs-{wh[0]}x{wh[1]}-{key}"
    if not path.is_dir():
        _build(pairs, path, wh, workers, report or (lambda done, of: None))
    cameras = dict(np.load(path / CAMERAS))
    words = json.loads((path / WORDS).read_text(encoding="utf-8"))
    layout = f"{pairs.layout}, {wh[0]}x{wh[1]} in {path}"
    return Pairs(range(len(pairs)), partial(_read, path, cameras, words), layout=layout,
                 fingerprint=key, largest_turn_deg=pairs.largest_turn_deg,
                 rig=partial(_rig, cameras))  # fmt: skip


def _rig(cameras: dict[str, NDArray[Any]], i: int) -> bytes:
    """All images of a copy are of one size, so K alone tells rigs apart."""
    left, right = cameras["K_left"][i], cameras["K_right"][i]
    return bytes(left.tobytes() + right.tobytes())


def _read(path: Path, cameras: dict[str, NDArray[Any]], words: list[Any], i: int) -> Pair:
    def array(name: str) -> NDArray[Any]:
        return np.array(np.load(path / name, mmap_mode="r")[i])

    left, right = array(IMAGES)
    has_truth = (path / f"{_TRUTH_FIELDS[0]}.npy").is_file()
    truth = Correspondences(*(array(f"{n}.npy") for n in _TRUTH_FIELDS)) if has_truth else None
    known: dict[str, Any] = {"T_right_left": None} | {k: v[i] for k, v in cameras.items()}
    return Pair(
        left=left,
        right=right,
        truth=truth,
        **known,
        **dict(zip(_WORD_FIELDS, words[i], strict=True)),
    )


# --- making the copy ---------------------------------------------------------------------------


class _Reduced(Dataset[Pair]):
    """Pairs at the size of the copy."""

    def __init__(self, pairs: Pairs[Any], wh: tuple[int, int]) -> None:
        self._pairs, self._wh = pairs, wh

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Pair:
        pair = self._pairs[index]
        if self._wh[0] > pair.wh[0] or self._wh[1] > pair.wh[1]:
            raise UserError(
                f"{pair.name}: {pair.wh[0]}x{pair.wh[1]} is smaller than the copy of "
                f"{self._wh[0]}x{self._wh[1]} that is asked for; read the source itself."
            )
        return resized(pair, self._wh)


def _build(
    pairs: Pairs[Any],
    path: Path,
    wh: tuple[int, int],
    workers: int,
    report: Callable[[int, int], None],
) -> None:
    """Writes beside ``path`` and renames at the end: a copy is whole, or is not there."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.mkdir(parents=True)
    try:
        _write(temporary, _all(pairs, wh, workers), wh, len(pairs), report)
        if not path.is_dir():  # another process may have been quicker
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _all(pairs: Pairs[Any], wh: tuple[int, int], workers: int) -> Iterator[Pair]:
    return iter(DataLoader(_Reduced(pairs, wh), batch_size=None, num_workers=workers,
                           collate_fn=_as_it_is, worker_init_fn=_start_worker))  # fmt: skip


def _as_it_is(pair: Any) -> Any:
    return pair


def _start_worker(_: int) -> None:
    cv2.setNumThreads(0)


def _write(
    folder: Path,
    pairs: Iterator[Pair],
    wh: tuple[int, int],
    num: int,
    report: Callable[[int, int], None],
) -> None:
    images = open_memmap(folder / IMAGES, "w+", np.uint8, (num, 2, wh[1], wh[0], 3))
    cameras: dict[str, list[Any]] = {name: [] for name in _CAMERA_FIELDS}
    words, truth = [], _Truth(folder, num)
    for i, pair in enumerate(pairs):
        images[i] = pair.left, pair.right
        for name, values in cameras.items():
            values.append(getattr(pair, name))
        words.append([getattr(pair, name) for name in _WORD_FIELDS])
        truth.write(i, pair.truth)
        report(i + 1, num)
    images.flush()
    known = {name: np.stack(v) for name, v in cameras.items() if all(x is not None for x in v)}
    np.savez(folder / CAMERAS, allow_pickle=False, **known)
    (folder / WORDS).write_text(json.dumps(words), encoding="utf-8")


class _Truth:
    """The arrays of correspondences, one file a field; the first pair tells the shapes."""

    def __init__(self, folder: Path, num: int) -> None:
        self._folder, self._num = folder, num
        self._arrays: dict[str, NDArray[Any]] = {}

    def write(self, i: int, truth: Correspondences | None) -> None:
        if truth is None:
            return
        for name in _TRUTH_FIELDS:
            value = np.asarray(getattr(truth, name))
            if name not in self._arrays:
                self._arrays[name] = open_memmap(
                    self._folder / f"{name}.npy", "w+", value.dtype, (self._num, *value.shape)
                )
            self._arrays[name][i] = value
