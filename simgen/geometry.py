"""Rigid transforms, projection and frame flips of pinhole cameras, in NumPy float64.

Notation: ``T_b_a`` takes points from frame a to frame b (``p_b = R_b_a @ p_a + t_b_a``), inner
names cancel. Camera frame: OpenCV (x right, y down, z forward). World: x ahead where the
drive begins, y left, z up,
metres. ``uv`` are pixel coordinates whose (0, 0) is the *centre* of the top-left pixel.
CONVENTIONS.md states all of this once for the whole project.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Rows: camera axes (x right, y down, z forward) of a camera that looks along +x of a vehicle
# frame (x forward, y left, z up).
R_CAM_VEHICLE: Array = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def skew(w: Array) -> Array:
    """Returns the 3×3 matrix [w]× with ``skew(w) @ x == cross(w, x)``."""
    x, y, z = w
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_from_vector(w: Array) -> Array:
    """exp([w]×) for a rotation vector ``w`` (3,) in radians (Rodrigues)."""
    w = np.asarray(w, dtype=np.float64)
    theta = float(np.linalg.norm(w))
    a = np.sinc(theta / np.pi)  # sin θ / θ, finite at 0
    b = 0.5 * np.sinc(theta / (2 * np.pi)) ** 2  # (1 − cos θ) / θ²
    s = skew(w)
    return np.eye(3) + a * s + b * (s @ s)


def vector_from_rotation(R: Array) -> Array:
    """log of a rotation matrix as a rotation vector (3,) in radians, for angles below π."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sin, cos = float(np.linalg.norm(v)), 0.5 * (float(np.trace(R)) - 1.0)
    theta = float(np.arctan2(sin, cos))
    return v * (1.0 if theta < 1e-12 else theta / sin)


def transform(R: Array, t: Array) -> Array:
    """Stacks R (3, 3) and t (3,) to a 4×4 ``T``."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse(T_b_a: Array) -> Array:
    """``T_a_b`` of a rigid (…, 4, 4) ``T_b_a``."""
    R_a_b = np.swapaxes(T_b_a[..., :3, :3], -1, -2)
    T_a_b = np.zeros_like(T_b_a)
    T_a_b[..., :3, :3] = R_a_b
    T_a_b[..., :3, 3:] = -R_a_b @ T_b_a[..., :3, 3:]
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def transform_points(T_b_a: Array, p_a: Array) -> Array:
    """Points (…, 3) from frame a to frame b."""
    return p_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]


def intrinsics(wh: tuple[int, int], hfov_deg: float) -> Array:
    """K [px] of a pinhole with square pixels and a centred principal point.

    The horizontal field of view is measured between the outer edges of the image, so
    ``f = W/2 / tan(hfov/2)``; the pixel-centre convention gives ``cx = (W − 1)/2``.
    """
    w, h = wh
    f = 0.5 * w / np.tan(np.deg2rad(hfov_deg) / 2)
    return np.array([[f, 0.0, (w - 1) / 2], [0.0, f, (h - 1) / 2], [0.0, 0.0, 1.0]])


def corner_origin_from_pixel_centre(K: Array) -> Array:
    """The same camera with (0, 0) at the outer *corner* of the top-left pixel (½ px further)."""
    K = K.copy()
    K[..., 0, 2] += 0.5
    K[..., 1, 2] += 0.5
    return K


def project(K: Array, p_cam: Array) -> Array:
    """Pixel coordinates (…, 2) of points (…, 3) in the camera frame; z must not be 0."""
    uvw = p_cam @ K.T
    return uvw[..., :2] / uvw[..., 2:]


def unproject(K: Array, uv: Array, depth: Array) -> Array:
    """Points (…, 3) in the camera frame at z-depth ``depth`` (…) [m] seen at ``uv`` (…, 2) [px]."""
    rays = np.concatenate([uv, np.ones_like(uv[..., :1])], axis=-1) @ np.linalg.inv(K).T
    return rays * depth[..., None]


def pixel_grid(hw: tuple[int, int]) -> Array:
    """Coordinates (H, W, 2) of all pixel centres as (u, v)."""
    h, w = hw
    u, v = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
    return np.stack([u, v], axis=-1)


def infinite_homography(K_left: Array, K_right: Array, R_right_left: Array) -> Array:
    """H (3, 3) with ``uv_right ~ H uv_left`` for points at infinite depth."""
    return K_right @ R_right_left @ np.linalg.inv(K_left)


def rectifying_rotations(T_right_left: Array) -> tuple[Array, Array]:
    """Rotations ``(R_rect_left, R_rect_right)`` that make the pair's image rows epipolar lines.

    Both cameras get the same orientation: x along the baseline (left to right), z as close to
    the mean of the two optical axes as that allows. Raises ValueError for a zero baseline,
    or one along the viewing direction.

    Source: Fusiello, Trucco, Verri, *A compact algorithm for rectification of stereo pairs*, 2000.
    """
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    baseline_left = -R.T @ t  # right centre in the left frame
    length = np.linalg.norm(baseline_left)
    if length == 0:
        raise ValueError("rectifying_rotations: the two camera centres coincide, so no baseline")
    x = baseline_left / length
    z_mean = np.array([0.0, 0.0, 1.0]) + R.T @ np.array([0.0, 0.0, 1.0])
    y = np.cross(z_mean, x)
    if np.linalg.norm(y) < 1e-9:
        raise ValueError("rectifying_rotations: the baseline runs along the viewing direction")
    y /= np.linalg.norm(y)
    R_rect_left = np.stack([x, y, np.cross(x, y)])
    return R_rect_left, R_rect_left @ R.T
