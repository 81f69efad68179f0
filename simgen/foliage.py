"""Leaves: single ones on twigs where the camera is near, clusters where it is not.

*Clumps* are ellipsoids that leaves cover. Seen from afar, each triangle over a clump stands for a
small cluster of leaves. Seen from nearby, a clump is made of *sprays*: a twig and its leaves of two
triangles, folded along the midrib, or of four; shoots with needles have one. Every spray hangs by a
stalk on the bough in the middle of its clump.

Up close, leaves are as long as the :class:`Leaf` says, further away longer, so that they stay some
pixels wide; where there would be too many triangles, all grow together. Their area stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.mesh import Faces, Part, cross, merged, part
from simgen.schema import LABELS

Array = NDArray[np.float64]

VEGETATION = LABELS["vegetation"]
UP = np.array([0.0, 0.0, 1.0])
CLUSTER_WIDTH = 0.5
"""of a cluster's length"""
TWIG = np.array([0.075, 0.055, 0.035])
FINE_RAD = 0.0055
"""length of the smallest leaves worth their triangles, as an angle: 7 px of 90° on 2560 px"""
LOBED_RAD = 0.011
"""Leaves that look longer than that are given four triangles."""
FILLED, FILLED_TRIANGLES = 0.35, 0.15
"""share of the area of leaves that lies in large dark ones within the clumps, and of the triangles
spent on them, where the triangles do not suffice for single leaves all through"""
FILLED_RIM = 0.5
"""how far out they lie, of the clumps' size"""
HIDDEN = -0.35
"""cosine between the directions to the eye and to a clump, both from the middle of the crown, from
which on the clump is behind the others"""


@dataclass(frozen=True)
class Leaf:
    """The leaf of a kind of plant, or the needled shoot that takes its place."""

    length_m: float
    width: float
    """of its length"""
    per_spray: int = 9
    angle_deg: float = 55.0
    """between twig and leaf"""
    fold: float = 0.25
    """how far the rims are bent up, of half the width; 0 for shoots"""

    @property
    def area(self) -> float:
        """About that of a leaf 1 long."""
        return 0.5 * self.width

    @property
    def num_triangles(self) -> int:
        return 2 if self.fold else 1


@dataclass(frozen=True, eq=False)
class Clumps:
    """C ellipsoids that leaves cover."""

    center: Array
    """(C, 3) [m]"""
    axes: Array
    """(C, 3, 3): rows are the semi-axes [m]"""

    def __getitem__(self, which: NDArray[np.bool_]) -> Clumps:
        return Clumps(self.center[which], self.axes[which])

    @property
    def cross_section(self) -> Array:
        """(C,) area [m²] seen from above, and a fair weight for the number of leaves."""
        a, b, c = np.linalg.norm(self.axes, axis=2).T
        return np.pi * np.cbrt(a * b * c) ** 2


# Clusters


def clusters(
    clumps: Clumps, num: int, cover: float, droop: float, leaf: ArrayLike,
    rng: np.random.Generator, *, rim: float = 1.0,
) -> Part:  # fmt: skip
    """``num`` triangles over the clumps, of ``cover`` times the clumps' cross-section in area.

    They reach out to ``rim`` of the clumps' size.
    """
    area = clumps.cross_section
    clump_color = np.asarray(leaf) * tint(clumps.center, rng)
    owner = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(num) + 0.5) / num)
    radius = rim * rng.uniform(0.15, 1.0, (num, 1)) ** 0.6
    offset = _offsets(clumps, owner, radius, rng)
    # Large dark leaves inside stop the light, small bright ones outside draw the outline.
    scale = (1.9 - 1.2 * radius[:, 0]) * rng.uniform(0.7, 1.3, num)
    length = scale * np.sqrt(cover * area.sum() * 2 / CLUSTER_WIDTH / (scale**2).sum())
    color = clump_color[owner] * (0.35 + 0.7 * radius) * rng.uniform(0.8, 1.25, (num, 1))
    return cluster_part(clumps.center[owner] + offset, unit(offset), length, droop, color, rng)


