"""What is placed stands on the ground, apart from each other, and out of the cameras' way."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely
from test_ground import make_spec

from simgen import mesh, world
from simgen.ground import Optics
from simgen.layout import Mover
from simgen.mesh import Part
from simgen.recipe import SceneSpec, recipe_names
from simgen.scene import World
from simgen.schema import LABELS
from simgen.site import Site

OPTICS = Optics(focal_px=48.0, hfov_rad=np.pi / 2, nearest_m=2.5)
VEHICLES = {LABELS[n] for n in ("car", "truck", "bus", "motorcycle", "trailer")}


NUM_STEPS = 12
AT_NIGHT = "suburban"
"""by day are the others"""


@cache
def spec_of(recipe: str) -> SceneSpec:
    spec = make_spec(recipe, 7)
    if recipe != AT_NIGHT:
        return spec
    return replace(spec, sky=replace(spec.sky, daylight="night", sun_elevation_deg=-12.0))


@cache
def scene_of(recipe: str, step: int = 0) -> tuple[World, Site, world.Drive]:
    """One world of each recipe, for all tests that only look at it, at a step of a drive."""
    spec = spec_of(recipe)
    drive = world.drive(spec, step, num_steps=NUM_STEPS)
    return world.build(spec, drive, OPTICS), Site(drive.network), drive


@pytest.fixture(params=recipe_names())
def built(request: pytest.FixtureRequest) -> tuple[World, Site, world.Drive]:
    return scene_of(request.param)


def things(parts: list[Part], classes: set[int]) -> list[np.ndarray]:
    """Vertices (N, 3) of each instance of the classes."""
    vertices = defaultdict(list)
    for p in parts:
        if p.instance and p.semantic in classes:
            vertices[p.instance].append(p.vertices)
    return [np.concatenate(v) for v in vertices.values()]


def test_all_numbers_are_finite_and_ids_fit(built):
    parts = built[0].parts
    assert all(np.isfinite(p.vertices).all() for p in parts)
    assert all(p.faces.max() < len(p.vertices) for p in parts)
    assert 1 <= max(p.instance for p in parts) < 65535


def test_the_triangle_budget_holds(built):
    assert sum(len(p.faces) for p in built[0].parts) < 1_500_000


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["rural", "suburban"])
def test_the_triangle_budget_holds_for_a_long_lens(recipe):
    """Of the truck's rig, 30° wide, which magnifies what is ahead."""
    half = np.deg2rad(15.0)
    long_lens = replace(OPTICS, focal_px=48.0 / np.tan(half), hfov_rad=2 * half)
    spec = make_spec(recipe, 7)
    scene = world.build(spec, world.drive(spec, 0), long_lens)
    assert sum(len(p.faces) for p in scene.parts) < 1_500_000


def test_vehicles_stand_on_their_wheels(built):
    scene, site, _ = built
    for vertices in things(scene.parts, VEHICLES):
        lowest = vertices[vertices[:, 2] < vertices[:, 2].min() + 0.05]
        ground = site.height(lowest[:, :2])
        assert np.abs(lowest[:, 2] - ground).max() < 0.35  # a long one bridges a dip
        assert np.abs(np.median(lowest[:, 2] - ground)) < 0.12


def test_vehicles_do_not_stand_in_each_other(built):
    """The rectangles around their bodies, below the mirrors, are apart."""
    bodies = [v[v[:, 2] < (v[:, 2].min() + v[:, 2].max()) / 2, :2]
              for v in things(built[0].parts, VEHICLES)]  # fmt: skip
    boxes = np.array([shapely.oriented_envelope(shapely.MultiPoint(b)) for b in bodies])
    a, b = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    assert len(boxes) > 3
    assert (a == b).all()


def test_nothing_stands_in_front_of_the_lens(built):
    """A tube of 1.2 m around the first two metres before each camera holds no vertex."""
    scene, _, drive = built
    R, t = drive.T_world_vehicle[:3, :3], drive.T_world_vehicle[:3, 3]
    for part in scene.parts:
        x, y, z = ((part.vertices - t) @ R).T
        blocked = (x > -0.5) & (x < 2.0) & (np.abs(y) < 1.2) & (z > 0.5) & (z < 2.2)
        assert not blocked.any()


def test_trees_grow_out_of_the_ground(built):
    scene, site, _ = built
    trunks = {p.instance for p in scene.parts if p.material == "bark"}
    for instance in sorted(trunks)[:40]:
        tree = np.concatenate([p.vertices for p in scene.parts if p.instance == instance])
        foot = tree[tree[:, 2].argmin()]
        assert -0.8 < foot[2] - site.height(foot[:2])[0] <= 0.05


