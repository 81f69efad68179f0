"""Vehicles: moving in their lanes, parked in bays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simgen import vehicles
from simgen.layout import Layout, Placed
from simgen.markings import BAY_M
from simgen.mesh import Model
from simgen.roads import Lane, at_station, stations
from simgen.vehicles import Vehicle

NUM_DESIGNS = 10
"""Designs of one scene, shared out among the families; each has at least one."""
_NEVER_IN_BAYS = ("bus", "box_truck", "semi_trailer")


@dataclass(frozen=True, eq=False)
class _Fleet:
    """What one stream of vehicles is drawn from.

    As in a real street, models repeat and colours do not.
    """

    layout: Layout
    mix: dict[str, float]
    rng: np.random.Generator

    def draw(self) -> Vehicle:
        """A vehicle in colours of its own."""
        family = vehicles.draw_family(rng=self.rng, mix=self.mix)
        share = vehicles.FAMILIES[family].share
        number = int(self.rng.integers(1 + round(NUM_DESIGNS * share)))
        designs = self.layout.designs
        if (family, number) not in designs:
            own = self.layout.spec.stream(f"design {family} {number}")
            designs[family, number] = vehicles.build(family, rng=own)
        return designs[family, number].repainted(rng=self.rng)


def moving(layout: Layout) -> Placed:
    """Vehicles in their lanes, with gaps of at least a second or so."""
    rng = layout.spec.stream("traffic")
    fleet = _Fleet(layout, dict(layout.spec.families), rng)
    mean_gap = 1000.0 / max(layout.spec.moving_per_km, 0.1)
    for lane in layout.lanes:
        if lane.kind == "driving" and not lane.in_junction:
            for s in _arrivals(stations(lane.centre)[-1] - 9.0, mean_gap, 9.0, rng):
                yield _vehicle(layout, lane, s, float(rng.normal(0, 0.15)), fleet)


def parked(layout: Layout) -> Placed:
    """Vehicles in the bays of parking lanes."""
    rng = layout.spec.stream("parked")
    small = {k: v for k, v in layout.spec.families.items() if k not in _NEVER_IN_BAYS}
    fleet = _Fleet(layout, small, rng)
    for lane in layout.lanes:
        if lane.kind == "parking" and not lane.in_junction:
            for s in np.arange(3.0 + BAY_M / 2, stations(lane.centre)[-1] - BAY_M, BAY_M):
                if rng.random() < layout.spec.parked:
                    shift = float(s) + float(rng.normal(0, 0.25))
                    yield _vehicle(layout, lane, shift, float(rng.normal(0, 0.08)), fleet)


def _arrivals(
    length: float, mean_gap: float, min_gap: float, rng: np.random.Generator
) -> Iterator[float]:
    s = float(rng.exponential(mean_gap))
    while s < length:
        yield s
        s += min_gap + float(rng.exponential(mean_gap))


def _vehicle(layout: Layout, lane: Lane, s: float, lateral: float, fleet: _Fleet) -> Model:
    """A vehicle standing on its lane, tilted as the road is; nothing if the place is taken."""
    point, tangent = at_station(lane.centre, s)
    heading = float(tangent) + float(fleet.rng.normal(0, 0.012))
    along = np.array([np.cos(heading), np.sin(heading)])
    xy = point[:2] + lateral * np.array([-along[1], along[0]])
    if not layout.in_view(xy):
        return []
    vehicle = fleet.draw()
    reach = vehicle.length / 2
    discs = [(*(xy + d * along), vehicle.width / 2 + 0.15) for d in np.linspace(-reach, reach, 6)]
    if not layout.site.claim(discs):
        return []
    ends = at_station(lane.centre, np.array([s - 1.5, s + 1.5]))[0]
    slope = (ends[1, 2] - ends[0, 2]) / 3.0
    normal = np.array([-slope * along[0], -slope * along[1], 1.0])
    return layout.stand(vehicle.model, xy, heading, z=float(point[2]), normal=normal)
