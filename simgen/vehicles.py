"""Road vehicles: cars, vans, trucks, buses and motorcycles drawn from families of proportions.

A family gives its body as curves in shares of length and height, so that one silhouette serves
every size. A vehicle is assembled from *pieces* (mesh, material, colour), which are merged to one
part per material. Frame, units and winding: see mesh.py; the shells and draping: bodyshell.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from simgen.bodyshell import (
    LIFT_M,
    Arch,
    Array,
    Direction,
    Mesh,
    Outline,
    Shell,
    band_grid,
    disc,
    joined,
    lathe,
    mirrored,
    moved,
    quad_grid,
    sheet,
    shell,
)
from simgen.mesh import Model, box, part, tube
from simgen.schema import LABELS

Range = tuple[float, float]
Curve = tuple[tuple[float, float], ...]
Rgb = tuple[float, float, float]
Rng = np.random.Generator


@dataclass(frozen=True)
class Vehicle:
    """A model and its outer size without mirrors [m]."""

    model: Model
    length: float
    width: float
    height: float
    family: str


class Size(NamedTuple):
    """Outer size without mirrors [m]."""

    length: float
    width: float
    height: float


class Piece(NamedTuple):
    """A mesh of one colour."""

    mesh: Mesh
    material: str
    color: Rgb


@dataclass(frozen=True)
class Family:
    """Proportions of a kind of vehicle. Positions along it are shares from nose (0) to tail (1)."""

    assemble: Callable[[Family, Rng], tuple[Model, Size]]
    semantic: int
    share: float
    """of traffic"""
    length_m: Range
    width_m: Range
    height_m: Range
    axles: tuple[float, float]
    """front and rear axle: the wheelbase is their difference"""
    wheel_radius_m: Range
    top: Curve = ()
    """silhouette of the body (of the cab, if there is one): (share of length, share of height)"""
    bottom: Curve = ()
    belt: Curve = ()
    windscreen: Range = (0.0, 0.0)
    """cowl and header"""
    rear_window: Range = (0.0, 0.0)
    """upper and lower edge"""
    panes: tuple[float, ...] = ()
    """pillars that bound the side windows"""
    doors: tuple[float, ...] = ()
    """seams of the side doors"""
    headlamp: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """share of half the width, from and to; share of the height, from and to"""
    tail_lamp: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    grille: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """share of half the width; share of the height, from and to"""
    pane_lean_m: float = 0.0
    """how far the upper corner of the last pane leans forward"""
    cladding_m: float = 0.05
    tumblehome: float = 0.16
    corner_m: float = 0.2
    crown_m: float = 0.07
    bow_m: Range = (0.16, 0.1)
    cab_m: float = 0.0
    """length of the cab of a truck"""


# Paints by their share of new cars, linear albedo.
PAINTS: tuple[tuple[float, Rgb], ...] = (
    (0.25, (0.70, 0.70, 0.68)),  # white
    (0.20, (0.018, 0.018, 0.020)),  # black
    (0.21, (0.12, 0.125, 0.13)),  # grey
    (0.12, (0.42, 0.43, 0.44)),  # silver
    (0.09, (0.02, 0.06, 0.20)),  # blue
    (0.05, (0.33, 0.02, 0.02)),  # red
    (0.03, (0.02, 0.08, 0.05)),  # green
    (0.03, (0.20, 0.15, 0.10)),  # beige, brown
    (0.02, (0.50, 0.30, 0.02)),  # yellow, orange
)
GLASS: Rgb = (0.03, 0.032, 0.034)
RUBBER: Rgb = (0.025, 0.025, 0.026)
PLASTIC: Rgb = (0.03, 0.03, 0.032)
SEAM: Rgb = (0.012, 0.012, 0.012)
ALLOY: Rgb = (0.55, 0.56, 0.58)
STEEL: Rgb = (0.20, 0.20, 0.21)
WHITE_LAMP: Rgb = (0.72, 0.72, 0.70)
RED_LAMP: Rgb = (0.35, 0.01, 0.01)
AMBER_LAMP: Rgb = (0.55, 0.20, 0.01)
PLATES: tuple[Rgb, ...] = ((0.70, 0.70, 0.68), (0.62, 0.45, 0.03))
FLEET: tuple[Rgb, ...] = (
    (0.70, 0.70, 0.68), (0.35, 0.02, 0.02), (0.03, 0.08, 0.30), (0.02, 0.16, 0.07),
    (0.60, 0.33, 0.02), (0.10, 0.11, 0.12), (0.03, 0.28, 0.36),
)  # fmt: skip


def build(family: str, *, rng: Rng) -> Vehicle:
    """A vehicle of a family of FAMILIES: size, colours and details drawn by ``rng``.

    Raises:
        ValueError: no such family.
    """
    if family not in FAMILIES:
        raise ValueError(f"vehicle family {family!r} is unknown; expected one of {list(FAMILIES)}")
    model, size = FAMILIES[family].assemble(FAMILIES[family], rng)
    return Vehicle(model, *size, family)


def draw_family(*, rng: Rng, mix: dict[str, float] | None = None) -> str:
    """A family name, by its share of traffic or by the weights of ``mix``.

    Raises:
        ValueError: an unknown family, a negative weight, or weights that sum to 0.
    """
    weights = {k: f.share for k, f in FAMILIES.items()} if mix is None else mix
    unknown = weights.keys() - FAMILIES.keys()
    if unknown:
        raise ValueError(f"mix: unknown families {sorted(unknown)}; expected {list(FAMILIES)}")
    total = sum(weights.values())
    if total <= 0 or min(weights.values()) < 0:
        raise ValueError(f"mix: weights must be >= 0 and not all 0, got {weights}")
    names = list(weights)
    return names[rng.choice(len(names), p=[weights[n] / total for n in names])]


def draw_paint(*, rng: Rng) -> Rgb:
    """A car colour with the frequencies of PAINTS, each a little varied."""
    shares = np.array([share for share, _ in PAINTS])
    color = PAINTS[rng.choice(len(PAINTS), p=shares / shares.sum())][1]
    return _varied(color, rng)


def _varied(color: Rgb, rng: Rng) -> Rgb:
    r, g, b = np.clip(np.array(color) * rng.uniform(0.8, 1.15) * rng.uniform(0.93, 1.07, 3), 0, 0.8)
    return float(r), float(g), float(b)


def _uniform(limits: Range, rng: Rng) -> float:
    return float(rng.uniform(*limits))


def _model(pieces: Iterable[Piece], semantic: int) -> Model:
    """One part per material."""
    by_material: dict[str, list[Piece]] = {}
    for piece in pieces:
        by_material.setdefault(piece.material, []).append(piece)
    return [
        part(
            *joined([p.mesh for p in group]),
            material,
            semantic,
            color=np.concatenate([np.tile(p.color, (len(p.mesh[0]), 1)) for p in group]),
        )
        for material, group in by_material.items()
    ]


def _both_sides(pieces: Iterable[Piece]) -> list[Piece]:
    """Pieces of the left side, and their mirror images."""
    left = list(pieces)
    return left + [p._replace(mesh=mirrored(p.mesh)) for p in left]


def _block(size: ArrayLike, center: ArrayLike, color: Rgb, material: str = "matte") -> Piece:
    return Piece(box(size, center), material, color)


def _bar(path: ArrayLike, radius: float, color: Rgb, material: str = "metal") -> Piece:
    return Piece(tube(path, radius, sides=6), material, color)


def _wheel(radius: float, width: float, *, alloy: bool, spokes: int) -> list[Piece]:
    """A wheel about the y axis through the origin, its outer side at y = 0.

    Alloy wheels have spokes in front of a dark hollow, steel ones a disc with a hub.
    """
    rim, sides = 0.68 * radius, 16
    profile = [(-width, 0.9 * radius), (-0.9 * width, radius), (-0.03, radius)]
    profile += [(-0.004, 0.93 * radius), (0.0, rim)]
    pieces = [
        Piece(lathe(profile, sides), "matte", RUBBER),
        Piece(lathe([(0.0, rim), (0.006, 0.92 * rim)], sides), "metal", ALLOY),
    ]
    if not alloy:
        hub = lathe([(-0.02, 0.4 * rim), (0.0, 0.3 * rim)], 10)
        return [
            *pieces,
            Piece(disc(-0.02, 0.92 * rim, sides), "metal", STEEL),
            Piece(joined([hub, disc(0.0, 0.3 * rim, 10)]), "matte", PLASTIC),
        ]
    spoke = np.array([(-0.15, 0.1), (-0.12, 0.95), (0.12, 0.95), (0.15, 0.1)]) * rim
    star = [_turned_quad(spoke, angle) for angle in np.arange(spokes) * 2 * np.pi / spokes]
    return [
        *pieces,
        Piece(disc(-0.06, 0.97 * rim, sides), "matte", SEAM),
        Piece(joined([*star, disc(-0.005, 0.22 * rim, 8)]), "metal", ALLOY),
    ]


def _turned_quad(corners: Array, angle: float) -> Mesh:
    """A quad (4, 2) of (x, z) that faces +y, turned about the axle."""
    c, s = np.cos(angle), np.sin(angle)
    x, z = corners[:, 0] * c + corners[:, 1] * s, -corners[:, 0] * s + corners[:, 1] * c
    y = -0.018 + 0.012 * (np.hypot(x, z) < 0.3 * np.hypot(*corners[1]))
    return np.stack([x, y, z], axis=1), np.array([[0, 1, 2], [0, 2, 3]])


def _axle(x: float, half_width: float, wheel: list[Piece], radius: float) -> list[Piece]:
    """Two wheels that stand on the ground with their outer sides at ±``half_width``."""
    at = (x, half_width, radius)
    return _both_sides(p._replace(mesh=moved(p.mesh, at)) for p in wheel)


class _Dresser:
    """Drapes pieces on a shell; positions are (x, z) or (y, z) in metres."""

    def __init__(self, body: Shell) -> None:
        self.body, self.outline = body, body.outline
        self.tail, self.nose = body.outline.span

    def x(self, share: float) -> float:
        """x of a share of the length, from nose (0) to tail (1)."""
        return self.nose + share * (self.tail - self.nose)

    def patch(
        self, direction: Direction, grid: Array, material: str, color: Rgb, layer: int = 1
    ) -> Piece:
        """A patch over a grid; a higher layer lies on top of a lower one."""
        return Piece(self.body.draped(direction, grid, layer * LIFT_M), material, color)

    def seam(self, direction: Direction, path: ArrayLike, width: float = 0.011) -> Piece:
        """A dark line along a path (N, 2)."""
        p = np.asarray(path, dtype=np.float64)
        along = np.gradient(p, axis=0)
        across = np.stack([along[:, 1], -along[:, 0]], axis=1)
        across *= width / 2 / np.linalg.norm(across, axis=1, keepdims=True)
        return self.patch(direction, np.stack([p - across, p + across], axis=1), "matte", SEAM)

    def surface_x(self, direction: Direction, y: float, z: float) -> float:
        """The outermost x of nose or tail around y, at the height of a number plate there."""
        grid = _rectangle(y - 0.26, y + 0.26, z - 0.06, z + 0.06, 3, 3)
        x = self.body.draped(direction, grid)[0][:, 0]
        return float(x.max() if direction == "front" else x.min())


def _rectangle(
    u0: float, u1: float, z0: float, z1: float, rows: int = 2, columns: int = 2
) -> Array:
    return quad_grid([(u0, z0), (u1, z0), (u1, z1), (u0, z1)], rows, columns)


def _outline(family: Family, size: Size, rng: Rng) -> Outline:
    """The family's curves at a size: over the whole length, or over the cab if there is one."""
    length, width, height = size
    front, body = length / 2, family.cab_m or length
    nose, tail = front - family.bow_m[0], front - body + family.bow_m[1]

    def curve(points: Curve) -> Array:
        return np.array([(nose + f * (tail - nose), z * height) for f, z in reversed(points)])

    top = curve(family.top)
    top[1:-1, 1] *= rng.uniform(0.985, 1.0, len(top) - 2)
    radius = _uniform(family.wheel_radius_m, rng)
    axles = [front - f * length for f in family.axles]
    return Outline(
        top=top,
        bottom=curve(family.bottom),
        belt=curve(family.belt),
        width=width,
        arches=tuple(Arch(x, radius, radius + 0.05) for x in axles if x > tail),
        cladding=family.cladding_m,
        tumblehome=family.tumblehome,
        corner=family.corner_m,
        bow=family.bow_m,
        crown=family.crown_m,
    )


