"""Which place of its sheet each surface shows: two that are seen show two, as far as sheets go.

A sheet is a square of 32 m (bark: 16 m) that continues on its opposite sides, and all walls of a
material, or all trunks, share it. Walls are therefore cut into *panels* no larger than a sheet,
each panel shows a *place*: a rectangle of the sheet, as it is or mirrored. Places are dealt out so
that they overlap least, what is near the rig before what is far away. Mirrored walls are no copies
of those that are not. Limbs are many and thin: they lie anywhere.

Courses of all walls repeat every ``sheets.RISE_M`` up a sheet, their blocks do not: panels whose
places are whole rises apart continue each other's courses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.massing import Massing
from simgen.sheets import BARK_M, RISE_M, WALL_M
from simgen.solids import Frame

Array = NDArray[np.float64]

CELL_M = 0.8
"""Places are whole cells of a sheet."""
CELLS = round(WALL_M / CELL_M)
BARK_CELLS = round(BARK_M / CELL_M)
CELLS_PER_RISE = round(RISE_M / CELL_M)
EYE_M = 3.0
"""Height above the start of the road from which nothing more is seen than from the cameras'."""
LEAST_M = 12.0
"""Nearer surfaces count as if they were that far away."""
ASIDE = 1.4
"""Beyond that share of the distance ahead, a wide lens sees nothing."""
SLACK_M = 8.0
SIGHT_M = 160.0
"""What is farther away, behind buildings or turned away lies anywhere on its sheet."""


@dataclass(frozen=True)
class Place:
    """How a surface lies on its sheet."""

    u: float = 0.0
    v: float = 0.0
    mirrored: bool = False

    def uv(self, xy: Array) -> Array:
        """Sheet coordinates (…, 2) of points (…, 2) on the surface [m]."""
        return xy * (-1.0 if self.mirrored else 1.0, 1.0) + (self.u, self.v)


