"""Trees, shrubs, hedges and grass: branches, and clumps of leaves.

A tree is grown from the outside in. Branch ends are drawn on the envelope of the crown, branches
lead to them from the trunk, *clumps* (ellipsoids) sit along the branches, and the leaves of
foliage.py cover the clumps. What gaps there are show the sky.

Levels of detail: 0 is seen up to 32 m, 1 from 32 to 95 m, 2 from further, each times the
magnification of the lens against one of 90° (see :meth:`simgen.layout.Layout.lod`). What stands
nearer yet is told from where it is seen (``eyes``), and has single leaves on that side. With equal
generators all levels share branches and clumps; fewer leaves are larger ones, so that silhouette
and density stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.foliage import (
    CLUSTER_WIDTH,
    Array,
    Clumps,
    Leaf,
    cluster_part,
    clusters,
    leaf_length_m,
    leaf_part,
    lumps,
    near_leaves,
    tint,
    unit,
)
from simgen.mesh import (
    Faces,
    Model,
    Part,
    Vertices,
    box,
    cross,
    merged,
    part,
    quads_to_triangles,
)
from simgen.schema import LABELS
from simgen.sheets import BARK_M

Color = tuple[float, float, float]

VEGETATION, TERRAIN = LABELS["vegetation"], LABELS["terrain"]
TREE_TRIANGLES = (10000, 4000, 1400)  # at most, by level of detail
FAR, NEAR = 2, 3  # levels of detail of wood
NEAR_TREE_TRIANGLES = 60000
"""at most, of a tree with single leaves at FULL_M; further away fewer"""
FULL_M = 15.0
SHRUB_TRIANGLES = (2400, 700, 140)
NEAR_SHRUB_TRIANGLES = 12000
HEDGE_TRIANGLES_PER_M2 = (260, 70, 14)
NEAR_HEDGE_TRIANGLES = 40000
SHRUB_LEAF = Leaf(0.05, 0.5)
HEDGE_LEAF = Leaf(0.05, 0.65)

UP = np.array([0.0, 0.0, 1.0])
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
LOPSIDED = 1.38  # at most the reach of leaves over the crown's radius
HANG = 0.11  # at most the depth of leaves below the crown's base, as a share of the height
BUTTRESS = 0.35  # how much wider the foot of a trunk is
BELOW = 0.02  # of a tree's height, below the ground
MAX_CROWN_BASE = 0.7  # what is left of a tree above its lowest limbs is a crown yet
DARK = np.array([0.022, 0.04, 0.012])  # between the leaves of a hedge


@dataclass(frozen=True)
class Species:
    """The habit of a kind of tree. Lengths are shares of the height of the tree."""

    height_m: tuple[float, float]
    """usual heights"""
    crown_base: float
    """height of the lowest branches"""
    crown_radius: float
    profile: tuple[float, ...]
    """crown radius from the crown's base to its top, equally spaced, as shares of crown_radius"""
    leader: float
    """height at which the trunk has dissolved into branches"""
    trunk_radius: float
    num_branches: int
    clumps_per_branch: int
    rise: float
    """tangent of the elevation of the branches; negative where they hang"""
    clump: tuple[float, float, float]
    """semi-axes along the branch, across and upright, as shares of the crown's radius there"""
    cover: float
    """leaf area over the cross-section of the clumps: below 1 the crown is airy"""
    droop: float
    """how strongly leaves point down; 0 for any direction"""
    color: Color
    """albedo of the leaves"""
    leaf: Leaf
    trunk: Color | None = None
    """albedo of a trunk that is not of the brown bark sheet"""


