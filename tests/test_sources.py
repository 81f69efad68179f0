"""Every layout: dots painted by the layout's own conventions appear where the pair read says."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from painted import centroids, dots
from scipy.spatial.transform import Rotation
from small_set import make_frame, write_set

from flowrect.calibration import Calibration
from flowrect.formats import opencv
from flowrect.sample import Pair
from flowrect.sources import open_source
from simgen.errors import UserError
from simgen.geometry import Array, intrinsics, inverse, project, rotation_from_vector, transform
from simgen.shards import Frame, ShardSet

WH = (320, 180)
K_A = np.array([[200.0, 0, 161.0], [0, 198.0, 88.0], [0, 0, 1]])
K_B = np.array([[205.0, 0, 157.0], [0, 206.0, 91.0], [0, 0, 1]])
DIST = np.array([-0.3, 0.1, 0.001, -0.002, 0.0])
T_RIGHT_LEFT = transform(rotation_from_vector(np.array([0.01, -0.02, 0.015])), [-0.6, 0.03, 0.04])


def _points() -> Array:
    """(N, 3) in the left camera's frame, in view of both cameras."""
    x, y = np.meshgrid(np.linspace(-0.55, 0.6, 6), np.linspace(-0.28, 0.28, 4))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return rays * np.random.default_rng(1).uniform(9, 30, (len(rays), 1))


def _paint(path: Path, uv: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), dots(WH, uv, sigma=2.0))


def _seen(K: Array, points: Array, dist: Array) -> Array:
    """Pixels of points (N, 3) of a camera's frame through its lens, by cv2."""
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, K, dist)[0].reshape(-1, 2)


def _require_dots(pair: Pair, points: Array, limit: float = 0.05) -> None:
    """Dots of ``points`` (left camera's frame) are where the pair's K and pose put them."""
    assert pair.T_right_left is not None
    right = points @ pair.T_right_left[:3, :3].T + pair.T_right_left[:3, 3]
    for image, uv in (
        (pair.left, project(pair.K_left, points)),
        (pair.right, project(pair.K_right, right)),
    ):
        assert np.abs(centroids(image, uv, 8) - uv).max() < limit


# --- plain folder ------------------------------------------------------------------------------


def _folder(folder: Path, dist: Array = DIST) -> Path:
    points = _points()
    right = points @ T_RIGHT_LEFT[:3, :3].T + T_RIGHT_LEFT[:3, 3]
    for name in ("b", "a"):
        _paint(folder / "left" / f"{name}.png", _seen(K_A, points, dist))
        _paint(folder / "right" / f"{name}.png", _seen(K_B, right, dist))
    opencv.write(folder / "calib.yaml", Calibration(K_A, K_B, T_RIGHT_LEFT, WH, dist, dist))
    return folder


@pytest.mark.parametrize("dist", [np.zeros(5), DIST], ids=["pinhole", "lens"])
def test_folder_shows_points_where_its_calibration_says(tmp_path: Path, dist: Array) -> None:
    pairs = open_source(_folder(tmp_path, dist), trusted=True)
    assert [pair.name for pair in pairs] == ["a", "b"]
    _require_dots(pairs[0], _points(), limit=0.1 if dist.any() else 0.05)


@pytest.mark.parametrize("source", ["folder", "KITTI", "Semi-Truck"])
def test_pairs_have_no_black_rim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    """White images through a lens that is straightened by drawing their border inwards."""
    monkeypatch.setitem(globals(), "DIST", np.array([0.1, 0, 0, 0, 0]))
    make = {
        "folder": lambda: _folder(tmp_path, DIST),
        "KITTI": lambda: _kitti(tmp_path, "extract"),
        "Semi-Truck": lambda: _truck_list(_semi_truck(tmp_path)),
    }
    path = make[source]()
    pair = open_source(path, trusted=True)[0]
    _require_dots(pair, _points(), limit=0.1)
    for image in tmp_path.rglob("*.png"):
        assert cv2.imwrite(str(image), np.full((WH[1], WH[0], 3), 255, np.uint8))
    pair = open_source(path, trusted=True)[0]
    assert min(pair.left.min(), pair.right.min()) == 255
    assert pair.wh[0] > 0.9 * WH[0]
    assert pair.wh[1] > 0.9 * WH[1]


