"""What a user does: images and a calibration in; aligned rows, files and clear words out."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_network import TINY_PAPER, network

from flowrect import rectify
from flowrect.calibration import Calibration, projections
from flowrect.estimate import Calibrator
from flowrect.files import read_rgb
from flowrect.formats import opencv, read_calibration
from flowrect.matchers import sift
from flowrect.matches import Matches
from flowrect.methods import FromMatches, Network, PoseEstimate, Seconds
from flowrect.model import Prediction, Rectifier
from flowrect.overlay import TILE_PX, View, choose_matches, draw_overlay
from flowrect.quality import MIN_MATCHES, MatchedRays, sift_matches
from flowrect.rectify import PairFiles, main, rectify_pair, write_rgb
from flowrect.sample import Image
from flowrect.solvers import SOLVERS, NoSolution
from flowrect.weights import Card, save_weights
from simgen.errors import UserError
from simgen.geometry import Array, project, transform

WH = (400, 240)
K = np.array([[210.0, 0, 203.0], [0, 212.0, 117.0], [0, 0, 1]])
DIST = np.array([-0.2, 0.05, 0.001, -0.001, 0.0])
NOMINAL = transform(np.eye(3), np.array([-0.4, 0.0, 0.0]))
TURN = Rotation.from_rotvec([1.1, -0.8, 0.9], degrees=True).as_matrix()
NEARLY = Rotation.from_rotvec([0.7, -0.4, 0.6], degrees=True).as_matrix()
RIG = Calibration(K, K, NOMINAL, WH)
LENS = replace(RIG, dist_left=DIST, dist_right=0.5 * DIST)
VERTICAL = replace(RIG, T_right_left=transform(np.eye(3), np.array([0.0, -0.4, 0.0])))
CARD = Card(preset="custom", prior_range_deg=(2.0, 2.0, 2.0))


# --- a textured wall, ray by ray


@cache
def texture() -> np.ndarray:
    """(1200, 1200, 3) smooth coloured noise of several scales."""
    rng = np.random.default_rng(5)
    layers = [
        cv2.resize(rng.normal(size=(n, n, 3)), (1200, 1200), interpolation=cv2.INTER_CUBIC)
        for n in (40, 100, 250)
    ]
    return (128 + 45 * sum(layers)).clip(0, 255).astype(np.uint8)


def photograph(K: Array, dist: Array, R: Array, t: Array) -> Image:
    """The wall, leaning back from 5 m on, as a camera with X_cam = R X_world + t sees it."""
    u, v = np.meshgrid(np.arange(WH[0], dtype=np.float64), np.arange(WH[1]))
    uv = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = np.ones((uv.shape[0], 3))
    rays[:, :2] = cv2.undistortPoints(uv, K, dist).reshape(-1, 2)
    rays, centre = rays @ R, -R.T @ t
    normal = np.array([0.0, 0.35, 1.0])  # of the plane normal . X = 5
    X = centre + rays * ((5 - normal @ centre) / (rays @ normal))[:, None]
    places = (600 + 45 * X[:, :2]).astype(np.float32).reshape(*u.shape, 2)
    return cv2.remap(texture(), places[..., 0], places[..., 1], cv2.INTER_LINEAR)


RIGS = {"pinhole": RIG, "lens": LENS, "vertical": VERTICAL}


def pose_now(rig: Calibration) -> Array:
    """T_right_left of a rig whose left camera has turned about its own centre: t stays."""
    return rig.T_right_left @ transform(TURN, np.zeros(3))


@cache
def photographs(rig_name: str) -> tuple[Image, Image]:
    """What the turned rig sees."""
    rig = RIGS[rig_name]
    T = pose_now(rig)
    return (
        photograph(rig.K_left, rig.dist_left, np.eye(3), np.zeros(3)),
        photograph(rig.K_right, rig.dist_right, T[:3, :3], T[:3, 3]),
    )


def take(folder: Path, rig_name: str = "pinhole", name: str = "a") -> PairFiles:
    """Files of what the turned rig sees."""
    files = PairFiles(name, folder / "left" / f"{name}.png", folder / "right" / f"{name}.png")
    for path, image in zip(files[1:], photographs(rig_name), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_rgb(path, image)
    return files


class Knowing(Rectifier):
    """A network that knows the rotation."""

    R: Array

    def forward(self, *inputs: torch.Tensor) -> Prediction:
        return replace(super().forward(*inputs), R=torch.from_numpy(self.R)[None])


def knowing(R: Array) -> Network:
    net = Knowing(TINY_PAPER).eval()
    net.R = R
    return Network(Calibrator(net, CARD))


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A network that was never trained: its correction is 0, so the prediction is the prior."""
    path = tmp_path / "tiny.safetensors"
    save_weights(path, network(TINY_PAPER), CARD)
    return path


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """left/ and right/ with pairs a and b, and rig.yaml."""
    for name in ("b", "a"):
        take(tmp_path, name=name)
    opencv.write(tmp_path / "rig.yaml", RIG)
    return tmp_path


