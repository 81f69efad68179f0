"""Triangle meshes of scene models, before they are merged for the renderer.

A *part* is a mesh of one material and one semantic class; a *model* is a list of parts in the
frame of the object: x forward, y left, z up, origin on the ground below its middle, metres.
Faces wind counter-clockwise seen from outside. Colours are linear RGB albedos.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import product

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
    normals: NDArray[np.float32] | None = None
    """(V, 3) unit vectors that a curved surface is shaded with, see :func:`smooth`; None: flat"""
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
    offset, size = np.asarray(xyz, dtype=np.float64), np.asarray(scale, dtype=np.float64)
    return [
        replace(
            p,
            vertices=(p.vertices * size) @ R.T + offset,
            normals=None if p.normals is None else _unit(p.normals / size) @ R.T,
            instance=instance,
        )
        for p in model
    ]


def merged(parts: Sequence[Part]) -> Part:
    """One part from several of the same material, semantic class and instance."""
    if any(p.normals is not None for p in parts):
        parts = [flat(p) if p.normals is None else p for p in parts]
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
        normals=_concatenated([p.normals for p in parts]),
    )


def _concatenated(
    arrays: Sequence[NDArray[np.float32] | None],
) -> NDArray[np.float32] | None:
    if arrays[0] is None:
        return None
    return np.concatenate([a for a in arrays if a is not None])


def flat(p: Part) -> Part:
    """The part as it is without normals, but with those of its faces: three corners for each."""
    corners = p.faces.ravel()
    normals = np.repeat(_unit(_face_normals(p.vertices, p.faces)), 3, axis=0)
    return _at_corners(p, corners, np.arange(len(corners)).reshape(-1, 3), normals)


def smooth(p: Part, crease_deg: float = 50.0) -> Part:
    """The part with normals that run smoothly over all edges but creases.

    A corner's normal is the mean, weighted by area, over the faces around its point that are
    turned by less than ``crease_deg`` from its own; a vertex is split where normals differ.
    """
    corners = p.faces.ravel()
    _, point = np.unique(_places(p.vertices)[corners], return_inverse=True)
    by_area = np.repeat(_face_normals(p.vertices, p.faces), 3, axis=0)
    own, mean = _unit(by_area), _unit(_sums(by_area, point))
    cos_crease, cos_half = np.cos(np.deg2rad(crease_deg) / np.array([1, 2]))
    torn = np.zeros(len(mean), dtype=bool)  # points where some faces might be too far apart
    torn[point[np.einsum("ij,ij->i", own, mean[point]) < cos_half]] = True
    normals = mean[point]
    some = np.flatnonzero(torn[point])
    mine, other = _meeting(point[some])
    alike = np.einsum("ij,ij->i", own[some[mine]], own[some[other]]) > cos_crease
    normals[some] = _unit(_sums(by_area[some[other[alike]]], mine[alike]))
    steps = np.rint((normals + 1) * 2000).astype(np.int64) @ [1, 2**12, 2**24]
    _, first, faces = np.unique(corners * 2**36 + steps, return_index=True, return_inverse=True)
    return _at_corners(p, corners[first], faces.reshape(-1, 3), normals[first])


def _sums(vectors: Vertices, group: NDArray[np.int64]) -> Vertices:
    """The sum of the vectors (N, 3) of each group (N,)."""
    return np.stack([np.bincount(group, v) for v in vectors.T], axis=1)


def _at_corners(p: Part, pick: NDArray[np.int64], faces: Faces, normals: Vertices) -> Part:
    """The part with picked vertices and new faces and normals."""
    return replace(
        p,
        vertices=p.vertices[pick],
        faces=faces,
        color=None if p.color is None else p.color[pick],
        uv=None if p.uv is None else p.uv[pick],
        normals=normals.astype(np.float32),
    )


def _face_normals(vertices: Vertices, faces: Faces) -> Vertices:
    """(F, 3), as long as twice the area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return cross(b - a, c - a)


def cross(a: ArrayLike, b: ArrayLike) -> Vertices:
    """Cross products (…, 3); np.cross is several times slower."""
    u, v = np.asarray(a), np.asarray(b)
    ux, uy, uz = u[..., 0], u[..., 1], u[..., 2]
    vx, vy, vz = v[..., 0], v[..., 1], v[..., 2]
    x = uy * vz - uz * vy
    product = np.empty((*x.shape, 3), x.dtype)
    product[..., 0] = x
    product[..., 1] = uz * vx - ux * vz
    product[..., 2] = ux * vy - uy * vx
    return product


