"""Rotations, intrinsics and rays of a pinhole pair in torch: batched and differentiable.

Notation as in CONVENTIONS.md: ``X_right = R X_left + t``, OpenCV camera axes (x right, y down,
z forward), ``uv`` with (0, 0) at the *centre* of the top-left pixel. A *ray* is a direction of a
camera frame with z = 1, or any point along it. All functions take any leading dimensions and
keep the dtype they are given; callers that need the last digits pass float64. No formula uses
``acos``: its gradient is infinite exactly at the nominal rig, where training sits.
"""

from __future__ import annotations

import torch
from torch import Tensor

BEHIND_PX = -1e6  # where `project` puts what is not in front: outside of every image, but finite


# --- rotations ---------------------------------------------------------------------------------


def skew(w: Tensor) -> Tensor:
    """[w]× (…, 3, 3) of w (…, 3): ``skew(w) @ x == cross(w, x)``."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def rotation_from_vector(w: Tensor) -> Tensor:
    """exp([w]×) (…, 3, 3) of a rotation vector (…, 3) in radians (Rodrigues)."""
    theta = torch.linalg.vector_norm(w, dim=-1)[..., None, None]
    a = torch.sinc(theta / torch.pi)  # sin θ / θ
    b = 0.5 * torch.sinc(theta / (2 * torch.pi)) ** 2  # (1 − cos θ) / θ²
    s = skew(w)
    return _identity_like(s) + a * s + b * (s @ s)


def quaternion_from_rotation(R: Tensor) -> Tensor:
    """Unit quaternion (…, 4) as (x, y, z, w), w ≥ 0, of R (…, 3, 3); stable at every angle.

    Each row of the matrix 4 q qᵀ, whose entries are sums of entries of R, is a multiple of q. The
    row of the largest diagonal entry is the one that loses no digits.
    Source: Shepperd, *Quaternion from rotation matrix*, 1978.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in R.unbind(-2))
    x, y, z, w = zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz
    rows = [
        torch.stack([1 + xx - yy - zz, xy + yx, xz + zx, x], dim=-1),
        torch.stack([xy + yx, 1 - xx + yy - zz, yz + zy, y], dim=-1),
        torch.stack([xz + zx, yz + zy, 1 - xx - yy + zz, z], dim=-1),
        torch.stack([x, y, z, w], dim=-1),
    ]
    outer = torch.stack(rows, dim=-2)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    q = _normalised(outer.gather(-2, best.expand(*best.shape[:-1], 4)).squeeze(-2))
    return torch.where(q[..., 3:] < 0, -q, q)


def rotation_from_quaternion(q: Tensor) -> Tensor:
    """R (…, 3, 3) of a unit quaternion (…, 4) as (x, y, z, w)."""
    s = skew(q[..., :3])
    return _identity_like(s) + 2 * q[..., 3:, None] * s + 2 * (s @ s)


def vector_from_rotation(R: Tensor) -> Tensor:
    """log of R (…, 3, 3): the rotation vector (…, 3) in radians, of length at most π."""
    q = quaternion_from_rotation(R)
    v, w = q[..., :3], q[..., 3:]
    square = (v * v).sum(-1, keepdim=True)
    tiny = square < 1e-12
    s = torch.where(tiny, 1.0, square).sqrt()
    half_angle_over_sin = torch.where(tiny, (1 - square / (3 * w * w)) / w, torch.atan2(s, w) / s)
    return 2 * half_angle_over_sin * v


def half_rotation(R: Tensor) -> Tensor:
    """R^½ (…, 3, 3), the rotation about the same axis by half of the angle (below π)."""
    q = quaternion_from_rotation(R)
    x, y, z, w = q.unbind(-1)
    return rotation_from_quaternion(_normalised(torch.stack([x, y, z, w + 1], dim=-1)))


def rotation_from_6d(r: Tensor) -> Tensor:
    """R (…, 3, 3) of r (…, 6), its x and y *columns* before orthogonalisation.

    Parallel or zero columns span no plane: the result is NaN.
    Source: paper, Eq. 9–11.
    """
    r_x, r_y = r[..., :3], r[..., 3:]
    x = _normalised(r_x)
    z = _normalised(torch.linalg.cross(x, r_y))
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def sixd_from_rotation(R: Tensor) -> Tensor:
    """The x and y columns (…, 6) of R (…, 3, 3); ``rotation_from_6d`` inverts it."""
    return torch.cat([R[..., :, 0], R[..., :, 1]], dim=-1)


def geodesic_rad(R_a: Tensor, R_b: Tensor) -> Tensor:
    """Angle (…) in [0, π] of the rotation between R_a and R_b (…, 3, 3)."""
    return torch.linalg.vector_norm(vector_from_rotation(R_a @ R_b.mT), dim=-1)