def command(folder: Path, *more: object, left: str = "left", right: str = "right") -> list[str]:
    files = [folder / left, folder / right, "--calib", folder / "rig.yaml", "--out", folder / "out"]
    weights = ["--method", "network", "--weights", folder / "tiny.safetensors"]
    return [str(x) for x in (*files, *weights, *more)]


def summary(folder: Path) -> list[dict[str, str]]:
    with (folder / "out" / "summary.csv").open(newline="") as file:
        return list(csv.DictReader(file))


# --- rows


@pytest.mark.parametrize("rig_name", RIGS)
def test_the_true_rotation_aligns_the_rows_of_a_textured_pair(rig_name, tmp_path, worst):
    result = rectify_pair(knowing(TURN), "truth", RIGS[rig_name], take(tmp_path, rig_name))
    found = sift_matches(result.left, result.right, np.eye(3), np.eye(3))  # rays are pixels
    across = (found.rays_right - found.rays_left)[:, 0 if result.rectification.vertical else 1]
    assert len(found) > 200
    worst("rows of a rectified pair, median by SIFT", np.median(np.abs(across)), 0.1)
    assert result.quality.after_px < 0.1 < 3 < result.quality.before_px
    assert result.quality.notes == ()


def test_the_written_files_rectify_as_cv2_does_with_them(tmp_path):
    files = take(tmp_path, "lens")
    result = rectify_pair(knowing(TURN), "truth", LENS, files)
    rectify.write_result(tmp_path, result)
    storage = cv2.FileStorage(str(tmp_path / "opencv.yaml"), cv2.FILE_STORAGE_READ)
    get = {n: storage.getNode(n).mat() for n in ("K_right", "dist_right", "R2", "P2", "R", "T")}
    maps = cv2.initUndistortRectifyMap(
        get["K_right"], get["dist_right"], get["R2"], get["P2"], WH, cv2.CV_32FC1
    )
    ours = read_rgb(tmp_path / "right.png")
    theirs = cv2.remap(read_rgb(files.right), *maps, cv2.INTER_CUBIC)
    assert np.abs(ours.astype(int) - theirs).max() <= 1
    np.testing.assert_allclose(get["R"], TURN, atol=1e-12)
    np.testing.assert_allclose(get["T"][:, 0], NOMINAL[:3, 3], atol=1e-12)


def test_all_formats_hold_the_corrected_pose(tmp_path):
    rectify.write_result(tmp_path, rectify_pair(knowing(TURN), "truth", RIG, take(tmp_path)))
    for names in (["opencv.yaml"], ["camchain.yaml"], ["ros_left.yaml", "ros_right.yaml"]):
        rig = read_calibration([tmp_path / name for name in names])
        expected = transform(TURN, NOMINAL[:3, 3])
        np.testing.assert_allclose(rig.T_right_left, expected, atol=1e-9, err_msg=names[0])


def test_a_lens_that_kalibr_cannot_hold_costs_its_file_and_is_said(tmp_path):
    rig = replace(RIG, dist_left=np.array([0, 0, 0, 0, 0.01]))
    notes = rectify.write_result(
        tmp_path, rectify_pair(knowing(TURN), "truth", rig, take(tmp_path))
    )
    assert notes == ["no camchain.yaml: Kalibr's radtan ends at k1, k2, p1, p2; the lens has more."]
    assert not (tmp_path / "camchain.yaml").exists()


