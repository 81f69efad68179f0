"""What methods say of two images that show different scenes: they should say nothing.

    python benchmarks/shuffled_pairs.py --data test/ [--methods sift+loransac network …]

The left image of each pair, and the right one of a pair of another scene, with its intrinsics. A
method that finds no solution is right. Of those that answer, the table says how far their answers
lie from the prior: a pose 1° away looks like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from _table import markdown, write_csv
from match_probability import partners
from rich.progress import track
from scipy.spatial.transform import Rotation

from flowrect.evaluation.delivered import Delivery, prior, wh_of
from flowrect.files import make_folder
from flowrect.matchers import PARTS, joined, load_matcher
from flowrect.matches import Matches
from flowrect.methods import TABLE, FromMatches, Method, Seconds, load_method
from flowrect.sample import Pair
from flowrect.solvers import NoSolution
from simgen.errors import UserError
from simgen.geometry import Array

HEADER = ("method", "pairs", "no solution", "answers", "median turn from the prior [°]",
          "within 3° of it")  # fmt: skip
NEAR_DEG = 3.0
"""an answer so near looks plausible: priors are up to 2° off about each axis"""


@dataclass(frozen=True)
class Options:
    """Asks methods about pairs that are none."""

    data: Path
    """a set of simgen"""
    methods: tuple[str, ...] = TABLE
    size: str = "1024x512"
    pairs: int = 12
    """evenly chosen"""
    out: Path = Path("results")
    """folder for shuffled.csv and shuffled.md"""


class Mixed:
    """The left image of one pair with the right image of another; matched once by each matcher."""

    def __init__(self, left: Pair, right: Pair) -> None:
        self._given = left.left, right.right, left.K_left, right.K_right
        self._prior = prior(left, "nominal")
        self._matches: dict[str, Matches] = {}

    def turn_deg(self, method: Method) -> float | None:
        """How far the method's rotation is from the prior's; None: it finds no solution."""
        try:
            if isinstance(method, FromMatches):
                parts = PARTS.get(method.matcher, (method.matcher,))
                matches = joined([self._matched(name) for name in parts])
                found = method.of_matches(matches, Seconds(), *self._given, self._prior)
            else:
                found = method(*self._given, self._prior)
        except NoSolution:
            return None
        turn = Rotation.from_matrix(found.R @ self._prior[:3, :3].T)
        return float(np.rad2deg(turn.magnitude()))

    def _matched(self, matcher: str) -> Matches:
        if matcher not in self._matches:
            left, right, *_ = self._given
            self._matches[matcher] = load_matcher(matcher)(left, right)
        return self._matches[matcher]


def row(name: str, turns_deg: Sequence[float | None]) -> list[object]:
    """Of the turns that a method found for all pairs."""
    answers: Array = np.array([x for x in turns_deg if x is not None])
    middle: object = float(np.median(answers)) if answers.size else "–"
    failed = len(turns_deg) - answers.size
    return [name, len(turns_deg), failed, answers.size, middle, int((answers <= NEAR_DEG).sum())]


def main(options: Options) -> None:
    """Prints and writes the table."""
    make_folder(options.out)
    delivered = Delivery(options.data, "test", wh_of(options.size), options.pairs).open()
    pairs = [prepared.input for prepared in delivered]
    mixed = [Mixed(p, pairs[j]) for p, j in zip(pairs, partners([p.scene for p in pairs]),
                                                strict=True)]  # fmt: skip
    rows = []
    for name in options.methods:
        try:
            method = load_method(name)
            if isinstance(method, FromMatches):
                load_matcher(method.matcher)
        except UserError as error:
            print(f"{name} left out: {error}")
            continue
        rows.append(row(name, [x.turn_deg(method) for x in track(mixed, name)]))
        (options.out / "shuffled.md").write_text(markdown(HEADER, rows), encoding="utf-8")
        write_csv(options.out / "shuffled.csv", HEADER, rows)
    print(f"\n{markdown(HEADER, rows)}")


if __name__ == "__main__":
    main(tyro.cli(Options))
