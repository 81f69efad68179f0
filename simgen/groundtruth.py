"""Pixel-centre rays → depth, ids, visibility; depth and cameras → flow.

Rays go through pixel centres (u, v integer) of a pinhole, in float32; what they decide is only
*which face* a pixel sees. All numbers then come from that face's plane in float64. For a plane
n·x = d in camera coordinates the inverse depth is affine in the pixel:
1/z = (n · K⁻¹ (u, v, 1)) / d, so three numbers per face give z exactly.

Visibility is traced: a second ray connects the other camera with the surface point. The point is
visible if that ray's first face is the point's own face, or lies no nearer than the point but for
a tolerance (two faces meet at an edge).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from simgen.flowfield import flow_from_depth
from simgen.geometry import Array, infinite_homography, inverse
from simgen.rig import Camera
from simgen.scene import FaceTable, Scene, aligned
from simgen.schema import AT_INFINITY, GLASS, LABELS, OCCLUDED, OUT_OF_FRAME, VISIBLE

NO_FACE = -1
SAME_SURFACE_REL = 1e-4
"""Two hits along one ray are one surface if their inverse depths differ by less than this share."""
_ROWS = 8
"""Rows per block: small enough for the cache of a core."""


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees at its pixel centres."""

    camera: Camera
    face: NDArray[np.int32]
    """(H, W) face id, NO_FACE where no surface"""
    inverse_depth: Array
    """(H, W) 1/z [1/m], 0 where no surface"""
    face_coeffs: Array
    """(F, 3) inverse depth of each face's plane as affine function of (u, v, 1)"""


def look(scene: Scene, camera: Camera) -> View:
    """Casts one ray through each pixel centre."""
    w, h = camera.wh
    coeffs = _inverse_depth_coeffs(scene.faces, camera)
    rays = _rays_from_pixels(camera)
    u = np.arange(w, dtype=np.float64)
    directions = np.empty((3, h, w), dtype=np.float32)
    inverse_depth = np.empty((h, w))

    def aim(rows: slice) -> None:
        v = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
        _direct(directions, rows, rays, u, v)

    _over_rows(aim, h)
    face = trace(scene, camera.centre, directions.reshape(3, -1)).reshape(h, w)

    def measure(rows: slice) -> None:
        v = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
        seen = _affine(coeffs, face[rows], u, v)
        inverse_depth[rows] = np.where(face[rows] == NO_FACE, 0.0, seen)

    _over_rows(measure, h)
    return View(camera, face, inverse_depth, coeffs)


def depth(view: View) -> NDArray[np.float32]:
    """z-depth (H, W) [m], 0 where no surface."""
    z = np.zeros(view.inverse_depth.shape, dtype=np.float32)
    return np.divide(1.0, view.inverse_depth, out=z, where=view.inverse_depth > 0)


def semantic(view: View, faces: FaceTable) -> NDArray[np.uint8]:
    """Cityscapes label ids (H, W)."""
    return np.append(faces.semantic, np.uint8(LABELS["sky"]))[view.face]


def instance(view: View, faces: FaceTable) -> NDArray[np.uint16]:
    """Instance ids (H, W), 0 = none."""
    return np.append(faces.instance, np.uint16(0))[view.face]


def flow_status(scene: Scene, source: View, target: View) -> NDArray[np.uint8]:
    """Visibility (H, W) of the source's pixels in the target camera, with the surface bits."""
    w, h = source.camera.wh
    seen_by_target = _Projection(source.camera, target.camera)
    in_frame = np.empty((h, w), dtype=bool)
    directions = np.empty((3, h, w), dtype=np.float32)

    def aim(rows: slice) -> None:
        inverse_depth = source.inverse_depth[rows]
        in_frame[rows] = seen_by_target.in_frame(rows, inverse_depth)
        for k in range(3):
            directions[k, rows] = seen_by_target.directions[k](rows, inverse_depth)

    _over_rows(aim, h)
    hit = trace(
        scene, target.camera.centre, directions.reshape(3, -1), in_frame.reshape(-1)
    ).reshape(h, w)
    status = np.empty((h, w), dtype=np.uint8)
    surface = np.append(np.uint8(GLASS) * scene.faces.glass, np.uint8(AT_INFINITY))

    def judge(rows: slice) -> None:
        own, first, inside = source.face[rows], hit[rows], in_frame[rows]
        seen = (first == own) | (first == NO_FACE)
        other = np.nonzero(~seen)
        inverse_depth = source.inverse_depth[rows][other]
        u, v, s = seen_by_target.at((other[0] + rows.start, other[1]), inverse_depth)
        reached = _affine(target.face_coeffs, first[other], u, v, s)
        seen[other] = reached <= inverse_depth * (1 + SAME_SURFACE_REL)
        visibility = np.where(seen, np.uint8(VISIBLE), np.uint8(OCCLUDED))
        status[rows] = np.where(inside, visibility, np.uint8(OUT_OF_FRAME))
        status[rows] += np.take(surface, own, mode="wrap")

    _over_rows(judge, h)
    return status


