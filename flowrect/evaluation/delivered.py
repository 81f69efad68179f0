"""The pairs as every method gets them: one size, one prior, the same for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, resized, sized
from flowrect.sample import Pair, Prepared
from flowrect.sources import Pairs, open_source
from flowrect.sources.pairs import digest
from flowrect.turn import draw_turn, largest_keep, turned
from simgen.errors import UserError
from simgen.geometry import Array

Translation = Literal["gt", "nominal"]


@dataclass(frozen=True)
class Delivery:
    """Which pairs, and how they are handed over."""

    data: Path
    split: Literal["test", "train", "all"] = "test"
    wh: tuple[int, int] = (1024, 512)
    """of the images that methods get"""
    limit: int = 0
    """pairs at most, evenly chosen; 0: all"""
    turn_deg: float = 0.0
    """turns both cameras of every pair by homography, each component of the rotation vector drawn
    within ± this: for real pairs, which are rectified to start with"""
    seed: int = 0
    """of those turns"""
    root: Path | None = None
    """folder that the paths of a list are relative to"""

    def open(self, truth_points: int | None = 0) -> Delivered:
        """The pairs; ``truth_points`` as open_source has it, which methods need none of."""
        rendered = (self.data / "manifest.json").is_file()
        split = self.split if rendered and self.split != "all" else None
        pairs = open_source(self.data, split=split, root=self.root, truth_points=truth_points,
                            trusted=self.turn_deg > 0)  # fmt: skip
        return Delivered(self, pairs, evenly(self.limit or len(pairs), len(pairs)))


def evenly(num: int, of: int) -> list[int]:
    """At most ``num`` of the indices below ``of``, evenly spread from the first to the last."""
    chosen: list[int] = np.linspace(0, of - 1, min(num, of)).round().astype(int).tolist()
    return chosen


def wh_of(size: str) -> tuple[int, int]:
    """(1024, 512) of "1024x512"."""
    try:
        w, h = (int(x) for x in size.split("x"))
    except ValueError as error:
        raise UserError(f"--size {size}: expected WIDTHxHEIGHT, such as 1024x512.") from error
    return w, h


class Delivered(Sequence[Prepared]):
    """Pairs at the delivered size and at ``METRIC_WH``, read when they are asked for."""

    def __init__(self, how: Delivery, pairs: Pairs[object], chosen: list[int]) -> None:
        self.how, self.pairs, self.chosen = how, pairs, chosen

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, i):  # type: ignore[no-untyped-def]
        pair = self.pairs[self.chosen[i]]
        prepared = self._turned(pair, i) if self.how.turn_deg else self._as_it_is(pair)
        if prepared.input.T_right_left is None:
            raise UserError(
                f"{pair.name}: its true pose is not known; expected rendered pairs, or rectified "
                "ones with --turn-deg, which turns their cameras by known angles."
            )
        if np.array_equal(prepared.input.T_right_left, prepared.input.T_right_left_nominal):
            raise UserError(
                f"{pair.name}: its true pose is the one that methods are told, so that whoever "
                "does nothing is right. Take --turn-deg, which turns the cameras by known angles."
            )
        return prepared

    @property
    def fingerprint(self) -> str:
        """Changes when any pair would, but not with where they stand."""
        how = replace(self.how, data=Path(), root=None, limit=0)
        return digest([self.pairs.fingerprint, str(how), str(self.chosen)])[:16]

    def _as_it_is(self, pair: Pair) -> Prepared:
        sizing = Sizing(self.how.wh)
        self._require_room(sizing, pair)
        return sized(pair, sizing)

    def _turned(self, pair: Pair, i: int) -> Prepared:
        sizing = Sizing(self.how.wh)
        limit_deg = self.how.turn_deg + self.pairs.largest_turn_deg
        sizing = replace(sizing, keep=largest_keep(pair, sizing, limit_deg))
        self._require_room(sizing, pair)
        rng = np.random.default_rng([self.how.seed, i])
        left, right = (draw_turn(self.how.turn_deg, rng=rng) for _ in range(2))
        sharp = turned(pair, left, right, sizing.box(pair.wh), self.how.wh)
        return Prepared(sharp, resized(sharp, METRIC_WH))

    def _require_room(self, sizing: Sizing, pair: Pair) -> None:
        box, (w, h) = sizing.box(pair.wh), self.how.wh
        if box.width < w:
            raise UserError(
                f"{pair.name}: the window of its {pair.wh[0]}x{pair.wh[1]} is "
                f"{box.width}x{box.height}, less than {w}x{h}; ask for a smaller --size."
            )


def prior(pair: Pair, translation: Translation) -> Array:
    """T_right_left (4, 4) that a method starts from: nominal, or with the true t."""
    T = pair.T_right_left_nominal.copy()
    if translation == "gt" and pair.T_right_left is not None:
        T[:3, 3] = pair.T_right_left[:3, 3]
    return T
