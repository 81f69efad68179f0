"""What stands on the walls: flat roofs behind parapets, pitched roofs and all that is on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from simgen.facades import BELOW_GROUND_M, Color, Style, Wall, wall_sheeted
from simgen.massing import Massing
from simgen.mesh import Model, Part, part, tube
from simgen.places import Places
from simgen.roofs import RoofSurface, convex_pieces
from simgen.schema import LABELS
from simgen.sheets import WALL_M
from simgen.solids import (
    WORLD,
    Frame,
    band,
    boxes,
    curtain,
    inset,
    offset_ring,
    painted,
    pipe,
    raised,
    rectangles,
    sheeted,
    slabs,
    upright,
)

Array = NDArray[np.float64]

_SLAB_M = 0.16  # thickness of a pitched roof at its edge
_BITUMEN: list[Color] = [(0.07, 0.07, 0.07), (0.14, 0.135, 0.13), (0.25, 0.24, 0.22)]
_LEAD: Color = (0.16, 0.165, 0.17)
_CLAY: Color = (0.28, 0.11, 0.06)


def flat_roof(
    massing: Massing, parapet_m: float, style: Style, *, rng: np.random.Generator, lod: int
) -> Model:
    """Roofing felt behind a parapet, with coping, a cornice and plant; from afar only felt."""
    ring, z = massing.footprint, massing.base_z + massing.wall_height
    felt = np.array(_BITUMEN[rng.integers(len(_BITUMEN))])
    top = z + parapet_m
    if lod == 2:
        return [_deck(piece, top, felt) for piece in convex_pieces(ring)]
    inner = [np.insert(offset_ring(ring, -0.25), 2, h, axis=1) for h in (top, z)]
    mouldings = [band(ring, 0.05, -0.28, top, top + 0.07)]
    if rng.random() < 0.6:
        mouldings.append(band(ring, rng.uniform(0.08, 0.25), -0.02, z - 0.15, z + 0.12))
    return [
        *(_deck(piece, z, felt) for piece in convex_pieces(ring)),
        painted(WORLD, curtain(*inner), 1.5 * felt),
        painted(WORLD, np.concatenate(mouldings), style.trim),
        *_plant(ring, z, rng),
    ]


def _deck(polygon: Array, z: float, color: Array) -> Part:
    vertices = np.insert(polygon, 2, z, axis=1)
    return part(vertices, _fan(len(polygon)), "matte", LABELS["building"], color=color)


def _fan(corners: int) -> NDArray[np.int64]:
    """Triangles (corners − 2, 3) of a convex polygon."""
    k = np.arange(1, corners - 1)
    return np.stack([np.zeros_like(k), k, k + 1], axis=1)


def _plant(ring: Array, z: float, rng: np.random.Generator) -> Model:
    """A stair head and air handlers, well inside the parapet."""
    centre = ring.mean(axis=0)
    radius = 0.5 * float(_clearance(ring, centre[None])[0])
    count = rng.integers(1, 5) if radius > 0.5 else 0
    size = rng.uniform((0.8, 0.8, 0.7), (2.4, 2.0, 1.6), (count, 3))
    size[:1] = rng.uniform((2.5, 2.5, 2.2), (4.0, 3.5, 2.8))  # the stair head
    size[:, :2] = np.minimum(size[:, :2], radius)
    at = rng.uniform(-radius, radius, (count, 2))
    lo = np.column_stack([at - size[:, :2] / 2, np.zeros(count)])
    frame = _plan_frame(ring, centre, z)
    color = rng.uniform(0.15, 0.5, (count, 1)) * np.ones(3)
    return [painted(frame, boxes(lo, lo + size, "xXyYZ"), color)]


def _plan_frame(ring: Array, centre: Array, z: float) -> Frame:
    """A frame with z up whose x runs along the first wall."""
    x = (ring[1] - ring[0]) / np.linalg.norm(ring[1] - ring[0])
    axes = np.array([[x[0], x[1], 0.0], [-x[1], x[0], 0.0], [0.0, 0.0, 1.0]])
    return Frame(np.array([*centre, z]), axes)


# ---- pitched roofs ----------------------------------------------------------------------------


def pitched_roof(
    massing: Massing,
    roof: RoofSurface,
    sides: list[Wall],
    style: Style,
    places: Places,
    *,
    rng: np.random.Generator,
    lod: int,
) -> Model:
    """Gables, the roof itself, and at close range its edges, ridges, gutters and openings."""
    eaves_z = massing.base_z + massing.wall_height
    overhang = rng.uniform(0.15, 0.25) if massing.kind == "terrace" else rng.uniform(0.25, 0.55)
    ring = offset_ring(massing.footprint, overhang)
    top_z = eaves_z + (0.5 * _SLAB_M if lod < 2 else 0.01)  # far roofs have no edge to hide a gap
    model = [_gable(wall, roof, style) for wall in sides]
    model += _covering(roof, ring, top_z, places, metal=massing.roof == "skillion")
    if lod < 2:
        model += [p for wall in sides for p in _attic_window(wall, roof, style)]
        model += _chimneys(massing, roof, style, places, rng)
        model += _edges(roof.outline(ring), eaves_z, style)
    if lod == 0:
        model += [
            _ridge(raised(line, top_z), rng.uniform(0, WALL_M, 2)) for line in roof.ridges(ring)
        ]
        model += _gutters(roof.outline(ring), massing, eaves_z, style, overhang)
        model += _roof_openings(massing, roof, top_z, rng)
    return model


def gable_profile(wall: Wall, roof: RoofSurface) -> tuple[Array, Array]:
    """Shares (M,) of a wall's length, and heights (M,) of the roof above it there."""
    start = wall.frame.origin[:2]
    return roof.profile(start, start + wall.length_m * wall.frame.axes[0, :2])


