"""A drawn spec → all surfaces and lights of the scene, seen from where the rig stands."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from simgen import (
    bridges,
    crossings,
    daylight,
    ground,
    markings,
    night,
    passers_by,
    planting,
    roads,
    roadside,
    sheets,
    surroundings,
    traffic,
    trolley,
    wetness,
    works,
)
from simgen.alignment import followed
from simgen.geometry import Array, rotation_from_vector, transform
from simgen.given_map import AFTER_DRIVE_M
from simgen.layout import Layout, Mover, Placed
from simgen.materials import MATERIALS
from simgen.mesh import Part
from simgen.recipe import SceneSpec
from simgen.rig import FRAME_STEP_M, drive_length
from simgen.roads import Network, at_station, points_at, stations
from simgen.scene import World
from simgen.schema import LABELS
from simgen.signs import sign_atlas
from simgen.site import Site


@dataclass(frozen=True, eq=False)
class Drive:
    """A scene's network and the rig's pose on it."""

    network: Network
    T_world_vehicle: Array
    """(4, 4): x forward, y left, z up, origin on the road below the rig"""
    way: Array
    """(N, 3) along which the rig drives in this scene, from the first frame to the last"""


def drive(spec: SceneSpec, step: int, opendrive_map: bytes = b"", *, num_steps: int = 1) -> Drive:
    """The road network and where the rig is at frame ``step`` of the scene's ``num_steps``.

    Raises RuntimeError where the road ends before the last of them.
    """
    length = drive_length(num_steps)
    network = roads.build(spec, opendrive_map, drive_m=length)
    rng = spec.stream(f"pose {step}")
    start = network.rig_station
    others = [x.centre for x in network.lanes if x.kind == "driving"]
    line = followed(network.rig_lane.centre, others, start + length + AFTER_DRIVE_M)
    if stations(line)[-1] < start + length + 2.0:
        raise RuntimeError(f"the road goes on for {stations(line)[-1] - start:.0f} m, the drive "
                           f"for {length:.0f}")  # fmt: skip
    s = start + FRAME_STEP_M * step
    point, heading = at_station(line, s)
    ends = points_at(line, np.array([s - 1.5, s + 1.5]))
    pitch = -np.arctan2(ends[1, 2] - ends[0, 2], 3.0)
    side = np.array([-np.sin(heading), np.cos(heading), 0.0])
    yaw = float(heading) + float(rng.normal(0, 0.01))
    R = rotation_from_vector(np.array([0, 0, yaw])) @ rotation_from_vector(np.array([0, pitch, 0]))
    way = points_at(line, np.linspace(start, start + length, num_steps))
    return Drive(network, transform(R, point + float(rng.normal(0, 0.12)) * side), way)


def build(spec: SceneSpec, drive: Drive, optics: ground.Optics) -> World:
    """Everything that can be seen.

    What stands where follows from the scene alone, wherever on its way the rig is.
    """
    half = surroundings.FAR_INNER_M
    # OpenCV and NumPy let other threads run: images are painted while objects are put in place.
    with ThreadPoolExecutor(max_workers=2) as pool:
        sky = pool.submit(daylight.environment, spec.sky, rng=spec.stream("clouds"))
        site = Site(drive.network)
        crossing = crossings.plan(site, spec)
        paints = markings.paint(drive.network, spec.road, rng=spec.stream("paint"))
        maps = pool.submit(
            ground.build, site, spec, paints, drive.T_world_vehicle, optics,
            far_low=surroundings.FAR_CENTRE - half, far_high=surroundings.FAR_CENTRE + half,
        )  # fmt: skip
        atlas = sign_atlas(rng=spec.stream("signs"))
        zoom = 1 / np.tan(optics.hfov_rad / 2)
        layout = Layout(site, spec, drive.way[:, :2], atlas.rects, float(zoom), crossing)
        parts, movers = _place(layout)
        surfaces = _sheets(spec, {p.material for p in parts}, optics.focal_px, pool)
        lamps = night.lamps(layout, drive.T_world_vehicle) if daylight.is_night(spec.sky) else []
        return World(
            parts, maps.result(), surfaces, atlas.image, sky.result(), lamps, movers, layout.way
        )


_STEPS: tuple[Callable[[Layout], Placed], ...] = (
    bridges.over_the_road, surroundings.houses, works.road_works, traffic.moving, traffic.parked,
    passers_by.cyclists, roadside.signals, roadside.lamps, roadside.signs, roadside.utility_poles,
    roadside.gantry, roadside.rails, roadside.noise_walls, trolley.overhead, works.building_site,
    planting.street_trees, roadside.small_things, roadside.frontage, passers_by.bicycles,
    passers_by.pedestrians, planting.verges, planting.trees, planting.grass, surroundings.horizon,
)  # fmt: skip
"""In order of precedence: what comes first takes the place."""
_STUFF = {LABELS[n] for n in ("terrain", "guard rail", "wall", "fence", "bridge")}
"""Classes that cannot be counted: they have no instance."""


def _place(layout: Layout) -> tuple[list[Part], list[dict[str, Any]]]:
    """All objects, with instance ids from 1, and the records of those that can move."""
    layout.keep_clear_of_rig()
    ids = count(1)
    parts: list[Part] = []
    movers: list[dict[str, Any]] = []
    dark, rng = daylight.is_night(layout.spec.sky), layout.spec.stream("night")
    for step in _STEPS:
        for thing in step(layout):
            model = thing.model if isinstance(thing, Mover) else thing
            if dark and step not in (traffic.parked, passers_by.bicycles):
                model = night.glowing(model, rng=rng)
            instance = next(ids) if any(p.semantic not in _STUFF for p in model) else 0
            parts += [replace(_rained_on(p, layout.spec), instance=instance) for p in model]
            if isinstance(thing, Mover):
                movers.append(thing.record(instance))
    return parts, movers


def _rained_on(p: Part, spec: SceneSpec) -> Part:
    """The part as dark as the scene's wetness makes it, if water soaks into it."""
    if spec.sky.wetness == 0 or p.color is None or p.material not in ("matte", "leaf"):
        return p
    exposure = 1.0 if p.semantic == LABELS["terrain"] else wetness.UPRIGHT
    return replace(p, color=wetness.darkened(p.color, spec.sky.wetness, exposure))


