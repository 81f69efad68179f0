"""Triangle meshes of scene models, before they are merged for the renderer.

A *part* is a mesh of one material and one semantic class; a *model* is a list of parts in the
frame of the object: x forward, y left, z up, origin on the ground below its middle, metres.
Faces wind counter-clockwise seen from outside. Colours are linear RGB albedos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vertices = NDArray[np.float64]  # (V, 3) [m]
Faces = NDArray[np.int64]  # (F, 3) vertex indices


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material and one semantic class.

    A material is coloured either by ``color`` or by ``uv``: materials.py says which.
    """

    vertices: Vertices
    faces: Faces
    material: str
    """a name of materials.MATERIALS"""
    semantic: int
    """Cityscapes label id, see schema.LABELS"""
    color: NDArray[np.float32] | None = None
    """(V, 3) linear RGB albedo"""
    uv: NDArray[np.float32] | None = None
    """(V, 2): metres on the surface, or [0, 1]² for the sign atlas"""
    instance: int = 0
    """0 = none; set when the model is placed"""
    emission: NDArray[np.float32] | None = None
    """(F, 3) radiance that each face sends out by itself, set at night; see night.py"""


Model = list[Part]


def part(
    vertices: ArrayLike,
    faces: ArrayLike,
    material: str,
    semantic: int,
    *,
    color: ArrayLike | None = None,
    uv: ArrayLike | None = None,
) -> Part:
    """Builds a part; one colour (3,) is spread over all vertices."""
    v = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    f = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    if color is not None:
        color = np.array(np.broadcast_to(np.asarray(color, dtype=np.float32), v.shape))
    if uv is not None:
        uv = np.asarray(uv, dtype=np.float32).reshape(-1, 2)
    return Part(v, f, material, semantic, color=color, uv=uv)


def placed(
    model: Sequence[Part],
    *,
    xyz: ArrayLike,
    heading_rad: float = 0.0,
    scale: float | ArrayLike = 1.0,
    instance: int = 0,
    normal: ArrayLike | None = None,
) -> Model:
    """The model scaled, turned by ``heading_rad`` about z (counter-clockwise) and moved to ``xyz``.

    With ``normal`` (3,), the model's z axis is tilted onto that direction (a car on a slope).
    """
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    if normal is not None:
        z = np.asarray(normal, dtype=np.float64) / np.linalg.norm(np.asarray(normal))
        y = np.cross(z, R[:, 0])
        y /= np.linalg.norm(y)
        R = np.stack([np.cross(y, z), y, z], axis=1)
    offset = np.asarray(xyz, dtype=np.float64)
    return [
        replace(p, vertices=(p.vertices * np.asarray(scale)) @ R.T + offset, instance=instance)
        for p in model
    ]


def merged(parts: Sequence[Part]) -> Part:
    """One part from several of the same material, semantic class and instance."""
    first = parts[0]
    kinds = {(p.material, p.semantic, p.instance) for p in parts}
    if len(kinds) != 1:
        raise ValueError(f"merged: parts must share material, semantic, instance; got {kinds}")
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return replace(
        first,
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]),
        color=_concatenated([p.color for p in parts]),
        uv=_concatenated([p.uv for p in parts]),
    )


def _concatenated(
    arrays: Sequence[NDArray[np.float32] | None],
) -> NDArray[np.float32] | None:
    if arrays[0] is None:
        return None
    return np.concatenate([a for a in arrays if a is not None])


def box(size: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Vertices, Faces]:
    """An axis-aligned box with flat-shaded sides (24 vertices, 12 faces)."""
    half = np.asarray(size, dtype=np.float64) / 2
    vertices: list[Vertices] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, a] = [-1, 1, 1, -1]
            corners[:, b] = [-1, -1, 1, 1]
            order = [0, 1, 2, 3] if sign > 0 else [0, 3, 2, 1]
            base = len(vertices) * 4
            vertices.append(corners[order])
            faces += [[base, base + 1, base + 2], [base, base + 2, base + 3]]
    return np.concatenate(vertices) * half + np.asarray(center), np.array(faces)


def tube(
    path: ArrayLike, radius: ArrayLike, sides: int = 8, caps: bool = True
) -> tuple[Vertices, Faces]:
    """A round tube along a polyline ``path`` (N, 3); ``radius`` is one number or (N,) [m]."""
    p = np.asarray(path, dtype=np.float64)
    r = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(p),))
    tangent = np.gradient(p, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(tangent).max(axis=0))]  # least parallel to the path
    u = np.cross(tangent, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w = np.cross(tangent, u)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * w[:, None]
    vertices = (p[:, None] + r[:, None, None] * ring).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(p) - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    quads = np.stack([a, b, b + sides, a + sides], axis=-1).reshape(-1, 4)
    faces = quads_to_triangles(quads)
    if caps:
        n = len(vertices)
        vertices = np.concatenate([vertices, p[[0, -1]]])
        k = np.arange(sides)
        last = (len(p) - 1) * sides
        start = np.stack([np.full(sides, n), (k + 1) % sides, k], axis=1)
        end = np.stack([np.full(sides, n + 1), last + k, last + (k + 1) % sides], axis=1)
        faces = np.concatenate([faces, start, end])
    return vertices, faces


def loft(sections: ArrayLike, caps: bool = True) -> tuple[Vertices, Faces]:
    """Skins closed sections (N, M, 3), each an M-gon, counter-clockwise seen against the path."""
    s = np.asarray(sections, dtype=np.float64)
    n, m = s.shape[:2]
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij")
    a, b = i * m + j, i * m + (j + 1) % m
    faces = quads_to_triangles(np.stack([a, b, b + m, a + m], axis=-1).reshape(-1, 4))
    vertices = s.reshape(-1, 3)
    if caps:
        k = np.arange(1, m - 1)
        start = np.stack([np.zeros_like(k), k + 1, k], axis=1)
        end = np.stack([np.zeros_like(k), k, k + 1], axis=1) + (n - 1) * m
        faces = np.concatenate([faces, start, end])
    return vertices, faces


def quads_to_triangles(quads: NDArray[np.int64]) -> Faces:
    """(Q, 4) vertex indices to (2Q, 3)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
