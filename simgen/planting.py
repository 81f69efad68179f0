"""Trees, shrubs and grass: in rows along the road, in clumps on open land, tufts on the verges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simgen import vegetation
from simgen.geometry import Array
from simgen.layout import Layout, Placed, along, edges, sunk
from simgen.mesh import Model, placed
from simgen.roads import offset_line, resampled


def _tree(layout: Layout, xy: Array, rng: np.random.Generator, mix: dict[str, float],
          share_of_height: tuple[float, float] = (0.0, 1.0)) -> Model:  # fmt: skip
    names = list(mix)
    weights = np.array([mix[n] for n in names])
    species = names[rng.choice(len(names), p=weights / weights.sum())]
    low, high = vegetation.SPECIES[species].height_m
    height = low + (high - low) * float(rng.uniform(*share_of_height))
    if not layout.in_view(xy) or not layout.site.claim([(*xy[:2], 0.9)]):
        return []
    lod = layout.lod(xy)
    if lod < FAR:
        model = vegetation.tree(species, height_m=height, lod=lod, rng=rng)
    else:
        model = _far_tree(layout, species, height, rng)
    return sunk(layout.stand(model, xy, float(rng.uniform(0, 2 * np.pi))), 0.08)


FAR = 2
"""level of detail from which on trees need not be individuals"""
FAR_DESIGNS = 8
"""different far trees of a species: each stands turned, scaled and tinted"""


def _far_tree(layout: Layout, species: str, height_m: float, rng: np.random.Generator) -> Model:
    key, usual = (species, int(rng.integers(FAR_DESIGNS))), vegetation.SPECIES[species].height_m[1]
    if key not in layout.far_trees:
        own = layout.spec.stream(f"far {species} {key[1]}")
        layout.far_trees[key] = vegetation.tree(species, height_m=usual, lod=FAR, rng=own)
    tint = rng.uniform(0.85, 1.15, 3).astype(np.float32)
    scaled = placed(layout.far_trees[key], xyz=np.zeros(3), scale=height_m / usual)
    return [p if p.color is None else replace(p, color=p.color * tint) for p in scaled]


def street_trees(layout: Layout) -> Placed:
    """Rows of trees along the road, on wide pavements or behind the verge."""
    rng = layout.spec.stream("street trees")
    if layout.spec.street_trees_per_100m < 0.3:
        return
    spacing = 100.0 / layout.spec.street_trees_per_100m
    town = layout.spec.road.kind == "town"
    for lane, line in edges(layout):
        if rng.random() < 0.25:
            continue
        on_pavement = lane.kind == "sidewalk" and lane.width > 2.6
        offset = lane.width - 0.8 if on_pavement else -float(rng.uniform(3.0, 6.0))
        mix = {"street": 1.0} if on_pavement and town else layout.spec.species
        for point, _ in along(layout, line, spacing, rng, offset):
            free = layout.site.clear_of(point[:2], road=0.4, pavement=-1, buildings=1.6)[0]
            if free and rng.random() < 0.9 and layout.open_above(point, 5.0):
                yield _tree(layout, point, rng, mix, (0.0, 0.7))


def trees(layout: Layout) -> Placed:
    """Trees and shrubs on open land, in clumps."""
    rng = layout.spec.stream("trees")
    width, depth = 2 * 130.0, 330.0
    num = min(MAX_TREES, int(rng.poisson(layout.spec.trees_per_hectare * width * depth / 1e4)))
    centres = rng.uniform([-20, -130], [310, 130], (max(1, num // 6), 2))
    xy = centres[rng.integers(len(centres), size=num)] + rng.normal(0, 9.0, (num, 2))
    xy += layout.rig_xy
    keep = layout.site.clear_of(xy, road=5.0, pavement=1.5, buildings=3.0)
    for point in xy[keep]:
        if rng.random() < 0.25:
            yield _shrub(layout, point, rng)
        else:
            yield _tree(layout, point, rng, layout.spec.species)


MAX_TREES = 420


def _shrub(layout: Layout, xy: Array, rng: np.random.Generator) -> Model:
    if not layout.in_view(xy) or not layout.site.claim([(*xy[:2], 0.6)]):
        return []
    model = vegetation.shrub(rng=rng, lod=layout.lod(xy, 25.0, 70.0))
    return sunk(layout.stand(model, xy, float(rng.uniform(0, 6.28))), 0.05)


def grass(layout: Layout) -> Placed:
    """Tufts on the verges near the rig."""
    rng = layout.spec.stream("grass")
    near = rng.uniform([1.0, -26.0], [34.0, 26.0], (9000, 2))
    far = rng.uniform([34.0, -45.0], [80.0, 45.0], (5000, 2))
    xy = np.concatenate([near, far]) + layout.rig_xy
    bare = np.sin(xy[:, 0] * 0.9) * np.sin(xy[:, 1] * 1.1) + rng.normal(0, 0.5, len(xy)) < -0.1
    xy = xy[~bare & layout.site.clear_of(xy, road=0.25, pavement=0.15, buildings=0.3)]
    z = layout.site.height(xy)
    known = ~np.isnan(z)
    yield [vegetation.grass_tufts(xy[known], z[known] - 0.02, rng=rng)]


VERGE_AHEAD_M = 90.0


def verges(layout: Layout) -> Placed:
    """Tall grass in drifts, and shrubs, beside roads that have no pavement."""
    rng = layout.spec.stream("verges")
    for lane, line in edges(layout):
        if lane.kind == "sidewalk":
            continue
        grown = resampled(offset_line(line, -2.2), 0.3)
        grown = grown[np.linalg.norm(grown[:, :2] - layout.rig_xy, axis=1) < VERGE_AHEAD_M]
        xy = grown[:, :2].repeat(4, axis=0) + rng.normal(0, 0.7, (4 * len(grown), 2))
        drifts = np.sin(0.23 * xy[:, 0] + 0.5 * np.sin(0.31 * xy[:, 1])) > rng.normal(
            0, 0.4, len(xy)
        )
        xy = xy[drifts & layout.site.clear_of(xy, road=0.7, pavement=0.3, buildings=0.3)]
        z = layout.site.height(xy)
        known = ~np.isnan(z)
        if known.any():
            yield [vegetation.grass_tufts(xy[known], z[known] - 0.02, rng=rng, tall=True)]
        for point, _ in along(layout, line, 9.0, rng, -float(rng.uniform(3.2, 5.0))):
            near = np.linalg.norm(point[:2] - layout.rig_xy) < 160.0
            clear = layout.site.clear_of(point[:2], road=2.0, pavement=1.0, buildings=1.5)[0]
            if near and clear and rng.random() < 0.35:
                yield _shrub(layout, point, rng)