def angles_per_axis_rad(R_gt: Tensor, R_pred: Tensor) -> Tensor:
    """log(R_gt R_predᵀ) (…, 3): error about the right camera's x (pitch), y (yaw), z (roll)."""
    return vector_from_rotation(R_gt @ R_pred.mT)


# --- poses of a pair ---------------------------------------------------------------------------


def rotated(
    R: Tensor, t: Tensor, *, left: Tensor | None = None, right: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """(R, t) after the cameras turned about their centres: ``X_new = left X_left``, same right."""
    if left is not None:
        R = R @ left.mT
    if right is not None:
        R, t = right @ R, (right @ t[..., None])[..., 0]
    return R, t


def swapped(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """(R, t) of the pair whose left camera was the right one: (Rᵀ, −Rᵀt)."""
    return R.mT, -(R.mT @ t[..., None])[..., 0]


def mirrored_swap(
    R: Tensor, t: Tensor, K_left: Tensor, K_right: Tensor, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(R, t, K_left, K_right) after swapping the views and mirroring both left to right.

    With M = diag(−1, 1, 1): R' = M Rᵀ M and t' = −M Rᵀ t, so a left-first rig stays one.
    """
    m = torch.tensor([-1.0, 1.0, 1.0], dtype=R.dtype, device=R.device)
    R_swap, t_swap = swapped(R, t)
    return m[:, None] * R_swap * m, m * t_swap, mirrored(K_right, width), mirrored(K_left, width)


# --- intrinsics and rays -----------------------------------------------------------------------


def mirrored(K: Tensor, width: int) -> Tensor:
    """K (…, 3, 3) of an image mirrored left to right: cx' = W − 1 − cx."""
    K = K.clone()
    K[..., 0, 2] = width - 1 - K[..., 0, 2]
    return K


def resized(K: Tensor, scale_x: float, scale_y: float | None = None) -> Tensor:
    """K (…, 3, 3) of an image resized by new / old size: f' = s f, c' = s (c + ½) − ½."""
    scale_y = scale_x if scale_y is None else scale_y
    K = K.clone()
    K[..., :2, 2] += 0.5
    K[..., 0, :] *= scale_x
    K[..., 1, :] *= scale_y
    K[..., :2, 2] -= 0.5
    return K


def cropped(K: Tensor, left: float, top: float) -> Tensor:
    """K (…, 3, 3) of an image cut so that pixel (left, top) becomes (0, 0)."""
    K = K.clone()
    K[..., 0, 2] -= left
    K[..., 1, 2] -= top
    return K


def inverse_intrinsics(K: Tensor) -> Tensor:
    """K⁻¹ (…, 3, 3) of an upper triangular K, in closed form (exports and differentiates)."""
    fx, s, cx, fy, cy = K[..., 0, 0], K[..., 0, 1], K[..., 0, 2], K[..., 1, 1], K[..., 1, 2]
    o, one = torch.zeros_like(fx), torch.ones_like(fx)
    entries = [1 / fx, -s / (fx * fy), (s * cy / fy - cx) / fx, o, 1 / fy, -cy / fy, o, o, one]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def project(K: Tensor, points: Tensor) -> Tensor:
    """uv (…, N, 2) [px] of points (…, N, 3) of the camera frame; ``BEHIND_PX`` where z ≤ 0."""
    xyz = points.mT
    z = xyz[..., 2:, :]
    in_front = z > 0
    uv = (K[..., :2, :] @ xyz) / torch.where(in_front, z, 1.0)  # by columns: all u, then all v
    return torch.where(in_front, uv, BEHIND_PX).mT


def unproject(K: Tensor, uv: Tensor) -> Tensor:
    """Rays (…, N, 3) with z = 1 through uv (…, N, 2) [px]."""
    return torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1) @ inverse_intrinsics(K).mT


def inside(uv: Tensor, wh: tuple[int, int]) -> Tensor:
    """True (…) where uv (…, 2) lies on the image's area: −½ ≤ u < W − ½, −½ ≤ v < H − ½."""
    u, v = uv.unbind(-1)  # by themselves: all(-1) of two takes longer than the comparisons
    return (u >= -0.5) & (u < wh[0] - 0.5) & (v >= -0.5) & (v < wh[1] - 0.5)


def pixel_grid(wh: tuple[int, int], *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """All pixel centres (H·W, 2) as (u, v), row by row."""
    u, v = (torch.arange(n, dtype=dtype, device=device) for n in wh)
    return torch.cartesian_prod(v, u).flip(-1)


def _normalised(x: Tensor) -> Tensor:
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)


def _identity_like(R: Tensor) -> Tensor:
    return torch.eye(3, dtype=R.dtype, device=R.device)
