"""Fascia boards, lettering, awnings and displays of shops; frames as in facades.py."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from simgen.facades import SHOPS, WHITE, Wall
from simgen.mesh import Model, Part
from simgen.signs import Rect
from simgen.solids import Frame, inset, painted, rectangles, sheeted, slabs

Array = NDArray[np.float64]


def shop_boards(
    wall: Wall, rects: Array, *, names: Sequence[Rect], rng: np.random.Generator
) -> Model:
    """Fascia boards over runs of one to three shop windows, with printed names and awnings.

    ``names`` are cells of the sign atlas; without any, boards stay blank.
    """
    if len(rects) < 2 or rects[:, 3].max() < 2.6:
        return []
    rects = rects[np.argsort(rects[:, 0])]
    head = float(rects[:, 3].max())
    model, start = [], 0
    while start < len(rects):
        end = min(start + int(rng.integers(1, 4)), len(rects))
        span = (float(rects[start, 0]) - 0.12, float(rects[end - 1, 2]) + 0.12)
        color = np.array(SHOPS[rng.integers(len(SHOPS))])
        board = np.array([[span[0], head + 0.12, span[1], head + 0.72]])
        model.append(painted(wall.frame, slabs(board, 0.0, 0.12), color))
        if names:
            model.append(_name(wall.frame, board[0], names[int(rng.integers(len(names)))]))
        if rng.random() < 0.35:
            model += _awning(wall.frame, span, head + 0.1, color, rng)
        start = end
    return model


NAME_ASPECT = 512 / 103
"""width over height of a shop's cell in the sign atlas"""


def _name(frame: Frame, board: Array, cell: Rect) -> Part:
    """A printed name in the middle of a board (left, bottom, right, top)."""
    middle, size = (board[:2] + board[2:]) / 2, board[2:] - board[:2] - 0.06
    width = min(size[0], size[1] * NAME_ASPECT)
    half = np.array([width, width / NAME_ASPECT]) / 2
    quad = rectangles([*(middle - half), *(middle + half)], 0.13)
    u0, v0, u1, v1 = cell
    uv = np.array([[(u0, v1), (u1, v1), (u1, v0), (u0, v0)]])
    return sheeted(frame, quad, "sign", uv)


def _awning(
    frame: Frame, span: tuple[float, float], y: float, color: Array, rng: np.random.Generator
) -> Model:
    """Striped cloth that slopes down over the pavement, with a valance."""
    reach, drop = rng.uniform(0.9, 1.4), 0.45
    count = max(round((span[1] - span[0]) / 0.35), 2)
    x = np.linspace(*span, count + 1)
    profile = [(y, 0.03), (y - drop, reach), (y - drop - 0.2, reach + 0.005)]  # (height, out)
    strips = [
        np.array([[(a, y1, z1), (b, y1, z1), (b, y0, z0), (a, y0, z0)]
                  for a, b in pairwise(x)])
        for (y0, z0), (y1, z1) in pairwise(profile)
    ]  # fmt: skip
    stripe = np.where(np.arange(count)[:, None] % 2, color, np.array(WHITE))
    cloth = np.stack(strips, axis=1).reshape(-1, 4, 3)
    return [painted(frame, cloth, stripe)]


def displays(frame: Frame, shops: Array, depth: float, rng: np.random.Generator) -> Model:
    """Posters and goods in shop windows."""
    if not len(shops):
        return []
    each = rng.integers(1, 4, len(shops))
    box = np.repeat(inset(shops, 0.1), each, axis=0)
    size = box[:, 2:] - box[:, :2]
    span = size * rng.uniform((0.1, 0.15), (0.35, 0.45), size.shape)
    low = box[:, :2] + (size - span) * rng.random(size.shape) * (1.0, 0.5)
    color = rng.uniform(0.03, 0.5, (len(box), 1)) * rng.uniform(0.6, 1.2, (len(box), 3))
    depths = depth + 0.005 * (np.arange(len(box)) % 3)  # never two of a window in one plane
    return [painted(frame, rectangles(np.hstack([low, low + span]), depths), color)]
