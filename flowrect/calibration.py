"""A rig of two cameras: intrinsics, lenses and relative pose, and what rectification makes of it.

``flowrect.formats`` reads and writes it. Conventions are OpenCV's: X_right = R X_left + t, pixel
centres at whole numbers, distortion as ``cv2.undistort`` or ``cv2.fisheye`` understands it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch

from flowrect.drectify import rectify
from flowrect.files import matrix
from flowrect.sample import Image, require_fit
from simgen.errors import UserError
from simgen.geometry import Array, transform

Lens = Literal["polynomial", "fisheye"]
NUM_DIST: dict[Lens, tuple[int, ...]] = {"polynomial": (4, 5, 8, 12, 14), "fisheye": (4,)}
"""how many coefficients OpenCV's lenses may have"""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Intrinsics and relative pose of a pair."""

    K_left: Array
    K_right: Array
    T_right_left: Array
    """(4, 4)"""
    wh: tuple[int, int]
    """(width, height) [px] of the images that K belongs to"""
    dist_left: Array = field(default_factory=lambda: np.zeros(4))
    dist_right: Array = field(default_factory=lambda: np.zeros(4))
    lens: Lens = "polynomial"
    """what dist means: k1, k2, p1, p2[, k3, …] of OpenCV, or k1 … k4 of cv2.fisheye"""

    def __post_init__(self) -> None:
        for side, K in (("left", self.K_left), ("right", self.K_right)):
            require_fit(f"the calibration's K_{side}", K, self.wh)
        t = self.T_right_left[:3, 3]
        if not (np.isfinite(t).all() and t.any()):
            raise UserError(
                f"the calibration's baseline T is {t.tolist()}; expected the vector from camera to "
                "camera, which is not 0."
            )

    def require_size(self, wh: tuple[int, int], where: str) -> None:
        """UserError unless images have the calibrated size."""
        if wh != self.wh:
            raise UserError(
                f"{where}: an image of {wh[0]}x{wh[1]}, but the calibration is for "
                f"{self.wh[0]}x{self.wh[1]}. Give images of that size, or a calibration of theirs."
            )

    def with_pose(self, R: Array, t: Array) -> Calibration:
        """The same cameras, X_right = R X_left + t."""
        return replace(self, T_right_left=transform(R, t))

    def undistorted(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Both images as lenses without distortion would give them, with the same K."""
        pinholes = not (np.any(self.dist_left) or np.any(self.dist_right))
        if pinholes and self.lens == "polynomial":  # a fisheye of zeros is equidistant
            return left, right
        return self._warped(left, right, np.eye(3), np.eye(3), self.K_left, self.K_right)

    def rectified(self, left: Image, right: Image, to: Projections) -> tuple[Image, Image]:
        """Both images as taken, undistorted and rectified in one resampling; black outside."""
        return self._warped(left, right, to.R1, to.R2, to.P1[:, :3], to.P2[:, :3])

    def _warped(
        self, left: Image, right: Image, R1: Array, R2: Array, K1: Array, K2: Array
    ) -> tuple[Image, Image]:
        maps = (
            cv2.fisheye.initUndistortRectifyMap
            if self.lens == "fisheye"
            else cv2.initUndistortRectifyMap
        )
        first, second = (
            cv2.remap(image, *maps(K, dist, R, K_new, self.wh, cv2.CV_32FC1), cv2.INTER_CUBIC)
            for image, K, dist, R, K_new in (
                (left, self.K_left, self.dist_left, R1, K1),
                (right, self.K_right, self.dist_right, R2, K2),
            )
        )
        return first, second


@dataclass(frozen=True, eq=False)
class Projections:
    """What ``cv2.stereoRectify`` returns, with CALIB_ZERO_DISPARITY and alpha = -1; float64."""

    R1: Array
    """(3, 3) left camera to rectified frame"""
    R2: Array
    """(3, 3) right camera to rectified frame"""
    P1: Array
    """(3, 4) projection of the rectified left image, of the size of the given ones [px]"""
    P2: Array
    """(3, 4) the same of the right one, of points in the rectified *left* frame"""
    Q: Array
    """(4, 4) (u, v, disparity, 1) to homogeneous points of the rectified left frame"""

    @property
    def vertical(self) -> bool:
        """Whether the baseline is vertical, so that a point has the same u in both images."""
        return bool(abs(self.P2[1, 3]) > abs(self.P2[0, 3]))


def projections(
    T_right_left: Array, K_left: Array, K_right: Array, wh: tuple[int, int]
) -> Projections:
    """Rectification of a pair of pinhole cameras of one image size."""
    R, t, K1, K2 = (
        torch.as_tensor(np.asarray(x, dtype=np.float64))[None]
        for x in (T_right_left[:3, :3], T_right_left[:3, 3], K_left, K_right)
    )
    rect = rectify(R, t, K1, K2, wh)
    R_left, R_right, K = (x[0].numpy() for x in (rect.R_left, rect.R_right, rect.K_new))
    baseline = R_right @ T_right_left[:3, 3]  # along x, or along y for a vertical rig
    P1 = np.hstack([K, np.zeros((3, 1))])
    P2 = np.hstack([K, K @ baseline[:, None]])
    Q = np.array([[1, 0, 0, -K[0, 2]], [0, 1, 0, -K[1, 2]], [0, 0, 0, K[0, 0]], [0, 0, 0, 0.0]])
    Q[3, 2] = -1 / baseline[1 if bool(rect.vertical) else 0]
    return Projections(R_left, R_right, P1, P2, Q)


def distortion(values: Array | None, lens: Lens, where: str) -> Array:
    """Coefficients of a lens; 0 where there are none."""
    allowed = NUM_DIST[lens]
    if values is None or np.size(values) == 0:
        return np.zeros(allowed[0])
    if np.size(values) not in allowed:
        raise UserError(
            f"{where}: {np.size(values)} coefficients, expected one of {allowed} ({lens} lens)."
        )
    return matrix(values, (np.size(values),), where)
