"""DRectify: from [R | t] to rectified images, differentiable from end to end (paper, section 3.3).

Bouguet's method, as OpenCV's ``stereoRectify`` does it, in closed form: both cameras turn half of R
towards each other, ``H = R^½``, which leaves the baseline ``t' = Hᵀ t``; then both turn by the
smallest rotation W that lays t' on the axis u = ±x̂ (horizontal rig) or ±ŷ (vertical rig):

    R_left = W H        R_right = W Hᵀ        R_right R R_leftᵀ = I        R_right t = |t| u

A *rectified frame* has K_new and no lens of its own; a point has the same v in both (horizontal
rig), or the same u (vertical rig). Rotations and pixel positions are float64 throughout.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from flowrect.geometry import (
    BEHIND_PX,
    half_rotation,
    inverse_intrinsics,
    project,
    resized,
    skew,
    unproject,
)

ROUNDING_PX = 1e-10
"""That positions may be off: images that nothing turns keep their outermost pixels."""


@dataclass(frozen=True)
class Rectification:
    """How to turn the images of each pair; float64."""

    R_left: Tensor
    """(B, 3, 3) left camera to rectified frame: OpenCV's R1"""
    R_right: Tensor
    """(B, 3, 3) right camera to rectified frame: OpenCV's R2"""
    K_new: Tensor
    """(B, 3, 3) [px] intrinsics of both rectified images"""
    vertical: Tensor
    """(B,) bool: the baseline is vertical, so epipolar lines are columns"""

    def resized(self, scale_x: float, scale_y: float | None = None) -> Rectification:
        """The same rectified frames with images of another size (new / old)."""
        return replace(self, K_new=resized(self.K_new, scale_x, scale_y))


def rectify(
    R: Tensor,
    t: Tensor,
    K_left: Tensor,
    K_right: Tensor,
    wh: tuple[int, int],
    *,
    K_new: Tensor | None = None,
) -> Rectification:
    """Rectifying rotations and intrinsics of a pair, by Bouguet's method.

    Args:
      R, t: (B, 3, 3) and (B, 3), ``X_right = R X_left + t``; R turns by less than π. The length
        of t does not matter; t = 0 has no rectification and gives NaN.
      K_left, K_right: (B, 3, 3) [px].
      wh: size of the images that they belong to, and of the rectified ones.
      K_new: (B, 3, 3) or (3, 3) [px]: taken as it is, so that the scale and centre of the rectified
        images do not move with the estimate; None: see ``new_intrinsics``.
    """
    R, t, K_left, K_right = (x.double() for x in (R, t, K_left, K_right))
    H = half_rotation(R)
    baseline = (H.mT @ t[..., None])[..., 0]
    vertical = baseline[..., 0].abs() <= baseline[..., 1].abs()
    W = _onto_axis(baseline, vertical)
    R_left, R_right = W @ H, W @ H.mT
    if K_new is None:
        K_new = new_intrinsics(K_left, K_right, R_left, R_right, vertical, wh)
    return Rectification(R_left, R_right, K_new.double().expand_as(R_left), vertical)


def new_intrinsics(
    K_left: Tensor,
    K_right: Tensor,
    R_left: Tensor,
    R_right: Tensor,
    vertical: Tensor,
    wh: tuple[int, int],
) -> Tensor:
    """K_new (B, 3, 3) as ``stereoRectify`` with CALIB_ZERO_DISPARITY and alpha = −1 has it.

    f is the mean of both cameras' focal lengths across the baseline (fy; fx of a vertical rig). c
    puts the mean of the turned image corners, averaged over both cameras, into the image's centre.
    """
    fx, fy = (0.5 * (K_left[..., i, i] + K_right[..., i, i]) for i in (0, 1))
    f = torch.where(vertical, fx, fy)
    uncentred = torch.diag_embed(torch.stack([f, f, torch.ones_like(f)], dim=-1))
    corners = _corners(wh, like=K_left)
    turned = [
        project(uncentred, unproject(K, corners) @ R_rect.mT).mean(-2)
        for K, R_rect in ((K_left, R_left), (K_right, R_right))
    ]
    K_new = uncentred.clone()
    K_new[..., :2, 2] = corners.mean(0) - 0.5 * (turned[0] + turned[1])
    return K_new


