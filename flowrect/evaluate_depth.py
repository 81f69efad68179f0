"""Depth error of a stereo matcher by range: ``python -m flowrect.evaluate_depth --data shards``.

The paper's section 5.2: every pair is rectified by each method's pose, matched, and the depth of
its left pixels compared with the truth. The poses are those that ``flowrect.evaluate`` has written
to RESULTS; a pair for which a method failed is rectified by the prior, and counted, and so is one
whose pose lays the baseline upright, reverses it, or leaves the images nothing in common; one that
was not predicted is in none of the method's figures. The row *prior* is rectified by the prior
alone, whose t is the true one with t = gt. All rectifications of a pair share the K_new of its
nominal rig, and the length of its nominal baseline, which images do not tell. Rectified images are
512×256, as in every report. What a matcher said of two images is kept in RESULTS/disparity, so that
the same command goes on after an interruption. Each stereo matcher and t have a table,
depth.STEREO.T.csv and .md, and their part of RESULTS/report.html.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from flowrect.correspondences import collate
from flowrect.depth import STEREO, StereoMatcher, load_stereo
from flowrect.depth.frame import DepthFrame, depth_frame
from flowrect.depth_error import (
    EDGES_M,
    DepthSamples,
    MatchedPair,
    comparable,
    compared,
    matched,
)
from flowrect.drectify import Rectification, rectify
from flowrect.evaluation import one_page, stamp
from flowrect.evaluation.delivered import Delivery, Translation, evenly, prior, wh_of
from flowrect.evaluation.depth_report import (
    CELLS,
    Comparisons,
    Counts,
    Picture,
    depth_report,
    depth_rows,
)
from flowrect.evaluation.kept_disparity import KeptDisparity
from flowrect.evaluation.predictions import Prediction, file_name, predictions_of
from flowrect.evaluation.scores import TRUTH, UNRECTIFIED
from flowrect.evaluation.tables import markdown
from flowrect.memory import keep_freed_memory
from flowrect.metrics import exact_vertical_flow
from flowrect.sample import Pair
from simgen.errors import UserError
from simgen.geometry import Array

TRUTH_POINTS = 100_000
"""left pixels of a pair, evenly chosen, whose depth is compared"""
SIGN_PX = 1.0
"""far points of a dark pair may well have a disparity of a little less than 0"""
PRIOR = "prior"
"""the row of pairs that are rectified by the prior alone; unrectified ones have no depth"""
NUM_SHOWN = 3
"""pairs whose depth is shown as every method rectifies them"""


@dataclass(frozen=True)
class EvaluateDepthOptions:
    """Depth error by range, of stereo matchers on the pairs that each method rectified."""

    data: Path
    """a set of simgen, as it was given to flowrect.evaluate"""
    results: Path = Path("results")
    """folder of flowrect.evaluate: all methods in it are taken, and tables and the page are written
    to it"""
    translation: Translation = "nominal"
    """which of the predictions"""
    stereo: tuple[str, ...] = ("sgbm", "hitnet", "onnx")
    """the matchers: sgbm, hitnet, hitnet=FILE of flowrect.train_depth, onnx or onnx=FILE for DLNR
    and others that were exported to ONNX. Those that lack weights are left out, and say so"""
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


Stereo = Callable[[DepthFrame], StereoMatcher]
"""a stereo matcher that is told what frame the rectified pair lives in"""


@dataclass
class Tally:
    """What a method's pairs gave."""

    samples: dict[int, DepthSamples] = field(default_factory=dict)
    """by pair, of those that it has predicted"""
    scenes: dict[int, str] = field(default_factory=dict)
    """by pair, what it is of"""
    pictures: dict[int, Picture] = field(default_factory=dict)
    """of some pairs"""
    failed: int = 0
    """pairs for which it found no pose, or one that does not rectify"""

    @property
    def counts(self) -> Counts:
        """For the tables."""
        return Counts(len(self.samples), self.failed)


