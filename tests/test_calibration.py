"""Calibrations come back as they went, formats mean what their owners say, cameras agree with cv2.

The files of other programs are spelt out here as those programs write them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from small_set import make_frame, write_set

from flowrect.calibration import Calibration, projections
from flowrect.formats import kalibr, opencv, read_calibration, ros
from flowrect.resize import resized_intrinsics
from simgen.errors import UserError
from simgen.export import write_nominal_rig
from simgen.geometry import Array, project, transform
from simgen.shards import ShardSet

WH = (320, 180)
K_A = np.array([[200.0, 0, 161.0], [0, 198.0, 88.0], [0, 0, 1]])
K_B = np.array([[205.0, 0, 157.0], [0, 206.0, 91.0], [0, 0, 1]])
DIST = np.array([-0.3, 0.1, 0.001, -0.002])
POSE = transform(
    Rotation.from_rotvec([0.6, -1.1, 0.9], degrees=True).as_matrix(), [-0.6, 0.03, 0.04]
)
RIG = Calibration(K_A, K_B, POSE, WH, DIST, 0.5 * DIST)
FISHEYE = replace(RIG, lens="fisheye", dist_left=DIST / 10, dist_right=DIST / 20)
VERTICAL = replace(RIG, T_right_left=transform(POSE[:3, :3], np.array([0.03, -0.6, 0.04])))


def rectified(rig: Calibration):
    return projections(rig.T_right_left, rig.K_left, rig.K_right, rig.wh)


def require_equal(a: Calibration, b: Calibration, atol: float = 1e-12) -> None:
    assert (a.wh, a.lens) == (b.wh, b.lens)
    for name in ("K_left", "K_right", "T_right_left"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=atol, err_msg=name)
    for name in ("dist_left", "dist_right"):
        x, y = (np.pad(getattr(rig, name), (0, 14 - len(getattr(rig, name)))) for rig in (a, b))
        np.testing.assert_allclose(x, y, atol=1e-15, err_msg=name)


# --- round trips


def write_opencv(folder: Path, rig: Calibration) -> list[Path]:
    opencv.write(folder / "rig.yaml", rig, rectified(rig))
    return [folder / "rig.yaml"]


def write_kalibr(folder: Path, rig: Calibration) -> list[Path]:
    kalibr.write(folder / "camchain.yaml", rig)
    return [folder / "camchain.yaml"]


def write_ros(folder: Path, rig: Calibration) -> list[Path]:
    paths = [folder / "left.yaml", folder / "right.yaml"]
    ros.write(paths[0], paths[1], rig, rectified(rig))
    return paths


@pytest.mark.parametrize("rig", [RIG, FISHEYE, VERTICAL], ids=["lens", "fisheye", "vertical"])
@pytest.mark.parametrize("write", [write_opencv, write_kalibr, write_ros])
def test_a_rig_survives_every_format(write, rig, tmp_path):
    require_equal(read_calibration(write(tmp_path, rig)), rig)


@pytest.mark.parametrize("write", [write_opencv, write_ros])
def test_eight_coefficients_survive_where_the_format_has_them(write, tmp_path):
    dist = np.array([-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003])
    rig = replace(RIG, dist_left=dist, dist_right=dist)
    require_equal(read_calibration(write(tmp_path, rig)), rig)


def test_kalibr_says_that_it_has_no_third_radial_coefficient(tmp_path):
    rig = replace(RIG, dist_left=np.array([-0.3, 0.1, 0, 0, 0.01]))
    with pytest.raises(UserError, match=r"Kalibr's radtan ends at k1, k2, p1, p2"):
        kalibr.write(tmp_path / "camchain.yaml", rig)


# --- files of others


def test_opencv_written_by_hand_needs_no_matrix_headers(tmp_path):
    (tmp_path / "rig.yaml").write_text(
        "%YAML:1.0\n---\nK_left: [200, 0, 159.5, 0, 200, 89.5, 0, 0, 1]\n"
        "K_right: [200., 0., 159.5, 0., 200., 89.5, 0., 0., 1.]\n"
        "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.5, 0, 0]\nimage_width: 320\nimage_height: 180\n"
    )
    rig = read_calibration([tmp_path / "rig.yaml"])
    assert rig.wh == WH
    assert rig.K_left[0, 2] == 159.5
    assert rig.T_right_left[0, 3] == -0.5


def stereo_calib(folder: Path, rig: Calibration) -> list[Path]:
    """The two files of OpenCV's sample stereo_calib."""
    files = {
        "intrinsics.yml": {
            "M1": rig.K_left, "D1": rig.dist_left[None], "M2": rig.K_right,
            "D2": rig.dist_right[None],
        },
        "extrinsics.yml": {"R": rig.T_right_left[:3, :3], "T": rig.T_right_left[:3, 3:]},
    }  # fmt: skip
    for name, entries in files.items():
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
        for key, value in entries.items():
            storage.write(key, value)
        storage.release()
    return [folder / name for name in files]


