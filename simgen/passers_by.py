"""People on foot and on bicycles: on pavements and crossings, and at the right edge of lanes.

Numbers follow the spec's densities as a Poisson process; rain sends people home or under
umbrellas.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, Protocol

import numpy as np

from simgen import alignment, bicycle, people
from simgen.geometry import Array
from simgen.layout import Layout, Mover, Placed, edges
from simgen.markings import CROSSING_SETBACK_M
from simgen.mesh import Model
from simgen.people import Person
from simgen.roads import Lane, at_station, offset_line, stations
from simgen.traffic import road_normal

Lod = Literal[0, 1, 2]
Rng = np.random.Generator

PARTY_SIZE = 1.5
"""mean number of people who are out together"""
WALK_M_S = (1.35, 0.2)
RIDE_M_S = (4.8, 0.9)
BICYCLES_PER_100M = 1.0
"""parked ones along a town's pavement"""
_STOCK = {"walking": 6, "waiting": 3, "phone": 2, "talking": 3}
"""Bodies of an activity that are seen again, in other clothes, where no detail shows."""


def outdoors(rain_mm_h: float) -> float:
    """Share of people who are out in the rain: a third at 10 mm/h."""
    return 1.0 / (1.0 + rain_mm_h / 5.0)


def umbrellas(rain_mm_h: float) -> float:
    """Share of people on foot under an umbrella."""
    return 0.75 * float(np.clip(rain_mm_h / 3.0, 0.0, 1.0))


class _Crowd:
    """Places people; fresh ones near the rig, a stock of bodies far away."""

    def __init__(self, layout: Layout, rng: Rng) -> None:
        self.layout, self.rng = layout, rng
        self.stock: dict[tuple[Lod, str, bool], list[Person]] = {}
        self.umbrellas = umbrellas(layout.spec.sky.rain_mm_h)

    def stand(
        self, xy: Array, heading: float, activity: str, speed: float = 0.0, *, road: float = 0.15
    ) -> Placed:
        """One person, if the place is in view, on the ground, ``road`` metres off it and free."""
        site = self.layout.site
        if not self.layout.in_view(xy) or np.isnan(site.height(xy[:2])[0]):
            return
        clear = site.clear_of(xy[:2], road=road, pavement=-1, buildings=0.35)[0]
        if clear and site.claim([(*xy[:2], 0.3)]):
            body = self._body(self.layout.lod(xy, 22.0, 60.0), activity)
            yield self.layout.mover(body.model(rng=self.rng), xy, heading, speed)

    def _body(self, lod: Lod, activity: str) -> Person:
        sheltered = activity != "phone" and bool(self.rng.random() < self.umbrellas)
        bodies = self.stock.setdefault((lod, activity, sheltered), [])
        if lod == 0 or len(bodies) < _STOCK[activity]:
            bodies.append(people.person(activity, rng=self.rng, lod=lod, umbrella=sheltered))
            return bodies[-1]
        return bodies[self.rng.integers(len(bodies))]


def pedestrians(layout: Layout) -> Placed:
    """People on foot along all roads, and those who cross them at junctions."""
    rng = layout.spec.stream("pedestrians")
    density = layout.spec.pedestrians_per_100m * outdoors(layout.spec.sky.rain_mm_h)
    crowd = _Crowd(layout, rng)
    if layout.spec.road.kind == "town" or layout.site.network.given is not None:
        for lane in layout.lanes:
            if not lane.in_junction:
                yield from _at_crossings(crowd, lane, density)
    for lane, line in edges(layout):
        for s in _stations(line, density / PARTY_SIZE / 100, rng):
            yield from _party(crowd, lane, line, s)


def _stations(line: Array, per_metre: float, rng: Rng) -> Array:
    """Stations (N,) of a Poisson process along a line."""
    length = stations(line)[-1]
    return rng.uniform(0.0, length, rng.poisson(per_metre * length))


def _left_of(heading: float | Array) -> Array:
    return np.array([-np.sin(heading), np.cos(heading)])


