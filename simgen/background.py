"""The countryside and the skyline between the last modelled street and the horizon.

World frame: z up, metres, origin in the middle of the modelled area, a square of half side
``inner_m``. Nothing here is seen from closer than about 200 m, so detail falls with distance; haze
is left to the renderer, and the light in windows at night to night.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Voronoi, cKDTree

from simgen.mesh import Model, Part, box, merged, part, placed, quads_to_triangles, tube
from simgen.schema import LABELS

Array = NDArray[np.float64]
HeightOfGround = Callable[[Array], Array]  # (N, 2) → (N,) [m]

BUILDING, VEGETATION, TERRAIN = LABELS["building"], LABELS["vegetation"], LABELS["terrain"]
BORDER_STEP_M = 10.0
RISE_OVER_M = 700.0  # hills reach their full height this far from the modelled square
FIELD_M = 230.0
TREE_TRIANGLES = 60_000  # at most, of all far trees together

# Land uses: linear albedo, and the share of the fields.
WOOD = 0
LAND_COLORS = np.array([
    [0.035, 0.055, 0.018],  # the ground below the far trees
    [0.075, 0.130, 0.030],  # meadow
    [0.110, 0.170, 0.040],  # young crop
    [0.270, 0.210, 0.085],  # ripe crop, stubble
    [0.130, 0.090, 0.055],  # ploughed
    [0.160, 0.170, 0.070],  # hay
])  # fmt: skip
LAND_SHARES = np.array([0.18, 0.24, 0.20, 0.18, 0.12, 0.08])

WHITE, RED = np.array([0.65, 0.65, 0.63]), np.array([0.42, 0.05, 0.03])
WALLS = np.array([
    [0.55, 0.52, 0.46], [0.48, 0.40, 0.28], [0.30, 0.13, 0.09], [0.36, 0.35, 0.33],
    [0.62, 0.60, 0.56], [0.40, 0.30, 0.22],
])  # fmt: skip
TOWER_WALLS = np.array([
    [0.40, 0.41, 0.42], [0.20, 0.24, 0.28], [0.55, 0.55, 0.53], [0.30, 0.28, 0.25],
])  # fmt: skip
ROOFS = np.array([[0.24, 0.09, 0.06], [0.16, 0.08, 0.06], [0.10, 0.10, 0.11], [0.12, 0.09, 0.07]])
COPPER = np.array([0.13, 0.20, 0.17])


@dataclass(frozen=True, eq=False)
class Countryside:
    """Heights and land use outside the modelled square."""

    inner_m: float
    """half side of the modelled square"""
    outer_m: float
    """half side of the whole square"""
    height_at_inner: HeightOfGround
    """height of the modelled ground; asked only on the border of its square"""
    plain_m: float
    """mean height of that border"""
    relief_m: float
    waves: Array
    """(W, 4) of the hills: wave vector [rad/m], phase, weight"""
    fields: Array
    """(F, 2) seeds of the Voronoi cells that are the fields"""
    land: NDArray[np.int64]
    """(F,) rows of LAND_COLORS"""
    shade: Array
    """(F, 3) albedo of each field"""

    def height(self, xy: Array) -> Array:
        """Height of the ground [m] at (N, 2) outside the modelled square."""
        beyond = np.abs(xy).max(axis=1) - self.inner_m
        away = np.clip(beyond / RISE_OVER_M, 0, 1)
        away = away**2 * (3 - 2 * away)
        far = np.clip(beyond / (self.outer_m - self.inner_m), 0, 1)
        wave = np.sin(xy @ self.waves[:, :2].T + self.waves[:, 2]) @ self.waves[:, 3]
        hills = self.plain_m + self.relief_m * ((0.2 + 0.8 * far) * wave + 0.15 + 0.6 * far**2)
        border = self.height_at_inner(np.clip(xy, -self.inner_m, self.inner_m))
        return border + away * (hills - border)

    def field_at(self, xy: Array) -> NDArray[np.int64]:
        """Index into ``fields`` of the field that holds each of (N, 2) points."""
        return cKDTree(self.fields).query(xy)[1]


def countryside(
    inner_m: float,
    outer_m: float,
    height_at_inner: HeightOfGround,
    *,
    relief_m: float,
    rng: np.random.Generator,
) -> Countryside:
    """Draws hills of about ``relief_m`` and a patchwork of fields and woods."""
    wavelength = np.array([2600.0, 1900.0, 1300.0, 900.0])
    azimuth, phase = rng.uniform(0, 2 * np.pi, (2, len(wavelength)))
    vector = 2 * np.pi / wavelength[:, None] * _horizontal(azimuth)
    weight = 0.5 * wavelength / wavelength.sum()
    cells = np.arange(-outer_m, outer_m, FIELD_M) + FIELD_M / 2
    fields = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2)
    fields += rng.uniform(-0.45, 0.45, fields.shape) * FIELD_M
    land = rng.choice(len(LAND_SHARES), len(fields), p=LAND_SHARES)
    shade = LAND_COLORS[land] * np.exp(rng.normal(0, 0.12, (len(fields), 1)))
    return Countryside(
        inner_m=inner_m,
        outer_m=outer_m,
        height_at_inner=height_at_inner,
        plain_m=float(height_at_inner(square_border(inner_m)).mean()),
        relief_m=relief_m,
        waves=np.column_stack([vector, phase, weight]),
        fields=fields,
        land=land,
        shade=shade,
    )


def square_border(half_m: float) -> Array:
    """(N, 2) points about 10 m apart, corners included, once around the square."""
    per_side = int(np.ceil(2 * half_m / BORDER_STEP_M))
    side = np.linspace(-half_m, half_m, per_side, endpoint=False)
    low, high = np.full_like(side, -half_m), np.full_like(side, half_m)
    return np.concatenate(
        [np.stack(s, axis=1) for s in ((side, low), (high, side), (-side, high), (low, -side))]
    )


def terrain_ring(land: Countryside) -> Part:
    """The ground from the modelled square to the edge of the world, coloured by fields.

    The first vertices are ``square_border(inner_m)``; the last ones hang below it, a skirt that
    hides cracks towards the modelled ground.
    """
    border = square_border(land.inner_m)
    n = len(border)
    growth = 1 + BORDER_STEP_M / land.inner_m  # keeps the cells about square
    num = int(np.ceil(np.log(land.outer_m / land.inner_m) / np.log(growth)))
    scale = np.geomspace(1, land.outer_m / land.inner_m, num + 1)
    xy = (scale[:, None, None] * border).reshape(-1, 2)
    vertices = np.column_stack([xy, land.height(xy)])
    skirt = vertices[:n] - [0.0, 0.0, 1.0]
    ring, k = np.meshgrid(np.arange(num) * n, np.arange(n), indexing="ij")
    after = (k + 1) % n
    quads = np.stack([ring + k, ring + n + k, ring + n + after, ring + after], axis=-1)
    k, after, last = k[0], after[0], len(xy)
    hanging = np.stack([last + k, k, after, last + after], axis=-1)
    color = land.shade[land.field_at(xy)]
    return part(
        np.concatenate([vertices, skirt]),
        quads_to_triangles(np.concatenate([quads.reshape(-1, 4), hanging])),
        "matte",
        TERRAIN,
        color=np.concatenate([color, color[:n]]),
    )


# Far trees


def tree_line(land: Countryside, *, rng: np.random.Generator) -> Part:
    """Woods, hedgerows between fields, and a last wood around the horizon, as one part.

    Further out one crown stands for several trees, so that crowns keep their angular size. At
    most ``TREE_TRIANGLES`` triangles: belt and hedgerows come first, the woods take the rest.
    """
    xy = np.concatenate([_horizon_belt(land, rng), _hedgerows(land, rng), _woods(land, rng)])
    distance = np.linalg.norm(xy, axis=1)
    leaves = np.select([distance < 450, distance < 900, distance < 1600], [120, 50, 24], 14)
    keep = np.cumsum(leaves) <= TREE_TRIANGLES
    return _crowns(xy[keep], leaves[keep], land, rng)


def _horizon_belt(land: Countryside, rng: np.random.Generator) -> Array:
    azimuth = np.deg2rad(np.arange(0, 360, 0.8) + rng.uniform(-0.3, 0.3, 450))
    return _horizontal(azimuth) * land.outer_m * rng.uniform(0.86, 0.97, (len(azimuth), 1))


def _hedgerows(land: Countryside, rng: np.random.Generator) -> Array:
    """(N, 2) along a fifth of the boundaries between fields."""
    cells = Voronoi(land.fields)
    ends = np.array([r for r in cells.ridge_vertices if r[0] >= 0])
    a, b = cells.vertices[ends[:, 0]], cells.vertices[ends[:, 1]]
    keep = _is_between(land, (a + b) / 2) & (rng.uniform(size=len(a)) < 0.2)
    a, b = a[keep], b[keep]
    spacing = _spacing((a + b) / 2)
    num = np.ceil(np.linalg.norm(b - a, axis=1) / spacing).astype(int)
    which = np.repeat(np.arange(len(a)), num)
    xy = a[which] + rng.uniform(0, 1, (len(which), 1)) * (b - a)[which]
    xy += rng.normal(0, 1.5, xy.shape)
    return xy[_is_between(land, xy)]


def _woods(land: Countryside, rng: np.random.Generator) -> Array:
    """(N, 2) scattered over the fields that are woods, denser where nearer."""
    num = int((2 * land.outer_m) ** 2 * LAND_SHARES[WOOD] / 8.0**2)
    woods = land.fields[land.land == WOOD]
    xy = woods[rng.integers(len(woods), size=num)] + rng.uniform(-0.6, 0.6, (num, 2)) * FIELD_M
    thinned = rng.uniform(size=num) < (8.0 / _spacing(xy)) ** 2
    xy = xy[thinned & _is_between(land, xy)]
    return xy[land.land[land.field_at(xy)] == WOOD]


def _spacing(xy: Array) -> Array:
    """Distance between neighbouring far crowns [m]: at least 8 m, and about 1.2° seen from 0."""
    return np.maximum(8.0, 0.021 * np.linalg.norm(xy, axis=1))


def _is_between(land: Countryside, xy: Array) -> NDArray[np.bool_]:
    beyond = np.abs(xy).max(axis=1)
    return (beyond > land.inner_m + 15) & (beyond < 0.98 * land.outer_m)


def _crowns(
    xy: Array, leaves: NDArray[np.int64], land: Countryside, rng: np.random.Generator
) -> Part:
    """One ragged crown with ``leaves[i]`` triangles for each of the places ``xy`` (N, 2)."""
    n = len(xy)
    height = rng.uniform(6, 15, n) + 0.002 * np.linalg.norm(xy, axis=1)
    half_width = np.maximum(0.3 * height, 0.62 * _spacing(xy)) * rng.uniform(0.8, 1.25, n)
    semi = np.column_stack([half_width, half_width, 0.56 * height])
    center = np.column_stack([xy, land.height(xy) + 0.46 * height])
    owner = np.repeat(np.arange(n), leaves)
    outward = _unit(rng.normal((0, 0, 0.25), 1.0, (len(owner), 3)))
    lobes = np.sin(4 * np.sum(outward * rng.normal(size=(n, 3))[owner], axis=1, keepdims=True))
    depth = rng.uniform(0.3, 1.0, (len(owner), 1)) ** 0.7
    position = center[owner] + outward * semi[owner] * depth * (1 + 0.2 * lobes)
    size = 1.7 * np.sqrt(semi[:, 0] * semi[:, 2] * 4 / leaves)[owner]
    a = _unit(np.cross(outward, rng.normal(size=outward.shape)))
    b = np.cross(outward, a)
    corners = [size[:, None] * (np.cos(t) * a + np.sin(t) * b) for t in (0.0, 2.2, 4.1)]
    vertices = position[:, None] + 0.6 * np.stack(corners, axis=1)
    hue = rng.uniform(0, 1, (n, 1))
    tree_color = (1 - hue) * [0.045, 0.085, 0.028] + hue * [0.085, 0.130, 0.036]
    light = rng.uniform(0.75, 1.2, (len(owner), 1)) * (0.3 + 0.65 * depth + 0.2 * outward[:, 2:])
    color = (tree_color[owner] * light).repeat(3, axis=0)
    return part(vertices, np.arange(3 * len(owner)), "leaf", VEGETATION, color=color)


# Skyline


def skyline(
    *,
    rng: np.random.Generator,
    num: int,
    near_m: float,
    far_m: float,
    ground_height: HeightOfGround,
) -> list[Model]:
    """``num`` far buildings in a few quarters around the origin, one part per material each."""
    quarter = rng.uniform(0, 2 * np.pi, max(2, num // 8))
    azimuth = rng.choice(quarter, num) + rng.normal(0, 0.25, num)
    distance = near_m * (far_m / near_m) ** rng.uniform(0, 1, num)
    xy = distance[:, None] * _horizontal(azimuth)
    z = ground_height(xy) - 1.0  # the foot is below the ground on a slope, too
    kinds = rng.choice(list(BUILDINGS), num, p=[b[1] for b in BUILDINGS.values()])
    heading = rng.uniform(0, 2 * np.pi, num)
    return [
        _by_material(placed(BUILDINGS[kind][0](rng), xyz=xyz, heading_rad=turn))
        for kind, xyz, turn in zip(kinds, np.column_stack([xy, z]), heading, strict=True)
    ]


def _by_material(model: Model) -> Model:
    groups = [[p for p in model if p.material == m and len(p.faces)] for m in ("matte", "glass")]
    return [merged(parts) for parts in groups if parts]


def _house(rng: np.random.Generator) -> Model:
    size = rng.uniform([9, 7, 5], [22, 10, 8])
    walls = _block(size, rng.choice(WALLS) * rng.uniform(0.8, 1.1))
    return [walls, *_windows(size, 2.8, 2.6, rng), _gable(size, 0.45, rng.choice(ROOFS))]


def _flats(rng: np.random.Generator) -> Model:
    size = np.array([rng.uniform(25, 80), rng.uniform(11, 15), 3.0 * rng.integers(4, 14)])
    walls = _block(size, rng.choice(WALLS) * rng.uniform(0.75, 1.1))
    lift = _block(np.array([6.0, 5.0, 3.5]), np.full(3, 0.3), (rng.uniform(-8, 8), 0, size[2]))
    return [walls, *_windows(size, 3.0, rng.uniform(2.4, 4.5), rng), lift]


def _tower(rng: np.random.Generator) -> Model:
    size = rng.uniform([18, 18, 45], [34, 34, 125])
    walls = _block(size, rng.choice(TOWER_WALLS) * rng.uniform(0.8, 1.1))
    plant = size * [0.6, 0.6, 0.06]
    top = _block(plant, np.full(3, 0.25), (0, 0, size[2]))
    mast = _rods(0.3, size[2] + plant[2], size[2] + rng.uniform(8, 22), WHITE, WHITE)
    return [walls, *_windows(size, 3.4, rng.uniform(2.0, 3.6), rng), top, mast]


def _hall(rng: np.random.Generator) -> Model:
    size = rng.uniform([40, 25, 7], [120, 50, 12])
    wall = rng.choice(TOWER_WALLS)
    stripe = _block(size * [1.003, 1.008, 0.12], rng.choice(ROOFS), (0, 0, 0.7 * size[2]))
    return [_block(size, wall), stripe, _gable(size, 0.1, 0.7 * wall)]


def _church(rng: np.random.Generator) -> Model:
    nave, wall, roof = rng.uniform([22, 11, 8], [34, 15, 12]), rng.choice(WALLS), rng.choice(ROOFS)
    side, eaves = rng.uniform(6, 8), rng.uniform(20, 32)
    x = -(nave[0] + side) / 2
    spire = tube([[x, 0, eaves], [x, 0, eaves + rng.uniform(10, 26)]], [0.68 * side, 0.05], 8)
    return [
        _block(nave, wall),
        *_windows(nave * [1, 1, 0.9], 7.0, 4.5, rng),
        _gable(nave, 0.9, roof),
        _block(np.array([side, side, eaves]), wall, (x, 0, 0)),
        part(*spire, "matte", BUILDING, color=rng.choice([*ROOFS, COPPER])),
    ]


def _chimney(rng: np.random.Generator) -> Model:
    height = rng.uniform(50, 130)
    body = rng.choice(WALLS)
    top = RED if rng.uniform() < 0.5 else 0.7 * body
    return [_rods(0.028 * height, 0.0, height, body, top), *_hall(rng)]


def _mast(rng: np.random.Generator) -> Model:
    height = rng.uniform(45, 110)
    drums = [_rods(1.4, z, z + 1.6, WHITE, WHITE) for z in height * rng.uniform(0.55, 0.95, 3)]
    return [_rods(0.9, 0.0, height, RED, WHITE), *drums]


def _block(size: Array, color: Array, base: tuple[float, float, float] = (0, 0, 0)) -> Part:
    """A box that stands on ``base``."""
    x, y, z = base
    return part(*box(size, (x, y, z + size[2] / 2)), "matte", BUILDING, color=color)


def _gable(size: Array, pitch: float, color: Array) -> Part:
    """A roof on walls of ``size``, its ridge along x; ``pitch`` is rise over run."""
    x, y, eaves = size / 2 * [1.03, 1.08, 2]
    ridge = eaves + pitch * y
    vertices = [[-x, -y, eaves], [x, -y, eaves], [x, y, eaves], [-x, y, eaves]]
    vertices += [[-x, 0, ridge], [x, 0, ridge]]
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 3, 2], [0, 2, 1]]
    return part(vertices, faces, "matte", BUILDING, color=color)


def _windows(size: Array, floor_m: float, bay_m: float, rng: np.random.Generator) -> Model:
    """A pane for every window of a block of ``size``: none, where a side is too narrow."""
    share = rng.uniform([0.45, 0.4], [0.85, 0.65])
    glass = np.array([0.05, 0.06, 0.075]) * rng.uniform(0.6, 1.6)
    sides = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        wide = 1 - axis
        columns, floors = _cells(size[wide], bay_m) - size[wide] / 2, _cells(size[2], floor_m)
        u, v = (g.reshape(-1, 1) for g in np.meshgrid(columns, floors))
        turn = sign if axis == 0 else -sign  # counter-clockwise seen from outside
        corners = np.empty((len(u), 4, 3))
        corners[..., axis] = sign * (size[axis] / 2 + 0.12)
        corners[..., wide] = u + turn * share[0] * bay_m / 2 * np.array([-1, 1, 1, -1])
        corners[..., 2] = v + share[1] * floor_m / 2 * np.array([-1, -1, 1, 1])
        color = glass * rng.choice([0.6, 1.0, 3.5], (len(u), 1), p=[0.3, 0.6, 0.1])
        faces = quads_to_triangles(np.arange(4 * len(u)).reshape(-1, 4))
        sides.append(part(corners, faces, "glass", BUILDING, color=color.repeat(4, axis=0)))
    return sides


def _cells(length_m: float, cell_m: float) -> Array:
    """Middles of the whole cells that fit into a length, the rest shared between the ends."""
    num = int(length_m / cell_m)
    rest_m = length_m - num * cell_m
    return np.linspace(0, num * cell_m, num, endpoint=False) + (cell_m + rest_m) / 2


def _rods(radius: float, low: float, high: float, color: Array, other: Array) -> Part:
    """A tapering upright tube in seven bands of two colours."""
    z = np.linspace(low, high, 8)
    r = radius * np.linspace(1, 0.6, 8)
    bands = [
        part(*tube([[0, 0, z[k]], [0, 0, z[k + 1]]], r[k : k + 2], 8), "matte", BUILDING, color=c)
        for k, c in enumerate([color, other] * 3 + [color])
    ]
    return merged(bands)


BUILDINGS: dict[str, tuple[Callable[[np.random.Generator], Model], float]] = {
    "house": (_house, 0.34), "flats": (_flats, 0.26), "tower": (_tower, 0.12),
    "hall": (_hall, 0.12), "church": (_church, 0.05), "chimney": (_chimney, 0.06),
    "mast": (_mast, 0.05),
}  # fmt: skip


def _horizontal(azimuth: Array) -> Array:
    return np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
