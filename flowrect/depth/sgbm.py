"""Semi-global block matching (Hirschmüller, PAMI 2008) by OpenCV; nothing is learned.

Set up as OpenCV's own sample is: P1 and P2 are 8 and 32 times the channels and pixels of a block,
costs of all three colours, a left-right check, and small islands of odd disparity removed.
Disparity below 0, which a wrong yaw gives to what is far, is not looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrect.sample import Image

SUBPIXEL = 16
"""OpenCV counts disparity in sixteenths of a pixel"""
STEP = 16
"""and takes a multiple of this many disparities"""


@dataclass(frozen=True)
class Sgbm:
    """How blocks are matched."""

    block: int = 5
    """side of a block [px], odd"""
    mode: int = cv2.STEREO_SGBM_MODE_SGBM_3WAY
    """3WAY sums costs along 3 directions, HH along 8: twice the time, and on rendered roads fewer
    pixels pass the uniqueness check (57 % against 81 % within 10 m) with no smaller errors"""
    left_right_px: int = 1
    """largest difference of a pixel's disparity and that of where it went"""
    uniqueness_percent: int = 10
    """how much better than the second the best cost has to be"""
    speckle_px: int = 100
    """islands of at most this many pixels are removed"""
    speckle_range_px: int = 2
    """disparities that differ by at most this from pixel to pixel are of one island"""
    prefilter_cap: int = 63
    """of the horizontal derivative that costs are taken of"""


TUNED = Sgbm()


def disparity(
    left: Image, right: Image, *, largest_px: float, options: Sgbm = TUNED
) -> NDArray[np.float32]:
    """Disparity (H, W) [px] of a rectified pair, to a sixteenth; NaN where unknown.

    Args:
      left, right: (H, W, 3) uint8 RGB.
      largest_px: the largest disparity that can occur.
    """
    num = STEP * max(1, int(np.ceil((largest_px + 1) / STEP)))
    # OpenCV answers no pixel within num of the left border, near or far; more border, and it does.
    padded = [cv2.copyMakeBorder(x, 0, 0, num, 0, cv2.BORDER_REPLICATE) for x in (left, right)]
    found = _matcher(num, options).compute(*padded)[:, num:].astype(np.float32) / SUBPIXEL
    return without_outside(np.where(found < 0, np.float32(np.nan), found))


def without_outside(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """NaN where the match would lie left of the right image: only border can be there."""
    u = np.arange(disparity.shape[1], dtype=np.float32)
    return np.where(disparity > u + 0.5, np.float32(np.nan), disparity)


def _matcher(num: int, options: Sgbm) -> cv2.StereoSGBM:
    area = 3 * options.block**2
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=num,
        blockSize=options.block,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=options.left_right_px,
        preFilterCap=options.prefilter_cap,
        uniquenessRatio=options.uniqueness_percent,
        speckleWindowSize=options.speckle_px,
        speckleRange=options.speckle_range_px,
        mode=options.mode,
    )
