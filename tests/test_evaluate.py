"""Scores of weights: three rows that must agree with each other, and with the geometry."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_network import TINY, road_set

from flowrect.estimate import Calibrator
from flowrect.evaluate import FIGURES, ROWS, Options, evaluate, score, table
from flowrect.model import Rectifier
from flowrect.sources import open_source
from flowrect.weights import Card, save_weights
from simgen.errors import UserError

ANGLES, FLOW = slice(0, 4), 4


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return road_set(tmp_path_factory.mktemp("set"))


@pytest.fixture
def untrained() -> Calibrator:
    return Calibrator(Rectifier(TINY).eval(), Card(preset="custom"))


def test_the_truth_has_no_error_and_no_vertical_flow(data, untrained):
    for pair in open_source(data, truth_points=None):
        truth = score(pair, untrained, "gt")["truth"]
        assert truth[ANGLES] == pytest.approx([0, 0, 0, 0], abs=1e-9)
        assert truth[FLOW] < 1e-4


def test_angles_of_the_unrectified_pair_are_those_that_were_drawn(data, untrained):
    pair = open_source(data, truth_points=None)[0]
    figures = score(pair, untrained, "gt")["unrectified"]
    relative = pair.turn_right.T @ pair.turn_left  # R_right_left of a rig without nominal rotation
    cosine = (np.trace(relative) - 1) / 2
    assert figures[3] == pytest.approx(np.rad2deg(np.arccos(cosine)), abs=1e-6)
    assert figures[FLOW] > 0.1


def test_a_wrong_translation_leaves_vertical_flow_even_to_the_true_rotation(data, untrained):
    pair = open_source(data, truth_points=None)[0]
    assert score(pair, untrained, "nominal")["truth"][FLOW] > 1e-3


def test_every_pair_is_scored_and_summarised(data, tmp_path):
    save_weights(tmp_path / "w.safetensors", Rectifier(TINY), Card(preset="custom"))
    options = Options(data, str(tmp_path / "w.safetensors"), split="all")
    records = evaluate(options)
    assert len(records) == len(open_source(data))
    assert all(len(r[row]) == len(FIGURES) for r in records for row in ROWS)
    json.dumps(records)
    assert table(records, "").row_count == len(ROWS)


def test_a_limit_is_spread_over_the_set(data, tmp_path):
    save_weights(tmp_path / "w.safetensors", Rectifier(TINY), Card(preset="custom"))
    records = evaluate(Options(data, str(tmp_path / "w.safetensors"), split="all", limit=2))
    pairs = open_source(data)
    assert [r["name"] for r in records] == [pairs[0].name, pairs[len(pairs) - 1].name]


def test_pairs_without_truth_are_refused(data, untrained):
    pair = replace(open_source(data, truth_points=None)[0], truth=None)
    with pytest.raises(UserError, match="no exact ground truth"):
        score(pair, untrained, "gt")
