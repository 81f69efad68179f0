"""Scores of trained weights on a set: ``python -m flowrect.evaluate --data shards --weights FILE``.

Three rows, the same pairs for all: *unrectified* (the prior's rotation for the angles, the images
as they are for vertical flow), the *network*, and the *truth*. Angles are those of R_gt R_predᵀ
about the right camera's axes; vertical flow is exact, by the correspondences of every native left
pixel, at 512×256 of the whole 2:1 window, whatever part of it the network sees.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flowrect.drectify import rectify
from flowrect.estimate import Calibrator, load_model
from flowrect.metrics import (
    METRIC_WH,
    angles_deg,
    exact_vertical_flow,
    geodesic_deg,
    summarise,
    unrectified_vertical_flow,
)
from flowrect.resize import Sizing, sized
from flowrect.sample import Pair, collate
from flowrect.sources import open_source
from simgen.errors import UserError

FIGURES = ("pitch [°]", "yaw [°]", "roll [°]", "geodesic [°]", "vertical flow [px]")
ROWS = ("unrectified", "network", "truth")


@dataclass(frozen=True)
class Options:
    """Angles and exact vertical flow of trained weights, over the pairs of a rendered set."""

    data: Path
    """a set of simgen"""
    weights: str = "small"
    """name of shipped weights, or a file of flowrect.train"""
    split: Literal["test", "train", "all"] = "test"
    translation: Literal["gt", "nominal"] = "gt"
    """t of the prior, for the network and for the rectification that is scored: gt as in the paper,
    though it leaks rotation, or the nominal one, which is what a user has"""
    limit: int = 0
    """pairs at most, evenly chosen; 0: all"""
    out: Path | None = None
    """writes the figures of every pair to this file, a JSON object a line"""


@torch.inference_mode()
def score(
    pair: Pair, calibrator: Calibrator, translation: Literal["gt", "nominal"]
) -> dict[str, list[float]]:
    """The ``FIGURES`` of one pair by row."""
    config, card = calibrator.network.config, calibrator.card
    seen = collate([sized(pair, Sizing(config.input_wh, card.fit, card.keep))])
    whole = collate([sized(pair, Sizing(config.input_wh, card.fit))])
    if seen.R is None or seen.t is None or whole.truth is None:
        raise UserError(
            f"{pair.name}: has no exact ground truth; expected a pair that was rendered."
        )
    t = seen.t if translation == "gt" else seen.t_nominal
    network = calibrator.network(
        seen.left, seen.right, seen.K_left, seen.K_right, seen.R_nominal, t
    )
    rotations = {"unrectified": seen.R_nominal, "network": network.R, "truth": seen.R}
    K_left, K_right = whole.K_left_metric, whole.K_right_metric
    rect = {row: rectify(R, t, K_left, K_right, METRIC_WH) for row, R in rotations.items()}
    flow = {row: exact_vertical_flow(rect[row], whole.truth) for row in ROWS[1:]}
    flow["unrectified"] = unrectified_vertical_flow(
        whole.truth, K_left, K_right, rect["truth"].vertical
    )
    return {
        row: [
            *angles_deg(seen.R, R)[0].abs().tolist(),
            geodesic_deg(seen.R, R).item(),
            flow[row].item(),
        ]
        for row, R in rotations.items()
    }


def evaluate(options: Options) -> list[dict[str, Any]]:
    """Scores every pair: its name, scene, weather, daylight, and the figures by row."""
    split = None if options.split == "all" else options.split
    pairs = open_source(options.data, split=split, truth_points=None)
    calibrator = load_model(options.weights)
    num = min(options.limit or len(pairs), len(pairs))
    chosen = np.linspace(0, len(pairs) - 1, num).round().astype(int).tolist()
    return list(_scored((pairs[i] for i in track(chosen, "pairs")), calibrator, options))


def _scored(
    pairs: Iterator[Pair], calibrator: Calibrator, options: Options
) -> Iterator[dict[str, Any]]:
    for pair in pairs:
        figures = score(pair, calibrator, options.translation)
        yield {"name": pair.name, "scene": pair.scene, "weather": pair.weather,
               "daylight": pair.daylight, **figures}  # fmt: skip


def table(records: list[dict[str, Any]], title: str) -> Table:
    """Mean / median of every figure, and the 95 % interval of the mean over scenes."""
    rng = np.random.default_rng(0)
    scenes = [r["scene"] for r in records]
    result = Table("", *FIGURES, title=title)
    for row in ROWS:
        cells = []
        for k in range(len(FIGURES)):
            values = np.array([r[row][k] for r in records])
            known = np.isfinite(values)
            s = summarise(values[known], np.array(scenes)[known], rng=rng)
            missing = f" ({(~known).sum()} without)" if not known.all() else ""
            low, high = s.interval
            cells.append(f"{s.mean:.3f} / {s.median:.3f} [{low:.3f}, {high:.3f}]{missing}")
        result.add_row(row, *cells)
    return result


def main() -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(Options, prog="flowrect.evaluate")
    try:
        records = evaluate(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if options.out is not None:
        options.out.write_text("".join(json.dumps(r) + "\n" for r in records), encoding="utf-8")
    title = (
        f"{len(records)} pairs, {options.split}, t = {options.translation}: mean / median [95 %]"
    )
    Console(width=180).print(table(records, title))
    return 0


if __name__ == "__main__":
    sys.exit(main())
