"""DRectify against OpenCV, against a NumPy twin, and by the laws of rectification."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flowrect.drectify import (
    Rectification,
    new_intrinsics,
    rectified_uv,
    rectify,
    source_positions,
    warp,
)
from flowrect.geometry import rotated, rotation_from_vector, swapped, unproject

WH = (64, 36)
NO_LENS = np.zeros(5)
NUM_RIGS = 2000


@dataclass(frozen=True)
class Rigs:
    """Random pairs, as float64 tensors (n, …)."""

    R: torch.Tensor
    t: torch.Tensor
    K_left: torch.Tensor
    K_right: torch.Tensor

    def rectify(self, **kwargs: torch.Tensor) -> Rectification:
        return rectify(self.R, self.t, self.K_left, self.K_right, WH, **kwargs)

    def arrays(self, i: int) -> tuple[np.ndarray, ...]:
        return tuple(x[i].numpy() for x in (self.R, self.t, self.K_left, self.K_right))


def rigs(n: int, *, seed: int, vertical: bool = False, limit_deg: float = 15.0) -> Rigs:
    """Baselines of either sign, up to 19° off their axis; K differs between the cameras."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-limit_deg, limit_deg, (n, 3)), degrees=True)
    along = np.array([0.0, 1.0, 0.0] if vertical else [1.0, 0.0, 0.0])
    off = rng.uniform(-0.25, 0.25, (n, 3)) * (1 - along)
    sign = rng.choice([-1.0, 1.0], (n, 1))
    # Off in the frame halfway between the cameras, where the axis is chosen.
    t = (R**0.5).apply((sign * along + off) * rng.uniform(0.1, 3.0, (n, 1)))
    K = np.tile(np.eye(3), (2, n, 1, 1))
    K[..., 0, 0], K[..., 1, 1] = rng.uniform(24, 56, (2, 2, n))
    K[..., 0, 2] = WH[0] / 2 + rng.uniform(-3, 3, (2, n))
    K[..., 1, 2] = WH[1] / 2 + rng.uniform(-3, 3, (2, n))
    return Rigs(*(torch.as_tensor(x) for x in (R.as_matrix(), t, *K)))


def opencv(
    R: np.ndarray, t: np.ndarray, K_left: np.ndarray, K_right: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(R1, R2, K_new) of stereoRectify."""
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K_left, NO_LENS, K_right, NO_LENS, WH, R, t.reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1,
    )  # fmt: skip
    np.testing.assert_array_equal(P1[:, :3], P2[:, :3])
    return R1, R2, P1[:, :3]


def numpy_twin(
    R: np.ndarray, t: np.ndarray, K_left: np.ndarray, K_right: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(R1, R2, K_new) in float64 by another route: SciPy's rotation vectors, angle and axis."""
    half = Rotation.from_rotvec(Rotation.from_matrix(R).as_rotvec() / 2)
    baseline = half.inv().apply(t)
    i = 0 if abs(baseline[0]) > abs(baseline[1]) else 1
    u = np.eye(3)[i] * np.sign(baseline[i])
    axis = np.cross(baseline, u)
    angle = np.arctan2(np.linalg.norm(axis), baseline @ u)
    W = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle)
    R1, R2 = (W * half).as_matrix(), (W * half.inv()).as_matrix()
    f = (K_left[1 - i, 1 - i] + K_right[1 - i, 1 - i]) / 2
    w, h = WH[0] - 1, WH[1] - 1
    corners = np.array([[0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1]], dtype=np.float64)
    points = [corners @ np.linalg.inv(K).T @ Q.T for K, Q in ((K_left, R1), (K_right, R2))]
    means = [(f * p[:, :2] / p[:, 2:]).mean(axis=0) for p in points]
    c = np.array([w, h]) / 2 - (means[0] + means[1]) / 2
    return R1, R2, np.array([[f, 0, c[0]], [0, f, c[1]], [0, 0, 1]])


def numpy_map(K: np.ndarray, R_rect: np.ndarray, K_new: np.ndarray) -> np.ndarray:
    """Source positions (H, W, 2), by one homography."""
    v, u = np.indices(WH[::-1], dtype=np.float64)
    p = np.stack([u, v, np.ones_like(u)], axis=-1) @ (K @ R_rect.T @ np.linalg.inv(K_new)).T
    return p[..., :2] / p[..., 2:]


