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
    with np.errstate(divide="ignore"):
        return np.where(view.inverse_depth > 0, 1.0 / view.inverse_depth, 0.0).astype(np.float32)


def semantic(view: View, faces: FaceTable) -> NDArray[np.uint8]:
    """Cityscapes label ids (H, W)."""
    return np.append(faces.semantic, np.uint8(LABELS["sky"]))[view.face]


def instance(view: View, faces: FaceTable) -> NDArray[np.uint16]:
    """Instance ids (H, W), 0 = none."""
    return np.append(faces.instance, np.uint16(0))[view.face]


def flow_status(scene: Scene, source: View, target: View) -> NDArray[np.uint8]:
    """Visibility (H, W) of the source's pixels in the target camera, with the surface bits."""
    w, h = source.camera.wh
    T_target_source = target.camera.T_cam_world @ inverse(source.camera.T_cam_world)
    projection = _Projection(source.camera, target.camera, T_target_source)
    rays = _rays_from_pixels(target.camera)
    uv = np.empty((2, h, w))
    own_inverse_depth = np.empty((h, w))
    in_frame = np.empty((h, w), dtype=bool)
    directions = np.empty((3, h, w), dtype=np.float32)

    def aim(rows: slice) -> None:
        u, v, own = projection(rows, source.inverse_depth[rows])
        inside = _in_frame(u, v, own, target.camera.wh)
        uv[0, rows], uv[1, rows] = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        own_inverse_depth[rows], in_frame[rows] = own, inside
        _direct(directions, rows, rays, uv[0, rows], uv[1, rows])

    _over_rows(aim, h)
    hit = trace(scene, target.camera.centre, directions.reshape(3, -1)).reshape(h, w)
    status = np.empty((h, w), dtype=np.uint8)
    surface = np.append(np.uint8(GLASS) * scene.faces.glass, np.uint8(AT_INFINITY))

    def judge(rows: slice) -> None:
        own, first, inside = source.face[rows], hit[rows], in_frame[rows]
        seen = (first == own) | (first == NO_FACE)
        other = np.nonzero(inside & ~seen)
        reached = _affine(target.face_coeffs, first[other], uv[0, rows][other], uv[1, rows][other])
        seen[other] = reached <= own_inverse_depth[rows][other] * (1 + SAME_SURFACE_REL)
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


def _affine(coeffs: Array, face: NDArray[np.int32], u: Array, v: Array) -> Array:
    """Inverse depth at (u, v) of the planes of ``face``; of the last one where NO_FACE."""
    a, b, c = (np.take(coeffs[:, k], face, mode="wrap") for k in range(3))
    return a * u + (b * v + c)


class _Projection:
    """Source pixels with inverse depth → target pixels with inverse depth, in float64.

    With w = 1/z and x = K⁻¹ (u, v, 1): p_target · w = R x + t w, which holds at w = 0, too.
    """

    def __init__(self, source: Camera, target: Camera, T_target_source: Array) -> None:
        self.H = infinite_homography(source.K, target.K, T_target_source[:3, :3])
        self.e = target.K @ T_target_source[:3, 3]
        self.u = np.arange(source.wh[0], dtype=np.float64)

    def __call__(self, rows: slice, inverse_depth: Array) -> tuple[Array, Array, Array]:
        """Target u, v and inverse depth of rows of pixels; negative behind the target."""
        v = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
        x, y, s = (
            h[0] * self.u + (h[1] * v + h[2]) + e * inverse_depth
            for h, e in zip(self.H, self.e, strict=True)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return x / s, y / s, np.where(s > 0, inverse_depth / s, -1.0)


def _in_frame(u: Array, v: Array, inverse_depth: Array, wh: tuple[int, int]) -> NDArray[np.bool_]:
    w, h = wh
    ahead = inverse_depth >= 0
    return ahead & (u >= -0.5) & (u < w - 0.5) & (v >= -0.5) & (v < h - 0.5)


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


def trace(scene: Scene, origin: Array, directions: NDArray[np.float32]) -> NDArray[np.int32]:
    """The first face id (N,) along rays (3, N) from ``origin``, NO_FACE where none."""
    if directions.size == 0:  # Dr.Jit aborts the process on an empty batch
        return np.empty(0, dtype=np.int32)
    if str(mi.variant()).startswith("scalar"):
        return _trace_scalar(scene, origin, directions)
    return _trace_wavefront(scene, origin, directions)


def _trace_wavefront(
    scene: Scene, origin: Array, directions: NDArray[np.float32]
) -> NDArray[np.int32]:
    # An opaque origin: as a literal it would be part of the kernel, and every frame would compile.
    point = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in origin))
    # One array per axis: a stacked one is read with its length as a literal, which compiles, too.
    axes = (mi.Float(aligned(d)) for d in directions)
    ray = mi.Ray3f(point, mi.Vector3f(*axes))
    hit = scene.mi_scene.ray_intersect_preliminary(ray, coherent=True)
    pointers: list[Any] = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)) for s in scene.shapes]
    slot_ids = [p.numpy()[0] for p in pointers]
    first_face = np.full(max(slot_ids) + 1, NO_FACE, dtype=np.int32)
    first_face[slot_ids] = scene.first_face
    shape: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
    first = dr.gather(mi.Int32, mi.Int32(aligned(first_face)), shape)
    face = dr.select(shape == 0, NO_FACE, first + mi.Int32(hit.prim_index))
    return np.asarray(face.numpy())


def _trace_scalar(
    scene: Scene, origin: Array, directions: NDArray[np.float32]
) -> NDArray[np.int32]:
    """One ray at a time: only scalar_rgb works so."""
    first_face = {s: int(f) for s, f in zip(scene.shapes, scene.first_face, strict=True)}
    point, intersect = mi.Point3f(*origin.tolist()), scene.mi_scene.ray_intersect_preliminary
    faces = np.full(directions.shape[1], NO_FACE, dtype=np.int32)
    for i, direction in enumerate(directions.T.tolist()):
        hit = intersect(mi.Ray3f(point, mi.Vector3f(direction)), True)
        if hit.is_valid():
            faces[i] = first_face[hit.shape] + hit.prim_index
    return faces
