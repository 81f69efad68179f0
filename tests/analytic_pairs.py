"""Pairs in closed form: points at random depths, some at infinity, seen by two turned cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flowrect.correspondences import Correspondences

WH = (128, 64)
F_PX = 64.0  # 90° across


@dataclass(frozen=True)
class AnalyticPairs:
    """n pairs as float64 tensors; ``X_right = R X_left + t``."""

    R: torch.Tensor
    t: torch.Tensor
    K_left: torch.Tensor
    K_right: torch.Tensor
    truth: Correspondences


def analytic_pairs(
    n: int, *, seed: int, vertical: bool = False, limit_deg: float = 2.0, num: int = 800
) -> AnalyticPairs:
    """Baseline 0.8 m along the nominal axis; left ends uniform in the image, 5 m away or more."""
    rng = np.random.default_rng(seed)
    left, right = (
        Rotation.from_rotvec(rng.uniform(-limit_deg, limit_deg, (n, 3)) / 2, degrees=True)
        for _ in range(2)
    )
    t = right.inv().apply([0.0, -0.8, 0.0] if vertical else [-0.8, 0.0, 0.0])
    R = (right.inv() * left).as_matrix()
    centre = (np.array(WH) - 1) / 2
    K = np.array([[F_PX, 0, centre[0]], [0, F_PX, centre[1]], [0, 0, 1]])
    xy = (rng.uniform(-0.5, np.array(WH) - 0.5, (n, num, 2)) - centre) / F_PX
    rays_left = np.concatenate([xy, np.ones((n, num, 1))], axis=-1)
    inverse_depth = rng.uniform(0, 0.2, (n, num)) * (rng.random((n, num)) < 0.8)
    X_right = rays_left @ R.swapaxes(1, 2) + inverse_depth[..., None] * t[:, None]
    truth = Correspondences(
        rays_left,
        X_right / X_right[..., 2:],
        np.ones((n, num), bool),
        np.ones((n, num), bool),
        np.divide(1, inverse_depth, where=inverse_depth > 0, out=np.zeros_like(inverse_depth)),
    )
    K_batch = np.tile(K, (n, 1, 1))
    return AnalyticPairs(*map(torch.as_tensor, (R, t, K_batch, K_batch)), truth.to("cpu"))
