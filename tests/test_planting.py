"""Trees have room: their crowns stay out of houses, and leave headroom over lanes."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from test_ground import make_spec

from simgen import planting, roads
from simgen.layout import Layout
from simgen.schema import LABELS
from simgen.site import Site
from simgen.vegetation import SPECIES, crown_radius_m, lowest_limbed_m, tree

SCENES = [("urban", 1), ("suburban", 2), ("rural", 3)]
COARSE = 0.2
"""zoom: from 6 m on, trees have fewer leaves, which reach as far"""


@pytest.mark.parametrize(("recipe", "seed"), SCENES)
def test_crowns_stay_out_of_houses_and_leave_headroom_over_lanes(recipe, seed):
    spec = make_spec(recipe, seed)
    site = Site(roads.build(spec))
    layout = Layout(site, spec, np.zeros((1, 2)), {}, COARSE)
    for step in (planting.street_trees, planting.trees):
        leaves = [p.vertices for m in step(layout) for p in m if p.material == "leaf"]
        xyz = np.concatenate([*leaves, np.empty((0, 3))])[::3]
        points = shapely.points(xyz[:, :2])
        assert not shapely.contains(site.built, points).any()
        over = xyz[shapely.contains(site.asphalt, points)]
        assert (over[:, 2] - site.height(over[:, :2])).min(initial=np.inf) > 4.4


@pytest.mark.parametrize(("below_m", "room_m"), [(8.0, 0.0), (30.0, 3.0)])
def test_trees_stay_below_wires_or_beside_them(below_m, room_m):
    spec = make_spec("rural", 3)
    layout = Layout(Site(roads.build(spec)), spec, np.zeros((1, 2)), {}, COARSE)
    where = layout.rig_xy + np.array([20.0, room_m])
    ground = float(layout.site.height(where)[0])
    ends = np.array([[-50.0, 0, ground + below_m], [90.0, 0, ground + below_m]])
    layout.wires.append(ends[None])
    for species in SPECIES:
        height = planting._clear_of_wires(layout, species, 25.0, where)
        assert height * 1.1 < below_m or crown_radius_m(species, height) < room_m
        assert height > 4.0


@pytest.mark.parametrize("species", SPECIES)
def test_leaves_keep_to_the_stated_radius_and_above_what_was_cut_off(species):
    height = 1.2 * lowest_limbed_m(4.5)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        eyes = np.array([[0.0, -7.0, 1.7]]) if seed == 3 else None
        model = tree(species, height_m=height, lod=seed % 3, rng=rng, clear_m=4.5, eyes=eyes)
        leaves = model[-1].vertices
        assert model[-1].semantic == LABELS["vegetation"]
        assert np.linalg.norm(leaves[:, :2], axis=1).max() < crown_radius_m(species, height)
        assert leaves[:, 2].min() > 4.5
