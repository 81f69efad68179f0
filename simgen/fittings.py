"""What fills and surrounds the openings of a wall: windows, doors, gates, balconies.

Frames and names as in facades.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simgen.facades import BELOW_GROUND_M, FABRICS, Openings, Style, Wall, wall_sheeted
from simgen.massing import Kind
from simgen.mesh import Model
from simgen.shopfronts import displays, shop_boards
from simgen.signs import Rect
from simgen.solids import Frame, boxes, inset, inside_out, painted, pipe, rectangles, slabs

Array = NDArray[np.float64]


def glass_colors(count: int, *, rng: np.random.Generator) -> Array:
    """Dark greys and blue-greys (M, 3): the room behind each pane."""
    tint = rng.uniform((0.8, 0.95, 0.95), (1.0, 1.1, 1.25), (count, 3))
    return rng.uniform(0.01, 0.05, (count, 1)) * tint


def flat_openings(
    wall: Wall,
    style: Style,
    openings: Openings,
    names: Sequence[Rect],
    *,
    rng: np.random.Generator,
) -> Model:
    """Openings painted on a plain wall, for the middle distance."""
    frame, rects = wall.frame, openings.rects
    shut = openings.of("gate", "door")
    return [
        painted(frame, rectangles(rects, 0.02), style.frame),
        painted(frame, rectangles(inset(rects, 0.07), 0.03),
                glass_colors(len(rects), rng=rng), "glass"),
        *_covers(frame, inset(openings.of("window", "tall"), 0.07), 0.04, style, rng),
        painted(frame, rectangles(inset(shut, 0.07), 0.05), style.door),
        *_balconies(wall, style, openings.of("tall"), bars=False),
        *shop_boards(wall, openings.of("shop", "door"), names=names, rng=rng),
    ]  # fmt: skip


def far_openings(
    wall: Wall, openings: Openings, max_quads: int, *, rng: np.random.Generator
) -> Model:
    """Dark panes on a plain wall; whole storeys become one pane where there are too many."""
    rects = openings.rects
    if len(rects) > max_quads:
        num_storeys = int(openings.storey.max()) + 1
        group = openings.storey * min(num_storeys, max_quads) // num_storeys
        groups = [rects[group == g] for g in np.unique(group)]
        rects = np.array([[*r[:, :2].min(axis=0), *r[:, 2:].max(axis=0)] for r in groups])
    colors = glass_colors(len(rects), rng=rng)
    return [painted(wall.frame, rectangles(rects, 0.05), colors, "glass")]


def detailed_openings(
    wall: Wall,
    kind: Kind,
    style: Style,
    openings: Openings,
    names: Sequence[Rect],
    *,
    rng: np.random.Generator,
) -> Model:
    """Openings with reveals, frames, panes, blinds, doors, shop fronts, balconies; fixtures."""
    frame, rects = wall.frame, openings.rects
    panes = openings.of("window", "tall")
    glazed = rects[openings.use != "gate"]
    depth = -style.reveal_m
    model = [
        wall_sheeted(wall, style, inside_out(slabs(rects, depth, 0.0, "xXyY"))),
        *_glazing(frame, glazed, depth, style, rng),
        *_covers(frame, inset(panes, _FRAME_M), depth - 0.03, style, rng),
        *_trims(frame, openings.of("window"), style),
        *_balconies(wall, style, openings.of("tall"), bars=not style.solid_balconies),
        *shop_boards(wall, openings.of("shop", "door"), names=names, rng=rng),
        *displays(frame, openings.of("shop"), depth - 0.03, rng),
    ]
    for rect in openings.of("gate"):
        model += _gate(frame, rect, depth, style)
    for rect in openings.of("door"):
        wide = kind.ground == "shop" or rect[2] - rect[0] > 1.5
        model += _door(frame, rect, depth, style, glazed=wide, rng=rng)
    model += _plinth(wall, style, openings.of("door", "gate"))
    return model + _courses(wall, style) + _fixtures(wall, style, rects, rng=rng)


_FRAME_M = 0.065
_PANE_M = 0.04  # from the front of the frame back to the glass


def _glazing(
    frame: Frame, rects: Array, depth: float, style: Style, rng: np.random.Generator
) -> Model:
    """Frames with mullions and a transom, and the pane behind them."""
    left, bottom, right, top = rects.T
    inner = inset(rects, _FRAME_M)
    ring = [
        np.column_stack([left, bottom, inner[:, 0], top]),
        np.column_stack([inner[:, 2], bottom, right, top]),
        np.column_stack([inner[:, 0], bottom, inner[:, 2], inner[:, 1]]),
        np.column_stack([inner[:, 0], inner[:, 3], inner[:, 2], top]),
    ]
    bars = [rectangles(np.concatenate(ring), depth),
            inside_out(slabs(inner, depth - _PANE_M, depth, "xXyY"))]  # fmt: skip
    pane = depth - _PANE_M
    usual = max(float(np.median(right - left)), 0.5) if len(rects) else 1.0
    count = np.round((right - left) / usual * (style.mullions + 1)).astype(int) - 1
    for i in range(max(count, default=0)):
        cut = count > i
        x = left[cut] + (right - left)[cut] * (i + 1) / (count[cut] + 1)
        bar = np.column_stack([x - 0.025, inner[cut, 1], x + 0.025, inner[cut, 3]])
        bars.append(slabs(bar, pane, depth - 0.006, "xXZ"))
    if style.transom:
        y = bottom + (top - bottom) * style.transom
        bar = np.column_stack([inner[:, 0], y - 0.02, inner[:, 2], y + 0.02])
        bars.append(slabs(bar, pane, depth - 0.012, "yYZ"))
    colors = glass_colors(len(rects), rng=rng)
    return [
        painted(frame, np.concatenate(bars), style.frame),
        painted(frame, rectangles(inner, pane), colors, "glass"),
    ]


def _covers(
    frame: Frame, panes: Array, depth: float, style: Style, rng: np.random.Generator
) -> Model:
    """Blinds (from the top) and curtains (at both sides) behind some of the panes.

    They lie in front of the glass, which is opaque.
    """
    n = len(panes)
    left, bottom, right, top = panes.T
    drop = np.clip(rng.beta(1.2, 1.8, n), 0.08, 1.0) * (top - bottom)
    gather = rng.uniform(0.12, 0.4, (2, n)) * (right - left)
    kind = rng.random(n) / style.covered  # below 0.6: blind; below 1: curtains; else nothing
    blind, curtain = kind < 0.6, (kind >= 0.6) & (kind < 1.0)
    fabric = np.array(FABRICS)[rng.integers(len(FABRICS), size=(2, n))] * rng.uniform(
        0.75, 1.05, (2, n, 1)
    )
    fabric[0, rng.random(n) < 0.6] = FABRICS[rng.integers(2)]  # most blinds are the landlord's
    rects = [
        np.column_stack([left, top - drop, right, top])[blind],
        np.column_stack([left, bottom, left + gather[0], top])[curtain],
        np.column_stack([right - gather[1], bottom, right, top])[curtain],
    ]
    colors = [fabric[0, blind], fabric[1, curtain], fabric[1, curtain]]
    return [painted(frame, rectangles(np.concatenate(rects), depth), np.concatenate(colors))]


def _trims(frame: Frame, windows: Array, style: Style) -> Model:
    """Sills, and by style lintels, shutters and spandrel panels."""
    left, bottom, right, top = windows.T
    sill = np.column_stack([left - 0.06, bottom - 0.07, right + 0.06, bottom])
    quads = [slabs(sill, 0.0, 0.06)]
    model = []
    if style.lintels:
        lintel = np.column_stack([left - 0.1, top, right + 0.1, top + 0.16])
        quads.append(slabs(lintel, 0.0, 0.025))
    if style.shutters:
        width = (right - left) / 2
        leaves = [np.column_stack([left - width, bottom, left - 0.02, top]),
                  np.column_stack([right + 0.02, bottom, right + width, top])]  # fmt: skip
        model.append(painted(frame, slabs(np.concatenate(leaves), 0.0, 0.04), style.door))
        model.append(painted(frame, _slats(np.concatenate(leaves)), 0.55 * np.array(style.door)))
    if style.spandrels:
        panel = np.column_stack([left, np.maximum(bottom - 0.75, 0.2), right, bottom - 0.08])
        model.append(painted(frame, slabs(panel, 0.0, 0.02), 0.6 * np.array(style.door) + 0.04))
    return [*model, painted(frame, np.concatenate(quads), style.trim)]


def _slats(leaves: Array) -> Array:
    """Shadow gaps of louvred shutters."""
    left, bottom, right, top = inset(leaves, 0.05).T
    pitch = (top - bottom) / 8
    y = bottom + np.arange(8)[:, None] * pitch
    rects = np.stack(np.broadcast_arrays(left, y, right, y + 0.3 * pitch), axis=-1)
    return rectangles(rects, 0.046)


def _door(
    frame: Frame, rect: Array, depth: float, style: Style, *, glazed: bool, rng: np.random.Generator
) -> Model:
    """A leaf in the frame, two steps in front and perhaps a canopy; glazed doors have no leaf."""
    left, bottom, right, top = rect
    foot = -BELOW_GROUND_M
    lo = [[left - 0.25, foot, 0.0], [left - 0.25, foot, 0.0]]
    hi = [[right + 0.25, 0.5 * bottom, 0.75], [right + 0.25, bottom, 0.4]]
    model = [painted(frame, boxes(lo, hi, "xXYZ"), (0.3, 0.29, 0.27))]
    grip = boxes([right - 0.2, bottom + 0.9, depth], [right - 0.16, bottom + 1.25, depth + 0.05])
    model.append(painted(frame, grip, (0.5, 0.5, 0.5), "metal"))
    if not glazed:
        leaf = np.array([[left + _FRAME_M, bottom, right - _FRAME_M, top - 0.35]])
        model.append(painted(frame, slabs(leaf, depth - 0.03, depth - 0.005), style.door))
        inner = leaf[0] + np.array([0.12, 0.15, -0.12, -0.15])
        middle = inner[1] + 0.45 * (inner[3] - inner[1])
        panels = np.array([[inner[0], inner[1], inner[2], middle - 0.06],
                           [inner[0], middle + 0.06, inner[2], inner[3]]])  # fmt: skip
        shade = 0.8 * np.array(style.door)
        model.append(painted(frame, slabs(panels, depth - 0.005, depth + 0.012), shade))
    if rng.random() < 0.6:
        canopy = boxes(
            [left - 0.3, top + 0.18, 0.0], [right + 0.3, top + 0.3, rng.uniform(0.6, 1.1)]
        )
        model.append(painted(frame, canopy, style.trim))
    return model


def _gate(frame: Frame, rect: Array, depth: float, style: Style) -> Model:
    """A sectional or roller door: slats with shadow gaps."""
    left, bottom, right, top = rect
    y = np.linspace(bottom, top, max(round((top - bottom) / 0.32), 2) + 1)
    n = len(y) - 1
    slats = np.column_stack([np.full(n, left), y[:-1] + 0.008, np.full(n, right), y[1:] - 0.008])
    color = 0.5 * np.array(style.door) + 0.15
    return [
        painted(frame, rectangles(rect, depth - 0.02), 0.4 * color),
        painted(frame, slabs(slats, depth - 0.02, depth, "yYZ"), color),
    ]


def _plinth(wall: Wall, style: Style, gaps: Array) -> Model:
    """A band at the foot of the wall, left out at doors."""
    if not wall.on_ground:
        return []
    gaps = gaps[np.argsort(gaps[:, 0])]
    ends = np.concatenate([[0.0], gaps[:, [0, 2]].ravel(), [wall.length_m + 0.03]]).reshape(-1, 2)
    low, high = np.full(len(ends), -BELOW_GROUND_M), np.full(len(ends), style.plinth_m)
    rects = np.column_stack([ends[:, 0], low, ends[:, 1], high])
    return [painted(wall.frame, slabs(rects, 0.0, 0.03, "xXYZ"), 0.5 * np.array(style.trim))]


def _courses(wall: Wall, style: Style) -> Model:
    """Bands of stone just below the upper floors."""
    if not style.courses:
        return []
    y = wall.floors[1:-1]
    zero = np.zeros_like(y)
    rects = np.column_stack([zero, y - 0.2, zero + wall.length_m + 0.045, y - 0.02])
    return [painted(wall.frame, slabs(rects, 0.0, 0.045), style.trim)]


_FIXTURES = np.array(
    [  # width, height, depth, lowest and highest place [m], grey
        (0.40, 0.60, 0.16, 0.5, 1.0, 0.50),  # meter box
        (0.23, 0.15, 0.02, 0.4, 9.0, 0.30),  # air brick
        (0.85, 0.58, 0.32, 1.8, 20.0, 0.55),  # outdoor unit of an air conditioner
        (0.14, 0.26, 0.14, 2.1, 2.5, 0.06),  # lamp
        (0.25, 0.35, 0.10, 2.6, 4.0, 0.45),  # alarm box
        (0.30, 0.30, 0.01, 1.2, 1.6, 0.60),  # notice
    ]
)


def _fixtures(wall: Wall, style: Style, rects: Array, *, rng: np.random.Generator) -> Model:
    """Small things on free pieces of wall, and a downpipe where its way is free."""
    top = float(wall.floors[-1])
    count = min(rng.poisson(wall.length_m * top / 18), 16)
    drawn = _FIXTURES[rng.integers(len(_FIXTURES), size=count)]
    size, low, high = drawn[:, :2], drawn[:, 3], np.minimum(drawn[:, 4], top - 0.8)
    corner = np.column_stack([
        rng.uniform(0.1, max(wall.length_m - 1.0, 0.2), count),
        low + rng.random(count) * np.maximum(high - low, 0.0),
    ])  # fmt: skip
    hung = np.hstack([corner, corner + size])
    free = ~_overlaps(hung, rects + np.array([-0.35, -0.35, 0.35, 0.35])).any(axis=1)
    free &= (hung[:, 2] < wall.length_m) & (hung[:, 3] < top - 0.2) & wall.on_ground
    free &= ~np.triu(_overlaps(hung, hung), 1).any(axis=1)
    lo = np.insert(hung[free, :2], 2, 0.0, axis=1)
    hi = np.column_stack([hung[free, 2:], drawn[free, 2]])
    model = [painted(wall.frame, boxes(lo, hi, "xXyYZ"), drawn[free, 5:] * np.ones(3))]
    way = np.array([[0.1, 0.0, 0.4, top]])
    if wall.drained and not _overlaps(way, rects).any():
        line = np.array([(0.25, top - 0.6, 0.09), (0.25, -BELOW_GROUND_M, 0.09)])
        model.append(pipe(wall.frame.world(line), 0.045, style.frame))
    return model


def _overlaps(a: Array, b: Array) -> NDArray[np.bool_]:
    """(A, B): which rectangles of a (A, 4) and b (B, 4) have area in common."""
    a = a[:, None]
    return np.all((a[..., :2] < b[..., 2:]) & (b[..., :2] < a[..., 2:]), axis=-1)


def _balconies(wall: Wall, style: Style, rects: Array, *, bars: bool) -> Model:
    """A slab with a railing in front of each tall window: upright bars, or solid panels."""
    if not len(rects):
        return []
    reach, rail, side = 1.2, 1.05, 0.35
    left, right = rects[:, 0] - side, rects[:, 2] + side
    floor = rects[:, 1] - 0.02
    zero = np.zeros(len(rects))
    slab = boxes(np.column_stack([left, floor - 0.18, zero]),
                 np.column_stack([right, floor, zero + reach]), "xXyYZ")  # fmt: skip
    model = [painted(wall.frame, slab, 0.75 * np.array(style.trim))]
    if bars:
        top = rail + floor
        handrail = _three_sides(left, right, top - 0.05, top, reach, 0.04)
        pickets = np.arange(0.0, float((right - left).max()) - 0.05, 0.11)
        x = (left[:, None] + 0.03 + pickets).ravel()
        keep = x < np.repeat(right, len(pickets)) - 0.02
        y = np.repeat(floor, len(pickets))[keep]
        upright = np.column_stack([x[keep] - 0.009, y, x[keep] + 0.009, y + rail - 0.05])
        model.append(painted(wall.frame, rectangles(upright, reach - 0.02), style.frame))
        return [*model, painted(wall.frame, handrail, style.frame)]
    panels = _three_sides(left, right, floor + 0.06, floor + rail, reach, 0.03)
    return [*model, painted(wall.frame, panels, 0.5 * np.array(style.door) + 0.2)]


def _three_sides(
    left: Array, right: Array, bottom: Array, top: Array, reach: float, thick: float
) -> Array:
    """Upright boards along the left, right and front edges of balconies."""
    zero = np.zeros_like(left)
    lo = [
        (left, bottom, zero),
        (right - thick, bottom, zero),
        (left + thick, bottom, zero + reach - thick),
    ]
    hi = [
        (left + thick, top, zero + reach),
        (right, top, zero + reach),
        (right - thick, top, zero + reach),
    ]
    return np.concatenate(
        [boxes(np.column_stack(a), np.column_stack(b)) for a, b in zip(lo, hi, strict=True)]
    )
