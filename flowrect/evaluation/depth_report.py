"""What the page says of depth: error by range (Fig. 4), rectified pairs and theirs (Fig. 5)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flowrect.depth_error import EDGES_M, Comparison, MatchedPair, MeanError, RangeComparison
from flowrect.evaluation.drawing import (
    SOME_CHARTED,
    best_of_each,
    captioned,
    chart,
    colours,
    labels,
    one_column_a_method,
    overlay,
    small,
)
from flowrect.sample import Image
from simgen.charts import label, legend_beside, to_svg
from simgen.page import section, table
from simgen.paint import depth_colors

SHOWN_M = 3.0, EDGES_M[-1]
"""ends of the colours of depth"""

Comparisons = Mapping[str, Comparison]
"""by method"""
CELLS = (
    "mean / median of |error| in m of pixels that both the row and the true pose give an answer "
    "for; what the true pose leaves of the same pixels, and the share of all that the row answers; "
    "last the mean of the ranges' means, that of the true pose and what it is exceeded by, with "
    "95 % bootstrap intervals over scenes"
)


class Counts(NamedTuple):
    """How many pairs a method's figures are of."""

    pairs: int
    """that it has predicted"""
    failed: int
    """of those, rectified by the prior"""


@dataclass(frozen=True, eq=False)
class Picture:
    """A pair as one method rectified it."""

    pair: str
    method: str
    images: tuple[Image, Image]
    """left and right laid over each other; depth of the left one"""

    @staticmethod
    def of(matched: MatchedPair, pair: str, method: str) -> Picture:
        """Small enough for a page."""
        depth_m = matched.frame.rectified_depth(matched.disparity).astype(np.float32)
        drawn = small(depth_colors(depth_m, SHOWN_M))
        return Picture(pair, method, (overlay(matched.left, matched.right), drawn))


def depth_report(
    stereo: str,
    title: str,
    comparisons: Comparisons,
    counts: Mapping[str, Counts],
    pictures: Sequence[Picture],
    lacking: Mapping[str, str],
) -> list[str]:
    """Its sections; ``lacking`` says why other stereo matchers could not run."""
    errors = {m: found.mean.mae_m for m, found in comparisons.items()}
    charted = {m: comparisons[m].ranges for m in best_of_each(errors)}
    charts = {
        "mean absolute error": _by_range(
            {m: [x.common.mae_m for x in found] for m, found in charted.items()},
            "mean |error| [m]",
            log=True,
        ),
        "share of pixels answered": _by_range(
            {m: [100 * x.own.coverage for x in found] for m, found in charted.items()},
            "% of pixels",
        ),
    }
    drawn = (
        f"<figure><h3>{escape(name)}</h3>{to_svg(figure, name)}</figure>"
        for name, figure in charts.items()
    )
    num = len(comparisons)
    which = [SOME_CHARTED.format(len(charted), num)] * (len(charted) < num)
    absent = [f"Left out: {why}" for why in lacking.values()]
    shown = (
        "Left and right image laid over each other: what is at one height in both stands on one "
        f"line. Below, depth: red {SHOWN_M[0]:g} m, blue {SHOWN_M[1]:g} m, grey no answer. Chosen "
        "evenly from the set, not by hand."
    )
    return [
        section(f"Depth by {title}", f'<div class="charts">{"".join(drawn)}</div>',
                " ".join(["Error by range of true depth.", *which, *absent])),
        section(f"Depth by {stereo} in numbers", _table(comparisons, counts),
                f"{CELLS}.".capitalize()),
        section(f"Pairs, and their depth by {stereo}", _pictures(pictures), shown),
    ]  # fmt: skip


def _by_range(values: Mapping[str, Sequence[float]], unit: str, *, log: bool = False) -> Figure:
    """Values of each method over the ranges of true depth."""
    figure, axes = chart(len(values))
    legend = labels(list(values))
    names = [f"{a:g}–{b:g}" for a, b in pairwise(EDGES_M)]
    for method, color in colours(values).items():
        axes.plot(names, values[method], "o-", markersize=3, linewidth=1.2, color=color,
                  label=legend[method])  # fmt: skip
    if log:
        axes.set_yscale("log")
    label(axes, "true depth [m]", unit)
    legend_beside(axes)
    return figure


def _table(comparisons: Comparisons, counts: Mapping[str, Counts]) -> str:
    head = ["method", *(f"{a:g}–{b:g} m" for a, b in pairwise(EDGES_M)), "mean of means"]
    rows = depth_rows(comparisons, counts)
    return f'<div class="scroll">{table(head, rows, numbers=True)}</div>'


def depth_rows(comparisons: Comparisons, counts: Mapping[str, Counts]) -> Iterator[list[str]]:
    """Cells of some lines each, see ``CELLS``: by range, and of the mean of all."""
    most = max(c.pairs for c in counts.values())
    for method, (ranges, mean) in comparisons.items():
        yield [method + _mark(counts[method], most), *map(_cell, ranges), _mean_cell(mean)]


def _cell(x: RangeComparison) -> str:
    if not x.common.answered:
        return f"–\n{x.own.coverage:.0%}" if x.own.pixels else "–"
    other = f"truth {x.by_truth.mae_m:.2f} / {x.by_truth.median_m:.2f}\n"
    other *= x.by_truth != x.common
    return f"{x.common.mae_m:.2f} / {x.common.median_m:.2f}\n{other}{x.own.coverage:.0%}"


def _mean_cell(mean: MeanError) -> str:
    if not np.isfinite(mean.mae_m):
        return "–"
    own = f"{mean.mae_m:.2f}{_interval(mean.interval_m, '.2f')}"
    if mean.mae_m == mean.truth_mae_m:
        return own
    excess = mean.mae_m - mean.truth_mae_m
    more = f"{excess:+.2f}{_interval(mean.excess_interval_m, '+.2f')}"
    return f"{own}\ntruth {mean.truth_mae_m:.2f}\n{more}"


def _interval(ends: tuple[float, float], digits: str) -> str:
    low, high = ends
    return "" if np.isnan(low) else f" [{low:{digits}}, {high:{digits}}]"


def _mark(counts: Counts, of: int) -> str:
    """What a name is followed by: pairs that it lacks, and those that failed."""
    marks = [f"{counts.pairs} of {of} pairs"] * (counts.pairs < of)
    marks += [f"{counts.failed} failed"] * (counts.failed > 0)
    return f" ({', '.join(marks)})" if marks else ""


def _pictures(pictures: Sequence[Picture]) -> str:
    cells = {(p.pair, p.method): captioned(p.images, f"{p.pair}: {p.method}") for p in pictures}
    return one_column_a_method(cells, list(dict.fromkeys(p.method for p in pictures)))
