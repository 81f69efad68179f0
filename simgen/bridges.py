"""Bridges over the rig's road: of roads on earth banks, of railways on walls, of people on stairs.

Everything is built in the frame of a :class:`crossings.Crossing`: x along the road below, y to
the left along the deck, z up from the road. ``ground`` takes (N, 2) of that frame to heights (N,).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen import vegetation
from simgen.crossings import REACH_M, Crossing
from simgen.geometry import Array
from simgen.layout import Layout, Placed
from simgen.mesh import Model, Part, loft, merged, part, placed, quads_to_triangles, smooth
from simgen.places import Place, Places
from simgen.schema import LABELS
from simgen.solids import WORLD, Frame, rectangles, sheeted, upright
from simgen.street_solids import (
    CONCRETE,
    STEEL,
    UP,
    assembled,
    bars,
    block,
    moved,
    rod,
    turned,
)

Ground = Callable[[Array], Array]
BRIDGE, TERRAIN = LABELS["bridge"], LABELS["terrain"]
PAINTS = ((0.05, 0.10, 0.08), (0.16, 0.17, 0.17), (0.20, 0.09, 0.06), (0.05, 0.08, 0.14),
          (0.34, 0.35, 0.34))  # fmt: skip
SLOPE = 1.7
"""run over rise of an earth bank"""
SLAB_M = 0.28
DEEP_M = 2.5
"""how far supports go into the ground: the land may fall away below them"""


def over_the_road(layout: Layout) -> Placed:
    """The bridge of the scene, and the banks that lead up to it."""
    crossing = layout.crossing
    if crossing is None:
        return
    rng = layout.spec.stream("bridge")
    for disc in crossing.discs():
        layout.site.claim([disc])

    def ground(xy: Array) -> Array:
        return layout.site.height(crossing.world(xy)) - crossing.origin[2]

    if crossing.kind == "rail":
        models = _rail_bridge(_Brickwork(crossing, layout.places), rng)
    else:
        models = (_road_bridge if crossing.kind == "road" else _footbridge)(crossing, ground, rng)
    for model in models:
        yield placed(model, xyz=crossing.origin, heading_rad=crossing.heading)


# --- what they have in common --------------------------------------------------------------------


def _stained(size: ArrayLike, center: ArrayLike, tone: ArrayLike, rng: np.random.Generator,
             pitch_m: float = 0.5) -> Part:  # fmt: skip
    """A beam of concrete along y whose faces are weathered by rain that runs down."""
    sx, sy, sz = np.asarray(size, dtype=np.float64)
    y = np.linspace(-sy / 2, sy / 2, max(2, round(sy / pitch_m)))
    z = np.array([-0.5, -0.1, 0.3, 0.5, 0.5, 0.3, -0.1, -0.5]) * sz
    x = np.array([1, 1, 1, 1, -1, -1, -1, -1]) * sx / 2
    rings = np.stack(np.broadcast_arrays(x, y[:, None], z), axis=2)
    vertices, faces = loft(rings[::-1])
    runs = 1 - 0.5 * rng.beta(0.6, 2.2, (len(y), 1)) * np.array([1, 1, 0.7, 0.2, 0.2, 0.7, 1, 1])
    grime = runs * np.array([0.8, 0.95, 1, 1, 1, 1, 0.95, 0.8]) * rng.normal(1, 0.03, runs.shape)
    color = np.asarray(tone) * grime.reshape(-1, 1).clip(0.3, 1.1)
    return moved(part(vertices, faces, "matte", BRIDGE, color=color), center)


def _railing(start: ArrayLike, end: ArrayLike, color: ArrayLike, spacing_m: float) -> list[Part]:
    """Posts, two rails and bars 1.1 m high on a line between two points."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    t = np.linspace(0, 1, max(2, round(length / spacing_m)))[:, None]
    foot = a + t * (b - a)
    upright = part(*bars(foot, foot + 1.08 * UP, 0.011, 4), "metal", BRIDGE, color=color)
    rails = [rod([a + z * UP, b + z * UP], r, color, BRIDGE, sides=6)
             for z, r in ((1.1, 0.035), (0.12, 0.02))]  # fmt: skip
    posts = foot[:: max(1, round(2.0 / spacing_m))]
    stout = part(*bars(posts, posts + 1.1 * UP, 0.035, 4), "metal", BRIDGE, color=color)
    return [upright, stout, *rails]