SPECIES: dict[str, Species] = {
    "broadleaf": Species(
        height_m=(9.0, 18.0), crown_base=0.22, crown_radius=0.34,
        profile=(0.5, 0.9, 1.0, 0.97, 0.85, 0.5), leader=0.7, trunk_radius=0.018,
        num_branches=30, clumps_per_branch=3, rise=0.9, clump=(0.29, 0.26, 0.22), cover=0.7,
        droop=0.3, color=(0.082, 0.145, 0.034),
        leaf=Leaf(0.085, 0.58),
    ),
    "poplar": Species(
        height_m=(14.0, 26.0), crown_base=0.08, crown_radius=0.105,
        profile=(0.6, 0.95, 1.0, 0.92, 0.72, 0.3), leader=0.95, trunk_radius=0.012,
        num_branches=44, clumps_per_branch=2, rise=2.2, clump=(0.75, 0.42, 0.42), cover=0.5,
        droop=0.1, color=(0.078, 0.138, 0.038),
        leaf=Leaf(0.07, 0.85),
    ),
    "birch": Species(
        height_m=(8.0, 17.0), crown_base=0.22, crown_radius=0.21,
        profile=(0.6, 0.95, 1.0, 0.82, 0.6, 0.25), leader=0.92, trunk_radius=0.010,
        num_branches=26, clumps_per_branch=3, rise=1.1, clump=(0.25, 0.20, 0.34), cover=0.55,
        droop=1.2, color=(0.105, 0.175, 0.042),
        leaf=Leaf(0.055, 0.65), trunk=(0.50, 0.48, 0.44),
    ),
    "spruce": Species(
        height_m=(10.0, 24.0), crown_base=0.08, crown_radius=0.20,
        profile=(1.0, 0.9, 0.74, 0.56, 0.36, 0.12), leader=0.97, trunk_radius=0.013,
        num_branches=110, clumps_per_branch=1, rise=-0.35, clump=(0.55, 0.28, 0.16), cover=0.95,
        droop=0.9, color=(0.056, 0.102, 0.038),
        leaf=Leaf(0.08, 0.26, per_spray=15, angle_deg=50, fold=0.0),
    ),
    "pine": Species(
        height_m=(10.0, 20.0), crown_base=0.46, crown_radius=0.22,
        profile=(0.6, 1.0, 0.95, 0.8, 0.45), leader=0.93, trunk_radius=0.012,
        num_branches=24, clumps_per_branch=2, rise=0.35, clump=(0.36, 0.32, 0.17), cover=0.9,
        droop=-0.4, color=(0.060, 0.110, 0.042),
        leaf=Leaf(0.1, 0.2, per_spray=15, angle_deg=35, fold=0.0),
    ),
    "street": Species(
        height_m=(8.0, 12.0), crown_base=0.42, crown_radius=0.18,
        profile=(0.5, 0.95, 1.0, 0.85, 0.45), leader=0.85, trunk_radius=0.009,
        num_branches=18, clumps_per_branch=3, rise=1.2, clump=(0.36, 0.30, 0.27), cover=0.65,
        droop=0.3, color=(0.092, 0.165, 0.038),
        leaf=Leaf(0.095, 0.75),
    ),
}  # fmt: skip


def tree(
    species: str,
    *,
    height_m: float,
    lod: int,
    rng: np.random.Generator,
    clear_m: float = 0.0,
    eyes: Array | None = None,
) -> Model:
    """A tree of ``height_m``: its wood, then its leaves; at most ``TREE_TRIANGLES[lod]``.

    Where something is to pass below it, its limbs are cut off up to ``clear_m``. With ``eyes``
    (E, 3), places in its frame from which it is looked at closely, it has single leaves, and at
    most NEAR_TREE_TRIANGLES.
    """
    if species not in SPECIES:
        raise ValueError(f"tree: unknown species {species!r}; choose from {', '.join(SPECIES)}")
    kind = SPECIES[species]
    if clear_m > 0:
        base = max(kind.crown_base, clear_m / height_m + HANG)
        kind = replace(kind, crown_base=base)
    trunk = _trunk_path(kind, height_m, rng)
    branches = _branch_paths(kind, height_m, trunk, rng)
    clumps, twigs = _clumps_on(branches, kind, height_m, rng)
    wood_lod, (bark_rng,) = lod if eyes is None else NEAR, rng.spawn(1)
    wood = _wood(kind, height_m, trunk, branches, twigs, wood_lod, bark_rng)
    num_wood = sum(len(p.faces) for p in wood)
    if eyes is None:
        num_leaves = TREE_TRIANGLES[lod] - num_wood
        return [*wood, clusters(clumps, num_leaves, kind.cover, kind.droop, kind.color, rng)]
    leaves = near_leaves(
        clumps, eyes, _affordable(NEAR_TREE_TRIANGLES, eyes) - num_wood, kind.leaf,
        cover=kind.cover, droop=kind.droop, color=kind.color, rng=rng,
    )  # fmt: skip
    return [*wood, leaves]


