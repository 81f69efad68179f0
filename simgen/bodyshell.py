"""Bodies of road vehicles: a lofted shell with real wheel arches, and patches draped on it.

The shell is skinned over cross-sections at stations along x. Each section runs from the lower edge
of the left side over the belt line and the roof to the lower edge of the right side; at the wheels
the lower edge follows the arch. Glass, lamps, seams and all that lies on the body is *draped*: a
flat grid is cast along one axis onto the triangles of the shell and lifted off them a little.
Frame and units: see mesh.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from simgen.mesh import Faces, Vertices, quads_to_triangles, tube

Array = NDArray[np.float64]
Mesh = tuple[Vertices, Faces]
Direction = Literal["front", "rear", "left"]

LIFT_M = 0.006
"""How far a draped patch stands off the shell: no z-fighting, no visible gap."""
_STATION_GAP_M = 0.025
"""silhouette points nearer to each other than this share a section"""
_ROOF_ANGLES = np.deg2rad([0.0, 32.0, 62.0, 90.0])
_CAP_COLUMNS = 5


@dataclass(frozen=True)
class Arch:
    """A wheel arch: a round cut into the lower edge of the sides."""

    x: float
    z: float
    radius: float


@dataclass(frozen=True, eq=False)
class Outline:
    """What fixes the shape of a shell [m]. Curves are (N, 2) points (x, z) with rising x."""

    top: Array
    """side view of the centre line from tail to nose"""
    bottom: Array
    """lower edge of the sides, before the arches are cut"""
    belt: Array
    """line below the side windows"""
    width: float
    arches: tuple[Arch, ...] = ()
    cladding: float = 0.05
    """height of the plastic strip along the lower edge"""
    tumblehome: float = 0.15
    """the roof is narrower than the belt by this share"""
    corner: float = 0.2
    """radius of the four vertical corners"""
    bow: tuple[float, float] = (0.15, 0.1)
    """how far nose and tail bulge beyond their corners"""
    crown: float = 0.1
    """height of the rounding between side and roof"""

    @cached_property
    def top_curve(self) -> PchipInterpolator:
        return PchipInterpolator(self.top[:, 0], self.top[:, 1])

    @property
    def span(self) -> tuple[float, float]:
        """x of tail and nose, measured at the corners."""
        return float(self.top[0, 0]), float(self.top[-1, 0])

    def top_at(self, x: ArrayLike) -> Array:
        return np.asarray(self.top_curve(x))

    def belt_at(self, x: ArrayLike) -> Array:
        """The belt line; over bonnet and boot it runs just below their surface."""
        belt = np.interp(np.asarray(x), self.belt[:, 0], self.belt[:, 1])
        return np.minimum(belt, self.top_at(x) - 0.03)

    def rail_at(self, x: ArrayLike) -> Array:
        """Where the side turns into the roof."""
        top = self.top_at(x)
        return top - np.minimum(self.crown, 0.6 * (top - self.belt_at(x)))

    def bottom_at(self, x: ArrayLike, grow: float = 0.0) -> Array:
        """The lower edge with the arches cut; ``grow`` moves it outwards from sill and wheels."""
        z = np.interp(np.asarray(x), self.bottom[:, 0], self.bottom[:, 1]) + grow
        for arch in self.arches:
            radius, dx = arch.radius + grow, np.asarray(x) - arch.x
            over = arch.z + np.sqrt(np.maximum(radius**2 - dx**2, 0.0))
            z = np.where(np.abs(dx) <= radius, np.maximum(z, over), z)
        return z

    def half_width_at(self, x: ArrayLike, z: ArrayLike) -> Array:
        """Half the width of the sides at (x, z): rounded corners, belly, tumblehome."""
        x, z = np.asarray(x), np.asarray(z)
        tail, nose = self.span
        inside = np.minimum(x - tail, nose - x)
        u = 0.95 * np.clip(1 - inside / self.corner, 0, 1)
        plan = self.width / 2 - self.corner * (1 - np.sqrt(1 - u**2))
        belt = np.interp(x, self.belt[:, 0], self.belt[:, 1])
        above = (z - belt) / (self.top[:, 1].max() - belt)
        below = np.clip((belt - z) / belt, 0, 1)
        belly = np.interp(below, [0.0, 0.2, 0.5, 1.0], [0.98, 1.0, 1.0, 0.95])
        return plan * np.where(above > 0, 0.98 - self.tumblehome * above, belly)

    def bowed(self, points: Array) -> Array:
        """Points with the middle of nose and tail pushed out; the sides stay where they are."""
        tail, nose = self.span
        x, y = points[..., 0], points[..., 1]
        middle = 1 - (2 * y / self.width) ** 2
        push = self.bow[0] * np.clip(x / nose, 0, 1) - self.bow[1] * np.clip(x / tail, 0, 1)
        return np.stack([x + middle * push, y, points[..., 2]], axis=-1)


def stations(outline: Outline) -> Array:
    """Rising x of the cross-sections: dense where an outline bends, each arch edge cut twice."""
    tail, nose = outline.span
    corner = outline.corner * np.array([0.12, 0.4, 1.0])
    x = np.concatenate(
        [outline.top[:, 0], tail + corner, nose - corner, np.linspace(tail, nose, 5)]
    )
    for arch in outline.arches:  # which brings its own stations
        x = x[np.abs(x - arch.x) > arch.radius + outline.cladding + 0.03]
    x = np.unique(x.clip(tail, nose))
    x = x[np.append(np.diff(x) > _STATION_GAP_M, True) | (x == tail)]
    around = [_around(arch, outline.cladding) for arch in outline.arches]
    return np.unique(np.concatenate([x, *around]).clip(tail, nose))


def _around(arch: Arch, cladding: float) -> Array:
    """Stations of an arch: just outside and just inside its edge, and over the wheel."""
    half = arch.radius * np.sin(np.deg2rad([16.0, 44.0, 69.0]))
    half = np.append(half, arch.radius + np.array([0.0, 0.01, cladding + 0.02]))
    return arch.x + np.concatenate([-half, half])


def sections(outline: Outline) -> Array:
    """Cross-sections (N, M, 3), left lower edge to right lower edge, not bowed yet."""
    x = stations(outline)
    belt, rail, top = outline.belt_at(x), outline.rail_at(x), outline.top_at(x)
    low = np.minimum(outline.bottom_at(x), belt - 0.02)
    clad = np.minimum(outline.bottom_at(x, outline.cladding), belt - 0.01)
    side_z = np.stack([low, clad, (clad + belt) / 2, belt, (belt + rail) / 2, rail], axis=1)
    side_y = outline.half_width_at(x[:, None], side_z)
    # a superellipse closes the section between the rails
    roof_y = side_y[:, -1:] * np.cos(_ROOF_ANGLES[1:]) ** 0.6
    roof_z = rail[:, None] + (top - rail)[:, None] * np.sin(_ROOF_ANGLES[1:]) ** 0.6
    y, z = np.hstack([side_y, roof_y]), np.hstack([side_z, roof_z])
    y, z = np.hstack([y, -y[:, -2::-1]]), np.hstack([z, z[:, -2::-1]])
    return np.stack([np.broadcast_to(x[:, None], y.shape), y, z], axis=-1)


@dataclass(frozen=True, eq=False)
class _Skin:
    """The triangles of a shell that face along ±axis, seen in the plane across it."""

    axis: int
    sign: int
    origin: Array
    """(2, T) a corner a of each triangle abc"""
    b_row: Array
    """(2, T) row that gives the weight of b from p - a"""
    c_row: Array
    box: Array
    """(4, T) low and negated high corner of the bounding box"""
    depth: Array
    """(3, T) how far out the corners are along ±axis"""
    normal: Array
    """(T, 3)"""

    @staticmethod
    def facing(corners: Array, normal: Array, axis: int, sign: int) -> _Skin:
        """Picks the triangles (T, 3, 3) whose unit normal has a part along ±axis."""
        k = sign * normal[:, axis] > 0.02
        flat = np.delete(corners[k], axis, axis=2).T  # (2, 3, T)
        a, (abx, aby), (acx, acy) = flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        area = abx * acy - aby * acx
        return _Skin(
            axis, sign, a,
            b_row=np.stack([acy, -acx]) / area,
            c_row=np.stack([-aby, abx]) / area,
            box=np.concatenate([flat.min(axis=1), -flat.max(axis=1)]),
            depth=sign * corners[k][:, :, axis].T,
            normal=normal[k],
        )  # fmt: skip

    def cast(self, points: Array) -> tuple[Array, Array]:
        """How far out the skin is at points (P, 2), and its normals (P, 3) there.

        Raises:
            ValueError: a point is beside the skin.
        """
        reach = np.concatenate([points.max(axis=0), -points.min(axis=0)])
        near = np.flatnonzero((self.box <= reach[:, None]).all(axis=0))
        x = points[:, :1] - self.origin[0, near]
        y = points[:, 1:] - self.origin[1, near]
        b = x * self.b_row[0, near] + y * self.b_row[1, near]
        c = x * self.c_row[0, near] + y * self.c_row[1, near]
        inside = (b >= -1e-9) & (c >= -1e-9) & (b + c <= 1 + 1e-9)
        missed = ~inside.any(axis=1)
        if missed.any():
            axis = ("-" if self.sign < 0 else "+") + "xy"[self.axis]
            raise ValueError(f"draped: no skin that faces {axis} at {points[missed][0].round(3)}")
        a_out, b_out, c_out = self.depth[:, near]
        outward = np.where(inside, a_out + b * (b_out - a_out) + c * (c_out - a_out), -np.inf)
        hit = outward.argmax(axis=1)
        return outward[np.arange(len(points)), hit], self.normal[near[hit]]


@dataclass(frozen=True, eq=False)
class Shell:
    """The skin of a body in the three kinds of surface that it has."""

    outline: Outline
    painted: Mesh
    cladding: Mesh
    underside: Mesh

    @cached_property
    def _skin(self) -> dict[str, _Skin]:
        corners = np.concatenate([v[f] for v, f in (self.painted, self.cladding)])
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1)
        corners, normal = corners[length > 1e-9], normal[length > 1e-9]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return {
            direction: _Skin.facing(corners, normal, axis, sign)
            for direction, axis, sign in (("front", 0, 1), ("rear", 0, -1), ("left", 1, 1))
        }

    def draped(self, direction: Direction, grid: Array, lift: float = LIFT_M) -> Mesh:
        """Casts a grid (R, C, 2) onto the outermost skin that faces ``direction``.

        Args:
            grid: (x, z) for left, (y, z) for front and rear; z rises with the row, x or y with
                the column.
            lift: distance from the skin along its normal [m]; more where a ridge of the skin
                would else cut through a cell of the grid.

        Raises:
            ValueError: a point of the grid is beside the shell.
        """
        fine = _halved(grid)
        outward, normal = self._skin[direction].cast(fine.reshape(-1, 2))
        outward = outward.reshape(fine.shape[:2])
        coarse = _halved(outward[::2, ::2])
        axis, sign = self._skin[direction].axis, self._skin[direction].sign
        cut = (outward - coarse) * np.abs(normal[:, axis]).reshape(outward.shape)
        xyz = np.empty((*grid.shape[:2], 3))
        xyz[..., [1 - axis, 2]], xyz[..., axis] = grid, sign * outward[::2, ::2]
        xyz += (lift + max(0.0, cut.max())) * normal.reshape(*outward.shape, 3)[::2, ::2]
        vertices, faces = sheet(xyz)
        return vertices, faces if direction == "front" else faces[:, ::-1]


def _halved(grid: Array) -> Array:
    """A grid (R, C, …) with the middles of its cells and of their sides (2R − 1, 2C − 1, …)."""
    rows, columns = grid.shape[:2]
    fine = np.empty((2 * rows - 1, 2 * columns - 1, *grid.shape[2:]))
    fine[::2, ::2] = grid
    fine[1::2, ::2] = (grid[:-1] + grid[1:]) / 2
    fine[:, 1::2] = (fine[:, :-2:2] + fine[:, 2::2]) / 2
    return fine


def shell(outline: Outline) -> Shell:
    """Skins an outline; nose and tail are closed by bulging faces."""
    s = sections(outline)
    nose, tail = _cap(s[-1]), _cap(s[0])[:, ::-1]
    painted = [s[:, 1:-1], nose[1:], tail[1:]]
    cladding = [s[:, :2], s[:, -2:], nose[:2], tail[:2]]
    return Shell(
        outline,
        painted=joined([sheet(outline.bowed(p)) for p in painted]),
        cladding=joined([sheet(outline.bowed(p)) for p in cladding]),
        underside=sheet(outline.bowed(s[:, [-1, 0]])),
    )


def _cap(section: Array) -> Array:
    """A grid (rows, columns, 3) that fills a section from its lower edge to its crown."""
    rows = (len(section) + 1) // 2
    left, right = section[:rows], section[::-1][:rows]
    t = np.linspace(0, 1, _CAP_COLUMNS)[None, :, None]
    return right[:, None] * (1 - t) + left[:, None] * t


def sheet(points: Array) -> Mesh:
    """The surface through a grid (R, C, 3); it faces column direction × row direction."""
    return points.reshape(-1, 3), _sheet_faces(*points.shape[:2])


@cache
def _sheet_faces(rows: int, columns: int) -> Faces:
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = np.stack([a, a + 1, a + columns + 1, a + columns], axis=1)
    return quads_to_triangles(quads)


def quad_grid(corners: ArrayLike, rows: int = 2, columns: int = 2) -> Array:
    """A grid (R, C, 2) over four corners: low start, low end, high end, high start."""
    low_start, low_end, high_end, high_start = np.asarray(corners, dtype=np.float64)
    u = np.linspace(0, 1, columns)[None, :, None]
    v = np.linspace(0, 1, rows)[:, None, None]
    return (low_start * (1 - u) + low_end * u) * (1 - v) + (high_start * (1 - u) + high_end * u) * v


def band_grid(u: Array, low: ArrayLike, high: ArrayLike, rows: int = 3) -> Array:
    """A grid (R, C, 2) between two curves over the rising abscissae ``u`` (C,)."""
    v = np.linspace(0, 1, rows)[:, None]
    z = np.broadcast_to(low, u.shape) * (1 - v) + np.broadcast_to(high, u.shape) * v
    return np.stack([np.broadcast_to(u, z.shape), z], axis=-1)


def tiled(mesh: Mesh, kind: NDArray[np.int64]) -> list[Mesh]:
    """Splits a sheet by the kind (R - 1, C - 1) of its cells: the mesh of kind 0, of kind 1, …"""
    vertices, faces = mesh
    of_face = np.tile(kind.ravel(), 2)
    return [(vertices, faces[of_face == k]) for k in range(int(kind.max()) + 1)]


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh from several."""
    offsets = np.cumsum([0] + [len(v) for v, _ in meshes[:-1]])
    faces = [f + o for (_, f), o in zip(meshes, offsets, strict=True)]
    return np.concatenate([v for v, _ in meshes]), np.concatenate(faces)


def mirrored(mesh: Mesh) -> Mesh:
    """The mesh on the other side of the plane y = 0."""
    vertices, faces = mesh
    return vertices * [1, -1, 1], faces[:, ::-1]


def moved(mesh: Mesh, offset: ArrayLike) -> Mesh:
    return mesh[0] + np.asarray(offset), mesh[1]


def lathe(profile: ArrayLike, sides: int) -> Mesh:
    """A solid of revolution about y; ``profile`` (N, 2) is (y, radius) with rising y."""
    p = np.asarray(profile, dtype=np.float64)
    path = np.stack([np.zeros(len(p)), p[:, 0], np.zeros(len(p))], axis=1)
    return tube(path, p[:, 1], sides, caps=False)


def disc(y: float, radius: float, sides: int) -> Mesh:
    """A disc that faces +y."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([radius * np.sin(angle), np.full(sides, y), radius * np.cos(angle)], axis=1)
    k = np.arange(sides)
    faces = np.stack([np.full(sides, sides), k, (k + 1) % sides], axis=1)
    return np.vstack([ring, [0.0, y, 0.0]]), faces
