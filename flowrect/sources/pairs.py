"""What every source yields: a list of pairs that are read when they are asked for."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, TypeVar, overload

from flowrect.sample import Pair
from simgen.errors import UserError

Item = TypeVar("Item")


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
    ) -> None:
        if not items:
            raise UserError(f"{layout}: no pairs in it.")
        self.items, self._read = list(items), read
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
        part = digest([self.fingerprint, repr(range(len(self))[index])])
        return Pairs(self.items[index], self._read, layout=self.layout, fingerprint=part,
                     largest_turn_deg=self.largest_turn_deg)  # fmt: skip

    def __str__(self) -> str:
        return f"{self.layout}: {len(self)} pairs"


def digest(parts: Sequence[str]) -> str:
    """sha256 of texts, in order."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def digest_files(paths: Sequence[Path]) -> str:
    """sha256 of the names, sizes and times of files; UserError if any is missing."""
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(paths)} files are missing, first {missing[0]}. Complete the "
            "set, or give the folder that the list's paths are relative to."
        )
    stats = [(path, path.stat()) for path in paths]
    return digest([f"{path} {stat.st_size} {stat.st_mtime_ns}" for path, stat in stats])
