"""Cutting the ground and painting its maps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely

from simgen import ground, markings, roads
from simgen.color import linear_from_srgb
from simgen.ground import Optics, bands, split
from simgen.noise import fractal
from simgen.recipe import (
    DaylightTable,
    WeatherTable,
    draw_scene,
    draw_sky,
    load_presets,
    load_recipe,
)
from simgen.roads import Network, Surface
from simgen.site import Site

OPTICS = Optics(focal_px=80.0, hfov_rad=np.pi / 2, nearest_m=2.5)
FAR = np.array([400.0, 400.0])


def make_spec(name: str, scene: int = 3):
    seed = (0, scene, 0)
    sky = draw_sky(load_presets("daylight", DaylightTable), load_presets("weather", WeatherTable),
                   seed=seed)  # fmt: skip
    return draw_scene(name, load_recipe(name)[1], sky=sky, seed=seed)


@cache
def network_of(name: str, scene: int) -> Network:
    """Built once, for all tests that only look at it."""
    return roads.build(make_spec(name, scene))


def area(surface: Surface) -> float:
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def soup(rng: np.random.Generator) -> Surface:
    return Surface(rng.normal(size=(90, 3)), np.arange(90).reshape(-1, 3))


@pytest.mark.parametrize("seed", range(5))
def test_splitting_keeps_area_and_sides(seed):
    rng = np.random.default_rng(seed)
    surface, axis, bound = soup(rng), np.array([0.6, 0.8]), 0.1
    below, above = split(surface, axis, bound)
    assert area(below) + area(above) == pytest.approx(area(surface), rel=1e-6)
    assert (below.vertices[:, :2] @ axis).max() < bound + 1e-9
    assert (above.vertices[:, :2] @ axis).min() > bound - 1e-9


def test_splitting_keeps_winding():
    surface = Surface(np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
    for half in split(surface, np.array([1.0, 0.0]), 1.0):
        a, b, c = (half.vertices[half.faces[:, k]] for k in range(3))
        assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.fixture(scope="module")
def built():
    spec = make_spec("urban")
    network = roads.build(spec)
    site = Site(network)
    paints = markings.paint(network, spec.road, rng=spec.stream("paint"))
    rings = ground.build(site, spec, paints, np.eye(4), OPTICS, far_low=-FAR, far_high=FAR)
    return spec, network, site, paints, rings


def test_bands_cover_road_and_pavement_once(built):
    _, network, _, _, rings = built
    for name, semantic in (("road", 7), ("sidewalk", 8)):
        parts = [p for r in rings for p in r.parts if p.semantic == semantic]
        total = sum(area(Surface(p.vertices, p.faces)) for p in parts)
        assert total == pytest.approx(area(network.surfaces[name]), rel=1e-6)


def test_uv_of_the_ground_leads_to_its_own_texel(built):
    *_, rings = built
    for ring, band in zip(rings, bands(np.eye(4), OPTICS), strict=True):
        h, w = band.shape
        for part in ring.parts:
            texel = part.uv * [w, h] - 0.5
            xy = texel @ band.A[:, :2].T + band.A[:, 2]
            np.testing.assert_allclose(xy, part.vertices[:, :2], atol=2e-3 * w)


def test_paint_is_where_the_marking_says(built):
    """A texel in the middle of a patch of paint is brighter than the asphalt around the paint."""
    _, _, site, paints, rings = built
    band, ring = bands(np.eye(4), OPTICS)[2], rings[2]
    middles = np.array([p.outline.mean(axis=0) for p in paints])
    shapely.prepare(site.asphalt)
    painted = shapely.union_all([shapely.Polygon(p.outline) for p in paints])
    beside = (middles[:, None] + [[0.0, 0.8], [0.0, -0.8], [0.8, 0.0], [-0.8, 0.0]]).reshape(-1, 2)
    beside = beside[shapely.distance(painted, shapely.points(beside)) > 0.2]

    def seen(xy: np.ndarray) -> np.ndarray:
        on_road = shapely.contains(site.asphalt, shapely.points(xy))
        column, row = np.round(band.texels(xy[on_road])).astype(int).T
        h, w = band.shape
        inside = (column > 2) & (column < w - 3) & (row > 2) & (row < h - 3)
        return linear_from_srgb(ring.image[row[inside], column[inside], 1] / 255.0)

    bright, dark = seen(middles), seen(beside)
    assert min(len(bright), len(dark)) > 5
    assert np.median(bright) > 1.5 * np.median(dark)


@pytest.mark.parametrize("name", ["tracks", "seams", "patches", "stains"])
def test_a_street_has_tracks_cracks_patches_and_stains_that_show(built, name):
    """Each lies on the asphalt, and changes the map where it lies."""
    spec, _, site, paints, _ = built
    layers = ground._layers(site, spec, paints)
    places = getattr(layers, name)
    middles = np.array([np.mean(place, axis=0) for place in places]) if name != "stains" else places
    on_road = shapely.contains(site.asphalt, shapely.points(middles[:, :2]))
    assert on_road.sum() >= 3
    band, without = bands(np.eye(4), OPTICS)[-1], replace(layers, **{name: places[:0]})
    with_it, bare = (ground._paint(band, x, spec, 0)[0].astype(int) for x in (layers, without))
    changed = (with_it != bare).any(axis=-1)
    assert 10 < changed.sum() < 0.2 * changed.size
    if name != "tracks":  # which shine on a fresh road and are pale on a worn one
        assert (with_it <= bare).all()


def test_the_same_ground_is_seen_from_further_along():
    """World-anchored: the map's tone at a place changes little when the rig has moved on."""
    A = np.array([[0.01, 0.0, 3.0], [0.0, 0.02, -5.0]])
    moved = A.copy()
    moved[:, 2] += [0.5, 1.0]  # 50 columns, 50 rows
    a = fractal((300, 400), wavelength=8.0, octaves=8, seed=3, A=A)
    b = fractal((300, 400), wavelength=8.0, octaves=8, seed=3, A=moved)
    difference = a[50:, 50:] - b[:-50, :-50]
    assert np.abs(difference).mean() < 0.08 * a.std()


def test_noise_does_not_repeat():
    a = fractal((256, 1024), wavelength=32.0, octaves=5, seed=1)
    a = (a - a.mean()) / a.std()
    for shift in range(64, 768, 8):
        assert abs(float((a[:, :-shift] * a[:, shift:]).mean())) < 0.35


def test_same_seed_same_maps():
    spec = make_spec("rural")
    images = []
    for _ in range(2):
        network = roads.build(spec)
        rings = ground.build(Site(network), spec, [], np.eye(4), OPTICS, far_low=-FAR, far_high=FAR)
        images.append([r.image for r in rings])
    for a, b in zip(*images, strict=True):
        np.testing.assert_array_equal(a, b)