WALL_COLORS = {
    "brick": ((0.26, 0.10, 0.07), (0.33, 0.17, 0.10), (0.20, 0.10, 0.08), (0.38, 0.27, 0.17)),
    "plaster": ((0.62, 0.58, 0.50), (0.60, 0.47, 0.28), (0.55, 0.37, 0.30), (0.45, 0.50, 0.48)),
    "concrete": ((0.32, 0.31, 0.29), (0.40, 0.38, 0.35)),
    "stone": ((0.38, 0.33, 0.26), (0.30, 0.29, 0.27)),
    "timber": ((0.30, 0.19, 0.11), (0.27, 0.25, 0.22), (0.55, 0.53, 0.48), (0.30, 0.06, 0.04)),
}
"""Albedos of each kind of wall; timber is oiled, weathered, or painted white or red."""


FINE_FROM_FOCAL_PX = 512.0
"""Longer lenses see the 1.6 cm between a fine sheet's pixels from 8 m away."""


def _sheets(
    spec: SceneSpec, materials: set[str], focal_px: float, pool: Executor
) -> dict[str, sheets.Sheet]:
    """The scene's four walls, its roofs, bark and turf, as fine as the images can show.

    Those that are not among the ``materials`` in use stay blank.
    """
    size_px = 2048 if focal_px >= FINE_FROM_FOCAL_PX else 1024
    rng = spec.stream("walls")
    kinds = ["brick", "plaster", *rng.choice(list(WALL_COLORS), 2)]
    colors = [WALL_COLORS[k][rng.integers(len(WALL_COLORS[k]))] for k in kinds]

    def draw(name: str) -> sheets.Sheet:
        rng = spec.stream(f"sheet {name}")
        if name == "bark":
            paint = partial(sheets.bark_sheet, rng=rng)
        elif name == "roof":
            paint = partial(sheets.roof_sheet, rng=rng, size_px=size_px)
        elif name == "turf":
            paint = partial(sheets.turf_sheet, rng=rng, size_px=size_px)
        else:
            k = int(name.removeprefix("wall_"))
            paint = partial(sheets.wall_sheet, kinds[k], colors[k], rng=rng, size_px=size_px)
        if name not in materials:
            return sheets.blank_like(paint)
        sheet: sheets.Sheet = paint()
        exposure = 1.0 if name in ("roof", "turf") else wetness.UPRIGHT
        return replace(sheet, image=wetness.wet_bytes(sheet.image, spec.sky.wetness, exposure))

    names = [name for name, material in MATERIALS.items() if material.color_by == "metres"]
    return dict(zip(names, pool.map(draw, names), strict=True))