def _span(crossing: Crossing, beyond_m: float) -> tuple[float, float]:
    """Middle and length along y of a deck that goes on beyond its supports."""
    low, high = -crossing.right_m - beyond_m, crossing.left_m + beyond_m
    return (low + high) / 2, high - low


def _pier(x: float, y: float, top: float, radius: float, tone: Array) -> Part:
    shape = [(radius, -DEEP_M), (radius, top)]
    return moved(turned(shape, [tone * 0.7, tone], BRIDGE, sides=16), (x, y, 0))


# --- a road on earth banks -----------------------------------------------------------------------


def _road_bridge(crossing: Crossing, ground: Ground, rng: np.random.Generator) -> list[Model]:
    """Beams on round piers; the deck ends on banks that slope down towards the road below."""
    tone = np.array(CONCRETE) * rng.uniform(0.85, 1.25)
    depth = float(rng.uniform(0.9, 1.3))
    top = crossing.soffit_m + depth + SLAB_M
    back = SLOPE * (crossing.soffit_m + 0.6)  # the bank's toe stays behind the piers
    middle, length = _span(crossing, back + 1.5)
    half = crossing.half_width_m
    parts = _beams(crossing, depth, middle, length, tone, rng)
    parts.append(block((2 * half, length, SLAB_M), (0, middle, top - SLAB_M / 2), tone * 0.75,
                       BRIDGE))  # fmt: skip
    for side in (-1, 1):
        edge = (side * (half + 0.15), middle, top - 0.12)
        parts.append(_stained((0.36, length, 0.66), edge, tone * 1.1, rng))
        ends = [(side * (half + 0.1), middle + s * length / 2, top + 0.21) for s in (-1, 1)]
        parts += _railing(ends[0], ends[1], np.array(STEEL) * rng.uniform(0.5, 1.0), 0.14)
    parts += _piers(crossing, tone, rng)
    for side, y in ((-1, -crossing.right_m), (1, crossing.left_m)):
        seat = (0, y + side * (back + 0.7), crossing.soffit_m - 0.4)
        parts.append(block((2 * half + 0.6, 1.4, 2.6), seat, tone * 0.85, BRIDGE))
    banks = [
        _bank(side, y + back * side, top - 0.1, half + 1.4, ground, rng)
        for side, y in ((-1, -crossing.right_m), (1, crossing.left_m))
    ]
    return [assembled(parts), [b for pair in banks for b in pair]]


def _beams(crossing: Crossing, depth: float, middle: float, length: float, tone: Array,
           rng: np.random.Generator) -> list[Part]:  # fmt: skip
    """Webs with flanges below the slab, of concrete or painted steel."""
    half = crossing.half_width_m
    steel = rng.random() < 0.4
    color = np.array(PAINTS[rng.integers(len(PAINTS))]) if steel else tone * 0.9
    web, flange = (0.05, 0.5) if steel else (0.4, 0.8)
    parts = []
    for x in np.linspace(-half + 0.5, half - 0.5, max(3, round(half * 0.9))):
        z = crossing.soffit_m
        parts.append(block((flange, length, 0.12 if steel else 0.25), (x, middle, z + 0.06),
                           color, BRIDGE))  # fmt: skip
        parts.append(block((web, length, depth), (x, middle, z + depth / 2), color, BRIDGE))
    return parts


def _piers(crossing: Crossing, tone: Array, rng: np.random.Generator) -> list[Part]:
    """Rows of round columns under a cap, beside the road and in a median, there on a plinth."""
    half, radius = crossing.half_width_m, float(rng.uniform(0.35, 0.5))
    rows = [-crossing.right_m, crossing.left_m]
    if crossing.median_m is not None:
        rows.append(crossing.median_m)
    columns = np.linspace(-half + 1.0, half - 1.0, 3 if half > 5 else 2)
    parts = []
    for y in rows:
        cap = (0, y, crossing.soffit_m - 0.35)
        parts.append(block((2 * half - 0.4, 2.2 * radius, 0.7), cap, tone, BRIDGE))
        parts += [_pier(x, y, crossing.soffit_m - 0.6, radius, tone) for x in columns]
    if crossing.median_m is not None:
        parts.append(block((2 * half + 1.0, 2.4 * radius, 1.9), (0, crossing.median_m, 0.1),
                           tone * 0.8, BRIDGE))  # fmt: skip
    return parts