def test_the_fit_mends_what_a_network_leaves_and_knows_how_well(tmp_path):
    method = FromMatches("sift", SOLVERS["5dof"], start=knowing(NEARLY))
    result = rectify_pair(method, "fitted", RIG, take(tmp_path))
    error = Rotation.from_matrix(TURN @ result.rig.T_right_left[:3, :3].T).as_rotvec(degrees=True)
    assert result.quality.sigma_deg is not None
    assert (np.abs(error) < 4 * np.array(result.quality.sigma_deg)).all()
    assert np.abs(error).max() < 0.1 < 0.4
    t, true_t = result.rig.T_right_left[:3, 3], NOMINAL[:3, 3]
    assert np.linalg.norm(np.cross(t, true_t)) < np.deg2rad(0.3) * (true_t @ true_t)
    assert result.quality.num_inliers > 100
    assert result.quality.notes == ()


def test_what_a_network_says_stands_where_there_are_no_matches_and_is_noted(tmp_path):
    files = take(tmp_path)
    for path, grey in ((files.left, 100), (files.right, 101)):
        write_rgb(path, np.full((*WH[::-1], 3), grey, np.uint8))
    method = FromMatches("sift", SOLVERS["5dof"], start=knowing(TURN))
    result = rectify_pair(method, "fitted", RIG, files)
    np.testing.assert_allclose(result.rig.T_right_left[:3, :3], TURN, atol=1e-12)
    assert any("not refined by matches: only 0 matches" in n for n in result.quality.notes)
    with pytest.raises(UserError, match="no pose found: only 0 matches, expected at least 30"):
        rectify_pair(FromMatches("sift", SOLVERS["5dof"]), "alone", RIG, files)


def test_the_bar_of_the_fit_counts_from_the_prior_and_not_from_where_a_network_ends():
    """A network that is led astray would carry the 10° along."""
    far = Rotation.from_rotvec([8.0, -6.0, 5.0], degrees=True).as_matrix()
    half = Rotation.from_rotvec([4.0, -3.0, 2.5], degrees=True).as_matrix()
    grid = np.stack(np.meshgrid([-1.0, 0, 1], [-0.5, 0, 0.5], [4.0, 7, 12, 30, 60]), -1)
    points = (grid.reshape(-1, 3) * [[1, 1, 0]] + [[0, 0, 1]]) * grid.reshape(-1, 3)[:, 2:]
    ends = points, points @ far.T + NOMINAL[:3, 3]
    matches = Matches(*(project(K, x) for x in ends))
    images = (np.full((*WH[::-1], 3), grey, np.uint8) for grey in (100, 101))
    given = matches, Seconds(), *images, K, K, NOMINAL
    with pytest.raises(NoSolution, match="11° away from the prior, expected at most 10°"):
        FromMatches("sift", SOLVERS["5dof"]).of_matches(*given)
    estimate = FromMatches("sift", SOLVERS["5dof"], start=knowing(half)).of_matches(*given)
    np.testing.assert_allclose(estimate.R, half)
    assert "not refined by matches: the best pose is 11° away" in estimate.notes[-1]


def test_a_network_of_horizontal_rigs_is_not_the_last_word_on_vertical_ones(tmp_path):
    def unlike(*_: object) -> PoseEstimate:
        raise NoSolution("images hardly match")

    method = FromMatches("sift", SOLVERS["5dof"], start=unlike)
    result = rectify_pair(method, "fitted", VERTICAL, take(tmp_path, "vertical"))
    error = Rotation.from_matrix(
        pose_now(VERTICAL)[:3, :3] @ result.rig.T_right_left[:3, :3].T
    ).as_rotvec(degrees=True)
    assert np.abs(error).max() < 0.1
    assert "horizontal rigs only, is left out: images hardly match" in result.quality.notes[0]
    with pytest.raises(UserError, match="no pose found: images hardly match"):
        rectify_pair(method, "fitted", RIG, take(tmp_path))
    blank = np.full((*WH[::-1], 3), 100, np.uint8)
    with pytest.raises(NoSolution, match="only 0 matches"):  # the prior does not stand
        method(blank, blank, K, K, VERTICAL.T_right_left)


