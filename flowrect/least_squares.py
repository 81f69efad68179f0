"""The rotation between two views from weighted matches, in closed form but for a few iterations.

In the frame that the prior rectifies to, the right camera is turned by Δ = exp([ω]×) and moved
along x only: a left ray p = (x, y, 1) is seen at q = Δ p + (τ, 0, 0), at any depth. So the vertical
coordinate of a match knows nothing of depth, and for small ω

  q_y/q_z − y = −ω_x (1 + y²) + ω_y x y + ω_z x,     q_x/q_z − x = ω_y (1 + x²) − ω_z y − ω_x x y

of which a horizontal rig uses the first and a vertical rig (moved along y) the second.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flowrect.geometry import rotation_from_vector

ROBUST_PX = 0.5  # Cauchy's scale, in pixels of the feature map


def rotation_from_matches(
    xy_left: Tensor,
    xy_right: Tensor,
    weight: Tensor,
    vertical: Tensor,
    *,
    focal_px: Tensor,
    prior_sigma_rad: float,
    iterations: int = 3,
) -> Tensor:
    """Rotation Δ (B, 3, 3) that takes left rays to right ones up to a shift along the baseline.

    Gauss-Newton with Cauchy weights; differentiable, float64. With all weights 0, the identity.

    Args:
      xy_left, xy_right: (B, N, 2) normalised coordinates of the matches.
      weight: (B, N) ≥ 0, the inverse variance of each match [1/px²].
      vertical: (B,) True where the baseline runs along y.
      focal_px: (B,) pixels per unit of xy.
      prior_sigma_rad: of each component of ω around 0.
    """
    rays = torch.cat([xy_left, torch.ones_like(xy_left[..., :1])], -1)
    across = torch.where(vertical, 0, 1)[:, None, None].expand(*xy_left.shape[:2], 1)
    measured = xy_right.gather(2, across)[..., 0]
    f = focal_px[:, None]
    ridge = torch.eye(3, dtype=rays.dtype, device=rays.device) / prior_sigma_rad**2
    omega = torch.zeros_like(rays[:, 0])
    for _ in range(iterations):
        turned = rays @ rotation_from_vector(omega).mT
        seen = turned[..., :2] / turned[..., 2:]
        residual = measured - seen.gather(2, across)[..., 0]
        J = _jacobian(seen).gather(2, across[..., None].expand(-1, -1, 1, 3))[:, :, 0]
        w = weight * f**2 / (1 + (f * residual / ROBUST_PX) ** 2)
        A = J.mT @ (w[..., None] * J) + ridge
        b = (J.mT @ (w * residual)[..., None])[..., 0] - omega @ ridge
        omega = omega + _solve(A, b)
    return rotation_from_vector(omega)


def _solve(A: Tensor, b: Tensor) -> Tensor:
    """A⁻¹ b (B, 3) of A (B, 3, 3) by Cramer's rule, since ONNX has no solver."""
    x, y, z = A.unbind(-1)
    rows = torch.stack([torch.linalg.cross(*ab) for ab in ((y, z), (z, x), (x, y))], -2)
    determinant = (x * rows[:, 0]).sum(-1, keepdim=True)
    return (rows @ b[..., None])[..., 0] / determinant


def _jacobian(xy: Tensor) -> Tensor:
    """d(x, y)/dω (B, N, 2, 3) of a ray seen at xy, for a small rotation after it."""
    x, y = xy.unbind(-1)
    of_x = torch.stack([-x * y, 1 + x**2, -y], -1)
    of_y = torch.stack([-1 - y**2, x * y, x], -1)
    return torch.stack([of_x, of_y], -2)
