"""Trees, shrubs, hedges and grass: branches, and clumps of leaf triangles.

A tree is grown from the outside in. Branch ends are drawn on the envelope of the crown, branches
lead to them from the trunk, *clumps* (ellipsoids) sit along the branches, and leaf triangles, each
standing for a small spray of leaves, cover the clumps. What gaps there are show the sky.

Levels of detail: 0 is seen from 6 to 32 m, 1 from 32 to 95 m, 2 from further, each times the
magnification of the lens against one of 90° (see :meth:`simgen.layout.Layout.lod`). With equal
generators all levels share branches and clumps; fewer leaves are larger ones, so that silhouette
and density stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

Array = NDArray[np.float64]
Color = tuple[float, float, float]

VEGETATION, TERRAIN = LABELS["vegetation"], LABELS["terrain"]
TREE_TRIANGLES = (10000, 4000, 1400)  # at most, by level of detail
SHRUB_TRIANGLES = (2400, 700, 140)
HEDGE_TRIANGLES_PER_M2 = (260, 70, 14)

UP = np.array([0.0, 0.0, 1.0])
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
LEAF_WIDTH = 0.5  # of a leaf's length
LOPSIDED = 1.38  # at most the reach of leaves over the crown's radius
HANG = 0.11  # at most the depth of leaves below the crown's base, as a share of the height
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
    leaf: Color
    trunk: Color | None = None
    """albedo of a trunk that is not of the brown bark sheet"""


SPECIES: dict[str, Species] = {
    "broadleaf": Species(
        height_m=(9.0, 18.0), crown_base=0.22, crown_radius=0.34,
        profile=(0.5, 0.9, 1.0, 0.97, 0.85, 0.5), leader=0.7, trunk_radius=0.018,
        num_branches=30, clumps_per_branch=3, rise=0.9, clump=(0.29, 0.26, 0.22), cover=0.7,
        droop=0.3, leaf=(0.082, 0.145, 0.034),
    ),
    "poplar": Species(
        height_m=(14.0, 26.0), crown_base=0.08, crown_radius=0.105,
        profile=(0.6, 0.95, 1.0, 0.92, 0.72, 0.3), leader=0.95, trunk_radius=0.012,
        num_branches=44, clumps_per_branch=2, rise=2.2, clump=(0.75, 0.42, 0.42), cover=0.5,
        droop=0.1, leaf=(0.078, 0.138, 0.038),
    ),
    "birch": Species(
        height_m=(8.0, 17.0), crown_base=0.22, crown_radius=0.21,
        profile=(0.6, 0.95, 1.0, 0.82, 0.6, 0.25), leader=0.92, trunk_radius=0.010,
        num_branches=26, clumps_per_branch=3, rise=1.1, clump=(0.25, 0.20, 0.34), cover=0.55,
        droop=1.2, leaf=(0.105, 0.175, 0.042), trunk=(0.50, 0.48, 0.44),
    ),
    "spruce": Species(
        height_m=(10.0, 24.0), crown_base=0.08, crown_radius=0.20,
        profile=(1.0, 0.9, 0.74, 0.56, 0.36, 0.12), leader=0.97, trunk_radius=0.013,
        num_branches=110, clumps_per_branch=1, rise=-0.35, clump=(0.55, 0.28, 0.16), cover=0.95,
        droop=0.9, leaf=(0.056, 0.102, 0.038),
    ),
    "pine": Species(
        height_m=(10.0, 20.0), crown_base=0.46, crown_radius=0.22,
        profile=(0.6, 1.0, 0.95, 0.8, 0.45), leader=0.93, trunk_radius=0.012,
        num_branches=24, clumps_per_branch=2, rise=0.35, clump=(0.36, 0.32, 0.17), cover=0.9,
        droop=-0.4, leaf=(0.060, 0.110, 0.042),
    ),
    "street": Species(
        height_m=(8.0, 12.0), crown_base=0.42, crown_radius=0.18,
        profile=(0.5, 0.95, 1.0, 0.85, 0.45), leader=0.85, trunk_radius=0.009,
        num_branches=18, clumps_per_branch=3, rise=1.2, clump=(0.36, 0.30, 0.27), cover=0.65,
        droop=0.3, leaf=(0.092, 0.165, 0.038),
    ),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Clumps:
    """C ellipsoids that leaves cover."""

    center: Array
    """(C, 3) [m]"""
    axes: Array
    """(C, 3, 3): rows are the semi-axes [m]"""

    @property
    def cross_section(self) -> Array:
        """(C,) area [m²] seen from above, and a fair weight for the number of leaves."""
        a, b, c = np.linalg.norm(self.axes, axis=2).T
        return np.pi * np.cbrt(a * b * c) ** 2


def tree(
    species: str,
    *,
    height_m: float,
    lod: int,
    rng: np.random.Generator,
    clear_m: float = 0.0,
) -> Model:
    """A tree of ``height_m``: its wood, then its leaves; at most ``TREE_TRIANGLES[lod]``.

    Where something is to pass below it, its limbs are cut off up to ``clear_m``.
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
    wood = _wood(kind, height_m, trunk, branches, twigs, lod)
    num_leaves = TREE_TRIANGLES[lod] - sum(len(p.faces) for p in wood)
    return [*wood, _leaves(clumps, num_leaves, kind.cover, kind.droop, kind.leaf, rng)]