def test_an_estimate_that_makes_rows_worse_is_noted(tmp_path):
    true = replace(RIG, T_right_left=pose_now(RIG))
    result = rectify_pair(knowing(np.eye(3)), "wrong", true, take(tmp_path))
    assert [note[:45] for note in result.quality.notes] == [
        "the estimate leaves more vertical disparity ("
    ]


# --- the check, and the picture


def points(n: int, rng: np.random.Generator) -> Array:
    return rng.uniform([-2, -1, 4], [2, 1, 20], (n, 3))


def test_true_matches_have_no_vertical_disparity_and_wrong_ones_do_not_move_the_median():
    rng, T = np.random.default_rng(0), pose_now(RIG)
    left = points(100, rng)
    right = left @ T[:3, :3].T + T[:3, 3]
    right[:30] = points(30, rng)
    matches = MatchedRays(left / left[:, 2:], right / right[:, 2:])
    assert matches.median_vertical_disparity(projections(T, K, K, WH)) < 1e-9
    assert matches.median_vertical_disparity(projections(NOMINAL, K, K, WH)) > 2


def test_too_few_matches_are_no_measurement():
    rays = np.ones((MIN_MATCHES - 1, 3))
    assert MatchedRays(rays, rays).median_vertical_disparity(projections(NOMINAL, K, K, WH)) is None


def test_sift_finds_a_shift_at_full_size_though_it_looks_at_less(monkeypatch):
    monkeypatch.setattr(sift, "QUICK", replace(sift.QUICK, max_pixels=40_000))
    image = texture()[:300, :400]
    found = sift_matches(image[8:], image[:-8], np.eye(3), np.eye(3))
    shift = np.median(found.rays_right - found.rays_left, axis=0)
    np.testing.assert_allclose(shift, [0, 8, 0], atol=0.05)


def view(rng: np.random.Generator, n: int = 300) -> View:
    left, right = rng.integers(0, 255, (2, WH[1], WH[0], 3), dtype=np.uint8)
    uv = rng.uniform(0, np.array(WH) - 1, (n, 2))
    return View("", left, right, uv, uv - np.array([20, 0]))


def test_a_turned_view_shows_the_same_pixels_at_its_matches():
    before = view(np.random.default_rng(1))
    uv = np.round(before.uv_left)
    after = replace(before, uv_left=uv).upright()
    (u, v), (u2, v2) = uv.astype(int).T, after.uv_left.astype(int).T
    np.testing.assert_array_equal(before.left[v, u], after.left[v2, u2])


def test_magnified_matches_lie_inside_and_apart():
    seen = view(np.random.default_rng(2))
    chosen = seen.uv_left[choose_matches(seen, seen)]
    assert len(chosen) == 6
    assert np.all((chosen > TILE_PX / 2) & (chosen < np.array(WH) - 1 - TILE_PX / 2))
    apart = np.linalg.norm(chosen[:, None] - chosen, axis=-1)[~np.eye(6, dtype=bool)]
    assert apart.min() > TILE_PX


@pytest.mark.parametrize("num", [0, 300])
@pytest.mark.parametrize("vertical", [False, True])
def test_an_overlay_is_drawn_with_and_without_matches(num, vertical):
    seen = view(np.random.default_rng(3), num)
    overlay = draw_overlay("title", seen, seen, vertical=vertical)
    assert overlay.shape[1:] == (1600, 3)
    assert (overlay[:30, :200] < 100).any()  # words


# --- the command


def test_a_pair_without_training_keeps_its_calibration(folders, weights, capsys):
    assert main(command(folders, left="left/a.png", right="right/a.png")) == 0
    assert sorted(p.name for p in (folders / "out" / "a").iterdir()) == [
        "camchain.yaml", "left.png", "opencv.yaml", "overlay.png", "quality.json", "right.png",
        "ros_left.yaml", "ros_right.yaml",
    ]  # fmt: skip
    quality = json.loads((folders / "out/a/quality.json").read_text())
    assert quality["before_px"] == quality["after_px"] > 3
    assert max(map(abs, quality["correction_deg"])) < 1e-6
    assert "px before" in capsys.readouterr().out