def test_lenses_that_leave_nothing_are_refused(tmp_path: Path) -> None:
    _folder(tmp_path, np.array([0, 0, 1.0, 0, 0]))
    with pytest.raises(UserError, match=r"a: its lenses leave nothing of 320x180 without a black"):
        open_source(tmp_path)[0]


def test_folder_has_no_true_pose_unless_it_is_trusted(tmp_path: Path) -> None:
    pair = open_source(_folder(tmp_path))[0]
    assert pair.T_right_left is None
    assert pair.truth is None
    np.testing.assert_allclose(pair.T_right_left_nominal, T_RIGHT_LEFT, atol=1e-12)


def test_a_folder_is_the_same_wherever_it_stands_and_as_a_copy(tmp_path: Path, monkeypatch) -> None:
    before = open_source(_folder(tmp_path / "here")).fingerprint
    shutil.copytree(tmp_path / "here", tmp_path / "a" / "there", copy_function=shutil.copyfile)
    assert open_source(tmp_path / "a" / "there").fingerprint == before
    monkeypatch.chdir(tmp_path)
    assert open_source(Path("here")).fingerprint == before
    calibration = tmp_path / "here" / "calib.yaml"
    text = calibration.read_text("utf-8")
    calibration.write_text(text.replace("1", "2", 1), "utf-8")  # of the same size
    assert open_source(Path("here")).fingerprint != before


def test_folder_with_a_single_image_is_refused(tmp_path: Path) -> None:
    (_folder(tmp_path) / "right" / "b.png").unlink()
    with pytest.raises(
        UserError, match=r"1 images stand in only one of .*left and .*right, first 'b'"
    ):
        open_source(tmp_path)


def test_images_of_another_size_than_the_calibration_are_refused(tmp_path: Path) -> None:
    _folder(tmp_path)
    twice = [np.diag([2, 2, 1.0]) @ K for K in (K_A, K_B)]
    opencv.write(tmp_path / "calib.yaml", Calibration(*twice, T_RIGHT_LEFT, (640, 360)))
    with pytest.raises(UserError, match=r"a.png: an image of 320x180, .* is for 640x360"):
        open_source(tmp_path)[0]


# --- KITTI -------------------------------------------------------------------------------------

DAY = "2011_09_26"
T_02 = transform(rotation_from_vector(np.array([0.02, 0.01, -0.01])), [0.06, -0.01, 0.003])
T_03 = T_RIGHT_LEFT @ T_02


def _line(name: str, values: Any) -> str:
    return f"{name}: {' '.join(f'{v:.12e}' for v in np.ravel(values))}\n"


def _kitti(root: Path, kind: str) -> Path:
    """A drive with two frames; rectified (sync) or raw (extract)."""
    points, (day, drive) = _points(), (root / DAY, f"{DAY}_drive_0001_{kind}")
    text = "calib_time: 09-Jan-2012 13:57:47\n"
    for name, K, T in (("02", K_A, T_02), ("03", K_B, T_03)):
        P = K_A @ np.hstack([np.eye(3), [[0.06 if name == "02" else -0.47], [0], [0]]])
        text += _line(f"S_{name}", WH) + _line(f"K_{name}", K) + _line(f"D_{name}", DIST)
        text += _line(f"R_{name}", T[:3, :3]) + _line(f"T_{name}", T[:3, 3])
        text += _line(f"S_rect_{name}", WH) + _line(f"P_rect_{name}", P)
        if kind == "sync":
            uv = project(K_A, points + np.array([0 if name == "02" else -0.53, 0, 0]))
        else:
            in_reference = (points - T_02[:3, 3]) @ T_02[:3, :3]
            uv = _seen(K, in_reference @ T[:3, :3].T + T[:3, 3], DIST)
        for frame in (3, 4):
            _paint(day / drive / f"image_{name}" / "data" / f"{frame:010d}.png", uv)
    (day / "calib_cam_to_cam.txt").write_text(text)
    return root