def flow(source_depth: NDArray[np.float32], left: Camera, right: Camera) -> NDArray[np.float32]:
    """Left to right flow (H, W, 2) [px] from the depth as it is stored."""
    return flow_from_depth(source_depth, left.K, right.K, right.T_cam_world @ left.T_world_cam)


def _direct(directions: NDArray[np.float32], rows: slice, rays: Array, u: Array, v: Array) -> None:
    """Fills ``rows`` of world directions (3, H, W) towards pixels (u, v)."""
    for k in range(3):
        directions[k, rows] = rays[k, 0] * u + (rays[k, 1] * v + rays[k, 2])


def _affine(
    coeffs: Array, face: NDArray[np.int32], u: Array, v: Array, s: Array | float = 1.0
) -> Array:
    """s times the inverse depth at (u, v) / s of the planes of ``face``; the last one's where
    NO_FACE."""
    a, b, c = (np.take(coeffs[:, k], face, mode="wrap") for k in range(3))
    return a * u + (b * v + c * s)


@dataclass(frozen=True, eq=False)
class _Form:
    """A number that is affine in pixel and inverse depth: a u + b v + c + e w, in float64."""

    a_u: Array
    """(W,)"""
    b: float
    c: float
    e: float

    def __call__(self, rows: slice, inverse_depth: Array) -> Array:
        """Of rows of pixels (h, W)."""
        v = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
        value = inverse_depth * self.e
        value += self.a_u + (self.b * v + self.c)
        return value

    def at(self, ij: tuple[NDArray[np.intp], NDArray[np.intp]], inverse_depth: Array) -> Array:
        """Of single pixels (N,)."""
        i, j = ij
        return inverse_depth * self.e + (self.a_u[j] + (self.b * i + self.c))


class _Projection:
    """Source pixels with inverse depth → where the target camera sees them, in float64.

    With w = 1/z and x = K⁻¹ (u, v, 1), the point is p_target · w = R x + t w in the target's frame,
    which holds at w = 0, too. So its image (u, v) s, s, and the direction in which it lies from the
    target, are affine in pixel and w; and it is in frame where four such forms have the right
    sign: nothing is divided. Inverse depth in the target is w / s.
    """

    def __init__(self, source: Camera, target: Camera) -> None:
        T_target_source = target.T_cam_world @ inverse(source.T_cam_world)
        H = infinite_homography(source.K, target.K, T_target_source[:3, :3])
        image = np.column_stack([H, target.K @ T_target_source[:3, 3]])
        away = np.column_stack([_rays_from_pixels(source), source.centre - target.centre])
        u = np.arange(source.wh[0], dtype=np.float64)

        def forms(rows: Array) -> list[_Form]:
            return [_Form(a * u, b, c, e) for a, b, c, e in rows]

        (w, h), (x, y, s) = target.wh, image
        self.image = forms(image)
        self.directions = forms(away)
        """in the world"""
        self.from_first_edges = forms(np.stack([x + 0.5 * s, y + 0.5 * s]))
        self.from_last_edges = forms(np.stack([(w - 0.5) * s - x, (h - 0.5) * s - y]))

    def in_frame(self, rows: slice, inverse_depth: Array) -> NDArray[np.bool_]:
        """Whether rows of pixels lie in the target's image: −½ ≤ u < W − ½, same for v, s > 0."""
        inside = self.from_first_edges[0](rows, inverse_depth) >= 0
        inside &= self.from_first_edges[1](rows, inverse_depth) >= 0
        for form in self.from_last_edges:
            inside &= form(rows, inverse_depth) > 0
        return inside

    def at(
        self, ij: tuple[NDArray[np.intp], NDArray[np.intp]], inverse_depth: Array
    ) -> tuple[Array, Array, Array]:
        """Homogeneous target pixels u s, v s, s (N,) of single pixels."""
        u, v, s = (form.at(ij, inverse_depth) for form in self.image)
        return u, v, s