def _gable(wall: Wall, roof: RoofSurface, style: Style) -> Part:
    """The piece of wall between its level top and the roof."""
    t, h = gable_profile(wall, roof)
    x = np.union1d(t * wall.length_m, wall.panels.x[1:-1])
    h = np.interp(x, t * wall.length_m, h)
    y = wall.floors[-1] + h
    low = np.full_like(y, wall.floors[-1])
    corners = [(x[:-1], low[:-1]), (x[1:], low[1:]), (x[1:], y[1:]), (x[:-1], y[:-1])]
    quads = np.stack([np.column_stack([*xy, np.zeros(len(x) - 1)]) for xy in corners], axis=1)
    return wall_sheeted(wall, style, quads[(h[:-1] > 1e-3) | (h[1:] > 1e-3)])


def _attic_window(wall: Wall, roof: RoofSurface, style: Style) -> Model:
    """A small window where the gable is high enough for one."""
    middle = wall.frame.origin[:2] + 0.5 * wall.length_m * wall.frame.axes[0, :2]
    if roof.height(middle) < 1.5 or wall.length_m < 4:
        return []
    x, y = wall.length_m / 2, wall.floors[-1]
    rect = np.array([x - 0.35, y + 0.1, x + 0.35, y + 0.9])
    return [
        painted(wall.frame, slabs(rect, 0.0, 0.02), style.frame),
        painted(wall.frame, rectangles(inset(rect, 0.07), 0.03), (0.025, 0.03, 0.035), "glass"),
    ]


def _covering(roof: RoofSurface, ring: Array, z: float, places: Places, metal: bool) -> Model:
    """The upper side of the roof: sheet metal, or tiles in rows along the eaves."""
    model = []
    for k, polygons in enumerate(roof.faces(ring)):
        frame = roof.frame(k, z)
        meshes = [(np.column_stack([p, roof.height(p) + z]), _fan(len(p))) for p in polygons]
        if metal:
            model += [part(*m, "metal", LABELS["building"], color=_LEAD) for m in meshes]
        elif meshes:
            flat = [((vertices - frame.origin) @ frame.axes.T)[:, :2] for vertices, _ in meshes]
            corners = np.concatenate(flat)
            rect = [*corners.min(axis=0), *corners.max(axis=0)]
            place = places.take("roof", frame, rect)
            model += [part(*m, "roof", LABELS["building"], uv=place.uv(xy))
                      for m, xy in zip(meshes, flat, strict=True)]  # fmt: skip
    return model


def _edges(outline: Array, eaves_z: float, style: Style) -> Model:
    """Fascia and barge boards around the roof, and the boarding under its overhang."""
    top = raised(outline, eaves_z + 0.5 * _SLAB_M)
    bottom = raised(top, -_SLAB_M)
    inner = bottom.copy()
    inner[:, :2] = offset_ring(outline[:, :2], -0.6)
    return [
        painted(WORLD, curtain(bottom, top), style.trim),
        painted(WORLD, curtain(inner, bottom), 0.7 * np.array(style.trim)),
    ]


