"""Façades: the style of a building, its walls, and their division into bays and storeys.

All geometry is in the frame of one wall: x along it from its left end, y up from the base of the
building, z out of the wall, metres. ``rects`` (M, 4) are left, bottom, right, top.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simgen.massing import KINDS, Kind
from simgen.mesh import Part
from simgen.solids import Frame, rectangles, sheeted

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
    uv_offset: tuple[float, float]
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
    covered: float
    """share of windows with a blind or a curtain"""


def drawn_style(kind: Kind, walls: list[str], *, rng: np.random.Generator) -> Style:
    """Draws a style."""

    def one_of(colors: list[Color]) -> Color:
        return colors[rng.integers(len(colors))]

    share, pitch = rng.uniform(*kind.window_share), rng.uniform(*kind.pitch_m)
    u, v = rng.uniform(0, 32, 2)
    return Style(
        wall=walls[rng.integers(len(walls))],
        uv_offset=(float(u), float(v)),
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
        spandrels=share > 0.5 and bool(rng.random() < 0.4),
        solid_balconies=bool(rng.random() < 0.5),
        covered=rng.uniform(0.35, 0.8),
    )


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a building."""

    frame: Frame
    length_m: float
    floors: Array
    """(S + 1,) heights of the floors and of the top of the wall"""
    side: Literal["front", "side", "back"]
    on_ground: bool
    uv_start: float
    """metres of wall that come before this one"""


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


def drawn_openings(
    wall: Wall, kind: Kind, style: Style, *, rng: np.random.Generator
) -> Openings:
    """Divides a wall into bays and storeys and draws what is in each."""
    num_bays = int((wall.length_m - 0.4) / style.pitch_m) or int(wall.length_m > 2.0)
    num_storeys = len(wall.floors) - 1
    bay = wall.length_m / max(num_bays, 1)
    bays = np.arange(num_bays)
    width = style.window_share * bay * np.where(rng.random(num_bays) < 0.12, 0.55, 1.0)
    present = rng.random(num_bays) < (kind.side_share if wall.side == "side" else 0.97)
    balcony = rng.random(num_bays) < kind.balcony_share * (wall.side != "side") * (bay > 2.4)

    storey, column = (a.ravel() for a in np.meshgrid(np.arange(num_storeys), bays, indexing="ij"))
    floor, ceiling = wall.floors[storey], wall.floors[storey + 1]
    top = np.minimum(floor + style.sill_m + style.window_height_m, ceiling - 0.35)
    bottom = np.maximum(np.minimum(floor + style.sill_m, top - 0.6), floor + 0.1)
    use = np.where(balcony[column] & (storey > 0), "tall", "window")
    bottom = np.where(use == "tall", floor + 0.08, bottom)
    centre = (column + 0.5) * bay
    rects = np.stack([centre - width[column] / 2, bottom, centre + width[column] / 2, top], axis=1)
    upper = Openings(rects, storey, use)
    keep = present[column]
    if not (wall.side == "front" and wall.on_ground and num_bays):
        return _selected(upper, keep)
    upper = _selected(upper, keep & (storey > 0))
    return _joined(_ground_floor(wall, kind, style, rects[:num_bays], rng), upper)


def _selected(openings: Openings, keep: NDArray[np.bool_]) -> Openings:
    return Openings(openings.rects[keep], openings.storey[keep], openings.use[keep])


def _joined(a: Openings, b: Openings) -> Openings:
    return Openings(
        np.concatenate([a.rects, b.rects]),
        np.concatenate([a.storey, b.storey]),
        np.concatenate([a.use, b.use]),
    )


def _ground_floor(
    wall: Wall, kind: Kind, style: Style, windows: Array, rng: np.random.Generator
) -> Openings:
    """The street side of the ground floor: one door, and shop windows or gates by kind."""
    num_bays = len(windows)
    bay, ceiling = wall.length_m / num_bays, wall.floors[1]
    rects, use = windows.copy(), np.full(num_bays, "window", dtype="<U6")
    middle = windows[:, [0, 2]].mean(axis=1)
    if kind.ground == "shop":
        use[:] = "shop"
        half, head = bay / 2 - 0.2, ceiling - 0.95
        rects = np.column_stack([middle - half, np.full(num_bays, style.plinth_m + 0.1),
                                 middle + half, np.full(num_bays, head)])  # fmt: skip
    door = rng.integers(num_bays)
    gates = rng.random(num_bays) < (0.45 if kind.ground == "gate" else 0.0)
    if kind is KINDS["house"] and num_bays > 2 and rng.random() < 0.4:
        gates[door - 1] = True
    gates[door] = False
    half = min(kind.door_m[0], bay - 0.3) / 2
    rects[door] = middle[door] - half, 0.04, middle[door] + half, min(kind.door_m[1], ceiling - 0.3)
    use[door] = "door"
    half, head = min(3.8, bay - 0.5) / 2, min(4.2 if kind.ground == "gate" else 2.15, ceiling - 0.4)
    rects[gates, 0], rects[gates, 2] = middle[gates] - half, middle[gates] + half
    rects[gates, 1], rects[gates, 3] = 0.04, head
    use[gates] = "gate"
    return Openings(rects, np.zeros(num_bays, dtype=np.int64), use)


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
    solid = [r for r in rects if r[2] > r[0] and r[3] > r[1]]
    return wall_sheeted(wall, style, rectangles(solid, 0.0))


def plain_surface(wall: Wall, style: Style) -> Part:
    """The wall without any opening."""
    rect = (0.0, -BELOW_GROUND_M, wall.length_m, wall.floors[-1])
    return wall_sheeted(wall, style, rectangles(rect, 0.0))


def wall_sheeted(wall: Wall, style: Style, quads: Array) -> Part:
    """Quads of a wall with the building's wall sheet."""
    u, v = style.uv_offset
    return sheeted(wall.frame, quads, style.wall, (u + wall.uv_start, v))