def _rays_from_pixels(camera: Camera) -> Array:
    """M (3, 3) with world direction = M (u, v, 1)."""
    return camera.T_world_cam[:3, :3] @ np.linalg.inv(camera.K)


def _inverse_depth_coeffs(faces: FaceTable, camera: Camera) -> Array:
    """(F, 3): 1/z = coeffs · (u, v, 1) for each face's plane.

    n·x = d with x = c + z M (u, v, 1) gives 1/z = n M (u, v, 1) / (d − n·c). A face whose
    plane holds the camera's centre is seen edge-on, which is no surface: its row is 0.
    """
    coeffs = np.empty((len(faces.plane), 3), order="F")
    M, (x, y, z) = _rays_from_pixels(camera), camera.centre

    def project(rows: slice) -> None:
        nx, ny, nz, d = faces.plane[rows].T
        offset = d - (nx * x + ny * y + nz * z)
        scale = np.divide(1.0, offset, out=np.zeros_like(offset), where=offset != 0)
        for k in range(3):
            coeffs[rows, k] = (nx * M[0, k] + ny * M[1, k] + nz * M[2, k]) * scale

    _over_rows(project, len(coeffs), block=1 << 14)
    return coeffs


def _over_rows(work: Callable[[slice], None], num: int, block: int = _ROWS) -> None:
    """Runs ``work`` on blocks of rows in two or more threads (NumPy releases the lock)."""
    slices = [slice(i, min(i + block, num)) for i in range(0, num, block)]
    with ThreadPoolExecutor(max_workers=dr.thread_count()) as pool:
        list(pool.map(work, slices))


# --- tracing: the only part that depends on the variant ----------------------------------------


def trace(
    scene: Scene,
    origin: Array,
    directions: NDArray[np.float32],
    active: NDArray[np.bool_] | None = None,
) -> NDArray[np.int32]:
    """The first face id (N,) along rays (3, N) from ``origin``, NO_FACE where none.

    With ``active`` (N,), rays that are not are left out: NO_FACE.
    """
    if directions.size == 0:  # Dr.Jit aborts the process on an empty batch
        return np.empty(0, dtype=np.int32)
    if active is None:
        active = np.ones(directions.shape[1], dtype=bool)
    if str(mi.variant()).startswith("scalar"):
        return _trace_scalar(scene, origin, directions, active)
    return _trace_wavefront(scene, origin, directions, active)


def _trace_wavefront(
    scene: Scene, origin: Array, directions: NDArray[np.float32], active: NDArray[np.bool_]
) -> NDArray[np.int32]:
    # An opaque origin: as a literal it would be part of the kernel, and every frame would compile.
    point = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in origin))
    # One array per axis: a stacked one is read with its length as a literal, which compiles, too.
    axes = (mi.Float(aligned(d)) for d in directions)
    ray = mi.Ray3f(point, mi.Vector3f(*axes))
    hit = scene.mi_scene.ray_intersect_preliminary(
        ray, coherent=True, active=mi.Bool(aligned(active))
    )
    pointers: list[Any] = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)) for s in scene.shapes]
    slot_ids = [p.numpy()[0] for p in pointers]
    first_face = np.full(max(slot_ids) + 1, NO_FACE, dtype=np.int32)
    first_face[slot_ids] = scene.first_face
    shape: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
    first = dr.gather(mi.Int32, mi.Int32(aligned(first_face)), shape)
    face = dr.select(shape == 0, NO_FACE, first + mi.Int32(hit.prim_index))
    return np.asarray(face.numpy())


def _trace_scalar(
    scene: Scene, origin: Array, directions: NDArray[np.float32], active: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """One ray at a time: only scalar_rgb works so."""
    first_face = {s: int(f) for s, f in zip(scene.shapes, scene.first_face, strict=True)}
    point, intersect = mi.Point3f(*origin.tolist()), scene.mi_scene.ray_intersect_preliminary
    faces = np.full(directions.shape[1], NO_FACE, dtype=np.int32)
    for i in np.flatnonzero(active).tolist():
        hit = intersect(mi.Ray3f(point, mi.Vector3f(directions[:, i].tolist())), True)
        if hit.is_valid():
            faces[i] = first_face[hit.shape] + hit.prim_index
    return faces
