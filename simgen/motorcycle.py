"""A motorcycle, on its stand or under its rider: tubes, blocks, hulls. Frame, units: mesh.py."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from simgen import figure as fig
from simgen import people
from simgen.bodyshell import Array, disc, lathe, sheet
from simgen.figure import DETAILS, SIDES
from simgen.mesh import Part, part, tube
from simgen.schema import LABELS
from simgen.vehicle_parts import (
    ALLOY,
    AMBER_LAMP,
    PLASTIC,
    PLATE_WHITE,
    RED_LAMP,
    RUBBER,
    SEAM,
    STEEL,
    WHITE_LAMP,
    Finish,
    Piece,
    Range,
    Rgb,
    Rng,
    block,
    both_sides,
    rod,
    shifted,
)


def motorcycle_pieces(
    axles: Range, radius: float, width: float, height: float, paint: Finish
) -> list[Piece]:
    """A motorcycle, upright.

    Args:
        axles: x of the front and of the rear axle [m].
        radius: of both wheels [m].
        width: over the handlebar [m].
        height: of the handlebar [m].
    """
    front, rear = axles
    return [
        *_wheel(front, radius, 0.12),
        *_wheel(rear, radius, 0.17),
        _mudguard(front, radius, (20, 130), paint),
        _mudguard(rear, radius, (75, 165), PLASTIC),
        *_engine((front + rear) / 2, rear),
        *_fork(front, radius, width / 2, height),
        *_head_lamp(np.add(_steering_head(front, height), (0.16, 0.0, -0.06)), paint),
        *_saddle(front, rear, radius, height, paint),
    ]


def on_stand(upright: list[Piece], axles: Range, lean_rad: float) -> list[Piece]:
    """The motorcycle on its side stand, leaning to the left, its bounding box centred in y."""
    x = sum(axles) / 2
    stand = rod([(x - 0.05, 0.12, 0.28), (x - 0.12, 0.26, 0.075)], 0.014)
    c, s = np.cos(lean_rad), np.sin(lean_rad)
    R = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    leaning = [p._replace(mesh=(p.mesh[0] @ R.T, p.mesh[1])) for p in [*upright, stand]]
    vertices = np.concatenate([p.mesh[0] for p in leaning])
    y_middle = (vertices[:, 1].min() + vertices[:, 1].max()) / 2
    return shifted(leaning, (0.0, -y_middle, -vertices[:, 2].min()))


def rider(axles: Range, width: float, height: float, helmet: Rgb, *, rng: Rng) -> Part:
    """Who rides the upright motorcycle of these measures: feet on its pegs, hands on its grips."""
    build, detail = people.draw_build(rng=rng, adult=True), DETAILS[1]
    middle, bar = sum(axles) / 2, _grip(axles[0], width / 2, height)
    hips = np.array([middle - 0.22, 0.0, 0.7 * height + 0.07 + 0.1 * build.scale])
    soles = np.array([(middle + PEG[0], side * PEG[1], PEG[2] + 0.015) for side in SIDES])
    grips = np.array([bar * (1.0, 0.86 * side, 1.0) for side in SIDES])
    s = fig.seated(build, hips, soles, grips, float(rng.uniform(0.15, 0.4)))
    worn = [k for k in people.clothed(s, detail, rng=rng, riding=True)
            if k.slot not in ("hair", "headgear")]  # fmt: skip
    body = fig.figure([*worn, *people.crash_helmet(s, detail)], ground=-float(hips[2]))
    colors = people.palette(rng=rng)
    colors[fig.SLOTS.index("headgear")] = helmet
    seat = np.add(body.vertices, [hips[0], 0.0, 0.0])
    return part(seat, body.faces, "matte", LABELS["rider"], color=colors[body.slots])


PEG = (-0.14, 0.25, 0.33)
"""where a foot rests (m), from the middle between the axles"""


def _steering_head(front: float, height: float) -> Array:
    return np.array([front - 0.28, 0.0, 0.86 * height - 0.08])


def _hull(path: ArrayLike, radii: ArrayLike, flat: float, finish: Finish) -> Piece:
    """A tube along the middle plane, ``flat`` times as wide as high."""
    vertices, faces = tube(path, radii, sides=10)
    return Piece((vertices * [1, flat, 1], faces), *finish)


def _wheel(x: float, radius: float, width: float) -> list[Piece]:
    """A narrow wheel in the middle plane, with a brake disc on both sides."""
    r, w = radius, width / 2
    profile = [(-w, 0.74 * r), (-0.8 * w, 0.93 * r), (0.0, r), (0.8 * w, 0.93 * r), (w, 0.74 * r)]
    sides = [Piece(disc(0.04, 0.5 * r, 12), *ALLOY), Piece(disc(0.02, 0.76 * r, 16), *SEAM)]
    return shifted([Piece(lathe(profile, 20), *RUBBER), *both_sides(sides)], (x, 0.0, radius))


def _mudguard(x: float, radius: float, sector_deg: Range, finish: Finish) -> Piece:
    angle = np.deg2rad(np.linspace(*sector_deg, 7))
    arc = (radius + 0.03) * np.stack([np.cos(angle), np.sin(angle)], axis=1) + [x, radius]
    return Piece(sheet(np.stack([np.insert(arc, 1, y, axis=1) for y in (0.08, -0.08)])), *finish)


def _engine(middle: float, rear: float) -> list[Piece]:
    """Crankcase, cylinder, radiator, exhaust on the right, a peg on either side."""
    exhaust = [
        (middle + 0.22, -0.1, 0.5),
        (middle + 0.2, -0.14, 0.26),
        (middle - 0.1, -0.17, 0.24),
        (rear + 0.15, -0.19, 0.33),
        (rear - 0.15, -0.2, 0.4),
    ]
    return [
        block((0.42, 0.3, 0.26), (middle + 0.05, 0, 0.36), STEEL),
        block((0.24, 0.24, 0.26), (middle + 0.12, 0, 0.56), PLASTIC),
        block((0.06, 0.32, 0.3), (middle + 0.33, 0, 0.52), SEAM),
        rod(exhaust, [0.025, 0.025, 0.03, 0.055, 0.05], ALLOY, sides=8),
        *both_sides([rod([(middle + PEG[0], y, PEG[2]) for y in (0.12, 0.3)], 0.012)]),
    ]


def _grip(front: float, half: float, height: float) -> Array:
    """The end (3,) of the handlebar on the left."""
    return np.array([_steering_head(front, height)[0] - 0.2, half, height - 0.13])


def _fork(front: float, radius: float, half: float, height: float) -> list[Piece]:
    """Fork, handlebar with grips, mirrors."""
    head, bar_z = _steering_head(front, height), height - 0.1
    x, end = float(head[0]), tuple(_grip(front, half, height))
    return both_sides(
        [
            rod([(front, 0.1, radius), (x, 0.1, head[2])], 0.026, ALLOY),
            rod([(x, 0.0, head[2]), (x - 0.1, 0.18, bar_z), end], 0.014),
            rod([(x - 0.17, 0.72 * half, bar_z - 0.02), end], 0.02, PLASTIC),
            rod([(x - 0.12, 0.6 * half, bar_z), (x - 0.1, 0.75 * half, bar_z + 0.06)], 0.007),
            block((0.02, 0.12, 0.07), (x - 0.1, 0.8 * half, bar_z + 0.065), PLASTIC),
        ]
    )


def _head_lamp(at: Array, paint: Finish) -> list[Piece]:
    """The headlamp with its glass at ``at`` (3,), and indicators beside it."""
    shell = [np.add(at, (dx, 0, 0)) for dx in (-0.1, -0.03, 0.0)]
    indicator = block((0.05, 0.06, 0.035), (at[0] - 0.04, 0.19, at[2]), AMBER_LAMP)
    return [
        _hull(shell, [0.05, 0.09, 0.095], 1.0, paint),
        _hull([at, np.add(at, (0.012, 0, 0))], [0.085, 0.06], 1.0, WHITE_LAMP),
        *both_sides([indicator]),
    ]


def _saddle(front: float, rear: float, radius: float, height: float, paint: Finish) -> list[Piece]:
    """Frame, swing arm, tank, seat, and what is mounted behind the seat."""
    head, middle, z = _steering_head(front, height), (front + rear) / 2, 0.7 * height
    tank = [(head[0] - 0.02, 0, z + 0.1), (head[0] - 0.15, 0, z + 0.11)]
    tank += [(middle + 0.08, 0, z + 0.08), (middle - 0.04, 0, z + 0.02)]
    seat = [(middle, 0, z), (middle - 0.25, 0, z - 0.01)]
    seat += [(rear + 0.15, 0, z + 0.03), (rear - 0.12, 0, z + 0.07)]
    left = [
        rod([(rear, 0.12, radius), (middle, 0.11, radius + 0.08)], 0.028),
        rod([(rear + 0.05, 0.1, radius + 0.05), (rear + 0.22, 0.1, z - 0.06)], 0.025),
        block((0.05, 0.05, 0.03), (rear - 0.16, 0.14, z - 0.04), AMBER_LAMP),
    ]
    return [
        *both_sides(left),
        rod([tuple(head), (middle - 0.2, 0, 0.32), (rear + 0.25, 0, 0.4)], 0.04),
        _hull(tank, [0.04, 0.15, 0.13, 0.06], 0.85, paint),
        _hull(seat, [0.06, 0.09, 0.075, 0.05], 1.3, PLASTIC),
        _hull(np.add(seat[1:], (-0.02, 0, -0.07)), [0.05, 0.06, 0.03], 1.4, paint),
        block((0.04, 0.13, 0.06), (rear - 0.2, 0, z + 0.03), RED_LAMP),
        block((0.01, 0.2, 0.16), (rear - 0.24, 0, z - 0.14), ("matte", PLATE_WHITE)),
        block((0.02, 0.15, 0.05), (rear - 0.24, 0, z - 0.12), SEAM),
    ]