def _size(family: Family, rng: Rng) -> Size:
    """A size: a long one of its kind is wide and tall, too."""
    t = np.clip(rng.uniform() + rng.normal(0, 0.15, 3), 0, 1)
    limits = (family.length_m, family.width_m, family.height_m)
    return Size(*(float(lo + u * (hi - lo)) for u, (lo, hi) in zip(t, limits, strict=True)))


def _skin(body: Shell, paint: Rgb, cladding: Rgb) -> list[Piece]:
    """The shell itself, and a dark block that closes the view between the wheel arches."""
    outline = body.outline
    (tail, nose), low = outline.span, float(outline.bottom[:, 1].min())
    size = (0.96 * (nose - tail), outline.width - 0.56, 0.3)
    return [
        Piece(body.painted, "paint", paint),
        Piece(body.cladding, "matte", cladding),
        Piece(body.underside, "matte", SEAM),
        _block(size, ((nose + tail) / 2, 0.0, low + 0.17), SEAM),
    ]


def _end_window(d: _Dresser, direction: Direction, low_x: float, high_x: float) -> Piece:
    """Windscreen or rear window between its lower and its upper edge."""
    o = d.outline
    low = float(o.top_at(low_x)) + 0.03
    high = min(float(o.rail_at(high_x)), float(o.top_at(high_x)) - 0.05)
    half_low = float(o.half_width_at(low_x, low)) - 0.1
    half_high = float(o.half_width_at(high_x, high)) - 0.1
    corners = [(-half_low, low), (half_low, low), (half_high, high), (-half_high, high)]
    return d.patch(direction, quad_grid(corners, 5, 9), "glass", GLASS)


