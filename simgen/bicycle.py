"""Bicycles: standing by themselves, or under a rider. Frame and units: see mesh.py."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from simgen import figure as fig
from simgen import people
from simgen.figure import DETAILS, SIDES, Build, Detail, Skeleton
from simgen.geometry import Array, rotation_from_vector
from simgen.mesh import Model, Part, box, part, tube
from simgen.people import Rgb, Rng
from simgen.schema import LABELS
from simgen.street_solids import assembled, bars

BICYCLE, RIDER = LABELS["bicycle"], LABELS["rider"]
LENGTH_M, HALF_WIDTH_M = 1.75, 0.32
WHEEL_M = 0.34
"""radius, tyre included"""
CRANK_M = 0.17

# In the middle plane, the origin on the ground between the wheels.
REAR, FRONT = np.array([-0.53, 0.0, WHEEL_M]), np.array([0.53, 0.0, WHEEL_M])
PEDALS = np.array([-0.09, 0.0, 0.28])
HEAD_LOW, HEAD_HIGH = np.array([0.40, 0.0, 0.70]), np.array([0.345, 0.0, 0.88])

_RUBBER: Rgb = (0.022, 0.022, 0.022)
_STEEL: Rgb = (0.45, 0.46, 0.47)
_FRAMES: tuple[Rgb, ...] = (
    (0.018, 0.018, 0.02), (0.018, 0.018, 0.02), (0.60, 0.60, 0.58), (0.35, 0.02, 0.02),
    (0.02, 0.07, 0.24), (0.03, 0.16, 0.10), (0.12, 0.12, 0.125), (0.50, 0.28, 0.02),
    (0.14, 0.34, 0.36),
)  # fmt: skip


@dataclass(frozen=True)
class _Fit:
    """How a bicycle is set up."""

    saddle: Array
    grips: Array
    """(2, 3) left and right"""
    crank_rad: float
    low_step: bool
    """without a top tube"""


def bicycle(*, rng: Rng, lod: int = 0) -> Model:
    """A bicycle on its stand, leaning a little to the left."""
    fit = _fitted(float(rng.uniform(1.6, 1.85)), rng)
    tilt = rotation_from_vector(np.array([-0.07, 0.0, 0.0]))
    return _turned(assembled(_parts(fit, DETAILS[lod], rng)), tilt)


def cyclist(*, rng: Rng, lod: int = 0) -> Model:
    """A rider on a bicycle, feet on the pedals and hands on the bar."""
    build = people.draw_build(rng=rng, adult=True)
    build = Build(float(np.clip(build.stature, 1.56, 1.92)), min(build.girth, 1.15), build.shape)
    fit, detail = _fitted(build.stature, rng), DETAILS[lod]
    s, hips = _seated(build, fit, float(rng.uniform(0.25, 0.6)))
    skins = people.clothed(s, detail, rng=rng, riding=True)
    if rng.random() < 0.5:
        skins += people.helmet(s, detail)
    if rng.random() < 0.3:
        skins.append(people.backpack(s, detail, rng=rng))
    rider = fig.figure(skins, ground=-float(hips[2]))
    seat = np.add(rider.vertices, [hips[0], 0.0, 0.0])
    colors = people.palette(rng=rng)[rider.slots]
    person = part(seat, rider.faces, "matte", RIDER, color=colors)
    return [person, *assembled(_parts(fit, detail, rng))]


def _fitted(stature: float, rng: Rng) -> _Fit:
    """Set up for someone: the leg is nearly straight on the lower pedal."""
    height = PEDALS[2] + 0.385 * stature
    saddle = np.array([-0.17 - 0.3 * (height - 0.9), 0.0, height])
    bar = float(rng.uniform(0.98, 1.1))
    half, back = float(rng.uniform(0.24, 0.3)), float(rng.uniform(0.22, 0.34))
    grips = np.array([[back, half, bar], [back, -half, bar]])
    return _Fit(saddle, grips, float(rng.uniform(0, 2 * np.pi)), bool(rng.random() < 0.35))


def _pedals(fit: _Fit) -> Array:
    """Middles (2, 3) of the pedals."""
    arm = CRANK_M * np.array([np.cos(fit.crank_rad), 0.0, np.sin(fit.crank_rad)])
    return np.array([PEDALS + side * arm + [0.0, 0.12 * side, 0.0] for side in SIDES])


def _seated(build: Build, fit: _Fit, lean: float) -> tuple[Skeleton, Array]:
    """A body on the saddle; returns it with the middle of its hips (3,)."""
    hips = np.add(fit.saddle, [0.04, 0.0, 0.1 * build.scale])
    soles = np.add(_pedals(fit), [0.0, 0.0, 0.012])
    return fig.seated(build, hips, soles, fit.grips, lean), hips


# --- parts ---------------------------------------------------------------------------------------


def _parts(fit: _Fit, d: Detail, rng: Rng) -> list[Part]:
    paint = _FRAMES[rng.integers(len(_FRAMES))]
    parts = [*_wheel(REAR, d), *_wheel(FRONT, d), *_frame(fit, d, paint), *_bar(fit, d),
             *_drive(fit, d), _saddle(fit, d)]  # fmt: skip
    if d.small:
        parts += [*_mudguards(rng), *_lights(fit)]
    return parts


def _tube(path: list[Array], radius: float, color: Rgb, d: Detail, material: str = "matte") -> Part:
    return part(*tube(path, radius, max(3, d.limb // 2)), material, BICYCLE, color=color)


def _arc(centre: Array, radius: float, start_deg: float, end_deg: float, num: int) -> list[Array]:
    """Points around an axle, counter-clockwise from ahead, seen from the right."""
    a = np.deg2rad(np.linspace(start_deg, end_deg, num))
    return list(centre + radius * np.stack([np.cos(a), 0 * a, np.sin(a)], axis=1))


def _wheel(axle: Array, d: Detail) -> list[Part]:
    """Tyre, rim and, near by, spokes."""
    num = 1 + max(16, 2 * d.torso)
    parts = [_tube(_arc(axle, WHEEL_M - 0.017, 0, 360, num), 0.017, _RUBBER, d)]
    if d.limb > 4:
        parts.append(_tube(_arc(axle, WHEEL_M - 0.042, 0, 360, num), 0.011, _STEEL, d, "metal"))
        parts.append(
            _tube([axle - [0, 0.045, 0], np.add(axle, [0, 0.045, 0])], 0.02, _STEEL, d, "metal")
        )
    if d.small:
        rim = np.array(_arc(axle, WHEEL_M - 0.045, 0, 360, 29)[:-1])
        hub = np.array(_arc(axle, 0.018, 60, 420, 29)[:-1])
        hub[:, 1] += np.where(np.arange(28) % 2 == 0, 0.03, -0.03)
        parts.append(part(*bars(hub, rim, 0.0013), "metal", BICYCLE, color=_STEEL))
    return parts


def _frame(fit: _Fit, d: Detail, paint: Rgb) -> list[Part]:
    """The two triangles and the fork."""
    down = fit.saddle - PEDALS
    seat = PEDALS + 0.78 * down
    high = PEDALS + 0.3 * down if fit.low_step else seat - 0.05 * down
    tubes = [_tube([HEAD_LOW, HEAD_HIGH], 0.019, paint, d, "paint"),
             _tube([PEDALS, HEAD_LOW], 0.018, paint, d, "paint"),
             _tube([high, HEAD_HIGH - 0.15 * (HEAD_HIGH - HEAD_LOW)], 0.015, paint, d, "paint"),
             _tube([PEDALS, seat], 0.016, paint, d, "paint"),
             _tube([seat, fit.saddle - [0, 0, 0.03]], 0.013, _STEEL, d, "metal")]  # fmt: skip
    for side in SIDES:
        wide = np.array([0.0, 0.055 * side, 0.0])
        crown = HEAD_LOW + 0.4 * wide
        curve = FRONT + wide + 0.45 * (HEAD_LOW - FRONT) + [-0.02, 0.0, 0.0]
        tubes += [_tube([REAR + wide, PEDALS + 0.4 * wide], 0.009, paint, d, "paint"),
                  _tube([REAR + wide, seat - 0.06 * down + 0.3 * wide], 0.008, paint, d, "paint"),
                  _tube([crown, curve, FRONT + wide], 0.011, paint, d, "paint")]  # fmt: skip
    return tubes


def _bar(fit: _Fit, d: Detail) -> list[Part]:
    """Stem, handlebar and grips."""
    stem = np.add(HEAD_HIGH, [0.03, 0.0, float(fit.grips[0, 2] - HEAD_HIGH[2]) - 0.01])
    parts = [_tube([HEAD_HIGH, stem], 0.013, _STEEL, d, "metal")]
    for side, grip in zip(SIDES, fit.grips, strict=True):
        bend = np.add(stem, [0.02, 0.6 * side * abs(grip[1]), 0.03])
        parts.append(_tube([stem, bend, grip], 0.011, _STEEL, d, "metal"))
        inner = grip + 0.55 * (bend - grip) * (0.12 / np.linalg.norm(bend - grip)) * 2
        end = grip - 0.02 * (bend - grip) / np.linalg.norm(bend - grip)
        parts.append(_tube([inner, end], 0.017, _RUBBER, d))
    return parts


def _drive(fit: _Fit, d: Detail) -> list[Part]:
    """Cranks, pedals, chain wheel, and the chain as a thin band."""
    parts = []
    for side, pedal in zip(SIDES, _pedals(fit), strict=True):
        inner = np.add(PEDALS, [0.0, 0.06 * side, 0.0])
        parts.append(_tube([inner, pedal - [0.0, 0.045 * side, 0.0]], 0.011, _STEEL, d, "metal"))
        parts.append(part(*box((0.09, 0.09, 0.022), pedal), "matte", BICYCLE, color=_RUBBER))
    right = np.array([0.0, -0.05, 0.0])
    wheel = _arc(PEDALS + right, 0.085, 0, 360, 1 + max(8, d.torso))
    parts.append(_tube(wheel, 0.008, (0.1, 0.1, 0.1), d, "metal"))
    for z, end in ((0.085, 0.04), (-0.085, -0.04)):
        chain = [PEDALS + right + [0, 0, z], REAR + right + [0, 0, end]]
        parts.append(_tube(chain, 0.006, _RUBBER, d))
    return parts


def _saddle(fit: _Fit, d: Detail) -> Part:
    table = np.array([(-0.04, 0.045, 0.09, -0.02), (-0.012, 0.075, 0.13, -0.01),
                      (0.0, 0.055, 0.11, -0.015)])  # fmt: skip
    vertices, faces = fig.stack(table, max(6, d.limb), 2.2)
    narrow = np.clip(1 - (vertices[:, 0] + 0.02) / 0.14, 0.3, 1.0)
    vertices[:, 1] *= narrow
    return part(vertices + fit.saddle, faces, "matte", BICYCLE, color=_RUBBER)


def _mudguards(rng: Rng) -> list[Part]:
    if rng.random() < 0.4:
        return []
    color = (0.02, 0.02, 0.02) if rng.random() < 0.6 else _STEEL
    parts = []
    for axle, start, end in ((REAR, 35, 190), (FRONT, 20, 130)):
        vertices, faces = tube(_arc(axle, WHEEL_M + 0.018, start, end, 14), 0.006, 6)
        parts.append(part(vertices * [1, 4.0, 1], faces, "metal", BICYCLE, color=color))
    return parts


def _lights(fit: _Fit) -> list[Part]:
    """A front lamp at the head tube and a tail lamp below the saddle."""
    front = np.add(HEAD_HIGH, [0.06, 0.0, 0.02])
    rear = np.add(fit.saddle, [-0.1, 0.0, -0.12])
    return [
        part(*box((0.05, 0.05, 0.05), front), "lamp", BICYCLE, color=(0.72, 0.72, 0.7)),
        part(*box((0.02, 0.05, 0.04), rear), "lamp", BICYCLE, color=(0.35, 0.01, 0.01)),
    ]


def _turned(model: Model, R: Array) -> Model:
    """The model turned about the origin and set back on the ground."""
    lowest = min(float((p.vertices @ R.T)[:, 2].min()) for p in model)
    return [replace(p, vertices=p.vertices @ R.T - [0.0, 0.0, lowest]) for p in model]
