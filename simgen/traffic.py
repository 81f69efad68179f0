"""Vehicles: moving in their lanes, parked in bays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from simgen import vehicles
from simgen.layout import Layout, Placed
from simgen.markings import BAY_M
from simgen.mesh import Model
from simgen.roads import Lane, at_station, stations


def moving(layout: Layout) -> Placed:
    """Vehicles in their lanes, with gaps of at least a second or so."""
    rng = layout.spec.stream("traffic")
    mean_gap = 1000.0 / max(layout.spec.moving_per_km, 0.1)
    for lane in layout.lanes:
        if lane.kind == "driving" and not lane.in_junction:
            for s in _arrivals(stations(lane.centre)[-1] - 9.0, mean_gap, 9.0, rng):
                yield _vehicle(layout, lane, s, float(rng.normal(0, 0.15)), rng)


def parked(layout: Layout) -> Placed:
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
