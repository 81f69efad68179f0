"""Works: cones and boards along a stretch of road side with an excavator; building sites.

Machines and boards are models in their own frame: +x is where they face, z up, metres.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from simgen import barriers, furniture, pavement
from simgen.geometry import Array
from simgen.layout import Layout, Placed, along, edges, sunk
from simgen.mesh import Model, Part, loft, part
from simgen.roads import Lane, at_station, offset_line, stations
from simgen.schema import LABELS
from simgen.street_solids import (
    BLACK,
    RED,
    STATIC,
    STEEL,
    UP,
    WHITE,
    assembled,
    bars,
    block,
    moved,
    rod,
    turned,
)

DYNAMIC, TERRAIN = LABELS["dynamic"], LABELS["terrain"]
MACHINE_COLORS = ((0.62, 0.33, 0.02), (0.60, 0.14, 0.02), (0.55, 0.42, 0.03))


# --- models --------------------------------------------------------------------------------------


def barrier_board(*, rng: np.random.Generator) -> Model:
    """A board of red and white fields on two feet, with a lamp; 1.6 m along y."""
    fields = [
        block((0.03, 0.2, 0.25), (0, -0.7 + 0.2 * i, 0.85), WHITE if i % 2 else RED, DYNAMIC)
        for i in range(8)
    ]
    posts = [block((0.04, 0.04, 1.0), (-0.035, y, 0.5), STEEL, DYNAMIC) for y in (-0.6, 0.6)]
    feet = [block((0.7, 0.28, 0.1), (-0.03, y, 0.05), BLACK, DYNAMIC) for y in (-0.6, 0.6)]
    lens = [(0.02, 1.0), (0.09, 1.04), (0.09, 1.16), (0.03, 1.2)]
    lamp = turned(lens, (0.62, 0.3, 0.02), DYNAMIC, "paint", 10)
    return assembled([*fields, *posts, *feet, moved(lamp, (0, float(rng.choice([-0.5, 0.5])), 0))])


def excavator(*, rng: np.random.Generator) -> Model:
    """A digger on tracks, its arm bent over +x; its cab looks along its own heading."""
    paint = np.array(MACHINE_COLORS[rng.integers(len(MACHINE_COLORS))])
    dark = np.array(BLACK) * 2
    reach = float(rng.uniform(2.6, 3.8))
    elbow = np.array([0.45 * reach + 0.6, -0.3, float(rng.uniform(3.0, 3.8))])
    wrist = np.array([0.6 + reach, -0.3, 1.1])
    parts = [_track(y) for y in (-0.85, 0.85)]
    parts += [
        block((0.9, 1.3, 0.4), (0, 0, 0.55), dark, DYNAMIC),
        block((2.5, 2.2, 0.25), (-0.4, 0, 0.9), dark, DYNAMIC),
        block((1.5, 2.2, 0.95), (-0.85, 0, 1.5), paint, DYNAMIC, "paint"),
        block((1.25, 0.95, 0.75), (0.35, 0.6, 1.4), paint, DYNAMIC, "paint"),
        block((1.2, 0.9, 0.75), (0.32, 0.6, 2.15), (0.03, 0.04, 0.045), DYNAMIC, "glass"),
        block((1.35, 1.0, 0.08), (0.32, 0.6, 2.56), paint, DYNAMIC, "paint"),
        _arm([(0.6, -0.3, 1.3), tuple(elbow)], (0.24, 0.2), paint),
        _arm([elbow, wrist], (0.19, 0.12), paint),
        rod([(0.9, -0.3, 1.2), tuple(0.6 * elbow + (0.35, -0.12, 0.3))], 0.05, STEEL,
            DYNAMIC),
        *_bucket(wrist, dark),
    ]  # fmt: skip
    return assembled(parts)


def _track(y: float) -> Part:
    """A crawler: a flat ring seen from the side, drawn out across y."""
    a = np.linspace(0, 2 * np.pi, 17)[:-1]
    x = 0.38 * np.cos(a) + 1.0 * np.sign(np.cos(a).round(6))
    z = 0.39 + 0.39 * np.sin(a)
    rings = [np.stack([x, 0 * x + y + w, z], axis=1) for w in (0.24, -0.24)]
    return part(*loft(rings), "matte", DYNAMIC, color=np.array(BLACK) * 1.8)


def _arm(path: ArrayLike, radius: ArrayLike, color: ArrayLike) -> Part:
    return rod(path, radius, color, DYNAMIC, "paint", sides=4)


def _bucket(wrist: Array, color: Array) -> list[Part]:
    """A scoop below the end of the arm, with teeth."""
    profile = np.array([(0.15, 0.15), (-0.45, -0.1), (-0.5, -0.6), (-0.1, -0.85), (0.25, -0.75)])
    rings = [np.stack([profile[:, 0], 0 * profile[:, 0] + y, profile[:, 1]], axis=1)
             for y in (-0.4, 0.4)]  # fmt: skip
    scoop = part(*loft(rings), "matte", DYNAMIC, color=color * 1.5)
    teeth = [block((0.2, 0.06, 0.05), (0.3, y, -0.78), STEEL, DYNAMIC, "metal")
             for y in np.linspace(-0.36, 0.36, 5)]  # fmt: skip
    return [moved(p, wrist) for p in (scoop, *teeth)]


def soil_heap(*, rng: np.random.Generator) -> Model:
    """A heap of earth and stones, 2 to 3 m wide."""
    num, width = 14, float(rng.uniform(1.0, 1.5))
    a = np.arange(num) * 2 * np.pi / num
    rings = []
    for share, z in ((1.0, -0.15), (0.8, 0.3), (0.5, 0.65), (0.2, 0.9), (0.02, 0.95)):
        r = width * share * rng.uniform(0.85, 1.15, num)
        rings.append(np.stack([r * np.cos(a), r * np.sin(a), z + 0.05 * rng.normal(size=num)], 1))
    vertices, faces = loft(rings)
    brown = np.array((0.13, 0.09, 0.055)) * rng.uniform(0.6, 1.3, (len(vertices), 1))
    return [part(vertices, faces, "matte", TERRAIN, color=brown)]


def tower_crane(*, rng: np.random.Generator) -> Model:
    """A lattice mast with a jib over +x, a counter-jib and a cab."""
    color = np.array(MACHINE_COLORS[rng.integers(len(MACHINE_COLORS))]) * rng.uniform(0.8, 1.2)
    height, jib = float(rng.uniform(28, 46)), float(rng.uniform(26, 42))
    top = height + 1.0
    tip = np.array([0.0, 0.0, height + 6.5])
    parts = [
        *_lattice_beam((0, 0, -0.5), (0, 0, height + 1), 1.5, color),
        *_lattice_beam((1, 0, top), (jib, 0, top), 1.1, color),
        *_lattice_beam((-1, 0, top), (-11, 0, top), 1.1, color),
        rod([(0, 0, height), tuple(tip)], (0.5, 0.1), color, STATIC, "paint", sides=4),
        block((2.4, 1.6, 1.8), (-10, 0, top - 0.6), (0.3, 0.29, 0.28)),
        block((1.5, 1.4, 1.7), (1.2, 1.3, height - 0.6), WHITE, material="paint"),
        block((2.6, 2.6, 1.2), (0, 0, -0.2), (0.33, 0.32, 0.3)),
    ]
    stays = [rod([tuple(tip), (x, 0, top + 0.5)], 0.04, BLACK, STATIC) for x in (0.7 * jib, -9.5)]
    trolley = float(rng.uniform(0.3, 0.9)) * jib
    hook = rod([(trolley, 0, top - 0.5), (trolley, 0, 0.55 * height)], 0.04, BLACK, STATIC)
    return assembled([*parts, *stays, hook])


def _lattice_beam(start: ArrayLike, end: ArrayLike, width: float, color: Array) -> list[Part]:
    """Four chords and zigzag bars in the four sides of a square beam."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    ahead = (b - a) / np.linalg.norm(b - a)
    side = np.cross(ahead, [0.0, 1.0, 0.0] if abs(ahead[1]) < 0.9 else UP)
    corners = [width / 2 * (s * side + t * np.cross(ahead, side))
               for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]  # fmt: skip
    num = max(2, round(float(np.linalg.norm(b - a)) / width))
    axis = a + np.linspace(0, 1, num + 1)[:, None] * (b - a)
    odd = np.arange(num + 1)[:, None] % 2 == 1
    zigzags = [axis + np.where(odd, c, d)
               for c, d in zip(corners, [*corners[1:], corners[0]], strict=True)]  # fmt: skip
    chords = bars(np.array([a + c for c in corners]), np.array([b + c for c in corners]), 0.09, 4)
    braces = bars(np.concatenate([z[:-1] for z in zigzags]),
                  np.concatenate([z[1:] for z in zigzags]), 0.045, 3)  # fmt: skip
    return [part(*mesh, "paint", STATIC, color=color) for mesh in (chords, braces)]