@pytest.mark.parametrize("vertical", [False, True])
def test_rotations_and_intrinsics_are_those_of_stereo_rectify(vertical, worst):
    pairs = rigs(NUM_RIGS, seed=1, vertical=vertical)
    rect = pairs.rectify()
    assert (rect.vertical == vertical).all()
    name = "vertical" if vertical else "horizontal"
    for route, rotation_limit, px_limit in ((opencv, 1e-12, 1e-4), (numpy_twin, 1e-12, 1e-9)):
        results = [route(*pairs.arrays(i)) for i in range(NUM_RIGS)]
        R1, R2, K_new = (torch.as_tensor(np.stack(x)) for x in zip(*results, strict=True))
        label = f"{name} rigs, {route.__name__}"
        worst(f"R1, R2: {label}", rect.R_left - R1, rotation_limit, "")
        worst(f"R1, R2: {label}", rect.R_right - R2, rotation_limit, "")
        worst(f"K_new: {label}", rect.K_new - K_new, px_limit)


@pytest.mark.parametrize("vertical", [False, True])
def test_maps_are_those_of_init_undistort_rectify_map(vertical, worst):
    pairs = rigs(NUM_RIGS, seed=2, vertical=vertical)
    rect = pairs.rectify()
    maps = source_positions(pairs.K_right, rect.R_right, rect.K_new, WH).numpy()
    for i in range(NUM_RIGS):
        K, R_rect, K_new = (x[i].numpy() for x in (pairs.K_right, rect.R_right, rect.K_new))
        near = (np.abs(maps[i]) < 200).all(-1)  # cv2 returns float32
        expected = cv2.initUndistortRectifyMap(K, NO_LENS, R_rect, K_new, WH, cv2.CV_32FC2)[0]
        worst("maps: cv2.initUndistortRectifyMap", (maps[i] - expected)[near], 1e-3)
        worst("maps: NumPy float64", (maps[i] - numpy_map(K, R_rect, K_new))[near], 1e-9)