def available(names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """The stereo matchers that can run here, and why others cannot; UserError if none can."""
    lacking = {}
    for name in names:
        kind, _, weights = name.partition("=")
        try:
            load_stereo(kind, largest_px=0, weights=weights)
        except UserError as error:
            if kind not in STEREO or weights:
                raise
            lacking[name] = str(error)
    if len(lacking) == len(names):
        raise UserError(" ".join(lacking.values()))
    return [name for name in names if name not in lacking], lacking


def _require_sensible(options: EvaluateDepthOptions) -> None:
    for name, value, least in (("--pairs", options.pairs, 1), ("--limit", options.limit, 0)):
        if value < least:
            raise UserError(f"{name} {value}: expected at least {least}.")
    if not options.stereo:
        raise UserError(f"--stereo: expected some of {', '.join(STEREO)}.")
    if not options.nearest_m > 0:
        raise UserError(f"--nearest-m {options.nearest_m:g}: expected more than 0.")


def evaluate(options: EvaluateDepthOptions, stereo: str) -> dict[str, Tally]:
    """Depth samples of every pair, by method."""
    delivery = _delivery(options)
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
    tallies = {name: Tally() for name in (PRIOR, *rows, TRUTH)}
    matcher = _stereo(options, stereo)
    chosen = evenly(options.pairs, len(pairs))
    shown = {chosen[k] for k in evenly(NUM_SHOWN, len(chosen))}
    for i in track(chosen, escape(f"pairs, {stereo}")):
        pair = pairs[i].metric
        truth = comparable(pair)
        predicted = {method: of[i] for method, of in rows.items() if i in of}
        found = _matched_by_all(tallies, pair, predicted, options.translation, matcher)
        _require_sign(found[TRUTH], pair, stereo)
        for name, rectified in found.items():
            tallies[name].samples[i] = rectified.samples(truth)
            tallies[name].scenes[i] = pair.scene
            if i in shown:
                tallies[name].pictures[i] = Picture.of(rectified, pair.name, name)
    return tallies


def _delivery(options: EvaluateDepthOptions) -> Delivery:
    return Delivery(options.data, options.split, wh_of(options.size), options.limit)


def _matched_by_all(
    tallies: dict[str, Tally],
    pair: Pair,
    predicted: Mapping[str, Prediction],
    translation: Translation,
    stereo: Stereo,
) -> dict[str, MatchedPair]:
    """The pair as each method rectifies it; failures are counted."""
    T, T_prior = pair.T_right_left, prior(pair, translation)
    assert T is not None, "as delivered"

    def match(rect: Rectification, frame: DepthFrame) -> MatchedPair:
        return matched(pair, rect, frame, stereo(frame))

    left_over = match(*rectified_by(T_prior[:3, :3], T_prior[:3, 3], pair))
    found = {PRIOR: left_over}
    for name, row in predicted.items():
        own = _by_prediction(row, T_prior, pair, translation)
        tallies[name].failed += own is None
        found[name] = match(*own) if own else left_over
    found[TRUTH] = match(*rectified_by(T[:3, :3], T[:3, 3], pair))
    return found


def _require_sign(truly_rectified: MatchedPair, pair: Pair, stereo: str) -> None:
    """Raises if a matcher counts disparity the other way; a wrong pose may well turn its sign."""
    known = truly_rectified.disparity[np.isfinite(truly_rectified.disparity)]
    if known.size and np.median(known) < -SIGN_PX:
        raise UserError(
            f"{stereo}: {pair.name} is rectified by its true pose, and most of its disparities are "
            f"negative (median {np.median(known):.1f} px), expected u_left − u_right ≥ 0. Networks "
            "that give the x of the flow are to be exported with the sign changed."
        )


def _by_prediction(
    row: Prediction, T_prior: Array, pair: Pair, translation: Translation
) -> tuple[Rectification, DepthFrame] | None:
    """None if there is no pose, or nobody could match the images that it rectifies."""
    if row.estimate is None:
        return None
    t = T_prior[:3, 3] if translation == "gt" else row.estimate.t
    try:
        rect, frame = rectified_by(row.estimate.R, t, pair)
    except UserError:  # the baseline of a wild pose is vertical, or reversed
        return None
    meet = pair.truth is None or not exact_vertical_flow(rect, collate([pair.truth])).isnan()
    return (rect, frame) if meet else None


def rectified_by(R: Array, t: Array, window: Pair) -> tuple[Rectification, DepthFrame]:
    """How a pose rectifies the pair; only the direction of t counts.

    UserError if the baseline is vertical, or reversed.
    """
    nominal = window.T_right_left_nominal
    t = t * np.linalg.norm(nominal[:3, 3]) / np.linalg.norm(t)
    K_left, K_right, R_own, t_own, R_given, t_given = (
        torch.from_numpy(np.asarray(x, dtype=np.float64))[None]
        for x in (window.K_left, window.K_right, nominal[:3, :3], nominal[:3, 3], R, t)
    )
    K_new = rectify(R_own, t_own, K_left, K_right, window.wh).K_new
    rect = rectify(R_given, t_given, K_left, K_right, window.wh, K_new=K_new)
    return rect, depth_frame(rect, t_given)


def _stereo(options: EvaluateDepthOptions, name: str) -> Stereo:
    """That of a name or NAME=FILE; what it says is kept among the results."""
    kind, _, weights = name.partition("=")
    made_by, folder = stamp.of_stereo(kind, weights), options.results / "disparity"

    def of(frame: DepthFrame) -> StereoMatcher:
        largest_px = frame.largest_disparity(options.nearest_m)
        match = load_stereo(kind, largest_px=largest_px, weights=weights)
        return KeptDisparity(match, f"{made_by} {largest_px}", folder / file_name(name))

    return of


# --- tables ------------------------------------------------------------------------------------


def comparisons(tallies: dict[str, Tally]) -> Comparisons:
    """Errors of each method; no method's depend on which others there are."""
    truth = tallies[TRUTH].samples
    return {
        name: compared(
            list(tally.samples.values()),
            [truth[i] for i in tally.samples],
            [tally.scenes[i] for i in tally.samples],
        )
        for name, tally in tallies.items()
    }


COLUMNS = ("method", "pairs", "failed_pairs", "from_m", "to_m", "pixels", "coverage", "mae_m",
           "median_m", "bias_m", "common_pixels", "common_mae_m", "common_median_m",
           "truth_mae_m", "truth_median_m", "all_mae_m", "all_low_m", "all_high_m",
           "all_truth_mae_m", "all_excess_low_m", "all_excess_high_m")  # fmt: skip


def write_csv(path: Path, found: Comparisons, counts: Mapping[str, Counts]) -> None:
    """One line for each method and range; what is of all ranges stands in each."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for name, (ranges, mean) in found.items():
            of_all = (mean.mae_m, *mean.interval_m, mean.truth_mae_m, *mean.excess_interval_m)
            for own, common, truth in ranges:
                writer.writerow([name, *counts[name], own.from_m, own.to_m, own.pixels,
                                 own.coverage, own.mae_m, own.median_m, own.bias_m,
                                 common.pixels, common.mae_m, common.median_m,
                                 truth.mae_m, truth.median_m, *of_all])  # fmt: skip


HEAD = ("", *(f"{a:.0f}-{b:.0f} m" for a, b in pairwise(EDGES_M)), "mean MAE")


def table(found: Comparisons, counts: Mapping[str, Counts], title: str) -> Table:
    """Cells of ``depth_rows``."""
    result = Table(*HEAD, title=escape(title))
    for row in depth_rows(found, counts):
        result.add_row(*map(escape, row))
    return result


def write_markdown(
    path: Path,
    found: Comparisons,
    counts: Mapping[str, Counts],
    title: str,
    lacking: Mapping[str, str],
) -> None:
    """The same as ``table``, and why other stereo matchers could not run."""
    rows = ([cell.replace("\n", ", ") for cell in row] for row in depth_rows(found, counts))
    absent = "".join(f"\nLeft out: {why}\n" for why in lacking.values())
    path.write_text(f"## Depth by {title}\n\n{markdown(HEAD, rows)}{absent}", encoding="utf-8")


def _write(options: EvaluateDepthOptions, stereo: str, lacking: Mapping[str, str]) -> None:
    """Measures by one stereo matcher, and writes and shows it."""
    tallies = evaluate(options, stereo)
    found, counts = comparisons(tallies), {name: tally.counts for name, tally in tallies.items()}
    name = f"depth.{file_name(stereo)}.{options.translation}"
    write_csv(options.results / f"{name}.csv", found, counts)
    title = f"{stereo}, {counts[TRUTH].pairs} pairs, t = {options.translation}"
    pictures = [t.pictures[i] for i in tallies[TRUTH].pictures for t in tallies.values()
                if i in t.pictures]  # fmt: skip
    sections = depth_report(stereo, title, found, counts, pictures, lacking)
    own = {PRIOR, TRUTH}
    sources = one_page.Sources.of(_delivery(options).open().fingerprint, tallies.keys() - own)
    path = one_page.put(options.results, name, sections, sources)
    title += f": {CELLS}"
    write_markdown(options.results / f"{name}.md", found, counts, title, lacking)
    Console(width=200).print(table(found, counts, title))
    print(f"{path}: the same as curves, with pictures")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something, 130 after Ctrl-C."""
    options = tyro.cli(EvaluateDepthOptions, args=arguments, prog="flowrect.evaluate_depth")
    keep_freed_memory()
    try:
        _require_sensible(options)
        lacking, stopped = _write_all(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted: the same command goes on from {options.results}.")
        return 130
    for why in lacking.values():
        print(f"left out: {why}")
    for why in stopped:
        print(f"error: {why}", file=sys.stderr)
    return 2 if stopped else 0


def _write_all(options: EvaluateDepthOptions) -> tuple[dict[str, str], list[str]]:
    """Why some stereo matchers could not run, and what stopped others."""
    names, lacking = available(options.stereo)
    stopped = []
    for name in names:
        try:
            _write(options, name, lacking)
        except UserError as error:
            if len(names) == 1:
                raise
            stopped.append(str(error))
    return lacking, stopped


if __name__ == "__main__":
    sys.exit(main())
