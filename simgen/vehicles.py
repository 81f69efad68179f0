"""Road vehicles: cars, vans, trucks, buses and motorcycles drawn from families of proportions.

A family gives its body as curves in shares of length and height, so that one silhouette serves
every size. Frame and units: mesh.py; shells and draping: bodyshell.py; parts: vehicle_parts.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from simgen.bodyshell import Arch, Array, Outline, band_grid, shell
from simgen.mesh import Model, Part
from simgen.motorcycle import motorcycle_pieces, on_stand, rider
from simgen.schema import LABELS
from simgen.vehicle_parts import (
    GLASS,
    PLASTIC,
    SEAM,
    STEEL,
    Dresser,
    LampPlace,
    Piece,
    Range,
    Rgb,
    Rng,
    axle,
    between_arches,
    both_sides,
    bus_door,
    cargo_box,
    chassis,
    destination,
    end_window,
    front_end,
    model_of,
    on_right,
    rear_end,
    rectangle,
    rod,
    side_doors,
    side_guards,
    side_mirror,
    side_windows,
    skin,
    tail_board,
    twin_axle,
    wipers,
)

Curve = tuple[tuple[float, float], ...]
Paints = tuple[Rgb, ...]


@dataclass(frozen=True)
class Vehicle:
    """A model and its outer size without mirrors [m]."""

    model: Model
    length: float
    width: float
    height: float
    family: str
    paints: tuple[Rgb, ...]
    """its colours of choice; all others belong to the design"""

    def repainted(self, *, rng: Rng) -> Vehicle:
        """The same design in newly drawn colours."""
        paints = _drawn_paints(FAMILIES[self.family], rng)
        recolored = dict(zip(self.paints, paints, strict=True))
        return replace(self, model=[_recolored(p, recolored) for p in self.model], paints=paints)


class Size(NamedTuple):
    """Outer size without mirrors [m]."""

    length: float
    width: float
    height: float


_NOWHERE = LampPlace(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Family:
    """Proportions of a kind of vehicle.

    Positions along the body (the cab, if there is one) are shares from nose (0) to tail (1),
    heights are shares of the height of the vehicle.
    """

    assemble: Callable[[Family, Paints, Rng], tuple[Model, Size]]
    semantic: int
    share: float
    """of traffic"""
    length_m: Range
    width_m: Range
    height_m: Range
    axles: Range
    """front and rear axle in shares of the whole length: the wheelbase is their difference"""
    wheel_radius_m: Range
    top: Curve = ()
    """silhouette of the body: (share of its length, share of the height)"""
    bottom: Curve = ()
    belt: Curve = ()
    windscreen: Range = (0.0, 0.0)
    """lower and upper edge"""
    rear_window: Range = (0.0, 0.0)
    """upper and lower edge"""
    panes: tuple[float, ...] = ()
    """pillars that bound the side windows"""
    pane_lean_m: float = 0.0
    """how far the upper corner of the last pane leans forward"""
    doors: tuple[float, ...] = ()
    """seams of the side doors"""
    headlamp: LampPlace = _NOWHERE
    tail_lamp: LampPlace = _NOWHERE
    grille: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """half its width in shares of half the width; lower and upper edge"""
    cladding_m: float = 0.05
    tumblehome: float = 0.16
    corner_m: float = 0.2
    crown_m: float = 0.07
    bow_m: Range = (0.16, 0.1)
    """how far nose and tail bulge"""
    cab_m: float = 0.0
    """length of the cab of a truck"""
    fleet_paints: int = 0
    """how many colours of FLEET_PAINTS it wears; 0: one of PAINTS"""
    ridden: Callable[[Family, Paints, Rng], tuple[Model, Size]] | None = None
    """assembles it with its rider, if it has one rather than someone behind glass"""


# Paints by their share of new cars, linear albedo.
PAINTS: tuple[tuple[float, Rgb], ...] = (
    (0.25, (0.70, 0.70, 0.68)),  # white
    (0.20, (0.028, 0.028, 0.030)),  # black: even in shade lighter than what is behind glass
    (0.21, (0.12, 0.125, 0.13)),  # grey
    (0.12, (0.42, 0.43, 0.44)),  # silver
    (0.09, (0.02, 0.06, 0.20)),  # blue
    (0.05, (0.33, 0.02, 0.02)),  # red
    (0.03, (0.02, 0.08, 0.05)),  # green
    (0.03, (0.20, 0.15, 0.10)),  # beige, brown
    (0.02, (0.50, 0.30, 0.02)),  # yellow, orange
)
FLEET_PAINTS: tuple[tuple[float, Rgb], ...] = (
    (0.40, (0.70, 0.70, 0.68)),
    (0.10, (0.35, 0.02, 0.02)),
    (0.14, (0.03, 0.08, 0.30)),
    (0.08, (0.02, 0.16, 0.07)),
    (0.10, (0.60, 0.33, 0.02)),
    (0.10, (0.10, 0.11, 0.12)),
    (0.08, (0.03, 0.28, 0.36)),
)


def build(family: str, *, rng: Rng, ridden: bool = False) -> Vehicle:
    """A vehicle of a family of FAMILIES: size, colours and details drawn by ``rng``.

    If it is ``ridden``, a kind that has a rider comes with one.

    Raises:
        ValueError: no such family.
    """
    if family not in FAMILIES:
        raise ValueError(f"vehicle family {family!r} is unknown; expected one of {list(FAMILIES)}")
    kind = FAMILIES[family]
    paints = _drawn_paints(kind, rng)
    assemble = (ridden and kind.ridden) or kind.assemble
    model, size = assemble(kind, paints, rng)
    return Vehicle(model, *size, family, paints)


def draw_family(*, rng: Rng, mix: dict[str, float] | None = None) -> str:
    """A family name, by its share of traffic or by the weights of ``mix``.

    Raises:
        ValueError: an unknown family, a negative weight, or weights that sum to 0.
    """
    weights = {name: f.share for name, f in FAMILIES.items()} if mix is None else mix
    unknown = sorted(weights.keys() - FAMILIES.keys())
    if unknown:
        raise ValueError(f"mix: unknown families {unknown}; expected some of {list(FAMILIES)}")
    total = sum(weights.values())
    if total <= 0 or min(weights.values()) < 0:
        raise ValueError(f"mix: weights must be >= 0 and not all 0, got {weights}")
    names = list(weights)
    return names[rng.choice(len(names), p=[weights[n] / total for n in names])]


def _drawn_paints(family: Family, rng: Rng) -> Paints:
    """Different paints by their shares, each a little varied."""
    paints = FLEET_PAINTS if family.fleet_paints else PAINTS
    shares = np.array([share for share, _ in paints])
    num = family.fleet_paints or 1
    drawn = rng.choice(len(paints), num, replace=False, p=shares / shares.sum())
    return tuple(_varied(paints[k][1], rng) for k in drawn)


_PAINTED = ("paint", "matte")


def _recolored(part: Part, new: Mapping[Rgb, Rgb]) -> Part:
    """The part with some of its colours exchanged."""
    if part.color is None or part.material not in _PAINTED:
        return part
    color = part.color.copy()
    for before, after in new.items():
        color[(part.color == np.array(before, np.float32)).all(axis=1)] = after
    return replace(part, color=color)


def _varied(color: Rgb, rng: Rng) -> Rgb:
    r, g, b = np.array(color) * rng.uniform(0.8, 1.1) * rng.uniform(0.95, 1.03, 3)
    return float(r), float(g), float(b)


def _size(family: Family, rng: Rng) -> Size:
    """A size: a long one of its kind is wide and tall, too."""
    t = np.clip(rng.uniform() + rng.normal(0, 0.15, 3), 0, 1)
    limits = (family.length_m, family.width_m, family.height_m)
    return Size(*(float(lo + u * (hi - lo)) for u, (lo, hi) in zip(t, limits, strict=True)))


def _dresser(family: Family, size: Size, rng: Rng) -> Dresser:
    """The family's shell at a size: over the whole length, or over the cab if there is one."""
    front, body = size.length / 2, family.cab_m or size.length
    nose, tail = front - family.bow_m[0], front - body + family.bow_m[1]

    def curve(points: Curve) -> Array:
        return np.array([(nose + f * (tail - nose), z * size.height) for f, z in reversed(points)])

    top = curve(family.top)
    roof = top[:, 1].max()
    top[1:-1, 1] *= rng.uniform(0.985, 1.0, len(top) - 2)  # no two bonnets are the same
    top[:, 1] *= roof / top[:, 1].max()
    radius = float(rng.uniform(*family.wheel_radius_m))
    axles = [front - f * size.length for f in family.axles]
    outline = Outline(
        top=top,
        bottom=curve(family.bottom),
        belt=curve(family.belt),
        width=size.width,
        arches=tuple(Arch(x, radius, radius + 0.05) for x in axles if x > tail),
        cladding=family.cladding_m,
        tumblehome=family.tumblehome,
        corner=family.corner_m,
        bow=family.bow_m,
        crown=family.crown_m,
    )
    return Dresser(shell(outline), size.height)


