"""A bridge leaves room for lorries, stands on free land, reaches the ground, and keeps to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_ground import make_spec

from simgen import bridges, crossings, roads, roadside, traffic, trolley, works
from simgen.crossings import CLEARANCE_M, Crossing
from simgen.layout import Layout, Mover
from simgen.mesh import Part
from simgen.recipe import SceneSpec
from simgen.schema import LABELS
from simgen.signs import sign_atlas
from simgen.site import Site

LAND = [LABELS["terrain"], LABELS["vegetation"]]
BRIDGES = [("highway", "overpass"), ("rural", "overpass"), ("urban", "overpass"),
           ("suburban", "footbridge")]  # fmt: skip


def _spec(recipe: str, index: int, **wanted: bool) -> SceneSpec:
    chosen = {"overpass": False, "footbridge": False, **wanted}
    return replace(make_spec(recipe, index), **chosen)


@pytest.fixture(scope="module", params=BRIDGES, ids=lambda b: b[0])
def planned(request: pytest.FixtureRequest) -> tuple[SceneSpec, Site, Crossing]:
    recipe, wanted = request.param
    spec = _spec(recipe, 1, **{wanted: True})
    site = Site(roads.build(spec))
    crossing = crossings.plan(site, spec)
    assert crossing is not None
    return spec, site, crossing


def test_the_deck_clears_the_road_below_it(planned):
    _, site, crossing = planned
    y = np.linspace(-crossing.right_m, crossing.left_m, 80)
    below = crossing.world(np.stack([0 * y, y], axis=1))
    room = crossing.origin[2] + crossing.soffit_m - site.height(below)
    assert room.min() > CLEARANCE_M[0] - 0.3


def test_the_supports_stand_beside_every_road_and_pavement(planned):
    _, site, crossing = planned
    supports = np.array([(0.0, crossing.left_m), (0.0, -crossing.right_m)])
    xy = crossing.world(supports)
    assert site.clear_of(xy, road=0.2, pavement=0.2, buildings=0.5).all()


def test_the_ground_that_a_bridge_takes_holds_no_building(planned):
    _, site, crossing = planned
    for x, y, radius in crossing.discs():
        assert site.clear_of([(x, y)], road=-1, pavement=-1, buildings=radius)[0]


def test_the_frame_of_a_crossing_has_x_ahead_and_y_to_the_left():
    crossing = Crossing("road", np.array([5.0, 2.0, 0.0]), np.pi / 2, 9.0, 9.0, 4.0, 6.0, None)
    np.testing.assert_allclose(crossing.world(np.array([[1.0, 0.0], [0.0, 1.0]])),
                               [[5.0, 3.0], [4.0, 2.0]], atol=1e-12)  # fmt: skip


def test_a_scene_without_a_bridge_has_none():
    spec = _spec("urban", 1)
    assert crossings.plan(Site(roads.build(spec)), spec) is None


STEPS = (bridges.over_the_road, works.road_works, traffic.moving, roadside.signals, roadside.lamps,
         roadside.signs, roadside.gantry, roadside.noise_walls, trolley.overhead,
         works.building_site)  # fmt: skip


def _things(layout: Layout) -> list[Part]:
    things = [thing for step in STEPS for thing in step(layout)]
    return [p for t in things for p in (t.model if isinstance(t, Mover) else t)]


def _layout(site: Site, spec: SceneSpec, crossing: Crossing | None) -> Layout:
    rects = sign_atlas(rng=np.random.default_rng(0)).rects
    return Layout(site, spec, np.zeros((1, 2)), rects, 1.0, crossing)


def test_bridges_reach_the_ground_and_nothing_else_reaches_into_their_decks(planned):
    spec, site, crossing = planned
    parts = _things(_layout(site, spec, crossing))
    bridge = [p.vertices for p in parts if p.semantic == LABELS["bridge"]]
    local = _local(crossing, np.concatenate(bridge))
    for y in (crossing.left_m, -crossing.right_m):
        support = local[np.abs(local[:, 1] - y) < 3.0]
        ground = site.height(crossing.world(np.array([[0.0, y]])))[0] - crossing.origin[2]
        assert support[:, 2].min() < ground
    others = [p.vertices for p in parts if p.semantic not in (LABELS["bridge"], *LAND)]
    x, y, z = _local(crossing, np.concatenate(others)).T
    over = (np.abs(x) < crossing.half_width_m) & (-crossing.right_m < y) & (y < crossing.left_m)
    assert not (over & (z > crossing.soffit_m) & (z < crossing.soffit_m + 1.0)).any()


def test_contact_wires_hang_at_their_height_over_the_road():
    spec = replace(_spec("urban", 3, trolley_wires=True), building_rules="town")
    site = Site(roads.build(spec))
    *poles, wires = trolley.overhead(_layout(site, spec, None))
    assert poles
    xyz = wires[0].vertices
    height = xyz[:, 2] - site.height(xyz[:, :2])
    assert np.nanmin(height) > 5.3


def _local(crossing: Crossing, points: np.ndarray) -> np.ndarray:
    c, s = np.cos(crossing.heading), np.sin(crossing.heading)
    d = points - crossing.origin
    return np.stack([d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s, d[:, 2]], axis=1)