def _offsets(
    clumps: Clumps, owner: NDArray[np.int64], radius: Array, rng: np.random.Generator
) -> Array:
    """(N, 3) from the middle of the owners to ``radius`` (N, 1) of their size, outside rather than
    inside the crown."""
    to_light = clumps.center - clumps.center.mean(axis=0)
    to_light /= max(float(np.linalg.norm(to_light, axis=1).max()), 1e-9)
    direction = rng.normal(size=(len(owner), 3)) + np.einsum(
        "nd,nkd->nk", 1.2 * to_light[owner], unit(clumps.axes[owner])
    )
    offset: Array = np.einsum("nk,nkd->nd", radius * unit(direction), clumps.axes[owner])
    return offset


def cluster_part(
    position: Array,
    outward: Array,
    length: Array,
    droop: float,
    color: Array,
    rng: np.random.Generator,
) -> Part:
    """Slim triangles that face ``outward`` and up, by and large."""
    n = len(position)
    normal = unit(outward + 0.4 * UP + 0.5 * rng.normal(size=(n, 3)))
    wish = rng.normal(size=(n, 3)) + 0.6 * outward - droop * UP
    side = unit(cross(normal, wish)) * (0.5 * CLUSTER_WIDTH * length[:, None])
    along = unit(cross(side, normal)) * length[:, None]
    base = position - along / 3
    vertices = np.stack([base - side, base + side, base + along], axis=1)
    corner = np.array([0.88, 0.88, 1.18])[:, None]  # the tip has the light
    vertex_color = (color[:, None] * corner).reshape(-1, 3)
    return part(vertices, np.arange(3 * n), "leaf", VEGETATION, color=vertex_color)


# Single leaves


def near_leaves(
    clumps: Clumps,
    eyes: Array,
    budget: int,
    leaf: Leaf,
    *,
    cover: float,
    droop: float,
    color: ArrayLike,
    rng: np.random.Generator,
) -> Part:
    """Sprays where the ``eyes`` (E, 3) see them, clusters behind, within ``budget`` triangles."""
    area = leaf.area * leaf_length_m(leaf, clumps.center, eyes) ** 2
    num_leaves = cover * clumps.cross_section / area
    seen = _facing(clumps, eyes) | (leaf.num_triangles * num_leaves.sum() < 0.8 * budget)
    behind = clumps[~seen]
    share = behind.cross_section.sum() / clumps.cross_section.sum()
    num_clusters = int(0.2 * share * budget)
    parts = [clusters(behind, num_clusters, cover, droop, color, rng)] if num_clusters else []
    budget -= num_clusters
    if leaf.num_triangles * num_leaves[seen].sum() > budget:
        num_inside = int(FILLED_TRIANGLES * budget)
        budget, cover, filled = budget - num_inside, (1 - FILLED) * cover, FILLED * cover
        parts.append(clusters(clumps[seen], num_inside, filled, droop, color, rng, rim=FILLED_RIM))
    return merged([_sprays(clumps[seen], eyes, budget, leaf, cover, droop, color, rng), *parts])


def _facing(clumps: Clumps, eyes: Array) -> NDArray[np.bool_]:
    """(C,) whether any eye looks at a clump's side of the crown."""
    out = unit(clumps.center - clumps.center.mean(axis=0) + 1e-9)
    to_eye = unit(eyes - clumps.center.mean(axis=0))
    return np.asarray((out @ to_eye.T).max(axis=1) > HIDDEN)


def leaf_length_m(leaf: Leaf, position: Array, eyes: Array) -> Array:
    """(N,) how long leaves at ``position`` (N, 3) are to look no smaller than FINE_RAD."""
    distance = np.min([np.linalg.norm(position - eye, axis=1) for eye in eyes], axis=0)
    return np.asarray(np.maximum(leaf.length_m, FINE_RAD * distance))