def _body_wheels(d: Dresser, width: float, spokes: int) -> list[Piece]:
    """Wheels in all arches of a body."""
    wheels = [axle(a.x, d.half - 0.03, a.z, width, spokes) for a in d.outline.arches]
    return [piece for pair in wheels for piece in pair]


def _car(family: Family, paints: Paints, rng: Rng) -> tuple[Model, Size]:
    """Cars and vans."""
    size = _size(family, rng)
    d = _dresser(family, size, rng)
    paint = ("paint", paints[0])
    trim = PLASTIC if rng.uniform() < 0.6 or family.cladding_m > 0.06 else paint
    mirror_x = d.x(family.panes[0]) - 0.02
    mirror_z = float(d.outline.belt_at(mirror_x)) + 0.03
    left = [
        *side_windows(d, family.panes, lean=family.pane_lean_m),
        *side_doors(d, family.doors, paint),
        *side_mirror(d, mirror_x, mirror_z, 0.17, paint),
    ]
    pieces = [
        *skin(d.body, paint, trim),
        end_window(d, "front", *(d.x(f) for f in family.windscreen)),
        *wipers(d, d.x(family.windscreen[0])),
        end_window(d, "rear", *(d.x(f) for f in reversed(family.rear_window))),
        *both_sides(left),
        *front_end(d, family.headlamp, family.grille, rng),
        *rear_end(d, family.tail_lamp, rng),
        *_body_wheels(d, 0.22, int(rng.choice([0, 5, 5, 6, 7, 10]))),
    ]
    return model_of(pieces, family.semantic), size


