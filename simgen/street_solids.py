"""The solids that street furniture is put together from, and its colours (linear albedos)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.mesh import (
    Faces,
    Model,
    Part,
    Vertices,
    box,
    loft,
    merged,
    part,
    quads_to_triangles,
    smooth,
    tube,
)
from simgen.schema import LABELS

Array = NDArray[np.float64]

STATIC, POLE = LABELS["static"], LABELS["pole"]
UP = np.array([0.0, 0.0, 1.0])

STEEL, CONCRETE, BLACK = (0.42, 0.43, 0.44), (0.35, 0.33, 0.29), (0.025, 0.025, 0.027)
WHITE, RED = (0.7, 0.7, 0.68), (0.42, 0.03, 0.03)
DARK_GREEN, WOOD = (0.03, 0.07, 0.045), (0.2, 0.12, 0.06)


def block(size: ArrayLike, center: ArrayLike, color: ArrayLike, semantic: int = STATIC,
         material: str = "matte") -> Part:  # fmt: skip
    return part(*box(size, center), material, semantic, color=color)


def rod(path: ArrayLike, radius: ArrayLike, color: ArrayLike = STEEL, semantic: int = POLE,
         material: str = "metal", sides: int = 8) -> Part:  # fmt: skip
    return part(*tube(path, radius, sides), material, semantic, color=color)


def turned(profile: Sequence[tuple[float, float]], color: ArrayLike, semantic: int = STATIC,
            material: str = "matte", sides: int = 12) -> Part:  # fmt: skip
    """A solid of revolution about z; ``profile`` is (radius, z) upwards, ``color`` one or each."""
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices, faces = loft([r * ring + z * UP for r, z in profile])
    colors = np.broadcast_to(np.asarray(color, dtype=np.float32), (len(profile), 3))
    return part(vertices, faces, material, semantic, color=np.repeat(colors, sides, axis=0))


def moved(p: Part, offset: ArrayLike) -> Part:
    return replace(p, vertices=p.vertices + np.asarray(offset, dtype=np.float64))


def bars(start: Array, end: Array, radius: float, sides: int = 3) -> tuple[Vertices, Faces]:
    """K thin rods at once, from ``start`` (K, 3) to ``end`` (K, 3), open at their ends."""
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 2:]) > 0.9, [[1.0, 0.0, 0.0]], UP)
    u = np.cross(along, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w = np.cross(along, u)
    a = np.arange(sides) * 2 * np.pi / sides
    ring = radius * (np.cos(a)[:, None] * u[:, None] + np.sin(a)[:, None] * w[:, None])
    vertices = np.stack([start[:, None] + ring, end[:, None] + ring], axis=1).reshape(-1, 3)
    k, j = np.meshgrid(np.arange(len(start)) * 2 * sides, np.arange(sides), indexing="ij")
    p, q = k + j, k + (j + 1) % sides
    return vertices, quads_to_triangles(np.stack([p, q, q + sides, p + sides], -1).reshape(-1, 4))


def assembled(parts: Sequence[Part]) -> Model:
    """Parts of the same kind in one; each lamp stays on its own, see ``lamp_heads``.

    What is round is shaded so.
    """
    kinds: dict[tuple[object, ...], list[Part]] = {}
    for i, p in enumerate(parts):
        kinds.setdefault((p.material, p.semantic, i if p.material == "lamp" else -1), []).append(p)
    return [smooth(merged(same)) for same in kinds.values()]
