"""RPNet: the pose of each camera from its own image, and from the two the relative one.

Source: En, Lechervy, Jurie, *RPNet: an End-to-End Network for Relative Camera Pose Estimation*,
ECCV Workshops 2018.

One GoogLeNet serves both images. Each of its three heads (two of them auxiliary, as GoogLeNet has
them) gives an absolute pose: a quaternion q and a position c in some frame of the rig that nobody
prescribes. The relative pose is R = R(q_right) R(q_left)ᵀ, t = R(q_right) (c_left − c_right).

Deviations: GoogLeNet is torchvision's, with batch normalisation, and starts at random, since no
weights of PoseNet are at hand. Quaternions are brought to unit length before they are multiplied;
the release compares raw products. q = ±q is one rotation, so errors are taken at w ≥ 0. What the
heads mean (Δ, δ) is said in ``flowrect.rivals.frame``. Adam instead of SGD with momentum.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torchvision.models.googlenet import GoogLeNet

from flowrect.geometry import quaternion_from_rotation, rotation_from_quaternion
from flowrect.rivals.config import RPNetConfig
from flowrect.rivals.frame import Frame, answers, unit_quaternion, views

NO_POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""quaternion (x, y, z, w) and position of a head that says nothing"""


@dataclass(frozen=True)
class Prediction:
    """What RPNet says."""

    R: Tensor
    """(B, 3, 3) float64"""
    t: Tensor
    """(B, 3) float64"""
    frame: Frame
    heads: list[tuple[Tensor, Tensor]]
    """Δ (B, 3, 3) and δ (B, 3) of the last head and, in training, of the auxiliary ones"""


def relative_pose(left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Δ (B, 3, 3), δ (B, 3) of two absolute poses (B, 7): quaternion (x, y, z, w), position."""
    R_left, R_right = (rotation_from_quaternion(unit_quaternion(p[:, :4])) for p in (left, right))
    apart = (left[:, 4:] - right[:, 4:]).double()
    return R_right @ R_left.mT, (R_right @ apart[..., None])[..., 0]


class RPNet(nn.Module):
    """The Siamese network with its three heads."""

    def __init__(self, config: RPNetConfig) -> None:
        super().__init__()
        self.config = config
        p = config.dropout
        self.trunk = GoogLeNet(len(NO_POSE), init_weights=False, dropout=p, dropout_aux=p)
        last = nn.Linear(config.hidden, len(NO_POSE))
        self.trunk.fc = nn.Sequential(nn.Linear(1024, config.hidden), nn.ReLU(), last)
        for layer in (last, self.trunk.aux1.fc2, self.trunk.aux2.fc2):
            answers(layer, NO_POSE)

    def forward(
        self, left: Tensor, right: Tensor, K_left: Tensor, K_right: Tensor, R_init: Tensor,
        t_init: Tensor,
    ) -> Prediction:  # fmt: skip
        """Arguments as ``Rectifier.forward``; the auxiliary heads speak only in training."""
        seen = views(left, right, K_left, K_right, R_init, t_init, self.config)
        poses = self.trunk(seen.images)
        heads = [relative_pose(*p.chunk(2)) for p in (poses if self.training else [poses])]
        return Prediction(*seen.frame.pose(*heads[0]), seen.frame, heads)

    def losses(self, prediction: Prediction, R: Tensor, t: Tensor) -> dict[str, Tensor]:
        """Distances of quaternion and position, of all heads; R (B, 3, 3), t (B, 3) the truth."""
        Delta, shift = prediction.frame.residual(R, t)
        q = quaternion_from_rotation(Delta)
        auxiliary = [self.config.auxiliary] * (len(prediction.heads) - 1)
        rotation, translation = q.new_zeros(()), q.new_zeros(())
        for weight, head in zip([1.0, *auxiliary], prediction.heads, strict=True):
            rotation = rotation + weight * _distance(quaternion_from_rotation(head[0]), q)
            translation = translation + weight * _distance(head[1], shift)
        return {
            "rotation": self.config.rotation * rotation,
            "translation": self.config.translation * translation,
        }


def _distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean over pairs of |a − b|."""
    return torch.linalg.vector_norm(a - b, dim=-1).mean()