def source_positions(K: Tensor, R_rect: Tensor, K_new: Tensor, wh_out: tuple[int, int]) -> Tensor:
    """Where each rectified pixel lies in the image of the camera: uv (B, H, W, 2) [px].

    OpenCV's ``initUndistortRectifyMap`` without distortion. ``geometry.BEHIND_PX`` for a pixel that
    looks behind the camera.
    """
    # One homography, by outer sums: in a third of the time of a list of all pixels and their rays.
    columns = (K @ R_rect.mT @ inverse_intrinsics(K_new)).mT[..., None, None]
    u, v = (torch.arange(n, dtype=K_new.dtype, device=K_new.device) for n in wh_out)
    of_u, of_v, constant = columns.unbind(-4)
    xyz = of_u * u + (of_v * v[:, None] + constant)
    z = xyz[..., 2:, :, :]
    in_front = z > 0
    uv = xyz[..., :2, :, :] / torch.where(in_front, z, 1.0)
    return torch.where(in_front, uv, BEHIND_PX).movedim(-3, -1)


def warp(
    image: Tensor, K: Tensor, R_rect: Tensor, K_new: Tensor, wh_out: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Resamples images bilinearly into the rectified frame, black where there is no image.

    Args:
      image: (B, C, h, w) of any floating type.
      K: (B, 3, 3) [px] of ``image``.
      R_rect: (B, 3, 3) camera to rectified frame.
      K_new: (B, 3, 3) [px] of the rectified image.
      wh_out: its size.

    Returns:
      The rectified image (B, C, H, W), and valid (B, 1, H, W): True where the source position
      lies in the hull of the source's pixel *centres*, 0 ≤ u ≤ w − 1 and 0 ≤ v ≤ h − 1 within
      ``ROUNDING_PX``: there no black is mixed in. Over the next pixel outwards the image fades to
      black.
    """
    uv = source_positions(K.double(), R_rect.double(), K_new.double(), wh_out)
    h, w = image.shape[-2:]
    last = torch.tensor([w - 1, h - 1], dtype=uv.dtype, device=uv.device)
    u, v = uv.unbind(-1)
    valid = (
        (u >= -ROUNDING_PX) & (u <= w - 1 + ROUNDING_PX)
        & (v >= -ROUNDING_PX) & (v <= h - 1 + ROUNDING_PX)
    )[:, None]  # fmt: skip
    dtype = torch.promote_types(image.dtype, torch.float32)  # half types cannot tell pixels apart
    grid = ((2 * uv + 1) / (last + 1) - 1).to(dtype)
    warped = F.grid_sample(image.to(dtype), grid, padding_mode="zeros", align_corners=False)
    return warped.to(image.dtype), valid


def rectified_uv(rays: Tensor, R_rect: Tensor, K_new: Tensor) -> Tensor:
    """Positions (B, N, 2) [px] in the rectified image of rays (B, N, 3) of the camera frame."""
    towards = (K_new @ R_rect) @ rays.mT  # one product for rotation and projection
    z = towards[..., 2:, :]
    in_front = z > 0
    uv = towards[..., :2, :] / torch.where(in_front, z, 1.0)  # by columns: all u, then all v
    return torch.where(in_front, uv, BEHIND_PX).mT


def _onto_axis(baseline: Tensor, vertical: Tensor) -> Tensor:
    """The smallest rotation (B, 3, 3) that turns the baseline (B, 3) onto its axis ±x̂ or ±ŷ.

    I + [v]× + [v]×² / (1 + c) with v = a × u and c = a · u, for unit a and u: smooth at v = 0,
    where the usual angle and axis are 0 / 0. The sign of u makes c ≥ 0.
    """
    a = baseline / torch.linalg.vector_norm(baseline, dim=-1, keepdim=True)
    x, y, _ = torch.eye(3, dtype=a.dtype, device=a.device)
    axis = torch.where(vertical[..., None], y, x)
    u = torch.where((a * axis).sum(-1, keepdim=True) < 0, -axis, axis)
    s = skew(torch.linalg.cross(a, u))
    c = (a * u).sum(-1)[..., None, None]
    return torch.eye(3, dtype=a.dtype, device=a.device) + s + s @ s / (1 + c)


def _corners(wh: tuple[int, int], *, like: Tensor) -> Tensor:
    """The outermost pixel centres (4, 2)."""
    w, h = wh[0] - 1.0, wh[1] - 1.0
    return like.new_tensor([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