def _side_windows(
    d: _Dresser, pillars: tuple[float, ...], *, sill: float = 0.03, lean: float = 0.0
) -> list[Piece]:
    """Left panes between pillars, as high as the side allows, and dark posts between them."""
    o = d.outline

    def band(x: Array) -> Array:
        return band_grid(x, o.belt_at(x) + sill, o.rail_at(x) - 0.035, rows=4)

    pieces = []
    for front, rear in pairwise(pillars):
        x = np.linspace(d.x(rear) + 0.025, d.x(front) - 0.025, 24)
        x = x[o.rail_at(x) - o.belt_at(x) > sill + 0.075]
        pane = band(np.linspace(x[0], x[-1], 6))
        if rear == pillars[-1]:
            pane[..., 0] += lean * np.linspace(0, 1, 4)[:, None] * np.linspace(1, 0, 6)
        pieces.append(d.patch("left", pane, "glass", GLASS))
    for post in pillars[1:-1]:
        pieces.append(d.patch("left", band(d.x(post) + np.array([-0.025, 0.025])), "matte", SEAM))
    return pieces


def _side_doors(d: _Dresser, seams: tuple[float, ...], paint: Rgb) -> list[Piece]:
    """Left seams from the belt to the lower edge, and a handle before each but the first."""
    o = d.outline
    pieces = []
    for share in seams:
        x = d.x(share)
        z = np.linspace(float(o.bottom_at(x, o.cladding)) + 0.02, float(o.belt_at(x)) - 0.01, 6)
        pieces.append(d.seam("left", np.stack([np.full(6, x), z], axis=1)))
    for share in seams[1:]:
        x, z = d.x(share) + 0.13, float(o.belt_at(d.x(share))) - 0.09
        y = float(o.half_width_at(x, z))
        pieces.append(_block((0.17, 0.05, 0.028), (x, y, z), paint, "paint"))
    return pieces


def _mirror(d: _Dresser, x: float, z: float, size: float, color: Rgb) -> list[Piece]:
    """An outside mirror on the left."""
    y = float(d.outline.half_width_at(x, z))
    profile = [(-0.05, 0.2), (0.0, 0.45), (0.3, 0.62), (1.0, 0.6), (1.25, 0.4), (1.3, 0.05)]
    vertices, faces = lathe(np.array(profile) * size, 7)
    housing = (vertices * [0.75, 1.0, 1.0] + [x, y, z + 0.4 * size], faces)
    glass_at = (x - 0.43 * size, y + 0.68 * size, z + 0.4 * size)
    return [
        Piece(housing, "paint", color),
        _block((0.02, 0.85 * size, 0.75 * size), glass_at, GLASS, "glass"),
    ]


def _plate(x: float, y: float, z: float, sign: float, color: Rgb, rng: Rng) -> list[Piece]:
    """A number plate with blocks for characters; it faces +x or -x by ``sign``."""
    plate = _block((0.012, 0.52, 0.112), (x + sign * 0.002, y, z), color)
    step, blank = 0.46 / 8, int(rng.integers(2, 6))
    half = rng.uniform(0.45, 0.75, 8) * step / 2
    at = x + sign * 0.013
    characters = [
        quad_grid([(c - h, z - 0.038), (c + h, z - 0.038), (c + h, z + 0.038), (c - h, z + 0.038)])
        for k, (c, h) in enumerate(zip(y + (np.arange(8) - 3.5) * step, half, strict=True))
        if k != blank
    ]
    flat = [sheet(np.insert(c, 0, at, axis=2)[:, :: int(sign)]) for c in characters]
    return [plate, Piece(joined(flat), "matte", SEAM)]


def _lamp(
    d: _Dresser, direction: Direction, ranges: tuple[float, float, float, float], color: Rgb,
    *, core: Range, height: float,
) -> list[Piece]:  # fmt: skip
    """A left lamp: a dark housing and the bright part of it, ``core`` being its share of width."""
    half = d.outline.width / 2
    y0, y1, z0, z1 = ranges
    y0, y1, z0, z1 = y0 * half, y1 * half, z0 * height, z1 * height
    housing = _rectangle(y0, y1, z0, z1, 3, 5)
    c0, c1 = (y0 + c * (y1 - y0) for c in core)
    inset = 0.16 * (z1 - z0)
    bright = _rectangle(c0, c1, z0 + inset, z1 - inset, 3, 4)
    return [
        d.patch(direction, housing, "glass", GLASS),
        d.patch(direction, bright, "lamp", color, layer=2),
    ]


def _face(d: _Dresser, family: Family, height: float, rng: Rng) -> list[Piece]:
    """Grille, intake, headlamps, indicators, badge and front number plate."""
    half = d.outline.width / 2
    width, z0, z1 = family.grille[0] * half, family.grille[1] * height, family.grille[2] * height
    pieces = [d.patch("front", _rectangle(-width, width, z0, z1, 3, 7), "matte", SEAM)]
    for z in np.linspace(z0, z1, int(rng.integers(3, 6)))[1:-1]:
        bar = _rectangle(-0.95 * width, 0.95 * width, z - 0.008, z + 0.008, 2, 7)
        pieces.append(d.patch("front", bar, "metal", STEEL, layer=2))
    intake_z = family.grille[1] * height - np.array([0.24, 0.13])
    intake = _rectangle(-0.55 * half, 0.55 * half, *intake_z, 3, 7)
    pieces.append(d.patch("front", intake, "matte", PLASTIC))
    lamp = family.headlamp
    pieces += _both_sides(
        _lamp(d, "front", lamp, WHITE_LAMP, core=(0.2, 0.75), height=height)
        + _lamp(d, "front", (lamp[1] - 0.08, lamp[1], lamp[2], lamp[2] + 0.02), AMBER_LAMP,
                core=(0.0, 0.9), height=height)[1:]
    )  # fmt: skip
    z = z0 - 0.06
    pieces += _plate(d.surface_x("front", 0.0, z), 0.0, z, 1.0, PLATES[0], rng)
    return pieces


