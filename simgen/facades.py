"""Façades: the style of a building, its walls, and their division into bays and storeys.

All geometry is in the frame of one wall: x along it from its left end, y up from the base of the
building, z out of the wall, metres. ``rects`` (M, 4) are left, bottom, right, top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.massing import Kind, Massing
from simgen.mesh import Model, Part
from simgen.places import CELLS_PER_RISE, Place, Places
from simgen.solids import Frame, painted, rectangles, sheeted, slabs, unrolled, upright

Array = NDArray[np.float64]
Color = tuple[float, float, float]

BELOW_GROUND_M = 1.0
"""how far walls and steps go below the base, since terrain may dip"""

WHITE: Color = (0.68, 0.67, 0.63)
FRAMES: list[Color] = [WHITE, WHITE, (0.045, 0.047, 0.05), (0.13, 0.065, 0.03), (0.3, 0.3, 0.29)]
TRIMS: list[Color] = [WHITE, (0.42, 0.39, 0.33), (0.3, 0.29, 0.28), (0.55, 0.5, 0.4)]
DOORS: list[Color] = [
    (0.25, 0.02, 0.02), (0.02, 0.05, 0.14), (0.02, 0.09, 0.05), (0.16, 0.07, 0.03),
    (0.04, 0.04, 0.045), (0.5, 0.49, 0.46), (0.3, 0.2, 0.05), (0.04, 0.15, 0.16),
]  # fmt: skip
FABRICS: list[Color] = [
    (0.66, 0.63, 0.56), (0.6, 0.6, 0.6), (0.55, 0.48, 0.36), (0.35, 0.34, 0.33), (0.4, 0.22, 0.15),
]  # fmt: skip
SHOPS: list[Color] = [
    (0.45, 0.03, 0.03), (0.03, 0.07, 0.25), (0.02, 0.16, 0.08), (0.6, 0.33, 0.03),
    (0.03, 0.03, 0.035), (0.62, 0.6, 0.55), (0.16, 0.05, 0.14), (0.05, 0.2, 0.26),
]  # fmt: skip


@dataclass(frozen=True)
class Style:
    """What one building's façades share; drawn once per building."""

    wall: str
    """material of the walls"""
    phase: int
    """where the courses of all walls begin, see :mod:`simgen.places`"""
    pitch_m: float
    window_share: float
    window_height_m: float
    sill_m: float
    reveal_m: float
    mullions: int
    transom: float
    """height of the transom over that of the window; 0 = none"""
    frame: Color
    trim: Color
    """sills, lintels, cornices, fascia boards"""
    door: Color
    plinth_m: float
    lintels: bool
    shutters: bool
    spandrels: bool
    """coloured panels below the windows"""
    solid_balconies: bool
    courses: bool
    """a band of stone at each floor"""
    covered: float
    """share of windows with a blind or a curtain"""


def drawn_style(kind: Kind, walls: Sequence[str], *, rng: np.random.Generator) -> Style:
    """Draws a style."""

    def one_of(colors: list[Color]) -> Color:
        return colors[rng.integers(len(colors))]

    share, pitch = rng.uniform(*kind.window_share), rng.uniform(*kind.pitch_m)
    return Style(
        wall=walls[int(rng.integers(len(walls)))],
        phase=int(rng.integers(CELLS_PER_RISE)),
        pitch_m=pitch,
        window_share=share,
        window_height_m=rng.uniform(*kind.window_height_m),
        sill_m=rng.uniform(*kind.sill_m),
        reveal_m=rng.uniform(0.08, 0.15),
        mullions=max(round(share * pitch / rng.uniform(0.7, 1.1)) - 1, 0),
        transom=rng.choice([0.0, 0.68, 0.5]),
        frame=one_of(FRAMES),
        trim=one_of(TRIMS),
        door=one_of(DOORS),
        plinth_m=rng.uniform(0.15, 0.4),
        lintels=bool(rng.random() < 0.5),
        shutters=kind.ground == "door" and share < 0.45 and bool(rng.random() < 0.3),
        spandrels=kind.window_share[1] > 0.8 and kind.ground != "gate" and bool(rng.random() < 0.4),
        solid_balconies=bool(rng.random() < 0.5),
        courses=kind.storey_m < 5 and bool(rng.random() < 0.3),
        covered=rng.uniform(0.45, 0.9),
    )


@dataclass(frozen=True, eq=False)
class Panels:
    """A wall's parts between joints, each with a place of its own on the sheet."""

    x: Array
    """(C + 1,) edges along the wall"""
    y: Array
    """(R + 1,) edges upwards"""
    places: list[list[Place]]
    """R rows of C"""

    def cut(self, rects: Array) -> Array:
        """Rectangles (M, 4), those that joints run through in pieces."""
        for axis, joints in ((0, self.x[1:-1]), (1, self.y[1:-1])):
            for joint in joints:
                through = (rects[:, axis] < joint) & (joint < rects[:, axis + 2])
                if through.any():
                    first, second = rects.copy(), rects[through]
                    first[through, axis + 2] = joint
                    second[:, axis] = joint
                    rects = np.concatenate([first, second])
        return rects

    def uv(self, quads: Array) -> Array:
        """Sheet coordinates (Q, 4, 2) of quads (Q, 4, 3), each of which is in one panel."""
        xy, middle = unrolled(quads), quads.mean(axis=1)
        if len(self.x) == len(self.y) == 2:
            return self.places[0][0].uv(xy)
        column = np.searchsorted(self.x[1:-1], middle[:, 0])
        row = np.searchsorted(self.y[1:-1], middle[:, 1])
        for r, c in set(zip(row.tolist(), column.tolist(), strict=True)):
            own = (row == r) & (column == c)
            xy[own] = self.places[r][c].uv(xy[own])
        return xy


