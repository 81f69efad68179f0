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
from flowrect.depth_error import EDGES_M, DepthSamples, MatchedPair, matched
from flowrect.drectify import rectify
from flowrect.evaluate import wh_of
from flowrect.evaluation.delivered import Delivery, Translation, evenly, prior
from flowrect.evaluation.depth_report import Picture, Ranges, depth_rows, write_depth_report
from flowrect.evaluation.predictions import Prediction, predictions_of
from flowrect.evaluation.scores import TRUTH, UNRECTIFIED
from flowrect.sample import Pair
from simgen.errors import UserError
from simgen.geometry import Array

TRUTH_POINTS = 100_000
"""left pixels of a pair, evenly chosen, whose depth is compared"""
NUM_SHOWN = 3
"""pairs whose depth is shown as every method rectifies them"""


@dataclass(frozen=True)
class DepthOptions:
    """Depth error by range, of one stereo matcher on the pairs that each method rectified."""

    data: Path
    """a set of simgen, as it was given to flowrect.evaluate"""
    results: Path = Path("results")
    """folder of flowrect.evaluate: all methods in it are taken, and depth.csv and depth.html
    are written to it"""
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
    pictures: list[Picture] = field(default_factory=list)
    """of some pairs"""
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
    chosen = evenly(options.pairs, len(pairs))
    shown = {chosen[k] for k in evenly(NUM_SHOWN, len(chosen))}
    for i in track(chosen, "pairs"):
        pair = pairs[i].metric
        found = _matched_by_all(tallies, pair, {m: r.get(i) for m, r in rows.items()}, options)
        for name, rectified in found.items():
            tallies[name].samples.append(rectified.samples(pair))
            if i in shown:
                tallies[name].pictures.append(Picture.of(rectified, pair.name, name))
    return tallies


def _matched_by_all(
    tallies: dict[str, Tally],
    pair: Pair,
    rows: Mapping[str, Prediction | None],
    options: DepthOptions,
) -> dict[str, MatchedPair]:
    """The pair as each method rectifies it; failures are counted."""
    T, T_prior = pair.T_right_left, prior(pair, options.translation)
    assert T is not None, "as delivered"
    left_over = matched_by(T_prior[:3, :3], T_prior[:3, 3], pair, options)
    found = {UNRECTIFIED: left_over}
    for name, row in rows.items():
        own = _by_prediction(row, T_prior, pair, options)
        tallies[name].failed += own is None
        found[name] = own or left_over
    found[TRUTH] = matched_by(T[:3, :3], T[:3, 3], pair, options)
    return found


def _by_prediction(
    row: Prediction | None, T_prior: Array, pair: Pair, options: DepthOptions
) -> MatchedPair | None:
    """None if there is no pose, or it makes no rig of the cameras."""
    if row is None or row.estimate is None:
        return None
    t = T_prior[:3, 3] if options.translation == "gt" else row.estimate.t
    try:
        return matched_by(row.estimate.R, t, pair, options)
    except UserError:  # the baseline of a wild pose is vertical, or reversed
        return None


def matched_by(R: Array, t: Array, window: Pair, options: DepthOptions) -> MatchedPair:
    """The pair, rectified by a pose and matched; only the direction of t counts."""
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
    return matched(window, rect, frame, match)


# --- tables ------------------------------------------------------------------------------------


def by_range(tallies: dict[str, Tally]) -> Ranges:
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


def write_csv(path: Path, ranges: Ranges, failed: Mapping[str, int]) -> None:
    """One line for each method and range."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for name, rows in ranges.items():
            for own, common in rows:
                writer.writerow([name, failed[name], own.from_m, own.to_m, own.pixels,
                                 own.coverage, own.mae_m, own.median_m, own.bias_m, common.mae_m,
                                 common.median_m])  # fmt: skip


def table(ranges: Ranges, failed: Mapping[str, int], title: str) -> Table:
    """MAE and median [m] of pixels that all answered, and each method's own coverage, by range."""
    columns = [f"{a:.0f}-{b:.0f} m" for a, b in pairwise(EDGES_M)]
    result = Table("", *columns, "mean MAE", title=title)
    for row in depth_rows(ranges, failed):
        result.add_row(*row)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(DepthOptions, args=arguments, prog="flowrect.evaluate_depth")
    try:
        tallies = evaluate(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    ranges = by_range(tallies)
    failed = {name: tally.failed for name, tally in tallies.items()}
    write_csv(options.results / "depth.csv", ranges, failed)
    num = len(tallies[TRUTH].samples)
    title = f"{options.stereo}, {num} pairs, t = {options.translation}"
    pictures = [tally.pictures[k] for k in range(len(tallies[TRUTH].pictures))
                for tally in tallies.values()]  # fmt: skip
    report = options.results / "depth.html"
    write_depth_report(report, title, ranges, failed, pictures)
    title += ": MAE / median in m of pixels that all answered; own answers"
    Console(width=200).print(table(ranges, failed, title))
    print(f"{report}: the same as curves, with pictures")
    return 0


if __name__ == "__main__":
    sys.exit(main())