@pytest.mark.parametrize("kind", ["sync", "extract"])
def test_kitti_shows_points_where_its_calibration_says(tmp_path: Path, kind: str) -> None:
    pairs = open_source(_kitti(tmp_path, kind))
    assert len(pairs) == 2
    assert pairs[1].name.endswith(f"{kind} 0000000004")
    _require_dots(pairs[0], _points(), limit=0.05 if kind == "sync" else 0.1)


def test_kitti_pose_is_right_after_inverse_left(tmp_path: Path) -> None:
    """The release has inverse left after right, whose translation is another one."""
    pair = open_source(_kitti(tmp_path, "extract"))[0]
    np.testing.assert_allclose(pair.T_right_left, T_03 @ inverse(T_02), atol=1e-9)
    assert not np.allclose(pair.T_right_left[:3, 3], (inverse(T_02) @ T_03)[:3, 3], atol=1e-3)


def test_kitti_list_finds_images_that_were_moved(tmp_path: Path) -> None:
    _kitti(tmp_path / "data", "extract")
    drive = f"{DAY}_drive_0001_extract"
    old = Path("/somewhere/else") / DAY
    images = [str(old / drive / f"image_{c}/data/0000000004.png") for c in ("02", "03")]
    row = [*images, str(old / "calib_cam_to_cam.txt"), DAY, drive]
    (tmp_path / "list.csv").write_text(",".join(row) + "\n")
    pairs = open_source(tmp_path / "list.csv", root=tmp_path / "data")
    assert len(pairs) == 1
    _require_dots(pairs[0], _points(), limit=0.1)


def test_list_of_images_that_are_not_there_is_refused(tmp_path: Path) -> None:
    drive = f"{DAY}_drive_0001_extract"
    _kitti(tmp_path, "extract")
    row = ["image_02/5.png", "image_03/5.png", f"{DAY}/calib_cam_to_cam.txt", DAY, drive]
    (tmp_path / "list.csv").write_text(",".join(row) + "\n")
    with pytest.raises(UserError, match=r"2 of 3 files are missing, first .*image_02/data/5.png"):
        open_source(tmp_path / "list.csv")


def test_kitti_images_of_another_size_are_refused(tmp_path: Path) -> None:
    _kitti(tmp_path, "sync")
    calib = tmp_path / DAY / "calib_cam_to_cam.txt"
    calib.write_text(calib.read_text().replace(_line("S_rect_02", WH), "S_rect_02: 1242 375\n"))
    with pytest.raises(UserError, match=r"320x180, but calib_cam_to_cam.txt is for 1242x375"):
        open_source(tmp_path)[0]


# --- Carla release -----------------------------------------------------------------------------

FOV_DEG = 80.0


def _unreal(R_deg: list[float], centre: list[float]) -> Array:
    """A camera-to-world matrix in Unreal's axes; any rotation does, both frames are left-handed."""
    return transform(rotation_from_vector(np.deg2rad(R_deg)), np.array(centre))


def _carla(root: Path) -> tuple[Path, Array]:
    """One frame of three cameras; returns points in the frame of perturbed camera 0 (OpenCV)."""
    nominal = [_unreal([0, 0, 30], [5 - 0.4 * i, 2 + 0.69 * i, 1.6]) for i in range(3)]
    drawn = ([0.5, -0.8, 0.9], [-0.7, 0.6, -0.4], [0.2, 0.9, -1.0])
    perturbed = [T @ _unreal(list(a), [0, 0, 0]) for T, a in zip(nominal, drawn, strict=True)]
    points = _points()
    in_unreal = points[:, [2, 0, 1]] * [1, 1, -1]  # forward, right, up
    world = in_unreal @ perturbed[0][:3, :3].T + perturbed[0][:3, 3]
    f = WH[0] / 2 / np.tan(np.deg2rad(FOV_DEG) / 2)
    poses = {}
    for i in range(3):
        for prefix, name, T in (("", "cam", nominal[i]), ("p_", "cam_p", perturbed[i])):
            x, y, z = ((world - T[:3, 3]) @ T[:3, :3]).T
            corner = np.stack([WH[0] / 2 + f * y / x, WH[1] / 2 - f * z / x], axis=1)
            _paint(root / f"{name}_{i}" / "00000042.png", corner - 0.5)
            poses[f"rgb_{prefix}cam{i}_matrix"] = T.tolist()
    (root / "poses").mkdir()
    (root / "poses" / "00000042.json").write_text(json.dumps(poses))
    config = {"fov": [FOV_DEG], "dim": [WH[1], WH[0]]}
    (root / "config_args.json").write_text(json.dumps(config))
    return root, points


