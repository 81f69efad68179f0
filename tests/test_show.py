"""The picture of a frame: colours, rectification, and what a user may ask for wrongly."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_set import HW, PAIRS, make_frame, write_set

from simgen import paint, schema, show
from simgen.errors import UserError
from simgen.geometry import (
    inverse,
    pixel_grid,
    project,
    rectifying_rotations,
    transform_points,
)
from simgen.shards import Frame, ShardSet


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set"), [make_frame(i) for i in (1, 2)])


@pytest.fixture(scope="module")
def frame(folder: Path) -> Frame:
    return ShardSet(folder).frame(1)


# --- rectification -------------------------------------------------------------------------------


@pytest.mark.parametrize("pair", range(3))
def test_a_point_has_the_same_row_in_both_rectified_images(frame: Frame, pair: int) -> None:
    (left, right), K, T = PAIRS[pair], frame.K, frame.T_world_cam
    homographies = show.rectifying_homographies(K[left], K[right], inverse(T[right]) @ T[left])
    points = np.random.default_rng(0).uniform((4, -6, -1), (60, 6, 6), (200, 3))
    uv_left, uv_right = (
        project(H @ K[c], transform_points(inverse(T[c]), points))
        for c, H in zip((left, right), homographies, strict=True)
    )
    np.testing.assert_allclose(uv_left[:, 1], uv_right[:, 1], atol=1e-9)
    assert (uv_left[:, 0] > uv_right[:, 0]).all()


def test_rectified_images_are_aligned_to_a_fraction_of_a_pixel(tmp_path: Path) -> None:
    """Each pixel is painted with its rectified row, so rectified rows must be of one shade."""
    drawn = make_frame(1)
    left, right = PAIRS[2]
    T = drawn["T_world_cam"]
    rotations = rectifying_rotations(inverse(T[right]) @ T[left])
    for camera, R in zip((left, right), rotations, strict=True):
        K = drawn["K"][camera]
        rays = np.concatenate([pixel_grid(HW), np.ones((*HW, 1))], -1) @ np.linalg.inv(K).T
        row = project(K, rays @ R.T)[..., 1]
        drawn["image"][camera] = np.clip(4 * row + 20, 0, 255).round()[..., None]
    frame = ShardSet(write_set(tmp_path, [drawn])).frame(1)
    for image in show.rectified_pair(frame, 2):
        inner = image[4:-4, 8:-8].astype(float)
        expected = 4 * np.arange(HW[0])[4:-4, None, None] + 20
        assert np.abs(inner - expected).max() <= 1.0  # a quarter of a pixel


def test_the_flow_pulls_the_right_image_onto_the_left_one() -> None:
    rng = np.random.default_rng(0)
    left = rng.integers(0, 256, (6, 9, 3), dtype=np.uint8)
    right = np.roll(left, -2, axis=1)
    flow = np.tile(np.float32([-2, 0]), (6, 9, 1))
    status = np.full((6, 9), schema.VISIBLE, np.uint8)
    status[:, :2] = schema.OUT_OF_FRAME
    seen = show.pulled_back(right, flow, status)
    np.testing.assert_array_equal(seen[:, 2:], left[:, 2:])
    assert len(np.unique(seen[:, :2].reshape(-1, 3), axis=0)) == 1


# --- colours -------------------------------------------------------------------------------------


def test_flow_directions_have_the_colours_of_middlebury() -> None:
    """Values of colorcode.cpp at the rim: right, left, and no motion at all."""
    vectors = np.float32([[[1, 0], [-1, 0], [0, 0]]])
    expected = [[(255, 0, 0), (0, 209, 255), (255, 255, 255)]]
    np.testing.assert_array_equal(paint.flow_colors(vectors, 1.0), expected)


def test_the_flow_wheel_has_no_seam() -> None:
    angles = np.linspace(0, 2 * np.pi, 2000)
    vectors = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[None].astype(np.float32)
    colors = paint.flow_colors(vectors, 1.0001).astype(int)
    assert np.abs(np.diff(colors, axis=1)).max() < 5


def test_vectors_beyond_the_rim_are_darker() -> None:
    near, beyond = paint.flow_colors(np.float32([[[0.999, 0], [2, 0]]]), 1.0)[0].astype(int)
    assert beyond.sum() < 0.8 * near.sum()


def test_depth_colours_are_logarithmic_and_the_sky_has_its_own() -> None:
    depth = np.float32([[1, 10, 100, 1000, 0]])
    colors = paint.depth_colors(depth, (1.0, 100.0))[0]
    middle = paint.depth_colors(np.float32([[50.5]]), (1.0, 100.0))[0, 0]
    assert tuple(colors[4]) == paint.SKY_COLOR
    assert (colors[2] == colors[3]).all()
    assert (colors[1] != middle).any()
    assert len(np.unique(colors, axis=0)) == 4


def test_every_label_has_its_cityscapes_colour() -> None:
    for label, color in schema.LABEL_COLORS.items():
        if label != schema.LABELS["static"]:
            assert tuple(paint.label_colors(np.array([[label]], np.uint8))[0, 0]) == color


def test_an_instance_has_one_colour_wherever_it_is() -> None:
    first = paint.instance_colors(np.array([[0, 7, 8]], np.uint16))[0]
    second = paint.instance_colors(np.array([[900, 8, 7]], np.uint16))[0]
    assert (first[1] == second[2]).all()
    assert (first[2] == second[1]).all()
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 4


def test_every_status_can_be_told_from_the_others() -> None:
    visibility = (schema.VISIBLE, schema.OCCLUDED, schema.OUT_OF_FRAME)
    surface = (0, schema.AT_INFINITY, schema.GLASS)
    status = [a + b for a, b in itertools.product(visibility, surface)]
    colors = paint.status_colors(np.array([status], np.uint8))[0].astype(int)
    distances = np.abs(colors[:, None] - colors).sum(axis=-1)
    assert distances[~np.eye(len(colors), dtype=bool)].min() > 40


# --- the file ------------------------------------------------------------------------------------


def test_the_picture_is_a_png_of_the_promised_width(frame: Frame, tmp_path: Path) -> None:
    path = show.save_picture(frame, 1, tmp_path / "new" / "picture.png")
    image = cv2.imread(str(path))
    assert image.shape[1] == show.WIDTH_PX
    assert image.std() > 30


def test_a_frame_of_nothing_but_sky_can_be_drawn(tmp_path: Path) -> None:
    sky = make_frame(1)
    for name in ("depth", "flow", "instance", "semantic"):
        sky[name][:] = 0
    frame = ShardSet(write_set(tmp_path, [sky])).frame(1)
    assert show.save_picture(frame, 0, tmp_path / "sky.png").exists()


@pytest.mark.parametrize("pair", [-1, 3])
def test_a_pair_that_the_rig_lacks_is_refused(frame: Frame, tmp_path: Path, pair: int) -> None:
    match = rf"--pair {pair}: this set has 3 pairs \(0: cameras 0 and 1, 1: cameras 1 and 2"
    with pytest.raises(UserError, match=match):
        show.save_picture(frame, pair, tmp_path / "x.png")
    assert not (tmp_path / "x.png").exists()


def test_a_frame_that_the_set_lacks_is_refused(folder: Path) -> None:
    with pytest.raises(UserError, match="no frame 7; it has 2 frames, 1 to 2"):
        ShardSet(folder).frame(7)


def test_a_place_that_cannot_be_written_is_refused(frame: Frame, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"x\.png: cannot write the picture .*--out"):
        show.save_picture(frame, 0, tmp_path / "file" / "x.png")
