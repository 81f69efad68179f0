"""The black rim of an undistorted image.

A lens with k1 > 0 is straightened by drawing the border of the picture inwards. Beyond it nothing
was taken; a camera that is turned afterwards (``flowrect.turn``) would show how far by its rim.
"""

from __future__ import annotations

import cv2
import numpy as np

from flowrect.resize import Box, cropped
from flowrect.sample import Pair
from simgen.errors import UserError
from simgen.geometry import Array

INSET = 1  # px: so far from the border, bicubic interpolation mixes in no black
PRECISE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-6)


def without_rim(pair: Pair, dist_left: Array, dist_right: Array) -> Pair:
    """The largest box of the pair that both images fill; K follows.

    Args:
      pair: undistorted, with the K of the images as they were taken.
      dist_left, dist_right: OpenCV's coefficients (k1, k2, p1, p2[, k3[, …]]) of their lenses.
    """
    filled = [
        _filled(pair.wh, K, np.asarray(dist, dtype=np.float64))
        for K, dist in ((pair.K_left, dist_left), (pair.K_right, dist_right))
    ]
    left, top = np.max([low for low, _ in filled], axis=0)
    right, bottom = np.min([high for _, high in filled], axis=0)
    if not (right > left and bottom > top):  # NaN where a lens cannot be inverted
        raise UserError(
            f"{pair.name}: its lenses leave nothing of {pair.wh[0]}x{pair.wh[1]} without a black "
            f"rim; are {dist_left} and {dist_right} their coefficients k1, k2, p1, p2, …?"
        )
    return cropped(pair, Box(int(left), int(top), int(right - left + 1), int(bottom - top + 1)))


def _filled(wh: tuple[int, int], K: Array, dist: Array) -> tuple[Array, Array]:
    """First and last pixel (u, v) of the box that the undistorted border encloses."""
    last = np.array(wh) - 1.0
    if not dist.any():
        return np.zeros(2), last
    u, v = (np.arange(INSET, n - INSET, dtype=np.float64) for n in wh)
    sides = ((INSET, v), (last[0] - INSET, v), (u, INSET), (u, last[1] - INSET))
    left, right, top, bottom = (_undistorted(_points(*side), K, dist) for side in sides)
    low = np.array([left[:, 0].max(), top[:, 1].max()])
    high = np.array([right[:, 0].min(), bottom[:, 1].min()])
    return np.ceil(low).clip(0), np.minimum(np.floor(high), last)


def _points(u: Array | float, v: Array | float) -> Array:
    """(N, 2) of a side of the image."""
    return np.stack(np.broadcast_arrays(u, v), axis=-1).astype(np.float64)


def _undistorted(uv: Array, K: Array, dist: Array) -> Array:
    """Where pixels (N, 2) of the picture as taken lie in the undistorted one."""
    return cv2.undistortImagePoints(uv, K, dist, None, PRECISE).reshape(-1, 2)
