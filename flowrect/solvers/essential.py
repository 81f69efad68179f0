"""The essential matrix from matches and known intrinsics, robustly; R and t's direction from it.

All solvers take thresholds in pixels, see neither prior nor rig (``supported`` refuses what is far
from the prior), and return a pose whose t has the prior's length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from flowrect.matches import Matches
from flowrect.solvers.solution import NoSolution, Solution, require_matches
from simgen.geometry import Array

MIN_MATCHES = 8
MIN_INLIERS = 15


@dataclass(frozen=True)
class Ransac:
    """How a robust solver decides."""

    threshold_px: float = 1.0
    """largest error of an inlier"""
    normalised: bool = False
    """the threshold is taken on normalised points instead, where one unit is a focal length"""
    iterations: int = 10_000
    """at most"""
    confidence: float = 0.9999
    seed: int = 0

    def in_pixels(self, K: Array) -> float:
        """The threshold [px]."""
        return self.threshold_px * (float(K[1, 1]) if self.normalised else 1.0)


def lo_ransac(
    matches: Matches, K_left: Array, K_right: Array, prior: Array, options: Ransac
) -> Solution:
    """LO-RANSAC of PoseLib, with its bundle adjustment of R and t at the end.

    Source: V. Larsson, PoseLib, 2020; J. Matas, O. Chum, J. Kittler, *Locally optimized RANSAC*.
    """
    require_matches(matches, MIN_MATCHES)
    pose, info = poselib.estimate_relative_pose(
        matches.uv_left, matches.uv_right, _camera(K_left), _camera(K_right),
        {"max_epipolar_error": options.in_pixels(K_left), "max_iterations": options.iterations,
         "success_prob": options.confidence, "seed": options.seed},
        {},
    )  # fmt: skip
    return _solution(pose.R, pose.t, np.array(info["inliers"], dtype=bool), prior)


def magsac(
    matches: Matches, K_left: Array, K_right: Array, prior: Array, options: Ransac
) -> Solution:
    """MAGSAC++ of OpenCV (D. Barath et al., CVPR 2020)."""
    return _by_opencv(matches, K_left, K_right, prior, options, cv2.USAC_MAGSAC)


def usac(
    matches: Matches, K_left: Array, K_right: Array, prior: Array, options: Ransac
) -> Solution:
    """LO-RANSAC of OpenCV (R. Raguram et al., *USAC*, TPAMI 2013), as it sets it by default."""
    return _by_opencv(matches, K_left, K_right, prior, options, cv2.USAC_DEFAULT)


def _by_opencv(
    matches: Matches, K_left: Array, K_right: Array, prior: Array, options: Ransac, method: int
) -> Solution:
    require_matches(matches, MIN_MATCHES)
    K = np.eye(3) if options.normalised else K_left  # OpenCV's own bounds are in pixels of K
    left, right = (x[:, :2] @ K[:2, :2].T + K[:2, 2] for x in matches.rays(K_left, K_right))
    cv2.setRNGSeed(options.seed)
    try:
        E, inliers = cv2.findEssentialMat(
            left, right, K, method=method, prob=options.confidence,
            threshold=options.threshold_px, maxIters=options.iterations,
        )  # fmt: skip
    except cv2.error as error:
        raise NoSolution(f"OpenCV finds no essential matrix ({error.err}).") from error
    if E is None or E.shape[0] < 3:
        raise NoSolution("OpenCV finds no essential matrix: degenerate matches?")
    # Without distanceThresh, points beyond 50 baselines do not count for which way t points.
    _, R, t, *_ = cv2.recoverPose(E[:3], left, right, K, distanceThresh=1e9, mask=inliers.copy())
    return _solution(R, t[:, 0], inliers[:, 0] > 0, prior)


def _camera(K: Array) -> dict[str, Any]:
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    wh = [round(2 * K[i, 2]) + 1 for i in (0, 1)]
    return {"model": "PINHOLE", "width": wh[0], "height": wh[1], "params": params}


def _solution(R: Array, t: Array, inliers: NDArray[np.bool_], prior: Array) -> Solution:
    if inliers.sum() < MIN_INLIERS:
        raise NoSolution(f"only {inliers.sum()} of {len(inliers)} matches agree on a pose, "
                         f"expected at least {MIN_INLIERS}.")  # fmt: skip
    length = np.linalg.norm(prior[:3, 3])
    return Solution(np.asarray(R), np.asarray(t) / np.linalg.norm(t) * length, inliers)
