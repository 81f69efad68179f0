"""What stands where: buildings, traffic, vegetation, street furniture and the far background.

Each ``_place_*`` function draws from its own stream of the scene and yields models that stand on
the ground, with an instance id each. :class:`~simgen.site.Site` keeps them from overlapping.
The level of detail falls with the distance from the rig.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import count

import numpy as np
import shapely

from simgen import background, buildings, vegetation, vehicles
from simgen.geometry import Array
from simgen.markings import BAY_M
from simgen.mesh import Model, Part, placed
from simgen.recipe import SceneSpec
from simgen.roads import Lane, at_station, offset_line, resampled, stations
from simgen.schema import LABELS
from simgen.site import Site

BEHIND_M = -30.0
"""What stands further behind the rig is left out: neither seen nor casting a shadow in view."""
AHEAD_M = 430.0
BESIDE_M = 260.0
FAR_CENTRE = np.array([150.0, 0.0])
FAR_INNER_M = 400.0
"""The modelled land is the square of this half side around FAR_CENTRE; the background goes on."""
FAR_OUTER_M = 3000.0

Placed = Iterator[Model]


class Layout:
    """A scene's objects, as they are placed."""

    def __init__(self, site: Site, spec: SceneSpec, rig_xy: Array, sign_rects: Sequence[str]) -> None:
        self.site, self.spec, self.rig_xy = site, spec, rig_xy
        self.lanes = site.network.lanes
        self.sign_rects = sign_rects

    def lod(self, xy: Array, near: float = 32.0, far: float = 95.0) -> int:
        """0 near the rig, 2 far away."""
        distance = float(np.linalg.norm(np.asarray(xy)[:2] - self.rig_xy))
        return int(distance > near) + int(distance > far)

    def in_view(self, xy: Array) -> bool:
        """Whether something at ``xy`` can matter for an image."""
        return bool(BEHIND_M < xy[0] - self.rig_xy[0] < AHEAD_M and abs(xy[1]) < BESIDE_M)

    def stand(self, model: Model, xy: Array, heading: float = 0.0, z: float | None = None,
              normal: Array | None = None) -> Model:  # fmt: skip
        """The model on the ground; empty where there is none."""
        ground = float(self.site.height(xy[:2])[0]) if z is None else z
        if np.isnan(ground):
            return []
        xyz = np.array([xy[0], xy[1], ground])
        return placed(model, xyz=xyz, heading_rad=heading, normal=normal)


def place(site: Site, spec: SceneSpec, rig_xy: Array, sign_rects: Sequence[str]) -> list[Part]:
    """All objects of a scene, with instance ids from 1."""
    layout = Layout(site, spec, rig_xy, sign_rects)
    clear_the_rig(layout)
    ids = count(1)
    steps = (
        _buildings, _traffic, _parked, _street_trees, _trees, _grass, _background,
    )  # fmt: skip
    parts: list[Part] = []
    for step in steps:
        for model in step(layout):
            instance = next(ids) if any(_is_thing(p) for p in model) else 0
            parts += [replace(p, instance=instance) for p in model]
    return parts


_STUFF = {LABELS["terrain"], LABELS["vegetation"], LABELS["guard rail"], LABELS["wall"],
          LABELS["fence"]}  # fmt: skip


def _is_thing(part: Part) -> bool:
    """Whether a part belongs to something that can be counted; a tree can, tufts of grass cannot."""
    return part.semantic not in _STUFF or part.material in ("leaf", "bark") and part.semantic == LABELS["vegetation"]


def clear_the_rig(layout: Layout) -> None:
    """Keeps the cameras free: nothing stands within a car's length of them."""
    x, y = layout.rig_xy
    layout.site.claim([(x + d, y, 2.2) for d in (-4.0, -1.0, 2.0, 5.0)])


# --- buildings -----------------------------------------------------------------------------------


