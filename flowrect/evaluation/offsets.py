"""What matches of a rectified pair say is left of it; measured once, and kept.

An offset is a function of two images and a matcher. OUT/offsets/MATCHER.jsonl holds one line for
each pair of images that were matched, known by their digest: an interrupted or repeated scoring
measures what is new alone, and images that two rows share, such as the truth's for both t, once.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from flowrect.evaluation import stamp
from flowrect.matches import Matcher
from flowrect.sample import Image


@dataclass(frozen=True)
class Offset:
    """|dy| of all matches of a rectified pair, |dx| of a vertical rig [px]; NaN without any."""

    mean_px: float
    """as the paper has it"""
    median_px: float


@dataclass(frozen=True)
class Offsets:
    """A matcher that measures what is left, and remembers it in a file."""

    path: Path
    match: Matcher
    _known: dict[str, Offset] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path.exists():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                self._remember(line)

    def of(self, left: Image, right: Image, *, vertical: bool) -> Offset:
        """Of rectified images (H, W, 3)."""
        key = _digest(left, right, vertical)
        if key not in self._known:
            self._known[key] = _measured(self.match, left, right, vertical)
            self._append({"key": key, **asdict(self._known[key])})
        return self._known[key]

    def _remember(self, line: str) -> None:
        try:
            row = json.loads(line)
            key = row.pop("key")
            self._known[key] = Offset(**row)
        except (ValueError, KeyError, TypeError):  # cut off by a crash: it is measured again
            return

    def _append(self, row: dict[str, object]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps(row))  # begins a line, whatever the last one lacks


def _digest(left: Image, right: Image, vertical: bool) -> str:
    parts = (stamp.of_matchers().encode(), bytes([vertical]), left.tobytes(), right.tobytes())
    return hashlib.sha256(b"".join(parts)).hexdigest()[:24]


def _measured(match: Matcher, left: Image, right: Image, vertical: bool) -> Offset:
    matches = match(left, right)
    across = np.abs((matches.uv_right - matches.uv_left)[:, 0 if vertical else 1])
    if not len(across):
        return Offset(float("nan"), float("nan"))
    return Offset(float(across.mean()), float(np.median(across)))
