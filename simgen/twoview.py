"""What two cameras of one frame must agree on, as numbers per pixel.

The second, independent piece of arithmetic: it shares no code with ``geometry``, ``rig`` and
``groundtruth``, so that an error in one of them shows. It is written in *inverse depth* w = 1/z,
in which the sky (w = 0) is no special case and every plane is an affine function of the pixel.

Notation: a is the source camera of a direction, b its target. A pixel of a with ray
r = K_a⁻¹ (u, v, 1) and inverse depth w lies, up to scale, at p = R_b_a r + w t_b_a in b: it ends
on the pixel K_b p / p_z, with inverse depth w / p_z. A *patch* is the 3×3 neighbourhood of the
target pixel nearest to that end point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from simgen import schema
from simgen.findings import BORDER_PX

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Bools = NDArray[np.bool_]

FLOAT32_PX = 4096.0  # beyond this, float32 cannot hold flow to 1e-3 px: errors count relative
SAME_SURFACE = 0.02  # inverse depths closer than this fraction belong to one surface
RESOLVED = 2  # directions, of 4, along which a pixel's surface goes on to both sides
NEARER = 1.001  # ratio of inverse depths from which something lies in front
AFFINE = 1e-3  # second difference, over inverse depth, up to which a patch is one plane
SAMPLE_PIXELS = 60_000  # per direction, when a check is not thorough
BLOCK_PIXELS = 200_000  # evaluated at a time: bounds the memory
EDGE_PX = 4  # between depth edges and pixels whose brightness is compared
PHOTOMETRIC_PIXELS = 400_000  # per pair, before those without texture are left out


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera: K [px], pose in the world, and what it saw."""

    K: Array
    T_world: Array
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class Direction:
    """The pixels of ``source`` (camera a) looked up in ``target`` (camera b)."""

    source: Camera
    target: Camera
    status: NDArray[np.uint8]
    flow: NDArray[np.float32] | None
    """where stored: from left to right, unless the set was written without"""
    where: str


def measure(d: Direction, *, thorough: bool) -> dict[str, Array]:
    """Residuals of a direction by the name of their check, one per pixel they apply to."""
    blocks = [_measure(d, i, j) for i, j in _pixel_blocks(d.status.shape, thorough=thorough)]
    return {name: np.concatenate([b[name] for b in blocks]) for name in blocks[0]}


