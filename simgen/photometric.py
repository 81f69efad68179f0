"""Two small numbers that tie the pixels of a pair to its geometry.

shift s:  right(x + flow(x) + s) = gain · left(x) + bias at all textured pixels x. A flow that is
          right explains the right image with s = 0; half a pixel in one principal point, or a
          turned camera, does not.
offset o: both images show at pixel x what depth and flow hold at x + o, for example half a pixel
          if the ground truth was taken at pixel corners. Then x belongs to x + flow(x + o), so
          that the slope of the flow, on road and walls, makes o visible beside s.

In haze a point is paler in the camera that is further from it: gain and bias may change linearly
with the difference of its two distances. Fog's own gradients lie at equal distances, not at equal
points, and would pass for a shift (0.4 px at a visibility of 50 m and a baseline of 1.6 m).

Both by Gauss-Newton on Tukey's robust cost. The images are slightly smoothed, against aliasing,
and sampled by cubic B-splines. The gradient in the Jacobian is the mean of both images', so that
the noise of one of them is not squared and does not bias the result.

Standard errors are those of residuals that are correlated within tiles of the image (denoised
noise is), not of independent pixels: the "sandwich" of Liang & Zeger, Longitudinal data analysis
using generalized linear models, 1986.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]

SMOOTHING_PX = 0.5  # standard deviation
TEXTURE_MIN = 1.0  # grey levels per pixel
UNCLIPPED = (8.0, 247.0)  # grey levels: outside, gain and offset do not hold
TUKEY = 4.685  # × standard deviation of the residual: 95 % efficiency on Gaussian noise
TILE_PX = 32  # residuals further apart than this are taken as independent
UNDETERMINED = 1e-14  # variances below this [px²] mean that a component has no influence
NUM_ITERATIONS_MAX = 20
CONVERGED_PX = 1e-4


@dataclass(frozen=True, eq=False)
class Estimate:
    """A displacement and its uncertainty."""

    uv: Array
    """(2,) [px]"""
    std_error: Array
    """(2,) [px]"""

    def __str__(self) -> str:
        parts = zip(self.uv, self.std_error, strict=True)
        return ", ".join(f"{value:+.4f} ± {error:.4f}" for value, error in parts) + " px"


@dataclass(frozen=True, eq=False)
class Alignment:
    """How the images of a pair lie on each other and on the geometry."""

    shift: Estimate
    offset: Estimate
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


@dataclass(frozen=True, eq=False)
class _Matches:
    """Textured pixels of the left image, and where to find them in the right one."""

    value: Array
    gradient: Array
    further: Array
    right: _Grey
    end: Array
    tile: NDArray[np.intp]
    """(N,) number of the image tile"""


def align(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    uv: Array,
    end: Array,
    flow_slope: Array,
    further: Array,
) -> Alignment:
    """Fits shift and offset of a pair of images (H, W, 3), given corresponding points.

    Args:
      left: where ``uv`` lie; right: where ``end`` lie.
      uv: pixels (N, 2) away from depth edges; those without texture and the clipped ones are
        left out here.
      end: where the flow takes them, (N, 2).
      flow_slope: derivative (N, 2, 2) of the flow with respect to (u, v), in the last axis.
      further: (N,) [m] by how much the point is further from the right camera than from the left.
    """
    grey_left, grey_right = _grey(left), _grey(right)
    value, gradient = grey_left.value(uv), grey_left.gradient(uv)
    use = (np.hypot(*gradient.T) >= TEXTURE_MIN) & (value > UNCLIPPED[0]) & (value < UNCLIPPED[1])
    if not use.any():
        nothing = Estimate(np.zeros(2), np.full(2, np.inf))
        return Alignment(nothing, nothing, 0.0, 0)
    tile = np.unique(uv[use] // TILE_PX, axis=0, return_inverse=True)[1]
    matches = _Matches(value[use], gradient[use], further[use], grey_right, end[use], tile)
    slope = flow_slope[use]
    uniform = np.broadcast_to(np.eye(2), slope.shape)
    both = np.concatenate([slope, uniform], axis=-1)
    return Alignment(
        shift=_fit(matches, uniform),
        offset=_fit(matches, both),
        correlation=_correlation(matches.gradient, grey_right.gradient(matches.end)),
        num=tile.size,
    )


def _correlation(a: Array, b: Array) -> float:
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum() + 1e-9))


def pool(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of independent estimates, weighted by certainty; its error is their scatter's."""
    values = np.array([e.uv for e in estimates])
    weight = np.array([e.std_error for e in estimates]) ** -2.0
    weight /= weight.sum(axis=0)
    mean = (weight * values).sum(axis=0)
    return Estimate(mean, np.sqrt((weight**2 * (values - mean) ** 2).sum(axis=0)))


def _fit(m: _Matches, basis: Array) -> Estimate:
    """The first two of the coefficients by which ``basis`` (N, 2, K) displaces the end points."""
    coeffs, (gain, paler) = np.zeros(basis.shape[-1]), (1.0, 0.0)
    light = np.column_stack([m.value, m.value * m.further, m.further, np.ones_like(m.value)])
    explained = m.value
    for _ in range(NUM_ITERATIONS_MAX):
        moved = m.end + basis @ coeffs
        observed = m.right.value(moved)
        own = (gain + paler * m.further)[:, None] * m.gradient
        slope = (m.right.gradient(moved) + own) / 2
        residual = observed - explained
        residual -= np.median(residual)
        sigma = 1.4826 * np.median(np.abs(residual)) + 1e-6
        inlier = np.clip(1 - (residual / (TUKEY * sigma)) ** 2, 0, 1)  # 1 at no residual
        columns = -np.einsum("nc,nck->nk", slope, basis)
        J = np.column_stack([columns, light])
        weighted = J.T * inlier**2
        solution = np.linalg.pinv(weighted @ J) @ (weighted @ observed)
        step, shades = np.split(solution, [len(coeffs)])
        coeffs, (gain, paler), explained = coeffs + step, shades[:2], light @ shades
        if np.abs(step).max() < CONVERGED_PX:
            break
    # Tukey's ψ(r) = r inlier² and its derivative.
    covariance = _sandwich(J, residual * inlier**2, inlier * (5 * inlier - 4), m.tile)
    variance = covariance.diagonal()[:2]
    # A direction that nothing determines comes out of the pseudo-inverse as certain.
    return Estimate(coeffs[:2], np.sqrt(np.where(variance > UNDETERMINED, variance, np.inf)))


def _sandwich(J: Array, psi: Array, dpsi: Array, tile: NDArray[np.intp]) -> Array:
    """Covariance of an M-estimate whose residuals are correlated within tiles."""
    scores = np.zeros((tile.max() + 1, J.shape[1]))
    np.add.at(scores, tile, J * psi[:, None])
    bread = np.linalg.pinv((J.T * dpsi) @ J)
    return np.asarray(bread @ (scores.T @ scores) @ bread)


def _grey(image: NDArray[np.uint8]) -> _Grey:
    grey = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTHING_PX)
    dv, du = np.gradient(smooth)
    return _Grey(ndimage.spline_filter(smooth, order=3), du, dv)


def _sample(image: Array, uv: Array, *, order: int) -> Array:
    return ndimage.map_coordinates(
        image, uv.T[::-1], output=np.float64, order=order, mode="nearest", prefilter=False
    )