# --- placement -----------------------------------------------------------------------------------

NEAR_M = (14.0, 80.0)
"""Works begin this far ahead of where the rig starts."""
NARROW_M = 1.2
"""Boards do not fit between the lanes and the edge of the road if that is no more than this."""
BEHIND_RAIL_M = -1.85
"""where they stand then, from that edge"""


def road_works(layout: Layout) -> Placed:
    """A stretch of road side that is coned off: boards across it, a sign, a heap, a digger."""
    rng = layout.spec.stream("road works")
    if not layout.spec.road_works:
        return
    for lane, line in edges(layout):
        s = np.arange(2.0, stations(line)[-1] - 12.0, 3.0)
        points, headings = at_station(line, s)
        x, y = (points[:, :2] - layout.rig_xy).T
        fits = (NEAR_M[0] < x) & (x < NEAR_M[1]) & (np.abs(y) < 20.0) & (np.abs(headings) < 0.4)
        if lane.side == "right" and fits.any():
            start = float(rng.choice(s[fits]))
            end = min(start + float(rng.uniform(16.0, 34.0)), stations(line)[-1] - 2.0)
            yield from _closed_off(layout, line, (start, end), _verge_width(layout, lane), rng)
            return


def _verge_width(layout: Layout, outermost: Lane) -> float:
    """From the outer edge of a road to its driving lanes [m]."""
    side = [x for x in layout.lanes if (x.road, x.side) == (outermost.road, outermost.side)]
    rank = max(x.rank for x in side if x.kind == "driving")
    return sum(x.width for x in side if x.rank > rank)