def _pixel_blocks(hw: Sequence[int], *, thorough: bool) -> Iterator[tuple[Indices, Indices]]:
    stride = 1 if thorough else _stride(hw, SAMPLE_PIXELS)
    rows, cols = (np.arange(stride // 2, n, stride) for n in hw)
    for part in np.array_split(rows, -(-rows.size * cols.size // BLOCK_PIXELS)):
        i, j = np.meshgrid(part, cols, indexing="ij")
        yield i.ravel(), j.ravel()


def _stride(hw: Sequence[int], num_max: int) -> int:
    """Spacing of a grid that holds about ``num_max`` pixels."""
    return int(np.ceil(np.sqrt(hw[0] * hw[1] / num_max)))


def _measure(d: Direction, i: Indices, j: Indices) -> dict[str, Array]:
    uv = np.stack([j, i], axis=-1).astype(np.float64)
    end, w_end = reproject(d.source, d.target, uv, _inverse(d.source.depth[i, j]))
    status, margin = d.status[i, j], _margin(end, w_end, d.status.shape)
    says_out = (status & schema.OUT_OF_FRAME) != 0
    wrong = (says_out != (margin < 0)) & ~(np.abs(margin) <= BORDER_PX)
    inside = margin >= 0
    values: dict[str, Array] = {"out_of_frame": np.abs(margin[wrong])}
    if d.flow is not None:
        stored = uv + d.flow[i, j]
        values["flow"] = _flow_error(stored - end, end - uv)[margin > -np.inf]
        values["vertical_flow"] = np.abs(_vertical_flow(d, uv[inside], stored[inside]))
    return values | _compare_patches(
        d, i[inside], j[inside], end[inside], w_end[inside], status[inside]
    )


def reproject(a: Camera, b: Camera, uv: Array, w: Array) -> tuple[Array, Array]:
    """End points (N, 2) [px] in ``b`` of the pixels ``uv`` of ``a``, and their inverse depths.

    Both are NaN for points that are not in front of ``b``.
    """
    R_b_world = b.T_world[:3, :3].T
    t_b_a = R_b_world @ (a.T_world[:3, 3] - b.T_world[:3, 3])
    p = R_b_world @ a.T_world[:3, :3] @ _rays(a.K, uv) + t_b_a[:, None] * w
    p[:, p[2] <= 0] = np.nan
    return ((b.K @ p)[:2] / p[2]).T, w / p[2]


def _rays(K: Array, uv: Array) -> Array:
    return np.asarray(np.linalg.inv(K) @ np.vstack([uv.T, np.ones(len(uv))]), np.float64)


def _inverse(depth: Any) -> Array:
    z = depth.astype(np.float64)
    return np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)


def _margin(end: Array, w_end: Array, hw: Sequence[int]) -> Array:
    """Distance [px] from the border of the image, negative outside, −inf behind the camera."""
    u, v = end.T
    to_edge = np.minimum(np.minimum(u + 0.5, hw[1] - 0.5 - u), np.minimum(v + 0.5, hw[0] - 0.5 - v))
    return np.where(np.isnan(w_end), -np.inf, to_edge)


def _flow_error(error: Array, flow: Array) -> Array:
    """Largest component of ``error`` [px], relative where the flow is beyond ``FLOAT32_PX``."""
    scale = np.maximum(1.0, np.abs(flow).max(axis=-1) / FLOAT32_PX)
    return np.abs(error).max(axis=-1) / scale


# --- rectification ------------------------------------------------------------------------------


def _vertical_flow(d: Direction, uv_a: Array, uv_b: Array) -> Array:
    """v_b − v_a [px] of matching pixels after rectification by the poses.

    Each camera takes half of the rotation between the two; then both turn the baseline onto x.
    Source: Bouguet's algorithm, as in ``cv2.stereoRectify``.
    """
    R_world_a, R_world_b = d.source.T_world[:3, :3], d.target.T_world[:3, :3]
    baseline_world = d.target.T_world[:3, 3] - d.source.T_world[:3, 3]
    half = Rotation.from_rotvec(Rotation.from_matrix(R_world_b.T @ R_world_a).as_rotvec() / 2)
    baseline = half.apply(R_world_a.T @ baseline_world)
    onto_x = _turn(baseline, np.array([np.copysign(1.0, baseline[0]), 0.0, 0.0]))
    p_a = (onto_x * half).as_matrix() @ _rays(d.source.K, uv_a)
    p_b = (onto_x * half.inv()).as_matrix() @ _rays(d.target.K, uv_b)
    return (p_b[1] / p_b[2] - p_a[1] / p_a[2]) * d.source.K[1, 1]


def _turn(start: Array, end: Array) -> Rotation:
    """The shortest rotation that takes the direction ``start`` to ``end``."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, start @ end)
    return Rotation.from_rotvec(axis * (angle / sine if sine > 0 else 0.0))


# --- around the end point -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Patch:
    """Inverse depth around end points."""

    w: Array
    """(3, 3, N)"""
    is_plane: Bools
    """(N,) whether the patch is affine: no depth edge, no crease, no image border"""
    w_end: Array
    """(N,) at the end points themselves: exact on a plane"""
    slope: Array
    """(2, N) per pixel in u and v"""

    def shows(self, w: Array) -> Bools:
        """Whether nothing but a plane is seen, and w on it where the end point is."""
        return self.is_plane & (np.abs(self.w_end - w) <= AFFINE * w)

    def reaches(self, w: Array) -> Bools:
        """Whether the nearest pixel shows w, give or take what its surface changes in ½ px.

        Towards the horizon, road changes by more than ``SAME_SURFACE`` from row to row.
        """
        middle = self.w[1, 1]
        step_u = np.abs(self.w[1, ::2] - middle).min(axis=0)
        step_v = np.abs(self.w[::2, 1] - middle).min(axis=0)
        return np.abs(middle - w) <= SAME_SURFACE * w + (step_u + step_v) / 2


def _neighbours(end: Array, hw: Sequence[int]) -> Indices:
    """Flat indices (3, 3, N) of the pixels around end points, repeated at the border."""
    u, v = np.rint(end).astype(np.intp).T
    i = np.clip(np.stack([v - 1, v, v + 1]), 0, hw[0] - 1)
    j = np.clip(np.stack([u - 1, u, u + 1]), 0, hw[1] - 1)
    return i[:, None] * hw[1] + j


def _patch(depth: NDArray[np.float32], end: Array, near: Indices) -> _Patch:
    w = _inverse(depth.ravel()[near])
    slope = np.stack([w[1, 2] - w[1, 0], w[2, 1] - w[0, 1]]) / 2
    w_end = w[1, 1] + ((end - np.rint(end)).T * slope).sum(axis=0)
    return _Patch(w, _is_plane(w), w_end, slope)


def _bends(w: Array) -> Array:
    """Second differences (4, …) of patches (3, 3, …) along rows, columns and diagonals."""
    opposite = ((w[1, 0], w[1, 2]), (w[0, 1], w[2, 1]), (w[0, 0], w[2, 2]), (w[0, 2], w[2, 0]))
    return np.stack([np.abs(one + other - 2 * w[1, 1]) for one, other in opposite])


def _is_plane(w: Array) -> Bools:
    """Whether patches (3, 3, …) of inverse depth are affine."""
    return np.asarray(_bends(w).max(axis=0) <= AFFINE * w[1, 1])


def _compare_patches(
    d: Direction, i: Indices, j: Indices, end: Array, w_end: Array, status: NDArray[np.uint8]
) -> dict[str, Array]:
    """Source pixels (i, j) that end inside the target, against the patches where they end.

    A blade of grass that one camera's rays hit is missed by the other's: only surfaces that the
    source resolves are looked for.
    """
    near = _neighbours(end, d.status.shape)
    patch = _patch(d.target.depth, end, near)
    resolved = _is_resolved(d.source.depth, i, j)
    visible, occluded = (status & schema.VISIBLE) != 0, (status & schema.OCCLUDED) != 0
    same = patch.is_plane & _is_close(patch.w_end, w_end)
    found = _is_close(patch.w, w_end).any(axis=(0, 1)) | patch.reaches(w_end)
    in_front = (patch.w.max(axis=(0, 1)) > NEARER * w_end) & ~patch.shows(w_end)
    instance = d.source.instance[i, j]
    keeps_instance = _contains(d.target.instance, near, instance)
    keeps_label = _contains(d.target.semantic, near, d.source.semantic[i, j])
    cyclic = visible & same
    back, _ = reproject(d.target, d.source, end[cyclic], patch.w_end[cyclic])
    return {
        "cycle": np.hypot(back[:, 0] - j[cyclic], back[:, 1] - i[cyclic]),
        "visible_depth": ~found[visible & resolved],
        "occluded_depth": occluded & ~in_front,
        "occluded_share": ~in_front[occluded],
        "instance": ~keeps_instance[visible & resolved & (instance != 0)],
        "semantic": ~keeps_label[visible & resolved],
    }


def _is_resolved(depth: NDArray[np.float32], i: Indices, j: Indices) -> Bools:
    """Whether pixels (i, j) belong to a surface that covers pixels around them, however slanted."""
    w = _inverse(depth.ravel()[_neighbours(np.stack([j, i], axis=-1), depth.shape)])
    return np.asarray((_bends(w) <= SAME_SURFACE * w[1, 1]).sum(axis=0) >= RESOLVED)


def _is_close(w: Array, w_expected: Array) -> Bools:
    return np.abs(w - w_expected) <= SAME_SURFACE * w_expected


def _contains(ids: NDArray[Any], near: Indices, wanted: NDArray[Any]) -> Bools:
    return (ids.ravel()[near] == wanted).any(axis=(0, 1))


def clean_matches(d: Direction) -> tuple[Array, Array, Array, Array]:
    """Correspondences to compare the images by.

    Returns:
      Visible pixels (N, 2) of the source, their end points (N, 2), the slope (N, 2, 2) of the flow,
      which its last axis takes along u and v, and by how much (N,) [m] the point is further from
      the target's camera (0 at infinity). Both ends lie on one opaque surface, and ``EDGE_PX`` away
      from depth edges, so that no silhouette reaches into the smoothed images.
    """
    hw, stride = d.status.shape, _stride(d.status.shape, PHOTOMETRIC_PIXELS)
    opaque = (d.status & (schema.VISIBLE | schema.GLASS)) == schema.VISIBLE
    i, j = stride * np.array(
        np.nonzero((opaque & _is_far_from_edges(d.source.depth))[::stride, ::stride])
    )
    uv, w = np.stack([j, i], axis=-1).astype(np.float64), _inverse(d.source.depth[i, j])
    slope = _patch(d.source.depth, uv, _neighbours(uv, hw)).slope
    steps = np.eye(2)
    end, w_end = reproject(d.source, d.target, uv, w)
    beside = [reproject(d.source, d.target, uv + step, w + step @ slope)[0] for step in steps]
    flow_slope = np.stack(beside, axis=-1) - end[..., None] - steps
    near = _neighbours(end, hw)
    clean = _is_far_from_edges(d.target.depth).ravel()[near[1, 1]]
    clean &= _is_close(_patch(d.target.depth, end, near).w_end, w_end)
    further = _distance(d.target.K, end[clean], w_end[clean])
    further -= _distance(d.source.K, uv[clean], w[clean])
    return uv[clean], end[clean], flow_slope[clean], further


def _distance(K: Array, uv: Array, w: Array) -> Array:
    """Distance (N,) [m] of points seen at ``uv`` with inverse depth ``w``; 0 at infinity."""
    length = np.linalg.norm(_rays(K, uv), axis=0)
    return np.divide(length, w, out=np.zeros_like(length), where=w > 0)


def _is_far_from_edges(depth: NDArray[np.float32]) -> Bools:
    """Pixels (H, W) around which all 3×3 patches are planes, as far as ``EDGE_PX``."""
    padded = np.pad(_inverse(depth), 1, mode="edge")
    w = np.moveaxis(np.lib.stride_tricks.sliding_window_view(padded, (3, 3)), (2, 3), (0, 1))
    kernel = np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)
    return cv2.erode(_is_plane(w).astype(np.uint8), kernel).astype(bool)