def test_carla_shows_points_where_its_matrices_say(tmp_path: Path) -> None:
    root, points = _carla(tmp_path)
    pairs = open_source(root)
    assert [p.name[-15:] for p in pairs] == [
        f"cameras {a} and {b}" for a, b in ((0, 1), (1, 2), (0, 2))
    ]
    _require_dots(pairs[0], points)
    _require_dots(pairs[2], points)


def test_carla_pose_is_the_nominal_one_between_turned_cameras(tmp_path: Path) -> None:
    pair = open_source(_carla(tmp_path)[0])[2]
    zero = np.zeros(3)
    turns = (transform(pair.turn_right.T, zero), transform(pair.turn_left, zero))
    expected = turns[0] @ pair.T_right_left_nominal @ turns[1]
    np.testing.assert_allclose(pair.T_right_left, expected, atol=1e-12)
    assert pair.T_right_left_nominal[0, 3] < -1  # cameras are numbered from left to right


def test_carla_says_how_far_its_cameras_are_turned(tmp_path: Path) -> None:
    pairs = open_source(_carla(tmp_path)[0])
    turns = [Rotation.from_matrix(t).as_rotvec(degrees=True)
             for p in pairs for t in (p.turn_left, p.turn_right)]  # fmt: skip
    assert pairs.largest_turn_deg == pytest.approx(np.abs(turns).max())
    assert pairs.largest_turn_deg > 0.1


def test_carla_list_says_which_camera_is_perturbed(tmp_path: Path) -> None:
    root, points = _carla(tmp_path)
    (root / "list.csv").write_text(
        "target_cam,ref_cam,left_perturbed,right_perturbed,left,right\n"
        "0,1,True,False,cam_p_0/00000042.png,cam_1/00000042.png\n"
    )
    pair = open_source(root / "list.csv")[0]
    _require_dots(pair, points)
    np.testing.assert_allclose(pair.turn_right, np.eye(3), atol=1e-12)


def test_carla_frame_without_poses_is_refused(tmp_path: Path) -> None:
    root, _ = _carla(tmp_path)
    (root / "list.csv").write_text("0,1,True,True,cam_p_0/00000007.png,cam_p_1/00000007.png\n")
    with pytest.raises(UserError, match=r"no poses 00000007.json for cam_p_0/00000007.png"):
        open_source(root / "list.csv")


# --- Semi-Truck release ------------------------------------------------------------------------


def _semi_truck(root: Path) -> Path:
    points = _points()
    right = points @ T_RIGHT_LEFT[:3, :3].T + T_RIGHT_LEFT[:3, 3]
    _paint(root / "torc/CAPT-1/dusk_CAPT-1/image0/f0_7.png", _seen(K_A, points, DIST))
    _paint(root / "torc/CAPT-1/dusk_CAPT-1/image2/f2_7.png", _seen(K_B, right, DIST))
    pose = {"rmat": np.ravel(T_RIGHT_LEFT[:3, :3]).tolist(), "tvec": T_RIGHT_LEFT[:3, 3].tolist()}
    optics = {
        name: {"K": np.ravel(K).tolist(), "dist": DIST.tolist()}
        for name, K in (("0", K_A), ("2", K_B))
    }
    rig = {"ar0820": {"extrinsics": {"0_2": pose}, "intrinsics": optics}}
    (root / "poses" / "wk2").mkdir(parents=True)
    (root / "poses" / "wk2" / "CAPT-1.json").write_text(json.dumps({"CAPT-1": rig}))
    return root


