"""From disparity to points: the frame that a rectified pair lives in.

A rectified pair shows the point X of the rectified left frame at u_left = f x/z + cx and
u_right = u_left − f b/z, so z = f b / (u_left − u_right), with b the length of the baseline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from flowrect.drectify import Rectification
from simgen.errors import UserError
from simgen.geometry import Array


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """What turns disparities of one rectified pair into points of its left camera."""

    R_left: Array
    """(3, 3) left camera to rectified frame"""
    K_new: Array
    """(3, 3) [px] of both rectified images"""
    baseline_m: float

    @property
    def focal_baseline(self) -> float:
        """f b: disparity times depth [px m]."""
        return float(self.K_new[0, 0]) * self.baseline_m

    def largest_disparity(self, nearest_m: float) -> float:
        """Disparity [px] of what is ``nearest_m`` in front of the rectified cameras."""
        return self.focal_baseline / nearest_m

    def rectified_depth(self, disparity: NDArray[np.floating]) -> NDArray[np.float64]:
        """z in the rectified frame [m]; infinite where disparity ≤ 0, NaN where it is NaN."""
        positive = np.where(disparity > 0, disparity, np.nan).astype(np.float64)
        depth = self.focal_baseline / positive
        return np.where(disparity <= 0, np.inf, depth)


def depth_frame(rect: Rectification, t: Tensor, index: int = 0) -> DepthFrame:
    """The frame of one pair of a batch.

    Args:
      rect: as the images were rectified, by a pose with translation t (B, 3) [m].

    Raises:
      UserError: the baseline is vertical, or the left camera is the right-hand one.
    """
    baseline = (rect.R_right[index] @ t[index].to(rect.R_right)).tolist()
    if bool(rect.vertical[index]) or baseline[0] >= 0:
        x, y, _ = baseline
        raise UserError(
            f"depth from disparity: the right camera is at ({-x:+.3g}, {-y:+.3g}) m (right, down) "
            "of the left one after rectification, expected it to the right. Exchange the images of "
            "a pair that is given the wrong way round; turn those of a vertical rig by 90°."
        )
    R_left, K_new = (x[index].cpu().numpy() for x in (rect.R_left, rect.K_new))
    return DepthFrame(R_left, K_new, -baseline[0])
