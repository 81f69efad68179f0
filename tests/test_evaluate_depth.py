"""Depth error by method: the truth is the best there is, and failures are counted."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from planes import along_x, plane_pair, turned
from tiny_network import road_set

from flowrect.evaluate_depth import DepthOptions, main, matched_by
from flowrect.evaluation.delivered import Delivery
from flowrect.evaluation.predictions import Origin, Prediction, write
from flowrect.evaluation.scores import TRUTH, UNRECTIFIED
from flowrect.evaluation.stamp import of_method
from flowrect.methods import PoseEstimate
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, sized


def test_the_truth_beats_a_wrong_pose_and_the_length_of_t_does_not_matter(tmp_path):
    R, t = turned(0.3, -0.4, 0.5), along_x()
    pair = plane_pair(R, t, np.array([0.002, 0.02, 0.04]))
    window = sized(pair, Sizing(METRIC_WH)).metric
    options = DepthOptions(tmp_path, nearest_m=6.0)
    true, wrong = R[0].numpy(), (turned(y=0.4) @ R)[0].numpy()
    rows = []
    for rotation, scale in ((true, 1.0), (true, 7.0), (wrong, 1.0)):
        found = matched_by(rotation, scale * t[0].numpy(), window, options)
        [row] = found.samples(window).by_range((0, 300))
        rows.append(row)
    assert rows[0].coverage > 0.8
    assert rows[1] == pytest.approx(rows[0])
    assert rows[2].median_m > 3 * rows[0].median_m


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    """A set, and results on it: of the true pose, of a wild one, and of a method that failed."""
    data = road_set(tmp_path / "set", frames=1)
    pairs = Delivery(data, "all", (96, 48)).open()
    for method in ("right", "wild", "failing"):
        rows = []
        for i in range(len(pairs)):
            T = pairs[i].input.T_right_left
            t = {"right": T[:3, 3], "wild": np.array([0.0, -1.0, 0.0])}.get(method)
            pose = None if t is None else PoseEstimate(T[:3, :3], t)
            rows.append(Prediction(i, "", pose, "" if pose else "too few matches"))
        origin = Origin(method, "nominal", pairs.fingerprint, of_method(method))
        write(tmp_path / "results" / "predictions" / f"{method}.h5", rows, origin)
    return ["--data", str(data), "--results", str(tmp_path / "results"), "--size", "96x48",
            "--split", "all"]  # fmt: skip


def test_every_method_answers_for_the_same_pixels_and_failures_are_scored_with_the_prior(
    given, tmp_path, capsys
):
    assert main(given) == 0
    printed = capsys.readouterr().out
    assert "failing (3 failed)" in printed
    assert "wild (3 failed)" in printed  # its baseline is vertical
    with (tmp_path / "results" / "depth.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    of = {name: [r for r in rows if r["method"] == name]
          for name in (UNRECTIFIED, "right", "wild", "failing", TRUTH)}  # fmt: skip
    for figure in ("pixels", "coverage", "mae_m", "mae_common_m"):
        column = {name: [r[figure] for r in found] for name, found in of.items()}
        assert column["failing"] == column["wild"] == column[UNRECTIFIED]
        assert column["right"] == column[TRUTH]
    assert sum(int(r["pixels"]) for r in of[TRUTH]) > 1000
    page = (tmp_path / "results" / "depth.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") == 2 * 3 * len(of)  # an overlay and depth, of three pairs
    assert page.count("<svg") == 2
    assert "failing (3 failed)" in page


def test_depth_without_predictions_or_matcher_is_refused(given, tmp_path, capsys):
    assert main(["--data", str(tmp_path / "no")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert main([*given, "--size", "64x32"]) == 2
    assert "Run python -m flowrect.evaluate with the same" in capsys.readouterr().err
    assert main([*given, "--stereo", "psm"]) == 2
    assert "stereo matcher 'psm': expected one of sgbm" in capsys.readouterr().err