def test_no_horizon_is_empty(built):
    """Land reaches the horizon: in every direction something lies beyond 2 km."""
    scene, *_ = built
    far = np.concatenate([p.vertices for p in scene.parts])
    far = far[np.linalg.norm(far[:, :2], axis=1) > 2000]
    azimuth = np.rad2deg(np.arctan2(far[:, 1], far[:, 0]))
    assert len(np.unique(np.floor(azimuth / 5) % 72)) == 72


def test_same_spec_same_world():
    """Built twice, for the first and the last step of a drive: it does not depend on that."""
    (a, *_), (b, *_) = (scene_of("urban", step) for step in (0, NUM_STEPS - 1))
    assert len(a.parts) == len(b.parts)
    for p, q in zip(a.parts, b.parts, strict=True):
        np.testing.assert_array_equal(p.vertices, q.vertices)
    np.testing.assert_array_equal(a.sky, b.sky)


def test_a_town_shows_many_classes():
    seen = {p.semantic for p in scene_of("urban")[0].parts}
    assert {LABELS[n] for n in ("building", "car", "vegetation", "pole", "terrain")} <= seen


def test_lamps_burn_at_night_only():
    dark, *_ = scene_of(AT_NIGHT)
    assert len(dark.lamps) > 4  # those of the rig are four
    for recipe in set(recipe_names()) - {AT_NIGHT}:
        assert not scene_of(recipe)[0].lamps


def test_all_frames_of_a_drive_show_the_same_scene():
    """What stands where does not depend on the rig, which drives on over the junction."""
    (first, _, start), (last, _, end) = (scene_of("urban", step) for step in (0, NUM_STEPS - 1))
    assert last.movers == first.movers
    for a, b in zip(first.parts, last.parts, strict=True):
        assert (a.material, a.instance) == (b.material, b.instance)
        np.testing.assert_array_equal(a.vertices, b.vertices)
    way = np.array([d.T_world_vehicle[:3, 3] for d in (start, end)])
    assert np.linalg.norm(way[1] - way[0]) == pytest.approx(33.0, abs=1.0)
    ahead = [(centre - way[0]) @ (way[1] - way[0]) / 33.0 for centre in start.network.junctions]
    assert 0 < min(ahead) < 33.0  # it was passed
    boxes = [np.array(m["xyz"][:2]) for m in first.movers]
    nearest = min(np.linalg.norm(start.way[:, :2] - xy, axis=1).min() for xy in boxes)
    assert nearest > 2.0


def test_a_drive_beyond_the_end_of_the_road_is_refused():
    spec = make_spec("urban", 2)
    with pytest.raises(RuntimeError, match="the road goes on for"):
        world.drive(spec, 0, num_steps=2000)


def test_only_sheets_in_use_are_drawn():
    scene, *_ = scene_of("highway")
    used = {p.material for p in scene.parts}
    drawn = {name for name, sheet in scene.sheets.items() if np.ptp(sheet.image) > 0}
    assert drawn == used & set(scene.sheets)
    assert drawn < set(scene.sheets)


def test_sheets_have_one_size_and_scale_in_all_scenes():
    """Both are part of the renderer's kernels: a scene with others would compile."""
    town, motorway = (scene_of(recipe)[0].sheets for recipe in ("urban", "highway"))
    sizes = [{k: (x.image.shape, x.metres) for k, x in s.items()} for s in (town, motorway)]
    assert sizes[0] == sizes[1]


def test_each_mover_is_the_instance_it_names(built):
    scene, *_ = built
    labels = defaultdict(set)
    middle = {}
    for p in scene.parts:
        labels[p.instance].add(p.semantic)
        middle.setdefault(p.instance, p.vertices[:, :2].mean(axis=0))
    assert len({m["instance"] for m in scene.movers}) == len(scene.movers)
    for mover in scene.movers:
        assert LABELS[mover["class"]] in labels[mover["instance"]]
        assert np.linalg.norm(middle[mover["instance"]] - mover["xyz"][:2]) < 9.0


def test_the_size_of_a_mover_is_that_along_its_own_axes():
    vertices, faces = mesh.box((4.0, 1.8, 1.5))
    car = [mesh.part(vertices, faces, "matte", LABELS["car"])]
    model = mesh.placed(car, xyz=[5, -3, 1], heading_rad=0.7)
    mover = Mover(model, np.array([5.0, -3.0, 1.0]), 0.7, 12.0)
    np.testing.assert_allclose(mover.record(1)["size_m"], [4.0, 1.8, 1.5], atol=0.011)
