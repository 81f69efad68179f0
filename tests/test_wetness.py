"""Water on the ground: how much there is, what it darkens, and what it mirrors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from small_scenes import camera, parallelogram, scene_of
from test_ground import FAR, OPTICS, make_spec

from simgen import ground, render, roads
from simgen.color import linear_from_srgb
from simgen.noise import fractal
from simgen.site import Site
from simgen.wetness import (
    FILM_FROM,
    UPRIGHT,
    Water,
    darkened,
    darkening,
    roughness,
    settle,
    wet_bytes,
)

HW = (64, 96)
HOLLOWS = fractal((400, 600), wavelength=40.0, octaves=5, seed=7)
NONE = np.zeros_like(HOLLOWS)


@pytest.fixture(scope="module")
def maps():
    """Ground of one scene for any wetness."""
    spec = make_spec("urban")
    site = Site(roads.build(spec))

    @cache
    def rings(wetness, rain_mm_h=0.0):
        wet = replace(spec, sky=replace(spec.sky, wetness=wetness, rain_mm_h=rain_mm_h))
        return ground.build(site, wet, [], np.eye(4), OPTICS, far_low=-FAR, far_high=FAR)

    return rings


def everywhere(damp, puddle=0.0):
    return Water(np.full(HW, damp, np.float32), np.full(HW, puddle, np.float32))


def test_water_grows_with_wetness():
    levels = [settle(HOLLOWS, NONE, NONE, wetness=w) for w in np.linspace(0.0, 1.0, 11).tolist()]
    for drier, wetter in pairwise(levels):
        assert (wetter.damp >= drier.damp).all()
        assert (wetter.puddle >= drier.puddle).all()
    assert levels[0].damp.max() == 0.0
    assert levels[-1].damp.min() == 1.0
    assert 0.02 < levels[-1].puddle.mean() < 0.3


def test_puddles_lie_in_hollows_and_wheel_tracks_and_along_kerbs():
    water = settle(HOLLOWS, NONE, NONE, wetness=0.9)
    assert HOLLOWS[water.puddle > 0.5].max() < HOLLOWS[water.puddle < 0.5].min()
    for where in ({"tracks": NONE + 1, "gutters": NONE}, {"tracks": NONE, "gutters": NONE + 1}):
        assert settle(HOLLOWS, **where, wetness=0.9).puddle.mean() > 1.3 * water.puddle.mean()


def test_wheel_tracks_dry_first():
    beside, track = (settle(HOLLOWS, NONE + t, NONE, wetness=0.35).damp for t in (0, 1))
    assert track.mean() < 0.8 * beside.mean()


def test_wet_ground_is_about_half_as_bright_and_more_saturated():
    soil = np.broadcast_to(np.float32([0.12, 0.088, 0.058]), (*HW, 3))
    factor = darkening(soil, everywhere(1.0))
    assert 0.45 < factor.min() <= factor.max() < 0.65
    assert (np.diff(factor[0, 0]) < 0).all()
    np.testing.assert_array_equal(darkening(soil, everywhere(0.0)), 1.0)


def test_film_puddle_and_rain_decide_roughness():
    paved, texture = np.ones(HW, np.float32), np.zeros(HW, np.float32)

    def rough(water, rain_mm_h=0.0, paved=paved):
        return roughness(water, paved, texture, wetness=0.9, rain_mm_h=rain_mm_h).mean() / 255

    dry, film, puddle = (rough(everywhere(*w)) for w in ((0.0,), (1.0,), (1.0, 1.0)))
    assert dry > 0.9 > 0.4 > film > 0.2 > puddle
    assert puddle < rough(everywhere(1.0, 1.0), rain_mm_h=8.0) < film
    assert rough(everywhere(1.0, 1.0), paved=0 * paved) == pytest.approx(dry)


def test_wet_maps_are_darker_and_only_a_film_shines(maps):
    dry, damp, wet = maps(0.0), maps(0.9 * FILM_FROM), maps(1.0)
    for a, b, c in zip(dry, damp, wet, strict=True):
        assert (c.image <= b.image).all()
        assert (b.image <= a.image).all()
        assert c.image.mean() < 0.85 * a.image.mean()
        assert a.roughness is None
        assert b.roughness is None
        assert c.roughness is not None
    assert any((b.image < a.image).any() for a, b in zip(dry, damp, strict=True))


@pytest.mark.parametrize("wetness", [0.2, 0.4, 0.9])
def test_land_beyond_the_maps_grows_as_dark_as_their_edge(maps, wetness):
    """No step in brightness where the countryside begins: the rim of the last map tells."""

    def rim(of):
        linear = linear_from_srgb(maps(of)[-1].image / 255)
        return np.concatenate([linear[:12], linear[-12:]]).mean(axis=(0, 1))

    dry = rim(0.0)
    np.testing.assert_allclose(darkened(dry, wetness), rim(wetness), rtol=0.08)


def test_walls_lose_half_as_much_as_open_ground():
    albedo = np.float32([0.4, 0.3, 0.2])
    level, upright = (albedo - darkened(albedo, 0.9, e) for e in (1.0, UPRIGHT))
    np.testing.assert_allclose(upright, level / 2, rtol=1e-5)
    np.testing.assert_array_equal(darkened(albedo, 0.0), albedo)


def test_wet_sheets_are_those_of_wet_albedos():
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    wet = linear_from_srgb(wet_bytes(image, 0.9, 1.0) / 255)
    np.testing.assert_allclose(wet, darkened(linear_from_srgb(image / 255), 0.9), atol=0.005)
    np.testing.assert_array_equal(wet_bytes(image, 0.0, 1.0), image)


def test_dry_ground_knows_no_rain(maps):
    for a, b in zip(maps(0.0), maps(0.0, rain_mm_h=9.0), strict=True):
        np.testing.assert_array_equal(a.image, b.image)


def test_same_seed_same_water(maps):
    for a, b in zip(maps(0.9), maps.__wrapped__(0.9), strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.roughness, b.roughness)


def test_neighbouring_bands_agree_about_puddles(maps):
    """Along their common edge, where each has made its noise on a raster of its own."""
    rings, bands = maps(0.9), ground.bands(np.eye(4), OPTICS)
    for k in (1, 2, 3):
        edge = bands[k].high[0]
        xy = np.stack([np.full(200, edge), np.linspace(-40, 40, 200)], axis=1)
        near, far = (_looked_up(rings[i], bands[i], xy) for i in (k, k + 1))
        assert np.mean(np.abs(near - far) > 60) < 0.1


def _looked_up(ring, band, xy):
    h, w = ring.roughness.shape
    column, row = np.round((band.texels(xy) - 0.5) / 2).astype(int).T
    return ring.roughness[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)].astype(float)


@pytest.mark.usefixtures("mitsuba_active")
def test_a_wet_road_mirrors_a_dark_wall():
    """A wall that stands ahead at the left: what lies before it is darker than beside it."""
    road = parallelogram((0, -50, -1.2), (90, 0, 0), (0, 100, 0), material="ground")
    road = replace(road, uv=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))
    wall = parallelogram((20, 0, -1.2), (0, 30, 0), (0, 0, 20), color=(0.02, 0.02, 0.02))
    seen = camera(wh=(96, 64), f_px=64.0)

    def contrast(gloss):
        scene = scene_of([wall], [road], roughness=gloss)
        radiance, *_ = render.render(scene, seen, spp=64, denoise=False, seed=1)
        strip = radiance[37:40].mean(axis=(0, 2))
        return strip[60:].mean() / strip[:36].mean()

    assert contrast(np.full((8, 8), 25, np.uint8)) > 1.3 * contrast(None)
