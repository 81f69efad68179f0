"""The arithmetic of the benchmarks, on what is known in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import ablation
import cv2
import data_loading
import flow_metric
import match_probability
import method_time
import numpy as np
import paper_step
import pytest
import scene_contents
import shuffled_pairs
import torch
import tune_methods
import tyro
from scipy.spatial.transform import Rotation
from small_set import HW, make_frame, write_set
from tiny_network import TINY, network, road_set

from flowrect.config import TRAINING
from flowrect.correspondences import Correspondences
from flowrect.geometry import pixel_grid, project, unproject
from flowrect.loading import Loading, PairLoader
from flowrect.matches import Matches
from flowrect.methods import FromMatches, unrectified
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing
from flowrect.sample import Batch
from flowrect.solvers import NoSolution, Solution
from flowrect.sources import open_source
from flowrect.train_flow import Views, error_sizes
from flowrect.weights import Card, load_weights, save_weights
from simgen.errors import UserError

WH = (48, 32)


# --- flow_metric: points at infinity, whose flow is a homography ---------------------------------


def views_at_infinity(vertical: bool) -> tuple[Views, torch.Tensor]:
    """Two turned cameras that see the sky, and the exact flow (1, 2, H, W) of every left pixel.

    Half of the pixels are occluded. Valid is a window inside which all flow ends in the image.
    """
    w, h = WH
    K = torch.tensor([[[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]], dtype=torch.float64)
    R = torch.from_numpy(
        Rotation.from_rotvec([2.0, -3.0, 4.0], degrees=True).as_matrix()
    )[None]  # fmt: skip
    uv = pixel_grid(WH, dtype=torch.float64, device="cpu")[None]
    rays = unproject(K, uv)
    towards = rays @ R.mT
    occluded = torch.arange(w * h) % w < w // 2
    truth = Correspondences(
        rays, towards / towards[..., 2:], ~occluded[None], ~occluded[None], torch.zeros(1, w * h)
    )
    flow = (project(K, towards) - uv).mT.unflatten(-1, (h, w))
    valid = torch.zeros(1, 1, h, w, dtype=torch.bool)
    valid[..., 6:-6, 6:-6] = True
    image = torch.zeros(1, 3, h, w)
    batch = Batch(image, image, K, K, image, image, K, K, None, None, R, R[..., 0], truth, [""])
    return Views(batch, valid, torch.tensor([vertical])), flow.float()


@pytest.mark.parametrize("vertical", [False, True])
def test_exact_flow_has_no_error_and_the_exact_vertical_flow(vertical):
    seen, flow = views_at_infinity(vertical)
    by_network, exact = flow_metric.vertical_flows(flow, seen)[0].tolist()
    inner = flow[0, 0 if vertical else 1, 6:-6, 6:-6]
    expected = inner.abs().mean().item()
    assert by_network == pytest.approx(expected, rel=1e-5)
    assert exact == pytest.approx(expected, rel=1e-5)  # occluded pixels count, too
    assert error_sizes(flow, seen).max() < 1e-4


@pytest.mark.parametrize("vertical", [False, True])
def test_a_constant_error_is_a_bias_of_its_size_and_sign(vertical):
    seen, flow = views_at_infinity(vertical)
    error = torch.tensor([-0.3, 9.0] if vertical else [9.0, -0.3])
    off = flow + error[:, None, None]
    assert flow_metric.vertical_bias(off, seen).tolist() == pytest.approx([-0.3], abs=1e-4)


def test_pixels_that_one_image_lacks_have_no_say():
    seen, flow = views_at_infinity(False)
    expected = flow_metric.vertical_flows(flow, seen)
    outside = torch.where(seen.valid, flow, 99.0)
    torch.testing.assert_close(flow_metric.vertical_flows(outside, seen), expected)


class Still:
    """A network that sees no motion."""

    def flow(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(left[:, :2])


def test_the_vertical_error_of_seeing_nothing_is_the_vertical_flow(tmp_path):
    pairs = open_source(road_set(tmp_path, 2), split="train", truth_points=None)
    loader = PairLoader(pairs, Sizing(METRIC_WH), None, Loading(1, 0, shuffle=False))
    rows = {row[0]: np.array(row[1:8]) for row in flow_metric.measured(Still(), loader)}
    assert rows["rectified by the truth"][2:] == pytest.approx(0, abs=1e-6)
    unrectified, wrong = rows["as they stand"], rows["rectified, up to 1° off"]
    assert wrong[5] == unrectified[5] == 0  # by the network
    assert 0.5 < wrong[6] < 12
    # over what both cameras see, against all: of the same size
    assert unrectified[2] == pytest.approx(unrectified[6], rel=0.3)


# --- method_time ---------------------------------------------------------------------------------


def test_times_count_failures_and_their_seconds():
    timings = [
        method_time.Timing(1.0, {"matching": 0.8, "solving": 0.2}, failed=False),
        method_time.Timing(2.0, {"matching": 1.6, "solving": 0.4}, failed=False),
        method_time.Timing(9.0, {}, failed=True),
    ]
    name, whole, stages, num, failed = method_time.row("x", timings)
    assert (name, num, failed) == ("x", 3, 1)
    assert whole == f"2.000 / {np.percentile([1, 2, 9], 95):.3f}"
    assert stages == "matching 1.200 / 1.560, solving 0.300 / 0.390"


def test_a_method_that_always_fails_has_times_and_no_stages():
    timings = 2 * [method_time.Timing(3.0, {}, failed=True)]
    assert method_time.row("x", timings) == ["x", "3.000 / 3.000", "–", 2, 2]
    assert method_time.row("x", []) == ["x", "–", "–", 0, 0]


def test_a_failure_is_timed(tmp_path):
    def fails(*arguments: object):
        raise NoSolution("no matches", seconds={"matching": 0.5})

    pair = open_source(road_set(tmp_path, 2), split="train", truth_points=None)[0]
    timing = method_time.once(fails, pair)
    assert timing.failed
    assert timing.seconds > 0
    assert timing.stages == {"matching": 0.5}


def test_a_method_that_raises_costs_its_pair_only(tmp_path, capsys):
    def raises(*arguments: object):
        raise cv2.error("a plane")

    pair = open_source(road_set(tmp_path, 2), split="train", truth_points=None)[0]
    assert method_time.once(raises, pair).failed
    assert "error: a plane" in capsys.readouterr().out


# --- shuffled_pairs ------------------------------------------------------------------------------


def test_answers_about_mixed_pairs_are_told_by_their_turn_from_the_prior(tmp_path, monkeypatch):
    pairs = open_source(road_set(tmp_path, 2), split="train", truth_points=None)
    looked: list[str] = []

    def matcher(name: str):
        def match(left: np.ndarray, right: np.ndarray) -> Matches:
            np.testing.assert_array_equal(left, pairs[0].left)
            np.testing.assert_array_equal(right, pairs[-1].right)
            looked.append(name)
            return Matches(np.zeros((2, 2)), np.zeros((2, 2)))

        return match

    def turned(matches: Matches, K_left: np.ndarray, K_right: np.ndarray, prior: np.ndarray):
        if len(matches) == 4:  # of both matchers together
            raise NoSolution("too few")
        R = Rotation.from_rotvec([0, 4, 3], degrees=True).as_matrix() @ prior[:3, :3]
        return Solution(R, prior[:3, 3], np.ones(len(matches), dtype=bool))

    monkeypatch.setattr(shuffled_pairs, "load_matcher", matcher)
    mixed = shuffled_pairs.Mixed(pairs[0], pairs[-1])
    turns = [mixed.turn_deg(FromMatches(name, turned)) for name in ("sift", "dis", "sift-dis")]
    assert turns == [pytest.approx(5), pytest.approx(5), None]
    assert looked == ["sift", "dis"]  # once each
    assert mixed.turn_deg(unrectified) == 0
    row = shuffled_pairs.row("m", [5.0, 2.0, None])
    assert row == ["m", 3, 1, 2, 3.5, 1]
    assert shuffled_pairs.row("m", [None]) == ["m", 1, 1, 0, "–", 0]


# --- paper_step, data_loading, tune_methods ------------------------------------------------------


@pytest.mark.parametrize("mode", ["inference", "training"])
def test_a_step_runs_in_its_own_mode(mode):
    net, training = network(TINY), replace(TRAINING["small"], model=TINY)
    net.train(mode == "inference")
    before = [p.clone() for p in net.parameters()]
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3)
    batch = paper_step.noise_batch(1, TINY.input_wh)
    paper_step.run_once(mode, net, optimiser, batch, training)
    assert net.training == (mode == "training")
    learnt = any(not torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))
    assert learnt == (mode == "training")


def test_batches_are_loaded_as_small_trains():
    options = tyro.cli(data_loading.Options, args=["set"])
    assert options.batch == TRAINING["small"].loading.batch == 8


def test_learned_matches_meet_every_solver():
    num = len(tune_methods.FITS) + len(tune_methods.RANSACS)
    assert all(len(tune_methods.SWEEP[name]) == num for name in ("aliked", "disk", "xfeat"))
    assert list(tune_methods.matchers(("dis", "sift"))) == ["dis", "sift"]
    with pytest.raises(UserError, match="--only nobody: expected some of"):
        tune_methods.matchers(("dis", "nobody"))


# --- ablation ------------------------------------------------------------------------------------


def test_arms_differ_in_what_they_are_called_after():
    options = tyro.cli(
        ablation.Options, args=["--data", "d/train", "--test", "test", "--arms", *ablation.ARMS]
    )
    names = {a: ablation.folder(options, ablation.ARMS[a], 2).name for a in options.arms}
    assert names == {
        "with flow loss": "train-exact-2-250x4-0.5-gt",
        "without": "train-none-2-250x4-0.5-gt",
        "without matching": "train-exact-2-250x4-0-gt",
        "conv3d decoder": "train-exact-2-250x4-0.5-gt-conv3d",
        "without matching, conv3d decoder": "train-exact-2-250x4-0-gt-conv3d",
    }
    train, test = ablation.commands(options, ablation.ARMS["conv3d decoder"], 2)
    assert train[train.index("--model.decoder") + 1] == "conv3d"
    assert train[train.index("--loss.matching") + 1] == 0.5
    last = Path("runs/ablation/train-exact-2-250x4-0.5-gt-conv3d/last.safetensors")
    assert f"network={last}" in test


def test_two_arms_in_one_folder_are_refused():
    arms = ("with flow loss", "without matching")
    options = ablation.Options(Path("train"), Path("test"), matching=0.0, arms=arms)
    with pytest.raises(UserError, match="train the same"):
        ablation.main(options)


def test_arms_are_compared_with_the_first_one():
    rng = np.random.default_rng(0)
    first = rng.random((3, 20, 1))
    found = {"a": first, "b": first + 0.5, "c": first - 0.25}
    rows = {row[0]: row[1:] for row in ablation.table(found, np.arange(20))}
    assert rows["b − a [95 %]"] == ["+0.500 [+0.500, +0.500]"]
    assert rows["c − a [95 %]"] == ["-0.250 [-0.250, -0.250]"]
    assert rows["a"][0].startswith(f"{first[..., 0].mean():.3f} (")


# --- scene_contents: frames that were filled by hand ----------------------------------------------


def test_contents_of_frames_are_counted(tmp_path: Path, capsys) -> None:
    frames = [make_frame(0), make_frame(1)]
    for frame in frames:
        frame["depth"][:] = 50
        frame["depth"][:, : HW[0] // 2] = 0  # half is sky
        frame["depth"][:, -1, :24], frame["depth"][:, -1, 24:36] = 200, 400
        frame["semantic"][:], frame["instance"][:] = 7, 0
        frame["semantic"][0, 0, :3] = 23, 11, 21  # camera 0 sees 4 labels, the others 1
        frame["instance"][1, 0, :3] = 8, 9, 9  # camera 1 sees 2 instances, the others none
    scene_contents.main(scene_contents.Options(write_set(tmp_path / "set", frames)))
    said = capsys.readouterr().out
    for recipe in ("rural", "urban"):
        assert f"| {recipe} | 1 | {(4 + 1 + 1) / 3:.3g} | {2 / 3:.3g} |" in said
        assert f"| {recipe} | 1 | 0.5 |" in said
    assert "| partly_cloudy | 2 | 1 |" in said
    beyond = 36 / (HW[0] * HW[1]), 12 / (HW[0] * HW[1])
    assert f"{beyond[0]:.1%} beyond 100 m, {beyond[1]:.1%} beyond 300 m, 50% sky" in said


# --- match_probability ----------------------------------------------------------------------------


def test_images_are_mixed_with_those_of_another_scene():
    assert match_probability.partners(["a", "a", "b", "b", "b", "c"]) == [2, 2, 5, 5, 5, 0]
    with pytest.raises(UserError, match="all pairs are of one scene"):
        match_probability.partners(["a", "a"])


def test_a_threshold_lies_between_what_it_parts():
    true, mixed = np.array([0.4, 0.3]), np.array([0.1, 0.2])
    assert match_probability.threshold(true, mixed) == pytest.approx(0.25)
    assert match_probability.threshold(mixed, true) is None


def test_the_threshold_is_written_into_the_card(tmp_path, monkeypatch, capsys):
    path = tmp_path / "w.safetensors"
    save_weights(path, network(), Card(preset="small", samples=7))
    found = np.array([0.4, 0.3]), np.array([0.1, 0.2])
    monkeypatch.setattr(match_probability, "probabilities", lambda *_: found)
    options = match_probability.Options(tmp_path, str(path), write=True)
    monkeypatch.setattr(match_probability, "Delivery",
                        lambda *_: SimpleNamespace(open=list))  # fmt: skip
    match_probability.main(options)
    assert "threshold 0.250" in capsys.readouterr().out
    net, card = load_weights(path)
    assert card == Card(preset="small", samples=7, least_match_probability=0.25)
    assert all(torch.equal(a, b) for a, b in zip(net.parameters(), network().parameters(),
                                                 strict=True))  # fmt: skip