def _back(d: _Dresser, family: Family, height: float, rng: Rng) -> list[Piece]:
    """Tail lamps, boot seam, lower bumper and rear number plate."""
    half = d.outline.width / 2
    lamp = family.tail_lamp
    low = float(d.outline.bottom_at(d.tail, 0.03))
    plate_z = float(rng.choice([max(low + 0.2, 0.42), 0.5 * (lamp[2] + lamp[3]) * height - 0.04]))
    plate = PLATES[int(rng.uniform() < 0.2)]
    apron = _rectangle(-0.6 * half, 0.6 * half, low, low + 0.1, 3, 7)
    seam_y, seam_z = np.linspace(-0.7 * half, 0.7 * half, 7), low + 0.29
    return [
        *_both_sides(_lamp(d, "rear", lamp, RED_LAMP, core=(0.08, 0.95), height=height)),
        d.patch("rear", apron, "matte", PLASTIC),
        d.seam("rear", np.stack([seam_y, np.full(7, seam_z)], axis=1)),
        *_plate(d.surface_x("rear", 0.0, plate_z), 0.0, plate_z, -1.0, plate, rng),
    ]


def _arch_wheels(outline: Outline, rng: Rng, *, alloy: bool, width: float = 0.22) -> list[Piece]:
    """Wheels below all arches of a body."""
    spokes = int(rng.choice([5, 5, 6, 7, 10]))
    pieces = []
    for arch in outline.arches:
        wheel = _wheel(arch.z, width, alloy=alloy, spokes=spokes)
        pieces += _axle(arch.x, outline.width / 2 - 0.03, wheel, arch.z)
    return pieces


def _car(family: Family, rng: Rng) -> tuple[Model, Size]:
    """Cars and vans."""
    size = _size(family, rng)
    outline = _outline(family, size, rng)
    d = _Dresser(shell(outline))
    paint = draw_paint(rng=rng)
    trim = PLASTIC if rng.uniform() < 0.6 or family.cladding_m > 0.06 else paint
    mirror_x = d.x(family.panes[0]) - 0.02
    left = [
        *_side_windows(d, family.panes, lean=family.pane_lean_m),
        *_side_doors(d, family.doors, paint),
        *_mirror(d, mirror_x, float(outline.belt_at(mirror_x)) + 0.03, 0.17, paint),
    ]
    pieces = [
        *_skin(d.body, paint, trim),
        _end_window(d, "front", *(d.x(f) for f in family.windscreen)),
        _end_window(d, "rear", *(d.x(f) for f in family.rear_window[::-1])),
        *_both_sides(left),
        *_face(d, family, size.height, rng),
        *_back(d, family, size.height, rng),
        *_arch_wheels(outline, rng, alloy=bool(rng.uniform() < 0.8)),
    ]
    return _model(pieces, family.semantic), size


def _bus(family: Family, rng: Rng) -> tuple[Model, Size]:
    """A city bus; its doors are on the right."""
    size = _size(family, rng)
    outline = _outline(family, size, rng)
    d = _Dresser(shell(outline))
    paint, accent = _fleet_colors(rng)
    half, height = size.width / 2, size.height
    doors = [d.x(f) for f in family.doors]
    panes = d.x(0.02) - np.cumsum([0.0, *np.full(7, 0.93 * size.length / 7)])
    shares = tuple(float((d.nose - x) / (d.nose - d.tail)) for x in panes)
    skirt = [
        d.patch("left", band_grid(x, outline.bottom_at(x, 0.12), 0.36 * height), "paint", accent)
        for x in _between_arches(d)
    ]
    pieces = [
        *_skin(d.body, paint, PLASTIC),
        *_both_sides(_side_windows(d, shares, sill=0.02) + skirt),
        *(p._replace(mesh=mirrored(p.mesh)) for x in doors for p in _bus_door(d, x)),
        d.patch("front", _rectangle(-0.86 * half, 0.86 * half, 0.36 * height, 0.83 * height, 7, 13),
                "glass", GLASS),
        *_destination(d, height, rng),
        d.patch("rear", _rectangle(-0.7 * half, 0.7 * half, 0.58 * height, 0.82 * height, 4, 7),
                "glass", GLASS),
        d.patch("rear", _rectangle(-0.7 * half, 0.7 * half, 0.24 * height, 0.42 * height, 3, 7),
                "matte", SEAM),
        *_face(d, family, height, rng),
        *_back(d, family, height, rng),
        *_both_sides(_mirror(d, d.nose - 0.1, 0.72 * height, 0.24, PLASTIC)),
        *_arch_wheels(outline, rng, alloy=False, width=0.3),
    ]  # fmt: skip
    return _model(pieces, family.semantic), size