def _closed_off(layout: Layout, line: Array, span: tuple[float, float], width: float,
                rng: np.random.Generator) -> Placed:  # fmt: skip
    """Cones beside the lane and boards at both ends of the stretch ``span`` [m] of an edge."""
    cone = pavement.cone(rng=rng)
    beside_lane = offset_line(line, width - 0.25)
    for s in np.arange(span[0], span[1], 3.5):
        yield _put(layout, cone, beside_lane, float(s), 0.25)
    kerbside = offset_line(line, width - 0.95 if width > NARROW_M else BEHIND_RAIL_M)
    board = barrier_board(rng=rng)
    for s in span:
        yield _put(layout, board, kerbside, s, 0.7, np.pi)
    warning = furniture.traffic_sign(layout.sign_rects, "warning", "limit_30", rng=rng)
    yield _put(layout, warning, kerbside, max(span[0] - 6.0, 0.5), 0.4, np.pi)
    verge = offset_line(line, -2.9)
    middle = float(rng.uniform(span[0] + 3.0, span[1] - 3.0))
    turn = float(rng.uniform(0.2, 0.7))  # away from the road, ahead or back
    turn = -turn if rng.random() < 0.5 else turn - np.pi
    yield _put(layout, excavator(rng=rng), verge, middle, 2.1, turn)
    for s in (span[0] + 1.5, span[1] - 1.5):
        yield _put(layout, soil_heap(rng=rng), verge, s, 1.6)


def _put(layout: Layout, model: Model, line: Array, s: float, radius: float,
         turn: float = 0.0) -> Model:  # fmt: skip
    """The model at a station of a line, turned from the line's heading, if its place is free."""
    point, heading = at_station(line, s)
    standing = sunk(layout.stand(model, point, float(heading) + turn), 0.02)
    outline = np.concatenate([point[None, :2], *(p.vertices[:, :2] for p in standing)])
    clear = layout.site.clear_of(outline, road=-1, pavement=-1, buildings=0.2).all()
    return standing if clear and layout.site.claim([(*point[:2], radius)]) else []


SITE_M = (22.0, 14.0)
"""A building site along and away from the road."""


def building_site(layout: Layout) -> Placed:
    """A hoarding around free land beside the road, and a tower crane in it."""
    rng = layout.spec.stream("building site")
    if not layout.spec.building_site:
        return
    length, depth = SITE_M
    for lane, line in edges(layout):
        setback = -1.0 if lane.kind == "sidewalk" else -4.0
        for point, heading in along(layout, line, 12.0, rng, setback):
            ahead, right = _axes(heading)
            corners = [point + a * ahead + b * right
                       for a, b in ((length, 0), (0, 0), (0, depth), (length, depth))]  # fmt: skip
            if point[0] < layout.rig_xy[0] + 18.0 or not _free(
                layout, point + length / 2 * ahead + depth / 2 * right, heading
            ):
                continue
            ring = np.concatenate([np.linspace(a, b, 8)[:-1] for a, b in
                                   pairwise([*corners, corners[0]])] + [corners[:1]])  # fmt: skip
            for side in pairwise(range(0, 29, 7)):
                run = ring[side[0] : side[1] + 1]
                on_ground = np.column_stack([run[:, :2], layout.site.height(run[:, :2])])
                yield [barriers.hoarding(on_ground, rng=rng)]
            middle = point + 0.5 * length * ahead + 0.6 * depth * right
            yield layout.stand(tower_crane(rng=rng), middle, float(rng.uniform(0, 2 * np.pi)))
            return


def _axes(heading: float) -> tuple[Array, Array]:
    """Unit vectors ahead and to the right."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([c, s, 0.0]), np.array([s, -c, 0.0])


def _free(layout: Layout, middle: Array, heading: float) -> bool:
    """Takes the rectangle of a building site if it holds nothing yet."""
    ahead, right = _axes(heading)
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 6))
    grid = (a[..., None] * SITE_M[0] * ahead + b[..., None] * SITE_M[1] * right).reshape(-1, 3)
    xy = (middle + grid)[:, :2]
    clear = layout.site.clear_of(xy, road=0.6, pavement=0.3, buildings=1.0).all()
    if not clear or np.isnan(layout.site.height(xy)).any():
        return False
    return layout.site.claim(np.column_stack([xy, np.full(len(xy), 1.4)]))