def _affordable(triangles: int, eyes: Array) -> int:
    """How many of the ``triangles`` of a plant at hand one gets that is seen from ``eyes``."""
    distance = float(np.linalg.norm(eyes[:, :2], axis=1).min())
    return int(triangles * min(1.0, FULL_M / distance))


def crown_radius_m(species: str, height_m: float) -> float:
    """How far the leaves of a tree may reach from its foot [m]."""
    return LOPSIDED * SPECIES[species].crown_radius * height_m


def trunk_m(species: str, height_m: float) -> tuple[float, float]:
    """Girth at the foot and length of the trunk of a tree [m]."""
    kind = SPECIES[species]
    girth = 2 * np.pi * kind.trunk_radius * height_m * (1 + BUTTRESS)
    return girth, (kind.leader + BELOW) * height_m


def lowest_limbed_m(clear_m: float) -> float:
    """Height [m] of the lowest tree whose limbs may be cut off up to ``clear_m``."""
    return clear_m / (MAX_CROWN_BASE - HANG)


def shrub(*, rng: np.random.Generator, lod: int, eyes: Array | None = None) -> Model:
    """A bush 0.8 to 2 m high, leafy down to the ground."""
    radius = rng.uniform(0.5, 1.1)
    direction = unit(rng.normal(size=(20, 3)))
    direction[:, 2] = np.abs(direction[:, 2]) * 1.3
    center = direction * radius * rng.uniform(0.35, 0.75, (20, 1)) + 0.2 * radius * UP
    size = radius * rng.uniform(0.26, 0.44, (20, 1, 1))
    color = np.array([0.07, 0.125, 0.035]) * rng.uniform(0.8, 1.25)
    clumps = Clumps(center, np.eye(3) * size)
    if eyes is None:
        return [clusters(clumps, SHRUB_TRIANGLES[lod], 0.9, 0.0, color, rng)]
    return [
        near_leaves(clumps, eyes, _affordable(NEAR_SHRUB_TRIANGLES, eyes), SHRUB_LEAF, cover=0.9,
                    droop=0.0, color=color, rng=rng)
    ]  # fmt: skip


HEDGE_COLOR = np.array([0.06, 0.115, 0.03])
HEDGE_COVER, NEAR_HEDGE_COVER = 1.1, 1.7
"""leaf area over the area of its sides"""


def hedge(
    length_m: float,
    height_m: float,
    width_m: float,
    *,
    rng: np.random.Generator,
    lod: int,
    eyes: Array | None = None,
) -> Model:
    """A clipped hedge along x: leaves around a dark inner volume."""
    size = np.array([length_m, width_m, height_m])
    inner = np.maximum(size - (0.16 if eyes is None else 0.3), size / 2)
    core = part(*box(inner, (0, 0, inner[2] / 2)), "leaf", VEGETATION, color=DARK)
    area = 2 * (length_m + width_m) * height_m + length_m * width_m
    num = int(np.ceil(HEDGE_TRIANGLES_PER_M2[lod] * area))
    position, normal = _on_box(size, num, rng)
    near: list[Part] = []
    if eyes is not None:
        hidden = ~_sees(eyes, position, normal)
        near = [_near_hedge(size, area, eyes, rng)]
        position, normal = position[hidden], normal[hidden]
    length = np.sqrt(2 / CLUSTER_WIDTH * HEDGE_COVER * area / num)
    return [merged([core, *near, _hedge_clusters(position, normal, length, rng)])]


def _hedge_clusters(
    position: Array, normal: Array, length: float, rng: np.random.Generator
) -> Part:
    num = len(position)
    position = position - normal * rng.uniform(-0.02, 0.12, (num, 1)) - 0.04 * lumps(position, rng)
    color = HEDGE_COLOR * tint(position / 0.7, rng) * rng.uniform(0.75, 1.25, (num, 1))
    return cluster_part(position, normal, length * rng.uniform(0.7, 1.3, num), 0.0, color, rng)


