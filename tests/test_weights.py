"""Weights come back as they went, anything else is refused; what a user of them sees."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from tiny_network import TINY, TINY_PAPER, network, pairs, predict

from flowrect.config import MODELS
from flowrect.estimate import Calibrator, load_model
from flowrect.weights import Card, config_from_json, find_weights, load_weights, save_weights
from simgen.errors import UserError
from simgen.geometry import intrinsics, transform

CARD = Card(preset="small", prior_range_deg=(2.0, 2.0, 2.0), samples=12, translation="gt")
HW = (96, 160)
K = intrinsics((HW[1], HW[0]), 90.0)
PRIOR = transform(np.eye(3), np.array([-0.8, 0.0, 0.0]))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_weights(tmp_path / "tiny.safetensors", network(), CARD)
    return tmp_path / "tiny.safetensors"


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*HW, 3), dtype=np.uint8)


# --- files


@pytest.mark.parametrize("config", [TINY, TINY_PAPER], ids=["small", "paper"])
def test_what_is_loaded_predicts_what_was_saved(config, tmp_path):
    net, given = network(replace(config, zero_head=False)), pairs(2, seed=1)
    save_weights(tmp_path / "w.safetensors", net, CARD)
    loaded, card = load_weights(tmp_path / "w.safetensors")
    assert (loaded.config, card) == (net.config, CARD)
    assert torch.equal(predict(loaded, given).R, predict(net, given).R)


def test_a_pickle_is_refused(tmp_path):
    torch.save(network().state_dict(), tmp_path / "model.pt")
    with pytest.raises(UserError, match=r"model\.pt is no safetensors file .*Pickles.*refused"):
        load_weights(tmp_path / "model.pt")


def test_weights_of_another_preset_are_refused_with_what_differs(path):
    with pytest.raises(UserError, match=r"another network: channels is 16, expected 32"):
        load_weights(path, expected=replace(TINY, channels=32))


def test_training_may_go_on_at_another_size_of_the_images(path):
    own, _ = load_weights(path)
    larger, _ = load_weights(path, expected=replace(TINY, input_wh=(384, 192)))
    assert larger.config.input_wh == (384, 192) != own.config.input_wh
    assert all(torch.equal(x, own.state_dict()[k]) for k, x in larger.state_dict().items())


def test_foreign_safetensors_are_refused(tmp_path):
    save_file({"x": torch.zeros(1)}, tmp_path / "x.safetensors")
    with pytest.raises(UserError, match=r"format 'flowrect-weights-1' in its header, found None"):
        load_weights(tmp_path / "x.safetensors")


def test_a_tensor_of_the_wrong_shape_is_named(tmp_path):
    net = network()
    net.linear = torch.nn.Linear(3, 6)
    save_weights(tmp_path / "w.safetensors", net, CARD)
    with pytest.raises(UserError, match=r"'linear\.weight' is \(6, 3\), expected \(6, 24\)"):
        load_weights(tmp_path / "w.safetensors")


def test_an_absent_tensor_is_named(tmp_path):
    net = network()
    del net.norm
    save_weights(tmp_path / "w.safetensors", net, CARD)
    with pytest.raises(UserError, match=r"'norm\.bias' is absent, expected \(16,\)"):
        load_weights(tmp_path / "w.safetensors")


def test_a_config_with_an_unknown_field_is_refused():
    with pytest.raises(ValueError, match=r"fields \['colour'\] are on one side only"):
        config_from_json(json.dumps({**asdict(TINY), "colour": 1}))


def test_a_name_that_is_not_there_says_what_is(tmp_path):
    with pytest.raises(UserError, match=r"weights 'smal': expected a file or one of the shipped"):
        find_weights("smal")


# --- use


def test_an_estimate_is_a_calibration_as_opencv_computes_it(path):
    pose = transform(Rotation.from_rotvec([1, -0.5, 1], degrees=True).as_matrix(), [-0.8, 0.01, 0])
    estimate = load_model(path).estimate(noise(0), noise(1), K, K, pose)
    R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(
        K, np.zeros(5), K, np.zeros(5), HW[::-1], estimate.R, estimate.t[:, None],
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1,
    )  # fmt: skip
    ours = (estimate.R1, estimate.R2, estimate.P1, estimate.P2, estimate.Q)
    for name, a, b in zip(("R1", "R2", "P1", "P2", "Q"), ours, (R1, R2, P1, P2, Q), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-4, err_msg=name)
    np.testing.assert_allclose(estimate.R @ estimate.R.T, np.eye(3), atol=1e-12)


def test_a_vertical_rig_has_its_baseline_in_the_second_row(path):
    prior = transform(np.eye(3), np.array([0.0, -0.5, 0.0]))
    estimate = load_model(path).estimate(noise(0), noise(1), K, K, prior)
    assert estimate.P2[1, 3] == pytest.approx(-0.5 * estimate.P2[1, 1])
    assert abs(estimate.P2[0, 3]) < 1e-9
    assert estimate.Q[3, 2] == pytest.approx(2.0)


def test_identical_images_are_refused(path):
    with pytest.raises(UserError, match=r"two images are identical"):
        load_model(path).estimate(noise(0), noise(0), K, K, PRIOR)


def test_constant_images_are_warned_of(path):
    grey = np.full((*HW, 3), 128, np.uint8)
    with pytest.warns(UserWarning, match=r"almost no texture"):
        estimate = load_model(path).estimate(grey, grey + 1, K, K, PRIOR)
    assert not estimate.valid
    assert [note[:14] for note in estimate.notes] == ["the left image", "the right imag"]


def test_an_estimate_beyond_the_trained_range_is_warned_of_with_the_range(path):
    narrow = Calibrator(load_model(path).network, replace(CARD, prior_range_deg=(0.0, 0.5, 0.0)))
    with pytest.warns(UserWarning, match=r"priors within 0\.00° / 0\.50° / 0\.00°"):
        assert not narrow.estimate(noise(0), noise(1), K, K, PRIOR).valid


def test_images_of_two_sizes_are_refused(path):
    with pytest.raises(UserError, match=r"160x96, the right one 160x95"):
        load_model(path).estimate(noise(0), noise(1)[:-1], K, K, PRIOR)


@pytest.mark.parametrize(
    "prior, message",
    [
        (np.eye(3), r"expected \(4, 4\)"),
        (2 * PRIOR, r"expected \(4, 4\)"),
        (np.eye(4), r"side by side differ"),
    ],
)
def test_a_prior_that_is_no_pose_of_a_rig_is_refused(path, prior, message):
    with pytest.raises(UserError, match=message):
        load_model(path).estimate(noise(0), noise(1), K, K, prior)


def test_the_shipped_weights_are_those_of_the_preset_seen_larger():
    larger = replace(MODELS["small"], input_wh=(384, 192))
    model, card = load_weights(find_weights("small"), expected=larger)
    assert not model.training
    assert card.preset == "custom"
    assert min(card.prior_range_deg) > 1.9
