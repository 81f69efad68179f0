"""Road paint: outlines on the ground plane, to be drawn into the ortho maps.

Dimensions follow common European practice (RMS, RMUZ): lines 0.12 to 0.30 m wide, dashes of 3 m in
town and 6 m outside, stop lines 0.5 m, zebra bars 0.5 m with gaps of 0.5 m.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from simgen.geometry import Array
from simgen.recipe import RoadSpec
from simgen.roads import (
    MEDIAN_M,
    Given,
    Lane,
    Network,
    at_station,
    offset_line,
    points_at,
    stations,
    strip,
)

WHITE = (0.62, 0.62, 0.59)
YELLOW = (0.55, 0.36, 0.06)


@dataclass(frozen=True, eq=False)
class Paint:
    """One painted patch."""

    outline: Array
    """(N, 2) world xy [m]"""
    color: tuple[float, float, float] = WHITE


def paint(network: Network, road: RoadSpec, *, rng: np.random.Generator) -> list[Paint]:
    """All paint of a network."""
    if network.given is not None:
        return list(_given(network.given))
    lanes = [lane for lane in network.lanes if not lane.in_junction]
    patches: list[Paint] = []
    for name in sorted({lane.road for lane in lanes}):
        mine = [lane for lane in lanes if lane.road == name]
        ends = [j for j in network.junctions if _near_end(mine, j)]
        patches += _lines(mine, road, ends)
        patches += _bays(mine, road, ends)
        if road.kind == "town":
            patches += [p for j in ends for p in _crossing(mine, j, rng=rng)]
        patches += [p for j in ends for p in _stop_lines(mine, j, road)]
    return patches


def piece(line: Array, start_m: float, end_m: float) -> Array:
    """The part of a polyline between two stations, about every metre."""
    num = max(2, int((end_m - start_m) / 1.0) + 1)
    return points_at(line, np.linspace(start_m, end_m, num))


# --- what a given map states ---------------------------------------------------------------------


def _given(given: Given) -> Iterator[Paint]:
    """Lines, zebras, and patches of paint such as stop lines."""
    for line in given.lines:
        color = YELLOW if line.yellow else WHITE
        for stroke in _strokes(line.points, line.dash):
            yield Paint(_band(stroke, line.width).outline, color)
    for thing in given.things:
        if thing.type == "crosswalk" and len(thing.outline) > 2:
            yield from _zebra(thing.outline)
        elif thing.type == "roadMark" and len(thing.outline) > 2:
            yield Paint(thing.outline)


def _strokes(line: Array, dash: tuple[float, float] | None) -> Iterator[Array]:
    step, on = (25.0, 25.0) if dash is None else (sum(dash), dash[0])
    end = stations(line)[-1]
    for s in np.arange(0.0, end - 0.2, max(step, 0.1)):
        yield piece(line, s, min(s + on, end))


def _zebra(outline: Array) -> Iterator[Paint]:
    """Bars half a metre wide across the shorter side of a crossing's rectangle."""
    box = np.array(shapely.oriented_envelope(shapely.Polygon(outline)).exterior.coords)[:4]
    if np.linalg.norm(box[1] - box[0]) < np.linalg.norm(box[2] - box[1]):
        box = np.roll(box, 1, axis=0)
    walk, bar = box[1] - box[0], box[2] - box[1]
    length = float(np.linalg.norm(walk))
    for k in range(max(1, round(length))):
        first, last = (box[0] + walk * (k + f) / max(1, round(length)) for f in (0.25, 0.75))
        yield Paint(np.array([first, last, last + bar, first + bar]))


# --- lines along the road ------------------------------------------------------------------------


def _open_span(lane: Lane, road: RoadSpec, junctions: Sequence[Array]) -> tuple[float, float]:
    """Where its lines begin and end [m]: short of the stop lines and zebras at junctions."""
    short = _setback(road) + 0.2
    near = [min((float(np.linalg.norm(end[:2] - j[:2])) for j in junctions), default=np.inf)
            < _NEAR_JUNCTION_M for end in lane.centre[[0, -1]]]  # fmt: skip
    return short * near[0], float(stations(lane.centre)[-1]) - short * near[1]


def _setback(road: RoadSpec) -> float:
    """From the end of a lane back to its stop line [m]."""
    return 4.8 if road.kind == "town" else 1.0


def _lines(lanes: list[Lane], road: RoadSpec, junctions: Sequence[Array]) -> Iterator[Paint]:
    outer = {side: max((x.rank for x in lanes if x.kind == "driving" and x.side == side), default=0)
             for side in ("left", "right")}  # fmt: skip
    for lane in lanes:
        if lane.kind != "driving":
            continue
        half, span = lane.width / 2, _open_span(lane, road, junctions)
        innermost = lane.rank == (1 if road.kind == "motorway" else 0)
        if innermost and road.kind == "motorway":
            yield from _line(lane, half - 0.15, 0.2, None, *span)
        elif innermost and lane.side == "right":
            yield from _centre_line(lane, half, road, *span)
        elif not innermost:
            yield from _line(lane, half, 0.13, _dash(road), *span)
        if lane.rank == outer[lane.side] and not _has_parking(lanes, lane.side):
            if road.kind != "town":
                yield from _line(lane, -half + 0.15, 0.15 if road.kind == "rural" else 0.3, None)
            elif road.pavement_m <= 0.5:
                yield from _line(lane, -half + 0.1, 0.12, None)