def test_folders_are_matched_by_name_and_summed_up(folders, weights, capsys):
    write_rgb(folders / "right" / "b.png", read_rgb(folders / "left" / "b.png"))
    assert main(command(folders)) == 2
    out = capsys.readouterr().out
    assert "b failed: the two images are identical" in out
    assert "rectified: 1 of 2 pairs" in out
    rows = summary(folders)
    assert [row["name"] for row in rows] == ["a"]
    assert float(rows[0]["before_px"]) > 3


def test_weights_of_a_method_that_takes_none_are_refused(folders, weights, capsys):
    others = [x.replace("network", "rpnet") for x in command(folders)]
    assert main(others) == 2
    assert "goes with --method network, network+3dof and network+5dof" in capsys.readouterr().err


def test_a_damaged_first_image_costs_its_pair_alone(folders, weights, capsys):
    (folders / "left" / "a.png").write_bytes(b"no image")
    assert main(command(folders)) == 2
    assert "a failed:" in capsys.readouterr().out
    assert [row["name"] for row in summary(folders)] == ["b"]


@pytest.mark.parametrize("side", ["left", "right"])
def test_sixteen_bits_are_refused_rather_than_cut(side, folders, weights, capsys):
    path = folders / side / "a.png"
    cv2.imwrite(str(path), 16 * cv2.imread(str(path)).astype(np.uint16))  # 12 bits
    assert main(command(folders)) == 2
    assert "samples of uint16, expected 8 bits" in capsys.readouterr().out.replace("\n", " ")


def test_pixels_lie_as_they_are_stored_whatever_a_viewer_is_told(tmp_path):
    image = photographs("pinhole")[0]
    write_rgb(tmp_path / "a.jpg", image)
    stored = (tmp_path / "a.jpg").read_bytes()
    tag = b"II*\0\x08\0\0\0\x01\0" + b"\x12\x01\x03\0\x01\0\0\0\x03\0\0\0" + bytes(4)
    exif = b"Exif\0\0" + tag  # orientation 3: upside down
    marker = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "turned.jpg").write_bytes(stored[:2] + marker + stored[2:])
    plain, turned = (str(tmp_path / name) for name in ("a.jpg", "turned.jpg"))
    assert not np.array_equal(cv2.imread(turned), cv2.imread(plain))
    np.testing.assert_array_equal(read_rgb(Path(turned)), read_rgb(Path(plain)))


def test_nothing_is_overwritten_unasked(folders, weights, capsys):
    mark = folders / "out" / "a" / "mark"
    mark.parent.mkdir(parents=True)
    mark.touch()
    assert main(command(folders, "--existing", "replace")) == 2
    assert "so it is not a result that could be replaced" in capsys.readouterr().err
    assert mark.exists()
    (mark.parent / "quality.json").write_text("{}")  # of somebody else; it is passed over
    assert main(command(folders)) == 2
    assert "holds results of 1 of 2 pairs, first a" in capsys.readouterr().err
    assert main(command(folders, "--existing", "keep")) == 0
    assert "kept: 1 of 2 pairs have a result already" in capsys.readouterr().out
    assert mark.exists()
    assert main(command(folders, "--existing", "replace")) == 0
    assert not mark.exists()


def test_a_folder_that_cannot_be_made_is_named(folders, weights, capsys):
    (folders / "out").touch()
    assert main(command(folders)) == 2
    assert "Choose another --out" in capsys.readouterr().err


def test_ctrl_c_keeps_what_is_done_and_leaves_nothing_half(folders, weights, capsys, monkeypatch):
    write, calls = rectify.write_result, []

    def interrupted(folder: Path, result: rectify.Rectified) -> list[str]:
        calls.append(folder)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return write(folder, result)

    monkeypatch.setattr(rectify, "write_result", interrupted)
    assert main(command(folders)) == 130
    assert "Go on with --existing keep" in capsys.readouterr().out
    assert sorted(p.name for p in (folders / "out").iterdir()) == ["a", "summary.csv"]
    assert main(command(folders, "--existing", "keep")) == 0
    assert [row["name"] for row in summary(folders)] == ["a", "b"]