def _ridge(line: Array, uv_offset: Array) -> Part:
    """Ridge tiles along a line (2, 3)."""
    vertices, faces = tube(raised(line, 0.02), 0.1, sides=6, caps=False)
    along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    v = np.tile(np.arange(6) * 0.1, 2)
    uv = np.column_stack([v, (vertices - line[0]) @ along]) + uv_offset
    return part(vertices, faces, "roof", LABELS["building"], uv=uv)


def _gutters(
    outline: Array, massing: Massing, eaves_z: float, style: Style, overhang: float
) -> Model:
    """A gutter along every lowest level edge, and a downpipe at its end."""
    ends = np.roll(outline, -1, axis=0)
    lowest = outline[:, 2].min() + 1e-3
    color = style.frame
    model = []
    for a, b in zip(outline, ends, strict=True):
        if a[2] > lowest or b[2] > lowest:
            continue
        along = (b - a) / np.linalg.norm(b - a)
        out = np.array([along[1], -along[0], 0.0])
        path = raised(np.array([a, b]) + 0.07 * out, eaves_z - 0.02)
        model.append(pipe(path, 0.065, color))
        start = path[0] + (overhang + 0.25) * along
        wall = raised(start - overhang * out, -overhang - 0.2)
        foot = np.array([*wall[:2], massing.base_z - BELOW_GROUND_M])
        model.append(pipe(np.array([start, raised(start, -0.12), wall, foot]), 0.045, color))
    return model


def _chimneys(
    massing: Massing, roof: RoofSurface, style: Style, places: Places, rng: np.random.Generator
) -> Model:
    """Stacks near the ridge, with a cap and pots, on dwellings."""
    if massing.kind not in ("house", "terrace") or rng.random() < 0.25:
        return []
    ring = massing.footprint
    along = np.array([np.cos(massing.ridge_rad), np.sin(massing.ridge_rad)])
    reach = 0.3 * np.ptp(ring @ along)
    at = ring.mean(axis=0) + along * rng.uniform(-reach, reach)
    eaves_z = massing.base_z + massing.wall_height
    frame = _plan_frame(ring, at, eaves_z)
    top = massing.roof_height + rng.uniform(0.7, 1.2)
    low = float(roof.height(at)) - 1.5
    half = np.array([rng.uniform(0.3, 0.55), rng.uniform(0.22, 0.32)])
    stack = boxes([*-half, low], [*half, top], "xXyY")
    cap = boxes([*(-half - 0.05), top - 0.05], [*(half + 0.05), top + 0.07])
    uv = np.stack([stack[..., 0] + stack[..., 1], stack[..., 2]], axis=-1)
    girth = half.sum()
    side = upright(frame.origin, -frame.axes[1, :2])
    place = places.take(style.wall, side, (-girth, low, girth, top), phase=style.phase)
    pots = [
        tube(frame.world(np.array([[x, 0, top], [x, 0, top + 0.35]])), 0.1, sides=8)
        for x in np.linspace(-0.6, 0.6, rng.integers(1, 4)) * half[0]
    ]
    return [
        sheeted(frame, stack, style.wall, place.uv(uv)),
        painted(frame, cap, (0.3, 0.29, 0.27)),
        *(part(*pot, "matte", LABELS["building"], color=_CLAY) for pot in pots),
    ]


def _roof_openings(
    massing: Massing, roof: RoofSurface, z: float, rng: np.random.Generator
) -> Model:
    """Roof windows on some of the slopes of dwellings."""
    if massing.kind not in ("house", "terrace", "apartments"):
        return []
    model: Model = []
    for k, polygons in enumerate(roof.faces(massing.footprint)):
        frame = roof.frame(k, z)
        for polygon in polygons:
            at = rng.uniform(polygon.min(axis=0), polygon.max(axis=0), (rng.integers(0, 3), 2))
            for xy in at[_clearance(polygon, at) > 1.0][:1]:
                local = (np.array([*xy, roof.height(xy) + z]) - frame.origin) @ frame.axes.T
                model += _roof_window(frame, local[:2])
    return model


def _roof_window(frame: Frame, at: Array) -> Model:
    half = np.array([0.39, 0.59])
    rect = np.concatenate([at - half, at + half])
    return [
        painted(frame, slabs(rect, 0.0, 0.09), _LEAD),
        painted(frame, rectangles(inset(rect, 0.07), 0.1), (0.03, 0.035, 0.04), "glass"),
    ]


def _clearance(polygon: Array, points: Array) -> Array:
    """How far points (M, 2) are inside the lines through a polygon's sides; negative outside."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    return np.asarray(((points[:, None] - polygon) * inward).sum(axis=2).min(axis=1))
