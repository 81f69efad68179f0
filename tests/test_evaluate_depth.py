"""Depth error by method: the truth is the best there is, and failures are counted."""

from __future__ import annotations

import json

import numpy as np
import pytest
from planes import along_x, plane_pair, turned
from tiny_network import road_set

from flowrect import evaluate_depth
from flowrect.evaluate_depth import TRUTH, Options, depth_by, evaluate, main, unanswered
from flowrect.methods import METHODS
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, sized
from flowrect.solvers.solution import NoSolution


def no_solution(*_: object) -> None:
    raise NoSolution("too few matches")


def test_the_truth_beats_a_wrong_pose_and_the_length_of_t_does_not_matter(tmp_path):
    R, t = turned(0.3, -0.4, 0.5), along_x()
    pair = plane_pair(R, t, np.array([0.002, 0.02, 0.04]))
    window = sized(pair, Sizing(METRIC_WH)).metric
    options = Options(tmp_path, nearest_m=6.0)
    true, wrong = R[0].numpy(), (turned(y=0.4) @ R)[0].numpy()
    rows = []
    for rotation, scale in ((true, 1.0), (true, 7.0), (wrong, 1.0)):
        [row] = depth_by(rotation, scale * t[0].numpy(), window, options).by_range((0, 300))
        rows.append(row)
    assert rows[0].coverage > 0.8
    assert rows[1] == pytest.approx(rows[0])
    assert rows[2].median_m > 3 * rows[0].median_m
    empty = unanswered(window).by_range((0, 300))[0]
    assert (empty.pixels, empty.answered) == (rows[0].pixels, 0)


def test_every_method_answers_for_the_same_pixels_and_failures_are_counted(
    tmp_path, monkeypatch, capsys
):
    data = road_set(tmp_path / "set", frames=1)
    monkeypatch.setitem(METHODS, "failing", lambda: no_solution)
    given = ["--data", str(data), "--limit", "2", "--methods", "unrectified", "failing",
             "--out", str(tmp_path / "rows.jsonl")]  # fmt: skip
    assert main(given) == 0
    printed = capsys.readouterr().out
    assert "failing (2 failed)" in printed
    assert "bias in m" in printed
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    pixels = {
        name: [r["pixels"] for r in rows if r["method"] == name]
        for name in ("unrectified", "failing", TRUTH)
    }
    assert pixels["unrectified"] == pixels["failing"] == pixels[TRUTH]
    assert sum(pixels[TRUTH]) > 1000
    assert not any(r["answered"] for r in rows if r["method"] == "failing")


def test_depth_of_no_data_or_no_matcher_is_refused(tmp_path, capsys):
    assert main(["--data", str(tmp_path / "no")]) == 2
    assert "no such folder" in capsys.readouterr().err
    data = road_set(tmp_path / "set", frames=1)
    assert main(["--data", str(data), "--stereo", "psm", "--methods", "unrectified"]) == 2
    assert "stereo matcher 'psm': expected one of sgbm" in capsys.readouterr().err


def test_pairs_are_chosen_evenly(tmp_path, monkeypatch):
    data = road_set(tmp_path / "set", frames=1)
    seen = []
    monkeypatch.setattr(evaluate_depth, "_add_pair", lambda _, pair, __: seen.append(pair.name))
    evaluate(Options(data, limit=2))
    assert seen == ["frame 0, cameras 0 and 1", "frame 0, cameras 0 and 2"]