def crown_radius_m(species: str, height_m: float) -> float:
    """How far the leaves of a tree may reach from its foot [m]."""
    return LOPSIDED * SPECIES[species].crown_radius * height_m


def lowest_limbed_m(clear_m: float) -> float:
    """Height [m] of the lowest tree whose limbs may be cut off up to ``clear_m``."""
    return clear_m / (MAX_CROWN_BASE - HANG)


def shrub(*, rng: np.random.Generator, lod: int) -> Model:
    """A bush 0.8 to 2 m high, leafy down to the ground."""
    radius = rng.uniform(0.5, 1.1)
    direction = _unit(rng.normal(size=(14, 3)))
    direction[:, 2] = np.abs(direction[:, 2]) * 1.3
    center = direction * radius * rng.uniform(0.35, 0.75, (14, 1)) + 0.2 * radius * UP
    size = radius * rng.uniform(0.28, 0.5, (14, 1, 1))
    leaf = np.array([0.07, 0.125, 0.035]) * rng.uniform(0.8, 1.25)
    return [_leaves(Clumps(center, np.eye(3) * size), SHRUB_TRIANGLES[lod], 0.9, 0.0, leaf, rng)]


def hedge(
    length_m: float, height_m: float, width_m: float, *, rng: np.random.Generator, lod: int
) -> Model:
    """A clipped hedge along x: leaves around a dark inner volume."""
    size = np.array([length_m, width_m, height_m])
    inner = np.maximum(size - 0.16, size / 2)
    core = part(*box(inner, (0, 0, inner[2] / 2)), "leaf", VEGETATION, color=DARK)
    area = 2 * (length_m + width_m) * height_m + length_m * width_m
    num = int(np.ceil(HEDGE_TRIANGLES_PER_M2[lod] * area))
    position, normal = _on_box(size, num, rng)
    position -= normal * rng.uniform(-0.02, 0.12, (num, 1)) + 0.04 * _lumps(position, rng)
    length = np.sqrt(2 / LEAF_WIDTH * 1.1 * area / num) * rng.uniform(0.7, 1.3, num)
    tint = _tint(position / 0.7, rng) * rng.uniform(0.75, 1.25, (num, 1))
    color = np.array([0.06, 0.115, 0.03]) * tint
    return [merged([core, _leaf_part(position, normal, length, 0.0, color, rng)])]


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
    z = np.linspace(-0.02, kind.leader, 25) * height_m
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
    forward = _unit(end - start)
    side = _unit(cross(UP + 1e-3, forward))
    axes = np.stack([forward, side, cross(forward, side)], axis=1) * size[:, :, None]
    twigs = np.stack([start + (along - 0.25) * (end - start), center], axis=1)
    return Clumps(center, axes), twigs


# Wood