def _bus(family: Family, paints: Paints, rng: Rng) -> tuple[Model, Size]:
    """A city bus; its doors are on the right."""
    size = _size(family, rng)
    d = _dresser(family, size, rng)
    paint, accent = (("paint", c) for c in paints)
    pillars = np.linspace(0.025, 0.965, int(rng.integers(7, 9))).tolist()
    skirts = [
        d.patch("left", band_grid(x, d.outline.bottom_at(x, 0.12), 0.36 * size.height), accent)
        for x in between_arches(d)
    ]
    middle, lower = (-0.7 * d.half, 0.7 * d.half), 0.36 * size.height
    windscreen = rectangle((-0.86 * d.half, 0.86 * d.half), (lower, 0.83 * size.height), 7, 13)
    rear_window = rectangle(middle, (0.58 * size.height, 0.82 * size.height), 4, 7)
    engine_grille = rectangle(middle, (0.24 * size.height, 0.42 * size.height), 3, 7)
    pieces = [
        *skin(d.body, paint, PLASTIC),
        *both_sides(side_windows(d, pillars, sill=0.02) + skirts),
        *on_right(piece for share in family.doors for piece in bus_door(d, d.x(share))),
        d.patch("front", windscreen, GLASS),
        *destination(d, rng),
        d.patch("rear", rear_window, GLASS),
        d.patch("rear", engine_grille, SEAM),
        *front_end(d, family.headlamp, family.grille, rng),
        *rear_end(d, family.tail_lamp, rng),
        *both_sides(side_mirror(d, d.nose - 0.1, 0.72 * size.height, 0.24, PLASTIC)),
        *_body_wheels(d, 0.3, 0),
    ]
    return model_of(pieces, family.semantic), size


