"""Rain against projection, energy and order: the same drops for all cameras, none behind walls."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from simgen import rain
from simgen.geometry import R_CAM_VEHICLE, intrinsics, rotation_from_vector, transform
from simgen.rain import Drops, Shower
from simgen.rig import Camera

WH = (320, 180)
SKY = np.full((64, 128, 3), 0.5, np.float32)
OPEN = np.full(WH[::-1], np.inf, np.float32)
ROAD = transform(rotation_from_vector(np.array([0, 0, 0.7])), np.array([30.0, -8.0, 2.0]))
SHOWER = Shower(8.0, 4e-3, (2.0, -1.0), 6.0, (3, 0, 5))


def camera(y_m: float) -> Camera:
    turned = rotation_from_vector(np.array([0.02, -0.03 * y_m, 0.05]))
    T_vehicle_cam = transform(R_CAM_VEHICLE.T @ turned, np.array([0, y_m, 1.5]))
    return Camera(intrinsics(WH, 80.0), ROAD @ T_vehicle_cam, WH)


CAMERAS = [camera(y) for y in (0.8, 0.0, -0.8)]


def falling(shower: Shower, seed: int = 0) -> Drops:
    return rain.falling(shower, CAMERAS, ROAD, rng=np.random.default_rng(seed))


def one_drop(diameter_m: float = 3e-3, ahead_m: float = 3.0) -> Drops:
    points = np.array([[ahead_m, 0.15, 1.62], [ahead_m - 0.02, 0.15, 1.57]]) @ ROAD[:3, :3].T
    start, end = points + ROAD[:3, 3]
    return Drops(np.array([diameter_m]), start[None], end[None])


def test_without_rain_there_is_no_shower():
    rng = np.random.default_rng(0)
    assert rain.draw_shower(0.0, "town", dark=False, num_lenses=3, rng=rng) is None


def test_nothing_changes_where_no_drop_is():
    radiance = np.random.default_rng(0).random((*WH[::-1], 3), dtype=np.float32)
    clear = rain.seen_through(radiance, np.zeros(WH[::-1], np.float32), SKY)
    np.testing.assert_allclose(clear, radiance, atol=1e-6)
    same = rain.through_wet_glass(radiance, 0, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(same, radiance)


@pytest.mark.parametrize("which", range(3))
def test_every_camera_sees_a_drop_where_it_projects(which: int):
    drop, seen_by = one_drop(), CAMERAS[which]
    hidden = rain.streaks(drop, seen_by, OPEN)
    v, u = np.indices(hidden.shape)
    centroid = np.array([(u * hidden).sum(), (v * hidden).sum()]) / hidden.sum()
    R, t = seen_by.T_cam_world[:3, :3], seen_by.T_cam_world[:3, 3]
    middle = (drop.start + drop.end) / 2
    expected, _ = cv2.projectPoints(middle, cv2.Rodrigues(R)[0], t, seen_by.K, None)
    np.testing.assert_allclose(centroid, expected.ravel(), atol=0.05)


@pytest.mark.parametrize("ahead_m", [0.8, 3.0, 8.0])
def test_a_streak_hides_the_area_of_its_drop(ahead_m: float):
    drop = one_drop(ahead_m=ahead_m)
    hidden = rain.streaks(drop, CAMERAS[1], OPEN)
    z = (CAMERAS[1].T_cam_world[:3] @ [*((drop.start + drop.end) / 2)[0], 1])[2]
    diameter_px = CAMERAS[1].K[0, 0] * drop.diameter_m[0] / z
    assert hidden.sum() == pytest.approx(np.pi / 4 * diameter_px**2, rel=0.02)


def test_drops_behind_a_wall_are_not_drawn():
    before, behind = (np.full(WH[::-1], d, np.float32) for d in (3.5, 2.5))
    assert rain.streaks(one_drop(), CAMERAS[1], before).sum() > 0
    assert rain.streaks(one_drop(), CAMERAS[1], behind).sum() == 0


def test_drops_behind_the_camera_are_not_drawn():
    assert rain.streaks(one_drop(ahead_m=-3.0), CAMERAS[1], OPEN).sum() == 0


def test_more_rain_hides_more_pixels():
    changed = [
        np.count_nonzero(
            rain.streaks(falling(replace(SHOWER, rate_mm_h=rate)), CAMERAS[0], OPEN) > 1e-3
        )
        for rate in (2.0, 8.0, 25.0)
    ]
    assert 0 < changed[0] < changed[1] / 1.5 < changed[2] / 2.25


def test_drops_are_as_many_as_marshall_and_palmer_counted():
    """By counting on a grid of diameters: here those above 2 mm in the first three metres."""
    shower, num = replace(SHOWER, rate_mm_h=25.0), 0
    for seed in range(20):
        drops = falling(shower, seed)
        middle = (drops.start + drops.end) / 2 - ROAD[:3, 3]
        ahead = middle @ ROAD[:3, 0]
        aside = np.abs(middle @ ROAD[:3, 1]) < 0.5
        above = np.abs(middle @ ROAD[:3, 2] - 1.5) < 0.5
        num += np.count_nonzero((drops.diameter_m > 2e-3) & (ahead < 3) & aside & above)
    edges = np.linspace(2.0, 6.0, 4001)
    per_m3 = 8000 * np.exp(-4.1 * 25.0**-0.21 * edges).sum() * (edges[1] - edges[0])
    expected = 20 * per_m3 * (3 - rain.NEAR_M)
    assert num == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_terminal_speeds_are_those_that_gunn_and_kinzer_measured():
    diameter_m = np.array([0.5, 1.0, 2.0, 3.0, 5.0]) * 1e-3
    measured = [2.06, 4.03, 6.49, 8.06, 9.09]
    np.testing.assert_allclose(rain.terminal_speed(diameter_m), measured, rtol=0.04)


def test_light_stays_between_that_of_scene_and_drops():
    radiance = np.random.default_rng(1).uniform(0.1, 0.9, (*WH[::-1], 3)).astype(np.float32)
    hidden = rain.streaks(falling(replace(SHOWER, rate_mm_h=50.0)), CAMERAS[0], OPEN)
    for wet in (
        rain.seen_through(radiance, hidden * 100, SKY),
        rain.through_wet_glass(radiance, 25, rng=np.random.default_rng(2)),
    ):
        assert wet.min() >= 0
        assert wet.max() <= 0.9 + 1e-6


def test_drops_on_the_glass_show_the_sky_at_their_foot():
    upright = np.zeros((720, 1280, 3), np.float32)
    upright[:360] = 1.0
    wet = rain.through_wet_glass(upright, 25, rng=np.random.default_rng(3))
    change = wet - upright
    assert change[360:].max() > 0.5
    assert change[:360].min() < -0.5


def test_the_same_stream_rains_the_same_drops():
    a, b, other = falling(SHOWER), falling(SHOWER), falling(SHOWER, seed=1)
    np.testing.assert_array_equal(a.start, b.start)
    assert a.start.shape != other.start.shape or not np.array_equal(a.start, other.start)


def test_cameras_whose_glass_is_ideal_have_no_drops_on_it():
    rng = np.random.default_rng(0)
    shower = rain.draw_shower(25.0, "town", dark=False, num_lenses=0, rng=rng)
    assert shower is not None
    assert shower.lens_drops == ()
