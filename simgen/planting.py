"""Trees, shrubs and grass: in rows along the road, in clumps on open land, tufts on the verges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simgen import vegetation
from simgen.geometry import Array
from simgen.layout import Layout, Placed, along, edges, sunk
from simgen.mesh import Model, placed
from simgen.places import Place
from simgen.roads import offset_line, resampled
from simgen.sheets import BARK_M
from simgen.solids import upright


def _tree(layout: Layout, xy: Array, rng: np.random.Generator, mix: dict[str, float],
          share_of_height: tuple[float, float] = (0.0, 1.0)) -> Model:  # fmt: skip
    names = list(mix)
    weights = np.array([mix[n] for n in names])
    species = names[rng.choice(len(names), p=weights / weights.sum())]
    low, high = vegetation.SPECIES[species].height_m
    height = low + (high - low) * float(rng.uniform(*share_of_height))
    if not layout.in_view(xy):
        return []
    height, clear_m = _fitted(layout, species, height, xy)
    if height < MIN_SHARE * low or not layout.site.claim([(*xy[:2], 0.9)]):
        return []
    lod: int = layout.lod(xy, FINE_TREE_M)
    if lod < FAR and layout.tree_triangles > MAX_TREE_TRIANGLES:
        lod += 1
    heading, own = float(rng.uniform(0, 2 * np.pi)), _own(rng)
    eyes = layout.close_eyes(xy[None], heading)
    if lod < FAR or clear_m or eyes is not None:
        model = vegetation.tree(
            species, height_m=height, lod=lod, rng=own, clear_m=clear_m, eyes=eyes
        )
    else:
        model = _far_tree(layout, species, height, own)
    if lod < FAR and eyes is None:
        layout.tree_triangles += sum(len(p.faces) for p in model)
    layout.spend_close(model, eyes)
    place = _bark_place(layout, species, height, xy, own)
    model = [
        p if p.uv is None else replace(p, uv=place.uv(p.uv.astype(np.float64)).astype(np.float32))
        for p in model
    ]
    return sunk(layout.stand(model, xy, heading), SUNK_M)


def _own(rng: np.random.Generator) -> np.random.Generator:
    """One for a single plant, so that its detail does not decide what comes after it."""
    return np.random.default_rng(rng.integers(1 << 62))


def _bark_place(
    layout: Layout, species: str, height_m: float, xy: Array, rng: np.random.Generator
) -> Place:
    """Where on the sheet the bark of a tree lies: that of its trunk is the tree's own."""
    if vegetation.SPECIES[species].trunk is not None:  # but for limbs, which are scattered anyway
        u, v = rng.uniform(0, BARK_M, 2).tolist()
        return Place(u, v, bool(rng.random() < 0.5))
    foot = np.array([*xy[:2], float(layout.site.height(xy[:2])[0])])
    to_rig = layout.way[np.argmin(np.linalg.norm(layout.way - xy[:2], axis=1))] - xy[:2]
    girth, length = vegetation.trunk_m(species, height_m)
    frame = upright(foot, to_rig / max(np.linalg.norm(to_rig), 1e-9))
    return layout.places.take("bark", frame, (0.0, 0.0, girth, length))


SUNK_M = 0.08
CROWN_GAP_M = 0.3
"""between a crown and a house, or a lane that it does not bridge"""
HEADROOM_M = 4.5
"""under a crown over a lane"""
WIRE_GAP_M = 0.7
"""between a crown and overhead wires"""
TALLEST = 1.1
"""at most the height of a tree over the one asked for"""
MIN_SHARE = 0.6
"""of the usual height of its species: a lower tree is not planted"""


def _fitted(layout: Layout, species: str, height_m: float, xy: Array) -> tuple[float, float]:
    """The height [m] that a tree at ``xy`` may have, and how far up it must have no limbs.

    Its crown stays clear of houses, and of lanes unless there is headroom below it.
    """
    per_m = vegetation.crown_radius_m(species, 1.0)
    from_house, from_lane = layout.site.room(xy) - CROWN_GAP_M
    height = _clear_of_wires(layout, species, min(height_m, from_house / per_m), xy)
    if height * per_m <= from_lane:
        return height, 0.0
    clear_m = HEADROOM_M + SUNK_M + _rise(layout, xy, height * per_m)
    if height >= vegetation.lowest_limbed_m(clear_m):
        return height, clear_m
    return from_lane / per_m, 0.0