def _bank(side: int, start: float, top: float, half: float, ground: Ground,
          rng: np.random.Generator) -> Model:  # fmt: skip
    """An earth bank from y = start outwards: a crown that sinks, and slopes all around it."""
    reach = REACH_M + 20.0
    foot = SLOPE * (top + 3.0)
    x = np.linspace(-half - foot, half + foot, 44)
    y = start + side * np.arange(-foot, reach, 1.4)
    grid = np.stack(np.meshgrid(x, y), axis=2)
    out = side * (grid[..., 1] - start)
    crown = top - top * np.clip(out / reach, 0, 1) ** 1.5
    past = np.hypot(np.maximum(np.abs(grid[..., 0]) - half, 0), np.maximum(-out, 0))
    rough = 0.05 * rng.standard_normal(out.shape) * (past > 0.5)
    z = crown - past / SLOPE + rough
    land = ground(grid.reshape(-1, 2)).reshape(z.shape)
    kept = z > np.nan_to_num(land, nan=np.inf) - 0.7
    vertices = np.concatenate([grid, z[..., None]], axis=2)
    sheet = _turf(vertices, kept, flipped=side < 0)
    on_slope = np.flatnonzero((z > land + 0.2) & (past > 0.3))
    chosen = rng.choice(on_slope, min(len(on_slope), 1500), replace=False)
    spots = vertices.reshape(-1, 3)[chosen]
    tufts = vegetation.grass_tufts(spots[:, :2], spots[:, 2] - 0.05, rng=rng)
    bushes = [
        p for spot in spots[:: len(spots) // 14 + 1]
        for p in placed(vegetation.shrub(rng=rng, lod=1), xyz=spot - 0.25 * UP)
    ]  # fmt: skip
    return [sheet, tufts, *bushes]


def _turf(vertices: Array, kept: NDArray[np.bool_], *, flipped: bool) -> Part:
    """The cells of a grid of points (R, C, 3) that have a kept corner, as grass."""
    rows, columns = kept.shape
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).ravel()
    quads = np.stack([a, a + 1, a + columns + 1, a + columns], axis=1)
    quads = quads[kept.ravel()[quads].any(axis=1)]
    faces = quads_to_triangles(quads[:, ::-1] if flipped else quads)
    used, index = np.unique(faces, return_inverse=True)
    points = vertices.reshape(-1, 3)[used]
    uv = _wandering(points[:, :2]) * (-1 if flipped else 1, 1)
    return smooth(part(points, index.reshape(-1, 3), "turf", TERRAIN, uv=uv))


def _wandering(xy: Array) -> Array:
    """Points (N, 2) drawn out and pushed together by turns, by up to a quarter.

    Where a sheet comes round again, it is another likeness of itself.
    """
    return xy + 1.5 * np.sin(2 * np.pi * xy[:, ::-1] / (37.0, 43.0))


# --- a railway between walls ---------------------------------------------------------------------


def _rail_bridge(brickwork: _Brickwork, rng: np.random.Generator) -> list[Model]:
    """Plate girders on brick abutments; the track goes on between retaining walls."""
    crossing = brickwork.crossing
    color = np.array(PAINTS[rng.integers(len(PAINTS))])
    half, z = crossing.half_width_m, crossing.soffit_m
    middle, length = _span(crossing, 0.9)
    parts = [block((2 * half, length, 0.3), (0, middle, z + 0.45), color * 0.5, BRIDGE)]
    for side in (-1, 1):
        parts += _plate_girder(side * half, middle, length, z, color, side, rng)
    for y in np.arange(middle - length / 2 + 1.2, middle + length / 2, 2.4):
        parts.append(block((2 * half, 0.3, 0.25), (0, y, z + 0.2), color * 0.6, BRIDGE))
    for side, y in ((-1, -crossing.right_m), (1, crossing.left_m)):
        parts += _abutment(side, y, half + 0.5, z, brickwork, rng)
    return [[*_flat(parts), *assembled([p for p in parts if p.uv is None])]]


