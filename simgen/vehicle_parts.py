"""Parts that kinds of vehicles share: wheels, windows, doors, lamps, plates, cargo boxes.

A *piece* is a mesh of one material and colour. What lies on a shell is draped by a `Dresser`;
what comes in pairs is made for the left side and mirrored. Frame and units: see mesh.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.bodyshell import (
    LIFT_M,
    Array,
    Direction,
    Mesh,
    Shell,
    band_grid,
    disc,
    joined,
    lathe,
    mirrored,
    moved,
    quad_grid,
    sheet,
    tiled,
)
from simgen.mesh import Model, box, part, quads_to_triangles, smooth, tube

Rgb = tuple[float, float, float]
Rng = np.random.Generator
Range = tuple[float, float]
Finish = tuple[str, Rgb]
"""material and colour"""


class Piece(NamedTuple):
    """A mesh of one material, with one colour or one (V, 3) for each vertex."""

    mesh: Mesh
    material: str
    color: Rgb | Array


class LampPlace(NamedTuple):
    """Where a left lamp is, in shares of half the width and of the height."""

    inner: float
    outer: float
    low: float
    high: float


STEEL_RGB: Rgb = (0.20, 0.20, 0.21)
PLATE_WHITE: Rgb = (0.70, 0.70, 0.68)
PLATE_YELLOW: Rgb = (0.62, 0.45, 0.03)

GLASS: Finish = ("glass", (0.012, 0.014, 0.016))
PALE: Finish = ("glass", (0.22, 0.22, 0.21))
RUBBER: Finish = ("matte", (0.025, 0.025, 0.026))
PLASTIC: Finish = ("matte", (0.03, 0.03, 0.032))
SEAM: Finish = ("matte", (0.012, 0.012, 0.012))
ALLOY: Finish = ("metal", (0.55, 0.56, 0.58))
STEEL: Finish = ("metal", STEEL_RGB)
STEEL_PAINT: Finish = ("matte", STEEL_RGB)
WHITE_LAMP: Finish = ("lamp", (0.45, 0.45, 0.46))  # a mirror in a dark bowl, not paper
RED_LAMP: Finish = ("lamp", (0.35, 0.01, 0.01))
AMBER_LAMP: Finish = ("lamp", (0.55, 0.20, 0.01))


def model_of(pieces: Iterable[Piece], semantic: int) -> Model:
    """One part per material, smoothly shaded."""
    by_material: dict[str, list[Piece]] = {}
    for piece in pieces:
        by_material.setdefault(piece.material, []).append(piece)
    return [
        smooth(
            part(
                *joined([p.mesh for p in group]),
                material,
                semantic,
                color=np.concatenate([np.broadcast_to(p.color, p.mesh[0].shape) for p in group]),
            )
        )
        for material, group in by_material.items()
    ]


def both_sides(left: Iterable[Piece]) -> list[Piece]:
    """Pieces of the left side, and their mirror images."""
    left = list(left)
    return left + on_right(left)


def on_right(left: Iterable[Piece]) -> list[Piece]:
    """Mirror images of pieces of the left side."""
    return [p._replace(mesh=mirrored(p.mesh)) for p in left]


def shifted(pieces: Iterable[Piece], offset: ArrayLike) -> list[Piece]:
    return [p._replace(mesh=moved(p.mesh, offset)) for p in pieces]


def block(size: ArrayLike, center: ArrayLike, finish: Finish) -> Piece:
    return Piece(box(size, center), *finish)


def rod(path: ArrayLike, radius: ArrayLike, finish: Finish = STEEL, sides: int = 6) -> Piece:
    return Piece(tube(path, radius, sides), *finish)


# --- wheels ----------------------------------------------------------------------------------


def road_wheel(radius: float, width: float, spokes: int) -> list[Piece]:
    """A wheel about the y axis through the origin, its outer side at y = 0.

    Alloy wheels have spokes in front of a dark hollow; without spokes it is a steel disc.
    """
    rim, sides = 0.68 * radius, 16
    tread = [(-width, 0.97 * radius), (-0.04, radius), (-0.005, 0.94 * radius), (0.0, rim)]
    pieces = [
        Piece(lathe(tread, sides), *RUBBER),
        Piece(lathe([(0.0, rim), (0.006, 0.91 * rim)], sides), *ALLOY),
    ]
    if spokes == 0:
        hub = joined([lathe([(-0.02, 0.4 * rim), (0.0, 0.3 * rim)], 8), disc(0.0, 0.3 * rim, 8)])
        dish = Piece(disc(-0.02, 0.92 * rim, sides), *STEEL)
        return [*pieces, dish, Piece(hub, *PLASTIC)]
    star = [_spoke(rim, angle) for angle in np.arange(spokes) * 2 * np.pi / spokes]
    hollow = Piece(disc(-0.06, 0.97 * rim, sides), *SEAM)
    return [*pieces, hollow, Piece(joined([*star, disc(-0.004, 0.22 * rim, 6)]), *ALLOY)]


def _spoke(rim: float, angle: float) -> Mesh:
    """A tapered quad from hub to rim that faces +y."""
    x = np.array([-0.15, -0.11, 0.11, 0.15]) * rim
    z = np.array([0.1, 0.95, 0.95, 0.1]) * rim
    c, s = np.cos(angle), np.sin(angle)
    y = np.array([-0.008, -0.02, -0.02, -0.008])
    return np.stack([x * c + z * s, y, z * c - x * s], axis=1), np.array([[0, 1, 2], [0, 2, 3]])


def axle(x: float, half_width: float, radius: float, width: float, spokes: int = 0) -> list[Piece]:
    """Two wheels that stand on the ground, their outer sides at ±``half_width``."""
    return both_sides(shifted(road_wheel(radius, width, spokes), (x, half_width, radius)))


def twin_axle(x: float, vehicle_width: float, radius: float) -> list[Piece]:
    """A driven or trailed axle of a truck with its mudguards."""
    angle = np.deg2rad(np.linspace(15, 165, 8))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (radius + 0.07) + [x, radius]
    across = (vehicle_width / 2 - 0.02, vehicle_width / 2 - 0.55)
    guard = sheet(np.stack([np.insert(arc, 1, y, axis=1) for y in across]))
    wheels = axle(x, vehicle_width / 2 - 0.04, radius, 0.5)
    return wheels + both_sides([Piece(guard, *PLASTIC)])


# --- what is draped on a shell ---------------------------------------------------------------


class Dresser:
    """Drapes pieces on a shell. ``height`` is the unit of heights that are given as shares."""

    def __init__(self, body: Shell, height: float) -> None:
        self.body, self.outline, self.height = body, body.outline, height
        self.tail, self.nose = body.outline.span
        self.half = body.outline.width / 2

    def x(self, share: float) -> float:
        """x of a share of the length, from nose (0) to tail (1)."""
        return self.nose + share * (self.tail - self.nose)

    def patch(self, direction: Direction, grid: Array, finish: Finish) -> Piece:
        return Piece(self.body.draped(direction, grid), *finish)

    def tiles(
        self,
        direction: Direction,
        u: ArrayLike,
        z: ArrayLike,
        kind: ArrayLike,
        finishes: Sequence[Finish],
        lift: float = LIFT_M,
    ) -> list[Piece]:
        """Cells between the edges ``u`` (C,) and ``z`` (R,), each of a kind (R - 1, C - 1)."""
        grid = np.stack(np.meshgrid(u, z), axis=-1).astype(np.float64)
        cells: NDArray[np.int64] = np.broadcast_to(kind, (len(grid) - 1, grid.shape[1] - 1))
        meshes = tiled(self.body.draped(direction, grid, lift), cells)
        return [Piece(m, *finish) for m, finish in zip(meshes, finishes, strict=True)]

    def seam(self, direction: Direction, path: ArrayLike, width: float = 0.011) -> Piece:
        """A dark line along a path (N, 2)."""
        p = np.asarray(path, dtype=np.float64)
        along = np.gradient(p, axis=0)
        across = np.stack([along[:, 1], -along[:, 0]], axis=1)
        across *= width / 2 / np.linalg.norm(across, axis=1, keepdims=True)
        return self.patch(direction, np.stack([p - across, p + across], axis=1), SEAM)


def rectangle(u: Range, z: Range, rows: int = 2, columns: int = 2) -> Array:
    corners = [(u[0], z[0]), (u[1], z[0]), (u[1], z[1]), (u[0], z[1])]
    return quad_grid(corners, rows, columns)


def skin(body: Shell, paint: Finish, cladding: Finish) -> list[Piece]:
    """The shell itself, and a dark block that closes the view between the wheel arches."""
    outline = body.outline
    (tail, nose), low = outline.span, float(outline.bottom[:, 1].min())
    size = (0.96 * (nose - tail), outline.width - 0.56, 0.3)
    return [
        Piece(body.painted, *paint),
        Piece(body.cladding, *cladding),
        Piece(body.underside, *SEAM),
        block(size, ((nose + tail) / 2, 0.0, low + 0.17), SEAM),
    ]


def end_window(d: Dresser, direction: Direction, low_x: float, high_x: float) -> Piece:
    """Windscreen or rear window from the x of its lower to that of its upper edge."""
    o = d.outline
    low = float(o.top_at(low_x)) + 0.03
    high = min(float(o.rail_at(high_x)), float(o.top_at(high_x)) - 0.05)
    half_low = float(o.half_width_at(low_x, low)) - 0.1
    half_high = float(o.half_width_at(high_x, high)) - 0.1
    corners = [(-half_low, low), (half_low, low), (half_high, high), (-half_high, high)]
    return cabin_pane(d, direction, quad_grid(corners, 6, 13), seats=(0.27, 0.73))


def cabin_pane(
    d: Dresser, direction: Direction, grid: Array, seats: Sequence[float], level: float = 0.45
) -> Piece:
    """Glass, which is opaque: painted with the light of the panes behind, and seats before it.

    Args:
        seats: places of the head rests along the pane, 0 to 1.
        level: height of their tops in the pane, 0 to 1.
    """
    rows, columns = grid.shape[:2]
    v, u = np.linspace(0, 1, rows)[:, None], np.linspace(0, 1, columns)
    light = 0.012 + 0.05 * np.exp(-(((v - 0.6) / 0.3) ** 2)) * np.ones(columns)
    for seat in seats:
        rest = np.clip(1.6 - np.abs(u - seat) / 0.1, 0, 1) * np.clip(1.5 - v / level, 0, 1)
        light = np.maximum(light * (1 - 0.8 * rest), 0.006)
    color = light.reshape(-1, 1) * np.array([0.95, 1.0, 1.02])
    return Piece(d.body.draped(direction, grid), GLASS[0], color)


def wipers(d: Dresser, low_x: float) -> list[Piece]:
    """Two wipers at rest above the lower edge of the windscreen at ``low_x``."""
    z = float(d.outline.top_at(low_x)) + 0.05
    half = float(d.outline.half_width_at(low_x, z)) - 0.2
    arms = [np.linspace((a, z), (b, z + 0.03), 4) for a, b in ((0.0, -half), (half, 0.08))]
    return [rod(d.body.draped("front", arm[None], 0.03)[0], 0.009, SEAM, sides=4) for arm in arms]


def side_windows(
    d: Dresser, pillars: Sequence[float], *, sill: float = 0.03, lean: float = 0.0
) -> list[Piece]:
    """Left panes between pillars, as high as the side allows, and dark posts between them."""
    o = d.outline

    def band(x: Array) -> Array:
        return band_grid(x, o.belt_at(x) + sill, o.rail_at(x) - 0.035, rows=3)

    pieces = []
    for front, rear in pairwise(pillars):
        x = np.linspace(d.x(rear) + 0.025, d.x(front) - 0.025, 24)
        x = x[o.rail_at(x) - o.belt_at(x) > sill + 0.075]
        pane = band(np.linspace(x[0], x[-1], 7))
        if rear == pillars[-1]:
            pane[..., 0] += lean * np.linspace(0, 1, 3)[:, None] * np.linspace(1, 0, 7)
        pieces.append(cabin_pane(d, "left", pane, seats=(0.3,), level=0.6))
    posts = [band(d.x(p) + np.array([-0.025, 0.025])) for p in pillars[1:-1]]
    return pieces + [d.patch("left", post, SEAM) for post in posts]


def side_doors(d: Dresser, seams: Sequence[float], paint: Finish) -> list[Piece]:
    """Left seams from the belt to the lower edge, and a handle at each but the first."""
    o = d.outline
    pieces = []
    for share in seams:
        x = d.x(share)
        z = np.linspace(float(o.bottom_at(x, o.cladding)) + 0.02, float(o.belt_at(x)) - 0.01, 6)
        pieces.append(d.seam("left", np.stack([np.full(6, x), z], axis=1)))
    for share in seams[1:]:
        x, handle_z = d.x(share) + 0.13, float(o.belt_at(d.x(share))) - 0.09
        y = float(o.half_width_at(x, handle_z))
        pieces.append(block((0.17, 0.05, 0.028), (x, y, handle_z), paint))
    return pieces


def side_mirror(d: Dresser, x: float, z: float, size: float, finish: Finish) -> list[Piece]:
    """An outside mirror on the left."""
    y = float(d.outline.half_width_at(x, z))
    profile = [(-0.05, 0.2), (0.1, 0.55), (1.0, 0.6), (1.25, 0.4), (1.3, 0.05)]
    vertices, faces = lathe(np.array(profile) * size, 8)
    housing = (vertices * [0.75, 1.0, 1.0] + [x, y, z + 0.4 * size], faces)
    glass_at = (x - 0.43 * size, y + 0.68 * size, z + 0.4 * size)
    return [
        Piece(housing, *finish),
        block((0.02, 0.85 * size, 0.75 * size), glass_at, GLASS),
    ]


def lamp(d: Dresser, direction: Direction, place: LampPlace, bright: Finish) -> list[Piece]:
    """A left lamp: bright in a dark housing, with an indicator at its outer lower corner."""
    inner, outer = place.inner * d.half, place.outer * d.half
    u = inner + (outer - inner) * np.array([0.0, 0.12, 0.32, 0.52, 0.72, 0.78, 0.97, 1.0])
    low, high = place.low * d.height, place.high * d.height
    z = low + (high - low) * np.array([0.0, 0.12, 0.38, 0.88, 1.0])
    kind = np.zeros((4, 7), dtype=np.int64)
    kind[1:3, [1, 3]], kind[2, 2] = 1, 1
    kind[1, 5] = 2
    if direction == "rear":
        kind[1:3, 2], kind[2, 4:6] = 1, 1
    return d.tiles(direction, u, z, kind, (GLASS, bright, AMBER_LAMP))


def number_plate(d: Dresser, direction: Direction, z: float, color: Rgb, rng: Rng) -> list[Piece]:
    """A flat number plate in the middle of nose or tail, just off the surface."""
    grid = rectangle((-0.26, 0.26), (z - 0.056, z + 0.056), 2, 3)
    x = d.body.draped(direction, grid)[0][:, 0]
    front = direction == "front"
    return plate_at(float(x.max() if front else x.min()), z, 1 if front else -1, color, rng)


def plate_at(x: float, z: float, sign: int, color: Rgb, rng: Rng) -> list[Piece]:
    """A number plate with text; it faces ±x by ``sign``."""
    text = rng.choice(list(_GLYPHS), 7)
    cell = np.array([0.047, 0.076])
    left = -0.215 + 0.06 * np.arange(7) + 0.02 * (np.arange(7) > int(rng.integers(0, 5)))
    strokes = np.concatenate([
        _STROKES[list(_GLYPHS[glyph])] * [*cell, *cell] + [x0, z - 0.038, x0, z - 0.038]
        for x0, glyph in zip(left, text, strict=True)
    ])  # fmt: skip
    u, v = strokes[:, [0, 2, 2, 0]] * sign, strokes[:, [1, 1, 3, 3]]
    characters = np.stack([np.full_like(u, x + sign * 0.014), u, v], axis=-1).reshape(-1, 3)
    faces = quads_to_triangles(np.arange(len(characters)).reshape(-1, 4))
    plate = block((0.012, 0.52, 0.112), (x + sign * 0.003, 0.0, z), ("matte", color))
    return [plate, Piece((characters, faces), *SEAM)]


_STROKES = np.array([  # left, bottom, right, top in a cell of width and height 1
    (0.0, 0.86, 1.0, 1.0), (0.0, 0.43, 1.0, 0.57), (0.0, 0.0, 1.0, 0.14), (0.0, 0.57, 0.24, 0.86),
    (0.76, 0.57, 1.0, 0.86), (0.0, 0.14, 0.24, 0.43), (0.76, 0.14, 1.0, 0.43),
])  # fmt: skip
"""Level ones from the top down, then the upper two and the lower two upright ones."""
_GLYPHS = {
    "0": (0, 2, 3, 4, 5, 6), "2": (0, 1, 2, 4, 5), "3": (0, 1, 2, 4, 6), "4": (1, 3, 4, 6),
    "5": (0, 1, 2, 3, 6), "6": (0, 1, 2, 3, 5, 6), "7": (0, 4, 6), "8": (0, 1, 2, 3, 4, 5, 6),
    "9": (0, 1, 2, 3, 4, 6), "A": (0, 1, 3, 4, 5, 6), "C": (0, 2, 3, 5), "E": (0, 1, 2, 3, 5),
    "F": (0, 1, 3, 5), "H": (1, 3, 4, 5, 6), "L": (2, 3, 5), "P": (0, 1, 3, 4, 5),
    "U": (2, 3, 4, 5, 6),
}  # fmt: skip


def front_end(
    d: Dresser, headlamp: LampPlace, grille: tuple[float, float, float], rng: Rng
) -> list[Piece]:
    """Headlamps, grille (half width, low, high in shares), intake below it, number plate."""
    half, low, high = grille[0] * d.half, grille[1] * d.height, grille[2] * d.height
    bars = int(rng.integers(1, 4))
    slot = (high - low) / (bars + 1)
    edges = low + slot * np.arange(1, bars + 1)[:, None] + [-0.009, 0.009]
    z = np.concatenate([[low], edges.ravel(), [high]])
    kind = (np.arange(len(z) - 1) % 2)[:, None]
    mouth = [(-0.5, -0.25), (0.5, -0.25), (0.62, -0.13), (-0.62, -0.13)] * np.array([d.half, 1.0])
    fog_lamp = rectangle((0.68 * d.half, 0.78 * d.half), (low - 0.2, low - 0.15))
    shut_line = np.stack([np.linspace(-0.8, 0.8, 9) * d.half, np.full(9, high + 0.022)], axis=1)
    badge = rectangle((-0.06, 0.06), (high - 0.8 * slot, high - 0.2 * slot))
    return [
        *both_sides([*lamp(d, "front", headlamp, WHITE_LAMP), d.patch("front", fog_lamp, PALE)]),
        *d.tiles("front", np.linspace(-half, half, 7), z, kind, (SEAM, ALLOY)),
        d.patch("front", quad_grid(mouth + np.array([0.0, low]), 3, 7), SEAM),
        d.seam("front", shut_line),
        Piece(d.body.draped("front", badge, 4 * LIFT_M), *ALLOY),
        *number_plate(d, "front", low - 0.06, PLATE_WHITE, rng),
    ]


def rear_end(d: Dresser, tail_lamp: LampPlace, rng: Rng) -> list[Piece]:
    """Tail lamps, boot seam, apron, and the number plate on the bumper or between the lamps."""
    low = float(d.outline.bottom_at(d.tail, 0.03))
    between = 0.5 * (tail_lamp.low + tail_lamp.high) * d.height - 0.04
    plate_z = between if rng.uniform() < 0.6 else max(low + 0.2, 0.42)
    plate = PLATE_YELLOW if rng.uniform() < 0.2 else PLATE_WHITE
    apron = rectangle((-0.6 * d.half, 0.6 * d.half), (low, low + 0.1), 2, 7)
    seam = np.stack([np.linspace(-0.7, 0.7, 7) * d.half, np.full(7, low + 0.29)], axis=1)
    return [
        *both_sides(lamp(d, "rear", tail_lamp, RED_LAMP)),
        d.patch("rear", apron, PLASTIC),
        d.seam("rear", seam),
        d.patch("rear", rectangle((-0.07, 0.07), (between + 0.1, between + 0.13)), ALLOY),
        *number_plate(d, "rear", plate_z, plate, rng),
    ]


# --- buses -----------------------------------------------------------------------------------


def between_arches(d: Dresser) -> list[Array]:
    """Abscissae of the side behind, between and in front of the arches."""
    edges = [d.tail + 0.25]
    for arch in sorted(d.outline.arches, key=lambda a: a.x):
        edges += [arch.x - arch.radius - 0.16, arch.x + arch.radius + 0.16]
    edges.append(d.nose - 0.25)
    return [np.linspace(a, b, 5) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def bus_door(d: Dresser, x: float) -> list[Piece]:
    """A folding door on the left with two panes, its front edge at ``x``."""
    low = float(d.outline.bottom_at(x)) + 0.1
    high = float(d.outline.rail_at(x)) - 0.06
    u = x - np.array([1.25, 1.18, 0.66, 0.6, 0.07, 0.0])
    z = np.array([low, low + 0.1, *np.linspace(low + 0.6, high - 0.6, 3), high - 0.06, high])
    kind = np.zeros((6, 5), dtype=np.int64)
    kind[1:-1, 1::2] = 1
    return d.tiles("left", u, z, kind, (PLASTIC, GLASS), lift=3 * LIFT_M)


def destination(d: Dresser, rng: Rng) -> list[Piece]:
    """The display over the windscreen: a word and a number in amber blocks."""
    z = np.array([0.855, 0.866, 0.914, 0.925]) * d.height
    kind = np.zeros((3, 33), dtype=np.int64)
    kind[1, 1::2] = rng.uniform(size=16) < 0.85
    kind[1, [1, 31]] = 1
    kind[1, 21:25] = 0  # the gap between word and number
    return d.tiles("front", np.linspace(-0.75, 0.75, 34), z, kind, (SEAM, AMBER_LAMP))


# --- trucks ----------------------------------------------------------------------------------


def cargo_box(x: Range, z: Range, width: float, colors: Sequence[Rgb], rng: Rng) -> list[Piece]:
    """A box body with posts and a livery on its sides, and two doors with rods at the rear."""
    (rear, front), (low, high) = x, z
    length, height = front - rear, high - low
    base, accent = (("matte", c) for c in colors)
    middle = ((rear + front) / 2, 0.0, (low + high) / 2)

    def on_side(x: float, z: float, dx: float, dz: float, finish: Finish) -> Piece:
        return block((dx, 0.02, dz), (x, width / 2 + 0.002, z), finish)

    left = [
        on_side(middle[0], z, length - 0.1, 0.09, STEEL_PAINT) for z in (low + 0.045, high - 0.045)
    ]
    posts = np.linspace(rear + 0.05, front - 0.05, 2 + round(length / 1.7))
    left += [on_side(x, middle[2], 0.035, height - 0.18, STEEL_PAINT) for x in posts]
    stripe_z = low + rng.uniform(0.25, 0.45) * height
    bays = zip(posts[:-1] + 0.02, posts[1:] - 0.02, strict=True)
    dz = rng.uniform(0.12, 0.3) * height
    left += [on_side((a + b) / 2, stripe_z, b - a, dz, accent) for a, b in bays]
    lettering = _lettering(front, low + 0.76 * height, length, height, rng)
    sides = both_sides(left) + [on_side(*letter, accent) for letter in lettering]
    sides += on_right(on_side(*_mirror_text(letter, middle[0]), accent) for letter in lettering)
    return [block((length, width, height), middle, base), *sides, *_rear_doors(rear, z, width)]


def _lettering(
    front: float, z: float, length: float, height: float, rng: Rng
) -> list[tuple[float, float, float, float]]:
    """Blocks (x, z, dx, dz) for the letters of a name, from the front backwards."""
    x = front - rng.uniform(0.1, 0.25) * length
    blocks = []
    for _ in range(int(rng.integers(4, 9))):
        dx = rng.uniform(0.035, 0.06) * length
        blocks.append((x - dx / 2, z, 0.8 * dx, rng.uniform(0.1, 0.16) * height))
        x -= dx
    return blocks


def _mirror_text(
    letter: tuple[float, float, float, float], middle: float
) -> tuple[float, float, float, float]:
    """The same letter read from the other side."""
    return (2 * middle - letter[0], *letter[1:])


def _rear_doors(x: float, z: Range, width: float) -> list[Piece]:
    low, high = z
    seams = [
        block((0.02, 0.025, high - low - 0.1), (x, y, (low + high) / 2), SEAM)
        for y in (0.06 - width / 2, 0.0, width / 2 - 0.06)
    ]
    ends = np.array([[x - 0.03, 0.0, low + 0.05], [x - 0.03, 0.0, high - 0.05]])
    rods = [rod(np.add(ends, (0, share * width, 0)), 0.018) for share in (-0.35, -0.1, 0.1, 0.35)]
    return seams + rods


def tail_board(rear: float, width: float, z: float, rng: Rng) -> list[Piece]:
    """Underrun bar, lamps and number plate below the rear of a box."""
    y = width / 2 - 0.25
    left = [
        block((0.06, 0.42, 0.16), (rear + 0.04, y, z), PLASTIC),
        block((0.03, 0.2, 0.11), (rear + 0.01, y + 0.09, z), RED_LAMP),
        block((0.03, 0.12, 0.11), (rear + 0.01, y - 0.09, z), AMBER_LAMP),
        rod([(rear + 0.1, 0.3 * width, z), (rear + 0.1, 0.3 * width, z + 0.35)], 0.05),
    ]
    bar = block((0.08, 0.94 * width, 0.12), (rear + 0.1, 0, z - 0.1), STEEL)
    plate = PLATE_YELLOW if rng.uniform() < 0.2 else PLATE_WHITE
    return [*both_sides(left), bar, *plate_at(rear, z + 0.02, -1, plate, rng)]


def chassis(x: Range, z: float) -> Piece:
    """The rails between cab and tail, their upper side at ``z``."""
    return block((x[1] - x[0], 0.9, 0.3), ((x[0] + x[1]) / 2, 0.0, z - 0.15), PLASTIC)


def side_guards(x: Range, width: float) -> list[Piece]:
    """Two rails along each side, between the axles, on posts."""
    y = width / 2 - 0.08
    rails = [rod([(x[0], y, z), (x[1], y, z)], 0.05) for z in (0.55, 0.82)]
    posts = [rod([(at, y, 0.55), (at, y, 1.15)], 0.04) for at in np.linspace(*x, 3)]
    return both_sides(rails + posts)
