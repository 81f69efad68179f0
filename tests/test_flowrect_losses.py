"""Losses against hand arithmetic and brute force; what each sees of an error; finite gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from analytic_pairs import WH, AnalyticPairs, analytic_pairs

from flowrect.drectify import Rectification, rectified_uv, rectify
from flowrect.geometry import cropped, inside, project, rotation_from_vector
from flowrect.losses import (
    image_flow_loss,
    matching_loss,
    rectified_vertical_flow,
    rotation_loss,
    vertical_flow_loss,
)

EYE = torch.eye(3, dtype=torch.float64)


def off_by(pairs: AnalyticPairs, error_deg: tuple[float, float, float]) -> Rectification:
    """Rectification by the true pose, its rotation off by so much in the right camera's axes."""
    error = rotation_from_vector(torch.tensor(error_deg).double().deg2rad())
    return rectify(error.mT @ pairs.R, pairs.t, pairs.K_left, pairs.K_right, WH)


def flow_loss(rect: Rectification, pairs: AnalyticPairs) -> torch.Tensor:
    return vertical_flow_loss(rect, pairs.truth, pairs.K_left, pairs.K_right, WH)


def test_rotation_loss_is_ten_times_the_sum_of_entries():
    R = torch.stack([EYE, EYE])
    other = R.clone()
    other[0, 0, 1], other[1, 2, 2] = 0.3, 0.5
    torch.testing.assert_close(rotation_loss(R, other), torch.tensor(10 * (0.3 + 0.5) / 2).double())
    assert rotation_loss(R, R) == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotation_loss_is_about_a_third_per_degree_about_any_axis(axis):
    w = torch.zeros(1, 3, dtype=torch.float64)
    w[0, axis] = np.deg2rad(1.0)
    assert rotation_loss(EYE[None], rotation_from_vector(w)).item() == pytest.approx(0.35, abs=5e-3)


@pytest.mark.parametrize("vertical", [False, True])
def test_true_pose_has_no_flow_loss(vertical):
    pairs = analytic_pairs(4, seed=1, vertical=vertical)
    rect = off_by(pairs, (0, 0, 0))
    assert (rect.vertical == vertical).all()
    assert flow_loss(rect, pairs) < 1e-12


def test_flow_loss_sees_pitch_best_and_yaw_least():
    pairs = analytic_pairs(4, seed=2)
    pitch, yaw, roll = (flow_loss(off_by(pairs, tuple(e)), pairs) for e in EYE)
    # First order, points at infinity, uniform in the image: f·ω, f·ω·E|x y|, f·ω·E|x|
    f, (w, h) = float(pairs.K_left[0, 0, 0]), WH
    per_degree = 0.1 * f * np.deg2rad(1.0)
    assert pitch.item() == pytest.approx(per_degree, rel=0.15)
    assert roll.item() == pytest.approx(per_degree * w / (4 * f), rel=0.25)
    assert yaw.item() == pytest.approx(per_degree * w * h / (16 * f**2), rel=0.35)


def test_vertical_flow_of_far_points_is_that_of_the_small_angle_formula(worst):
    """dv = f (−ωx (1 + y²) + ωy x y + ωz x), with x, y the rectified left point over f."""
    pairs = analytic_pairs(3, seed=12)
    w = (1e-3, -2e-3, 3e-3)
    rect = off_by(pairs, tuple(np.rad2deg(w)))
    flow, counted = rectified_vertical_flow(rect, pairs.truth, WH)
    uv = rectified_uv(pairs.truth.rays_left, rect.R_left, rect.K_new)
    f = rect.K_new[:, :1, 0]
    x, y = ((uv - rect.K_new[:, None, :2, 2]) / f[..., None]).unbind(-1)
    expected = f * (-w[0] * (1 + y**2) + w[1] * x * y + w[2] * x)
    far = counted & (pairs.truth.depth == 0)
    worst("vertical flow against the small-angle formula", (flow - expected)[far], 0.02)
    assert expected[far].abs().max() > 0.2