def _party(crowd: _Crowd, lane: Lane, line: Array, s: float) -> Placed:
    """Someone or some people together at a station of the outer edge of a road."""
    point, tangent = at_station(line, s)
    heading, rng = float(tangent), crowd.rng
    if lane.kind != "sidewalk":  # beside the traffic, towards it
        verge = point[:2] + float(rng.uniform(-0.25, 0.1)) * _left_of(heading)
        yield from crowd.stand(verge, heading + np.pi, "walking", _walking_speed(rng), road=-1)
        return
    inward = float(rng.uniform(0.45, max(0.5, lane.width - 0.5)))
    place = point[:2] + inward * _left_of(heading)
    choice = rng.random()
    if choice < 0.72:
        yield from _walkers(crowd, place, heading + np.pi * rng.integers(2))
    elif choice < 0.85:
        activity = "phone" if rng.random() < 0.5 else "waiting"
        yield from crowd.stand(place, float(rng.uniform(0, 2 * np.pi)), activity)
    else:
        yield from _talkers(crowd, place)


def _walking_speed(rng: Rng) -> float:
    return float(np.clip(rng.normal(*WALK_M_S), 0.7, 1.9))


def _walkers(crowd: _Crowd, place: Array, heading: float) -> Placed:
    """One to three people side by side; who finds no room there is left out."""
    num, speed = int(crowd.rng.choice([1, 2, 3], p=[0.7, 0.25, 0.05])), _walking_speed(crowd.rng)
    for k in range(num):
        ahead = float(crowd.rng.normal(0, 0.12)) * np.array([np.cos(heading), np.sin(heading)])
        beside = 0.68 * (k - (num - 1) / 2) * _left_of(heading)
        turn = float(crowd.rng.normal(0, 0.06))
        yield from crowd.stand(place + ahead + beside, heading + turn, "walking", speed)


def _talkers(crowd: _Crowd, place: Array) -> Placed:
    """Two to four people in a ring, facing each other."""
    num = int(crowd.rng.choice([2, 3, 4], p=[0.6, 0.3, 0.1]))
    radius, first = 0.42 + 0.1 * num, float(crowd.rng.uniform(0, 2 * np.pi))
    for angle in first + np.arange(num) * 2 * np.pi / num:
        spot = place + radius * np.array([np.cos(angle), np.sin(angle)])
        facing = float(angle) + np.pi + float(crowd.rng.normal(0, 0.2))
        yield from crowd.stand(spot, facing, "talking")


# --- crossings -----------------------------------------------------------------------------------


def _at_crossings(crowd: _Crowd, lane: Lane, density: float) -> Placed:
    """People who cross a lane before a junction, or wait at the kerb to do so."""
    rng = crowd.rng
    network = crowd.layout.site.network
    given = network.given
    places = _mouths(lane, network.junctions) if given is None else _zebras(lane, given.things)
    for s in places:
        for _ in range(rng.poisson(0.03 * density)):
            point, tangent = at_station(lane.centre, s + float(rng.normal(0, 0.6)))
            heading = float(tangent) + np.pi / 2
            if lane.kind == "driving":
                spot = point[:2] + float(rng.uniform(-0.4, 0.4)) * lane.width * _left_of(tangent)
                way = heading + np.pi * rng.integers(2)
                yield from crowd.stand(spot, way, "walking", _walking_speed(rng), road=-1)
            elif lane.kind == "sidewalk":
                spot = point[:2] + (lane.width / 2 - 0.45) * _left_of(tangent)
                yield from crowd.stand(spot, heading + float(rng.normal(0, 0.25)), "waiting")


def _mouths(lane: Lane, junctions: list[Array]) -> Iterator[float]:
    """Stations of the crossings at those ends of a lane that lie at a junction."""
    length = stations(lane.centre)[-1]
    ends = ((0, CROSSING_SETBACK_M), (-1, length - CROSSING_SETBACK_M))
    for end, s in ends:
        distances = [np.linalg.norm(lane.centre[end, :2] - j[:2]) for j in junctions]
        if min(distances, default=np.inf) < 30.0:
            yield float(s)


