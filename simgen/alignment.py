"""Lays out the roads of an OpenDRIVE map: reference lines, lanes, painted lines, things.

Notation as in ``opendrive.py``: station s, t to the left [m].
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgen.errors import UserError
from simgen.geometry import Array
from simgen.opendrive import GAP_M, MAX_LANE_M, Geometry, Mark, Road, Section

STEP_M = 1.0
"""between the points of a lane's line"""
NARROW_M = 1.8
"""A lane that is narrower in the mean is too narrow for a car: it counts as a shoulder."""

# --- reference lines -----------------------------------------------------------------------------

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


def reference(road: Road, s: Array) -> tuple[Array, Array]:
    """Points (N, 3) and headings (N,) of a road's reference line at rising stations (N,)."""
    starts = np.array([g.s for g in road.planview])
    piece = np.clip(np.searchsorted(starts, s + 1e-9, side="right") - 1, 0, None)
    xy, heading = np.empty((len(s), 2)), np.empty(len(s))
    for k, geometry in enumerate(road.planview):
        mine = piece == k
        xy[mine], heading[mine] = _along(geometry, s[mine] - geometry.s)
    return np.column_stack([xy, road.elevation(s)]), heading


def require_whole(road: Road) -> None:
    """UserError if a piece of the reference line begins elsewhere than the last one ends."""
    for k, (before, after) in enumerate(itertools.pairwise(road.planview), start=1):
        num = 2 + int(before.length / STEP_M)
        end = _along(before, np.linspace(0.0, before.length, num))[0][-1]
        gap = float(np.hypot(*(end - [after.x, after.y])))
        if not gap <= GAP_M:
            raise UserError(
                f"road {road.id}: piece {k} of its <planView> begins {gap:g} m from where the "
                f"piece before it ends; expected at most {GAP_M:g} m."
            )


def _along(g: Geometry, s: Array) -> tuple[Array, Array]:
    """Points (N, 2) and headings (N,) of one piece at rising distances from its start."""
    local, turn = _polynomial(g, s) if "oly3" in g.shape else _clothoid(g, s)
    c, sn = np.cos(g.heading), np.sin(g.heading)
    return [g.x, g.y] + local @ np.array([[c, sn], [-sn, c]]), g.heading + turn


def _clothoid(g: Geometry, s: Array) -> tuple[Array, Array]:
    """Line, arc and spiral: the curvature is linear, so the heading is a parabola.

    Its sine and cosine are integrated from point to point by five Gauss nodes.
    """
    k0, k1 = g.numbers or (0.0, 0.0)
    rate = (k1 - k0) / g.length if g.length else 0.0

    def turn(u: Array) -> Array:
        return u * (k0 + 0.5 * rate * u)

    before = np.concatenate([[0.0], s[:-1]])
    half = 0.5 * (s - before)
    theta = turn(before[:, None] + half[:, None] * (1 + _NODES))
    steps = half[:, None] * np.stack([np.cos(theta) @ _WEIGHTS, np.sin(theta) @ _WEIGHTS], axis=1)
    return np.cumsum(steps, axis=0), turn(s)


def _polynomial(g: Geometry, s: Array) -> tuple[Array, Array]:
    """poly3 and paramPoly3; the former's u is found from the arc length on a fine table."""
    u, v = (np.polynomial.Polynomial(g.numbers[k : k + 4]) for k in (0, 4))
    p = s / g.length if g.normalized and g.length else s
    if g.shape == "poly3":
        table = np.linspace(0.0, g.length, 2 + int(g.length / 0.02))
        middle = 0.5 * (table[1:] + table[:-1])
        arc = np.cumsum(np.hypot(1.0, v.deriv()(middle))) * table[1]
        p = np.interp(s, np.concatenate([[0.0], arc]), table)
    return np.stack([u(p), v(p)], axis=1), np.arctan2(v.deriv()(p), u.deriv()(p))


# --- layout --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Strip:
    """A lane of one section, laid out; points run along its direction of travel."""

    road: str
    section: int
    number: int
    kind: str
    centre: Array
    """(N, 3)"""
    widths: Array
    """(N,)"""
    junction: str


@dataclass(frozen=True, eq=False)
class Line:
    """A painted line."""

    points: Array
    """(N, 3)"""
    width: float
    dash: tuple[float, float] | None
    yellow: bool


@dataclass(frozen=True, eq=False)
class Placed:
    """An object or a signal in the plane."""

    tag: str
    type: str
    value: str
    xyz: Array
    heading: float
    outline: Array
    """(N, 2) world xy"""


def moved(road: Road, origin: Array) -> Road:
    """The road in a frame that has its origin at ``origin`` (x, y, …)."""
    planview = [replace(g, x=g.x - origin[0], y=g.y - origin[1]) for g in road.planview]
    return replace(road, planview=tuple(planview))


