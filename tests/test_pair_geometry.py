"""Crop, area filter, turn, swap, mirror: dots land where K and the rays say; poses stay in step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted import SIGMA, WH, away_from_border, centroids, painted_pair

from flowrect.augment import Augmentation, augmented, mirrored, recoloured, swapped
from flowrect.metrics import METRIC_WH
from flowrect.resize import Box, Sizing, cropped, resized, resized_image, sized, window_intrinsics
from flowrect.sample import Pair
from flowrect.turn import draw_turn, largest_keep, turned
from simgen.errors import UserError
from simgen.geometry import project

PLAIN = Augmentation(brightness=0, contrast=0, saturation=0, hue_deg=0)
BOX = Sizing(keep=0.88).box(WH)


def _turned(pair: Pair) -> Pair:
    rng = np.random.default_rng(5)
    return turned(pair, draw_turn(1.0, rng=rng), draw_turn(1.0, rng=rng), BOX, METRIC_WH)


def _augmented(pair: Pair, which: int, **changes: float) -> Pair:
    options = replace(PLAIN, **changes)
    rng = np.random.default_rng(8)
    return augmented(pair, Sizing(keep=0.88), options, rng=rng)[which]


OPERATIONS: dict[str, Callable[[Pair], Pair]] = {
    "crop": lambda p: cropped(p, Box(37, 12, 500, 300)),
    "area filter": lambda p: resized(p, (320, 180)),
    "area filter by no whole number": lambda p: resized(p, (389, 219)),
    "stretch": lambda p: sized(p, Sizing((300, 256), fit="stretch")).input,
    "one side up, one down": lambda p: resized(p, (500, 400)),
    "enlarge": lambda p: resized(p, (800, 450)),
    "network input": lambda p: sized(p, Sizing()).input,
    "metric size": lambda p: sized(p, Sizing(keep=0.9)).metric,
    "swap": swapped,
    "mirror": mirrored,
    "turn": _turned,
    "turn of a mirrored pair": lambda p: _turned(mirrored(p)),
    "mirror of a turned pair": lambda p: mirrored(_turned(p)),
    "mirror of a vertical rig": lambda _: mirrored(painted_pair(vertical=True)),
    "augmented vertical rig": lambda _: _augmented(painted_pair(vertical=True), 1, mirror=1),
    "swap of a turned pair": lambda p: swapped(_turned(p)),
    "augmented, network input": lambda p: _augmented(p, 0, mirror=0),
    "augmented, metric size": lambda p: _augmented(p, 1, mirror=0),
    "augmented and mirrored": lambda p: _augmented(p, 1, mirror=1),
    "augmented and swapped": lambda p: _augmented(p, 1, mirror=0, swap=1),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_dots_land_where_intrinsics_and_rays_say(name: str, worst: Callable[..., None]) -> None:
    pair = OPERATIONS[name](painted_pair())
    assert pair.truth is not None
    for image, K, rays in (
        (pair.left, pair.K_left, pair.truth.rays_left),
        (pair.right, pair.K_right, pair.truth.rays_right),
    ):
        radius = int(4 * SIGMA * K[0, 0] / 300) + 1
        uv = project(K, rays)
        uv = uv[away_from_border(uv, pair.wh, radius + 1)]
        assert len(uv) > 20
        worst("dots against rays", centroids(image, uv, radius) - uv, 0.05)


@pytest.mark.parametrize("name", OPERATIONS)
def test_pose_takes_left_points_to_right_rays(name: str) -> None:
    pair = OPERATIONS[name](painted_pair())
    assert pair.truth is not None
    assert pair.T_right_left is not None
    points = pair.truth.depth[:, None] * pair.truth.rays_left
    seen = points @ pair.T_right_left[:3, :3].T + pair.T_right_left[:3, 3]
    np.testing.assert_allclose(seen / seen[:, 2:], pair.truth.rays_right, atol=1e-12)


@pytest.mark.parametrize("name", OPERATIONS)
def test_pose_is_the_nominal_one_between_turned_cameras(name: str) -> None:
    pair = OPERATIONS[name](painted_pair())
    T, nominal = pair.T_right_left, pair.T_right_left_nominal
    assert T is not None
    R = pair.turn_right.T @ nominal[:3, :3] @ pair.turn_left
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], pair.turn_right.T @ nominal[:3, 3], atol=1e-12)


def test_swap_and_mirror_are_their_own_inverses() -> None:
    pair = painted_pair()
    for twice in (swapped(swapped(pair)), mirrored(mirrored(pair))):
        for field in ("left", "right", "K_left", "T_right_left", "turn_right"):
            np.testing.assert_allclose(getattr(twice, field), getattr(pair, field), atol=1e-12)


def test_mirrored_rig_stays_left_first_and_swapped_one_does_not() -> None:
    pair = painted_pair()
    assert mirrored(pair).T_right_left_nominal[0, 3] < 0 < swapped(pair).T_right_left_nominal[0, 3]


def test_mirrored_vertical_rig_keeps_its_upper_camera_first() -> None:
    pair = painted_pair(vertical=True)
    mirror = mirrored(pair)
    np.testing.assert_array_equal(mirror.left, pair.left[:, ::-1])
    assert mirror.T_right_left_nominal[1, 3] == pair.T_right_left_nominal[1, 3] < 0
    np.testing.assert_allclose(mirrored(mirror).T_right_left, pair.T_right_left, atol=1e-15)


# --- sizes -------------------------------------------------------------------------------------


def test_window_of_a_rendered_frame_is_the_middle_2_to_1() -> None:
    assert Sizing().box((2560, 1440)) == Box(0, 80, 2560, 1280)
    assert Sizing((1024, 512)).box((512, 288)) == Box(0, 16, 512, 256)
    assert Sizing().box((1242, 375)) == Box(246, 0, 750, 375)
    assert Sizing((300, 200), fit="stretch").box((1241, 376)) == Box(0, 0, 1241, 376)
    assert Sizing((300, 200), fit="stretch", keep=0.9).box((1241, 376)) == Box(62, 19, 1116, 338)


def test_whole_number_area_filter_is_the_block_mean() -> None:
    image = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    blocks = image.reshape(6, 4, 8, 4, 3).mean(axis=(1, 3))
    assert np.abs(resized_image(image, (8, 6)) - blocks).max() <= 0.51


def test_sized_is_crop_and_cv2_area() -> None:
    pair = painted_pair()
    prepared = sized(pair, Sizing())
    middle = pair.left[20:340]
    for result, wh in ((prepared.input, (256, 128)), (prepared.metric, METRIC_WH)):
        np.testing.assert_array_equal(result.left, cv2.resize(middle, wh, interpolation=3))
        assert result.K_left[0, 0] == pytest.approx(pair.K_left[0, 0] * wh[0] / 640)


def test_window_that_no_image_holds_is_refused() -> None:
    with pytest.raises(UserError, match=r"input_wh 640x360: expected twice as wide .* 720x360"):
        Sizing((640, 360))
    with pytest.raises(UserError, match=r"0 < keep <= 1"):
        Sizing(keep=0.0)
    with pytest.raises(UserError, match=r"an image of 1x1 is too small"):
        Sizing().box((1, 1))


# --- turns -------------------------------------------------------------------------------------


@pytest.mark.parametrize("wh, finer", [(METRIC_WH, 1), ((256, 128), 2)])
def test_turned_equals_cv2_rectification_maps(wh: tuple[int, int], finer: int) -> None:
    pair, turn = replace(painted_pair(), left=_smooth(), right=_smooth()), np.eye(3)
    result = turned(pair, turn, turn, BOX, wh)
    fine = finer * wh[0], finer * wh[1]
    K_fine = window_intrinsics(pair.K_left, BOX, fine)
    maps = cv2.initUndistortRectifyMap(
        pair.K_left, None, pair.turn_left, K_fine, fine, cv2.CV_32FC1
    )
    remapped = cv2.remap(pair.left, *maps, cv2.INTER_LINEAR)
    expected = cv2.resize(remapped, wh, interpolation=cv2.INTER_AREA)
    assert np.abs(result.left.astype(int) - expected).max() <= 2
    assert np.abs(result.left.astype(int) - expected).mean() < 0.5


def _smooth() -> np.ndarray:
    noise = np.random.default_rng(3).integers(0, 256, (WH[1], WH[0], 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 4)


def test_turning_to_the_present_turns_changes_no_pose() -> None:
    pair = painted_pair()
    same = turned(pair, pair.turn_left, pair.turn_right, BOX, METRIC_WH)
    np.testing.assert_allclose(same.T_right_left, pair.T_right_left, atol=1e-14)
    window = resized(cropped(pair, BOX), METRIC_WH)
    np.testing.assert_allclose(same.K_left, window.K_left, atol=1e-12)
    assert np.abs(same.left.astype(int) - window.left).max() <= 16  # interpolated, not averaged


def test_rectified_real_pair_can_be_turned() -> None:
    rectified = painted_pair(turn_deg=0.0)
    result = _turned(rectified)
    rng = np.random.default_rng(5)
    left, right = draw_turn(1.0, rng=rng), draw_turn(1.0, rng=rng)
    R = rectified.T_right_left_nominal[:3, :3]
    np.testing.assert_allclose(result.T_right_left[:3, :3], right.T @ R @ left, atol=1e-14)


def test_no_draw_leaves_the_largest_window() -> None:
    rng = np.random.default_rng(0)
    pair = replace(painted_pair(), left=_black(), right=_black())
    keep = largest_keep(pair, Sizing(), 2.0)
    assert 0.8 < keep < 0.95
    box = Sizing(keep=keep).box(WH)
    corners = np.deg2rad([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    old = [cv2.Rodrigues(a)[0] for a in corners]
    for _ in range(100):
        stands = replace(pair, turn_left=old[rng.integers(8)], turn_right=draw_turn(1.0, rng=rng))
        turned(stands, old[rng.integers(8)], old[rng.integers(8)], box, (64, 32))


def _black() -> np.ndarray:
    return np.zeros((WH[1], WH[0], 3), np.uint8)


def test_window_that_would_show_an_empty_border_is_refused() -> None:
    pair, box = painted_pair(), Sizing(keep=1.0).box(WH)
    with pytest.raises(UserError, match=r"painted 0: turned by .* deg, .* keep less of the image"):
        turned(pair, np.eye(3), np.eye(3), box, METRIC_WH)
    with pytest.raises(UserError, match="turns of 80 deg leave nothing of the image in view"):
        largest_keep(pair, Sizing(), 80.0)


def test_validity_mask_tells_nothing_about_the_rotation() -> None:
    pair, sizing = painted_pair(), Sizing((64, 32), keep=0.88)
    sights = [
        augmented(pair, sizing, replace(PLAIN, mirror=0), rng=np.random.default_rng(s)).input
        for s in range(150)
    ]
    assert _explained_by_mask(pair, sights) == pytest.approx(0.0, abs=1e-9)


def test_black_border_would_tell_the_rotation() -> None:
    """What the test above guards against: it can fail."""
    pair, rng = painted_pair(), np.random.default_rng(0)
    whole = sized(pair, Sizing((64, 32))).input
    sights = [replace(whole, turn_left=draw_turn(1.0, rng=rng)) for _ in range(150)]
    assert _explained_by_mask(pair, sights) > 0.2


def _explained_by_mask(pair: Pair, sights: list[Pair]) -> float:
    """Share of the left turns' variance that a linear model of the masks explains, held out."""
    x = np.array([_mask(pair, s).ravel() for s in sights], dtype=float)
    y = np.array([cv2.Rodrigues(s.turn_left)[0].ravel() for s in sights])
    seen, x, y_seen, y = x[:110], x[110:], y[:110], y[110:]
    centred = seen - seen.mean(0)
    weights = centred.T @ np.linalg.solve(centred @ centred.T + np.eye(110), y_seen)
    error = y - (x - seen.mean(0)) @ weights
    return 1 - float(np.square(error).mean() / np.square(y).mean())


