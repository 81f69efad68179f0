"""Depth error of a stereo matcher by range: ``python -m flowrect.evaluate_depth --data shards``.

The paper's section 5.2: every pair is rectified by each method's pose, matched, and the depth of
its left pixels compared with the truth. The poses are those that ``flowrect.evaluate`` has written
to RESULTS; a pair for which a method failed is rectified by the prior, and counted. All
rectifications of a pair share the K_new of its nominal rig, and the length of its nominal baseline,
which images do not tell. Rectified images are 512×256, as in every report.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flowrect.depth import StereoMatcher, load_stereo
from flowrect.depth.frame import depth_frame
from flowrect.depth_error import EDGES_M, DepthSamples, RangeError, measured
from flowrect.drectify import rectify
from flowrect.evaluate import wh_of
from flowrect.evaluation.delivered import Delivery, Translation, evenly, prior
from flowrect.evaluation.predictions import Prediction, predictions_of
from flowrect.evaluation.scores import TRUTH, UNRECTIFIED
from flowrect.sample import Pair
from simgen.errors import UserError
from simgen.geometry import Array

TRUTH_POINTS = 100_000
"""left pixels of a pair, evenly chosen, whose depth is compared"""


@dataclass(frozen=True)
class DepthOptions:
    """Depth error by range, of one stereo matcher on the pairs that each method rectified."""

    data: Path
    """a set of simgen, as it was given to flowrect.evaluate"""
    results: Path = Path("results")
    """folder of flowrect.evaluate: all methods in it are taken, and depth.csv is written to it"""
    translation: Translation = "nominal"
    """which of the predictions"""
    stereo: str = "sgbm"
    """the matcher: sgbm, hitnet, or onnx"""
    stereo_weights: str = ""
    """its file, where it needs one"""
    nearest_m: float = 2.0
    """nothing is nearer: it bounds the disparities that are looked for"""
    split: Literal["test", "train", "all"] = "test"
    """as it was given to flowrect.evaluate"""
    size: str = "1024x512"
    """as it was given to flowrect.evaluate"""
    limit: int = 0
    """as it was given to flowrect.evaluate"""
    pairs: int = 86
    """of those, evenly chosen"""


@dataclass
class Tally:
    """What a method's pairs gave."""

    samples: list[DepthSamples] = field(default_factory=list)
    failed: int = 0
    """pairs for which it found no pose, or one that does not rectify"""


def evaluate(options: DepthOptions) -> dict[str, Tally]:
    """Depth samples of every pair, by method."""
    delivery = Delivery(options.data, options.split, wh_of(options.size), options.limit)
    rows = {
        method: found
        for (method, translation), found in predictions_of(
            options.results, delivery.open().fingerprint
        ).items()
        if translation == options.translation and method != UNRECTIFIED
    }
    if not rows:
        raise UserError(
            f"{options.results}: no predictions of these pairs with t = {options.translation}. Run "
            "python -m flowrect.evaluate with the same --data, --size, --split and --limit first."
        )
    pairs = delivery.open(truth_points=TRUTH_POINTS)
    tallies = {name: Tally() for name in (UNRECTIFIED, *rows, TRUTH)}
    for i in track(evenly(options.pairs, len(pairs)), "pairs"):
        _add_pair(tallies, pairs[i].metric, {m: found.get(i) for m, found in rows.items()}, options)
    return tallies


def _add_pair(
    tallies: dict[str, Tally],
    pair: Pair,
    rows: Mapping[str, Prediction | None],
    options: DepthOptions,
) -> None:
    T, T_prior = pair.T_right_left, prior(pair, options.translation)
    assert T is not None, "as delivered"
    left_over = depth_by(T_prior[:3, :3], T_prior[:3, 3], pair, options)
    for name, tally in tallies.items():
        row = rows.get(name)
        if name == UNRECTIFIED:
            samples = left_over
        elif name == TRUTH:
            samples = depth_by(T[:3, :3], T[:3, 3], pair, options)
        else:
            found = _by_prediction(row, T_prior, pair, options)
            tally.failed += found is None
            samples = found or left_over
        tally.samples.append(samples)