def _buildings(layout: Layout) -> Placed:
    for number, masses in enumerate(layout.site.network.buildings):
        rng = layout.spec.stream(f"building {number}")
        model: Model = []
        walls = rng.permutation(["wall_0", "wall_1", "wall_2", "wall_3"])
        for mass in masses:
            middle = mass.footprint.mean(axis=0)
            if layout.in_view(middle):
                nearest = mass.footprint[np.argmin(np.linalg.norm(mass.footprint - layout.rig_xy, axis=1))]
                model += buildings.build(mass, rng=rng, lod=layout.lod(nearest, 45.0, 130.0),
                                         walls=[str(w) for w in walls[:2]])  # fmt: skip
        if model:
            yield model


# --- traffic -------------------------------------------------------------------------------------


def _traffic(layout: Layout) -> Placed:
    """Vehicles in their lanes, with gaps of at least a second or so."""
    rng = layout.spec.stream("traffic")
    mean_gap = 1000.0 / max(layout.spec.moving_per_km, 0.1)
    for lane in layout.lanes:
        if lane.kind == "driving" and not lane.in_junction:
            for s in _arrivals(stations(lane.centre)[-1] - 9.0, mean_gap, 9.0, rng):
                yield _vehicle(layout, lane, s, float(rng.normal(0, 0.15)), rng)


def _parked(layout: Layout) -> Placed:
    """Vehicles in the bays of parking lanes."""
    rng = layout.spec.stream("parked")
    cars = {k: v for k, v in layout.spec.families.items() if k not in ("bus", "box_truck",
                                                                        "semi_trailer")}  # fmt: skip
    for lane in layout.lanes:
        if lane.kind == "parking" and not lane.in_junction:
            for s in np.arange(3.0 + BAY_M / 2, stations(lane.centre)[-1] - BAY_M, BAY_M):
                if rng.random() < layout.spec.parked:
                    shift = s + float(rng.normal(0, 0.25))
                    yield _vehicle(layout, lane, shift, float(rng.normal(0, 0.08)), rng, cars)


def _arrivals(
    length: float, mean_gap: float, min_gap: float, rng: np.random.Generator
) -> Iterator[float]:
    s = float(rng.exponential(mean_gap))
    while s < length:
        yield s
        s += min_gap + float(rng.exponential(mean_gap))


def _vehicle(
    layout: Layout,
    lane: Lane,
    s: float,
    lateral: float,
    rng: np.random.Generator,
    mix: dict[str, float] | None = None,
) -> Model:
    """A vehicle standing on its lane, tilted as the road is; nothing if the place is taken."""
    point, heading = at_station(lane.centre, s)
    heading = float(heading) + float(rng.normal(0, 0.012))
    along = np.array([np.cos(heading), np.sin(heading)])
    xy = point[:2] + lateral * np.array([-along[1], along[0]])
    if not layout.in_view(xy):
        return []
    family = vehicles.draw_family(rng=rng, mix=mix or layout.spec.families)
    vehicle = vehicles.build(family, rng=rng)
    reach = vehicle.length / 2
    discs = [(*(xy + d * along), vehicle.width / 2 + 0.15) for d in np.linspace(-reach, reach, 6)]
    if not layout.site.claim(discs):
        return []
    ends = at_station(lane.centre, np.array([s - 1.5, s + 1.5]))[0]
    slope = (ends[1, 2] - ends[0, 2]) / 3.0
    normal = np.array([-slope * along[0], -slope * along[1], 1.0])
    return layout.stand(vehicle.model, xy, heading, z=float(point[2]), normal=normal)


# --- beside the road -----------------------------------------------------------------------------


def _edges(layout: Layout) -> Iterator[tuple[Lane, Array, float]]:
    """The outer edge of every road side outside junctions: (outermost lane, line, sign to outside).

    The line runs along the lane's direction of travel, so the outside is always on its right.
    """
    outermost: dict[tuple[str, str], Lane] = {}
    for lane in layout.lanes:
        key = (lane.road, lane.side)
        if not lane.in_junction and (key not in outermost or lane.rank > outermost[key].rank):
            outermost[key] = lane
    for lane in outermost.values():
        yield lane, lane.offset(-lane.width / 2), -1.0