def _mask(pair: Pair, sight: Pair) -> np.ndarray:
    """Where the left view of a sight shows the old image, from its K and turn alone."""
    G = sight.turn_left.T @ pair.turn_left
    H_new_old = sight.K_left @ G @ np.linalg.inv(pair.K_left)
    white = np.full((WH[1], WH[0]), 255, np.uint8)
    return cv2.warpPerspective(white, H_new_old, sight.wh, flags=cv2.INTER_NEAREST) > 0


# --- colour and draws --------------------------------------------------------------------------


def test_colour_changes_grey_levels_and_nothing_else() -> None:
    pair = painted_pair()
    brighter = 1.5 * np.hstack([np.eye(3), np.zeros((3, 1))])
    result = recoloured(pair, brighter, np.hstack([np.eye(3), np.zeros((3, 1))]))
    np.testing.assert_array_equal(result.right, pair.right)
    expected = np.clip(np.round(1.5 * pair.left.astype(float)), 0, 255)
    assert np.abs(result.left - expected).max() <= 1
    assert result.K_left is pair.K_left


def test_hue_and_saturation_leave_grey_grey() -> None:
    pair = painted_pair()
    options = Augmentation(
        turn_deg=0, mirror=0, brightness=0, contrast=0, saturation=0.5, hue_deg=30
    )
    rng = np.random.default_rng(0)
    result = augmented(pair, Sizing(), options, rng=rng).input
    expected = sized(pair, Sizing()).input
    assert np.abs(result.left.astype(int) - expected.left).max() <= 1


def test_same_generator_gives_the_same_sight_and_another_gives_another() -> None:
    pair, sizing = painted_pair(), Sizing(keep=0.85)
    a, b, c = (
        augmented(pair, sizing, Augmentation(), rng=np.random.default_rng(s)).input
        for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(a.left, b.left)
    assert not np.array_equal(a.turn_left, c.turn_left)
    assert not np.array_equal(a.turn_left, a.turn_right)
