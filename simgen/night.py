"""What gives light at night: lamps as light sources, and faces that glow.

Street lamps and the headlights of the rig are sources that light the scene. Everything that can
be *seen* to burn (lit windows, lamps of vehicles, signals, luminaires) is a face with a radiance
of its own [kcd/m²], which glow.py adds to what the face reflects; as sources there would be too
many of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simgen.geometry import Array
from simgen.layout import Layout
from simgen.mesh import Part
from simgen.scene import Lamp
from simgen.schema import LABELS

WARM, NEUTRAL, COOL = (1.0, 0.62, 0.30), (1.0, 0.80, 0.58), (0.85, 0.93, 1.0)
LUMINAIRE, HEADLAMP, TAIL, SIGNAL = 12.0, 14.0, 1.6, 4.0
"""kcd/m² of what a face of colour 1 sends out: seen from the side, not down the beam"""
WINDOW = (0.003, 0.03)
"""kcd/m² of lit rooms, log-uniform"""
LIT_SHARE = 0.28
_HEADLAMP = np.array([1.0, 0.94, 0.83])
_DIPPED = ((9.0, -0.03, 8.0, 1.5), (1.7, -0.1, 50.0, 12.0))
"""(kcd, slope of the axis, cut-off [°], full within [°]) of a dipped beam: far down the lane, and
wide in front. Source: UNECE R112 asks for 10.1 kcd at 75R, 0.6° below the horizon, and for 1.7 kcd
at 25L and 25R, 9° to the sides."""
_STREET_LAMP_KCD = 2.9


def glowing(model: list[Part], *, rng: np.random.Generator) -> list[Part]:
    """The model with what burns on it at night: vehicles that move, lamps, signals, windows."""
    return [_lit(p, rng) for p in model]


def _lit(p: Part, rng: np.random.Generator) -> Part:
    if p.color is None:
        return p
    if p.material == "lamp":
        return replace(p, emission=_of_lamp(p))
    if p.material == "glass" and p.semantic == LABELS["building"]:
        return replace(p, emission=_of_windows(p, rng))
    return p


def _of_lamp(p: Part) -> NDArray[np.float32]:
    """By class and colour: red and white burn on vehicles, amber only blinks."""
    assert p.color is not None
    color = p.color[p.faces[:, 0]]
    if p.semantic == LABELS["traffic light"]:
        return color * (SIGNAL * (color.max(axis=1, keepdims=True) > 0.2)).astype(np.float32)
    if p.semantic == LABELS["pole"]:
        return color * np.float32(LUMINAIRE)
    white, red = color.min(axis=1) > 0.4, color[:, 0] > 10 * color[:, 1]
    strength = np.where(white, HEADLAMP, np.where(red, TAIL, 0.0))
    return color * strength[:, None].astype(np.float32)


def _of_windows(p: Part, rng: np.random.Generator) -> NDArray[np.float32]:
    """Some panes with the light of a lamp or of a screen behind them.

    The two triangles of a pane share their first corner.
    """
    corners, pane = np.unique(p.faces[:, 0], return_inverse=True)
    num = len(corners)
    tint = np.array([WARM, NEUTRAL, COOL])[rng.choice(3, num, p=[0.65, 0.25, 0.1])]
    strength = np.exp(rng.uniform(np.log(WINDOW[0]), np.log(WINDOW[1]), num)) * (
        rng.random(num) < LIT_SHARE
    )
    return (tint * strength[:, None])[pane].astype(np.float32)


def lamps(layout: Layout, T_world_vehicle: Array) -> list[Lamp]:
    """The rig's own headlights, and street lamps, those nearest to where it stands first."""
    T = T_world_vehicle
    own = [
        Lamp(T[:3, :3] @ np.array([0.4, y, 0.7]) + T[:3, 3],
             T[:3, :3] @ np.array([1.0, 0.0, slope]), _HEADLAMP * kcd, cutoff_deg, beam_deg)
        for y in (0.65, -0.65) for kcd, slope, cutoff_deg, beam_deg in _DIPPED
    ]  # fmt: skip
    if not layout.lights:
        return own
    heads = np.concatenate(layout.lights)
    nearest = heads[np.argsort(np.linalg.norm(heads[:, :2] - T[:2, 3], axis=1))]
    down, color = np.array([0.0, 0.0, -1.0]), np.array(NEUTRAL) * _STREET_LAMP_KCD
    return own + [Lamp(xyz - [0, 0, 0.05], down, color, 75.0, 55.0) for xyz in nearest]
