"""Depth error of a stereo matcher by range: ``python -m flowrect.evaluate_depth --data shards``.

The paper's section 5.2: every pair is rectified by each method's pose, matched, and the depth of
its left pixels compared with the truth. All rectifications of a pair share the K_new of its nominal
rig, and the length of its nominal baseline, which images do not tell. Rectified images are 512×256,
as in every report; methods see the native ones.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flowrect.depth import StereoMatcher, load_stereo
from flowrect.depth.frame import depth_frame
from flowrect.depth_error import EDGES_M, DepthSamples, measured, shown_truth
from flowrect.drectify import rectify
from flowrect.methods import load_method
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, sized
from flowrect.sample import Pair
from flowrect.solvers.solution import NoSolution
from flowrect.sources import open_source
from simgen.errors import UserError
from simgen.geometry import Array

TRUTH = "truth"


@dataclass(frozen=True)
class Options:
    """Depth error by range, of one stereo matcher on the pairs that each method rectified."""

    data: Path
    """a set of simgen"""
    methods: tuple[str, ...] = ("unrectified", "sift+5dof", "network")
    """of flowrect.methods; the truth is always there"""
    stereo: str = "sgbm"
    """the matcher: sgbm, hitnet, or onnx"""
    stereo_weights: str = ""
    """its file, where it needs one"""
    nearest_m: float = 2.0
    """nothing is nearer: it bounds the disparities that are looked for"""
    split: Literal["test", "train", "all"] = "test"
    limit: int = 0
    """pairs at most, evenly chosen; 0: all"""
    out: Path | None = None
    """writes every method's figures to this file, a JSON object for each method and range"""


@dataclass
class Tally:
    """What a method's pairs gave."""

    samples: list[DepthSamples]
    failed: int = 0
    """pairs for which it found no pose: their pixels have no answer"""


def evaluate(options: Options) -> dict[str, Tally]:
    """Depth samples of every pair, by method."""
    split = None if options.split == "all" else options.split
    pairs = open_source(options.data, split=split, truth_points=None)
    num = min(options.limit or len(pairs), len(pairs))
    chosen = np.linspace(0, len(pairs) - 1, num).round().astype(int).tolist()
    tallies = {name: Tally([]) for name in (*options.methods, TRUTH)}
    for index in track(chosen, "pairs"):
        _add_pair(tallies, pairs[index], options)
    return tallies


def _add_pair(tallies: dict[str, Tally], pair: Pair, options: Options) -> None:
    window = sized(pair, Sizing(METRIC_WH)).metric
    for name, tally in tallies.items():
        pose = _pose(name, pair)
        if pose is None:
            tally.failed += 1
            tally.samples.append(unanswered(window))
        else:
            tally.samples.append(depth_by(*pose, window, options))


def depth_by(R: Array, t: Array, window: Pair, options: Options) -> DepthSamples:
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


def unanswered(window: Pair) -> DepthSamples:
    """The pixels of a pair that could not be rectified."""
    truth = shown_truth(window)
    true = truth.depth[truth.visible & (truth.depth > 0)]
    return DepthSamples(true, np.full_like(true, np.nan))


def _pose(name: str, pair: Pair) -> tuple[Array, Array] | None:
    """(R, t) that a method finds; None if it finds none."""
    if name == TRUTH:
        T = pair.T_right_left
        if T is None:
            raise UserError(f"{pair.name}: nobody knows its pose; expected a rendered pair.")
        return T[:3, :3], T[:3, 3]
    try:
        found = load_method(name)(
            pair.left, pair.right, pair.K_left, pair.K_right, pair.T_right_left_nominal
        )
    except NoSolution:
        return None
    return found.R, found.t


def records(tallies: dict[str, Tally]) -> list[dict[str, Any]]:
    """One for each method and range."""
    return [
        {"method": name, "failed_pairs": tally.failed, **row._asdict(), "coverage": row.coverage}
        for name, tally in tallies.items()
        for row in DepthSamples.joined(tally.samples).by_range()
    ]


def table(rows: list[dict[str, Any]], title: str) -> Table:
    """MAE, median and bias [m], and coverage, by range, and the mean of the ranges' MAE."""
    ranges = [f"{a:.0f}-{b:.0f} m" for a, b in pairwise(EDGES_M)]
    result = Table("", *ranges, "mean MAE", title=title)
    for name in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == name]
        cells = [
            f"{r['mae_m']:.2f} / {r['median_m']:.2f} / {r['bias_m']:+.2f}\n{r['coverage']:.0%}"
            for r in own
        ]
        failed = f" ({own[0]['failed_pairs']} failed)" if own[0]["failed_pairs"] else ""
        result.add_row(name + failed, *cells, f"{np.mean([r['mae_m'] for r in own]):.2f}")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(Options, args=arguments, prog="flowrect.evaluate_depth")
    try:
        tallies = evaluate(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = records(tallies)
    if options.out is not None:
        options.out.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    num = len(tallies[TRUTH].samples)
    title = f"{options.stereo}, {num} pairs: MAE / median / bias in m, pixels with an answer"
    Console(width=200).print(table(rows, title))
    return 0


if __name__ == "__main__":
    sys.exit(main())