def test_the_two_files_of_stereo_calib_make_a_rig_of_the_images_size(tmp_path):
    require_equal(read_calibration(stereo_calib(tmp_path, RIG), WH), RIG)


def test_files_without_a_size_need_the_images(tmp_path):
    with pytest.raises(UserError, match=r"no entry image_width, image_height: which size"):
        read_calibration(stereo_calib(tmp_path, RIG))


def test_a_point_of_cam0_is_taken_to_cam1_by_kalibrs_matrix(tmp_path):
    (tmp_path / "camchain.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [461.6, 460.3, 362.7, 248.1]\n"
        "  distortion_model: radtan\n  distortion_coeffs: [-0.27, 0.06, 0.0008, 0.0003]\n"
        "  resolution: [752, 480]\n  rostopic: /cam0/image_raw\n  cam_overlaps: [1]\n"
        "cam1:\n  T_cn_cnm1:\n  - [0.0, -1.0, 0.0, -0.11]\n  - [1.0, 0.0, 0.0, 0.02]\n"
        "  - [0.0, 0.0, 1.0, 0.03]\n  - [0.0, 0.0, 0.0, 1.0]\n"
        "  camera_model: pinhole\n  intrinsics: [460.0, 459.0, 360.0, 250.0]\n"
        "  distortion_model: none\n  distortion_coeffs: []\n  resolution: [752, 480]\n"
    )
    rig = read_calibration([tmp_path / "camchain.yaml"])
    np.testing.assert_allclose((rig.T_right_left @ [1, 2, 3, 1])[:3], [-2.11, 1.02, 3.03])
    np.testing.assert_array_equal(rig.K_left[:2], [[461.6, 0, 362.7], [0, 460.3, 248.1]])
    assert (rig.wh, rig.dist_left[0], rig.dist_right.any()) == ((752, 480), -0.27, False)


def test_ros_has_minus_focal_length_times_baseline_in_the_right_projection(tmp_path):
    ideal = replace(RIG, T_right_left=transform(np.eye(3), np.array([-0.25, 0.0, 0.0])))
    info = yaml.safe_load(write_ros(tmp_path, ideal)[1].read_text())
    P = np.array(info["projection_matrix"]["data"]).reshape(3, 4)
    assert P[0, 3] == pytest.approx(-0.25 * P[0, 0])
    assert info["distortion_coefficients"] == {
        "rows": 1, "cols": 5, "data": [*RIG.dist_right, 0.0]
    }  # fmt: skip
    assert (info["image_width"], info["distortion_model"]) == (320, "plumb_bob")


