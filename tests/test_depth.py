"""Depth of a rectified pair: its geometry, errors by range, and matchers that need no training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info
from onnx.numpy_helper import from_array
from planes import BASELINE_M, WH, K, along_x, planar_pair, plane_pair, plane_truth, turned

from flowrect.depth import load_stereo, sgbm
from flowrect.depth.frame import DepthFrame, depth_frame
from flowrect.depth_error import (
    DepthSamples,
    comparable,
    depth_samples,
    disparity_at,
    left_depth,
    matched,
)
from flowrect.drectify import Rectification, rectify
from simgen.errors import UserError

# --- geometry ----------------------------------------------------------------------------------


def rectified_by(R: torch.Tensor, t: torch.Tensor) -> tuple[Rectification, DepthFrame]:
    rect = rectify(R, t, torch.from_numpy(K)[None], torch.from_numpy(K)[None], WH,
                   K_new=torch.from_numpy(K))  # fmt: skip
    return rect, depth_frame(rect, t)


def plane_disparity(
    normal: np.ndarray, R: torch.Tensor, t: torch.Tensor, rect: Rectification
) -> np.ndarray:
    """What a perfect matcher along rows sees of that plane: u_left − u_right (H, W) [px].

    Every rectified left pixel is traced to the plane and projected into the rectified right image.
    """
    R_left, R_right = rect.R_left[0].numpy(), rect.R_right[0].numpy()
    u, v = np.meshgrid(np.arange(WH[0]), np.arange(WH[1]))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ R_left
    X_right = (rays / (rays @ normal)[..., None]) @ R[0].numpy().T + t[0].numpy()
    uvw = X_right @ R_right.T @ K.T
    return u - uvw[..., 0] / uvw[..., 2]


@pytest.mark.parametrize("angles", [(0, 0, 0), (0.7, -0.9, 1.1)])
def test_the_true_rotation_and_exact_disparity_give_the_true_depth(angles, worst):
    R, t = turned(*angles), along_x()
    normal = np.array([0.004, 0.02, 0.05])
    rect, frame = rectified_by(R, t)
    samples = depth_samples(plane_disparity(normal, R, t, rect), frame, plane_truth(normal, R, t))
    answered = np.isfinite(samples.estimated_m)
    assert answered.mean() > 0.9
    worst("depth by the truth", (samples.estimated_m - samples.true_m)[answered], 1e-8, "m")


def test_points_are_those_of_opencv(worst):
    """cv2.reprojectImageTo3D, then the left camera frame by R_leftᵀ."""
    R, t = turned(0.4, 1.0, -0.8), along_x()
    rect, frame = rectified_by(R, t)
    disparity = np.float32(np.random.default_rng(0).uniform(3, 40, WH[::-1]))
    Q = np.eye(4)
    Q[:, 3] = [-K[0, 2], -K[1, 2], K[0, 0], 0]
    Q[2:, 2:] = [[0, K[0, 0]], [1 / frame.baseline_m, 0]]
    inner = (slice(1, -1), slice(1, -1))
    X_rect = cv2.reprojectImageTo3D(disparity, Q)[inner].reshape(-1, 3).astype(float)
    X_left = X_rect @ rect.R_left[0].numpy()
    depth = left_depth(disparity, frame, X_left / X_left[:, 2:])
    worst("depth against OpenCV's points", depth / X_left[:, 2] - 1, 1e-5, "-")


@pytest.mark.parametrize("yaw_deg", [0.05, -0.1])
def test_a_yaw_error_changes_inverse_depth_by_the_closed_form(yaw_deg, worst):
    """R_est = exp(ω ŷ) R: 1/z grows by ω (1 + x²) / b, whatever the depth; here 100 m."""
    normal, R, t = np.array([0, 0, 0.01]), turned(), along_x()
    rect, frame = rectified_by(turned(y=yaw_deg), t)
    truth = plane_truth(normal, R, t)
    samples = depth_samples(plane_disparity(normal, R, t, rect), frame, truth)
    expected = np.deg2rad(yaw_deg) * (1 + truth.rays_left[:, 0] ** 2) / BASELINE_M
    found = 1 / samples.estimated_m - 1 / samples.true_m
    known = np.isfinite(found)
    assert known.mean() > 0.9
    worst("inverse depth of a yaw error", (found / expected - 1)[known], 0.02, "-")


def test_a_yaw_error_biases_the_mean_and_leaves_coverage():
    normal, R, t = np.array([0, 0, 1 / 60]), turned(), along_x()
    truth = plane_truth(normal, R, t)
    rows = []
    for yaw_deg in (-0.1, 0.0, 0.1):
        rect, frame = rectified_by(turned(y=yaw_deg), t)
        samples = depth_samples(plane_disparity(normal, R, t, rect), frame, truth)
        rows.append(samples.by_range()[3])
    assert rows[0].bias_m > 3
    assert rows[1].bias_m == pytest.approx(0, abs=1e-9)
    assert rows[2].bias_m < -3
    assert min(row.coverage for row in rows) > 0.98


def test_a_pitch_error_makes_matching_fail():
    R, t = turned(0.3, -0.4, 0.5), along_x()
    pair = plane_pair(R, t, np.array([0.002, 0.02, 0.08]))
    rows = {}
    for pitch_deg in (0.0, 2.0):
        rect, frame = rectified_by(turned(x=pitch_deg) @ R, t)
        match = load_stereo("sgbm", largest_px=frame.largest_disparity(5.0))
        found = matched(pair, rect, frame, match)
        [rows[pitch_deg]] = found.samples(comparable(pair)).by_range((0, 300))
    good, bad = rows[0.0], rows[2.0]
    assert good.coverage > 0.9
    assert good.median_m < 0.15  # at 12 m, where a sixteenth of a pixel is 0.06 m
    assert bad.answered < 0.5 * good.answered
    assert bad.median_m > 5 * good.median_m


# --- looking up, summing up --------------------------------------------------------------------


def test_lookup_is_exact_on_planes_and_takes_one_side_of_an_edge(worst):
    v, u = np.mgrid[:8, :10]
    plane = 5 + 0.3 * u - 0.2 * v
    uv = np.random.default_rng(0).uniform(0, (9, 7), (200, 2))
    worst("lookup on a plane", disparity_at(plane, uv) - (5 + uv @ (0.3, -0.2)), 1e-12)
    step = np.where(u < 5, 3.0, 40.0)
    assert set(disparity_at(step, uv).round(9)) == {3.0, 40.0}


def test_lookup_of_the_unknown_is_unknown():
    disparity = np.ones((4, 4))
    disparity[1, 1] = np.nan
    uv = np.array([[1.2, 1.2], [1.6, 1.6], [-0.1, 2], [3.1, 2], [3, 3], [0, 0]])
    np.testing.assert_array_equal(
        np.isnan(disparity_at(disparity, uv)), [True, False, True, True, False, False]
    )


def test_by_range_agrees_with_loops():
    rng = np.random.default_rng(1)
    true, estimated = rng.uniform(0, 120, 500), rng.uniform(0, 150, 500)
    estimated[rng.random(500) < 0.2] = np.nan
    for row in DepthSamples(true, estimated).by_range((0, 30, 100)):
        pairs = [(a, b) for a, b in zip(true, estimated, strict=True) if row.from_m <= a < row.to_m]
        errors = [min(b, 100) - a for a, b in pairs if b == b]
        assert (row.pixels, row.answered) == (len(pairs), len(errors))
        assert row.mae_m == pytest.approx(sum(map(abs, errors)) / len(errors))
        assert row.bias_m == pytest.approx(sum(errors) / len(errors))
        assert row.median_m == pytest.approx(np.median(np.abs(errors)))


def test_infinity_counts_as_the_end_of_the_last_range():
    frame = DepthFrame(np.eye(3), K, BASELINE_M)
    disparity = np.array([0.0, -3.0, np.nan, 1.0])
    depth = frame.rectified_depth(disparity)
    np.testing.assert_array_equal(depth, [np.inf, np.inf, np.nan, frame.focal_baseline])
    [row] = DepthSamples(np.full(4, 100.0), depth).by_range((0, 300))
    assert (row.answered, row.mae_m) == (3, pytest.approx((200 + 200 + 44) / 3))


def test_a_range_without_pixels_has_no_figures():
    [row] = DepthSamples(np.zeros(0), np.zeros(0)).by_range((0, 1))
    assert (row.pixels, row.answered) == (0, 0)
    assert np.isnan([row.mae_m, row.median_m, row.bias_m, row.coverage]).all()


def test_only_what_both_cameras_see_at_a_finite_depth_is_compared():
    pair = plane_pair(turned(), along_x(), np.array([0, 0, 0.1]))
    truth = pair.truth
    assert truth is not None
    whole = len(comparable(pair).depth)
    seen = np.random.default_rng(0).random(len(truth.depth)) < 0.5
    depth = np.where(np.arange(len(seen)) % 7 == 0, 0.0, truth.depth)
    truth = replace(truth, visible=truth.visible & seen, depth=depth)
    some = comparable(replace(pair, truth=truth))
    assert 0 < len(some.depth) < whole
    assert (some.depth > 0).all()
    assert some.visible.all()


def test_pixels_that_a_crop_cut_off_are_not_asked_for():
    R, t = turned(), along_x()
    pair = plane_pair(R, t, np.array([0, 0, 0.1]))
    assert pair.truth is not None
    u_right = 96 * pair.truth.rays_right[:, 0] + 95.5
    expected = pair.truth.rays_left[u_right >= -0.5]
    assert 0 < len(expected) < len(u_right)
    np.testing.assert_array_equal(comparable(pair).rays_left, expected)


def test_a_pair_without_depth_is_refused():
    pair = replace(plane_pair(turned(), along_x(), np.array([0, 0, 0.1])), truth=None)
    with pytest.raises(UserError, match="plane: has no depth to compare with"):
        comparable(pair)


@pytest.mark.parametrize("t", [(1.5, 0.0, 0.0), (0.1, -1.5, 0.0)])
def test_a_rig_whose_left_camera_is_not_the_left_one_is_refused(t):
    with pytest.raises(UserError, match="expected it to the right"):
        rectified_by(turned(), torch.tensor([t], dtype=torch.float64))


# --- SGBM --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "back, front",
    [((9.3, 0, 0), (25.6, 0, 0)), ((6.0, 0.02, 0.05), (30.0, -0.03, 0.02))],
    ids=["fronto-parallel", "slanted"],
)
def test_block_matching_finds_planes_to_a_quarter_pixel_and_no_occluded_ones(back, front, worst):
    pair = planar_pair(back, front, (90, 30, 150, 90), wh=(256, 128), seed=0)
    found = sgbm.disparity(pair.left, pair.right, largest_px=48)
    error = (found - pair.disparity)[pair.visible]
    known = np.isfinite(error)
    assert known.mean() > 0.93
    worst("median error of SGBM", np.median(np.abs(error[known])), 0.25)
    assert np.mean(np.abs(error[known]) > 1) < 0.02
    assert np.isnan(found[~pair.visible]).mean() > 0.6


def test_pixels_near_the_left_border_are_matched_too():
    """OpenCV alone answers none of the first num_disparities columns."""
    pair = planar_pair((8.0, 0, 0), wh=(256, 64), seed=1)
    found = sgbm.disparity(pair.left, pair.right, largest_px=100)
    assert np.isfinite(found[:, 14:100]).mean() > 0.95
    assert np.isnan(found[:, :7]).mean() > 0.9


def test_no_match_lies_outside_the_right_image():
    noise = np.random.default_rng(0).integers(0, 255, (2, 64, 128, 3), dtype=np.uint8)
    found = sgbm.disparity(*noise, largest_px=60)
    assert not (np.arange(128) - found < -0.5).any()
    assert found.dtype == np.float32


# --- networks from elsewhere -------------------------------------------------------------------


def onnx_file(path: Path, *, weight: np.ndarray, hw: tuple = ("h", "w"), inputs: int = 2) -> Path:
    """One convolution (1, 6, 3, 3) of both images."""
    names = ["left", "right", "more"][:inputs]
    image = [make_tensor_value_info(n, TensorProto.FLOAT, [1, 3, *hw]) for n in names]
    nodes = [
        make_node("Concat", names, ["both"], axis=1),
        make_node("Conv", ["both", "weight"], ["disparity"], pads=[1, 1, 1, 1]),
    ]
    answer = make_tensor_value_info("disparity", TensorProto.FLOAT, [1, "c", *hw])
    graph = make_graph(nodes, "tiny", image, [answer], [from_array(weight, "weight")])
    onnx.save(make_model(graph, opset_imports=[make_opsetid("", 17)], ir_version=9), path)
    return path


def noise_images(hw: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (2, *hw, 3), dtype=np.uint8)


def random_weight(outputs: int = 1, channels: int = 6) -> np.ndarray:
    return np.random.default_rng(1).random((outputs, channels, 3, 3), dtype=np.float32)


def test_an_onnx_file_answers_what_its_operators_say(tmp_path, monkeypatch, worst):
    weight = random_weight()
    path = onnx_file(tmp_path / "tiny.onnx", weight=weight)
    left, right = noise_images((40, 50))
    found = load_stereo("onnx", largest_px=9, weights=str(path))(left, right)
    both = torch.from_numpy(np.concatenate([left, right], -1)).permute(2, 0, 1)[None].float()
    expected = torch.nn.functional.conv2d(both, torch.from_numpy(weight), padding=1)[0, 0].numpy()
    assert found.shape == (40, 50)
    inner = (slice(None, -1), slice(None, -1))  # the last ones see the padding
    worst("ONNX against torch", found[inner] / expected[inner] - 1, 1e-4, "-")
    monkeypatch.setenv("FLOWRECT_STEREO_ONNX", str(path))
    np.testing.assert_array_equal(load_stereo("onnx", largest_px=9)(left, right), found)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"weight": random_weight(2)}, r"its first output is \(1, 2, 64, 64\), expected"),
        (
            {"weight": random_weight(), "hw": (32, 96)},
            "takes images of 96x32 only, these are 50x40",
        ),
        (
            {"weight": random_weight(), "hw": ("h", 96)},
            "takes images of 96xh only, these are 50x40",
        ),
        ({"weight": random_weight(1, 9)}, "tiny.onnx cannot be run on images of 64x64 .*Conv"),
        ({"weight": random_weight(1, 9), "inputs": 3}, "expected two of float32"),
    ],
    ids=["channels", "size", "width", "raises", "inputs"],
)
def test_an_onnx_file_that_breaks_the_contract_is_refused(changes, message, tmp_path):
    path = onnx_file(tmp_path / "tiny.onnx", **changes)
    with pytest.raises(UserError, match=message):
        load_stereo("onnx", largest_px=9, weights=str(path))(*noise_images((40, 50)))


def test_what_is_no_onnx_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.delenv("FLOWRECT_STEREO_ONNX", raising=False)
    torch.save({}, tmp_path / "dlnr.pth")
    for weights, message in (
        (str(tmp_path / "dlnr.pth"), "is no ONNX file that onnxruntime runs"),
        (str(tmp_path / "absent.onnx"), "no weights, .*: no such file. Nothing is fetched"),
        ("", "no file is named. Nothing is fetched"),
    ):
        with pytest.raises(UserError, match=message):
            load_stereo("onnx", largest_px=9, weights=weights)


def test_an_unknown_matcher_is_refused():
    with pytest.raises(UserError, match="stereo matcher 'x': expected one of sgbm, hitnet, onnx"):
        load_stereo("x", largest_px=10)