def _by_prediction(
    row: Prediction | None, T_prior: Array, pair: Pair, options: DepthOptions
) -> DepthSamples | None:
    """None if there is no pose, or it makes no rig of the cameras."""
    if row is None or row.estimate is None:
        return None
    t = T_prior[:3, 3] if options.translation == "gt" else row.estimate.t
    try:
        return depth_by(row.estimate.R, t, pair, options)
    except UserError:  # the baseline of a wild pose is vertical, or reversed
        return None


def depth_by(R: Array, t: Array, window: Pair, options: DepthOptions) -> DepthSamples:
    """Depth samples of a pair that is rectified by a pose; only the direction of t counts."""
    nominal = window.T_right_left_nominal
    t = t * np.linalg.norm(nominal[:3, 3]) / np.linalg.norm(t)
    K_left, K_right, R_own, t_own, R_given, t_given = (
        torch.from_numpy(np.asarray(x, dtype=np.float64))[None]
        for x in (window.K_left, window.K_right, nominal[:3, :3], nominal[:3, 3], R, t)
    )
    K_new = rectify(R_own, t_own, K_left, K_right, window.wh).K_new
    rect = rectify(R_given, t_given, K_left, K_right, window.wh, K_new=K_new)
    frame = depth_frame(rect, t_given)
    largest_px = frame.largest_disparity(options.nearest_m)
    match: StereoMatcher = load_stereo(
        options.stereo, largest_px=largest_px, weights=options.stereo_weights
    )
    return measured(window, rect, frame, match)


# --- tables ------------------------------------------------------------------------------------


def by_range(tallies: dict[str, Tally]) -> dict[str, list[tuple[RangeError, RangeError]]]:
    """Errors of each method and range: of its own answers, and of pixels that all answered.

    The first alone would favour whoever answers for the easy pixels only.
    """
    joined = {name: DepthSamples.joined(tally.samples) for name, tally in tallies.items()}
    answered = np.all([np.isfinite(s.estimated_m) for s in joined.values()], axis=0)
    return {
        name: list(zip(s.by_range(), s.subset(answered).by_range(), strict=True))
        for name, s in joined.items()
    }


COLUMNS = ("method", "failed_pairs", "from_m", "to_m", "pixels", "coverage", "mae_m", "median_m",
           "bias_m", "mae_common_m", "median_common_m")  # fmt: skip


def write_csv(path: Path, tallies: dict[str, Tally]) -> None:
    """One line for each method and range."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for name, rows in by_range(tallies).items():
            for own, common in rows:
                writer.writerow([name, tallies[name].failed, own.from_m, own.to_m, own.pixels,
                                 own.coverage, own.mae_m, own.median_m, own.bias_m, common.mae_m,
                                 common.median_m])  # fmt: skip


def table(tallies: dict[str, Tally], title: str) -> Table:
    """MAE and median [m] of pixels that all answered, and each method's own coverage, by range."""
    ranges = [f"{a:.0f}-{b:.0f} m" for a, b in pairwise(EDGES_M)]
    result = Table("", *ranges, "mean MAE", title=title)
    for name, rows in by_range(tallies).items():
        cells = [f"{c.mae_m:.2f} / {c.median_m:.2f}\n{own.coverage:.0%}" for own, c in rows]
        failed = tallies[name].failed
        mean = np.nanmean([c.mae_m for _, c in rows])
        result.add_row(name + (f" ({failed} failed)" if failed else ""), *cells, f"{mean:.2f}")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(DepthOptions, args=arguments, prog="flowrect.evaluate_depth")
    try:
        tallies = evaluate(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_csv(options.results / "depth.csv", tallies)
    num = len(tallies[TRUTH].samples)
    title = (
        f"{options.stereo}, {num} pairs: MAE / median in m of pixels that all answered; own answers"
    )
    Console(width=200).print(table(tallies, title))
    return 0


if __name__ == "__main__":
    sys.exit(main())
