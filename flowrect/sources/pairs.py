"""What every source yields: a list of pairs that are read when they are asked for."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

from flowrect.sample import Pair
from simgen.errors import UserError

BEGINNING = 65_536
"""bytes of a file that are looked at; a calibration has less"""
Item = TypeVar("Item")


def _the_same(_: Any) -> Hashable:
    return None


def _its_own(item: Any) -> Hashable:
    return item


class Pairs(Sequence[Pair], Generic[Item]):
    """Lazy pairs: ``pairs[i]`` reads the i-th from disk. May be handed to other processes."""

    def __init__(
        self,
        items: Sequence[Item],
        read: Callable[[Item], Pair],
        *,
        layout: str,
        fingerprint: str,
        largest_turn_deg: float = 0.0,
        rig: Callable[[Item], Hashable] = _the_same,
        scene: Callable[[Item], Hashable] = _its_own,
        reverse: Callable[[Item], Item] | None = None,
    ) -> None:
        """Functions are module-level ones or partials, so that other processes know them.

        Args:
          rig: equal for pairs of the same cameras, that is of one K and image size.
          scene: equal for pairs that show the same things; such pairs are neighbours.
          reverse: the pair from right to left; None where the source has only left to right.
        """
        if not items:
            raise UserError(f"{layout}: no pairs in it.")
        self.items, self._read = list(items), read
        self._rig, self._scene, self._reverse = rig, scene, reverse
        self.layout = layout
        """what was found, and where"""
        self.fingerprint = fingerprint
        """changes when the content does"""
        self.largest_turn_deg = largest_turn_deg
        """of a camera against its nominal pose, about each axis"""

    def __len__(self) -> int:
        return len(self.items)

    @overload
    def __getitem__(self, index: int) -> Pair: ...
    @overload
    def __getitem__(self, index: slice) -> Pairs[Item]: ...
    def __getitem__(self, index: int | slice) -> Pair | Pairs[Item]:
        if not isinstance(index, slice):
            return self._read(self.items[index])
        return self._with(self.items[index], repr(range(len(self))[index]))

    def _with(self, items: Sequence[Item], what: str) -> Pairs[Item]:
        return Pairs(
            items,
            self._read,
            layout=self.layout,
            fingerprint=digest([self.fingerprint, what]),
            largest_turn_deg=self.largest_turn_deg,
            rig=self._rig,
            scene=self._scene,
            reverse=self._reverse,
        )

    def in_both_directions(self) -> Pairs[Item]:
        """Each pair, and its reverse after it where the source has one."""
        if self._reverse is None:
            return self
        both = [x for item in self.items for x in (item, self._reverse(item))]
        return self._with(both, "both directions")

    def one_of_each_rig(self) -> list[Pair]:
        """A pair of every set of cameras."""
        items = {self._rig(item): item for item in reversed(self.items)}
        return [self._read(item) for item in items.values()]

    def start_of_last(self, num: int) -> int:
        """Where the last ``num`` pairs begin, and the others of their scenes: 0 if nowhere else."""
        start = max(0, len(self) - num)
        scenes = [self._scene(item) for item in self.items[: start + 1]]
        return scenes.index(scenes[-1])

    def __str__(self) -> str:
        return f"{self.layout}: {len(self)} pairs"


def digest(parts: Sequence[str]) -> str:
    """sha256 of texts, in order."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def digest_files(paths: Sequence[Path]) -> str:
    """sha256 of names below the folder that holds all, sizes and beginnings of files.

    The same wherever the folder stands, and for a copy of it. UserError if any file is missing.
    """
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(paths)} files are missing, first {missing[0]}. Complete the "
            "set, or give the folder that the list's paths are relative to."
        )
    whole = [Path(os.path.abspath(path)) for path in paths]  # where links stand, not what they mean
    root = os.path.commonpath([path.parent for path in whole])
    return digest([f"{os.path.relpath(path, root)} {_content(path)}" for path in whole])


def _content(path: Path) -> str:
    """Tells apart what is likely to differ, without reading sets of images as a whole."""
    with path.open("rb") as file:
        return f"{path.stat().st_size} {hashlib.sha256(file.read(BEGINNING)).hexdigest()}"