def test_flow_loss_is_a_tenth_of_the_mean_over_counted_correspondences_by_brute_force():
    pairs = analytic_pairs(3, seed=3)
    rect = off_by(pairs, (0.5, -0.8, 1.0))
    sizes = []
    for b in range(3):
        K, R1, R2 = (x[b].numpy() for x in (rect.K_new, rect.R_left, rect.R_right))
        K_left, K_right = pairs.K_left[b].numpy(), pairs.K_right[b].numpy()
        for left, right in zip(pairs.truth.rays_left[b], pairs.truth.rays_right[b], strict=True):
            p, q = K @ R1 @ left.numpy(), K @ R2 @ right.numpy()
            taken = [K_source @ x.numpy() for K_source, x in ((K_left, left), (K_right, right))]
            ends = np.array([x[:2] / x[2] for x in (p, q, *taken)])
            if ((ends >= -0.5) & (ends < np.array(WH) - 0.5)).all():
                sizes.append(abs(ends[1, 1] - ends[0, 1]))
    assert 0 < len(sizes) < pairs.truth.depth.numel()
    loss = flow_loss(rect, pairs)
    assert loss.item() == pytest.approx(0.1 * np.mean(sizes), rel=1e-12)


def test_flow_loss_counts_nothing_on_the_border_without_image():
    """Images that are the inner three quarters: what the cut took away lies beyond their border."""
    pairs = analytic_pairs(2, seed=3)
    cut = torch.tensor([WH[0] // 8, WH[1] // 8])
    inner = (WH[0] * 3 // 4, WH[1] * 3 // 4)
    K_left, K_right = (cropped(K, *cut.tolist()) for K in (pairs.K_left, pairs.K_right))
    error = rotation_from_vector(torch.tensor([0.5, -0.8, 1.0]).double().deg2rad())
    K_new = K_left.clone()
    K_new[:, 0, 2] += 4  # shows 4 columns more on the left
    rect = rectify(error.mT @ pairs.R, pairs.t, K_left, K_right, inner, K_new=K_new)
    taken = [project(K, rays) for K, rays in
             ((K_left, pairs.truth.rays_left), (K_right, pairs.truth.rays_right))]  # fmt: skip
    shown = inside(taken[0], inner) & inside(taken[1], inner)
    flow, counted = rectified_vertical_flow(rect, pairs.truth, inner)
    assert (counted & ~shown).sum() > 20
    loss = vertical_flow_loss(rect, pairs.truth, K_left, K_right, inner)
    assert loss.item() == pytest.approx(0.1 * flow[counted & shown].abs().mean().item(), rel=1e-12)


def test_vertical_flow_keeps_its_sign():
    pairs = analytic_pairs(2, seed=4)
    # The estimate holds too little pitch: a positive turn about x (down to forward) is left over,
    # which moves what the right camera sees upwards: v_right < v_left.
    flow, counted = rectified_vertical_flow(off_by(pairs, (1.0, 0, 0)), pairs.truth, WH)
    assert (flow[counted] < 0).all()
    assert (flow[~counted] == 0).all()


def test_flow_loss_of_a_hopeless_estimate_is_zero_and_its_gradient_finite():
    pairs = analytic_pairs(2, seed=5)
    w = torch.tensor([[0.0, 3.0, 0.0]] * 2).double().requires_grad_()
    rect = rectify(rotation_from_vector(w) @ pairs.R, pairs.t, pairs.K_left, pairs.K_right, WH,
                   K_new=pairs.K_left)  # fmt: skip
    loss = flow_loss(rect, pairs)
    assert loss == 0
    loss.backward()
    assert w.grad.isfinite().all()


def test_gradients_of_the_flow_loss_are_those_of_finite_differences():
    pairs = analytic_pairs(2, seed=6)

    def loss(w: torch.Tensor) -> torch.Tensor:
        R = rotation_from_vector(w) @ pairs.R
        rect = rectify(R, pairs.t, pairs.K_left, pairs.K_right, WH, K_new=pairs.K_left)
        return flow_loss(rect, pairs)

    w = torch.tensor([[0.01, 0.02, -0.01], [-0.02, 0.01, 0.015]]).double().requires_grad_()
    assert torch.autograd.gradcheck(loss, (w,))


def test_descending_both_losses_finds_the_true_rotation():
    pairs = analytic_pairs(2, seed=7, num=100)
    w = torch.full((2, 3), 0.01, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([w], lr=1e-3)
    for step in range(40):
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * 0.88**step
        R = rotation_from_vector(w) @ pairs.R
        rect = rectify(R, pairs.t, pairs.K_left, pairs.K_right, WH)
        loss = rotation_loss(pairs.R, R) + flow_loss(rect, pairs)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert w.abs().max() < np.deg2rad(0.02)


def test_flow_of_a_network_is_averaged_over_valid_pixels_of_the_right_component():
    flow = torch.stack([torch.full((2, 2, 3), 5.0), torch.full((2, 2, 3), -3.0)], dim=1)
    flow[:, :, 0, 0] = 100.0
    valid = torch.ones(2, 1, 2, 3, dtype=torch.bool)
    valid[:, :, 0, 0] = False
    assert image_flow_loss(flow, valid, torch.tensor([False, False])).item() == pytest.approx(0.3)
    assert image_flow_loss(flow, valid, torch.tensor([True, False])).item() == pytest.approx(0.4)
    assert image_flow_loss(flow, ~valid & valid, torch.tensor([True, True])) == 0


# --- matches -----------------------------------------------------------------------------------


def features_of(pairs: AnalyticPairs, scale: float) -> tuple[Rectification, tuple[int, int]]:
    return off_by(pairs, (0, 0, 0)).resized(scale), (int(WH[0] * scale), int(WH[1] * scale))


def test_uniform_matches_cost_the_logarithm_of_their_number():
    pairs = analytic_pairs(2, seed=8)
    rect, (w, h) = features_of(pairs, 1 / 8)
    uniform = torch.full((2, w * h, w * h), 1 / (w * h)).log()
    loss = matching_loss(uniform, pairs.truth, rect, (w, h))
    assert loss.item() == pytest.approx(np.log(w * h), rel=1e-5)


def test_descending_the_matching_loss_puts_the_expected_match_at_the_true_displacement():
    pairs = analytic_pairs(1, seed=9)
    rect, (w, h) = features_of(pairs, 1 / 8)
    scores = torch.zeros(1, w * h, w * h, requires_grad=True)
    optimiser = torch.optim.Adam([scores], lr=0.5)
    for _ in range(100):
        loss = matching_loss(scores.log_softmax(-1), pairs.truth, rect, (w, h))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    taught = scores.grad.abs().sum(-1)[0] > 0
    assert taught.sum() > 0.5 * w * h
    v, u = (x.flatten().float() for x in torch.meshgrid(torch.arange(h), torch.arange(w),
                                                        indexing="ij"))  # fmt: skip
    matches = scores.detach().softmax(-1)[0]
    dv = (matches @ v - v)[taught]
    du = (matches @ u - u)[taught]
    assert dv.abs().max() < 0.02  # rectified: matches lie in the same row
    assert (du < 0.02).all()  # and never to the right
    assert du.min() < -0.3


def test_only_visible_correspondences_teach_matches():
    pairs = analytic_pairs(2, seed=10)
    rect, (w, h) = features_of(pairs, 1 / 8)
    scores = torch.randn(2, w * h, w * h, generator=torch.Generator().manual_seed(0))
    hidden = pairs.truth.__class__(
        pairs.truth.rays_left, pairs.truth.rays_right, torch.zeros_like(pairs.truth.visible),
        pairs.truth.in_frame, pairs.truth.depth,
    )  # fmt: skip
    assert matching_loss(scores.log_softmax(-1), hidden, rect, (w, h)) == 0
    assert matching_loss(scores.log_softmax(-1), pairs.truth, rect, (w, h)) > 1


def test_match_between_features_is_shared_by_bilinear_weights():
    """One correspondence from the centre of feature (2, 1) to (1.25, 1.5) of a 4 × 3 map."""
    pairs = analytic_pairs(1, seed=11)
    K = torch.tensor([[[10.0, 0, 0], [0, 10, 0], [0, 0, 1]]]).double()
    rect = Rectification(EYE[None], EYE[None], K, torch.tensor([False]))
    truth = pairs.truth.subset([0])
    truth.rays_left[:] = torch.tensor([0.2, 0.1, 1])
    truth.rays_right[:] = torch.tensor([0.125, 0.15, 1])
    truth.visible[:] = True
    log_matches = torch.randn(1, 12, 12, generator=torch.Generator().manual_seed(1)).log_softmax(-1)
    row = log_matches[0, 1 * 4 + 2]
    expected = -(0.375 * (row[5] + row[9]) + 0.125 * (row[6] + row[10]))
    torch.testing.assert_close(matching_loss(log_matches, truth, rect, (4, 3)), expected.double())
