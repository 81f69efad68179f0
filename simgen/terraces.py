"""What stands before shops: tables under parasols, stalls, boards, lockers, racks, meters.

Each is a model in its own frame: +x is where it faces, z up, origin on the ground. ``rects`` are
those of the scene's sign atlas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from simgen.mesh import Model, Part, loft, part, placed
from simgen.pavement import VEGETATION, Builder
from simgen.signs import Rect, face
from simgen.street_solids import (
    BLACK,
    POLE,
    STATIC,
    STEEL,
    UP,
    WHITE,
    WOOD,
    Array,
    assembled,
    block,
    moved,
    rod,
    turned,
)

CLOTHS = ((0.45, 0.05, 0.05), (0.5, 0.45, 0.33), (0.05, 0.16, 0.09), (0.06, 0.1, 0.26),
          (0.55, 0.3, 0.03), WHITE)  # fmt: skip


def cafe_table(*, rng: np.random.Generator) -> Model:
    """A round table with three or four chairs, under a parasol or not."""
    color = np.array((WOOD, BLACK, STEEL)[rng.integers(3)])
    top = turned([(0.38, 0.71), (0.38, 0.74)], color * 1.2, sides=14)
    parts = [top, rod([(0, 0, 0.02), (0, 0, 0.72)], 0.03, BLACK, STATIC)]
    parts.append(turned([(0.24, 0.0), (0.2, 0.03)], BLACK))
    for a in rng.uniform(0, 2 * np.pi) + np.arange(rng.integers(3, 5)) * 1.57:
        seat = placed(_chair(color), xyz=0.72 * np.array([np.cos(a), np.sin(a), 0.0]),
                      heading_rad=float(a) + np.pi + float(rng.normal(0, 0.2)))  # fmt: skip
        parts += seat
    if rng.random() < 0.65:
        parts += _parasol(np.array(CLOTHS[rng.integers(len(CLOTHS))]), rng)
    return assembled(parts)


def _chair(color: Array) -> list[Part]:
    legs = [block((0.03, 0.03, 0.45), (x, y, 0.225), BLACK)
            for x in (-0.18, 0.18) for y in (-0.18, 0.18)]  # fmt: skip
    back = block((0.03, 0.4, 0.22), (-0.2, 0, 0.75), color)
    rails = [block((0.03, 0.03, 0.45), (-0.19, y, 0.66), BLACK) for y in (-0.18, 0.18)]
    return [*legs, *rails, back, block((0.42, 0.42, 0.03), (0, 0, 0.46), color)]


def _parasol(color: Array, rng: np.random.Generator) -> list[Part]:
    """A cloth of eight gores on a pole, with a valance."""
    radius, z = float(rng.uniform(1.2, 1.5)), float(rng.uniform(2.1, 2.35))
    cloth = [(radius, z - 0.16), (radius, z), (0.55 * radius, z + 0.27), (0.04, z + 0.42)]
    vertices, faces = loft(_rings(cloth, 8), caps=False)
    shade = color * rng.normal(1, 0.05, (len(vertices), 1)).clip(0.85, 1.15)
    return [part(vertices, faces, "matte", STATIC, color=shade),
            rod([(0, 0, 0), (0, 0, z + 0.5)], 0.022, WOOD, STATIC, "matte", 6)]  # fmt: skip


def _rings(profile: ArrayLike, sides: int) -> Array:
    """Rings (N, sides, 3) about z of a profile (N, 2) of (radius, z)."""
    r, z = np.asarray(profile, dtype=np.float64).T[:, :, None]
    a = np.arange(sides) * 2 * np.pi / sides
    return np.stack(np.broadcast_arrays(r * np.cos(a), r * np.sin(a), z), axis=2)


def market_stall(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """A counter of crates under a striped roof, with a name over it."""
    cloth = np.array(CLOTHS[rng.integers(len(CLOTHS))])
    posts = [rod([(x, y, 0), (x, y, 2.1 + 0.25 * (x < 0))], 0.025, STEEL)
             for x in (-0.9, 0.9) for y in (-1.45, 1.45)]  # fmt: skip
    counter = [block((0.8, 2.8, 0.04), (0.4, 0, 0.85), WOOD),
               block((0.7, 2.7, 0.8), (0.4, 0, 0.42), cloth * 0.8)]  # fmt: skip
    strips = []
    for i, y in enumerate(np.linspace(-1.4, 1.4, 9)):
        color = cloth if i % 2 else np.array(WHITE)
        roof = [(1.15, y, 2.08), (-1.0, y, 2.4)]
        rings = [np.add([(0, -0.175, 0), (0, 0.175, 0), (0, 0.175, 0.02), (0, -0.175, 0.02)], p)
                 for p in roof[::-1]]  # fmt: skip
        strips.append(part(*loft(rings), "matte", STATIC, color=color))
    goods = [_crate(x, y, rng) for x in (0.2, 0.6) for y in np.linspace(-1.15, 1.15, 5)]
    name = _shop_face(rects, 1.9, 0.36, rng)
    sign = [moved(p, (1.18, 0, 1.93)) for p in name]
    return assembled([*posts, *counter, *strips, *sign, *(p for g in goods for p in g)])


def _crate(x: float, y: float, rng: np.random.Generator) -> list[Part]:
    """A wooden crate heaped with fruit."""
    fruit = np.array(((0.5, 0.08, 0.03), (0.55, 0.26, 0.02), (0.14, 0.3, 0.04), (0.5, 0.42, 0.05),
                      (0.2, 0.03, 0.1)))[rng.integers(5)]  # fmt: skip
    box = block((0.36, 0.5, 0.14), (x, y, 0.94), np.array(WOOD) * 1.6)
    spots = rng.uniform((x - 0.14, y - 0.21, 1.0), (x + 0.14, y + 0.21, 1.05), (12, 3))
    balls = [block((0.09, 0.09, 0.09), spot, fruit * rng.uniform(0.7, 1.3)) for spot in spots]
    return [box, *balls]


def _shop_face(rects: Mapping[str, Rect], width: float, height: float,
               rng: np.random.Generator) -> list[Part]:  # fmt: skip
    """The name of a shop on a sheet, which is no traffic sign."""
    name = str(rng.choice([n for n in rects if n.startswith("shop_")]))
    return [replace(p, semantic=STATIC) for p in face(rects[name], width, height)]


def shop_board(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """Two boards that lean on each other, with names and an advertisement on both."""
    posters = [n for n in rects if n.startswith("billboard_")]
    lean = np.deg2rad(12.0)
    sheets = []
    for heading in (0.0, np.pi):
        frame = block((0.02, 0.6, 1.05), (-0.02, 0, 0.52), BLACK)
        head = [moved(p, (0.003, 0, 0.9)) for p in _shop_face(rects, 0.54, 0.11, rng)]
        poster = face(rects[str(rng.choice(posters))], 0.54, 0.27)
        picture = [replace(moved(p, (0.003, 0, 0.62)), semantic=STATIC) for p in poster]
        chalk = block((0.01, 0.5, 0.3), (0.003, 0, 0.26), (0.04, 0.045, 0.045))
        board = [_leaning(p, lean) for p in (frame, *head, *picture, chalk)]
        sheets += placed(board, xyz=(0, 0, 0), heading_rad=heading)
    return assembled(sheets)


def _leaning(p: Part, angle: float) -> Part:
    """Tilted backwards about y, its foot set forwards."""
    x, y, z = p.vertices.T
    c, s = np.cos(angle), np.sin(angle)
    return replace(p, vertices=np.stack([c * x - s * z + 0.24, y, s * x + c * z], axis=1))


def bicycle_rack(*, rng: np.random.Generator) -> Model:
    """Hoops of steel side by side along y."""
    num = int(rng.integers(3, 7))
    a = np.linspace(0, np.pi, 9)
    hoop = np.stack([0.36 * np.cos(a), 0 * a, 0.5 + 0.32 * np.sin(a)], axis=1)
    path = np.concatenate([[(0.36, 0, -0.05)], hoop, [(-0.36, 0, -0.05)]])
    hoops = [rod(path + np.array([0.0, y, 0.0]), 0.024, STEEL, STATIC, sides=6)
             for y in 0.75 * (np.arange(num) - (num - 1) / 2)]  # fmt: skip
    return assembled(hoops)


def parcel_locker(*, rng: np.random.Generator) -> Model:
    """A wall of doors of three sizes with a screen in the middle and a narrow roof."""
    color = np.array(((0.6, 0.4, 0.02), (0.06, 0.12, 0.3), (0.4, 0.04, 0.04))[rng.integers(3)])
    columns = int(rng.integers(4, 7))
    y = 0.5 * (np.arange(columns) - (columns - 1) / 2)
    width = 0.5 * columns
    parts = [block((0.62, width + 0.06, 2.05), (0, 0, 1.02), color * 0.7, material="paint"),
             block((0.9, width + 0.3, 0.06), (0.1, 0, 2.2), color * 0.5)]  # fmt: skip
    for i, at in enumerate(y):
        cuts = np.linspace(0.12, 2.0, int(rng.choice([4, 6, 9])))
        for low, high in pairwise(cuts):
            door = (0.315, at, (low + high) / 2)
            parts.append(block((0.02, 0.47, high - low - 0.02), door, color, material="paint"))
        if i == columns // 2:
            parts.append(block((0.02, 0.34, 0.5), (0.33, at, 1.35), BLACK, material="paint"))
    return assembled(parts)


def parking_meter(*, rng: np.random.Generator) -> Model:
    """A pay station with a screen, or a meter on a post."""
    color = np.array(((0.05, 0.09, 0.16), (0.12, 0.13, 0.13))[rng.integers(2)])
    if rng.random() < 0.5:
        return assembled([
            block((0.26, 0.3, 1.5), (0, 0, 0.75), color, POLE, "paint"),
            block((0.02, 0.2, 0.14), (0.14, 0, 1.3), (0.1, 0.14, 0.12), POLE),
            block((0.03, 0.34, 0.34), (0, 0, 1.7), (0.03, 0.13, 0.42), POLE, "paint"),
        ])  # fmt: skip
    head = [(0.06, 1.12), (0.1, 1.2), (0.1, 1.36), (0.07, 1.44), (0.01, 1.47)]
    return assembled([rod([(0, 0, -0.1), (0, 0, 1.15)], 0.03, STEEL),
                      turned(head, color * 2, POLE, "paint"),
                      block((0.02, 0.1, 0.08), (0.1, 0, 1.3), WHITE, POLE)])  # fmt: skip


def flower_bed(*, rng: np.random.Generator) -> Model:
    """A trough 2 m long with leaves and flowers in clumps of one colour."""
    stone = np.array((0.3, 0.29, 0.27)) * rng.uniform(0.8, 1.2)
    trough = [block((0.6, 2.0, 0.42), (0, 0, 0.2), stone),
              block((0.5, 1.9, 0.03), (0, 0, 0.42), (0.06, 0.045, 0.03))]  # fmt: skip
    num = 420
    root = rng.uniform((-0.25, -0.95, 0.42), (0.25, 0.95, 0.45), (num, 3))
    tip = root + UP * rng.gamma(4, 0.05, (num, 1))
    leaves = tip[:, None] + rng.normal(0, 0.055, (num, 3, 3))
    blooms = np.array(((0.55, 0.04, 0.07), (0.6, 0.45, 0.03), (0.4, 0.1, 0.45), WHITE))
    clump = blooms[(rng.integers(4) + np.floor(1.6 * root[:, 1]).astype(int)) % 4]
    green = np.array((0.06, 0.12, 0.03)) * rng.uniform(0.6, 1.4, (num, 1))
    color = np.where(rng.random((num, 1)) < 0.3, clump, green)
    foliage = part(leaves, np.arange(3 * num), "leaf", VEGETATION,
                   color=np.repeat(color, 3, axis=0))  # fmt: skip
    return [*assembled(trough), foliage]


TERRACE: dict[str, Builder] = {
    "cafe_table": cafe_table,
    "bicycle_rack": bicycle_rack,
    "parcel_locker": parcel_locker,
    "parking_meter": parking_meter,
    "flower_bed": flower_bed,
}
"""Things before shops by name; each takes ``rng`` alone."""