def _near_hedge(size: Array, area: float, eyes: Array, rng: np.random.Generator) -> Part:
    """Single leaves on the sides that the eyes see, smaller where they are nearer."""
    leaf, most = HEDGE_LEAF, NEAR_HEDGE_TRIANGLES // 2
    leaf_area = 0.5 * leaf.width  # of one that is 1 long
    num = min(int(NEAR_HEDGE_COVER * area / (leaf_area * leaf.length_m**2)), 5 * most)
    finest = np.sqrt(NEAR_HEDGE_COVER * area / (leaf_area * num))
    position, normal = _on_box(size, num, rng)
    seen = _sees(eyes, position, normal)
    position, normal = position[seen], normal[seen]
    length = np.maximum(leaf_length_m(leaf, position, eyes), finest)
    wanted = (finest / length) ** 2
    grown = max(1.0, np.sqrt(wanted.sum() / most))
    keep = rng.random(len(position)) < wanted / grown**2
    position, normal, length = position[keep], normal[keep], grown * length[keep]
    n = len(position)
    depth = rng.uniform(0.0, 0.17, (n, 1))
    position -= normal * depth + 0.04 * lumps(position, rng)
    face = unit(normal + 0.5 * UP + 0.6 * rng.normal(size=(n, 3)))
    along = unit(0.5 * normal + 0.2 * UP + 0.8 * rng.normal(size=(n, 3)))
    along = unit(cross(cross(face, along), face)) * (length * rng.uniform(0.75, 1.25, n))[:, None]
    color = HEDGE_COLOR * tint(position / 0.7, rng) * (1.2 - 2.5 * depth)
    return leaf_part(position, along, face, leaf, color, rng)


def _sees(eyes: Array, position: Array, normal: Array) -> NDArray[np.bool_]:
    """(N,) whether an eye is on the outer side of the faces at ``position``."""
    return np.asarray(np.any([((eye - position) * normal).sum(axis=1) > 0 for eye in eyes], axis=0))