def _cab(family: Family, d: Dresser, color: Rgb, rng: Rng) -> list[Piece]:
    """The cab of a truck with its front wheels."""
    paint = ("paint", color)
    roof = float(d.outline.top[:, 1].max())
    left = [
        *side_windows(d, family.panes),
        *side_doors(d, family.doors, paint),
        *side_mirror(d, d.nose - 0.25, 0.7 * roof, 0.26, PLASTIC),
    ]
    return [
        *skin(d.body, paint, PLASTIC),
        end_window(d, "front", *(d.x(f) for f in family.windscreen)),
        *wipers(d, d.x(family.windscreen[0])),
        *both_sides(left),
        *front_end(d, family.headlamp, family.grille, rng),
        *_body_wheels(d, 0.3, 0),
    ]


def _box_truck(family: Family, paints: Paints, rng: Rng) -> tuple[Model, Size]:
    """A rigid truck: cab, chassis, box."""
    size = _size(family, rng)
    d = _dresser(family, size, rng)
    rear, floor, radius = 0.06 - size.length / 2, 0.32 * size.height, d.outline.arches[0].z
    drive = size.length * (0.5 - family.axles[1])
    cargo = (rear, d.tail - 0.12), (floor, size.height)
    pieces = [
        *_cab(family, d, paints[0], rng),
        *cargo_box(*cargo, size.width, paints[1:], rng),
        chassis((rear + 0.1, d.tail + 0.1), floor),
        *side_guards((drive + radius + 0.3, d.tail - 0.4), size.width),
        *twin_axle(drive, size.width, radius),
        *tail_board(rear, size.width, floor - 0.35, rng),
    ]
    return model_of(pieces, family.semantic), size


def _semi_trailer(family: Family, paints: Paints, rng: Rng) -> tuple[Model, Size]:
    """A tractor (truck) and its three-axle trailer (trailer)."""
    size = _size(family, rng)
    d = _dresser(family, size, rng)
    rear, floor, radius = 0.06 - size.length / 2, 1.2, d.outline.arches[0].z
    drive = size.length * (0.5 - family.axles[1])
    y = size.width / 2 - 0.4
    tank = rod([(drive + 0.8, y, 0.65), (d.tail - 0.1, y, 0.65)], 0.32, STEEL, sides=10)
    leg = rod([(drive - 2.0, 0.8, 0.3), (drive - 2.0, 0.8, floor)], 0.06)
    tractor = [
        *_cab(family, d, paints[0], rng),
        chassis((drive - 0.9, d.tail + 0.1), 1.0),
        *twin_axle(drive, size.width, radius),
        *both_sides([tank]),
    ]
    cargo = (rear, d.tail - 0.55), (floor, size.height)
    trailer = [
        *cargo_box(*cargo, size.width, paints[1:], rng),
        chassis((rear + 0.1, drive - 1.0), floor),
        *side_guards((rear + 5.5, drive - 2.2), size.width),
        *(p for x in (1.9, 3.2, 4.5) for p in twin_axle(rear + x, size.width, radius)),
        *both_sides([leg]),
        *tail_board(rear, size.width, 0.75, rng),
    ]
    return model_of(tractor, family.semantic) + model_of(trailer, LABELS["trailer"]), size


def _upright(family: Family, size: Size, paint: Rgb, rng: Rng) -> tuple[list[Piece], Range]:
    """A motorcycle without its rider, and x of its axles."""
    front, rear = (size.length * (0.5 - f) for f in family.axles)
    radius = float(rng.uniform(*family.wheel_radius_m))
    pieces = motorcycle_pieces((front, rear), radius, size.width, size.height, ("paint", paint))
    return pieces, (front, rear)


def _motorcycle(family: Family, paints: Paints, rng: Rng) -> tuple[Model, Size]:
    """A parked motorcycle."""
    size = _size(family, rng)
    pieces, axles = _upright(family, size, paints[0], rng)
    lean_rad = float(np.deg2rad(rng.uniform(7, 11)))
    return model_of(on_stand(pieces, axles, lean_rad), family.semantic), size


