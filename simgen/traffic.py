"""Vehicles: moving in their lanes, parked in bays.

Speeds are those of free traffic on the kind of road, or less where the gap ahead asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simgen import vehicles
from simgen.geometry import Array
from simgen.layout import Layout, Mover, Placed
from simgen.markings import BAY_M
from simgen.roads import Lane, at_station, points_at, stations
from simgen.vehicles import Vehicle

NUM_DESIGNS = 10
"""Designs of one scene, shared out among the families; each has at least one."""
_HEAVY = ("bus", "box_truck", "semi_trailer")
HEAVY_M_S = 25.0
"""as fast as they may go"""


@dataclass(frozen=True, eq=False)
class _Fleet:
    """What one stream of vehicles is drawn from.

    As in a real street, models repeat and colours do not.
    """

    layout: Layout
    mix: dict[str, float]
    under_way: bool
    rng: np.random.Generator

    def draw(self) -> Vehicle:
        """A vehicle in colours of its own."""
        family = vehicles.draw_family(rng=self.rng, mix=self.mix)
        kind = vehicles.FAMILIES[family]
        number = int(self.rng.integers(1 + round(NUM_DESIGNS * kind.share)))
        designs, ridden = self.layout.designs, self.under_way and kind.ridden is not None
        key = (family, number, ridden)
        if key not in designs:
            own = self.layout.spec.stream(f"design {family} {number}")
            designs[key] = vehicles.build(family, rng=own, ridden=ridden)
        return designs[key].repainted(rng=self.rng)


def moving(layout: Layout) -> Placed:
    """Vehicles in their lanes, with gaps of at least a second or so."""
    rng, speeds = layout.spec.stream("traffic"), layout.spec.stream("speeds")
    fleet = _Fleet(layout, dict(layout.spec.families), under_way=True, rng=rng)
    mean_gap = 1000.0 / max(layout.spec.moving_per_km, 0.1)
    for lane in layout.lanes:
        if lane.kind == "driving" and not lane.in_junction:
            places = list(_arrivals(stations(lane.centre)[-1] - 9.0, mean_gap, 9.0, rng))
            for s, gap in zip(places, np.diff(places, append=np.inf), strict=True):
                speed = _speed(layout.spec.road.kind, float(gap), speeds)
                yield from _vehicle(layout, lane, s, float(rng.normal(0, 0.15)), fleet, speed)


def parked(layout: Layout) -> Placed:
    """Vehicles in the bays of parking lanes."""
    rng = layout.spec.stream("parked")
    small = {k: v for k, v in layout.spec.families.items() if k not in _HEAVY}
    fleet = _Fleet(layout, small, under_way=False, rng=rng)
    for lane in layout.lanes:
        if lane.kind == "parking" and not lane.in_junction:
            for s in np.arange(3.0 + BAY_M / 2, stations(lane.centre)[-1] - BAY_M, BAY_M):
                if rng.random() < layout.spec.parked:
                    shift = float(s) + float(rng.normal(0, 0.25))
                    yield from _vehicle(layout, lane, shift, float(rng.normal(0, 0.08)), fleet, 0.0)


def _arrivals(
    length: float, mean_gap: float, min_gap: float, rng: np.random.Generator
) -> Iterator[float]:
    s = float(rng.exponential(mean_gap))
    while s < length:
        yield s
        s += min_gap + float(rng.exponential(mean_gap))


_FREE_M_S = {"town": (12.0, 1.8), "rural": (22.0, 3.0), "motorway": (30.0, 4.0)}
"""mean and standard deviation of the speed that drivers choose on a free road"""
HEADWAY_S, STANDING_GAP_M = 1.3, 7.0
"""time to the vehicle ahead; from middle to middle in a queue"""


def _speed(kind: str, gap: float, rng: np.random.Generator) -> float:
    """Speed [m/s] of a vehicle whose middle is ``gap`` metres behind the next one's."""
    mean, deviation = _FREE_M_S[kind]
    free = float(np.clip(rng.normal(mean, deviation), 0.6 * mean, 1.5 * mean))
    return min(free, max(gap - STANDING_GAP_M, 0.0) / HEADWAY_S)


def road_normal(line: Array, s: float, along: Array) -> Array:
    """The upward normal (3,) of a road that runs ``along`` (2,) at a station of its line."""
    ends = points_at(line, np.array([s - 1.5, s + 1.5]))
    slope = (ends[1, 2] - ends[0, 2]) / 3.0
    return np.array([-slope * along[0], -slope * along[1], 1.0])


def _vehicle(
    layout: Layout, lane: Lane, s: float, lateral: float, fleet: _Fleet, speed_m_s: float
) -> Iterator[Mover]:
    """A vehicle standing on its lane, tilted as the road is; nothing if the place is taken."""
    point, tangent = at_station(lane.centre, s)
    heading = float(tangent) + float(fleet.rng.normal(0, 0.012))
    along = np.array([np.cos(heading), np.sin(heading)])
    xy = point[:2] + lateral * np.array([-along[1], along[0]])
    if not layout.in_view(xy):
        return
    vehicle = fleet.draw()
    reach, num = vehicle.length / 2, int(np.ceil(vehicle.length)) + 1
    discs = [(*(xy + d * along), vehicle.width / 2 + 0.15) for d in np.linspace(-reach, reach, num)]
    if layout.site.claim(discs):
        normal = road_normal(lane.centre, s, along)
        speed_m_s = min(speed_m_s, HEAVY_M_S) if vehicle.family in _HEAVY else speed_m_s
        z = float(point[2])
        yield layout.mover(vehicle.model, xy, heading, speed_m_s, z=z, normal=normal)