def _between_arches(d: _Dresser) -> list[Array]:
    """Abscissae of the side in front of, between and behind the arches."""
    edges = [d.tail + 0.25]
    for arch in sorted(d.outline.arches, key=lambda a: a.x):
        edges += [arch.x - arch.radius - 0.16, arch.x + arch.radius + 0.16]
    edges.append(d.nose - 0.25)
    return [np.linspace(a, b, 5) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _bus_door(d: _Dresser, x: float) -> list[Piece]:
    """A folding door with two panes, drawn on the left side, its front edge at ``x``."""
    low = float(d.outline.bottom_at(x)) + 0.1
    high = float(d.outline.rail_at(x)) - 0.06
    frame = _rectangle(x - 1.25, x, low, high, 7, 4)
    panes = [_rectangle(x - b, x - a, low + 0.1, high - 0.05, 7, 3)
             for a, b in ((0.06, 0.6), (0.65, 1.19))]  # fmt: skip
    return [
        d.patch("left", frame, "matte", PLASTIC, layer=2),
        *(d.patch("left", pane, "glass", GLASS, layer=3) for pane in panes),
    ]


def _destination(d: _Dresser, height: float, rng: Rng) -> list[Piece]:
    """The display over the windscreen: a word and a number in amber blocks."""
    low, high = 0.86 * height, 0.92 * height
    edges = np.linspace(-0.7, 0.7, 31)
    (vertices, faces) = d.body.draped("front", band_grid(edges, low + 0.03, high - 0.03, 2), 0.02)
    lit = (np.arange(30) % 2 == 0) & (rng.uniform(size=30) < 0.85)
    lit[20:24] = False  # a gap between word and number
    return [
        d.patch("front", _rectangle(-0.8, 0.8, low, high, 3, 13), "matte", SEAM),
        Piece((vertices, faces[np.tile(lit, 2)]), "lamp", AMBER_LAMP),
    ]


def _fleet_colors(rng: Rng) -> tuple[Rgb, Rgb]:
    """Two different colours of a haulier or an operator."""
    first, second = rng.choice(len(FLEET), 2, replace=False, p=[0.4, *[0.1] * 6])
    return _varied(FLEET[first], rng), _varied(FLEET[second], rng)


def _cab(family: Family, size: Size, paint: Rgb, rng: Rng) -> tuple[_Dresser, list[Piece]]:
    """The cab of a truck with its front wheels."""
    outline = _outline(family, size, rng)
    d = _Dresser(shell(outline))
    roof = float(outline.top[:, 1].max())
    left = [
        *_side_windows(d, family.panes),
        *_side_doors(d, family.doors, paint),
        *_mirror(d, d.nose - 0.25, 0.7 * roof, 0.26, PLASTIC),
    ]
    pieces = [
        *_skin(d.body, paint, PLASTIC),
        _end_window(d, "front", *(d.x(f) for f in family.windscreen)),
        *_both_sides(left),
        *_face(d, family, size.height, rng),
        *_arch_wheels(outline, rng, alloy=False, width=0.3),
    ]
    return d, pieces


def _cargo_box(
    front: float, rear: float, width: float, low: float, high: float, rng: Rng
) -> list[Piece]:
    """A box body with posts, a livery on its sides, and two doors at the rear."""
    base, accent = _fleet_colors(rng)
    length, middle = front - rear, (front + rear) / 2
    face, height = width / 2 + 0.004, high - low
    pieces = [_block((length, width, height), (middle, 0, (low + high) / 2), base)]

    def on_side(x: float, z: float, dx: float, dz: float, color: Rgb) -> Piece:
        return _block((dx, 0.02, dz), (x, face, z), color)

    posts = np.linspace(rear + 0.05, front - 0.05, 2 + round(length / 1.7))
    left = [on_side(x, (low + high) / 2, 0.03, height, STEEL) for x in posts]
    left += [on_side(middle, z, length, 0.09, STEEL) for z in (low + 0.045, high - 0.045)]
    stripe = rng.uniform(0.12, 0.35) * height
    left.append(on_side(middle, low + rng.uniform(0.25, 0.5) * height, length - 0.2, stripe, accent))
    z, x = low + 0.76 * height, front - rng.uniform(0.1, 0.25) * length
    for _ in range(int(rng.integers(4, 9))):  # the letters of a name
        dx = rng.uniform(0.035, 0.06) * length
        left.append(on_side(x - dx / 2, z, dx * 0.8, rng.uniform(0.1, 0.16) * height, accent))
        x -= dx
    seams = [_block((0.02, 0.025, height - 0.1), (rear, y, (low + high) / 2), SEAM)
             for y in (-width / 2 + 0.06, 0.0, width / 2 - 0.06)]  # fmt: skip
    rods = [_bar([(rear - 0.03, y, low + 0.05), (rear - 0.03, y, high - 0.05)], 0.018, STEEL)
            for y in (-0.35 * width, -0.1 * width, 0.1 * width, 0.35 * width)]  # fmt: skip
    return [*pieces, *_both_sides(left), *seams, *rods]


def _tail_board(rear: float, width: float, z: float, rng: Rng) -> list[Piece]:
    """Underrun bar, lamps and number plate below the rear of a box."""
    lamp_at = (rear + 0.04, width / 2 - 0.25, z)
    left = [
        _block((0.06, 0.42, 0.16), lamp_at, PLASTIC),
        _block((0.03, 0.2, 0.11), np.add(lamp_at, (-0.03, 0.09, 0)), RED_LAMP, "lamp"),
        _block((0.03, 0.12, 0.11), np.add(lamp_at, (-0.03, -0.09, 0)), AMBER_LAMP, "lamp"),
        _bar([(rear + 0.1, 0.3 * width, z), (rear + 0.1, 0.3 * width, z + 0.35)], 0.05, STEEL),
    ]
    bar = _block((0.08, 0.94 * width, 0.12), (rear + 0.1, 0, z - 0.1), STEEL, "metal")
    plate = _plate(rear, 0.0, z + 0.02, -1.0, PLATES[int(rng.uniform() < 0.2)], rng)
    return [*_both_sides(left), bar, *plate]


def _frame(front: float, rear: float, width: float, z: float) -> list[Piece]:
    """Chassis rails, and the guards and tanks along the left and right between the axles."""
    rails = _block((front - rear, 0.9, 0.28), ((front + rear) / 2, 0, z), PLASTIC)
    return [rails, *_both_sides(
        _bar([(front - 0.5, width / 2 - 0.08, h), (rear + 0.5, width / 2 - 0.08, h)], 0.05, STEEL)
        for h in (0.55, 0.82)
    )]  # fmt: skip


def _twin_axle(x: float, width: float, radius: float) -> list[Piece]:
    """A driven or trailed axle with a mudguard."""
    angle = np.deg2rad(np.linspace(15, 165, 8))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (radius + 0.07) + [x, radius]
    across = np.array([width / 2 - 0.02, width / 2 - 0.55])
    guard = np.stack([np.insert(arc, 1, y, axis=1) for y in across], axis=0)
    wheel = _wheel(radius, 0.5, alloy=False, spokes=0)
    return [
        *_both_sides([Piece(sheet(guard), "matte", PLASTIC)]),
        *_axle(x, width / 2 - 0.04, wheel, radius),
    ]


def _box_truck(family: Family, rng: Rng) -> tuple[Model, Size]:
    """A rigid truck: cab, chassis, box."""
    size = _size(family, rng)
    cab_paint = _fleet_colors(rng)[0]
    d, pieces = _cab(family, size, cab_paint, rng)
    rear, floor, radius = -size.length / 2, 0.32 * size.height, d.outline.arches[0].z
    axle = size.length * (0.5 - family.axles[1])
    pieces += [
        *_cargo_box(d.tail - 0.12, rear + 0.06, size.width, floor, size.height, rng),
        *_frame(d.tail, rear + 0.2, size.width, floor - 0.16),
        *_frame(d.tail - 0.3, axle + 0.3, size.width, floor - 0.16)[1:],
        *_twin_axle(axle, size.width, radius),
        *_tail_board(rear + 0.06, size.width, floor - 0.35, rng),
    ]
    return _model(pieces, family.semantic), size


def _semi_trailer(family: Family, rng: Rng) -> tuple[Model, Size]:
    """A tractor (truck) and its three-axle trailer (trailer)."""
    size = _size(family, rng)
    d, tractor = _cab(family, size, _fleet_colors(rng)[0], rng)
    front, rear, floor = size.length / 2, -size.length / 2, 1.2
    radius = d.outline.arches[0].z
    drive = front - family.axles[1] * size.length
    tractor += [
        *_frame(d.tail + 0.3, drive - 0.9, size.width, 0.85)[:1],
        *_twin_axle(drive, size.width, radius),
        *_both_sides([Piece(lathe([(-0.3, 0.3), (0.3, 0.3)], 10), "metal", STEEL)][:0]),
    ]
    trailer = [
        *_cargo_box(d.tail - 0.55, rear + 0.06, size.width, floor, size.height, rng),
        *_frame(drive - 1.2, rear + 0.2, size.width, floor - 0.16)[:1],
        *_frame(drive - 1.6, rear + 5.4, size.width, floor)[1:],
        *(p for x in (1.9, 3.2, 4.5) for p in _twin_axle(rear + x, size.width, radius)),
        *_both_sides([_bar([(drive - 2, 0.8, 0.3), (drive - 2, 0.8, floor)], 0.06, STEEL)]),
        *_tail_board(rear + 0.06, size.width, 0.75, rng),
    ]
    return _model(tractor, family.semantic) + _model(trailer, LABELS["trailer"]), size


def _motorcycle(family: Family, rng: Rng) -> tuple[Model, Size]:
    """A motorcycle that leans on its stand."""
    size = _size(family, rng)
    radius = _uniform(family.wheel_radius_m, rng)
    front, rear = (size.length * (0.5 - f) for f in family.axles)
    pieces = [*_motorcycle_wheel(front, radius, 0.12), *_motorcycle_wheel(rear, radius, 0.17)]
    pieces += _motorcycle_frame(front, rear, radius, size, draw_paint(rng=rng), rng)
    lean = np.deg2rad(rng.uniform(7, 11))
    c, s = np.cos(lean), np.sin(lean)
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    leaning = [p._replace(mesh=(p.mesh[0] @ R.T, p.mesh[1])) for p in pieces]
    low = min(float(p.mesh[0][:, 2].min()) for p in leaning)
    pieces = [p._replace(mesh=moved(p.mesh, (0, 0, -low))) for p in leaning]
    return _model(pieces, family.semantic), size


def _motorcycle_wheel(x: float, radius: float, width: float) -> list[Piece]:
    """A narrow wheel in the middle plane, with a brake disc on both sides."""
    r, w = radius, width / 2
    profile = [(-w, 0.74 * r), (-0.8 * w, 0.93 * r), (0.0, r), (0.8 * w, 0.93 * r), (w, 0.74 * r)]
    left = [
        Piece(disc(0.04, 0.5 * r, 12), "metal", ALLOY),
        Piece(disc(0.02, 0.76 * r, 16), "matte", SEAM),
    ]
    pieces = [Piece(lathe(profile, 20), "matte", RUBBER), *_both_sides(left)]
    return [p._replace(mesh=moved(p.mesh, (x, 0, radius))) for p in pieces]


def _motorcycle_frame(
    front: float, rear: float, radius: float, size: Size, paint: Rgb, rng: Rng
) -> list[Piece]:
    """All between and above the wheels, in an upright motorcycle."""
    head = np.array([front - 0.28, 0.0, 0.86 * size.height - 0.08])  # steering head
    middle, seat_z = (front + rear) / 2, 0.7 * size.height
    bar_z, half = size.height - 0.1, size.width / 2

    def hull(path: ArrayLike, radii: ArrayLike, flat: float, color: Rgb, material: str) -> Piece:
        vertices, faces = tube(path, radii, sides=10)
        return Piece((vertices * [1, flat, 1], faces), material, color)

    tank = [(head[0] - 0.02, 0, seat_z + 0.1), (head[0] - 0.15, 0, seat_z + 0.11),
            (middle + 0.08, 0, seat_z + 0.08), (middle - 0.04, 0, seat_z + 0.02)]  # fmt: skip
    seat = [(middle, 0, seat_z), (middle - 0.25, 0, seat_z - 0.01), (rear + 0.15, 0, seat_z + 0.03),
            (rear - 0.12, 0, seat_z + 0.07)]  # fmt: skip
    lamp = head + [0.16, 0.0, -0.06]
    left = [
        _bar([(front, 0.1, radius), head + [0.0, 0.1, 0.0]], 0.026, ALLOY),
        _bar([(rear, 0.12, radius), (middle, 0.11, radius + 0.08)], 0.028, STEEL),
        _bar([(rear + 0.05, 0.1, radius + 0.05), (rear + 0.22, 0.1, seat_z - 0.06)], 0.025, STEEL),
        _bar([head, (head[0] - 0.1, 0.18, bar_z), (head[0] - 0.2, half, bar_z - 0.03)], 0.014, STEEL),
        _bar([(head[0] - 0.17, 0.72 * half, bar_z - 0.02), (head[0] - 0.2, half, bar_z - 0.03)],
             0.02, PLASTIC, "matte"),
        _bar([(head[0] - 0.12, 0.6 * half, bar_z), (head[0] - 0.1, 0.75 * half, bar_z + 0.09)],
             0.007, PLASTIC, "matte"),
        _block((0.02, 0.12, 0.07), (head[0] - 0.1, 0.8 * half, bar_z + 0.065), PLASTIC),
        _block((0.05, 0.06, 0.035), (lamp[0] - 0.04, 0.19, lamp[2]), AMBER_LAMP, "lamp"),
        _block((0.05, 0.05, 0.03), (rear - 0.16, 0.14, seat_z - 0.04), AMBER_LAMP, "lamp"),
    ]  # fmt: skip
    exhaust = [(middle + 0.22, -0.1, 0.5), (middle + 0.2, -0.14, 0.26), (middle - 0.1, -0.17, 0.24),
               (rear + 0.15, -0.19, 0.33), (rear - 0.15, -0.2, 0.4)]  # fmt: skip
    return [
        *_both_sides(left),
        hull(tank, [0.04, 0.15, 0.13, 0.06], 0.85, paint, "paint"),
        hull(seat, [0.06, 0.09, 0.075, 0.05], 1.3, PLASTIC, "matte"),
        hull(np.add(seat[1:], (-0.02, 0, -0.07)), [0.05, 0.06, 0.03], 1.4, paint, "paint"),
        _bar([head, (middle - 0.2, 0, 0.32), (rear + 0.25, 0, 0.4)], 0.04, STEEL),
        _block((0.42, 0.3, 0.26), (middle + 0.05, 0, 0.36), STEEL, "metal"),
        _block((0.24, 0.24, 0.26), (middle + 0.12, 0, 0.56), PLASTIC, "metal"),
        _block((0.06, 0.32, 0.3), (middle + 0.33, 0, 0.52), SEAM),
        Piece(tube(exhaust, [0.025, 0.025, 0.03, 0.055, 0.05]), "metal", ALLOY),
        _mudguard(front, radius, (20, 130), paint),
        _mudguard(rear, radius, (75, 165), PLASTIC),
        hull([lamp - [0.1, 0, 0], lamp - [0.03, 0, 0], lamp], [0.05, 0.09, 0.095], 1, paint, "paint"),
        hull([lamp, lamp + [0.012, 0, 0]], [0.085, 0.06], 1, WHITE_LAMP, "lamp"),
        _block((0.04, 0.13, 0.06), (rear - 0.2, 0, seat_z + 0.03), RED_LAMP, "lamp"),
        _block((0.01, 0.2, 0.16), (rear - 0.24, 0, seat_z - 0.14), PLATES[0]),
        _block((0.012, 0.15, 0.05), (rear - 0.24, 0, seat_z - 0.12), SEAM),
        _bar([(middle - 0.05, 0.12, 0.28), (middle - 0.12, 0.26, 0.05)], 0.014, STEEL),
    ]


def _mudguard(x: float, radius: float, sector_deg: Range, color: Rgb) -> Piece:
    angle = np.deg2rad(np.linspace(*sector_deg, 7))
    arc = np.stack([x + (radius + 0.03) * np.cos(angle), radius + (radius + 0.03) * np.sin(angle)])
    rows = [np.insert(arc.T, 1, y, axis=1) for y in (-0.08, 0.08)]
    return Piece(sheet(np.stack(rows)), "paint", color)


_CAR_BOTTOM: Curve = (
    (0, 0.15), (0.03, 0.13), (0.10, 0.125), (0.5, 0.12), (0.92, 0.135), (0.985, 0.17), (1, 0.19),
)  # fmt: skip

FAMILIES: dict[str, Family] = {
    "hatchback": Family(
        assemble=_car, semantic=LABELS["car"], share=0.27,
        length_m=(3.7, 4.4), width_m=(1.68, 1.8), height_m=(1.42, 1.54),
        axles=(0.185, 0.815), wheel_radius_m=(0.29, 0.33),
        top=((0, 0.40), (0.008, 0.47), (0.03, 0.525), (0.10, 0.585), (0.20, 0.64), (0.245, 0.675),
             (0.33, 0.81), (0.43, 0.95), (0.47, 0.975), (0.56, 1.0), (0.72, 0.985), (0.86, 0.94),
             (0.89, 0.91), (0.965, 0.69), (0.985, 0.62), (0.995, 0.52), (1, 0.42)),
        bottom=_CAR_BOTTOM,
        belt=((0, 0.56), (0.25, 0.62), (0.7, 0.645), (0.92, 0.68), (1, 0.68)),
        windscreen=(0.25, 0.44), rear_window=(0.885, 0.96), panes=(0.29, 0.51, 0.71, 0.86),
        doors=(0.28, 0.51, 0.71), pane_lean_m=0.16, headlamp=(0.56, 0.93, 0.43, 0.52),
        tail_lamp=(0.62, 0.93, 0.50, 0.66), grille=(0.5, 0.40, 0.47),
    ),
    "saloon": Family(
        assemble=_car, semantic=LABELS["car"], share=0.14,
        length_m=(4.4, 5.0), width_m=(1.75, 1.9), height_m=(1.4, 1.49),
        axles=(0.185, 0.785), wheel_radius_m=(0.31, 0.35),
        top=((0, 0.40), (0.007, 0.47), (0.025, 0.53), (0.10, 0.59), (0.22, 0.645), (0.27, 0.68),
             (0.35, 0.82), (0.43, 0.95), (0.48, 0.985), (0.54, 1.0), (0.63, 0.985), (0.70, 0.94),
             (0.78, 0.82), (0.85, 0.74), (0.90, 0.725), (0.965, 0.715), (0.985, 0.68),
             (0.993, 0.58), (1, 0.45)),
        bottom=_CAR_BOTTOM,
        belt=((0, 0.56), (0.27, 0.63), (0.7, 0.665), (0.85, 0.68), (1, 0.69)),
        windscreen=(0.275, 0.44), rear_window=(0.695, 0.84), panes=(0.31, 0.48, 0.64, 0.76),
        doors=(0.29, 0.48, 0.66), headlamp=(0.54, 0.93, 0.44, 0.52),
        tail_lamp=(0.45, 0.93, 0.53, 0.64), grille=(0.5, 0.38, 0.49), bow_m=(0.18, 0.12),
    ),
    "estate": Family(
        assemble=_car, semantic=LABELS["car"], share=0.15,
        length_m=(4.4, 4.95), width_m=(1.75, 1.88), height_m=(1.44, 1.53),
        axles=(0.185, 0.785), wheel_radius_m=(0.31, 0.345),
        top=((0, 0.40), (0.007, 0.47), (0.025, 0.53), (0.10, 0.59), (0.22, 0.645), (0.265, 0.68),
             (0.345, 0.82), (0.425, 0.95), (0.47, 0.98), (0.54, 1.0), (0.75, 0.99), (0.89, 0.95),
             (0.92, 0.91), (0.975, 0.70), (0.988, 0.62), (0.995, 0.52), (1, 0.42)),
        bottom=_CAR_BOTTOM,
        belt=((0, 0.56), (0.27, 0.625), (0.7, 0.65), (0.92, 0.67), (1, 0.68)),
        windscreen=(0.27, 0.435), rear_window=(0.915, 0.97), panes=(0.31, 0.48, 0.65, 0.89),
        doors=(0.29, 0.48, 0.66), pane_lean_m=0.14, headlamp=(0.54, 0.93, 0.44, 0.52),
        tail_lamp=(0.64, 0.93, 0.48, 0.66), grille=(0.5, 0.39, 0.48), bow_m=(0.18, 0.1),
    ),
    "suv": Family(
        assemble=_car, semantic=LABELS["car"], share=0.2,
        length_m=(4.25, 4.9), width_m=(1.8, 1.98), height_m=(1.58, 1.75),
        axles=(0.185, 0.80), wheel_radius_m=(0.345, 0.385),
        top=((0, 0.45), (0.007, 0.52), (0.02, 0.585), (0.08, 0.625), (0.20, 0.66), (0.25, 0.69),
             (0.33, 0.82), (0.41, 0.95), (0.45, 0.98), (0.54, 1.0), (0.75, 0.985), (0.89, 0.955),
             (0.915, 0.92), (0.97, 0.72), (0.988, 0.64), (0.995, 0.54), (1, 0.45)),
        bottom=((0, 0.19), (0.03, 0.165), (0.10, 0.155), (0.5, 0.15), (0.92, 0.17), (0.985, 0.20),
                (1, 0.22)),
        belt=((0, 0.60), (0.25, 0.64), (0.7, 0.66), (0.92, 0.70), (1, 0.70)),
        windscreen=(0.255, 0.42), rear_window=(0.91, 0.965), panes=(0.29, 0.49, 0.69, 0.87),
        doors=(0.275, 0.49, 0.69), pane_lean_m=0.2, headlamp=(0.56, 0.94, 0.48, 0.555),
        tail_lamp=(0.6, 0.94, 0.52, 0.62), grille=(0.52, 0.41, 0.52), cladding_m=0.075,
        corner_m=0.22, crown_m=0.09,
    ),
    "van": Family(
        assemble=_car, semantic=LABELS["car"], share=0.1,
        length_m=(4.9, 5.9), width_m=(1.9, 2.05), height_m=(1.95, 2.45),
        axles=(0.175, 0.775), wheel_radius_m=(0.33, 0.35),
        top=((0, 0.37), (0.006, 0.43), (0.018, 0.475), (0.06, 0.515), (0.12, 0.555), (0.15, 0.585),
             (0.21, 0.73), (0.28, 0.90), (0.31, 0.945), (0.36, 0.98), (0.5, 1.0), (0.94, 0.99),
             (0.972, 0.95), (0.98, 0.90), (0.988, 0.60), (0.993, 0.52), (1, 0.36)),
        bottom=((0, 0.13), (0.03, 0.115), (0.1, 0.115), (0.9, 0.12), (1, 0.15)),
        belt=((0, 0.48), (0.15, 0.53), (0.3, 0.535), (1, 0.535)),
        windscreen=(0.153, 0.285), rear_window=(0.98, 0.988), panes=(0.18, 0.365),
        doors=(0.165, 0.37, 0.58), headlamp=(0.6, 0.94, 0.36, 0.45),
        tail_lamp=(0.8, 0.94, 0.34, 0.55), grille=(0.52, 0.33, 0.41), tumblehome=0.11,
        corner_m=0.16, bow_m=(0.18, 0.03), crown_m=0.1, cladding_m=0.07,
    ),
    "box_truck": Family(
        assemble=_box_truck, semantic=LABELS["truck"], share=0.05,
        length_m=(6.6, 9.2), width_m=(2.25, 2.5), height_m=(3.1, 3.7),
        axles=(0.16, 0.74), wheel_radius_m=(0.4, 0.47),
        top=((0, 0.33), (0.015, 0.40), (0.04, 0.45), (0.10, 0.60), (0.16, 0.70), (0.20, 0.74),
             (0.30, 0.77), (0.6, 0.79), (0.9, 0.78), (0.97, 0.76), (1, 0.6)),
        bottom=((0, 0.12), (0.08, 0.11), (0.5, 0.13), (1, 0.2)),
        belt=((0, 0.45), (0.5, 0.44), (1, 0.44)),
        windscreen=(0.03, 0.17), panes=(0.14, 0.72),
        doors=(0.12, 0.76), headlamp=(0.66, 0.92, 0.185, 0.23), grille=(0.55, 0.24, 0.32),
        tumblehome=0.08, corner_m=0.2, bow_m=(0.14, 0.0), crown_m=0.12, cladding_m=0.07, cab_m=2.05,
    ),
    "semi_trailer": Family(
        assemble=_semi_trailer, semantic=LABELS["truck"], share=0.05,
        length_m=(15.6, 16.6), width_m=(2.5, 2.55), height_m=(3.9, 4.0),
        axles=(0.087, 0.315), wheel_radius_m=(0.5, 0.52),
        top=((0, 0.38), (0.012, 0.45), (0.03, 0.50), (0.07, 0.62), (0.11, 0.72), (0.15, 0.765),
             (0.25, 0.81), (0.5, 0.91), (0.8, 0.965), (0.96, 0.97), (1, 0.7)),
        bottom=((0, 0.09), (0.08, 0.085), (0.5, 0.12), (1, 0.2)),
        belt=((0, 0.47), (0.5, 0.46), (1, 0.46)),
        windscreen=(0.02, 0.13), panes=(0.13, 0.62),
        doors=(0.11, 0.66), headlamp=(0.64, 0.92, 0.15, 0.195), grille=(0.62, 0.22, 0.36),
        tumblehome=0.08, corner_m=0.24, bow_m=(0.16, 0.0), crown_m=0.16, cladding_m=0.08, cab_m=2.25,
    ),
    "bus": Family(
        assemble=_bus, semantic=LABELS["bus"], share=0.03,
        length_m=(10.5, 12.2), width_m=(2.5, 2.55), height_m=(2.95, 3.2),
        axles=(0.23, 0.72), wheel_radius_m=(0.47, 0.5),
        top=((0, 0.5), (0.003, 0.65), (0.009, 0.80), (0.016, 0.89), (0.025, 0.95), (0.04, 0.985),
             (0.08, 1.0), (0.3, 1.0), (0.6, 1.0), (0.95, 0.995), (0.98, 0.97), (0.99, 0.90),
             (0.996, 0.75), (1, 0.45)),
        bottom=((0, 0.1), (0.03, 0.09), (0.5, 0.09), (0.97, 0.1), (1, 0.12)),
        belt=((0, 0.4), (1, 0.4)),
        doors=(0.03, 0.44), headlamp=(0.6, 0.9, 0.19, 0.245), grille=(0.4, 0.24, 0.27),
        tail_lamp=(0.78, 0.93, 0.25, 0.4),
        tumblehome=0.07, corner_m=0.26, bow_m=(0.2, 0.06), crown_m=0.2, cladding_m=0.07,
    ),
    "motorcycle": Family(
        assemble=_motorcycle, semantic=LABELS["motorcycle"], share=0.01,
        length_m=(2.0, 2.25), width_m=(0.74, 0.9), height_m=(1.08, 1.2),
        axles=(0.16, 0.84), wheel_radius_m=(0.3, 0.33),
    ),
}  # fmt: skip
