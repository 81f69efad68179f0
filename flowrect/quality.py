"""A check of a calibration that no network takes part in: vertical disparity of SIFT matches.

Matches are found once, in the images as they stand, by appearance alone: no epipolar geometry
selects them, so none of the calibrations under test is favoured. What is left of wrong matches is
why the *median* is taken. Source: D. Lowe, IJCV 2004 (SIFT, and the ratio test).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowrect.calibration import Projections
from flowrect.resize import resized_image
from flowrect.sample import Image
from simgen.geometry import Array

RATIO = 0.75
"""of the distances to the best and the second best descriptor"""
MAX_PIXELS = 1_500_000
"""larger images are shrunk for SIFT"""
MAX_FEATURES = 4000
MIN_MATCHES = 20
"""fewer than this say nothing"""


@dataclass(frozen=True, eq=False)
class Matches:
    """N matches of a pair without distortion, as rays K⁻¹ (u, v, 1)ᵀ of both cameras."""

    rays_left: Array
    """(N, 3)"""
    rays_right: Array

    def __len__(self) -> int:
        return len(self.rays_left)

    def rectified(self, to: Projections) -> tuple[Array, Array]:
        """uv_left, uv_right (N, 2) [px] in the rectified images."""
        return _seen(self.rays_left, to.R1, to.P1), _seen(self.rays_right, to.R2, to.P2)

    def median_vertical_disparity(self, to: Projections) -> float | None:
        """Median |v_right − v_left| [px], of u for a vertical rig; None if there are too few."""
        if len(self) < MIN_MATCHES:
            return None
        uv_left, uv_right = self.rectified(to)
        across = 0 if to.vertical else 1
        return float(np.median(np.abs(uv_right - uv_left)[:, across]))


def sift_matches(left: Image, right: Image, K_left: Array, K_right: Array) -> Matches:
    """Mutual nearest neighbours among SIFT descriptors that pass the ratio test both ways."""
    (uv_left, first), (uv_right, second) = _features(left), _features(right)
    pairs = _mutual(first, second)
    return Matches(
        _rays(uv_left[pairs[:, 0]], K_left),
        _rays(uv_right[pairs[:, 1]], K_right),
    )


def _features(image: Image) -> tuple[Array, Array]:
    """Positions (N, 2) [px] and descriptors (N, 128)."""
    h, w = image.shape[:2]
    scale = min(1.0, (MAX_PIXELS / (w * h)) ** 0.5)
    wh = round(w * scale), round(h * scale)
    grey = cv2.cvtColor(resized_image(image, wh), cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(grey, None)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    uv = np.array([k.pt for k in keypoints], dtype=np.float64)
    return (uv + 0.5) * np.array([w / wh[0], h / wh[1]]) - 0.5, descriptors


def _mutual(first: Array, second: Array) -> np.ndarray:
    """Indices (N, 2) of descriptors that are each other's best, far better than the next."""
    forth, back = _best(first, second), _best(second, first)
    pairs = [(i, j) for i, j in forth.items() if back.get(j) == i]
    return np.array(pairs, dtype=int).reshape(-1, 2)


def _best(queries: Array, among: Array) -> dict[int, int]:
    if len(queries) == 0 or len(among) < 2:
        return {}
    found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(queries, among, k=2)
    return {a.queryIdx: a.trainIdx for a, b in found if a.distance < RATIO * b.distance}


def _rays(uv: Array, K: Array) -> Array:
    return np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(K).T


def _seen(rays: Array, R: Array, P: Array) -> Array:
    points = rays @ (P[:, :3] @ R).T
    return points[:, :2] / points[:, 2:]
