"""Spray against quadrature and projection: the same plumes for all cameras, none behind walls."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest
from scipy.integrate import quad
from small_scenes import camera

from simgen import spray
from simgen.along_rays import at_all_pixels, directions
from simgen.geometry import project, transform_points

WH = (160, 90)
AIR = np.full((1, 64, 3), 0.7, np.float32)
OPEN = np.full(WH[::-1], np.inf, np.float32)
WET = 0.9
TRUCK = {"instance": 7, "class": "truck", "xyz": [40.0, 2.0, -1.5], "heading_rad": 0.2,
         "size_m": [12.0, 2.5, 3.6], "speed_m_s": 24.0}  # fmt: skip
CAMERAS = [camera((0, y, 0), turn, wh=WH, f_px=90.0)
           for y, turn in ((0.8, (0.5, -1.0, 0.3)), (-0.8, (-0.4, 0.7, 0.2)))]  # fmt: skip


def plumes(*movers, wetness: float = WET, seed: int = 0) -> list[spray.Plume]:
    return spray.plumes(movers, wetness, rng=np.random.default_rng(seed))


def cloud(*movers) -> spray.Puffs:
    return spray.puffs(plumes(*movers), movers)


def one_puff() -> spray.Puffs:
    """The third behind the truck."""
    c = cloud(TRUCK)
    return spray.Puffs(c.middle[3:4], c.T_puff_world[3:4], c.extinction[3:4])


def depth_of(puffs: spray.Puffs, view, distance_m: np.ndarray, step: int = 4) -> np.ndarray:
    evaluate = partial(spray.optical_depth, puffs)
    return at_all_pixels(evaluate, view, distance_m, step=step)[..., 0]


@pytest.mark.parametrize("end", [0.5, 3.0, 40.0])
def test_a_rays_length_in_a_gaussian_is_its_integral(end: float):
    rng = np.random.default_rng(1)
    start, along = rng.normal(0, 2, 3), rng.normal(0, 1, (20, 3))
    expected = [
        quad(lambda t, d=d: np.exp(-0.5 * ((start + t * d) ** 2).sum()), 0, end, limit=200)[0]
        for d in along
    ]
    np.testing.assert_allclose(spray.gaussian_length(start, along, np.full(20, end)), expected,
                               rtol=1e-6, atol=1e-9)  # fmt: skip


def test_the_optical_depth_of_a_pixel_is_what_a_march_through_all_puffs_finds():
    view, puffs, (row, column), end = CAMERAS[0], cloud(TRUCK), (47, 81), 33.0
    depth = spray.optical_depth(puffs, view, np.full_like(OPEN, end))[row, column, 0]
    t = np.linspace(0, end, 20001)
    points = view.centre + t[:, None] * directions(view)[row, column]
    local = np.einsum("nij,tj->nti", puffs.T_puff_world[:, :3, :3], points)
    local += puffs.T_puff_world[:, None, :3, 3]
    extinction = puffs.extinction @ np.exp(-0.5 * (local**2).sum(axis=-1))
    assert depth > 0.05
    assert depth == pytest.approx(np.trapezoid(extinction, t), rel=2e-3)


def test_at_the_edge_of_a_surface_every_pixel_has_its_own_depth():
    """A wall halfway into the plume covers part of each coarse cell at its edge."""
    view = camera(wh=(640, 360), f_px=360.0)
    distance = np.full((360, 640), 60.0, np.float32)
    distance[:, 331:] = 21.0
    exact = spray.optical_depth(cloud(TRUCK), view, distance)[..., 0]
    error = np.abs(depth_of(cloud(TRUCK), view, distance) - exact)
    assert np.abs(exact[:, 330] - exact[:, 331]).max() > 0.3, "the case shows nothing"
    assert error.max() < 0.05 * exact.max()


@pytest.mark.parametrize("which", range(2))
def test_every_camera_sees_a_puff_where_its_middle_projects(which: int):
    view, puffs = CAMERAS[which], one_puff()
    depth = depth_of(puffs, view, OPEN, step=2)
    v, u = np.indices(depth.shape)
    core = np.where(depth > 0.5 * depth.max(), depth, 0)
    centroid = np.array([(u * core).sum(), (v * core).sum()]) / core.sum()
    R, t = view.T_cam_world[:3, :3], view.T_cam_world[:3, 3]
    expected, _ = cv2.projectPoints(puffs.middle, cv2.Rodrigues(R)[0], t, view.K, None)
    np.testing.assert_allclose(centroid, expected.ravel(), atol=0.3)


def test_spray_behind_a_wall_hides_nothing():
    radiance = np.full((*WH[::-1], 3), 0.1, np.float32)
    wall = np.full_like(OPEN, 12.0)
    far = cloud({**TRUCK, "xyz": [90.0, 2.0, -1.5]})
    assert (spray.seen_in_spray(radiance, far, CAMERAS[0], OPEN, AIR) > 0.2).any()
    seen = spray.seen_in_spray(radiance, far, CAMERAS[0], wall, AIR)
    np.testing.assert_allclose(seen, radiance, atol=1e-4)


def test_dense_spray_shows_the_light_of_the_air():
    puffs = one_puff()
    dense = spray.Puffs(puffs.middle, puffs.T_puff_world, puffs.extinction * 1e3)
    radiance = np.full((*WH[::-1], 3), 0.1, np.float32)
    seen = spray.seen_in_spray(radiance, dense, CAMERAS[0], OPEN, AIR)
    uv = project(CAMERAS[0].K, transform_points(CAMERAS[0].T_cam_world, puffs.middle[0]))
    u, v = np.round(uv).astype(int)
    np.testing.assert_allclose(seen[v, u], 0.7, atol=1e-3)
    assert seen.max() < 0.7 + 1e-3


def test_where_no_puff_is_in_view_the_picture_stays_as_it_is():
    radiance = np.random.default_rng(0).random((*WH[::-1], 3), dtype=np.float32)
    behind = {**TRUCK, "xyz": [-60.0, 0.0, 0.0]}
    assert spray.seen_in_spray(radiance, cloud(behind), CAMERAS[0], OPEN, AIR) is radiance


@pytest.mark.parametrize(
    "mover", [{**TRUCK, "speed_m_s": 6.0}, {**TRUCK, "class": "person"}], ids=["slow", "on foot"]
)
def test_what_is_slow_or_has_no_tyres_throws_up_nothing(mover):
    assert plumes(TRUCK)
    assert plumes(mover) == []


def test_a_damp_road_gives_no_spray():
    assert plumes(TRUCK, wetness=0.3) == []


def test_spray_grows_with_the_square_of_the_speed_and_with_the_vehicle():
    """The first puff lies beside the vehicle: it does not depend on how fast the rest fades."""
    fast, slow, car = (
        plumes({**TRUCK, **change})[0].extinction_per_m[0]
        for change in ({"speed_m_s": 30.0}, {"speed_m_s": 15.0}, {"class": "car"})
    )
    assert fast / slow == pytest.approx(4.0, rel=0.02)
    assert car < plumes(TRUCK)[0].extinction_per_m[0]


def test_the_plume_widens_and_thins_behind_its_vehicle():
    c = cloud(TRUCK)
    forward = np.array([np.cos(0.2), np.sin(0.2), 0.0])
    behind = (TRUCK["xyz"] - c.middle) @ forward
    width = 1 / np.linalg.norm(c.T_puff_world[:, 1, :3], axis=1)
    assert (np.diff(behind) > 0).all()
    assert (np.diff(width) >= 0).all()
    assert c.extinction[-1] < 0.5 * c.extinction[0]


def test_the_same_draw_gives_the_same_plumes():
    assert plumes(TRUCK, seed=3) == plumes(TRUCK, seed=3) != plumes(TRUCK, seed=4)