def _truck_list(root: Path, left: str = "0", right: str = "2", week: str = "wk2") -> Path:
    images = [f"torc/CAPT-1/dusk_CAPT-1/image{i}/f{i}_7.png" for i in (left, right)]
    path = root / "list.csv"
    path.write_text(",".join(["torc", week, "CAPT-1", "ar0820", left, right, *images]) + "\n")
    return path


def test_semi_truck_shows_points_where_its_calibration_says(tmp_path: Path) -> None:
    pair = open_source(_truck_list(_semi_truck(tmp_path)))[0]
    _require_dots(pair, _points(), limit=0.1)
    assert pair.daylight == "dusk"
    assert pair.scene == "wk2 CAPT-1"


def test_semi_truck_pair_in_the_other_order_has_the_inverse_pose(tmp_path: Path) -> None:
    pair = open_source(_truck_list(_semi_truck(tmp_path), "2", "0"))[0]
    np.testing.assert_allclose(pair.T_right_left, inverse(T_RIGHT_LEFT), atol=1e-12)
    np.testing.assert_allclose(pair.K_left, K_B)


def test_semi_truck_without_calibration_is_refused(tmp_path: Path) -> None:
    pairs = open_source(_truck_list(_semi_truck(tmp_path), week="wk9"))
    with pytest.raises(UserError, match=r"no calibration of wk9/CAPT-1, ar0820; have wk2/CAPT-1"):
        pairs[0]


# --- shards ------------------------------------------------------------------------------------


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    return write_set(tmp_path / "set", [make_frame(i) for i in (0, 1, 2)])


def test_shards_yield_each_pair_of_their_split(shards: Path) -> None:
    assert [len(open_source(shards, split=s)) for s in ("train", "test", None)] == [6, 3, 9]
    assert str(open_source(shards, split="train")).endswith("simgen shards, train: 6 pairs")
    pair = open_source(shards, split="train")[1]
    assert (pair.name, pair.scene) == ("frame 1, cameras 1 and 2", "1")
    assert (pair.weather, pair.daylight) == ("partly_cloudy", "noon")


def test_pairs_without_truth_read_neither_depth_nor_visibility(shards: Path, monkeypatch) -> None:
    whole = open_source(shards, split="test")[1]
    known, read = [], Frame.read

    def noted(frame: Frame, name: str, which: int | None = None) -> np.ndarray:
        known.append(name)
        return read(frame, name, which)

    monkeypatch.setattr(Frame, "read", noted)
    pair = open_source(shards, split="test", truth_points=0)[1]
    assert pair.truth is None
    assert whole.truth is not None
    assert not {"depth", "flow_status"} & set(known)
    np.testing.assert_array_equal(pair.T_right_left, whole.T_right_left)
    np.testing.assert_array_equal(pair.right, whole.right)


@pytest.mark.parametrize("position", [0, 1, 2])
def test_shards_truth_ends_where_the_stored_flow_does(
    shards: Path, position: int, worst: Callable[..., None]
) -> None:
    pair = open_source(shards, split="test", truth_points=None)[position]
    with h5py.File(shards / "test-00000.h5") as file:
        flow, status = file["flow"][0, position], file["flow_status"][0, position]
    truth = pair.truth
    assert truth is not None
    assert len(truth.depth) == flow[..., 0].size
    np.testing.assert_array_equal(truth.visible, (status.ravel() & 1) > 0)
    u, v = np.meshgrid(np.arange(96), np.arange(54))
    ends = np.stack([u, v], axis=-1).reshape(-1, 2) + flow.reshape(-1, 2)
    worst("rays against flow", project(pair.K_right, truth.rays_right) - ends, 1e-3)