def _zebras(lane: Lane, things: Sequence[alignment.Placed]) -> Iterator[float]:
    """Stations of a given map's crosswalks that a lane passes, on them or at their ends."""
    for thing in things:
        if thing.type == "crosswalk" and len(thing.outline) > 2:
            middle = thing.outline.mean(axis=0)
            reach = np.linalg.norm(thing.outline - middle, axis=1).max() + lane.width / 2
            away = np.linalg.norm(lane.centre[:, :2] - middle, axis=1)
            if away.min() < reach:
                yield float(stations(lane.centre)[away.argmin()])


# --- bicycles ------------------------------------------------------------------------------------


def cyclists(layout: Layout) -> Placed:
    """Riders at the right edge of the outermost driving lanes."""
    rng = layout.spec.stream("cyclists")
    per_metre = layout.spec.cyclists_per_km * outdoors(layout.spec.sky.rain_mm_h) / 1000
    stock: _Stock = {}
    for lane in _right_lanes(layout):
        line = offset_line(lane.centre, 0.75 - lane.width / 2)
        for s in _stations(line, per_metre, rng):
            point, tangent = at_station(line, s)
            heading = float(tangent) + float(rng.normal(0, 0.03))
            ahead = np.array([np.cos(heading), np.sin(heading)])
            if layout.in_view(point) and layout.site.claim(_along(point, ahead)):
                model = _again(stock, bicycle.cyclist, layout.lod(point, 25.0, 70.0), rng)
                speed = float(np.clip(rng.normal(*RIDE_M_S), 2.5, 8.0))
                normal = road_normal(line, float(s), ahead)
                yield layout.mover(model, point, heading, speed, normal=normal)


_Stock = dict[Lod, list[Model]]


class _Builder(Protocol):
    def __call__(self, *, rng: Rng, lod: int) -> Model: ...


def _again(stock: _Stock, build: _Builder, lod: Lod, rng: Rng) -> Model:
    """A model: a new one nearby, one of four far away."""
    models = stock.setdefault(lod, [])
    if lod == 0 or len(models) < 4:
        models.append(build(rng=rng, lod=lod))
        return models[-1]
    return models[rng.integers(len(models))]


def _right_lanes(layout: Layout) -> Iterator[Lane]:
    """The outermost driving lane of each side of each road outside junctions."""
    outermost: dict[tuple[str, str], Lane] = {}
    for lane in layout.site.network.driving:
        key = (lane.road, lane.side)
        if key not in outermost or lane.rank > outermost[key].rank:
            outermost[key] = lane
    yield from outermost.values()


def _along(point: Array, ahead: Array) -> list[tuple[float, float, float]]:
    """Discs (x, y, radius) that a bicycle covers."""
    reach = bicycle.LENGTH_M / 2 - 0.3
    spots = [point[:2] + d * ahead for d in (-reach, 0.0, reach)]
    return [(float(x), float(y), 0.36) for x, y in spots]


def bicycles(layout: Layout) -> Placed:
    """Bicycles left at the back of a town's pavements."""
    rng = layout.spec.stream("bicycles")
    if layout.spec.cyclists_per_km <= 0 or layout.spec.road.kind != "town":
        return
    stock: _Stock = {}
    for lane, line in edges(layout):
        if lane.kind == "sidewalk":
            for s in _stations(line, BICYCLES_PER_100M / 100, rng):
                yield from _parked(layout, stock, line, s, rng)


def _parked(layout: Layout, stock: _Stock, line: Array, s: float, rng: Rng) -> Iterator[Mover]:
    point, tangent = at_station(line, s)
    xy = point[:2] + 0.45 * _left_of(tangent)
    heading = float(tangent) + np.pi * int(rng.integers(2)) + float(rng.normal(0, 0.06))
    ahead = np.array([np.cos(heading), np.sin(heading)])
    clear = layout.site.clear_of(xy, road=-1, pavement=-1, buildings=bicycle.HALF_WIDTH_M)[0]
    if clear and layout.in_view(xy) and layout.site.claim(_along(xy, ahead)):
        model = _again(stock, bicycle.bicycle, layout.lod(xy, 25.0, 70.0), rng)
        yield layout.mover(model, xy, heading, 0.0)
