"""A check of a calibration: vertical disparity of SIFT matches, before and after.

Matches are found once, in the images as they stand, by appearance alone: no epipolar geometry
selects them, so none of the calibrations under test is favoured. What is left of wrong matches is
why the *median* is taken. Where the estimate was fitted to matches, some of these are among them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowrect.calibration import Projections
from flowrect.matchers import sift
from flowrect.sample import Image
from simgen.geometry import Array

MIN_MATCHES = 20
"""fewer than this say nothing"""


@dataclass(frozen=True, eq=False)
class MatchedRays:
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


def sift_matches(left: Image, right: Image, K_left: Array, K_right: Array) -> MatchedRays:
    """Mutual nearest neighbours among SIFT descriptors that pass the ratio test both ways."""
    return MatchedRays(*sift.match(left, right, sift.QUICK).rays(K_left, K_right))


def _seen(rays: Array, R: Array, P: Array) -> Array:
    points = rays @ (P[:, :3] @ R).T
    return points[:, :2] / points[:, 2:]