@pytest.mark.parametrize("position", [0, 1, 2])
def test_shards_reversed_truth_ends_where_the_reverse_flow_does(
    shards: Path, position: int, worst: Callable[..., None]
) -> None:
    pairs = open_source(shards, split="test", truth_points=None).in_both_directions()
    forward, pair = pairs[2 * position], pairs[2 * position + 1]
    frame = ShardSet(shards, "test")[0]
    flow, status = frame.reverse_flow(position), frame.read("flow_status_reverse", position)
    np.testing.assert_array_equal(pair.left, forward.right)
    np.testing.assert_allclose(pair.T_right_left, inverse(forward.T_right_left), atol=1e-12)
    np.testing.assert_array_equal(pair.turn_left, forward.turn_right)
    np.testing.assert_array_equal(pair.truth.visible, (status.ravel() & 1) > 0)
    u, v = np.meshgrid(np.arange(96), np.arange(54))
    ends = np.stack([u, v], axis=-1).reshape(-1, 2) + flow.reshape(-1, 2)
    worst("reversed rays", project(pair.K_right, pair.truth.rays_right) - ends, 1e-3)


def test_shards_turns_are_the_drawn_perturbations(shards: Path) -> None:
    pair = open_source(shards, split="test")[2]
    drawn = make_frame(0)["perturbation_deg"]
    np.testing.assert_allclose(pair.turn_left, cv2.Rodrigues(np.deg2rad(drawn[0]))[0], atol=1e-12)
    np.testing.assert_allclose(pair.turn_right, cv2.Rodrigues(np.deg2rad(drawn[2]))[0], atol=1e-12)
    zero = np.zeros(3)
    expected = transform(pair.turn_right.T, zero) @ pair.T_right_left_nominal
    expected = expected @ transform(pair.turn_left, zero)
    np.testing.assert_allclose(pair.T_right_left, expected, atol=1e-12)


def test_set_without_train_frames_is_refused(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", [make_frame(0), make_frame(10)])
    with pytest.raises(UserError, match=r"no train frames among its 2\..*a larger --n"):
        open_source(folder, split="train")


def test_empty_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a set without a frame"):
        open_source(write_set(tmp_path / "set", []))


def test_missing_shard_is_refused(shards: Path) -> None:
    (shards / "train-00000.h5").unlink()
    with pytest.raises(UserError, match=r"1 of 1 shards are missing, first train-00000.h5"):
        open_source(shards, split="train")


def test_foreign_shard_is_refused(shards: Path) -> None:
    with h5py.File(shards / "train-00000.h5", "w") as file:
        file["image"] = np.zeros(3)
    with pytest.raises(UserError, match="no shard of simgen"):
        open_source(shards, split="train")[0]


# --- anything else -----------------------------------------------------------------------------


def test_unknown_layout_says_what_it_found_and_expected(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match=r"it holds notes.txt.\nExpected one of\n  manifest.json"):
        open_source(tmp_path)
    with pytest.raises(UserError, match="no such folder or list"):
        open_source(tmp_path / "nothing")
    (tmp_path / "list.csv").write_text("a,b\n")
    with pytest.raises(UserError, match=r"list.csv: a list of 2 columns"):
        open_source(tmp_path / "list.csv")


def test_split_of_a_layout_that_has_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="split 'train' is known for rendered sets only"):
        open_source(_folder(tmp_path), split="train")


def test_images_of_two_sizes_are_refused() -> None:
    left, right = np.zeros((180, 320, 3), np.uint8), np.zeros((176, 320, 3), np.uint8)
    with pytest.raises(UserError, match=r"x: the left image is 320x180, the right one 320x176"):
        Pair(left, right, K_A, K_B, None, T_RIGHT_LEFT, name="x")


def test_intrinsics_of_another_size_are_refused() -> None:
    image = np.zeros((360, 640, 3), np.uint8)
    with pytest.raises(UserError, match=r"K_left has its principal point at \(161.0, 88.0\), far"):
        Pair(image, image, K_A, K_B, None, T_RIGHT_LEFT, name="x")
    with pytest.raises(UserError, match=r"K_right is\n.*\n.*\n.*\nexpected \(3, 3\)"):
        Pair(image, image, intrinsics((640, 360), 90), K_A.T, None, T_RIGHT_LEFT, name="x")
