"""Halos against quadrature along the ray, and lamps that walls hide."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.integrate import quad
from small_scenes import camera, parallelogram, scene_of

from simgen import halos
from simgen.atmosphere import extinction
from simgen.halos import FORWARD, Lights, halo

VISIBILITY_M = 100.0
BETA = extinction(VISIBILITY_M)
WH = (160, 90)
OPEN = np.full(WH[::-1], np.inf, np.float32)
CAMERAS = [camera((0, y, 0), turn, wh=WH, f_px=90.0)
           for y, turn in ((0.8, (0.5, -1.0, 0.3)), (-0.8, (-0.4, 0.7, 0.2)))]  # fmt: skip
LAMP = Lights(np.array([[25.0, 3.0, 2.0]]), np.array([[0.5, 0.4, 0.3]]), np.array([0.1]))


def phase(cosine):
    """The phase function, 1 in the mean over all directions."""
    norm = 2 * FORWARD / np.log((1 + FORWARD) / (1 - FORWARD))
    return norm / (1 + FORWARD**2 - 2 * FORWARD * cosine)


def by_quadrature(angle: float, distance: float, end: float, *, longer: bool) -> float:
    """The halo at an angle from the lamp; ``longer``: light is lost on its detour, too."""
    closest, h = distance * np.cos(angle), distance * np.sin(angle)

    def added(t: float) -> float:
        r = np.hypot(t - closest, h)
        path = t + r if longer else distance
        return float(BETA * np.exp(-BETA * path) * phase((closest - t) / r) / (4 * np.pi * r**2))

    places = [p for p in (closest - h, closest, closest + h) if 0 < p < end]
    return float(quad(added, 0, end, points=places, limit=400)[0])


def closed_form(angle: float, distance: float, end: float) -> float:
    return float(halo(np.array(distance * np.cos(angle)), distance, np.array(end), 1e-6, BETA))


def test_droplets_scatter_all_light_once_and_mostly_forward():
    cosine = 1 - np.geomspace(1e-9, 2, 200001)
    total = -np.trapezoid(phase(cosine), cosine) / 2
    forward = -np.trapezoid(phase(cosine) * cosine, cosine) / 2
    assert total == pytest.approx(1.0, rel=1e-4)
    assert forward == pytest.approx(0.85, abs=0.005)


@pytest.mark.parametrize("end", [10.0, 29.0, 31.0, 300.0])
@pytest.mark.parametrize("angle", [0.005, 0.1, 0.8, 2.5])
def test_a_halo_is_the_integral_along_the_ray(angle: float, end: float):
    expected = by_quadrature(angle, 30.0, end, longer=False)
    assert closed_form(angle, 30.0, end) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("angle", "above"), [(0.005, 0.01), (0.05, 0.02), (0.2, 0.09)])
def test_the_light_lost_on_detours_is_little_near_the_lamp(angle: float, above: float):
    full = by_quadrature(angle, 30.0, 500.0, longer=True)
    assert 1.0 <= closed_form(angle, 30.0, 500.0) / full <= 1 + above


def test_in_clear_air_there_is_no_halo():
    foggy, clear = (
        halos.scattered(LAMP, CAMERAS[0], OPEN, visibility_m).max() for visibility_m in (100, 1e7)
    )
    assert clear < 1e-4 * foggy


@pytest.mark.parametrize("which", range(2))
def test_every_camera_sees_a_halo_around_its_lamp(which: int):
    view = CAMERAS[which]
    light = halos.scattered(LAMP, view, OPEN, VISIBILITY_M)[..., 0]
    v, u = np.indices(light.shape)
    core = np.where(light > 0.3 * light.max(), light, 0)
    centroid = np.array([(u * core).sum(), (v * core).sum()]) / core.sum()
    R, t = view.T_cam_world[:3, :3], view.T_cam_world[:3, 3]
    expected, _ = cv2.projectPoints(LAMP.xyz, cv2.Rodrigues(R)[0], t, view.K, None)
    np.testing.assert_allclose(centroid, expected.ravel(), atol=0.3)


def test_at_the_edge_of_a_surface_every_pixel_has_its_own_halo():
    wide = camera(wh=(640, 64), f_px=360.0)
    lamp = replace(LAMP, xyz=np.array([[25.0, 0.0, 0.0]]))
    distance = np.full((64, 640), 80.0, np.float32)
    distance[:, 331:] = 12.0
    coarse = halos.scattered(lamp, wide, distance, VISIBILITY_M)
    exact = halos._halos(wide, distance, shining=lamp, beta=BETA)
    edge = np.s_[:, 329:333]
    assert exact[:, 330].max() > 2 * exact[:, 331].max(), "the case shows nothing"
    np.testing.assert_allclose(coarse[edge], exact[edge], rtol=0.1, atol=0.02 * exact.max())


# --- lamps of a scene ----------------------------------------------------------------------------


def _lamp(distance_m: float = 10.0, half_m: float = 0.1):
    """A square that faces the cameras, and burns."""
    corner = (distance_m, half_m, -half_m)
    plain = parallelogram(corner, (0, -2 * half_m, 0), (0, 0, 2 * half_m), material="lamp")
    return replace(plain, emission=np.tile([3.0, 2.0, 1.0], (2, 1)).astype(np.float32))


def _lights(*parts) -> Lights:
    return halos.lights(scene_of(parts), [camera((0, 0.1, 0)), camera()], VISIBILITY_M)


@pytest.mark.usefixtures("mitsuba_active")
def test_a_lamp_has_the_intensity_of_its_faces():
    seen = _lights(_lamp())
    np.testing.assert_allclose(seen.intensity.sum(axis=0), 0.04 * np.array([3, 2, 1]), rtol=1e-3)
    np.testing.assert_allclose(seen.xyz[:, 0], 10.0)


@pytest.mark.usefixtures("mitsuba_active")
def test_a_lamp_behind_a_wall_has_no_halo():
    wall = parallelogram((5.0, 8.0, -8.0), (0, -16.0, 0), (0, 0, 16.0))
    hidden = _lights(_lamp(), wall)
    assert len(hidden.xyz) == 0
    assert not np.any(halos.scattered(hidden, CAMERAS[0], OPEN, VISIBILITY_M))


@pytest.mark.usefixtures("mitsuba_active")
def test_without_lamps_there_are_no_lights():
    assert len(_lights(replace(_lamp(), emission=None)).xyz) == 0


@pytest.mark.usefixtures("mitsuba_active")
def test_the_strongest_lamps_are_kept():
    far = [parallelogram((40.0, 3.0 * k, 0), (0, -0.1, 0), (0, 0, 0.1)) for k in range(-20, 20)]
    far = [replace(p, emission=np.ones((2, 3), np.float32)) for p in far]
    seen = _lights(*far, _lamp())
    assert len(seen.xyz) == halos.MOST_LIGHTS
    assert seen.xyz[0, 0] == pytest.approx(10.0)