def _unit(vectors: NDArray[np.floating]) -> Vertices:
    """Unit vectors; up where there is no direction."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    unit = vectors / np.maximum(length, 1e-30)
    unit[length[:, 0] == 0] = [0.0, 0.0, 1.0]
    return unit


def _places(vertices: Vertices) -> NDArray[np.int64]:
    """(V,) a number for the place of each vertex, the same for equal places (to 0.1 mm or so)."""
    low = vertices.min(axis=0)
    step = max(1e-4, float((vertices - low).max()) / 2**20)
    return np.asarray(np.rint((vertices - low) / step).astype(np.int64) @ [1, 2**21, 2**42])


def _meeting(point: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All ordered pairs of corners at the same point (C,), each with itself, too."""
    _, group, count = np.unique(point, return_inverse=True, return_counts=True)
    order = np.argsort(group, kind="stable")
    start = np.cumsum(count) - count
    partners = count[group]
    mine = np.repeat(np.arange(len(point)), partners)
    step = np.arange(len(mine)) - np.repeat(np.cumsum(partners) - partners, partners)
    return mine, order[np.repeat(start[group], partners) + step]


IMAGE_ROWS = 16
"""of a full-size image, worked on while they are in the cache, see :func:`blocks`"""


def blocks(num: int, size: int = 1 << 14) -> Iterator[slice]:
    """Slices of 0..num, short enough that what is computed on one stays in the cache."""
    return (slice(i, min(i + size, num)) for i in range(0, num, size))


def box(size: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Vertices, Faces]:
    """An axis-aligned box with flat-shaded sides (24 vertices, 12 faces)."""
    vertices, faces = _unit_box()
    return vertices * np.asarray(size, dtype=np.float64) + np.asarray(center), faces


@cache
def _unit_box() -> tuple[Vertices, Faces]:
    sides = []
    for axis, sign in product(range(3), (-0.5, 0.5)):
        corners = np.full((4, 3), sign)
        corners[:, axis - 2] = [-0.5, 0.5, 0.5, -0.5]
        corners[:, axis - 1] = [-0.5, -0.5, 0.5, 0.5]
        sides.append(corners if sign > 0 else corners[[0, 3, 2, 1]])
    return np.concatenate(sides), quads_to_triangles(np.arange(24).reshape(-1, 4))


def tube(
    path: ArrayLike, radius: ArrayLike, sides: int = 8, caps: bool = True
) -> tuple[Vertices, Faces]:
    """A round tube along a polyline ``path`` (N, 3); ``radius`` is one number or (N,) [m]."""
    p = np.asarray(path, dtype=np.float64)
    r = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(p),))
    tangent = _unit(np.diff(p, axis=0)[[0, -1]] if len(p) == 2 else np.gradient(p, axis=0))
    helper = np.eye(3)[np.argmin(np.abs(tangent).max(axis=0))]  # least parallel to the path
    u = _unit(cross(tangent, np.broadcast_to(helper, tangent.shape)))
    w = cross(tangent, u)
    angle = np.arange(sides)[:, None] * (2 * np.pi / sides)
    ring = np.cos(angle) * u[:, None] + np.sin(angle) * w[:, None]
    vertices = (p[:, None] + r[:, None, None] * ring).reshape(-1, 3)
    if caps:
        vertices = np.concatenate([vertices, p[[0, -1]]])
    return vertices, _tube_faces(len(p), sides, caps)


@cache
def _tube_faces(rings: int, sides: int, caps: bool) -> Faces:
    last, k = (rings - 1) * sides, np.arange(sides)
    following = (k + 1) % sides
    a = np.arange(0, last, sides)[:, None]
    quads = np.stack(
        np.broadcast_arrays(a + k, a + following, a + following + sides, a + k + sides), axis=-1
    )
    faces = quads_to_triangles(quads.reshape(-1, 4))
    if not caps:
        return faces
    tip = np.full(sides, last + sides)
    start = np.stack([tip, following, k], axis=1)
    end = np.stack([tip + 1, last + k, last + following], axis=1)
    return np.concatenate([faces, start, end])


def loft(sections: ArrayLike, caps: bool = True) -> tuple[Vertices, Faces]:
    """Skins closed sections (N, M, 3), each an M-gon, counter-clockwise seen against the path."""
    s = np.asarray(sections, dtype=np.float64)
    return s.reshape(-1, 3), _loft_faces(*s.shape[:2], caps)


@lru_cache(maxsize=512)
def _loft_faces(n: int, m: int, caps: bool) -> Faces:
    """Read-only faces between ``n`` sections of ``m`` corners; most lofts are alike."""
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij")
    a, b = i * m + j, i * m + (j + 1) % m
    faces = quads_to_triangles(np.stack([a, b, b + m, a + m], axis=-1).reshape(-1, 4))
    if caps:
        k = np.arange(1, m - 1)
        start = np.stack([np.zeros_like(k), k + 1, k], axis=1)
        end = np.stack([np.zeros_like(k), k, k + 1], axis=1) + (n - 1) * m
        faces = np.concatenate([faces, start, end])
    faces.flags.writeable = False
    return faces


def quads_to_triangles(quads: NDArray[np.int64]) -> Faces:
    """(Q, 4) vertex indices to (2Q, 3)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