def test_an_exported_pair_has_the_nominal_rig(tmp_path):
    frames = ShardSet(write_set(tmp_path / "set", [make_frame(0)]))
    frame = frames.frame(0)
    rig = read_calibration([write_nominal_rig(tmp_path / "rig.yaml", frame, 2)])
    left, right = frame.pairs[2]
    assert rig.wh == frame.image.shape[2:0:-1]
    np.testing.assert_array_equal(rig.K_right, frame.K[right])
    np.testing.assert_allclose(
        frame.T_world_cam_nominal[right] @ rig.T_right_left, frame.T_world_cam_nominal[left],
        atol=1e-9,
    )  # fmt: skip


# --- cameras


POINTS = np.random.default_rng(2).uniform([-1.2, -0.6, 5], [1.2, 0.6, 9], (50, 3))


def through_lens(points: Array, K: Array, dist: Array, lens: str) -> Array:
    """Pixels (N, 2) of points of a camera's frame, by cv2."""
    zero = np.zeros(3)
    cast = cv2.fisheye.projectPoints if lens == "fisheye" else cv2.projectPoints
    if lens == "fisheye":
        return cast(points[:, None], zero, zero, K, dist)[0].reshape(-1, 2)
    return cast(points, zero, zero, K, dist)[0].reshape(-1, 2)


SHIFT = 40


def ramps(wh: tuple[int, int]) -> np.ndarray:
    """An image whose red is u - SHIFT and whose green is v: a place shows itself."""
    u, v = np.meshgrid(np.arange(wh[0]), np.arange(wh[1]))
    return np.stack([u - SHIFT, v, 0 * u], axis=-1).clip(0, 255).astype(np.uint8)


def shown(image: np.ndarray, uv: Array) -> Array:
    """The place that ``ramps`` shows at ``uv``."""
    u, v = uv.T.astype(np.float32)[..., None]
    return cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR)[:, 0, :2] + [SHIFT, 0]


@pytest.mark.parametrize("rig", [RIG, FISHEYE, VERTICAL], ids=["lens", "fisheye", "vertical"])
def test_lens_and_rotation_are_undone_as_cv2_projects(rig):
    right = POINTS @ rig.T_right_left[:3, :3].T + rig.T_right_left[:3, 3]
    to = rectified(rig)
    straight, warped = (
        rig.undistorted(ramps(WH), ramps(WH)),
        rig.rectified(ramps(WH), ramps(WH), to),
    )
    for i, (X, K, dist, R, P) in enumerate(
        [(POINTS, K_A, rig.dist_left, to.R1, to.P1), (right, K_B, rig.dist_right, to.R2, to.P2)]
    ):
        places = through_lens(X, K, dist, rig.lens)
        for image, uv in (
            (straight[i], project(K, X)),
            (warped[i], project(P[:, :3], X @ R.T)),
        ):
            inside = np.all((uv > 2) & (uv < np.array(WH) - 3), axis=1)
            inside &= np.abs(places[:, 0] - SHIFT - 127) < 125
            assert inside.sum() > 10
            assert np.abs(shown(image, uv[inside]) - places[inside]).max() < 0.6  # of whole greys


# --- bad files

INFO = {
    "image_width": 320, "image_height": 180, "camera_matrix": {"data": K_A.ravel().tolist()},
    "distortion_coefficients": {"data": [0.0] * 5},
    "rectification_matrix": {"data": np.eye(3).ravel().tolist()},
    "projection_matrix": {"data": np.hstack([K_A, np.zeros((3, 1))]).ravel().tolist()},
}  # fmt: skip
CAM = {"camera_model": "pinhole", "intrinsics": [200, 200, 160, 90], "resolution": [320, 180]}