def _flat(parts: list[Part]) -> Model:
    """Those of a sheet, as one."""
    return [merged([p for p in parts if p.uv is not None])]


def _plate_girder(x: float, middle: float, length: float, z: float, color: Array, side: int,
                  rng: np.random.Generator) -> list[Part]:  # fmt: skip
    """A riveted girder along y, its stiffeners outside, and a handrail on top."""
    depth = 1.7
    web = _stained((0.05, length, depth), (x, middle, z + depth / 2), color, rng, 0.3)
    flanges = [block((0.45, length, 0.06), (x, middle, z + dz), color * 0.9, BRIDGE)
               for dz in (0.03, depth - 0.03)]  # fmt: skip
    ribs = [
        block((0.2, 0.05, depth - 0.12), (x + 0.1 * side, y, z + depth / 2), color * 0.95, BRIDGE)
        for y in np.arange(middle - length / 2 + 0.2, middle + length / 2, 1.5)
    ]
    low, high = ((x, middle + s * length / 2, z + depth) for s in (-1, 1))
    return [web, *flanges, *ribs, *_railing(low, high, np.array(STEEL) * 0.6, 1.0)]


def _abutment(
    side: int,
    y: float,
    half: float,
    soffit: float,
    brickwork: _Brickwork,
    rng: np.random.Generator,
) -> list[Part]:
    """The wall below the end of the deck and the retaining walls behind it, with copings."""
    top, far = soffit + 0.9, y + side * REACH_M
    stone = np.array(CONCRETE) * rng.uniform(0.8, 1.2)
    low, high = min(y, far), max(y, far)
    behind = sorted((y + side, far))
    parts = [
        *brickwork.box((-half, low, -DEEP_M), (half, high, soffit - 0.5)),
        *brickwork.box((-half, behind[0], soffit - 0.5), (half, behind[1], top)),
        block((2 * half + 0.1, 1.1, 0.5), (0, y + 0.5 * side, soffit - 0.25), stone, BRIDGE),
    ]
    middle, length = sum(behind) / 2, behind[1] - behind[0]
    for x in (-half, half):
        parts.append(_stained((0.5, length, 0.3), (x, middle, top + 0.1), stone, rng, 1.2))
        ends = [(x, end, top + 0.25) for end in behind]
        parts += _railing(ends[0], ends[1], np.array(STEEL) * 0.6, 1.5)
        for at in np.arange(behind[0] + 0.6, behind[1], 7.0):
            pilaster = (x - 0.2, at - 0.5, -DEEP_M), (x + 0.2, at + 0.5, top - 0.06)
            parts += brickwork.box(*pilaster)
    return parts


SECTION_M = 7.0
"""between the pilasters of a retaining wall"""