def _sprays(
    clumps: Clumps, eyes: Array, budget: int, leaf: Leaf, cover: float, droop: float,
    color: ArrayLike, rng: np.random.Generator,
) -> Part:  # fmt: skip
    """Twigs with leaves all over the clumps."""
    length = leaf_length_m(leaf, clumps.center, eyes)
    distance = np.min([np.linalg.norm(clumps.center - eye, axis=1) for eye in eyes], axis=0)
    lobed = bool(np.median(leaf.length_m / distance) > LOBED_RAD)
    shape = _spray_shape(leaf, lobed, rng)
    wanted = cover * clumps.cross_section / (shape.area * length**2)
    most = budget / (shape.num_triangles + 2)
    grown = max(1.0, float(np.sqrt(wanted.sum() / most)))
    length, wanted = length * grown, wanted / grown**2
    num = min(int(most), int(np.ceil(wanted.sum())))
    owner = np.searchsorted(np.cumsum(wanted) / wanted.sum(), (np.arange(num) + 0.5) / num)
    size = (length[owner] * rng.uniform(0.8, 1.2, num))[:, None]
    inner = np.linalg.norm(clumps.axes, axis=2).mean(axis=1)[owner, None]
    inset = np.clip(1 - 0.5 * shape.length * size / inner, 0.35, 1.0)  # tips reach the envelope
    radius = inset * rng.uniform(0.1, 1.0, (num, 1)) ** 0.5
    offset = _offsets(clumps, owner, radius, rng)
    middle = clumps.center[owner] + offset
    wish = unit(offset) + 0.55 * rng.normal(size=(num, 3)) + (0.25 - droop) * UP
    forward = unit(wish)
    face = unit(0.9 * UP + 0.5 * unit(offset) + 0.45 * rng.normal(size=(num, 3)))
    side = unit(cross(face, forward))
    R = np.stack([forward, side, cross(forward, side)], axis=1) * size[:, :, None]
    foot = middle - 0.5 * shape.length * R[:, 0]
    vertices = foot[:, None] + shape.drawn(num, rng) @ R
    shade = (0.65 + 0.45 * radius) * np.asarray(color) * tint(clumps.center, rng)[owner]
    colors = _leaf_colors(shade, leaf.per_spray, shape.per_leaf, rng)
    twigs = np.broadcast_to(TWIG, (num, vertices.shape[1] - colors.shape[1], 3))
    return merged([
        part(vertices, _repeated(shape.faces, num, vertices.shape[1]), "leaf", VEGETATION,
             color=np.concatenate([colors, twigs], axis=1).reshape(-1, 3)),
        _stalks(clumps, owner, foot, size),
    ])  # fmt: skip


def _leaf_colors(shade: Array, leaves: int, corners: int, rng: np.random.Generator) -> Array:
    """(S, leaves · corners, 3) albedos: each leaf of the sprays (S, 3) has a hue of its own."""
    n = len(shade)
    bright = np.exp(rng.normal(0, 0.22, (n, leaves, 1)))
    yellow = rng.normal(0.0, 0.12, (n, leaves, 1)) * [1.3, 0.4, -0.3]
    color = shade[:, None] * bright * np.exp(yellow)
    return np.repeat(color, corners, axis=1)


def _stalks(clumps: Clumps, owner: NDArray[np.int64], foot: Array, size: Array) -> Part:
    """A thin double triangle from the bough in the middle of each spray's clump to its foot."""
    axis = clumps.axes[owner, 0]
    along = np.einsum("nd,nd->n", foot - clumps.center[owner], axis)
    along /= np.einsum("nd,nd->n", axis, axis)
    start = clumps.center[owner] + np.clip(0.6 * along - 0.1, -0.5, 0.5)[:, None] * axis
    across = unit(cross(foot - start, UP + 1e-3)) * (0.05 * size)
    vertices = np.stack([start - across, start + across, foot + 0.3 * across,
                         foot - 0.3 * across], axis=1)  # fmt: skip
    faces = _repeated(np.array([[0, 1, 2], [0, 2, 3]]), len(foot), 4)
    return part(vertices, faces, "leaf", VEGETATION, color=TWIG)


