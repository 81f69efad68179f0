"""Rectangles and boxes in a local frame: what buildings are made of.

``quads`` (Q, 4, 3) are planar corners, counter-clockwise seen from outside. On a wall the frame
is x along the wall (to the right for someone who faces it), y up, z out of the wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.mesh import Part, cross, part, quads_to_triangles, tube
from simgen.schema import LABELS

Array = NDArray[np.float64]

# Corners of a box's sides: 0 takes the low coordinate, 1 the high one; x faces −x, X faces +x.
_SIDES = {
    "x": ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
    "X": ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
    "y": ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
    "Y": ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
    "z": ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
    "Z": ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
}


@dataclass(frozen=True, eq=False)
class Frame:
    """A right-handed orthonormal frame; rows of ``axes`` are its x, y, z in the world."""

    origin: Array
    axes: Array

    def world(self, points: Array) -> Array:
        """World coordinates of local points (…, 3)."""
        return self.origin + points @ self.axes


WORLD = Frame(np.zeros(3), np.eye(3))


def upright(origin: ArrayLike, out: ArrayLike) -> Frame:
    """The frame of a wall at ``origin`` (3,) that faces the horizontal direction ``out`` (2,)."""
    nx, ny = np.asarray(out, dtype=np.float64) / np.linalg.norm(out)
    axes = np.array([[-ny, nx, 0.0], [0.0, 0.0, 1.0], [nx, ny, 0.0]])
    return Frame(np.asarray(origin, dtype=np.float64), axes)


def rectangles(rects: ArrayLike, depth: ArrayLike) -> Array:
    """Quads that face +z at ``depth`` from (M, 4) rows of left, bottom, right, top."""
    r = np.asarray(rects, dtype=np.float64).reshape(-1, 4)
    z = np.broadcast_to(np.asarray(depth, dtype=np.float64), (len(r),))
    xy = r[:, [[0, 1], [2, 1], [2, 3], [0, 3]]]
    return np.concatenate([xy, np.broadcast_to(z[:, None, None], (len(r), 4, 1))], axis=2)


def inset(rects: Array, by: float) -> Array:
    """Rectangles (…, 4) made smaller on all four sides."""
    return rects + np.array([by, by, -by, -by])


def raised(points: Array, by: float) -> Array:
    """Points (…, 3) moved along z."""
    return points + np.array([0.0, 0.0, by])


def boxes(lo: ArrayLike, hi: ArrayLike, sides: str = "xXyYzZ") -> Array:
    """Outsides of the boxes between corners (M, 3); quads of one box follow each other."""
    low, high = np.broadcast_arrays(*(np.asarray(c, np.float64).reshape(-1, 3) for c in (lo, hi)))
    pick = np.array([_SIDES[s] for s in sides], dtype=bool)
    return np.where(pick, high[:, None, None], low[:, None, None]).reshape(-1, 4, 3)


def slabs(rects: Array, near: float, far: float, sides: str = "xXyYZ") -> Array:
    """Boxes over rectangles (M, 4) between two depths; by default without the side at ``near``."""
    r = np.asarray(rects, dtype=np.float64).reshape(-1, 4)
    lo = np.insert(r[:, :2], 2, near, axis=1)
    hi = np.insert(r[:, 2:], 2, far, axis=1)
    return boxes(lo, hi, sides)


def inside_out(quads: Array) -> Array:
    """The same quads facing the other way."""
    return quads[:, ::-1]


def painted(frame: Frame, quads: Array, color: ArrayLike, material: str = "matte") -> Part:
    """A part of building; ``color`` (3,) or (M, 3) for M equal runs of quads."""
    c = np.asarray(color, dtype=np.float32).reshape(-1, 3)
    if len(c) > 1:
        c = np.repeat(c, 4 * len(quads) // len(c), axis=0)
    return part(*_mesh(frame, quads), material, LABELS["building"], color=c)


def pipe(points: Array, radius: float, color: ArrayLike) -> Part:
    """A gutter or downpipe along world points (N, 3)."""
    vertices, faces = tube(points, radius, sides=6)
    return part(vertices, faces, "metal", LABELS["building"], color=color)


def sheeted(frame: Frame, quads: Array, material: str, uv: Array) -> Part:
    """A part of building with metres on its sheet (Q, 4, 2) as uv."""
    return part(*_mesh(frame, quads), material, LABELS["building"], uv=uv)


def unrolled(quads: Array) -> Array:
    """(Q, 4, 2) metres along a wall and up, which go on where its face turns inwards."""
    normal = np.abs(cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]))
    xy = quads[..., :2].copy()
    for axis in (0, 1):
        turned = np.argmax(normal, axis=1) == axis
        xy[turned, :, axis] += quads[turned, :, 2]
    return xy


def _mesh(frame: Frame, quads: Array) -> tuple[Array, NDArray[np.int64]]:
    corners = np.arange(4 * len(quads)).reshape(-1, 4)
    return frame.world(quads).reshape(-1, 3), quads_to_triangles(corners)


def offset_ring(ring: Array, distance: float) -> Array:
    """A counter-clockwise ring (N, 2) grown outwards, with mitred corners."""
    edge = np.roll(ring, -1, axis=0) - ring
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    out = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    before = np.roll(out, 1, axis=0)
    return ring + distance * (out + before) / (1 + (out * before).sum(axis=1))[:, None]


def band(ring: Array, outer: float, inner: float, z0: float, z1: float) -> Array:
    """World quads of a moulding around a building, from offset ``inner`` to ``outer`` [m]."""
    rings = [(outer, z0), (outer, z1), (inner, z1), (inner, z0)]
    loops = [np.insert(offset_ring(ring, d), 2, z, axis=1) for d, z in rings]
    return np.concatenate(
        [curtain(a, b) for a, b in zip(loops, loops[1:] + loops[:1], strict=True)]
    )


def curtain(bottom: Array, top: Array) -> Array:
    """Quads between two closed loops (N, 3), facing outwards where ``top`` is above."""
    return np.stack([bottom, np.roll(bottom, -1, axis=0), np.roll(top, -1, axis=0), top], axis=1)
