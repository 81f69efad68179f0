"""Colours for fields that are not pictures: depth, labels, instances, flow, flow status.

Every function takes a field (H, W, …) and returns display RGB (H, W, 3) uint8.
"""

from __future__ import annotations

import colorsys

import matplotlib
import numpy as np
from numpy.typing import NDArray

from simgen.schema import (
    AT_INFINITY,
    GLASS,
    LABEL_COLORS,
    LABELS,
    OCCLUDED,
    OUT_OF_FRAME,
    VISIBLE,
)

Rgb = NDArray[np.uint8]

DEPTH_MAP = "turbo_r"
SKY_COLOR = (214, 222, 230)
STATUS_COLORS = {
    VISIBLE: (86, 160, 110),
    OCCLUDED: (214, 84, 64),
    OUT_OF_FRAME: (92, 112, 178),
}
LIGHTENED, DARKENED = (238, 238, 238), (56, 56, 56)
"""What a status colour is mixed with where the surface is at infinity, or is glass."""

_NO_INSTANCE = (232, 232, 232)
_GOLDEN_RATIO = 0.618033988749895  # consecutive ids get hues that are far apart
# Lengths of the six arcs of the Middlebury wheel: red-yellow, yellow-green, … magenta-red.
_WHEEL_ARCS = (15, 6, 4, 11, 13, 6)
_WHEEL_CORNERS = (
    (255, 0, 0),
    (255, 255, 0),
    (0, 255, 0),
    (0, 255, 255),
    (0, 0, 255),
    (255, 0, 255),
)


def depth_colors(depth: NDArray[np.float32], range_m: tuple[float, float]) -> Rgb:
    """Red near, blue far, logarithmic between the ends of ``range_m``; the sky is pale grey."""
    low, high = np.log(range_m)
    known = depth > 0
    level = (np.log(np.where(known, depth, range_m[1])) - low) / (high - low)
    colors = matplotlib.colormaps[DEPTH_MAP](level.clip(0, 1), bytes=True)[..., :3]
    return np.where(known[..., None], colors, np.array(SKY_COLOR, np.uint8))


def label_colors(semantic: NDArray[np.uint8]) -> Rgb:
    """Cityscapes' own colours."""
    table = np.zeros((256, 3), np.uint8)
    for label, color in LABEL_COLORS.items():
        table[label] = color
    table[LABELS["static"]] = (40, 40, 40)  # black is kept for what has no label
    return table[semantic]


def instance_colors(instance: NDArray[np.uint16]) -> Rgb:
    """A colour per id, the same in all cameras; pale grey where there is none."""
    ids, inverse = np.unique(instance, return_inverse=True)
    table = [_instance_color(int(i)) if i else _NO_INSTANCE for i in ids]
    return np.array(table, np.uint8)[inverse.reshape(instance.shape)]


def _instance_color(i: int) -> tuple[int, ...]:
    hue, level = i * _GOLDEN_RATIO % 1.0, 0.6 + 0.35 * (i * _GOLDEN_RATIO * 7 % 1.0)
    return tuple(round(255 * x) for x in colorsys.hsv_to_rgb(hue, 0.75, level))


def flow_colors(flow: NDArray[np.float32], rim_px: float) -> Rgb:
    """The Middlebury wheel: direction is hue, length is saturation up to ``rim_px``.

    Longer vectors keep the hue and are darkened. Source: Baker et al., *A database and evaluation
    methodology for optical flow*, 2011 (colorcode.cpp of its website).
    """
    wheel = _flow_wheel()
    length = np.hypot(flow[..., 0], flow[..., 1])[..., None] / rim_px
    turn = np.arctan2(-flow[..., 1], -flow[..., 0]) / np.pi  # −1 … 1 from the left, clockwise
    place = (turn + 1) / 2 * (len(wheel) - 1)
    below = np.floor(place).astype(int)
    share = (place - below)[..., None]
    color = (1 - share) * wheel[below] + share * wheel[(below + 1) % len(wheel)]
    inside = 255 - length.clip(max=1) * (255 - color)
    return np.where(length <= 1, inside, 0.75 * color).round().astype(np.uint8)


def _flow_wheel() -> NDArray[np.float64]:
    """The 55 colours of the rim."""
    corners = np.array([*_WHEEL_CORNERS, _WHEEL_CORNERS[0]], float)
    ends = np.cumsum((0, *_WHEEL_ARCS))
    steps = np.arange(ends[-1])
    return np.stack([np.interp(steps, ends, corners[:, c]) for c in range(3)], axis=-1)


def status_colors(status: NDArray[np.uint8]) -> Rgb:
    """Hue tells the visibility; pale is at infinity, dark is glass."""
    colors = np.zeros((*status.shape, 3))
    for bit, color in STATUS_COLORS.items():
        colors[(status & bit) > 0] = color
    for bit, tint in ((AT_INFINITY, LIGHTENED), (GLASS, DARKENED)):
        where = (status & bit) > 0
        colors[where] = 0.5 * colors[where] + 0.5 * np.array(tint)
    return colors.astype(np.uint8)
