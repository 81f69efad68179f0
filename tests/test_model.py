"""Laws of the network: frames of the correction, each stage by brute force, sizes, gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_pairs import analytic_pairs
from tiny_network import TINY, TINY_PAPER, WH, network, pairs, predict, rotations

from flowrect.drectify import rectify
from flowrect.geometry import geodesic_rad, sixd_from_rotation
from flowrect.least_squares import rotation_from_matches
from flowrect.model import expected_matches, log_match_distribution, sine_encoding
from simgen.errors import UserError

BOTH = pytest.mark.parametrize("config", [TINY, TINY_PAPER], ids=["small", "paper"])


def geodesic_deg(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(geodesic_rad(a, b).rad2deg().max())


# --- the frame of the correction


@BOTH
def test_zero_correction_gives_back_the_start(config):
    net, given = network(config), pairs(3, seed=1)
    prediction = predict(net, given)
    assert geodesic_deg(prediction.R, prediction.R_start) < 1e-6
    if prediction.matches is None:
        assert geodesic_deg(prediction.R, given["R_init"]) < 1e-6


@pytest.mark.parametrize("frame", ["camera", "rectified"])
def test_the_right_correction_gives_the_true_rotation_for_any_prior(frame):
    net = network(replace(TINY, frame=frame))
    given = pairs(8, seed=2, limit_deg=20.0)
    given["t_init"] = given["t_init"] + 0.3 * torch.rand(8, 3, dtype=torch.float64)
    R_start, R_gt = given["R_init"], rotations(torch.linspace(-9, 9, 24).reshape(8, 3).double())
    rect = rectify(R_start, given["t_init"], given["K_left"], given["K_right"], WH)
    if frame == "camera":
        right = sixd_from_rotation(R_gt) - sixd_from_rotation(R_start)
    else:
        right = sixd_from_rotation(rect.R_right @ R_gt @ rect.R_left.mT)
        right = right - torch.tensor([1.0, 0, 0, 0, 1, 0])
    assert right.abs().max() < 1  # within Tanh's reach
    torch.testing.assert_close(net.corrected(R_start, right, rect), R_gt, rtol=0, atol=1e-13)


def test_in_the_rectified_frame_the_same_output_means_the_same_residual_for_any_prior():
    net, given = network(TINY), pairs(2, seed=3)
    correction = 0.02 * torch.randn(1, 6, dtype=torch.float64).expand(2, 6)
    rect = rectify(given["R_init"], given["t_init"], given["K_left"], given["K_right"], WH)
    R = net.corrected(given["R_init"], correction, rect)
    residual = rect.R_right @ R @ rect.R_left.mT
    torch.testing.assert_close(residual[0], residual[1], rtol=0, atol=1e-13)


@pytest.mark.parametrize("vertical", [False, True])
def test_perfect_matches_give_the_true_rotation_whatever_the_depth(vertical):
    rig = analytic_pairs(6, seed=4, vertical=vertical)
    eye = torch.eye(3, dtype=torch.float64).expand(6, 3, 3)
    rect = rectify(eye, rig.t, rig.K_left, rig.K_right, (128, 64))
    xy = [rays @ R.mT for rays, R in ((rig.truth.rays_left, rect.R_left),
                                      (rig.truth.rays_right, rect.R_right))]  # fmt: skip
    xy = [x[..., :2] / x[..., 2:] for x in xy]
    Delta = rotation_from_matches(
        *xy, torch.full(xy[0].shape[:2], 1e6, dtype=torch.float64), rect.vertical,
        focal_px=rect.K_new[:, 0, 0], prior_sigma_rad=math.radians(2), iterations=12,
    )  # fmt: skip
    assert geodesic_deg(rect.R_right.mT @ Delta @ rect.R_left, rig.R) < 1e-6


def test_without_weight_the_closed_form_leaves_the_prior():
    xy = torch.rand(2, 50, 2, dtype=torch.float64, requires_grad=True)
    Delta = rotation_from_matches(
        xy, xy + 0.1, torch.zeros(2, 50, dtype=torch.float64), torch.tensor([False, True]),
        focal_px=torch.full((2,), 32.0).double(), prior_sigma_rad=0.03,
    )  # fmt: skip
    torch.testing.assert_close(Delta, torch.eye(3).double().expand(2, 3, 3))
    Delta.sum().backward()
    assert torch.isfinite(xy.grad).all()


def test_gradient_of_the_closed_form_is_that_of_finite_differences():
    generator = torch.Generator().manual_seed(5)
    left, shift = torch.rand(2, 1, 12, 2, generator=generator, dtype=torch.float64)
    weight = torch.rand(1, 12, generator=generator, dtype=torch.float64)
    right = (left + 0.05 * shift).requires_grad_()
    horizontal, focal = torch.tensor([False]), torch.tensor([32.0]).double()

    def solve(right: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        return rotation_from_matches(
            left, right, weight, horizontal, focal_px=focal, prior_sigma_rad=0.03
        )

    assert torch.autograd.gradcheck(solve, (right, weight.requires_grad_()))


# --- stages


def test_encoding_is_the_formula():
    channels, h, w = 16, 5, 7
    d = channels // 2
    expected = np.zeros((channels, h, w))
    for row in range(h):
        for column in range(w):
            for half, pos in enumerate((row + 1, column + 1)):
                for k in range(d // 2):
                    angle = pos / 10000 ** (2 * k / d)
                    expected[half * d + 2 * k, row, column] = math.sin(angle)
                    expected[half * d + 2 * k + 1, row, column] = math.cos(angle)
    encoding = sine_encoding(channels, (h, w), torch.device("cpu"))
    np.testing.assert_allclose(encoding.numpy(), expected, atol=1e-6)


def test_match_distribution_is_the_softmax_of_scaled_products():
    left, right = torch.randn(2, 2, 6, 16, generator=torch.Generator().manual_seed(6))
    M_vol = np.einsum("bic,bjc->bij", left.numpy(), right.numpy()) / 4
    M_match = np.exp(M_vol) / np.exp(M_vol).sum(-1, keepdims=True)
    log_matches = log_match_distribution(left, right)
    np.testing.assert_allclose(log_matches.exp().numpy(), M_match, rtol=1e-4)


@BOTH
def test_rows_of_matches_sum_to_one(config):
    M_match = predict(network(config), pairs(2, seed=7)).log_matches.exp()
    torch.testing.assert_close(M_match.sum(-1), torch.ones(2, 16 * 8))


def test_a_sharp_distribution_is_read_where_it_stands():
    h, w = 6, 9
    target = torch.tensor([3.25, 2.5])  # between four feature pixels, by bilinear weights
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    p = (1 - (u - target[0]).abs()).clamp(0) * (1 - (v - target[1]).abs()).clamp(0)
    far = p.clone()
    far[0, 8] = 0.2  # a second mode outside the window
    log_matches = torch.stack([p, far]).flatten(1).clamp_min(1e-12).log()[None]
    matches = expected_matches(log_matches, (h, w), 2)
    torch.testing.assert_close(matches.uv_right, target.expand(1, 2, 2), rtol=0, atol=1e-5)
    spread = math.sqrt(0.25 * 0.75 + 0.5 * 0.5 + 1e-4)
    torch.testing.assert_close(matches.spread, torch.full((1, 2), spread), rtol=1e-4, atol=0)


def test_a_feature_pixel_stands_for_the_middle_of_its_square():
    """An image mirrored left to right has mirrored features if kernels are: centres agree."""
    net = network(TINY)
    for module in net.cnn.modules():
        if isinstance(module, torch.nn.Conv2d):
            with torch.no_grad():
                module.weight.copy_(0.5 * (module.weight + module.weight.flip(-1)))
    image = torch.rand(1, 3, 32, 64, generator=torch.Generator().manual_seed(9))
    with torch.no_grad():
        torch.testing.assert_close(
            net.cnn(image.flip(-1)), net.cnn(image).flip(-1), rtol=0, atol=1e-5
        )


def test_pixels_that_show_no_image_have_no_say():
    given = pairs(1, seed=10)
    net = network(TINY)
    rect = rectify(given["R_init"], given["t_init"], given["K_left"], given["K_right"], WH)
    log_matches = torch.randn(1, 128, 128).log_softmax(-1)
    other = log_matches.clone()
    other[:, 17] = other[:, 17].roll(40)
    seen = torch.ones(1, 128, dtype=torch.bool)
    seen[:, 17] = False
    with torch.no_grad():
        a, b = (net.decoder(x, seen, rect.resized(0.25), (8, 16)) for x in (log_matches, other))
    torch.testing.assert_close(a[0], b[0], rtol=0, atol=0)
    torch.testing.assert_close(a[1], b[1], rtol=0, atol=0)


# --- the whole


@BOTH
def test_gradients_are_finite_and_reach_every_parameter(config):
    net = network(replace(config, zero_head=False))
    prediction = net(**pairs(2, seed=11))
    (prediction.R.sum() + prediction.log_matches[..., 0].mean()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


@BOTH
def test_gradients_are_finite_for_constant_images(config):
    net, given = network(config), pairs(2, seed=12)
    given["left"], given["right"] = torch.zeros(2, 2, 3, 32, 64)
    net(**given).R.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


@BOTH
@pytest.mark.parametrize("wh", [(96, 64), (64, 32), (70, 45)])
def test_any_size_goes_through(config, wh):
    prediction = predict(network(config), pairs(1, seed=13, wh=wh))
    assert prediction.feature_wh == (wh[0] // 4, wh[1] // 4)
    assert torch.isfinite(prediction.R).all()


def test_a_pair_does_not_depend_on_its_batch():
    net, given = network(TINY), pairs(3, seed=14)
    alone = predict(net, {name: x[1:2] for name, x in given.items()})
    torch.testing.assert_close(alone.R[0], predict(net, given).R[1], rtol=0, atol=1e-6)


def test_half_precision_leaves_the_geometry_in_double():
    net, given = network(TINY), pairs(1, seed=15)
    with torch.autocast("cpu", torch.bfloat16):
        prediction = predict(net, given)
    assert prediction.R.dtype == torch.float64
    product = prediction.R @ prediction.R.mT
    torch.testing.assert_close(product[0], torch.eye(3).double(), rtol=0, atol=1e-13)


def test_an_image_beyond_the_memory_limit_is_refused_with_its_cost():
    net = network(replace(TINY, max_tokens=200))
    with pytest.raises(UserError, match=r"96x64 px have 384 feature pixels, expected at most 200"):
        predict(net, pairs(1, seed=16, wh=(96, 64)))


def test_an_image_too_small_for_features_is_refused():
    with pytest.raises(UserError, match=r"40x12 px are too small: expected at least 16 px"):
        predict(network(TINY), pairs(1, seed=17, wh=(40, 12)))


def test_a_second_pass_starts_from_the_first_ones_rotation():
    arguments = pairs(2, seed=3)
    once, twice = (network(replace(TINY, passes=n)) for n in (1, 2))
    first = predict(once, arguments)
    second = predict(once, {**arguments, "R_init": first.R})
    assert (second.R - first.R).abs().max() > 1e-6
    torch.testing.assert_close(predict(twice, arguments).R, second.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(predict(twice.train(), arguments).R, first.R, rtol=0, atol=1e-12)