def _clear_of_wires(layout: Layout, species: str, height_m: float, xy: Array) -> float:
    """The height [m], up to ``height_m``, of a tree that stays below wires or beside them."""
    if not layout.wires:
        return height_m
    a, b = np.concatenate(layout.wires).swapaxes(0, 1)
    along = (b - a)[:, :2]
    share = ((xy[:2] - a[:, :2]) * along).sum(axis=1) / (along**2).sum(axis=1)
    nearest = a[:, :2] + np.clip(share, 0, 1)[:, None] * along
    beside = np.linalg.norm(nearest - xy[:2], axis=1) - WIRE_GAP_M
    below = np.minimum(a[:, 2], b[:, 2]) - layout.site.height(xy[:2]) - WIRE_GAP_M
    room = np.maximum(beside / vegetation.crown_radius_m(species, 1.0), below / TALLEST)
    return min(height_m, float(room.min()))


def _rise(layout: Layout, xy: Array, radius_m: float) -> float:
    """How much higher than at ``xy`` the ground may be within a crown's radius [m]."""
    azimuth = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rim = xy[:2] + radius_m * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    z = layout.site.height(np.concatenate([[xy[:2]], rim]))
    return float(np.nanmax(z) - z[0])


FINE_TREE_M = 50.0
"""Trees up to that far are as detailed as they get without single leaves."""
MAX_TREE_TRIANGLES = 320_000
"""of trees that are individuals without single leaves; in a dense wood all further ones are a level
coarser"""
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
    low, high = layout.around((-20.0, -130.0), (310.0, 130.0))
    hectares = float(np.prod(high - low)) / 1e4
    most = int(MAX_TREES_PER_HECTARE * hectares)
    num = min(most, int(rng.poisson(layout.spec.trees_per_hectare * hectares)))
    centres = rng.uniform(low, high, (max(1, num // 6), 2))
    xy = centres[rng.integers(len(centres), size=num)] + rng.normal(0, 9.0, (num, 2))
    keep = layout.site.clear_of(xy, road=5.0, pavement=1.5, buildings=3.0)
    xy = xy[keep]
    for point in xy[np.argsort(layout.distance(xy), kind="stable")]:  # near ones have first choice
        if rng.random() < 0.25:
            yield _shrub(layout, point, rng)
        else:
            yield _tree(layout, point, rng, layout.spec.species)


MAX_TREES_PER_HECTARE = 49.0


def _shrub(layout: Layout, xy: Array, rng: np.random.Generator) -> Model:
    if not layout.in_view(xy) or not layout.site.claim([(*xy[:2], 0.6)]):
        return []
    heading = float(rng.uniform(0, 2 * np.pi))
    eyes = layout.close_eyes(xy[None], heading)
    model = vegetation.shrub(rng=_own(rng), lod=layout.lod(xy, 25.0, 70.0), eyes=eyes)
    layout.spend_close(model, eyes)
    return sunk(layout.stand(model, xy, heading), 0.05)


def grass(layout: Layout) -> Placed:
    """Tufts on the verges near the rig."""
    rng = layout.spec.stream("grass")
    near = _scattered(5.2, layout.around((1.0, -26.0), (34.0, 26.0)), rng)
    far = _scattered(1.2, layout.around((34.0, -45.0), (80.0, 45.0)), rng)
    xy = np.concatenate([near, far])
    bare = np.sin(xy[:, 0] * 0.9) * np.sin(xy[:, 1] * 1.1) + rng.normal(0, 0.5, len(xy)) < -0.1
    xy = xy[~bare & layout.site.clear_of(xy, road=0.25, pavement=0.15, buildings=0.3)]
    z = layout.site.height(xy)
    known = ~np.isnan(z)
    yield [vegetation.grass_tufts(xy[known], z[known] - 0.02, rng=rng)]


def _scattered(per_m2: float, box: tuple[Array, Array], rng: np.random.Generator) -> Array:
    """Points (N, 2) in a rectangle."""
    return rng.uniform(*box, (int(per_m2 * np.prod(box[1] - box[0])), 2))


VERGE_AHEAD_M = 90.0


def verges(layout: Layout) -> Placed:
    """Tall grass in drifts, and shrubs, beside roads that have no pavement."""
    rng = layout.spec.stream("verges")
    for lane, line in edges(layout):
        if lane.kind == "sidewalk":
            continue
        grown = resampled(offset_line(line, -2.2), 0.3)
        grown = grown[layout.distance(grown[:, :2]) < VERGE_AHEAD_M]
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
            near = layout.distance(point[:2])[0] < 160.0
            clear = layout.site.clear_of(point[:2], road=2.0, pavement=1.0, buildings=1.5)[0]
            if near and clear and rng.random() < 0.35:
                yield _shrub(layout, point, rng)
