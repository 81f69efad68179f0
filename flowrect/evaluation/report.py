"""What the page says of an evaluation: tables, error curves, overlays of pairs (Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import torch
from matplotlib.figure import Figure

from flowrect.depth_error import rectified_images
from flowrect.drectify import rectify
from flowrect.evaluation import seconds, tables
from flowrect.evaluation.delivered import Delivered, evenly, prior
from flowrect.evaluation.drawing import (
    SOME_CHARTED,
    best_of_each,
    captioned,
    chart,
    colours,
    labels,
    one_column_a_method,
    overlay,
)
from flowrect.evaluation.scores import TRUTH, UNRECTIFIED, Rows, Score
from flowrect.sample import Image, Pair
from simgen.charts import label, legend_beside, to_svg
from simgen.geometry import Array
from simgen.page import section, table

NUM_SHOWN = 3
"""pairs that are shown as every method rectifies them"""
NOISE_PX = 0.5
"""of a match, for the Cramér–Rao bound"""


def report(
    scores: Sequence[Score],
    rows: Rows,
    pairs: Delivered,
    unavailable: dict[str, str],
    trained: Mapping[str, str],
) -> list[str]:
    """Its sections."""
    translations = list(dict.fromkeys(s.translation for s in scores))
    sections = [_lead(scores)]
    for translation in translations:
        of = [s for s in scores if s.translation == translation]
        sections.append(
            section(f"t = {translation}", _table(of, unavailable, trained) + _charts(of, pairs))
        )
    last = translations[-1]
    drawn = _overlays(rows, [s for s in scores if s.translation == last], pairs)
    sections.append(section(
        "Pairs as the methods rectify them", drawn,
        f"Left and right image laid over each other, t = {last}: what is at one height in both "
        "stands on one line. Where a method failed, the prior's rectification is shown. Chosen "
        "evenly from the set, not by hand.",
    ))  # fmt: skip
    timed = table(seconds.HEAD, seconds.rows(scores))
    sections.append(section("Seconds", f'<div class="scroll">{timed}</div>', seconds.NOTE))
    return sections


def _lead(scores: Sequence[Score]) -> str:
    pairs, scenes = len(tables.pairs_of(scores)), len({s.scene for s in scores})
    return (
        f'<p class="lead">{pairs} pairs of {scenes} scenes. A pair for which a method failed is '
        "scored with the prior, and counted; a wild pose keeps its angles. "
        "Pixels are those of 512×256 images.</p>"
    )


def _table(scores: Sequence[Score], unavailable: dict[str, str], trained: Mapping[str, str]) -> str:
    head, rows = tables.main_rows(scores, scores[0].translation, unavailable, trained)
    rows = [row[:2] if row[0] in unavailable else row for row in rows]  # a reason has room
    notes = "".join(f"<p>{escape(note)}</p>" for note in tables.offset_notes(scores))
    return f'<div class="scroll">{table(head, rows, numbers=True)}</div>{notes}'


# --- curves ------------------------------------------------------------------------------------


def _charts(scores: Sequence[Score], pairs: Delivered) -> str:
    every = {m: g for (m, _), g in tables.grouped(scores).items() if m != TRUTH}
    errors = {m: float(np.median([_geodesic(s) for s in g])) for m, g in every.items()}
    groups = {m: every[m] for m in best_of_each(errors)}
    name = scores[0].translation
    figures = {
        "share of pairs below an error": _cumulative(groups),
        "error against number of matches (hollow: failed)": _by_matches(groups, pairs),
        **{f"median error by {by}": _by_stratum(groups, by) for by in tables.STRATA},
    }
    drawn = (
        f"<figure><h3>{escape(title)}</h3>{to_svg(figure, f'{name} {title}')}</figure>"
        for title, figure in figures.items()
    )
    some = f"<p>{SOME_CHARTED.format(len(groups), len(every))}</p>"
    which = some if len(groups) < len(every) else ""
    return f'{which}<div class="charts">{"".join(drawn)}</div>'


def _geodesic(score: Score) -> float:
    return score.figures["geodesic_deg"]


def _cumulative(groups: dict[str, list[Score]]) -> Figure:
    figure, axes = chart(len(groups))
    names = labels(list(groups))
    for method, color in colours(groups).items():
        error = np.sort([_geodesic(s) for s in groups[method]])
        share = 100 * (np.arange(len(error)) + 1) / len(error)
        axes.step(error, share, where="post", color=color, label=names[method], linewidth=1.4)
    axes.set_xscale("log")
    axes.set_ylim(0, 100)
    label(axes, "geodesic error [°]", "% of pairs")
    legend_beside(axes)
    return figure


def _by_matches(groups: dict[str, list[Score]], pairs: Delivered) -> Figure:
    """Errors of methods that count their matches, and what no method can better on average.

    Failures, which have the prior's error, are hollow; those without any match stand at 1.
    """
    figure, axes = chart(len(groups))
    names = labels(list(groups))
    for method, color in colours(groups).items():
        known = [(s.num_matches, s) for s in groups[method] if s.num_matches is not None]
        for failed in (False, True):
            points = [(max(1, n), _geodesic(s)) for n, s in known if bool(s.failure) == failed]
            if points:
                axes.plot(*zip(*points, strict=True), ".", markersize=3 + 2 * failed, color=color,
                          fillstyle="none" if failed else "full", alpha=0.6,
                          label=None if failed else names[method])  # fmt: skip
    pair = pairs[0].input
    counts = np.geomspace(20, 20_000, 50)
    bound = cramer_rao_deg(counts, NOISE_PX, float(pair.K_left[1, 1]), pair.wh)
    axes.plot(counts, bound, color="#444b54", linewidth=1.2, label=f"bound, {NOISE_PX:g} px")
    axes.set_xscale("log")
    axes.set_yscale("log")
    label(axes, "matches", "geodesic error [°]")
    legend_beside(axes)
    return figure


def cramer_rao_deg(num: Array, noise_px: float, f: float, wh: tuple[int, int]) -> Array:
    """Least standard deviation [°] of the geodesic error, by number of uniform matches.

    Of an unbiased estimate with t known, f in pixels: σ_pitch = √2 σ / (f √N),
    σ_yaw = 12 √2 σ f / (W H √N), σ_roll = 2 √6 σ / (W √N), in radians.
    """
    w, h = wh
    factors = np.sqrt(2) / f, 12 * np.sqrt(2) * f / (w * h), 2 * np.sqrt(6) / w
    return np.rad2deg(noise_px * np.linalg.norm(factors) / np.sqrt(num))


def _by_stratum(groups: dict[str, list[Score]], by: str) -> Figure:
    key = tables.STRATA[by]
    strata = sorted({key(s) for g in groups.values() for s in g if key(s)}) or ["all"]
    figure, axes = chart(len(groups))
    names = labels(list(groups))
    for method, color in colours(groups).items():
        parts = [[_geodesic(s) for s in groups[method] if key(s) in (n, "")]
                 for n in strata]  # fmt: skip
        axes.plot(strata, [np.median(p) if p else np.nan for p in parts], "o", color=color,
                  markersize=5, label=names[method])  # fmt: skip
    axes.set_yscale("log")
    axes.tick_params(axis="x", labelrotation=20)
    label(axes, "", "median geodesic error [°]")
    legend_beside(axes)
    return figure


# --- overlays ----------------------------------------------------------------------------------


def _overlays(rows: Rows, scores: Sequence[Score], pairs: Delivered) -> str:
    """Some pairs as all methods rectify them, the truth last; failures by the prior."""
    cells = {}
    for i in evenly(NUM_SHOWN + 2, len(pairs))[1:-1] or range(len(pairs)):
        pair = pairs[i].metric
        for score in (s for s in scores if s.index == i):
            pose = _pose(score, rows, pair)
            left, right = (pair.left, pair.right) if pose is None else _rectified(pair, *pose)
            failed = ", which failed" if score.failure else ""
            caption = f"{pair.name}: {score.method}{failed}"
            cells[pair.name, score.method] = captioned([overlay(left, right)], caption)
    return one_column_a_method(cells, list(dict.fromkeys(s.method for s in scores)))


def _pose(score: Score, rows: Rows, pair: Pair) -> tuple[Array, Array] | None:
    """R and t that a pair is rectified by as it was scored; None: not at all."""
    if score.method == UNRECTIFIED:
        return None
    if score.method == TRUTH:
        T = pair.T_right_left
        assert T is not None, "as delivered"
        return T[:3, :3], T[:3, 3]
    T_prior = prior(pair, score.translation)
    estimate = rows[score.method, score.translation][score.index].estimate
    if score.failure or estimate is None:
        return T_prior[:3, :3], T_prior[:3, 3]
    return estimate.R, T_prior[:3, 3] if score.translation == "gt" else estimate.t


def _rectified(pair: Pair, R: Array, t: Array) -> tuple[Image, Image]:
    R_given, t_given, K_left, K_right = (
        torch.from_numpy(np.asarray(x, dtype=np.float64))[None]
        for x in (R, t, pair.K_left, pair.K_right)
    )
    return rectified_images(pair, rectify(R_given, t_given, K_left, K_right, pair.wh))
