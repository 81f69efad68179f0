"""Laws of transforms and projection, against OpenCV, SciPy and each other."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simgen import geometry as g

RNG = np.random.default_rng(20240501)
VECTORS = RNG.normal(size=(40, 3)) * RNG.uniform(0, np.pi / np.sqrt(14), size=(40, 1))
AXES = RNG.normal(size=(8, 3)) / np.sqrt(3)


def pose(seed: int, angle_rad: float = 0.5):
    """A transform of a random rotation and translation."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=3)
    R = Rotation.from_rotvec(angle_rad * w / np.linalg.norm(w)).as_matrix()
    return g.transform(R, rng.normal(size=3))


def K_of(seed: int):
    """Intrinsics with an off-centre principal point and oblong pixels."""
    rng = np.random.default_rng(seed)
    fx, fy, cx, cy = rng.uniform([400, 400, 200, 100], [600, 600, 440, 380])
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def points_ahead(num: int, seed: int = 0):
    """Points in a camera frame, 1 to 100 m ahead."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.8, -0.6, 1], [0.8, 0.6, 1], (num, 3)) * rng.uniform(1, 100, (num, 1))


# --- rotations --------------------------------------------------------------------------------


def test_skew_is_the_cross_product():
    a, b = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(g.skew(a) @ b, np.cross(a, b), rtol=0, atol=1e-15)


def test_exp_agrees_with_scipy_and_opencv(worst):
    ours = np.stack([g.rotation_from_vector(w) for w in VECTORS])
    theirs = np.stack([cv2.Rodrigues(w)[0] for w in VECTORS])
    worst("exp of a rotation, SciPy", ours - Rotation.from_rotvec(VECTORS).as_matrix(), 1e-14, "1")
    worst("exp of a rotation, OpenCV", ours - theirs, 1e-14, "1")


def test_exp_is_a_rotation_at_every_angle():
    for angle in (0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-9, np.pi, 5.0, 2 * np.pi):
        for axis in AXES:
            R = g.rotation_from_vector(angle * axis)
            np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-14)
            assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)


def test_exp_keeps_tiny_angles():
    for angle in (1e-15, 1e-10, 1e-6):
        np.testing.assert_allclose(
            g.rotation_from_vector(np.array([angle, 0, 0]))[2, 1], angle, rtol=1e-6
        )


def test_log_inverts_exp(worst):
    logs = np.stack([g.vector_from_rotation(g.rotation_from_vector(w)) for w in VECTORS])
    worst("log after exp", logs - VECTORS, 1e-14, "rad")


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-13, 1e-8, 1e-3, 3.0, np.pi - 1e-4])
def test_log_is_exact_from_zero_to_just_below_a_half_turn(angle):
    for axis in AXES:
        w = angle * axis / np.linalg.norm(axis)
        log = g.vector_from_rotation(g.rotation_from_vector(w))
        np.testing.assert_allclose(log, w, rtol=1e-10, atol=1e-15)


def test_rotations_about_one_axis_add_up():
    for axis in AXES:
        product = g.rotation_from_vector(0.3 * axis) @ g.rotation_from_vector(0.9 * axis)
        np.testing.assert_allclose(product, g.rotation_from_vector(1.2 * axis), atol=1e-14)


def test_log_of_a_conjugate_is_the_turned_log():
    for w, v in zip(VECTORS, VECTORS[::-1], strict=True):
        R, Q = g.rotation_from_vector(w), g.rotation_from_vector(v)
        np.testing.assert_allclose(g.vector_from_rotation(Q @ R @ Q.T), Q @ w, atol=1e-13)


# --- transforms -------------------------------------------------------------------------------


def test_inverse_inverts():
    T = pose(3)
    np.testing.assert_allclose(g.inverse(T) @ T, np.eye(4), atol=1e-15)


def test_inverse_works_on_stacks():
    stack = np.stack([pose(i) for i in range(6)]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(g.inverse(stack) @ stack, np.broadcast_to(np.eye(4), stack.shape),
                               atol=1e-15)  # fmt: skip
    np.testing.assert_array_equal(g.inverse(stack)[1, 2], g.inverse(pose(5)))


def test_transform_points_follows_the_notation():
    T_b_a, p_a = pose(4), points_ahead(7).reshape(7, 1, 3)
    p_b = g.transform_points(T_b_a, p_a)
    for a, b in zip(p_a[:, 0], p_b[:, 0], strict=True):
        np.testing.assert_allclose(b, T_b_a[:3, :3] @ a + T_b_a[:3, 3], atol=1e-13)


def test_transforms_compose_with_inner_names_cancelling():
    T_c_b, T_b_a, p_a = pose(5), pose(6), points_ahead(9)
    two_steps = g.transform_points(T_c_b, g.transform_points(T_b_a, p_a))
    np.testing.assert_allclose(g.transform_points(T_c_b @ T_b_a, p_a), two_steps, atol=1e-13)


def test_vehicle_axes_are_a_rotation_to_right_down_forward():
    np.testing.assert_array_equal(g.R_CAM_VEHICLE @ [1, 0, 0], [0, 0, 1])
    np.testing.assert_array_equal(g.R_CAM_VEHICLE @ [0, 1, 0], [-1, 0, 0])
    np.testing.assert_array_equal(g.R_CAM_VEHICLE @ [0, 0, 1], [0, -1, 0])
    assert np.linalg.det(g.R_CAM_VEHICLE) == 1


# --- projection -------------------------------------------------------------------------------


def test_projection_agrees_with_opencv(worst):
    points, T_cam_world, K = points_ahead(200), pose(7, 0.2), K_of(7)
    T_world_cam = g.inverse(T_cam_world)
    world = g.transform_points(T_world_cam, points)
    rotation, translation = cv2.Rodrigues(T_cam_world[:3, :3])[0], T_cam_world[:3, 3]
    theirs = cv2.projectPoints(world, rotation, translation, K, None)[0][:, 0]
    ours = g.project(K, g.transform_points(T_cam_world, world))
    worst("projection, OpenCV", ours - theirs, 1e-9)


def test_unproject_inverts_project(worst):
    K = K_of(8)
    K[0, 1] = 3.0
    uv = np.random.default_rng(8).uniform(-50, 700, (5, 40, 2))
    depth = np.random.default_rng(9).uniform(0.1, 1e4, (5, 40))
    points = g.unproject(K, uv, depth)
    np.testing.assert_array_equal(points[..., 2], depth)
    worst("project after unproject", g.project(K, points) - uv, 1e-9)


@pytest.mark.parametrize("wh", [(640, 480), (641, 481), (1, 1)])
def test_field_of_view_reaches_from_edge_to_edge(wh):
    K = g.intrinsics(wh, 80.0)
    w, h = wh
    left, right = g.unproject(
        K, np.array([[-0.5, (h - 1) / 2], [w - 0.5, (h - 1) / 2]]), np.ones(2)
    )
    np.testing.assert_allclose(left, [-np.tan(np.deg2rad(40)), 0, 1], atol=1e-13)
    np.testing.assert_allclose(right, [np.tan(np.deg2rad(40)), 0, 1], atol=1e-13)
    assert K[0, 0] == K[1, 1]


def test_the_axis_of_a_centred_camera_meets_the_middle_of_the_image():
    np.testing.assert_array_equal(
        g.project(g.intrinsics((2, 2), 90.0), np.array([0.0, 0, 1])), [0.5, 0.5]
    )


def test_corner_origin_moves_pixels_by_a_half_and_leaves_its_argument():
    K, points = K_of(10), points_ahead(5)
    before = K.copy()
    moved = g.project(g.corner_origin_from_pixel_centre(K), points) - g.project(K, points)
    np.testing.assert_allclose(moved, 0.5, atol=1e-12)
    np.testing.assert_array_equal(K, before)
    stack = g.corner_origin_from_pixel_centre(np.stack([K, K_of(11)]))
    np.testing.assert_array_equal(stack[1], g.corner_origin_from_pixel_centre(K_of(11)))


def test_pixel_grid_is_uv_by_row_and_column():
    grid = g.pixel_grid((3, 5))
    assert grid.shape == (3, 5, 2)
    np.testing.assert_array_equal(grid[2, 4], [4, 2])
    np.testing.assert_array_equal(grid[0, 0], [0, 0])


# --- two views --------------------------------------------------------------------------------


def test_infinite_homography_is_the_limit_of_far_points():
    K_left, K_right, T = K_of(13), K_of(14), pose(15, 0.2)
    uv = np.random.default_rng(16).uniform(0, 600, (50, 2))
    mapped = np.c_[uv, np.ones(50)] @ g.infinite_homography(K_left, K_right, T[:3, :3]).T
    far = g.transform_points(T, g.unproject(K_left, uv, np.full(50, 1e12)))
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], g.project(K_right, far), atol=1e-6)


def rig_like_pair(seed: int):
    """``T_right_left`` of two forward cameras 0.8 m apart, each turned by some degrees."""
    turn = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-5, 5, (2, 3)), degrees=True)
    left, right = turn.as_matrix()
    T_world_right = g.transform(right, np.array([0.8, 0, 0]))
    return g.inverse(T_world_right) @ g.transform(left, np.zeros(3))


def rectified(T_right_left, R_left, R_right, left):
    """Normalised image points of points in the left frame, in both rectified views."""
    views = left @ R_left.T, g.transform_points(T_right_left, left) @ R_right.T
    return [p[:, :2] / p[:, 2:] for p in views]


@pytest.mark.parametrize("seed", range(5))
def test_rectified_rows_match_and_disparity_is_baseline_over_depth(seed, worst):
    T, left = rig_like_pair(seed), points_ahead(100, seed)
    R_left, R_right = g.rectifying_rotations(T)
    x_left, x_right = rectified(T, R_left, R_right, left)
    worst("vertical flow after rectification, f = 1", x_right[:, 1] - x_left[:, 1], 1e-14, "f")
    np.testing.assert_allclose(x_left[:, 0] - x_right[:, 0], 0.8 / (left @ R_left[2]), atol=1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_rectification_agrees_with_opencv_but_for_the_turn_about_the_baseline(seed, worst):
    """Ours looks along the mean axis, ``cv2.stereoRectify`` along the half rotation's axis."""
    T, left, K = rig_like_pair(seed), points_ahead(100, seed), K_of(0)
    theirs = cv2.stereoRectify(K, None, K, None, (640, 480), T[:3, :3], T[:3, 3:])[:2]
    ours = g.rectifying_rotations(T)
    x_left, x_right = rectified(T, *theirs, left)
    worst("vertical flow after cv2.stereoRectify, f = 1", x_right[:, 1] - x_left[:, 1], 1e-12, "f")
    between = ours[0] @ theirs[0].T
    np.testing.assert_allclose(between @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(between, ours[1] @ theirs[1].T, atol=1e-12)
    assert np.rad2deg(np.linalg.norm(g.vector_from_rotation(between))) < 0.5


def test_rectifying_rotations_of_a_rectified_pair_are_the_identity():
    T = g.transform(np.eye(3), np.array([-0.8, 0, 0]))
    for R in g.rectifying_rotations(T):
        np.testing.assert_allclose(R, np.eye(3), atol=1e-15)


def test_rectification_needs_a_baseline():
    with pytest.raises(ValueError, match="two camera centres coincide, so no baseline"):
        g.rectifying_rotations(g.transform(pose(0)[:3, :3], np.zeros(3)))
