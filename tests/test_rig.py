"""Laws of the rigs that the project ships: where their cameras stand, look, and are turned."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats
from scipy.spatial.transform import Rotation

from simgen import rig as rigs
from simgen.geometry import inverse, project, transform

RIGS = Path(__file__).parents[1] / "scenes" / "rigs"
TABLE = {
    "intent": "for tests", "vehicle": "car", "camera_y_m": [0.5, 0.0, -0.5],
    "height_m": [1.4, 1.6], "pairs": [[0, 1]], "size": [640, 360], "hfov_deg": 90.0,
    "perturbation_deg": 1.0,
}  # fmt: skip


def load(name: str) -> rigs.Rig:
    return rigs.Rig.model_validate(tomllib.loads((RIGS / f"{name}.toml").read_text()))


def somewhere(seed: int = 0):
    """A vehicle that drives uphill on a bank."""
    rng = np.random.default_rng(seed)
    heading, tilt = rng.uniform(-180, 180), rng.uniform(-10, 10, 2)
    R = Rotation.from_euler("ZYX", [heading, *tilt], degrees=True).as_matrix()
    return transform(R, rng.uniform(-50, 50, 3))


def pose(name: str = "default", seed: int = 0):
    rng = np.random.default_rng(seed)
    return rigs.pose(load(name), somewhere(), (640, 360), rng=rng)


def T_right_left(left, right):
    return inverse(right) @ left


@pytest.mark.parametrize(
    "name, baselines",
    [("default", [0.8, 0.8, 1.6]), ("truck", [0.65, 0.65, 0.7, 1.3, 1.35, 2.0])],
)
def test_nominal_pairs_differ_by_their_baseline_along_x_alone(name, baselines):
    nominal = pose(name).T_world_cam_nominal
    for (left, right), baseline in zip(load(name).pairs, baselines, strict=True):
        T = T_right_left(nominal[left], nominal[right])
        np.testing.assert_allclose(T, transform(np.eye(3), np.array([-baseline, 0, 0])), atol=1e-13)


@pytest.mark.parametrize("name", ["default", "truck"])
def test_nominal_cameras_look_forward_upright_from_their_height(name):
    rig = load(name)
    nominal = rigs.nominal_poses(rig, np.eye(4), 1.5)
    for T, y in zip(nominal, rig.camera_y_m, strict=True):
        np.testing.assert_array_equal(T[:3, 2], [1, 0, 0])  # z: forward
        np.testing.assert_array_equal(T[:3, 1], [0, 0, -1])  # y: down
        np.testing.assert_array_equal(T[:3, 3], [0, y, 1.5])


def test_the_rig_moves_with_its_vehicle():
    rig, T = load("default"), somewhere(3)
    moved = rigs.nominal_poses(rig, T, 1.5)
    np.testing.assert_allclose(moved, T @ rigs.nominal_poses(rig, np.eye(4), 1.5), atol=1e-13)


@pytest.mark.parametrize("name", ["default", "truck"])
def test_true_pose_is_nominal_times_exp_of_the_drawn_vector(name):
    posed = pose(name)
    R = Rotation.from_rotvec(posed.perturbation_deg, degrees=True).as_matrix()
    for camera, T, R_nominal_true in zip(posed.cameras, posed.T_world_cam_nominal, R, strict=True):
        np.testing.assert_allclose(
            camera.T_world_cam[:3, :3], T[:3, :3] @ R_nominal_true, atol=1e-14
        )


def test_cameras_turn_about_their_own_centres():
    posed = pose()
    for camera, T in zip(posed.cameras, posed.T_world_cam_nominal, strict=True):
        np.testing.assert_array_equal(camera.centre, T[:3, 3])


def test_a_positive_yaw_moves_the_image_left():
    """A rotation about y (down) turns the camera to the right."""
    nominal = rigs.nominal_poses(load("default"), np.eye(4), 1.5)[:1]
    (true,) = rigs.perturbed(nominal, np.array([[0.0, 1.0, 0.0]]))
    ahead = np.array([100.0, 0.8, 1.5, 1.0])
    u = project(np.eye(3), (inverse(true) @ ahead)[:3])[0]
    assert u == pytest.approx(-np.tan(np.deg2rad(1)), rel=1e-12)


def test_true_cameras_share_intrinsics_of_the_requested_size():
    for camera in pose().cameras:
        assert camera.wh == (640, 360)
        np.testing.assert_allclose(
            camera.K, [[320, 0, 319.5], [0, 320, 179.5], [0, 0, 1]], rtol=1e-12
        )


def test_world_to_camera_inverts_camera_to_world():
    (camera, *_) = pose().cameras
    np.testing.assert_allclose(camera.T_cam_world @ camera.T_world_cam, np.eye(4), atol=1e-13)


@pytest.mark.parametrize("limit", [0.0, 0.3, 1.0])
def test_drawn_angles_fill_their_range_uniformly_and_independently(limit):
    rig = rigs.Rig.model_validate({**TABLE, "perturbation_deg": limit})
    rng = np.random.default_rng(7)
    posed = [rigs.pose(rig, np.eye(4), (64, 36), rng=rng) for _ in range(400)]
    angles = np.stack([p.perturbation_deg for p in posed]).reshape(400, 9)
    assert np.abs(angles).max() <= limit
    if limit:
        uniform = stats.uniform(-limit, 2 * limit).cdf
        assert min(stats.kstest(column, uniform).pvalue for column in angles.T) > 1e-3
        assert np.abs(np.corrcoef(angles.T) - np.eye(9)).max() < 0.2


def test_drawn_height_fills_its_interval():
    heights = [pose(seed=seed).height_m for seed in range(200)]
    assert stats.kstest(heights, stats.uniform(1.45, 0.3).cdf).pvalue > 1e-3
    assert pose().T_world_cam_nominal[0, 2, 3] != pose(seed=1).T_world_cam_nominal[0, 2, 3]


def test_one_seed_gives_one_rig_and_another_seed_another():
    first, again, other = pose(seed=0), pose(seed=0), pose(seed=1)
    np.testing.assert_array_equal(first.perturbation_deg, again.perturbation_deg)
    for a, b in zip(first.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(a.T_world_cam, b.T_world_cam)
    assert (first.perturbation_deg != other.perturbation_deg).all()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"pairs": [[0, 3]]}, r"pairs holds \[0, 3\]; expected left < right, both in 0…2"),
        ({"pairs": [[0, 1], [1, 1]]}, r"pairs holds \[1, 1\]; expected left < right"),
        ({"pairs": [[2, 0]]}, r"pairs holds \[2, 0\]; expected left < right"),
        ({"pairs": [[-1, 1]]}, r"pairs holds \[-1, 1\]; expected left < right"),
        ({"pairs": []}, "at least 1 item"),
        ({"camera_y_m": [-0.5, 0.0, 0.5]}, "camera_y_m must fall from left"),
        ({"camera_y_m": [0.5, 0.5, 0.0]}, "camera_y_m must fall .* no two equal"),
        ({"camera_y_m": [0.5]}, "at least 2 items"),
        ({"height_m": [2.0, 1.0]}, r"expected \[low, high\] with 0.3 <= low <= high <= 6"),
        ({"hfov_deg": 180.0}, "less than or equal to 140"),
        ({"perturbation_deg": -1.0}, "greater than or equal to 0"),
        ({"vehicle": "boat"}, "car|truck"),
        ({"baseline_m": 0.8}, "Extra inputs are not permitted"),
    ],
)
def test_a_rig_that_cannot_be_built_is_rejected_with_the_reason(change, message):
    with pytest.raises(ValidationError, match=message):
        rigs.Rig.model_validate(TABLE | change)