def _centre_line(
    lane: Lane, offset: float, road: RoadSpec, start_m: float, end_m: float
) -> Iterator[Paint]:
    solid_m = 22.0 if road.junction != "none" and road.kind == "town" else 0.0
    if road.lanes > 1 and road.kind == "town":
        yield from _line(lane, offset - 0.12, 0.11, None, start_m, end_m)
        yield from _line(lane, offset + 0.12, 0.11, None, start_m, end_m)
        return
    solid_from = max(end_m - solid_m, start_m)
    yield from _line(lane, offset, 0.12, _dash(road), start_m, solid_from)
    if solid_m:
        yield from _line(lane, offset, 0.12, None, solid_from, end_m)


def _dash(road: RoadSpec) -> tuple[float, float]:
    return {"town": (3.0, 6.0), "rural": (4.0, 8.0), "motorway": (6.0, 12.0)}[road.kind]


def _line(
    lane: Lane,
    offset: float,
    width: float,
    dash: tuple[float, float] | None,
    start_m: float = 0.0,
    end_m: float | None = None,
) -> Iterator[Paint]:
    """A line at ``offset`` to the left of the lane's centre; ``dash`` is (paint, gap) or solid."""
    line = offset_line(lane.centre, offset)
    scale = stations(line)[-1] / stations(lane.centre)[-1]
    end = stations(line)[-1] if end_m is None else end_m * scale
    step, on = (25.0, 25.0) if dash is None else (sum(dash), dash[0])
    for s in np.arange(start_m * scale, end - 0.2, step):
        yield _band(piece(line, s, min(s + on, end)), width)


def _band(line: Array, width: float) -> Paint:
    return Paint(strip(line, width / 2, -width / 2)[:, :2])


def _has_parking(lanes: Iterable[Lane], side: str) -> bool:
    return any(x.kind == "parking" and x.side == side for x in lanes)


def _bays(lanes: list[Lane], road: RoadSpec, junctions: Sequence[Array]) -> Iterator[Paint]:
    """The inner edge of a parking lane, and a tick between bays."""
    for lane in lanes:
        if lane.kind != "parking":
            continue
        start, end = _open_span(lane, road, junctions)
        yield from _line(lane, lane.width / 2, 0.1, (1.0, 1.0), start, end)
        for s in np.arange(max(start, 3.0), min(end, stations(lane.centre)[-1] - 3.0), BAY_M):
            point, heading = at_station(lane.centre, float(s))
            yield _bar(point, float(heading) + np.pi / 2, lane.width * 0.9, 0.1)


BAY_M = 5.8


def _bar(point: Array, direction: float, length: float, width: float) -> Paint:
    """A rectangle centred on a point, its length along ``direction`` [rad]."""
    along = np.array([np.cos(direction), np.sin(direction)]) * length / 2
    across = np.array([-np.sin(direction), np.cos(direction)]) * width / 2
    corners = [along + across, -along + across, -along - across, along - across]
    return Paint(point[:2] + np.array(corners))


# --- junctions -----------------------------------------------------------------------------------

_NEAR_JUNCTION_M = 30.0


def _near_end(lanes: list[Lane], junction: Array) -> bool:
    ends = np.concatenate([lane.centre[[0, -1], :2] for lane in lanes if lane.kind == "driving"])
    return bool(np.linalg.norm(ends - junction[:2], axis=1).min() < _NEAR_JUNCTION_M)


def _towards(lane: Lane, junction: Array) -> Array:
    """The lane's centre line, turned so that it ends at the junction."""
    first, last = np.linalg.norm(lane.centre[[0, -1], :2] - junction[:2], axis=1)
    return lane.centre if last < first else lane.centre[::-1]


def _arrives(lane: Lane, junction: Array) -> bool:
    return _towards(lane, junction) is lane.centre


def _crossing(lanes: list[Lane], junction: Array, *, rng: np.random.Generator) -> Iterator[Paint]:
    """A zebra across the mouth of a road: bars along the direction of travel."""
    if rng.random() < 0.3:
        return
    for lane in lanes:
        if lane.kind not in ("driving", "parking", "shoulder"):
            continue
        line = _towards(lane, junction)
        point, heading = at_station(line, stations(line)[-1] - CROSSING_SETBACK_M)
        side = np.array([-np.sin(heading), np.cos(heading)])
        num = max(1, round(lane.width / 1.0))
        for k in range(num):
            shift = (k + 0.5) / num * lane.width - lane.width / 2
            place = np.append(point[:2] + shift * side, point[2])
            yield _bar(place, float(heading), 3.0, 0.5)


CROSSING_SETBACK_M = 2.2


def _stop_lines(lanes: list[Lane], junction: Array, road: RoadSpec) -> Iterator[Paint]:
    setback = _setback(road)
    gives_way = lanes[0].road.startswith("road/side")
    for lane in lanes:
        if lane.kind != "driving" or not _arrives(lane, junction):
            continue
        length = stations(lane.centre)[-1]
        point, heading = at_station(lane.centre, length - setback)
        if road.kind == "town" or gives_way:
            yield _bar(point, float(heading) + np.pi / 2, lane.width - 0.3, 0.4)
        if road.lanes > 1:
            yield from _arrow(*at_station(lane.centre, length - setback - 9.0))


def _arrow(point: Array, heading: Array) -> Iterator[Paint]:
    """A straight-on arrow, 5 m long."""
    outline = np.array([(-2.5, -0.08), (0.6, -0.08), (0.6, -0.32), (2.5, 0.0), (0.6, 0.32),
                        (0.6, 0.08), (-2.5, 0.08)])  # fmt: skip
    c, s = np.cos(heading), np.sin(heading)
    yield Paint(outline @ np.array([[c, s], [-s, c]]) + point[:2])


def median_outlines(network: Network) -> list[Array]:
    """The bands (N, 2) between the carriageways of a motorway."""
    return [
        strip(lane.centre, MEDIAN_M / 4, -MEDIAN_M / 4)[:, :2]
        for lane in network.lanes
        if lane.kind == "median"
    ]