def _wood(
    kind: Species, height_m: float, trunk: Array, branches: Array, twigs: Array, lod: int
) -> Model:
    base = kind.trunk_radius * height_m
    z = np.clip(trunk[:, 2] / trunk[-1, 2], 0, 1)
    trunk_radius = base * (1 - 0.8 * z + 0.35 * np.exp(-z * height_m / 0.3))
    rings = slice(None, None, (1, 4, 8)[lod])
    stem = _tubes(trunk[None, rings], trunk_radius[None, rings], (8, 6, 4)[lod])
    every = -(-len(branches) // 24)  # more limbs would only hide among the leaves
    limbs = branches[::every, :: lod + 1]
    limb_base = np.interp(limbs[:, 0, 2], trunk[:, 2], trunk_radius) * 0.5
    limb_radius = limb_base[:, None] * np.linspace(1, 0.25, limbs.shape[1])
    twig_radius = np.full((len(twigs), 1), 0.12 * base) * np.array([1, 0.3])
    thin = [_tubes(limbs, limb_radius, 4 - lod)] if lod < 2 else []
    if lod == 0:
        thin.append(_tubes(twigs[::every], twig_radius[::every], 3))
    if kind.trunk is None:
        return [merged([_bark(*tube) for tube in [stem, *thin]])]
    vertices, faces, _ = stem
    return [
        part(vertices, faces, "matte", VEGETATION, color=_birch_color(kind.trunk, vertices)),
        *([merged([_bark(*tube) for tube in thin])] if thin else []),
    ]


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
    tangent = _unit(np.gradient(paths, axis=1))
    helper = np.eye(3)[np.argmin(np.abs(tangent).max(axis=1), axis=1)][:, None]
    u = _unit(cross(tangent, helper))
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


# Leaves


def _leaves(
    clumps: Clumps, num: int, cover: float, droop: float, leaf: ArrayLike, rng: np.random.Generator
) -> Part:
    """``num`` triangles over the clumps, of ``cover`` times the clumps' cross-section in area."""
    area = clumps.cross_section
    clump_color = np.asarray(leaf) * _tint(clumps.center, rng)
    owner = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(num) + 0.5) / num)
    radius = rng.uniform(0.15, 1.0, (num, 1)) ** 0.6
    to_light = clumps.center - clumps.center.mean(axis=0)
    to_light /= np.linalg.norm(to_light, axis=1).max()
    direction = rng.normal(size=(num, 3)) + np.einsum(  # few leaves grow inside the crown
        "nd,nkd->nk", 1.2 * to_light[owner], _unit(clumps.axes[owner])
    )
    offset = np.einsum("nk,nkd->nd", radius * _unit(direction), clumps.axes[owner])
    # Large dark leaves inside stop the light, small bright ones outside draw the outline.
    scale = (1.9 - 1.2 * radius[:, 0]) * rng.uniform(0.7, 1.3, num)
    length = scale * np.sqrt(cover * area.sum() * 2 / LEAF_WIDTH / (scale**2).sum())
    color = clump_color[owner] * (0.35 + 0.7 * radius) * rng.uniform(0.8, 1.25, (num, 1))
    return _leaf_part(clumps.center[owner] + offset, _unit(offset), length, droop, color, rng)


def _leaf_part(
    position: Array,
    outward: Array,
    length: Array,
    droop: float,
    color: Array,
    rng: np.random.Generator,
) -> Part:
    """Slim triangles that face ``outward`` and up, by and large."""
    n = len(position)
    normal = _unit(outward + 0.4 * UP + 0.5 * rng.normal(size=(n, 3)))
    wish = rng.normal(size=(n, 3)) + 0.6 * outward - droop * UP
    side = _unit(cross(normal, wish)) * (0.5 * LEAF_WIDTH * length[:, None])
    along = _unit(cross(side, normal)) * length[:, None]
    base = position - along / 3
    vertices = np.stack([base - side, base + side, base + along], axis=1)
    corner = np.array([0.88, 0.88, 1.18])[:, None]  # the tip has the light
    vertex_color = (color[:, None] * corner).reshape(-1, 3)
    return part(vertices, np.arange(3 * n), "leaf", VEGETATION, color=vertex_color)


def _tint(position: Array, rng: np.random.Generator) -> Array:
    """(N, 3) factors: hue and brightness of one plant, and of each of its places."""
    n = len(position)
    yellow = rng.normal(0, 0.07) + rng.normal(0, 0.05, n)
    bright = np.exp(rng.normal(0, 0.08) + 0.1 * _lumps(position, rng)[:, 0])
    return bright[:, None] * np.exp(yellow[:, None] * np.array([1.6, 0.4, -1.0]))


def _lumps(position: Array, rng: np.random.Generator) -> Array:
    """(N, 1) smooth noise in [-1, 1] over positions, with features about 2 m apart."""
    frequency, phase = rng.normal(0, 1.5, (3, 4)), rng.uniform(0, 2 * np.pi, 4)
    return np.sin(position @ frequency + phase).mean(axis=1, keepdims=True)


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


def _unit(vector: Array) -> Array:
    x, y, z = np.moveaxis(vector, -1, 0)
    return vector / np.sqrt(x * x + y * y + z * z)[..., None]