def test_warp_is_that_of_remap(worst):
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.uniform(0, 1, (WH[1], WH[0], 3)).astype(np.float32), None, 2.0)
    pairs = rigs(20, seed=3, limit_deg=4.0)
    rect = pairs.rectify()
    image = torch.as_tensor(noise).permute(2, 0, 1).expand(20, -1, -1, -1)
    warped, valid = warp(image, pairs.K_left, rect.R_left, rect.K_new, WH)
    maps = source_positions(pairs.K_left, rect.R_left, rect.K_new, WH).float().numpy()
    for i in range(20):
        expected = cv2.remap(noise, maps[i], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        seen = valid[i, 0].numpy()
        assert seen.mean() > 0.3
        error = (warped[i].permute(1, 2, 0).numpy() - expected)[seen]
        worst("warp: cv2.remap, colours in [0, 1]", error, 1e-5, "")


@pytest.mark.parametrize("vertical", [False, True])
def test_rectified_pair_has_one_orientation_and_its_baseline_along_one_axis(vertical, worst):
    pairs = rigs(500, seed=4, vertical=vertical)
    rect = pairs.rectify()
    worst(
        "R_right R R_leftᵀ = I", rect.R_right @ pairs.R @ rect.R_left.mT - torch.eye(3), 1e-14, ""
    )
    baseline = (rect.R_right @ pairs.t[..., None])[..., 0]
    across = baseline[:, [0, 2]] if vertical else baseline[:, 1:]
    worst("R_right t off its axis", across, 1e-14, "m")


def test_points_keep_their_row_of_a_horizontal_and_their_column_of_a_vertical_rig(worst):
    points = torch.as_tensor(np.random.default_rng(5).uniform([-2, -1, 4], [2, 1, 60], (300, 3)))
    for vertical in (False, True):
        pairs = rigs(100, seed=5, vertical=vertical, limit_deg=3.0)
        rect = pairs.rectify()
        uv_left = rectified_uv(points.expand(100, -1, -1), rect.R_left, rect.K_new)
        points_right = points @ pairs.R.mT + pairs.t[:, None]
        uv_right = rectified_uv(points_right, rect.R_right, rect.K_new)
        across = (uv_right - uv_left)[..., 0 if vertical else 1]
        worst("vertical flow of rectified points", across, 1e-11)


def test_rectified_position_is_where_warp_takes_that_pixel_from():
    pairs = rigs(5, seed=6, limit_deg=4.0)
    rect = pairs.rectify()
    uv = source_positions(pairs.K_left, rect.R_left, rect.K_new, WH).flatten(1, 2)
    back = rectified_uv(unproject(pairs.K_left, uv), rect.R_left, rect.K_new)
    v, u = torch.meshgrid(*(torch.arange(n).double() for n in WH[::-1]), indexing="ij")
    torch.testing.assert_close(back, torch.stack([u, v], -1).reshape(1, -1, 2).expand(5, -1, -1))


def test_nominal_rig_is_left_alone():
    K = torch.tensor([[[32.0, 0, 31.5], [0, 32, 17.5], [0, 0, 1]]]).double()
    image = torch.rand(1, 3, WH[1], WH[0], generator=torch.Generator().manual_seed(0))
    for x in (-0.8, 0.8):
        rect = rectify(torch.eye(3)[None], torch.tensor([[x, 0, 0]]), K, K, WH)
        torch.testing.assert_close(rect.R_left, torch.eye(3).double()[None], rtol=0, atol=0)
        torch.testing.assert_close(rect.R_right, rect.R_left, rtol=0, atol=0)
        torch.testing.assert_close(rect.K_new, K, rtol=0, atol=1e-12)
        warped, valid = warp(image, K, rect.R_left, rect.K_new, WH)
        torch.testing.assert_close(warped, image, rtol=0, atol=1e-5)
        assert valid[..., 1:-1, 1:-1].all()


def test_length_of_the_baseline_does_not_matter():
    pairs = rigs(50, seed=7)
    longer = Rigs(pairs.R, 7.0 * pairs.t, pairs.K_left, pairs.K_right).rectify()
    torch.testing.assert_close(longer.R_left, pairs.rectify().R_left, rtol=0, atol=1e-14)
    torch.testing.assert_close(longer.K_new, pairs.rectify().K_new, rtol=0, atol=1e-11)


def test_swapped_rig_has_the_same_rectified_frames():
    pairs = rigs(50, seed=8)
    other = rectify(*swapped(pairs.R, pairs.t), pairs.K_right, pairs.K_left, WH)
    rect = pairs.rectify()
    torch.testing.assert_close(other.R_left, rect.R_right, rtol=0, atol=1e-14)
    torch.testing.assert_close(other.R_right, rect.R_left, rtol=0, atol=1e-14)
    torch.testing.assert_close(other.K_new, rect.K_new, rtol=0, atol=1e-11)


def test_intrinsics_can_be_frozen():
    pairs = rigs(3, seed=9)
    K_new = pairs.K_left[0].float()
    rect = pairs.rectify(K_new=K_new)
    assert rect.K_new.dtype == torch.float64
    torch.testing.assert_close(rect.K_new, K_new.double().expand(3, 3, 3), rtol=0, atol=0)
    own = pairs.rectify()
    torch.testing.assert_close(rect.R_left, own.R_left, rtol=0, atol=0)
    expected = new_intrinsics(
        pairs.K_left, pairs.K_right, own.R_left, own.R_right, own.vertical, WH
    )
    torch.testing.assert_close(own.K_new, expected, rtol=0, atol=0)


def test_rectification_of_half_size_images_sees_the_same_rays():
    rect = rigs(4, seed=10).rectify()
    uv = torch.tensor([[10.0, 20.0]]).double().expand(4, 1, 2)
    rays = unproject(rect.K_new, uv)
    torch.testing.assert_close(unproject(rect.resized(0.5).K_new, 0.5 * (uv + 0.5) - 0.5), rays)


@pytest.mark.parametrize("size", ["whole", "one pixel"])
def test_valid_is_exactly_where_the_source_is_between_pixel_centres(size):
    wh = (20, 12) if size == "whole" else (1, 1)
    K = torch.eye(3).double()[None]
    shift = K.clone()
    for du in (0.0, 1e-9, 0.5, -1e-9):
        shift[..., 0, 2] = -du  # rectified pixel u is source pixel u + du
        image = torch.ones(1, 1, wh[1], wh[0])
        warped, valid = warp(image, K, torch.eye(3)[None], shift, wh)
        u = torch.arange(wh[0]).double() + du
        expected = ((u >= 0) & (u <= wh[0] - 1)).expand(wh[1], -1)
        assert torch.equal(valid[0, 0], expected)
        torch.testing.assert_close(warped[valid], torch.ones(int(valid.sum())), atol=1e-5, rtol=0)


def test_white_image_stays_white_where_valid_and_is_darker_elsewhere_only():
    pairs = rigs(10, seed=11, limit_deg=6.0)
    rect = pairs.rectify()
    white = torch.ones(10, 1, WH[1], WH[0])
    warped, valid = warp(white, pairs.K_left, rect.R_left, rect.K_new, WH)
    assert (warped[valid] > 1 - 1e-5).all()
    maps = source_positions(pairs.K_left, rect.R_left, rect.K_new, WH)
    beyond = ((maps <= -1) | (maps >= torch.tensor(WH))).any(-1)[:, None]
    assert beyond.any()
    assert (warped[beyond] < 1e-3).all()


def test_an_image_that_nothing_turns_keeps_its_outermost_pixels():
    for size in ((512, 256), (320, 160), (97, 41)):
        K = torch.tensor([[[0.7 * size[0], 0, 0.47 * size[0]], [0, 0.71 * size[0], 0.53 * size[1]],
                           [0, 0, 1]]], dtype=torch.float64)  # fmt: skip
        image = torch.rand(1, 3, *size[::-1])
        warped, valid = warp(image, K, torch.eye(3, dtype=torch.float64)[None], K, size)
        assert valid.all()
        torch.testing.assert_close(warped, image, atol=1e-5, rtol=0)


def test_pixels_that_look_behind_the_camera_are_black_and_invalid():
    K = torch.tensor([[[20.0, 0, 9.5], [0, 20, 9.5], [0, 0, 1]]]).double()
    about = rotation_from_vector(torch.tensor([[0.0, torch.pi, 0.0]]).double())
    warped, valid = warp(torch.ones(1, 1, 20, 20), K, about, K, (20, 20))
    assert not valid.any()
    assert (warped == 0).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_warp_returns_the_type_it_is_given_and_keeps_pixels_apart(dtype):
    K = torch.eye(3).double()[None]
    image = (torch.arange(300) % 2).to(dtype).expand(1, 1, 2, 300)
    warped, _ = warp(image, K, torch.eye(3)[None], K, (300, 2))
    assert warped.dtype == dtype
    torch.testing.assert_close(warped, image, atol=1e-3, rtol=0)


@pytest.mark.parametrize("vertical", [False, True])
@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (0.7, -0.4, 0.9), (5.0, 8.0, -12.0)])
def test_gradients_are_those_of_finite_differences(turn_deg, vertical):
    K = torch.tensor([[[32.0, 0, 31.5], [0, 33, 17.5], [0, 0, 1]]]).double()
    w = torch.tensor([turn_deg]).double().deg2rad().requires_grad_()
    t = torch.tensor([[0.0, 0.8, 0.0] if vertical else [-0.8, 0.0, 0.0]]).double().requires_grad_()

    def whole(w: torch.Tensor, t: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rect = rectify(rotation_from_vector(w), t, K, K, WH)
        return rect.R_left, rect.R_right, rect.K_new

    assert torch.autograd.gradcheck(whole, (w, t))


def test_gradient_with_respect_to_every_entry_of_the_nominal_rotation_is_right():
    K = torch.tensor([[[32.0, 0, 31.5], [0, 33, 17.5], [0, 0, 1]]]).double()
    R = torch.eye(3).double()[None].requires_grad_()
    t = torch.tensor([[-0.8, 0.0, 0.0]]).double()

    def whole(R: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rect = rectify(R, t, K, K, WH)
        return rect.R_left, rect.R_right, rect.K_new

    assert torch.autograd.gradcheck(whole, (R,))


def test_gradient_flows_through_the_warped_image():
    K = torch.tensor([[[9.0, 0, 4.4], [0, 9.0, 3.7], [0, 0, 1]]]).double()
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 2, 8, 10, generator=generator, dtype=torch.float64)
    w = torch.tensor([[0.013, -0.021, 0.034]]).double().requires_grad_()

    def warped(w: torch.Tensor) -> torch.Tensor:
        rect = rectify(
            rotation_from_vector(w), torch.tensor([[-0.8, 0, 0]]), K, K, (10, 8), K_new=K
        )
        return warp(image, K, rect.R_left, rect.K_new, (10, 8))[0]

    assert torch.autograd.gradcheck(warped, (w,))


def test_turning_the_cameras_only_changes_how_they_are_turned_back(worst):
    pairs = rigs(50, seed=12, limit_deg=0.0)
    turns = rigs(50, seed=13, limit_deg=2.0).R
    R, t = rotated(pairs.R, pairs.t, left=turns, right=turns)
    rect = rectify(R, t, pairs.K_left, pairs.K_right, WH)
    worst(
        "turned rig: R_right R R_leftᵀ = I",
        rect.R_right @ R @ rect.R_left.mT - torch.eye(3),
        1e-14,
        "",
    )


def test_no_baseline_gives_nan_instead_of_a_rectification():
    K = torch.eye(3)[None]
    rect = rectify(torch.eye(3)[None], torch.zeros(1, 3), K, K, WH)
    assert rect.R_left.isnan().all()
