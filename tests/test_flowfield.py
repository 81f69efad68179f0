"""Flow from depth: against projection of unprojected points, and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simgen import geometry as g
from simgen.flowfield import flow_from_depth

HW = (61, 83)  # odd, and higher than one block of rows
K_LEFT = np.array([[70.0, 0, 37], [0, 64, 33], [0, 0, 1]])
K_RIGHT = np.array([[66.0, 0, 45], [0, 72, 29], [0, 0, 1]])


def turned(seed: int, angle_deg: float = 12.0, shift_m: float = 1.0):
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-angle_deg, angle_deg, 3), degrees=True).as_matrix()
    return g.transform(R, rng.uniform(-shift_m, shift_m, 3))


def random_depth(seed: int, low_m: float = 3.0):
    return np.random.default_rng(seed).uniform(low_m, 300, HW).astype(np.float32)


def by_points(depth, T):
    """The same flow by lifting each pixel to a point and projecting it."""
    uv = g.pixel_grid(HW)
    right = g.transform_points(T, g.unproject(K_LEFT, uv, depth.astype(np.float64)))
    return g.project(K_RIGHT, right) - uv, right[..., 2]


def by_homography(H):
    uv = g.pixel_grid(HW)
    mapped = np.concatenate([uv, np.ones((*HW, 1))], axis=-1) @ H.T
    return mapped[..., :2] / mapped[..., 2:] - uv


@pytest.mark.parametrize("seed", range(6))
def test_flow_is_the_projection_of_the_unprojected_point(seed, worst):
    depth, T = random_depth(seed), turned(seed)
    flow = flow_from_depth(depth, K_LEFT, K_RIGHT, T)
    assert flow.shape == (*HW, 2)
    assert flow.dtype == np.float32
    worst("flow from depth, by points", flow - by_points(depth, T)[0], 1e-4)


def test_a_sideways_shift_gives_focal_length_times_baseline_over_depth(worst):
    depth = random_depth(1)
    T = g.transform(np.eye(3), np.array([-0.8, 0, 0]))
    flow = flow_from_depth(depth, K_LEFT, K_LEFT, T)
    worst("flow -f B / Z", flow[..., 0] + 70.0 * 0.8 / depth.astype(np.float64), 1e-5)
    worst("vertical flow of a rectified pair", flow[..., 1], 1e-5)


def test_the_same_camera_twice_gives_no_flow():
    flow = flow_from_depth(random_depth(2), K_LEFT, K_LEFT, np.eye(4))
    np.testing.assert_allclose(flow, 0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_moves_by_its_homography(seed, worst):
    T, normal, distance = turned(seed), np.array([0.2, 0.3, 1.0]), 20.0
    rays = g.unproject(K_LEFT, g.pixel_grid(HW), np.ones(HW))
    depth = (distance / (rays @ normal)).astype(np.float32)
    H = K_RIGHT @ (T[:3, :3] + np.outer(T[:3, 3], normal) / distance) @ np.linalg.inv(K_LEFT)
    worst(
        "flow of a plane, by its homography",
        flow_from_depth(depth, K_LEFT, K_RIGHT, T) - by_homography(H),
        1e-4,
    )


def test_the_sky_moves_by_the_infinite_homography(worst):
    T = turned(4)
    H = g.infinite_homography(K_LEFT, K_RIGHT, T[:3, :3])
    flow = flow_from_depth(np.zeros(HW, np.float32), K_LEFT, K_RIGHT, T)
    worst("flow of the sky", flow - by_homography(H), 1e-4)


def test_pure_rotation_flow_is_independent_of_depth():
    T = turned(5, shift_m=0.0)
    sky = flow_from_depth(np.zeros(HW, np.float32), K_LEFT, K_RIGHT, T)
    np.testing.assert_array_equal(flow_from_depth(random_depth(6), K_LEFT, K_RIGHT, T), sky)


def test_points_behind_the_right_camera_have_no_flow():
    depth = np.random.default_rng(7).uniform(1, 20, HW).astype(np.float32)
    T = g.transform(np.eye(3), np.array([0.3, 0, -10.0]))
    expected, z = by_points(depth, T)
    flow = flow_from_depth(depth, K_LEFT, K_RIGHT, T)
    assert 0.2 < (z <= 0).mean() < 0.8
    np.testing.assert_array_equal(flow[z <= 0], 0)
    np.testing.assert_allclose(flow[z > 0.1], expected[z > 0.1], atol=1e-3)


def test_sky_behind_the_right_camera_has_no_flow():
    back = g.transform(Rotation.from_euler("y", 180, degrees=True).as_matrix(), np.zeros(3))
    flow = flow_from_depth(np.zeros(HW, np.float32), K_LEFT, K_LEFT, back)
    np.testing.assert_array_equal(flow, 0)


def test_a_point_in_the_right_cameras_plane_has_no_flow():
    T = g.transform(np.eye(3), np.array([0.5, 0, -8.0]))
    flow = flow_from_depth(np.full(HW, 8.0, np.float32), K_LEFT, K_LEFT, T)
    np.testing.assert_array_equal(flow, 0)


@pytest.mark.parametrize("height", [1, 48, 49, 97])
def test_every_row_is_filled_whatever_the_block(height):
    depth = np.full((height, 5), 4.0, np.float32)
    T = g.transform(np.eye(3), np.array([-1.0, 0, 0]))
    flow = flow_from_depth(depth, K_LEFT, K_LEFT, T)
    np.testing.assert_allclose(flow[..., 0], -70 / 4, rtol=1e-6)


def test_depth_is_only_read():
    depth = random_depth(8)
    depth.setflags(write=False)
    first = flow_from_depth(depth, K_LEFT, K_RIGHT, turned(8))
    np.testing.assert_array_equal(first, flow_from_depth(depth, K_LEFT, K_RIGHT, turned(8)))