def _repeated(faces: Faces, times: int, step: int) -> Faces:
    return np.asarray((faces + step * np.arange(times)[:, None, None]).reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class _SprayShape:
    """Sprays of leaves 1 long: x along the twig, which begins at 0, z out of their plane."""

    variants: Array
    """(V, M, 3): the leaves' corners, then the twig's"""
    faces: Faces
    length: float
    """of the twig"""
    area: float
    """of the leaves"""
    per_leaf: int
    """corners"""

    @property
    def num_triangles(self) -> int:
        return len(self.faces)

    def drawn(self, num: int, rng: np.random.Generator) -> Array:
        return np.asarray(self.variants[rng.integers(len(self.variants), size=num)])


NUM_VARIANTS = 16


def _spray_shape(leaf: Leaf, lobed: bool, rng: np.random.Generator) -> _SprayShape:
    outline, faces = leaf_outline(leaf, lobed)
    n, length = leaf.per_spray, 0.42 * leaf.per_spray * max(leaf.width, 0.3)
    shape = (NUM_VARIANTS, n)
    station = length * (0.25 + 0.75 * np.arange(n) / (n - 1)) + rng.normal(0, 0.06, shape)
    angle = np.deg2rad(leaf.angle_deg + rng.normal(0, 14, shape)) * (1 - 2 * (np.arange(n) % 2))
    angle[:, -1] = rng.normal(0, 0.2, NUM_VARIANTS)
    lift, roll = rng.normal(-0.15, 0.35, shape), rng.normal(0, 0.5, shape)
    along = np.stack([np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)], -1)
    side = unit(cross(np.broadcast_to(UP, along.shape), along))
    normal = cross(along, side)
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    frame = np.stack([along, c * side + s * normal, c * normal - s * side], axis=2)
    corners = outline @ (frame * rng.uniform(0.75, 1.2, (*shape, 1, 1)))
    corners[..., 0] += station[..., None]
    half = 0.035
    twig = np.array([[0, -half, 0], [0, half, 0], [length, 0, 0.0]])
    variants = np.concatenate([corners.reshape(NUM_VARIANTS, -1, 3),
                               np.broadcast_to(twig, (NUM_VARIANTS, 3, 3))], axis=1)  # fmt: skip
    all_faces = np.concatenate(
        [_repeated(faces, n, len(outline)), n * len(outline) + np.arange(3)[None]]
    )
    a, b, d = np.moveaxis(corners[..., faces, :], -2, 0)
    area = np.linalg.norm(cross(b - a, d - a), axis=-1).sum() / 2 / NUM_VARIANTS
    return _SprayShape(variants, all_faces, length, float(area), len(outline))


def leaf_outline(leaf: Leaf, lobed: bool) -> tuple[Array, Faces]:
    """Corners (K, 3) of a leaf 1 long, from its stalk along x, bent up at the rims; its faces."""
    w, up = leaf.width / 2, leaf.fold * leaf.width / 2
    if not leaf.fold:
        return np.array([[0, -w, 0], [0, w, 0], [1, 0, -0.06]]), np.array([[0, 1, 2]])
    if not lobed:
        corners = [[0, 0, 0], [0.42, -w, up], [1, 0, -0.06], [0.42, w, up]]
        return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])
    corners = [[0, 0, 0], [0.28, -0.96 * w, up], [0.66, -0.74 * w, 0.7 * up], [1, 0, -0.1],
               [0.66, 0.74 * w, 0.7 * up], [0.28, 0.96 * w, up]]  # fmt: skip
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])


def leaf_part(
    base: Array,
    along: Array,
    normal: Array,
    leaf: Leaf,
    color: Array,
    rng: np.random.Generator,
    *,
    lobed: bool = False,
) -> Part:
    """Leaves from ``base`` (N, 3), as long as ``along`` and facing ``normal``, by and large."""
    outline, faces = leaf_outline(leaf, lobed)
    side = unit(cross(normal, along)) * np.linalg.norm(along, axis=1)[:, None]
    up = cross(unit(along), side)
    vertices = base[:, None] + outline @ np.stack([along, side, up], axis=1)
    colors = _leaf_colors(color, 1, len(outline), rng)
    faces = _repeated(faces, len(base), len(outline))
    return part(vertices, faces, "leaf", VEGETATION, color=colors.reshape(-1, 3))


# Colours


def tint(position: Array, rng: np.random.Generator) -> Array:
    """(N, 3) factors: hue and brightness of one plant, and of each of its places."""
    n = len(position)
    yellow = rng.normal(0, 0.07) + rng.normal(0, 0.05, n)
    bright = np.exp(rng.normal(0, 0.08) + 0.1 * lumps(position, rng)[:, 0])
    return np.asarray(bright[:, None] * np.exp(yellow[:, None] * np.array([1.6, 0.4, -1.0])))


def lumps(position: Array, rng: np.random.Generator) -> Array:
    """(N, 1) smooth noise in [-1, 1] over positions, with features about 2 m apart."""
    frequency, phase = rng.normal(0, 1.5, (3, 4)), rng.uniform(0, 2 * np.pi, 4)
    return np.asarray(np.sin(position @ frequency + phase).mean(axis=1, keepdims=True))


def unit(vector: Array) -> Array:
    """Unit vectors (…, 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    return np.asarray(vector / np.sqrt(x * x + y * y + z * z)[..., None])