@pytest.mark.parametrize(
    "texts, message",
    [
        (["%YAML:1.0\n---\nK_left: [1]\n"], r"no entry K_right, R, T; found K_left"),
        (["%YAML:1.0\n---\nK_left: [1"], r"not a file of cv2\.FileStorage"),
        (["K_left: [1]"], r"no entry K_right, R, T; found K_left"),
        (["%YAML:1.0\n---\nK_left: { rows: 3, of: me }\n"], r"no entry K_left, K_right, R, T"),
        ([yaml.safe_dump({"cam0": 5, "cam1": CAM})], r"cam0 is 5; expected a camera's entries"),
        (
            [yaml.safe_dump({**INFO, "distortion_coefficients": "none"})] * 2,
            r"distortion_coefficients: expected numbers, found 'none'",
        ),
        (["- 1\n- 2"], r"(?s)no calibration of a pair in .*0\.yaml: nothing.*Expected one of"),
        (["a: 1\nb: 2"], r"0\.yaml: a, b"),
        (["a: [1"], r"not a YAML file"),
        ([yaml.safe_dump(INFO)], r"(?s)no calibration of a pair in .*: ros.*two camera_info"),
        ([yaml.safe_dump(INFO)] * 2, r"projection_matrix has no baseline"),
        ([yaml.safe_dump({**INFO, "distortion_model": "fov"})] * 2, r"'fov', expected one of"),
        (
            [yaml.safe_dump({k: v for k, v in INFO.items() if k != "rectification_matrix"})] * 2,
            r"no entry rectification_matrix; it has camera_matrix",
        ),
        (
            [
                yaml.safe_dump(
                    {**INFO, "distortion_model": "equidistant"}
                )
            ] * 2,
            r"5 coefficients, expected one of \(4,\) \(fisheye lens\)",
        ),
        ([yaml.safe_dump({"cam0": CAM})], r"a camchain of cam0, expected cam0 \(left\) and cam1"),
        ([yaml.safe_dump({"cam0": CAM, "cam1": CAM})], r"cam1 has no entry T_cn_cnm1"),
        (
            [yaml.safe_dump({"cam0": {**CAM, "distortion_model": "radtan"}, "cam1": CAM})],
            r"cam0 has no entry distortion_coeffs",
        ),
        (
            [yaml.safe_dump({"cam0": {**CAM, "camera_model": "omni"}, "cam1": CAM})],
            r"cam0: camera_model 'omni' .*expected 'pinhole'",
        ),
    ],
)  # fmt: skip
def test_a_bad_calibration_says_what_is_wrong(tmp_path, texts, message):
    paths = [tmp_path / f"{i}.yaml" for i in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    with pytest.raises(UserError, match=message):
        read_calibration(paths)


def test_a_calibration_that_is_not_there_is_named(tmp_path):
    with pytest.raises(UserError, match=r"rig\.yaml: no such calibration"):
        read_calibration([tmp_path / "rig.yaml"])


def test_a_binary_file_is_no_calibration(tmp_path):
    (tmp_path / "rig.yaml").write_bytes(b"\x80\x04\x95\xff\xfe")
    with pytest.raises(UserError, match=r"not a YAML file"):
        read_calibration([tmp_path / "rig.yaml"])


@pytest.mark.parametrize("t", [0.0, np.nan])
def test_a_rig_without_baseline_is_refused(t):
    with pytest.raises(UserError, match=r"baseline T is \[.*\]; expected the vector"):
        RIG.with_pose(np.eye(3), np.full(3, t))


@pytest.mark.parametrize("scale", [0.5, 2.0])
@pytest.mark.parametrize("side", ["left", "right"])
def test_intrinsics_of_another_resolution_are_refused(side, scale):
    K = resized_intrinsics(getattr(RIG, f"K_{side}"), scale, scale)
    with pytest.raises(UserError, match=rf"the calibration's K_{side} .*another image size\?"):
        replace(RIG, **{f"K_{side}": K})


@pytest.mark.parametrize("write", [write_opencv, write_kalibr])
def test_a_rotation_that_is_none_is_refused(write, tmp_path):
    skewed = POSE.copy()
    skewed[0, 1] += 0.1
    with pytest.raises(UserError, match=r"(?s)is no rotation"):
        read_calibration(write(tmp_path, replace(RIG, T_right_left=skewed)))
