"""Group laws, singular points and gradients of flowrect's rotations; SciPy and NumPy as oracles."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flowrect import geometry as g
from simgen import geometry as np_g

EYE = torch.eye(3, dtype=torch.float64)


def rotations(n: int, *, seed: int, max_angle_rad: float = np.pi) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = axes * rng.uniform(0, max_angle_rad, (n, 1))
    return torch.as_tensor(Rotation.from_rotvec(vectors).as_matrix())


def test_skew_is_the_cross_product():
    w, x = torch.randn(2, 10, 3, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close((g.skew(w) @ x[..., None])[..., 0], torch.linalg.cross(w, x))


def test_exp_and_log_are_those_of_scipy(worst):
    R = rotations(1000, seed=1)
    vectors = torch.as_tensor(Rotation.from_matrix(R.numpy()).as_rotvec())
    worst("exp against SciPy", g.rotation_from_vector(vectors) - R, 1e-14, "")
    worst("log against SciPy", g.vector_from_rotation(R) - vectors, 1e-12, "rad")


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-6, 2e-6, 1e-3, 1.0, np.pi - 1e-6])
def test_log_inverts_exp_at_every_angle(angle):
    axes = torch.cat([EYE, -EYE, torch.tensor([[0.6, -0.48, 0.64]]).double()])
    back = g.vector_from_rotation(g.rotation_from_vector(angle * axes))
    torch.testing.assert_close(back, angle * axes, rtol=1e-9, atol=1e-16)


def test_quaternions_are_those_of_scipy_also_for_half_turns(worst):
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    R = torch.cat([rotations(500, seed=2), torch.as_tensor(half_turns), EYE[None]])
    q = g.quaternion_from_rotation(R)
    expected = torch.as_tensor(Rotation.from_matrix(R.numpy()).as_quat())
    sign = (q * expected).sum(-1, keepdim=True).sign()
    worst("quaternion against SciPy", q - sign * expected, 1e-14, "")
    assert (q[:, 3] >= 0).all()
    worst("quaternion and back", g.rotation_from_quaternion(q) - R, 1e-14, "")


def test_half_rotation_twice_is_the_rotation(worst):
    R = rotations(1000, seed=3, max_angle_rad=0.99 * np.pi)
    half = g.half_rotation(R)
    worst("half rotation, twice", half @ half - R, 1e-14, "")
    worst("half rotation, half the angle", 2 * g.geodesic_rad(half, EYE) - g.geodesic_rad(R, EYE),
          1e-12, "rad")  # fmt: skip


def test_6d_inverts_and_orthogonalises_any_two_columns():
    R = rotations(100, seed=4)
    torch.testing.assert_close(g.rotation_from_6d(g.sixd_from_rotation(R)), R)
    r = torch.randn(100, 6, generator=torch.Generator().manual_seed(4)).double()
    made = g.rotation_from_6d(r)
    torch.testing.assert_close(made @ made.mT, EYE.expand(100, 3, 3))
    assert (torch.linalg.det(made) > 0).all()
    x = r[:, :3] / torch.linalg.vector_norm(r[:, :3], dim=-1, keepdim=True)
    torch.testing.assert_close(made[..., 0], x)  # the first column keeps its direction
    assert (torch.linalg.vecdot(made[..., 1], r[:, 3:]) > 0).all()
    assert torch.linalg.vecdot(made[..., 2], r[:, 3:]).abs().max() < 1e-12


def test_6d_reads_columns_not_rows():
    R = g.rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2]).double())
    torch.testing.assert_close(g.sixd_from_rotation(R), torch.tensor([0, 1, 0, -1, 0, 0]).double())


def test_parallel_columns_are_no_rotation():
    assert g.rotation_from_6d(torch.tensor([1.0, 0, 0, 2, 0, 0])).isnan().any()


def test_geodesic_is_a_distance_that_ignores_a_common_turn():
    A, B, C = rotations(300, seed=5).unflatten(0, (3, 100))
    torch.testing.assert_close(g.geodesic_rad(A, B), g.geodesic_rad(B, A))
    torch.testing.assert_close(g.geodesic_rad(C @ A, C @ B), g.geodesic_rad(A, B))
    torch.testing.assert_close(g.geodesic_rad(A @ C, B @ C), g.geodesic_rad(A, B))
    assert (g.geodesic_rad(A, A) < 1e-15).all()
    assert (g.geodesic_rad(A, C) <= g.geodesic_rad(A, B) + g.geodesic_rad(B, C)).all()
    # cos θ = (tr − 1)/2, the textbook's way
    cosine = 0.5 * ((A * B).sum((-2, -1)) - 1)
    torch.testing.assert_close(g.geodesic_rad(A, B).cos(), cosine)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_angles_per_axis_name_the_axis_of_the_right_camera_that_is_off(axis):
    error = torch.zeros(3, dtype=torch.float64)
    error[axis] = 0.02
    R = rotations(1, seed=6)[0]
    angles = g.angles_per_axis_rad(g.rotation_from_vector(error) @ R, R)
    torch.testing.assert_close(angles, error)


GRADIENTS = {
    "log": (g.vector_from_rotation, EYE),
    "half": (g.half_rotation, EYE),
    "6d": (lambda R: g.rotation_from_6d(g.sixd_from_rotation(R)), EYE),
    "quaternion": (g.quaternion_from_rotation, EYE),
    "exp": (g.rotation_from_vector, torch.zeros(3, dtype=torch.float64)),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradient_at_the_identity_is_that_of_finite_differences(name):
    function, at = GRADIENTS[name]
    assert torch.autograd.gradcheck(function, (at.clone().requires_grad_(),))


@pytest.mark.parametrize("name", [n for n in GRADIENTS if n != "exp"])
@pytest.mark.parametrize("angle", [1e-7, 1e-3, 0.5, 2.5])
def test_gradient_elsewhere_is_that_of_finite_differences(name, angle):
    R = g.rotation_from_vector(angle * torch.tensor([0.6, -0.48, 0.64]).double())
    assert torch.autograd.gradcheck(GRADIENTS[name][0], (R.requires_grad_(),))


def test_geodesic_of_equal_rotations_has_a_finite_gradient():
    R = EYE.clone().requires_grad_()
    g.geodesic_rad(R, EYE).backward()
    assert R.grad.isfinite().all()


# --- poses of a pair ---------------------------------------------------------------------------


def pose(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    t = np.random.default_rng(seed).normal(size=3)
    return rotations(1, seed=seed)[0], torch.as_tensor(t)


def test_rotated_pose_takes_turned_points_to_turned_points():
    R, t = pose(7)
    left, right = rotations(2, seed=8)
    X_left = torch.randn(20, 3, generator=torch.Generator().manual_seed(8)).double()
    X_right = X_left @ R.T + t
    R_new, t_new = g.rotated(R, t, left=left, right=right)
    torch.testing.assert_close((X_left @ left.T) @ R_new.T + t_new, X_right @ right.T)


def test_swapped_pose_is_the_inverse_transform():
    R, t = pose(9)
    expected = np_g.inverse(np_g.transform(R.numpy(), t.numpy()))
    R_swap, t_swap = g.swapped(R, t)
    np.testing.assert_allclose(np_g.transform(R_swap.numpy(), t_swap.numpy()), expected, atol=1e-15)
    torch.testing.assert_close(g.swapped(R_swap, t_swap), (R, t))


def test_mirrored_swap_projects_mirrored_points_to_mirrored_pixels():
    R = g.rotation_from_vector(torch.tensor([0.1, -0.2, 0.05]).double())
    t = torch.tensor([-0.8, 0.1, 0.05]).double()
    K_left = torch.tensor([[100.0, 0, 60], [0, 101, 40], [0, 0, 1]]).double()
    K_right = torch.tensor([[110.0, 0, 66], [0, 111, 44], [0, 0, 1]]).double()
    X_left = torch.tensor([[0.5, -0.3, 4.0], [-2.0, 1.0, 9.0]]).double()
    X_right = X_left @ R.T + t
    R_new, t_new, K_left_new, K_right_new = g.mirrored_swap(R, t, K_left, K_right, 128)
    flip = torch.tensor([-1.0, 1.0, 1.0]).double()
    new_left, new_right = X_right * flip, X_left * flip
    torch.testing.assert_close(new_left @ R_new.T + t_new, new_right)
    for K, X, K_old, X_old in (
        (K_left_new, new_left, K_right, X_right),
        (K_right_new, new_right, K_left, X_left),
    ):
        uv, old = g.project(K, X), g.project(K_old, X_old)
        torch.testing.assert_close(uv[:, 0], 127 - old[:, 0])
        torch.testing.assert_close(uv[:, 1], old[:, 1])
    assert t_new[0] < 0
    torch.testing.assert_close(torch.linalg.det(R_new), torch.tensor(1.0).double())


# --- intrinsics and rays -----------------------------------------------------------------------

K = torch.tensor([[90.0, 0.3, 47.2], [0, 95, 30.9], [0, 0, 1]]).double()


def test_inverse_intrinsics_is_the_matrix_inverse():
    torch.testing.assert_close(g.inverse_intrinsics(K[None]), torch.linalg.inv(K[None]))


def test_project_and_unproject_are_those_of_numpy_and_invert_each_other():
    uv = torch.rand(50, 2, generator=torch.Generator().manual_seed(1)).double() * 90
    rays = g.unproject(K, uv)
    np.testing.assert_allclose(rays, np_g.unproject(K.numpy(), uv.numpy(), np.ones(50)), atol=1e-14)
    np.testing.assert_allclose(g.project(K, 3 * rays), np_g.project(K.numpy(), rays.numpy()))
    torch.testing.assert_close(g.project(K, 3 * rays), uv)


def test_points_behind_are_outside_of_every_image_and_leave_gradients_finite():
    points = torch.tensor([[0.0, 0, -1], [0, 0, 0], [1, 1, 2]]).double().requires_grad_()
    uv = g.project(K, points)
    assert g.inside(uv, (100, 100)).tolist() == [False, False, True]
    uv.sum().backward()
    assert points.grad.isfinite().all()


def test_image_covers_half_a_pixel_beyond_its_outer_centres():
    uv = torch.tensor([[-0.5, -0.5], [-0.51, 0], [9.49, 4.49], [9.5, 0], [0, 4.5]]).double()
    assert g.inside(uv, (10, 5)).tolist() == [True, False, True, False, False]


def test_pixel_grid_is_numpys():
    grid = g.pixel_grid((4, 3), dtype=torch.float64, device=torch.device("cpu"))
    np.testing.assert_array_equal(grid, np_g.pixel_grid((3, 4)).reshape(-1, 2))


def test_resized_and_cropped_intrinsics_follow_the_pixels_of_the_image():
    # A ramp: its value at a pixel is the pixel's place in the native image, so content tells.
    v, u = np.indices((64, 96), dtype=np.float32)
    ramp = np.stack([u, v], axis=-1)[8:56, 12:92]
    small = cv2.resize(ramp, (20, 12), interpolation=cv2.INTER_AREA)
    K_small = g.resized(g.cropped(K, 12, 8), 0.25)
    at_small = g.unproject(K_small, torch.tensor([[7.0, 5.0]]).double())
    expected = g.unproject(K, torch.as_tensor(small[5, 7]).double()[None])
    torch.testing.assert_close(at_small, expected)
    stretched = g.resized(K, 0.5, 0.25)
    at_stretched = g.unproject(stretched, torch.tensor([[0.5, 0.25]]).double() * 41 - 0.5)
    torch.testing.assert_close(at_stretched, g.unproject(K, torch.tensor([[40.5, 40.5]]).double()))