@dataclass(frozen=True, eq=False)
class _Brickwork:
    """Walls of the scene's brick at a crossing, each section at its own place of the sheet."""

    crossing: Crossing
    places: Places

    def box(self, low: ArrayLike, high: ArrayLike) -> list[Part]:
        """The four sides and the top of a box between two corners, in the crossing's frame."""
        a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        top = rectangles([a[0], a[1], b[0], b[1]], b[2])
        sides = [self._side(a, b, np.array(out)) for out in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        return [replace(p, semantic=BRIDGE) for p in
                (*sides, sheeted(WORLD, top, "wall_0", top[..., :2]))]  # fmt: skip

    def _side(self, a: Array, b: Array, out: Array) -> Part:
        """The side that faces ``out`` (2,), in sections as long as from pilaster to pilaster."""
        right = np.array([-out[1], out[0]])
        half = np.abs(b - a)[:2] / 2
        length = 2 * float(np.abs(right) @ half)
        corner = (a + b)[:2] / 2 + out * half - right * length / 2
        x = np.linspace(0, length, max(round(length / SECTION_M), 1) + 1)
        rects = np.column_stack([x[:-1], 0 * x[1:] + a[2], x[1:], 0 * x[1:] + b[2]])
        frame = upright([*corner, 0.0], out)
        quads = rectangles(rects, 0.0)
        uv = [self._place(frame, r).uv(q[:, :2]) for r, q in zip(rects, quads, strict=True)]
        return sheeted(frame, quads, "wall_0", np.array(uv))

    def _place(self, frame: Frame, rect: Array) -> Place:
        at = self.crossing.world(frame.origin[None, :2])[0]
        out = self.crossing.world(frame.axes[None, 2, :2])[0] - self.crossing.origin[:2]
        seen = upright([*at, self.crossing.origin[2]], out)
        return self.places.take("wall_0", seen, rect, phase=0)


# --- people on stairs ----------------------------------------------------------------------------

RISER_M, TREAD_M = 0.17, 0.29


def _footbridge(crossing: Crossing, ground: Ground, rng: np.random.Generator) -> list[Model]:
    """A steel truss on two columns, and a flight of stairs along the road at either end."""
    color = np.array(PAINTS[rng.integers(len(PAINTS))]) * rng.uniform(0.9, 1.4)
    half, z = crossing.half_width_m, crossing.soffit_m
    middle, length = _span(crossing, 1.8)
    top = z + 0.3
    deck = _stained((2 * half, length, 0.3), (0, middle, z + 0.15), np.array(CONCRETE), rng)
    parts = [deck, *_trusses(half, middle, length, top, color)]
    for side, y in ((-1, -crossing.right_m), (1, crossing.left_m)):
        parts.append(_pier(0.0, y, z, 0.3, np.array(CONCRETE)))
        parts += _stairs(side, y + 0.9 * side, half, top, ground, color)
    return [assembled(parts)]


def _trusses(half: float, middle: float, length: float, z: float, color: Array) -> list[Part]:
    """Chords and zigzag bars 1.3 m high on both edges, with the bars of a railing inside."""
    y = np.linspace(middle - length / 2, middle + length / 2, 2 * round(length / 2.4) + 1)
    up = np.where(np.arange(len(y)) % 2, 1.3, 0.06)
    parts = []
    for x in (-half, half):
        zigzag = np.stack([0 * y + x, y, z + up], axis=1)
        parts.append(part(*bars(zigzag[:-1], zigzag[1:], 0.06, 6), "paint", BRIDGE, color=color))
        for level in (0.06, 1.3):
            chord = (x, middle, z + level)
            parts.append(block((0.16, length, 0.16), chord, color, BRIDGE, "paint"))
        inside = x * (1 - 0.12 / half)
        parts += _railing((inside, y[0], z), (inside, y[-1], z), color * 0.8, 0.13)
    return parts


def _stairs(side: int, y: float, half: float, top: float, ground: Ground,
            color: Array) -> list[Part]:  # fmt: skip
    """A flight from the end of the deck down to the ground, towards ±x."""
    run = TREAD_M / RISER_M
    foot = float(np.nan_to_num(ground(np.array([[side * (half + run * top), y]])))[0])
    num = int(np.ceil((top - foot) / RISER_M))
    steps = np.arange(num)
    x, z = side * (half + TREAD_M * (steps + 0.5)), top - RISER_M * (steps + 1)
    parts = [block((TREAD_M + 0.03, 1.5, 0.06), (a, y, b), CONCRETE, BRIDGE)
             for a, b in zip(x, z, strict=True)]  # fmt: skip
    ends = np.array([[side * half, top], [x[-1] + 0.2 * side, z[-1] - 0.1]])
    for edge in (-0.78, 0.78):
        a, b = ((e[0], y + edge, e[1]) for e in ends)
        parts.append(_stringer(a, b, color))
        parts += _railing(a, b, color * 0.8, 0.2)
    return parts


def _stringer(a: ArrayLike, b: ArrayLike, color: Array) -> Part:
    """The board on edge that carries the steps, between two points."""
    across, down = np.array([0.0, 0.03, 0.0]), 0.32 * UP
    rings = [np.stack([p - across, p + across, p + across - down, p - across - down])
             for p in (np.asarray(a), np.asarray(b))]  # fmt: skip
    return part(*loft(rings), "paint", BRIDGE, color=color)