WHOLE = Panels(np.array([0.0, np.inf]), np.array([-np.inf, np.inf]), [[Place()]])


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a building."""

    frame: Frame
    length_m: float
    floors: Array
    """(S + 1,) heights of the floors and of the top of the wall"""
    side: Literal["front", "side", "back"]
    on_ground: bool
    drained: bool
    """whether a downpipe from a flat roof runs down near its left end"""
    panels: Panels = WHOLE


@dataclass(frozen=True, eq=False)
class Openings:
    """The holes in one wall; within a storey they lie side by side."""

    rects: Array
    storey: NDArray[np.int64]
    use: NDArray[np.str_]
    """window, tall (window down to the floor, on a balcony), door, shop or gate"""

    def of(self, *uses: str) -> Array:
        """Rectangles of some uses."""
        return self.rects[np.isin(self.use, uses)]


def walls_of(massing: Massing, kind: Kind, parapet_m: float) -> list[Wall]:
    """The sides of a building."""
    ring = massing.footprint
    edges = np.roll(ring, -1, axis=0) - ring
    lengths = np.linalg.norm(edges, axis=1)
    out = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / lengths[:, None]
    along_front = np.abs(out @ out[massing.front]) > 0.7
    floors = _floors(massing, kind, parapet_m)
    return [
        Wall(
            frame=upright([*ring[i], massing.base_z], out[i]),
            length_m=float(lengths[i]),
            floors=floors,
            side="front" if i == massing.front else "back" if along_front[i] else "side",
            on_ground=massing.on_ground,
            drained=massing.roof == "flat" and massing.on_ground and bool(along_front[i]),
        )
        for i in range(len(ring))
    ]


def _floors(massing: Massing, kind: Kind, parapet_m: float) -> Array:
    height = massing.wall_height
    ground = kind.ground_m if massing.on_ground and kind.ground_m < 0.8 * height else 0.0
    count = max(round((height - ground) / kind.storey_m), 1)
    floors = np.linspace(ground, height, count + 1)
    floors[-1] += parapet_m
    return np.concatenate([[0.0], floors]) if ground else floors


PANEL_M = 12.0
"""A longer wall has joints between its bays about that far apart."""
STACK_M = 14.0
"""A higher one has bands at its floors about that far apart."""


def panelled(wall: Wall, style: Style, places: Places, gable_m: float = 0.0) -> Wall:
    """The wall cut into panels, each at a place of its own; a gable belongs to the uppermost."""
    bays = np.linspace(0, wall.length_m, max(_num_bays(wall, style), 1) + 1)
    x = _joints(bays, PANEL_M)
    y = _joints(wall.floors, STACK_M)
    low, high = y.copy(), y.copy()
    low[0] -= BELOW_GROUND_M
    high[-1] += gable_m
    taken = [
        [
            places.take(style.wall, wall.frame, (left, bottom, right, top), phase=style.phase)
            for left, right in pairwise(x)
        ]
        for bottom, top in zip(low, high[1:], strict=False)
    ]
    return replace(wall, panels=Panels(x, y, taken))


def _joints(edges: Array, spacing_m: float) -> Array:
    """Those of the edges (M,) that come next to equal parts of about a length, and both ends."""
    length = edges[-1] - edges[0]
    parts = max(int(np.ceil(length / spacing_m - 0.25)), 1)
    wanted = edges[0] + length * np.arange(1, parts) / parts
    inner = edges[1:-1]
    nearest = [int(np.argmin(np.abs(inner - at))) for at in wanted] if len(inner) else []
    return np.concatenate([edges[:1], inner[np.unique(np.array(nearest, int))], edges[-1:]])


def _num_bays(wall: Wall, style: Style) -> int:
    return int((wall.length_m - 0.4) / style.pitch_m) or int(wall.length_m > 2.0)


def joints(wall: Wall, style: Style) -> Model:
    """Cover strips over the joints between panels, and bands of stone at their floors."""
    x, y, top = wall.panels.x[1:-1], wall.panels.y[1:-1], wall.floors[-1]
    model: Model = []
    if len(x):
        strips = np.column_stack([x - 0.02, 0 * x - BELOW_GROUND_M, x + 0.02, 0 * x + top])
        model.append(painted(wall.frame, rectangles(strips, 0.003), 0.5 * np.array(style.trim)))
    if len(y):
        bands = np.column_stack([0 * y, y - 0.2, 0 * y + wall.length_m, y + 0.02])
        model.append(painted(wall.frame, slabs(bands, 0.0, 0.05), style.trim))
    return model


def drawn_openings(wall: Wall, kind: Kind, style: Style, *, rng: np.random.Generator) -> Openings:
    """Divides a wall into bays and storeys and draws what is in each."""
    num_bays = _num_bays(wall, style)
    num_storeys = len(wall.floors) - 1
    bay = wall.length_m / max(num_bays, 1)
    bays = np.arange(num_bays)
    width = style.window_share * bay * np.where(rng.random(num_bays) < 0.12, 0.55, 1.0)
    present = rng.random(num_bays) < (kind.side_share if wall.side == "side" else 1.0)
    balcony = rng.random(num_bays) < kind.balcony_share * (wall.side != "side") * (bay > 2.4)

    storey, column = (a.ravel() for a in np.meshgrid(np.arange(num_storeys), bays, indexing="ij"))
    floor, ceiling = wall.floors[storey], wall.floors[storey + 1]
    top = np.minimum(floor + style.sill_m + style.window_height_m, ceiling - 0.35)
    bottom = np.maximum(np.minimum(floor + style.sill_m, top - 0.6), floor + 0.1)
    use = np.where(balcony[column] & (storey > 0), "tall", "window")
    bottom = np.where(use == "tall", floor + 0.08, bottom)
    rects = _row((column + 0.5) * bay, width[column], bottom, top)
    keep = present[column]
    if wall.side == "front" and wall.on_ground and num_bays:
        rects[:num_bays], use[:num_bays] = _ground_floor(
            wall, kind, style, rects[:num_bays], rng=rng
        )
    return Openings(rects[keep], storey[keep], use[keep])


def _ground_floor(
    wall: Wall, kind: Kind, style: Style, windows: Array, *, rng: np.random.Generator
) -> tuple[Array, NDArray[np.str_]]:
    """The street side of the ground floor: one door, and shop windows or gates by kind."""
    num_bays = len(windows)
    bay, ceiling = wall.length_m / num_bays, wall.floors[1]
    middle = (np.arange(num_bays) + 0.5) * bay
    rects, use = windows.copy(), np.full(num_bays, "window", dtype="<U6")
    if kind.ground == "shop":
        rects[:] = _row(middle, bay - 0.4, style.plinth_m + 0.1, ceiling - 0.95)
        use[:] = "shop"

    door = rng.integers(num_bays)
    gates = rng.random(num_bays) < (0.45 if kind.ground == "gate" else 0.0)
    garage = num_bays > 2 and rng.random() < kind.garage_share
    gates[door - 1] |= garage or kind.ground == "gate"
    gates[door] = False
    head = 4.2 if kind.ground == "gate" else 2.15
    rects[gates] = _row(middle, min(3.8, bay - 0.5), 0.04, min(head, ceiling - 0.4))[gates]
    use[gates] = "gate"

    width, head = kind.door_m
    rects[door] = _row(middle, min(width, bay - 0.3), 0.04, min(head, ceiling - 0.3))[door]
    use[door] = "door"
    return rects, use


def _row(middle: ArrayLike, width: ArrayLike, bottom: ArrayLike, top: ArrayLike) -> Array:
    """Rectangles (M, 4) of given widths around their middles (M,)."""
    x, half = np.asarray(middle), np.asarray(width) / 2
    return np.stack(np.broadcast_arrays(x - half, bottom, x + half, top), axis=-1)


# ---- walls ------------------------------------------------------------------------------------


def wall_surface(wall: Wall, style: Style, openings: Openings) -> Part:
    """The wall around its openings: piers between them, and pieces below and above each."""
    rects = []
    for storey in range(len(wall.floors) - 1):
        low = wall.floors[storey] if storey else -BELOW_GROUND_M
        high = wall.floors[storey + 1]
        holes = openings.rects[openings.storey == storey]
        holes = holes[np.argsort(holes[:, 0])]
        edges = np.concatenate([[0.0], holes[:, [0, 2]].ravel(), [wall.length_m]]).reshape(-1, 2)
        rects += [(left, low, right, high) for left, right in edges]
        rects += [(left, low, right, bottom) for left, bottom, right, _ in holes]
        rects += [(left, top, right, high) for left, _, right, top in holes]
    solid = np.array([r for r in rects if r[2] > r[0] and r[3] > r[1]]).reshape(-1, 4)
    return wall_sheeted(wall, style, rectangles(wall.panels.cut(solid), 0.0))


def plain_surface(wall: Wall, style: Style) -> Part:
    """The wall without any opening."""
    rect = np.array([[0.0, -BELOW_GROUND_M, wall.length_m, wall.floors[-1]]])
    return wall_sheeted(wall, style, rectangles(wall.panels.cut(rect), 0.0))


def wall_sheeted(wall: Wall, style: Style, quads: Array) -> Part:
    """Quads of a wall, each within one of its panels, with the building's wall sheet."""
    return sheeted(wall.frame, quads, style.wall, wall.panels.uv(quads))
