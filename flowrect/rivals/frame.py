"""What a rival sees of a pair, and the frame that its answer is written in.

As published, the rivals see the images as they are and answer with the relative pose itself. On a
rig whose drawing is known that would have them learn the drawing, so by default (``start`` of their
configs) they see what our network sees: both images *rectified by the prior* (R_init, t_init). They
answer with what it leaves over, in that rectified frame, where b = |t_init|:

    Δ = R_right R R_leftᵀ        δ = R_right (t − t_init) / b

Δ = I and δ = 0 if the prior is right. As published, R_left = R_right = I, t_init = 0 and b = 1 m,
so that Δ = R and δ = t. R, t take points of the left camera to the right one; all is float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from flowrect.drectify import rectify, warp
from flowrect.geometry import resized
from flowrect.rivals.config import SharedConfig

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""of ImageNet's RGB, by which all three trunks are usually fed"""


@dataclass(frozen=True)
class Frame:
    """The rectified frame of a prior, and what t is counted from."""

    R_left: Tensor
    """(B, 3, 3) left camera to rectified frame"""
    R_right: Tensor
    t_start: Tensor
    """(B, 3) t_init, or 0"""
    unit: Tensor
    """(B, 1) length of the prior's baseline, or 1 m"""

    def pose(self, Delta: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        """R (B, 3, 3) and t (B, 3) of Δ and δ."""
        turned_back = (self.R_right.mT @ shift[..., None])[..., 0]
        return self.R_right.mT @ Delta @ self.R_left, self.t_start + self.unit * turned_back

    def residual(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Δ and δ of R and t; ``pose`` inverts it."""
        shift = (self.R_right @ (t - self.t_start)[..., None])[..., 0] / self.unit
        return self.R_right @ R @ self.R_left.mT, shift


@dataclass(frozen=True)
class Views:
    """What a rival sees."""

    images: Tensor
    """(2B, 3, h, w), the left views first, by ImageNet's mean and deviation"""
    K: Tensor
    """(2B, 3, 3) [px] of these images"""
    frame: Frame


def views(
    left: Tensor, right: Tensor, K_left: Tensor, K_right: Tensor, R_init: Tensor, t_init: Tensor,
    config: SharedConfig,
) -> Views:  # fmt: skip
    """Both images at ``config.network_wh``; arguments are those of ``Rectifier.forward``."""
    K_left, K_right, R_init, t_init = (x.double() for x in (K_left, K_right, R_init, t_init))
    w, h = wh = config.network_wh
    H, W = left.shape[-2:]
    images = F.interpolate(torch.cat([left, right]), (h, w), mode="bilinear", antialias=True)
    K = resized(torch.cat([K_left, K_right]), w / W, h / H)
    if config.start == "none":
        eye = torch.eye(3, dtype=K.dtype, device=K.device).expand_as(R_init)
        frame = Frame(eye, eye, torch.zeros_like(t_init), torch.ones_like(t_init[:, :1]))
        return Views(_normalised(images), K, frame)
    rect = rectify(R_init, t_init, K_left, K_right, (W, H))
    K_new = resized(torch.cat([rect.K_new, rect.K_new]), w / W, h / H)  # squeezed, not cut
    images, _ = warp(images, K, torch.cat([rect.R_left, rect.R_right]), K_new, wh)
    baseline = torch.linalg.vector_norm(t_init, dim=-1, keepdim=True)
    return Views(_normalised(images), K_new, Frame(rect.R_left, rect.R_right, t_init, baseline))


def unit_quaternion(q: Tensor) -> Tensor:
    """q (…, 4) as (x, y, z, w), of unit length and float64; shorter than .01 it stays short."""
    return F.normalize(q.double(), dim=-1, eps=0.01)


def answers(layer: nn.Linear, values: tuple[float, ...]) -> None:
    """Has a last layer start with nearly these values, whatever it is given."""
    with torch.no_grad():
        layer.weight.mul_(0.01)
        layer.bias.copy_(torch.tensor(values))


def _normalised(images: Tensor) -> Tensor:
    mean, deviation = (images.new_tensor(x)[:, None, None] for x in (MEAN, DEVIATION))
    return (images - mean) / deviation
