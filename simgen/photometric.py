"""The global sub-pixel shift between two images that ought to agree after warping.

Model: right(x + flow(x) + s) = gain · left(x) + offset at textured pixels x, with one shift s for
the whole image. It ties the pixels to the geometry: a flow that is right explains the right image
with s = 0, while half a pixel in a principal point, or a ground truth taken at pixel corners,
shows as s ≠ 0.

Gauss-Newton on Tukey's robust cost. The images are slightly smoothed, against aliasing, and
sampled by cubic B-splines. The gradient in the Jacobian is the mean of both images', which keeps
noise from biasing s (Baker & Matthews 2004, section 3, on why one image's gradient would do so).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]

SMOOTHING_PX = 0.7  # standard deviation
TEXTURE_MIN = 2.0  # grey levels per pixel
UNCLIPPED = (8.0, 247.0)  # grey levels: outside, gain and offset do not hold
TUKEY = 4.685  # × standard deviation of the residual: 95 % efficiency on Gaussian noise
NUM_ITERATIONS_MAX = 20
CONVERGED_PX = 1e-4


@dataclass(frozen=True)
class Shift:
    """The shift that best explains the right image."""

    uv: Array
    """(2,) [px]"""
    std_error: float
    """of its components [px]"""
    correlation: float
    """between the two images' gradients, after warping"""
    num: int
    """textured pixels used"""


@dataclass(frozen=True, eq=False)
class _Grey:
    """A smoothed grey image as spline coefficients, with its gradient."""

    spline: Array
    du: Array
    dv: Array

    def value(self, uv: Array) -> Array:
        return _sample(self.spline, uv, order=3)

    def gradient(self, uv: Array) -> Array:
        return np.stack([_sample(g, uv, order=1) for g in (self.du, self.dv)], axis=-1)


def estimate_shift(
    left: NDArray[np.uint8], right: NDArray[np.uint8], uv: Array, end: Array
) -> Shift:
    """Fits the shift of the right image, given corresponding points.

    Args:
      left: image (H, W, 3); right: likewise.
      uv: pixels (N, 2) of the left image, away from depth edges; those without texture and the
        clipped ones are left out here.
      end: where the flow takes them in the right image (N, 2).
    """
    grey_left, grey_right = _grey(left), _grey(right)
    value, gradient = grey_left.value(uv), grey_left.gradient(uv)
    use = (np.hypot(*gradient.T) >= TEXTURE_MIN) & (value > UNCLIPPED[0]) & (value < UNCLIPPED[1])
    value, gradient, end = value[use], gradient[use], end[use]
    if value.size == 0:
        return Shift(np.zeros(2), np.inf, 0.0, 0)
    there = grey_right.gradient(end)
    shift, std_error = _fit(value, gradient, grey_right, end)
    correlation = (gradient * there).sum() / np.sqrt((gradient**2).sum() * (there**2).sum() + 1e-9)
    return Shift(shift, std_error, float(correlation), value.size)


def _fit(value: Array, gradient: Array, right: _Grey, end: Array) -> tuple[Array, float]:
    shift, gain, offset = np.zeros(2), 1.0, 0.0
    for _ in range(NUM_ITERATIONS_MAX):
        observed = right.value(end + shift)
        slope = (right.gradient(end + shift) + gain * gradient) / 2
        residual = observed - gain * value - offset
        residual -= np.median(residual)
        sigma = 1.4826 * np.median(np.abs(residual)) + 1e-6
        weight = np.clip(1 - (residual / (TUKEY * sigma)) ** 2, 0, 1) ** 2
        J = np.column_stack([-slope, value, np.ones_like(value)])
        normal = J.T @ (J * weight[:, None])
        *step, gain, offset = np.linalg.pinv(normal) @ (J.T @ (weight * observed))
        shift = shift + step
        if np.hypot(*step) < CONVERGED_PX:
            break
    covariance = sigma**2 * np.linalg.pinv(normal)
    return shift, float(np.sqrt(covariance.diagonal()[:2].max()))


def _grey(image: NDArray[np.uint8]) -> _Grey:
    grey = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTHING_PX)
    dv, du = np.gradient(smooth)
    return _Grey(ndimage.spline_filter(smooth, order=3), du, dv)


def _sample(image: Array, uv: Array, *, order: int) -> Array:
    return ndimage.map_coordinates(
        image, uv.T[::-1], output=np.float64, order=order, mode="nearest", prefilter=False
    )