def _motorcyclist(family: Family, paints: Paints, rng: Rng) -> tuple[Model, Size]:
    """A motorcycle and who rides it, in a helmet of its colour."""
    size = _size(family, rng)
    pieces, axles = _upright(family, size, paints[0], rng)
    person = rider(axles, size.width, size.height, paints[0], rng=rng)
    top = float(person.vertices[:, 2].max())
    return [*model_of(pieces, family.semantic), person], size._replace(height=top)


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
        doors=(0.28, 0.51, 0.71), pane_lean_m=0.16, headlamp=LampPlace(0.56, 0.93, 0.43, 0.52),
        tail_lamp=LampPlace(0.62, 0.93, 0.50, 0.66), grille=(0.5, 0.40, 0.47),
    ),
    "saloon": Family(
        assemble=_car, semantic=LABELS["car"], share=0.14,
        length_m=(4.4, 5.0), width_m=(1.75, 1.9), height_m=(1.4, 1.49),
        axles=(0.185, 0.785), wheel_radius_m=(0.31, 0.35),
        top=((0, 0.40), (0.007, 0.47), (0.025, 0.53), (0.10, 0.59), (0.22, 0.645), (0.27, 0.68),
             (0.35, 0.82), (0.43, 0.95), (0.54, 1.0), (0.63, 0.985), (0.70, 0.94),
             (0.78, 0.82), (0.85, 0.735), (0.965, 0.715), (0.985, 0.68),
             (0.993, 0.58), (1, 0.45)),
        bottom=_CAR_BOTTOM,
        belt=((0, 0.56), (0.27, 0.63), (0.7, 0.665), (0.85, 0.68), (1, 0.69)),
        windscreen=(0.275, 0.44), rear_window=(0.695, 0.84), panes=(0.31, 0.48, 0.64, 0.76),
        doors=(0.29, 0.48, 0.66), headlamp=LampPlace(0.54, 0.93, 0.44, 0.52),
        tail_lamp=LampPlace(0.45, 0.93, 0.53, 0.64), grille=(0.5, 0.38, 0.49), bow_m=(0.18, 0.12),
    ),
    "estate": Family(
        assemble=_car, semantic=LABELS["car"], share=0.15,
        length_m=(4.4, 4.95), width_m=(1.75, 1.88), height_m=(1.44, 1.53),
        axles=(0.185, 0.785), wheel_radius_m=(0.31, 0.345),
        top=((0, 0.40), (0.007, 0.47), (0.025, 0.53), (0.10, 0.59), (0.22, 0.645), (0.265, 0.68),
             (0.345, 0.82), (0.425, 0.95), (0.47, 0.98), (0.54, 1.0), (0.75, 0.99), (0.89, 0.95),
             (0.92, 0.91), (0.975, 0.70), (0.99, 0.60), (1, 0.42)),
        bottom=_CAR_BOTTOM,
        belt=((0, 0.56), (0.27, 0.625), (0.7, 0.65), (0.92, 0.67), (1, 0.68)),
        windscreen=(0.27, 0.435), rear_window=(0.915, 0.97), panes=(0.31, 0.48, 0.65, 0.89),
        doors=(0.29, 0.48, 0.66), pane_lean_m=0.14, headlamp=LampPlace(0.54, 0.93, 0.44, 0.52),
        tail_lamp=LampPlace(0.64, 0.93, 0.48, 0.66), grille=(0.5, 0.39, 0.48), bow_m=(0.18, 0.1),
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
        windscreen=(0.255, 0.42), rear_window=(0.9, 0.975), panes=(0.29, 0.49, 0.69, 0.87),
        doors=(0.275, 0.49, 0.69), pane_lean_m=0.2, headlamp=LampPlace(0.56, 0.94, 0.48, 0.555),
        tail_lamp=LampPlace(0.6, 0.94, 0.52, 0.62), grille=(0.52, 0.41, 0.52), cladding_m=0.075,
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
        doors=(0.165, 0.37, 0.58), headlamp=LampPlace(0.6, 0.94, 0.36, 0.45),
        tail_lamp=LampPlace(0.8, 0.94, 0.34, 0.55), grille=(0.52, 0.33, 0.41), tumblehome=0.11,
        corner_m=0.16, bow_m=(0.18, 0.03), crown_m=0.1, cladding_m=0.07,
    ),
    "box_truck": Family(
        assemble=_box_truck, semantic=LABELS["truck"], share=0.05,
        fleet_paints=3,
        length_m=(6.6, 9.2), width_m=(2.25, 2.5), height_m=(3.1, 3.7),
        axles=(0.16, 0.74), wheel_radius_m=(0.4, 0.47),
        top=((0, 0.33), (0.015, 0.40), (0.04, 0.45), (0.10, 0.60), (0.16, 0.70), (0.20, 0.74),
             (0.30, 0.77), (0.6, 0.79), (0.9, 0.78), (0.97, 0.76), (1, 0.6)),
        bottom=((0, 0.12), (0.08, 0.11), (0.5, 0.13), (1, 0.2)),
        belt=((0, 0.45), (0.5, 0.44), (1, 0.44)),
        windscreen=(0.03, 0.17), panes=(0.14, 0.72),
        doors=(0.12, 0.76), headlamp=LampPlace(0.66, 0.92, 0.185, 0.23), grille=(0.55, 0.24, 0.32),
        tumblehome=0.08, corner_m=0.2, bow_m=(0.14, 0.0), crown_m=0.12, cladding_m=0.07, cab_m=2.05,
    ),
    "semi_trailer": Family(
        assemble=_semi_trailer, semantic=LABELS["truck"], share=0.05,
        fleet_paints=3,
        length_m=(15.6, 16.6), width_m=(2.5, 2.55), height_m=(3.9, 4.0),
        axles=(0.087, 0.315), wheel_radius_m=(0.5, 0.52),
        top=((0, 0.38), (0.012, 0.45), (0.03, 0.50), (0.07, 0.62), (0.11, 0.72), (0.15, 0.765),
             (0.25, 0.81), (0.5, 0.91), (0.8, 0.965), (0.96, 0.97), (1, 0.7)),
        bottom=((0, 0.09), (0.08, 0.085), (0.5, 0.12), (1, 0.2)),
        belt=((0, 0.47), (0.5, 0.46), (1, 0.46)),
        windscreen=(0.02, 0.13), panes=(0.13, 0.62),
        doors=(0.11, 0.66), headlamp=LampPlace(0.64, 0.92, 0.15, 0.195), grille=(0.62, 0.22, 0.36),
        tumblehome=0.08, corner_m=0.24, bow_m=(0.16, 0.0), crown_m=0.16, cladding_m=0.08,
        cab_m=2.25,
    ),
    "bus": Family(
        assemble=_bus, semantic=LABELS["bus"], share=0.03,
        fleet_paints=2,
        length_m=(10.5, 12.2), width_m=(2.5, 2.55), height_m=(2.95, 3.2),
        axles=(0.23, 0.72), wheel_radius_m=(0.47, 0.5),
        top=((0, 0.5), (0.003, 0.65), (0.009, 0.80), (0.016, 0.89), (0.025, 0.95), (0.04, 0.985),
             (0.08, 1.0), (0.3, 1.0), (0.6, 1.0), (0.95, 0.995), (0.98, 0.97), (0.99, 0.90),
             (0.996, 0.75), (1, 0.45)),
        bottom=((0, 0.1), (0.03, 0.09), (0.5, 0.09), (0.97, 0.1), (1, 0.12)),
        belt=((0, 0.4), (1, 0.4)),
        doors=(0.03, 0.44), headlamp=LampPlace(0.6, 0.9, 0.19, 0.245), grille=(0.4, 0.24, 0.27),
        tail_lamp=LampPlace(0.78, 0.93, 0.25, 0.4),
        tumblehome=0.07, corner_m=0.26, bow_m=(0.2, 0.06), crown_m=0.2, cladding_m=0.07,
    ),
    "motorcycle": Family(
        assemble=_motorcycle, ridden=_motorcyclist, semantic=LABELS["motorcycle"], share=0.01,
        length_m=(2.0, 2.25), width_m=(0.74, 0.9), height_m=(1.08, 1.2),
        axles=(0.16, 0.84), wheel_radius_m=(0.3, 0.33),
    ),
}  # fmt: skip
