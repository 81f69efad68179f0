"""Metrics: what each says of a known error, and what none may say."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from analytic_pairs import F_PX, WH, AnalyticPairs, analytic_pairs

from flowrect import metrics
from flowrect.drectify import Rectification, rectify
from flowrect.geometry import inside, project, rotation_from_vector
from flowrect.losses import vertical_flow_loss

EYE = torch.eye(3, dtype=torch.float64)


def estimate_off_by(pairs: AnalyticPairs, error_deg: tuple[float, ...]) -> torch.Tensor:
    error = rotation_from_vector(torch.tensor(error_deg).double().deg2rad())
    return error.mT @ pairs.R


def rectification(pairs: AnalyticPairs, R: torch.Tensor) -> Rectification:
    return rectify(R, pairs.t, pairs.K_left, pairs.K_right, WH, K_new=pairs.K_left[0])


def test_angles_and_geodesic_name_the_error_in_degrees():
    pairs = analytic_pairs(3, seed=1)
    error = (0.3, -1.2, 0.4)
    R = estimate_off_by(pairs, error)
    expected = torch.tensor([error] * 3).double()
    torch.testing.assert_close(metrics.angles_deg(pairs.R, R), expected, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(metrics.geodesic_deg(pairs.R, R), torch.full((3,), 1.3).double(),
                               rtol=1e-6, atol=1e-7)  # fmt: skip


def test_float32_estimates_are_measured_in_float64():
    assert metrics.geodesic_deg(EYE[None].float(), EYE[None].float()).dtype == torch.float64


@pytest.mark.parametrize("vertical", [False, True])
def test_true_rotation_has_no_vertical_flow_and_no_rotation_some(vertical):
    pairs = analytic_pairs(4, seed=2, vertical=vertical)
    rect = rectification(pairs, pairs.R)
    assert (metrics.exact_vertical_flow(rect, pairs.truth, WH) < 1e-11).all()
    before = metrics.unrectified_vertical_flow(
        pairs.truth, pairs.K_left, pairs.K_right, rect.vertical, WH
    )
    nominal = rectify(EYE.expand(4, 3, 3), pairs.t * 0 + torch.tensor([0, -0.8, 0] if vertical
                      else [-0.8, 0, 0]), pairs.K_left, pairs.K_right, WH)  # fmt: skip
    torch.testing.assert_close(metrics.exact_vertical_flow(nominal, pairs.truth, WH), before)
    assert (before > 0.1).all()


def test_vertical_flow_of_a_pair_is_a_pixel_where_the_right_camera_is_shifted_by_one():
    pairs = analytic_pairs(2, seed=3, limit_deg=0.0)
    shifted = pairs.K_right.clone()
    shifted[:, 1, 2] += torch.tensor([1.0, -2.0])
    level = torch.tensor([False, False])
    flow = metrics.unrectified_vertical_flow(pairs.truth, pairs.K_left, shifted, level, WH)
    torch.testing.assert_close(flow, torch.tensor([1.0, 2.0]).double())


def test_vertical_flow_is_what_the_loss_averages_over_what_both_images_show():
    pairs = analytic_pairs(1, seed=4)
    rect = rectification(pairs, estimate_off_by(pairs, (0.5, 0.5, 0.5)))
    shown = pairs.truth.subset(inside(project(pairs.K_right, pairs.truth.rays_right), WH)[0])
    flow = metrics.exact_vertical_flow(rect, shown, WH)
    loss = vertical_flow_loss(rect, pairs.truth, pairs.K_left, pairs.K_right, WH)
    torch.testing.assert_close(loss, 0.1 * flow[0])


def test_vertical_flow_scales_with_the_image():
    pairs = analytic_pairs(2, seed=5)
    rect = rectification(pairs, estimate_off_by(pairs, (0.5, -0.5, 0.5)))
    double = metrics.exact_vertical_flow(rect.resized(2.0), pairs.truth, (2 * WH[0], 2 * WH[1]))
    torch.testing.assert_close(double, 2 * metrics.exact_vertical_flow(rect, pairs.truth, WH))


def test_estimate_that_leaves_nothing_in_frame_has_no_vertical_flow_at_all():
    pairs = analytic_pairs(2, seed=6)
    rect = rectification(pairs, estimate_off_by(pairs, (0.0, 170.0, 0.0)))
    assert metrics.exact_vertical_flow(rect, pairs.truth, WH).isnan().all()


# --- disparity ---------------------------------------------------------------------------------


def test_yaw_error_shifts_disparity_by_focal_length_times_angle():
    pairs = analytic_pairs(1, seed=7, limit_deg=0.0)
    far = pairs.truth.subset((pairs.truth.rays_left[0, :, :2].abs() < 0.1).all(-1))
    rect_gt = rectification(pairs, pairs.R)
    for yaw_deg in (0.1, -0.4):
        rect = rectification(pairs, estimate_off_by(pairs, (0.0, yaw_deg, 0.0)))
        bias = metrics.disparity_bias(rect, rect_gt, far, WH)
        expected = torch.full((1,), -F_PX * np.deg2rad(yaw_deg)).double()
        torch.testing.assert_close(bias, expected, rtol=0.15, atol=0)


def test_vertical_rig_has_its_disparity_along_columns():
    pairs = analytic_pairs(2, seed=8, vertical=True, limit_deg=0.0)
    rect_gt = rectification(pairs, pairs.R)
    rect = rectification(pairs, estimate_off_by(pairs, (0.3, 0.0, 0.0)))
    bias = metrics.disparity_bias(rect, rect_gt, pairs.truth, WH)
    assert (bias > 0.8 * F_PX * np.deg2rad(0.3)).all()


def test_truth_has_no_bias():
    pairs = analytic_pairs(2, seed=9)
    rect = rectification(pairs, pairs.R)
    assert (metrics.disparity_bias(rect, rect, pairs.truth, WH) == 0).all()


# --- images ------------------------------------------------------------------------------------


def images(n: int, *, seed: int) -> torch.Tensor:
    noise = np.random.default_rng(seed).uniform(0, 1, (n, WH[1], WH[0], 3)).astype(np.float32)
    smooth = np.stack([cv2.GaussianBlur(x, None, 2.0) for x in noise])
    return torch.as_tensor(smooth).permute(0, 3, 1, 2)


def image_error(left, right, pairs, *rectifications) -> metrics.ImageError:
    K = pairs.K_left, pairs.K_right
    views = (metrics.rectified_views(left, right, *K, rect, WH) for rect in rectifications)
    return metrics.rectified_image_error(*views)


def test_image_error_is_that_of_opencv_on_each_view():
    pairs = analytic_pairs(1, seed=10)
    left, right = images(2, seed=10).split(1)
    rect_gt = rectification(pairs, pairs.R)
    rect = rectification(pairs, estimate_off_by(pairs, (1.0, -0.5, 0.7)))
    error = image_error(left, right, pairs, rect, rect_gt)
    sums, values = 0.0, []
    for image, side in ((left, "R_left"), (right, "R_right")):
        pixels = image[0].permute(1, 2, 0).numpy()
        K, K_new = pairs.K_left[0].numpy(), rect.K_new[0].numpy()
        views = []
        for r in (rect, rect_gt):
            R_rect = getattr(r, side)[0].numpy()
            maps, _ = cv2.initUndistortRectifyMap(K, np.zeros(5), R_rect, K_new, WH, cv2.CV_32FC2)
            inside = ((maps >= 0) & (maps <= np.array(WH) - 1)).all(-1)
            views.append((cv2.remap(pixels, maps, None, cv2.INTER_LINEAR), inside))
        (a, a_inside), (b, b_inside) = views
        sums += np.abs(a - b).mean()
        values.append(np.abs(a - b).mean(-1)[a_inside & b_inside])
    assert error.paper.item() == pytest.approx(sums, rel=1e-4)
    assert error.valid.item() == pytest.approx(np.concatenate(values).mean(), rel=1e-4)


def test_images_rectified_by_the_truth_have_no_error():
    pairs = analytic_pairs(2, seed=11)
    rect = rectification(pairs, pairs.R)
    x = images(2, seed=11)
    error = image_error(x, x, pairs, rect, rect)
    assert (error.paper == 0).all()
    assert (error.valid == 0).all()


def test_black_borders_count_in_the_papers_error_only():
    pairs = analytic_pairs(1, seed=12)
    white = torch.ones(1, 3, WH[1], WH[0])
    rect_gt = rectification(pairs, pairs.R)
    rect = rectification(pairs, estimate_off_by(pairs, (4.0, 0.0, 0.0)))
    error = image_error(white, white, pairs, rect, rect_gt)
    assert error.paper > 0.02
    assert error.valid < 1e-5


def test_rectifications_of_two_scales_are_not_compared():
    pairs = analytic_pairs(1, seed=13)
    rect = rectification(pairs, pairs.R)
    other = replace(rect, K_new=rect.K_new + torch.tensor([0.25, 0, 0]))
    with pytest.raises(ValueError, match=r"intrinsics 0\.25 px apart, expected one K_new"):
        metrics.disparity_bias(rect, other, pairs.truth, WH)


# --- summaries ---------------------------------------------------------------------------------


def test_interval_covers_the_true_mean_about_as_often_as_it_says():
    rng = np.random.default_rng(14)
    hits = 0
    for _ in range(200):
        of_scene = rng.normal(size=40)
        values = np.repeat(of_scene, 3) + 0.1 * rng.normal(size=120)
        low, high = metrics.bootstrap_interval(
            values, np.repeat(np.arange(40), 3), rng=rng, num=300
        )
        hits += low <= 0.0 <= high
    assert 175 <= hits <= 199  # 190 ± 3 standard deviations and the bootstrap's small bias


def test_pairs_of_one_scene_are_not_taken_for_independent():
    rng = np.random.default_rng(15)
    of_scene = rng.normal(size=30)
    values, scenes = np.repeat(of_scene, 10), np.repeat(np.arange(30), 10)
    by_scene = metrics.bootstrap_interval(values, scenes, rng=rng)
    by_pair = metrics.bootstrap_interval(values, np.arange(300), rng=rng)
    assert np.ptp(by_scene) == pytest.approx(np.sqrt(10) * np.ptp(by_pair), rel=0.15)


def test_one_scene_says_nothing_about_others():
    """An interval of no width would say that it says all."""
    found = metrics.bootstrap_interval([1.0, 2.0], ["a", "a"], rng=np.random.default_rng(0))
    assert np.isnan(found).all()


def test_summary_is_the_textbooks_and_repeats_with_its_seed():
    values, scenes = np.arange(101.0), np.arange(101)
    summary = metrics.summarise(values, scenes, rng=np.random.default_rng(1))
    assert (summary.mean, summary.median, summary.p95, summary.num) == (50, 50, 95, 101)
    assert summary.interval[0] < 50 < summary.interval[1]
    assert summary == metrics.summarise(values, scenes, rng=np.random.default_rng(1))


@pytest.mark.parametrize("values", [[1.0, np.nan], []])
def test_summary_refuses_what_is_no_number(values):
    bad = len(values) - 1 if values else 0
    with pytest.raises(ValueError, match=rf"{bad} of {len(values)} values are not finite"):
        metrics.summarise(values, values, rng=np.random.default_rng(0))