def _along(
    layout: Layout, line: Array, spacing: float, rng: np.random.Generator, offset: float = 0.0
) -> Iterator[tuple[Array, float]]:
    """Points in view and headings, about every ``spacing`` metres, ``offset`` to the left."""
    shifted = offset_line(line, offset)
    start = float(rng.uniform(0.2, 1.0)) * spacing
    for s in np.arange(start, stations(shifted)[-1] - 2.0, spacing):
        point, heading = at_station(shifted, float(s) + float(rng.normal(0, 0.03 * spacing)))
        if layout.in_view(point):
            yield point, float(heading)


def _kerbside(lane: Lane) -> float:
    """How far left of the outer edge street furniture stands: on the pavement near the kerb."""
    return lane.width - 0.45 if lane.kind == "sidewalk" else -1.4


# --- vegetation ----------------------------------------------------------------------------------


def _tree(layout: Layout, xy: Array, rng: np.random.Generator, mix: dict[str, float],
          share_of_height: tuple[float, float] = (0.0, 1.0)) -> Model:  # fmt: skip
    names = list(mix)
    weights = np.array([mix[n] for n in names])
    species = names[rng.choice(len(names), p=weights / weights.sum())]
    low, high = vegetation.SPECIES[species].height_m
    height = low + (high - low) * float(rng.uniform(*share_of_height))
    if not layout.in_view(xy) or not layout.site.claim([(*xy[:2], 0.9)]):
        return []
    model = vegetation.tree(species, height_m=height, lod=layout.lod(xy), rng=rng)
    return _sunk(layout.stand(model, xy, float(rng.uniform(0, 2 * np.pi))), 0.08)


def _sunk(model: Model, depth_m: float) -> Model:
    """Lowered a little, so that sloping ground leaves no gap."""
    return [replace(p, vertices=p.vertices - [0.0, 0.0, depth_m]) for p in model]


def _street_trees(layout: Layout) -> Placed:
    """Rows of trees along the road, on wide pavements or behind the verge."""
    rng = layout.spec.stream("street trees")
    if layout.spec.street_trees_per_100m < 0.3:
        return
    spacing = 100.0 / layout.spec.street_trees_per_100m
    town = layout.spec.road.kind == "town"
    for lane, line, _ in _edges(layout):
        if rng.random() < 0.25:
            continue
        on_pavement = lane.kind == "sidewalk" and lane.width > 2.6
        offset = lane.width - 0.8 if on_pavement else -float(rng.uniform(3.0, 6.0))
        mix = {"street": 1.0} if on_pavement and town else layout.spec.species
        for point, _ in _along(layout, line, spacing, rng, offset):
            free = layout.site.clear_of(point[:2], road=0.4, pavement=-1, buildings=1.6)[0]
            if free and rng.random() < 0.9:
                yield _tree(layout, point, rng, mix, (0.0, 0.7))


def _trees(layout: Layout) -> Placed:
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
    return _sunk(layout.stand(model, xy, float(rng.uniform(0, 6.28))), 0.05)


def _grass(layout: Layout) -> Placed:
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


# --- background ----------------------------------------------------------------------------------


def _background(layout: Layout) -> Placed:
    """Hills, woods and a skyline from the edge of the modelled land to the horizon."""
    rng = layout.spec.stream("background")

    def inner_height(xy: Array) -> Array:
        z = layout.site.height(xy + FAR_CENTRE)
        return np.nan_to_num(z)

    land = background.countryside(
        FAR_INNER_M, FAR_OUTER_M, inner_height, relief_m=layout.spec.far_relief_m, rng=rng
    )
    far = [background.terrain_ring(land), background.tree_line(land, rng=rng)]
    yield placed(far, xyz=[*FAR_CENTRE, 0.0])
    blocks = background.skyline(rng=rng, num=layout.spec.skyline, near_m=FAR_INNER_M + 40.0,
                                far_m=2200.0, ground_height=land.height)  # fmt: skip
    for block in blocks:
        yield placed([block], xyz=[*FAR_CENTRE, 0.0])
