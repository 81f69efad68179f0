"""Tables and the bound: numbers that were worked out by other means."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from flowrect.evaluation.report import cramer_rao_deg
from flowrect.evaluation.scores import Score
from flowrect.evaluation.tables import stratum_table, write_summary


def score(index: int, geodesic: float, bias: float, weather: str = "", failure: str = "") -> Score:
    """Of method "m"; the vertical flow is ten times the angle."""
    figures = {"geodesic_deg": geodesic, "vertical_flow_px": 10 * geodesic,
               "disparity_bias_px": bias}  # fmt: skip
    return Score("m", "gt", index, "", f"scene {index}", weather, "", figures, failure)


@pytest.mark.parametrize(("wh", "f"), [((1024, 512), 887.0), ((1242, 375), 727.0)])
def test_the_bound_is_the_error_of_fits_to_noisy_matches(wh, f):
    """Least squares of dv = −ωx(1 + y²) + ωy xy + ωz x, both ends of a match off by 0.5 px."""
    rng = np.random.default_rng(0)
    for side in (10, 30):
        grid = (np.arange(side) + 0.5) / side - 0.5
        x, y = (grid * n / f for n in wh)
        x, y, num = np.tile(x, side), np.repeat(y, side), side**2
        J = np.stack([-(1 + y**2), x * y, x], axis=1)
        ends = rng.normal(0, 0.5, (2, num, 2000)) / f
        turns = np.linalg.pinv(J) @ (ends[0] - ends[1])
        rms_deg = np.rad2deg(np.sqrt((turns**2).sum(0).mean()))
        assert cramer_rao_deg(np.array(num), 0.5, f, wh) == pytest.approx(rms_deg, rel=0.05)


def test_a_stratum_has_the_medians_of_its_pairs_and_counts_its_failures():
    scores = [score(0, 0.1, 0, "clear"), score(1, 0.2, 0, "clear"), score(2, 0.6, 0, "clear", "no"),
              score(3, 0.4, 0, "fog"), score(4, 0.5, 0, "fog")]  # fmt: skip
    assert stratum_table(scores, "gt", "weather").splitlines() == [
        "| method | clear (3) | fog (2) |",
        "| --- | --- | --- |",
        "| m | 2.000 / 0.200 (1) | 4.500 / 0.450 |",
    ]
    assert stratum_table(scores, "nominal", "weather").splitlines()[2:] == []


def test_a_summary_has_signed_means_intervals_over_scenes_and_failures(tmp_path: Path):
    bias = np.array([-3.0, 1.0, 1.0, 2.0, 2.0, np.nan])
    scores = [score(i, 0.1, b, failure="no" * (i == 0)) for i, b in enumerate(bias)]
    write_summary(tmp_path / "s.csv", scores)
    with (tmp_path / "s.csv").open(newline="") as file:
        rows = {row["figure"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["geodesic_deg", "vertical_flow_px", "disparity_bias_px"]
    row = rows["disparity_bias_px"]
    assert (row["method"], row["translation"]) == ("m", "gt")
    assert float(row["mean"]) == pytest.approx(0.6)
    assert float(row["median"]) == 1.0
    assert float(row["p95"]) == 2.0
    assert (row["pairs"], row["failures"]) == ("5", "1")  # a pair without the figure is in neither
    draws = np.random.default_rng(1).choice(bias[:5], (20_000, 5)).mean(1)
    low, high = np.quantile(draws, [0.025, 0.975])
    assert float(row["low"]) == pytest.approx(low, abs=0.1)
    assert float(row["high"]) == pytest.approx(high, abs=0.1)
    assert float(rows["geodesic_deg"]["low"]) == pytest.approx(0.1)