def grass_tufts(
    xy: ArrayLike, z: ArrayLike, *, rng: np.random.Generator, tall: bool = False
) -> Part:
    """Tufts of ten thin blades at ``xy`` (N, 2) on the ground of height ``z`` (N,), one part.

    Mown ones are 0.1 to 0.3 m high, tall ones 0.2 to 0.9 m.
    """
    low, high = (0.25, 0.7) if tall else (0.07, 0.24)
    root = np.column_stack([np.asarray(xy, dtype=np.float64), z]).repeat(10, axis=0)
    n = len(root)
    height = (rng.uniform(low, high, n // 10).repeat(10) * rng.uniform(0.5, 1.3, n))[:, None]
    azimuth, lean = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.05, 0.7, (n, 1))
    outward, across = _horizontal(azimuth), _horizontal(azimuth + np.pi / 2)
    root += outward * rng.uniform(0, 0.07, (n, 1)) - 0.01 * UP
    half_width = across * rng.uniform(0.003, 0.007, (n, 1)) * (2.2 if tall else 1.0)
    tip = root + height * (UP + lean * outward)
    vertices = np.stack([root - half_width, root + half_width, tip], axis=1)
    dry = rng.beta(1.2, 4, (n, 1, 1))
    color = (1 - dry) * np.array([0.075, 0.14, 0.03]) + dry * np.array([0.20, 0.17, 0.08])
    color = color * np.array([0.6, 0.6, 1.2])[:, None] * rng.uniform(0.75, 1.25, (n, 1, 1))
    faces = np.arange(3 * n)
    return part(vertices, faces, "leaf", TERRAIN, color=color.reshape(-1, 3))


# Skeleton


def _trunk_path(kind: Species, height_m: float, rng: np.random.Generator) -> Array:
    """(25, 3) points from below the ground to the end of the leader."""
    z = np.linspace(-BELOW, kind.leader, 25) * height_m
    bend = np.cumsum(rng.normal(0, 0.0035 * height_m * (1.2 - kind.leader), (25, 2)), axis=0)
    return np.column_stack([bend - bend[0], z])


def _branch_paths(kind: Species, height_m: float, trunk: Array, rng: np.random.Generator) -> Array:
    """(B, 5, 3) quadratic Bézier curves from the trunk to the envelope of the crown."""
    n = kind.num_branches
    azimuth = np.arange(n) * GOLDEN_ANGLE + rng.uniform(0, 2 * np.pi) + rng.normal(0, 0.3, n)
    level = _levels(kind, rng)
    reach = _envelope(kind, height_m, level) * (1 - 0.8 * kind.clump[0])
    reach *= rng.uniform(0.6, 1.05, n) * _lobes(azimuth, rng)
    top_m = height_m * (1 - 1.3 * kind.clump[2] * kind.crown_radius * kind.profile[-1])
    end_z = kind.crown_base * height_m + level * (top_m - kind.crown_base * height_m)
    lowest, highest = 0.9 * kind.crown_base * height_m, 0.98 * trunk[-1, 2]
    start_z = np.clip(end_z - kind.rise * reach, lowest, highest)
    start = np.column_stack([np.interp(start_z, trunk[:, 2], trunk[:, k]) for k in range(3)])
    end = np.column_stack([reach[:, None] * _horizontal(azimuth)[:, :2], end_z])
    end[:, :2] += start[:, :2]
    bow = np.sign(kind.rise) * -0.12 * reach[:, None] * UP
    return _bezier(start, (start + end) / 2 + bow, end)


def _levels(kind: Species, rng: np.random.Generator) -> Array:
    """(B,) branch ends as shares of the crown's height, as dense as the crown is wide."""
    x = np.linspace(0, 1, 50)
    density = np.interp(x, np.linspace(0, 1, len(kind.profile)), kind.profile) + 0.3
    cdf = np.cumsum(density) / density.sum()
    stratum = np.arange(kind.num_branches) + rng.uniform(0, 1, kind.num_branches)
    level = np.interp(stratum / kind.num_branches, cdf, x)
    level[-1] = 1.0
    return level


def _envelope(kind: Species, height_m: float, level: Array) -> Array:
    """Crown radius [m] at ``level``."""
    share = np.interp(level, np.linspace(0, 1, len(kind.profile)), kind.profile)
    return kind.crown_radius * height_m * share


def _lobes(azimuth: Array, rng: np.random.Generator) -> Array:
    """A factor around 1 that makes the crown lopsided."""
    phase = rng.uniform(0, 2 * np.pi, 2)
    return 1 + 0.12 * np.sin(azimuth + phase[0]) + 0.08 * np.sin(2 * azimuth + phase[1])


def _bezier(a: Array, b: Array, c: Array) -> Array:
    s = np.linspace(0, 1, 5)[:, None]
    a, b, c = a[:, None], b[:, None], c[:, None]
    return (1 - s) ** 2 * a + 2 * s * (1 - s) * b + s**2 * c


def _clumps_on(
    branches: Array, kind: Species, height_m: float, rng: np.random.Generator
) -> tuple[Clumps, Array]:
    """Clumps along the outer halves of the branches, and (C, 2, 3) twigs that lead to them."""
    per = kind.clumps_per_branch
    start, end = branches[:, 0].repeat(per, axis=0), branches[:, -1].repeat(per, axis=0)
    level = (branches[:, -1, 2] / height_m - kind.crown_base) / (1 - kind.crown_base)
    radius = _envelope(kind, height_m, np.clip(level, 0, 0.9)).repeat(per)[:, None]
    # A single clump is a spray that covers its branch; several begin at the branch's end.
    shares = np.array([0.62]) if per == 1 else 1 - 0.55 * np.arange(per) / per
    along = np.tile(shares, len(branches))[:, None]
    spread = rng.normal(0, 0.13 * (per - 1) / per, (len(start), 3)) * radius
    center = start + along * (end - start) + spread
    size = np.array(kind.clump) * radius * rng.uniform(0.75, 1.3, (len(start), 1))
    forward = unit(end - start)
    side = unit(cross(UP + 1e-3, forward))
    axes = np.stack([forward, side, cross(forward, side)], axis=1) * size[:, :, None]
    twigs = np.stack([start + (along - 0.25) * (end - start), center], axis=1)
    return Clumps(center, axes), twigs


# Wood


def _wood(
    kind: Species, height_m: float, trunk: Array, branches: Array, twigs: Array, lod: int,
    rng: np.random.Generator,
) -> Model:  # fmt: skip
    base = kind.trunk_radius * height_m
    z = np.clip(trunk[:, 2] / trunk[-1, 2], 0, 1)
    trunk_radius = base * (1 - 0.8 * z + BUTTRESS * np.exp(-z * height_m / 0.3))
    rings = slice(None, None, (1, 4, 8, 1)[lod])
    stem = _tubes(trunk[None, rings], trunk_radius[None, rings], (8, 6, 4, 14)[lod])
    # From afar, more limbs would only hide among the leaves.
    every = 1 if lod == NEAR else -(-len(branches) // 24)
    limbs = branches[::every, :: (1, 2, 3, 1)[lod]]
    limb_base = np.interp(limbs[:, 0, 2], trunk[:, 2], trunk_radius) * 0.5
    limb_radius = limb_base[:, None] * np.linspace(1, 0.25, limbs.shape[1])
    twig_radius = np.full((len(twigs), 1), 0.12 * base) * np.array([1, 0.3])
    thin = [_limbs(limbs, limb_radius, (4, 3, 0, 6)[lod], rng)] if lod != FAR else []
    if lod in (0, NEAR):
        thin.append(_limbs(twigs[::every], twig_radius[::every], 3 if lod == 0 else 4, rng))
    if kind.trunk is None:
        return [merged([_bark(*tube) for tube in [stem, *thin]])]
    vertices, faces, _ = stem
    return [
        part(vertices, faces, "matte", VEGETATION, color=_birch_color(kind.trunk, vertices)),
        *([merged([_bark(*tube) for tube in thin])] if thin else []),
    ]


def _limbs(
    paths: Array, radius: Array, sides: int, rng: np.random.Generator
) -> tuple[Vertices, Faces, Array]:
    """Tubes, each with bark from anywhere on the sheet."""
    vertices, faces, uv = _tubes(paths, radius, sides)
    offset = rng.uniform(0, BARK_M, (len(paths), 1, 2))
    return vertices, faces, (uv.reshape(len(paths), -1, 2) + offset).reshape(-1, 2)


def _bark(vertices: Vertices, faces: Faces, uv: Array) -> Part:
    return part(vertices, faces, "bark", VEGETATION, uv=uv)


def _birch_color(trunk: Color, vertices: Vertices) -> Array:
    """White with dark blotches, more of them towards the foot."""
    x, y, z = vertices.T
    dark = np.sin(9.0 * z + 2 * np.sin(40 * (x + y))) > 0.45 + 0.05 * z
    return np.where(dark[:, None], 0.2, 1.0) * np.array(trunk)


def _tubes(paths: Array, radius: Array, sides: int) -> tuple[Vertices, Faces, Array]:
    """Open tubes along (B, P, 3) paths with (B, P) radii: vertices, faces, uv in metres."""
    num, points = paths.shape[:2]
    tangent = unit(np.gradient(paths, axis=1))
    helper = np.eye(3)[np.argmin(np.abs(tangent).max(axis=1), axis=1)][:, None]
    u = unit(cross(tangent, helper))
    w = cross(tangent, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]  # the seam twice, for uv
    ring = np.cos(angle) * u[:, :, None] + np.sin(angle) * w[:, :, None]
    vertices = paths[:, :, None] + radius[:, :, None, None] * ring
    step = np.linalg.norm(np.diff(paths, axis=1), axis=2)
    v = np.concatenate([np.zeros((num, 1)), np.cumsum(step, axis=1)], axis=1)
    uv = np.empty((num, points, sides + 1, 2))
    uv[..., 0] = angle[:, 0] * radius[:, :1, None]
    uv[..., 1] = v[:, :, None]
    index = np.arange(num * points * (sides + 1)).reshape(num, points, sides + 1)
    quads = [index[:, :-1, :-1], index[:, :-1, 1:], index[:, 1:, 1:], index[:, 1:, :-1]]
    faces = quads_to_triangles(np.stack(quads, axis=-1).reshape(-1, 4))
    return vertices.reshape(-1, 3), faces, uv.reshape(-1, 2)


def _on_box(size: Array, num: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """(num, 3) points on the top and the four sides of a box on the ground, and their normals."""
    x, y, z = size
    normals = np.array([[0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
    area = np.array([x * y, x * z, x * z, y * z, y * z])
    normal = normals[rng.choice(5, num, p=area / area.sum())]
    inside = rng.uniform(-1, 1, (num, 3))
    cube = np.where(normal == 0, inside, normal)
    return (cube + UP) * size / 2, normal


def _horizontal(azimuth: Array) -> Array:
    return np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
