"""Roofs over footprints.

A roof surface is the lower envelope of planes, h(x, y) = min_k (a_k x + b_k y + c_k), in metres
above the top of the walls. Gabled, hipped, pyramidal, skillion and flat roofs differ in nothing
but their planes; overhangs, gables, ridges and eaves all follow from h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simgen.solids import Frame

Array = NDArray[np.float64]
RoofForm = Literal["flat", "gabled", "hipped", "pyramidal", "skillion"]


@dataclass(frozen=True, eq=False)
class RoofSurface:
    """h(x, y) over the plan of one building."""

    planes: Array
    """(P, 3) rows a, b, c"""

    def heights(self, xy: Array) -> Array:
        """(…, P) height of every plane at points (…, 2)."""
        return xy @ self.planes[:, :2].T + self.planes[:, 2]

    def height(self, xy: Array) -> Array:
        """h (…) at points (…, 2)."""
        return self.heights(xy).min(axis=-1)

    def faces(self, ring: Array) -> list[list[Array]]:
        """For each plane, the convex polygons (N, 2) within ``ring`` where it is the lowest."""
        pieces = convex_pieces(ring)
        return [[p for piece in pieces if len(p := self._lowest(k, piece))] for k in self._range]

    def ridges(self, ring: Array) -> list[Array]:
        """Lines (2, 3), h as z, within ``ring`` along which two planes meet: ridges and hips."""
        lines = []
        for k, polygons in enumerate(self.faces(ring)):
            for polygon in polygons:
                heights = self.heights(polygon)
                tied = np.abs(heights - heights[:, [k]]) < 1e-6
                tied &= np.roll(tied, -1, axis=0)
                for i in np.flatnonzero(tied[:, k + 1 :].any(axis=1)):
                    ends = polygon[[i, (i + 1) % len(polygon)]]
                    lines.append(np.column_stack([ends, self.height(ends)]))
        return lines

    def profile(self, start: Array, end: Array) -> tuple[Array, Array]:
        """h along a straight line as a polyline: shares t (M,) of the way, and h(t) (M,)."""
        h0, h1 = self.heights(start), self.heights(end)
        gap0, gap1 = h0[:, None] - h0, h1[:, None] - h1
        crossing = gap0 * gap1 < 0
        t = np.unique(np.round(gap0[crossing] / (gap0 - gap1)[crossing], 9))
        t = np.concatenate([[0.0], t[(t > 1e-6) & (t < 1 - 1e-6)], [1.0]])
        h = (h0 + t[:, None] * (h1 - h0)).min(axis=1)
        bend = np.abs(np.interp(t[1:-1], t[[0, -1]], h[[0, -1]]) - h[1:-1]) > 1e-9
        keep = np.concatenate([[True], bend, [True]])
        return t[keep], h[keep]

    def outline(self, ring: Array) -> Array:
        """``ring`` with its bends, as a closed loop (M, 3) with h as z."""
        points = []
        for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            t, h = self.profile(start, end)
            points.append(np.column_stack([start + t[:-1, None] * (end - start), h[:-1]]))
        return np.concatenate(points)

    def frame(self, k: int, base_z: float) -> Frame:
        """Axes of plane k: x along its eaves, y up its slope, z its normal."""
        a, b, c = self.planes[k]
        slope = np.hypot(a, b)
        up = np.array([a, b]) / slope if slope > 0 else np.array([0.0, 1.0])
        y = np.array([*up, slope]) / np.hypot(1, slope)
        x = np.array([up[1], -up[0], 0.0])
        return Frame(np.array([0.0, 0.0, base_z + c]), np.stack([x, y, np.cross(x, y)]))

    @property
    def _range(self) -> range:
        return range(len(self.planes))

    def _lowest(self, k: int, polygon: Array) -> Array:
        for j in self._range:
            if j != k and len(polygon):
                polygon = _clipped(polygon, self.planes[k] - self.planes[j])
        return polygon


def roof_surface(ring: Array, form: RoofForm, height: float, ridge_rad: float) -> RoofSurface:
    """The roof ``height`` metres high over a footprint (N, 2).

    ``ridge_rad`` is the direction of the ridge; a skillion roof rises in that direction.
    """
    along = np.array([np.cos(ridge_rad), np.sin(ridge_rad)])
    across = np.array([-along[1], along[0]])
    half_r, mid_r = _extent(ring @ along)
    half_s, mid_s = _extent(ring @ across)

    def rising(direction: Array, middle: float, half: float, run: float) -> Array:
        """Plane that is 0 at the edge of the plan and ``height`` after ``run`` metres."""
        return np.array([*(direction * height / run), (half - middle) * height / run])

    def pair(direction: Array, middle: float, half: float, run: float) -> list[Array]:
        return [rising(direction, middle, half, run), rising(-direction, -middle, half, run)]

    planes = {
        "flat": lambda: [np.zeros(3)],
        "skillion": lambda: [rising(along, mid_r, half_r, 2 * half_r)],
        "gabled": lambda: pair(across, mid_s, half_s, half_s),
        "hipped": lambda: (
            pair(across, mid_s, half_s, half_s) + pair(along, mid_r, half_r, min(half_r, half_s))
        ),
        "pyramidal": lambda: (
            pair(across, mid_s, half_s, half_s) + pair(along, mid_r, half_r, half_r)
        ),
    }
    if form not in planes:
        raise ValueError(f"roof form {form!r} is unknown; choose from {sorted(planes)}")
    return RoofSurface(np.array(planes[form]()))


def convex_pieces(ring: Array) -> list[Array]:
    """A simple counter-clockwise polygon as itself if convex, as triangles (ears) if not."""
    ring = np.asarray(ring, dtype=np.float64)
    pieces = []
    while len(ring) > 3 and (reflex := _turns(ring) < -1e-9).any():
        i = next(i for i in range(len(ring)) if _is_ear(ring, i, ring[reflex]))
        pieces.append(ring[[i - 1, i, (i + 1) % len(ring)]])
        ring = np.delete(ring, i, axis=0)
    return [*pieces, ring]


def _is_ear(ring: Array, i: int, reflex: Array) -> bool:
    """Whether the corner at i can be cut off: it turns left and holds no reflex vertex."""
    triangle = ring[[i - 1, i, (i + 1) % len(ring)]]
    if _turns(triangle)[1] <= 1e-9:
        return False
    edges = np.roll(triangle, -1, axis=0) - triangle
    sides = _cross(edges, reflex[:, None] - triangle)
    return not (sides > 1e-9).all(axis=1).any()


def _turns(ring: Array) -> Array:
    """Twice the signed area of the corner at each vertex: positive for a left turn."""
    return _cross(ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _clipped(polygon: Array, plane: Array) -> Array:
    """The part of a convex polygon where a x + b y + c <= 0 (Sutherland and Hodgman, 1974)."""
    value = polygon @ plane[:2] + plane[2]
    points = []
    for i, (here, ahead) in enumerate(zip(value, np.roll(value, -1), strict=True)):
        if here <= 1e-9:
            points.append(polygon[i])
        if (here < -1e-9 and ahead > 1e-9) or (here > 1e-9 and ahead < -1e-9):
            points.append(
                polygon[i] + here / (here - ahead) * (polygon[(i + 1) % len(value)] - polygon[i])
            )
    return np.array(points) if len(points) > 2 else np.zeros((0, 2))


def _extent(coordinates: Array) -> tuple[float, float]:
    """Half length and middle of an interval."""
    low, high = float(coordinates.min()), float(coordinates.max())
    return (high - low) / 2, (high + low) / 2