def strips(road: Road) -> Iterator[Strip]:
    """The paved lanes of a road."""
    for number, section in enumerate(road.sections):
        base, heading, borders, _ = _laid_out(road, section)
        for lane in section.lanes:
            widths = np.abs(borders[lane.number] - borders[_inner(lane.number)])
            if lane.kind is None or widths.max() < 0.05:
                continue
            middle = 0.5 * (borders[lane.number] + borders[_inner(lane.number)])
            step = -1 if lane.number > 0 else 1
            for_cars = lane.kind in ("driving", "parking")
            kind = "shoulder" if for_cars and widths.mean() < NARROW_M else lane.kind
            yield Strip(road.id, number, lane.number, kind,
                        _beside(base, heading, middle)[::step], widths[::step],
                        road.junction)  # fmt: skip


def lines(road: Road) -> Iterator[Line]:
    """The painted lines of a road."""
    for section in road.sections:
        base, heading, borders, s = _laid_out(road, section)
        for lane in section.lanes:
            ends = [*(section.start + m.s for m in lane.marks[1:]), section.end]
            for mark, end in zip(lane.marks, ends, strict=False):
                here = (s >= section.start + mark.s - 1e-6) & (s <= end + 1e-6)
                for shift, dash in _strokes(mark, outwards=-1 if lane.number <= 0 else 1):
                    points = _beside(base, heading, borders[lane.number] + shift)[here]
                    if len(points) > 1:
                        yield Line(points, mark.width, dash, mark.yellow)


def things(road: Road) -> Iterator[Placed]:
    """The objects and signals of a road."""
    for thing in road.things:
        base, heading = reference(road, np.array([min(max(thing.s, 0.0), road.length)]))
        xyz = _beside(base, heading, np.array([thing.t]))[0]
        turn = float(heading[0]) + thing.heading
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        outline = np.array(thing.outline).reshape(-1, 2) @ R.T + xyz[:2]
        yield Placed(thing.tag, thing.type, thing.value, xyz, turn, outline)


def _inner(number: int) -> int:
    """The neighbour of a lane on the side of the reference line."""
    return number - int(np.sign(number))


def _laid_out(road: Road, section: Section) -> tuple[Array, Array, dict[int, Array], Array]:
    """Reference points, headings, t of the outer border of every lane, and stations."""
    num = max(2, 1 + math.ceil((section.end - section.start) / STEP_M))
    breaks = [section.start + m.s for lane in section.lanes for m in lane.marks]
    inside = [b for b in breaks if section.start < b < section.end]
    s = np.unique(np.concatenate([np.linspace(section.start, section.end, num), inside]))
    base, heading = reference(road, s)
    borders = {0: road.lane_offset(s)}
    for lane in sorted(section.lanes, key=lambda x: abs(x.number)):
        if lane.number and _inner(lane.number) not in borders:
            raise UserError(
                f"road {road.id}: lane {lane.number} has no lane {_inner(lane.number)} beside it; "
                "expected numbers without gaps."
            )
        if lane.number:
            width = np.maximum(lane.width(s - section.start), 0.0)
            _require_narrow(road, lane.number, width)
            borders[lane.number] = borders[_inner(lane.number)] + np.sign(lane.number) * width
    return base, heading, borders, s


def _require_narrow(road: Road, number: int, width: Array) -> None:
    if width.max() > MAX_LANE_M:
        raise UserError(
            f"road {road.id}: lane {number} is {width.max():g} m wide; expected at most "
            f"{MAX_LANE_M:g} m."
        )


def _beside(base: Array, heading: Array, t: Array) -> Array:
    """Points (N, 3) at ``t`` (N,) to the left of a line."""
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=1)
    return base + t[:, None] * left


def _strokes(mark: Mark, outwards: int) -> list[tuple[float, tuple[float, float] | None]]:
    """(shift to the left, dash or None for solid) of the one or two lines of a mark."""
    kinds = [k for k in mark.kind.split() if k in ("solid", "broken")]
    gap = 2 * mark.width
    shifts = [0.0] if len(kinds) == 1 else [-0.5 * gap * outwards, 0.5 * gap * outwards]
    dashes = [mark.dash if k == "broken" else None for k in kinds]
    return list(zip(shifts, dashes, strict=False))


# --- from lane to lane ---------------------------------------------------------------------------


def followed(line: Array, others: Sequence[Array], length: float) -> Array:
    """A line (N, 3) with those of the others that begin where it ends, until it is ``length`` long.

    It takes the straightest way, each line once, and ends early where none goes on.
    """
    firsts, taken = np.array([other[0] for other in others]), set[int]()
    while np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum() < length:
        heading = _heading(line[-2:])
        touching = set(np.flatnonzero(np.linalg.norm(firsts - line[-1], axis=1) < 0.3).tolist())
        bends = {
            k: _turn(heading, others[k][-2:])
            for k in touching - taken
            if _turn(heading, others[k][:2]) < 0.2
        }
        if not bends:
            break
        best = min(bends, key=lambda k: bends[k])
        taken.add(best)
        line = np.concatenate([line, others[best][1:]])
    return line


def _heading(line: Array) -> float:
    return float(np.arctan2(line[-1, 1] - line[0, 1], line[-1, 0] - line[0, 0]))


def _turn(heading: float, line: Array) -> float:
    """The angle from a heading to that of a line, whichever way round."""
    difference = _heading(line) - heading
    return float(abs(np.arctan2(np.sin(difference), np.cos(difference))))
