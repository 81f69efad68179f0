"""Ground truth as rays: exact through sub-sampling, turning, swapping and mirroring."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_set import PAIRS, make_frame, write_set

import flowrect
from flowrect import geometry as g
from flowrect.correspondences import Correspondences, collate, from_flow, from_frame
from flowrect.drectify import Rectification, rectify
from flowrect.losses import rectified_vertical_flow
from simgen.flowfield import flow_from_depth
from simgen.geometry import intrinsics, inverse, project, transform
from simgen.schema import AT_INFINITY, OUT_OF_FRAME, VISIBLE
from simgen.shards import ShardSet

FRAME = make_frame(1)


def truth_of(pair: int, *, num: int | None = None) -> Correspondences:
    left, right = PAIRS[pair]
    return from_flow(
        FRAME["flow"][pair], FRAME["flow_status"][pair], FRAME["depth"][left],
        FRAME["K"][left], FRAME["K"][right], num=num,
    )  # fmt: skip


def pose_of(pair: int) -> tuple[np.ndarray, np.ndarray]:
    left, right = PAIRS[pair]
    T = inverse(FRAME["T_world_cam"][right]) @ FRAME["T_world_cam"][left]
    return T[:3, :3], T[:3, 3]


def check_rays_meet(c: Correspondences, R: np.ndarray, t: np.ndarray) -> None:
    """Right ray = direction of R X + t for the left point X, of R x for points at infinity."""
    finite = c.depth > 0
    scale = np.where(finite, c.depth, 1.0)[:, None]
    X_right = scale * c.rays_left @ R.T + np.where(finite[:, None], t, 0.0)
    # float32 flow: 96 px have a last digit of 4e-6 px
    assert np.abs(X_right / np.abs(X_right[:, 2:]) - c.rays_right).max() < 2e-6


@pytest.mark.parametrize("pair", [0, 1, 2])
def test_rays_of_a_pair_meet_at_their_depth(pair):
    check_rays_meet(truth_of(pair), *pose_of(pair))


def test_all_pixels_are_taken_row_by_row_when_no_number_is_asked_for():
    c = truth_of(0)
    h, w = FRAME["depth"].shape[1:]
    assert c.depth.shape == (h * w,)
    uv = project(FRAME["K"][0], c.rays_left)
    np.testing.assert_allclose(uv[w + 3], (3, 1), atol=1e-12)
    np.testing.assert_array_equal(c.depth, FRAME["depth"][0].reshape(-1))


def test_status_bits_become_masks():
    c, status = truth_of(2), FRAME["flow_status"][2].reshape(-1)
    np.testing.assert_array_equal(c.visible, (status & VISIBLE) > 0)
    np.testing.assert_array_equal(c.in_frame, (status & OUT_OF_FRAME) == 0)
    np.testing.assert_array_equal(c.depth == 0, (status & AT_INFINITY) > 0)
    assert {c.visible.dtype, c.in_frame.dtype} == {np.dtype(bool)}


def test_sub_grid_is_a_regular_and_centred_part_of_all_pixels():
    every, some = truth_of(1), truth_of(1, num=200)
    assert 140 <= len(some.depth) <= 290
    uv = project(FRAME["K"][1], some.rays_left).round().astype(int)
    steps = {tuple(np.unique(np.diff(np.unique(uv[:, i])))) for i in (0, 1)}
    assert len(steps) == 1
    h, w = FRAME["depth"].shape[1:]
    margin_low, margin_high = uv.min(0), np.array([w - 1, h - 1]) - uv.max(0)
    assert np.abs(margin_low - margin_high).max() <= 1
    index = uv[:, 1] * w + uv[:, 0]
    np.testing.assert_array_equal(every.subset(index).rays_right, some.rays_right)
    np.testing.assert_array_equal(every.subset(index).depth, some.depth)


def test_point_behind_the_right_camera_has_a_ray_that_points_back():
    K = intrinsics((16, 8), 90.0)
    depth = np.full((8, 16), 2.0, np.float32)
    T = transform(np.eye(3), np.array([0.0, 0.0, -3.0]))  # right camera 3 m ahead of the left
    flow = flow_from_depth(depth, K, K, T)
    status = np.full((8, 16), OUT_OF_FRAME, np.uint8)
    c = from_flow(flow, status, depth, K, K)
    np.testing.assert_array_equal(c.rays_right, np.tile([0.0, 0, -1], (128, 1)))
    assert not c.in_frame.any()
    uv = g.project(torch.as_tensor(K), torch.as_tensor(c.rays_right))
    assert not g.inside(uv, (16, 8)).any()


def test_turned_cameras_see_the_same_points_from_the_turned_pose():
    c, (R, t) = truth_of(2), pose_of(2)
    left, right = Rotation.from_rotvec([[2.0, -3, 1], [-1, 4, 5]], degrees=True).as_matrix()
    turned = c.rotated(left=left, right=right)
    R_new, t_new = g.rotated(*(torch.as_tensor(x) for x in (R, t, )), left=torch.as_tensor(left),
                             right=torch.as_tensor(right))  # fmt: skip
    check_rays_meet(turned, R_new.numpy(), t_new.numpy())
    np.testing.assert_array_equal(turned.depth == 0, c.depth == 0)
    back = turned.rotated(left=left.T, right=right.T)
    np.testing.assert_allclose(back.rays_left, c.rays_left, atol=1e-14)
    np.testing.assert_allclose(back.rays_right, c.rays_right, atol=1e-14)
    np.testing.assert_allclose(back.depth, c.depth, rtol=1e-14)


def test_homography_of_the_image_and_turned_rays_agree():
    K, c = FRAME["K"][0], truth_of(0)
    turn = Rotation.from_rotvec([1.0, -2, 3], degrees=True).as_matrix()
    h = np.concatenate([project(K, c.rays_left), np.ones((len(c.depth), 1))], axis=1)
    moved = h @ (K @ turn @ np.linalg.inv(K)).T
    uv = project(K, c.rotated(left=turn).rays_left)
    np.testing.assert_allclose(uv, moved[:, :2] / moved[:, 2:], atol=1e-10)


def test_swapped_pair_sees_the_same_points_from_the_swapped_pose():
    c, (R, t) = truth_of(0), pose_of(0)
    R_swap, t_swap = R.T, -R.T @ t
    swapped = c.swapped(R, t)
    finite = c.depth > 0
    X_right = c.depth[:, None] * c.rays_left @ R.T + t
    np.testing.assert_allclose(swapped.depth[finite], X_right[finite, 2], rtol=1e-12)
    np.testing.assert_array_equal(swapped.depth[~finite], 0.0)
    np.testing.assert_array_equal(swapped.rays_left, c.rays_right)
    again = swapped.swapped(R_swap, t_swap)
    np.testing.assert_array_equal(again.rays_left, c.rays_left)
    np.testing.assert_allclose(again.depth[finite & (c.depth < 20)],
                               c.depth[finite & (c.depth < 20)], rtol=1e-4)  # fmt: skip


def test_mirrored_pair_is_seen_in_mirrored_pixels():
    c, K = truth_of(0, num=100), FRAME["K"][0]
    before = c.rays_left.copy()
    uv, mirrored = project(K, c.rays_left), project(K, c.mirrored().rays_left)
    w = FRAME["depth"].shape[2]
    np.testing.assert_allclose(mirrored, np.stack([w - 1 - uv[:, 0], uv[:, 1]], axis=1))
    np.testing.assert_array_equal(c.rays_left, before)


def test_every_method_gives_the_same_for_arrays_and_batches():
    c, (R, t) = truth_of(0, num=100), pose_of(0)
    batch = collate([c, c])
    turn = Rotation.from_rotvec([1.0, -2, 3], degrees=True).as_matrix()
    many = [torch.as_tensor(np.stack([x, x])) for x in (turn, R, t)]
    results = (
        (c.rotated(left=turn, right=turn), batch.rotated(left=many[0], right=many[0])),
        (c.swapped(R, t), batch.swapped(many[1], many[2])),
        (c.mirrored(), batch.mirrored()),
        (c.subset([5, 3]), batch.subset([5, 3])),
        (c, batch.to("cpu")),
    )
    for single, both in results:
        for name in ("rays_left", "rays_right", "visible", "in_frame", "depth"):
            expected = torch.as_tensor(np.stack([getattr(single, name)] * 2))
            torch.testing.assert_close(getattr(both, name), expected, rtol=1e-14, atol=1e-14)


def test_pairs_of_unequal_number_are_not_stacked():
    with pytest.raises(ValueError, match=r"pairs have \[\d+, 5184\] correspondences, expected one"):
        collate([truth_of(0), truth_of(0, num=50)])


@pytest.mark.parametrize("stored_flow", [True, False])
def test_shards_give_the_same_correspondences_with_and_without_stored_flow(tmp_path, stored_flow):
    frame = ShardSet(write_set(tmp_path, [FRAME], flow=stored_flow))[0]
    c, expected = from_frame(frame, 2, num=300), truth_of(2, num=300)
    np.testing.assert_array_equal(c.rays_left, expected.rays_left)
    np.testing.assert_array_equal(c.rays_right, expected.rays_right)
    np.testing.assert_array_equal(c.depth, expected.depth)


@pytest.mark.parametrize("pair", [0, 1, 2])
def test_true_pose_leaves_no_vertical_flow(pair, worst):
    left, right = PAIRS[pair]
    wh = FRAME["depth"].shape[:0:-1]
    R, t, K_left, K_right = (
        torch.as_tensor(x)[None] for x in (*pose_of(pair), FRAME["K"][left], FRAME["K"][right])
    )
    rect = rectify(R, t, K_left, K_right, wh)
    flow, counted = rectified_vertical_flow(rect, collate([truth_of(pair)]), wh)
    assert counted.float().mean() > 0.5
    worst("vertical flow after rectification by the true pose", flow, 1e-3)


def test_no_augmentation_makes_the_truth_inexact(worst):
    c, wh = collate([truth_of(0)]), FRAME["depth"].shape[:0:-1]
    R, t, K_left, K_right = (
        torch.as_tensor(x)[None] for x in (*pose_of(0), FRAME["K"][0], FRAME["K"][1])
    )
    turns = Rotation.from_rotvec([[1.5, -2, 1], [-1, 2, -2]], degrees=True).as_matrix()
    left, right = (torch.as_tensor(x)[None] for x in turns)
    c, (R, t) = c.rotated(left=left, right=right), g.rotated(R, t, left=left, right=right)
    mirrored = g.mirrored_swap(R, t, K_left, K_right, wh[0])
    cases = {
        "turned": (c, (R, t, K_left, K_right)),
        "swapped": (c.swapped(R, t), (*g.swapped(R, t), K_right, K_left)),
        "mirrored": (c.swapped(R, t).mirrored(), mirrored),
    }
    for name, (truth, rig) in cases.items():
        flow, counted = rectified_vertical_flow(rectify(*rig, wh), truth, wh)
        assert counted.float().mean() > 0.5
        worst(f"vertical flow of a {name} pair, true pose", flow, 1e-5)


def test_correspondences_need_no_torch():
    code = "import sys; from flowrect import Correspondences; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_unknown_name_is_refused_with_those_that_exist():
    with pytest.raises(
        AttributeError, match=r"flowrect has no 'Rectifcation'; it has .*Rectification"
    ):
        flowrect.Rectifcation  # noqa: B018
    assert flowrect.Rectification is Rectification