class Places:
    """The sheets of a scene and what of them is taken."""

    def __init__(
        self, way: ArrayLike, blocks: Sequence[Massing] = (), *, rng: np.random.Generator
    ) -> None:
        """``way`` (N, 2) is where the rig stands in the frames; ``blocks`` hide what is behind."""
        self._eyes = _eyes(np.asarray(way, dtype=np.float64).reshape(-1, 2))
        self._edges = _edges(blocks)
        self._rng = rng
        self._taken: dict[str, Array] = {}

    def take(
        self, material: str, frame: Frame, rect: ArrayLike, *, phase: int | None = None
    ) -> Place:
        """The place of the rectangle left, bottom, right, top of a surface in its frame.

        With a ``phase`` its courses begin that many cells above those of the sheet.
        """
        left, bottom, right, top = np.asarray(rect, dtype=np.float64)
        weight = self._weight(frame, np.array([(left + right) / 2, (bottom + top) / 2, 0.0]),
                              (right - left) / 2)  # fmt: skip
        below = int(np.floor(bottom / CELL_M))  # in cells, so that v is whole cells at y = 0
        n = cells_of(material)
        width = min(int(np.ceil((right - left) / CELL_M)), n)
        height = min(int(np.ceil(top / CELL_M)) - below, n)
        rows = np.arange(n)
        if phase is not None:
            rows = np.arange(n // CELLS_PER_RISE) * CELLS_PER_RISE + phase + below
        rows = rows % n
        mirrored, row, column = self._dealt(material, rows, (height, width), weight)
        v = float((row - below) * CELL_M)
        if mirrored:
            return Place(float((column + width) * CELL_M + left), v, True)
        return Place(float(column * CELL_M - left), v, False)

    def free(self, material: str) -> float:
        """What is still free of a sheet, in 0..1."""
        return float(np.exp(-self._taken[material].mean())) if material in self._taken else 1.0

    def _weight(self, frame: Frame, middle: Array, reach: float) -> float:
        """How much a repetition there would matter: 0 where no camera looks, 1 close by."""
        at, (right, _, out) = frame.world(middle), frame.axes
        x, y, z = at.tolist()
        nx, ny, nz = out.tolist()
        nearest = SIGHT_M
        for ex, ey, ax, ay in self._eyes:
            dx, dy = x - ex, y - ey
            along, aside = ax * dx + ay * dy, abs(ax * dy - ay * dx)
            faces = dx * nx + dy * ny + (z - EYE_M) * nz < 0
            if faces and along > -(slack := reach + SLACK_M) and aside < ASIDE * along + 2 * slack:
                nearest = min(nearest, hypot(dx, dy) - reach)
        if nearest >= SIGHT_M:
            return 0.0
        ends = at + np.array([[-0.9], [0.0], [0.9]]) * reach * right
        if all(self._hidden(ends, np.array(eye[:2])) for eye in self._eyes):
            return 0.0
        return float((LEAST_M / max(nearest, LEAST_M)) ** 2)

    def _hidden(self, points: Array, eye: Array) -> bool:
        """Whether buildings stand between an eye (2,) and each of some points (P, 3)."""
        start, edge, top = self._edges
        ray = points[:, None, :2] - eye  # (P, 1, 2)
        across = _cross(ray, edge)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = _cross(start - eye, edge) / across  # share of the ray, (P, E)
            along = _cross(start - eye, ray) / across
        level = EYE_M + far * (points[:, None, 2] - EYE_M)
        behind = (far > 0) & (far < 0.98) & (along >= 0) & (along <= 1) & (level < top)
        return bool(behind.any(axis=1).all())

    def _dealt(
        self, material: str, rows: NDArray[np.int64], hw: tuple[int, int], weight: float
    ) -> tuple[bool, int, int]:
        """Takes one of the least taken places that begin in one of the rows."""
        n = cells_of(material)
        if weight == 0:
            pick = int(self._rng.integers(2 * len(rows) * n))
            side, row = divmod(pick // n, len(rows))
            return bool(side), int(rows[row]), pick % n
        taken = self._taken.setdefault(material, np.zeros((2, n, n)))
        cost = _box_sums(taken, hw)[:, rows]
        cost -= 1e-9 * _touching(taken, hw)[:, rows]  # edge to edge leaves the largest rest
        cost += 1e-10 * self._rng.random(cost.shape)
        side, i, column = (int(k) for k in np.unravel_index(np.argmin(cost), cost.shape))
        height, width = hw
        down = (rows[i] + np.arange(height)) % n
        across = (column + np.arange(width)) % n
        taken[side, down[:, None], across] += weight
        return bool(side), int(rows[i]), column


def cells_of(material: str) -> int:
    """How many cells a side of the sheet of a material has."""
    return BARK_CELLS if material == "bark" else CELLS


def _eyes(way: Array) -> list[tuple[float, ...]]:
    """Where the rig begins, is half-way and ends, and a unit vector of where it looks."""
    ahead = np.gradient(way, axis=0) if len(way) > 1 else np.array([[1.0, 0.0]])
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    picked = np.unique([0, len(way) // 2, len(way) - 1])
    return [tuple(row) for row in np.hstack([way, ahead])[picked].tolist()]


def _edges(blocks: Sequence[Massing]) -> tuple[Array, Array, Array]:
    """Starts (E, 2), directions (E, 2) and heights (E,) of the outlines of buildings."""
    rings = [block.footprint for block in blocks]
    top = [np.full(len(b.footprint), b.base_z + b.wall_height) for b in blocks]
    start = np.concatenate([np.empty((0, 2)), *rings])
    edge = np.concatenate([np.empty((0, 2)), *(np.roll(r, -1, axis=0) - r for r in rings)])
    return start, edge, np.concatenate([np.empty(0), *top])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _touching(taken: Array, hw: tuple[int, int]) -> Array:
    """(L, N, N) how many taken cells lie within or right beside the box at each cell."""
    n = taken.shape[1]
    around = min(hw[0] + 2, n), min(hw[1] + 2, n)
    return np.roll(_box_sums((taken > 0).astype(np.float64), around), 1, axis=(1, 2))


def _box_sums(cells: Array, hw: tuple[int, int]) -> Array:
    """(L, N, N) sums over the h × w cells that begin at each cell and go on around the borders."""
    height, width = hw
    n = cells.shape[1]
    sums = np.zeros((len(cells), n + height, n + width), cells.dtype)
    sums[:, :n, :n] = cells
    sums[:, n:, :n] = cells[:, :height]
    sums[:, :, n:] = sums[:, :, :width]
    sums = sums.cumsum(axis=1).cumsum(axis=2)
    sums = np.pad(sums, ((0, 0), (1, 0), (1, 0)))
    low, high = sums[:, :n], sums[:, height : n + height]
    box = high[:, :, width : n + width] - high[:, :, :n] - low[:, :, width : n + width]
    return np.asarray(box + low[:, :, :n])