def test_blank_images_are_noted(folders, weights, capsys):
    for side, grey in (("left", 100), ("right", 101)):
        write_rgb(folders / side / "a.png", np.full((*WH[::-1], 3), grey, np.uint8))
    assert main(command(folders, left="left/a.png", right="right/a.png")) == 0
    out = capsys.readouterr().out
    assert "the left image has almost no texture" in out
    assert "only 0 SIFT matches, 20 are needed: the result is unchecked" in out


def _remove_left(folder: Path) -> None:
    (folder / "left" / "a.png").unlink()


def _shrink(folder: Path) -> None:
    write_rgb(folder / "right" / "a.png", read_rgb(folder / "right" / "a.png")[:-1])


def _other_size(folder: Path) -> None:
    twice = np.diag([2, 2, 1.0]) @ K
    opencv.write(folder / "rig.yaml", Calibration(twice, twice, NOMINAL, (800, 480)))


def _k_of_other_size(folder: Path) -> None:
    """What is left of a calibration at 800x480 if only its size is changed."""
    _other_size(folder)
    text = (folder / "rig.yaml").read_text()
    (folder / "rig.yaml").write_text(text.replace(": 800", ": 400").replace(": 480", ": 240"))


def _no_calibration(folder: Path) -> None:
    (folder / "rig.yaml").unlink()


def _pickle(folder: Path) -> None:
    torch.save({}, folder / "tiny.safetensors")


def _no_weights(folder: Path) -> None:
    (folder / "tiny.safetensors").unlink()


def _garbage(folder: Path) -> None:
    (folder / "right" / "a.png").write_bytes(b"no image")


@pytest.mark.parametrize(
    "spoil, message",
    [
        (_remove_left, r"a.png: no such image or folder"),
        (_no_calibration, r"rig.yaml: no such calibration"),
        (_pickle, r"Pickles (.pt, .pth, .ckpt) are refused"),
        (_no_weights, r"expected a file or one of the shipped"),
        (_garbage, r"a.png: cannot be decoded as an image"),
    ],
)
def test_what_cannot_be_used_is_said(spoil, message, folders, weights, capsys):
    spoil(folders)
    assert main(command(folders, left="left/a.png", right="right/a.png")) == 2
    captured = capsys.readouterr()
    assert message in (captured.out + captured.err).replace("\n", " ")
    assert not list((folders / "out").glob("a*"))


@pytest.mark.parametrize("method", ["network", "sift+5dof"])
@pytest.mark.parametrize(
    "spoil, message",
    [
        (_shrink, r"a.png: an image of 400x239, but the calibration is for 400x240"),
        (_other_size, r"a.png: an image of 400x240, but the calibration is for 800x480"),
        (_k_of_other_size, r"principal point at (406.0, 234.0), far from the centre"),
    ],
)
def test_no_method_takes_a_calibration_of_other_images(
    spoil, message, method, folders, weights, capsys
):
    spoil(folders)
    arguments = command(folders, left="left/a.png", right="right/a.png")
    if method != "network":
        where = arguments.index("--method")
        arguments[where : where + 4] = ["--method", method]
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert message in (captured.out + captured.err).replace("\n", " ")
    assert not list((folders / "out").glob("a*"))


@pytest.mark.parametrize(
    "left, right, message",
    [
        ("left", "right/a.png", r"one is a folder, one is not"),
        ("left", ".", r"2 images stand in only one of .*, first 'a'"),
        (".", ".", r"no images in them"),
    ],
)
def test_folders_that_do_not_match_are_refused(left, right, message, folders):
    with pytest.raises(UserError, match=message):
        rectify.find_pairs(folders / left, folders / right)


def test_two_images_of_one_name_are_refused(folders):
    write_rgb(folders / "left" / "a.jpg", read_rgb(folders / "left" / "a.png"))
    with pytest.raises(UserError, match=r"a\.jpg and a\.png are one name"):
        rectify.find_pairs(folders / "left", folders / "right")
