"""Statistics of images: is a picture like a photograph, and a rendering like its converged self?

The first part measures what photographs of real places have in common (Field, *Relations between
the statistics of natural images and the response properties of cortical cells*, 1987: power falls
with about the square of the frequency), and what feature detectors find in them.

The second part splits a picture into octaves of spatial frequency and compares a cheap rendering x
with two independent, nearly noise-free ones a and b of the same view. With ⟨·⟩ the mean over
pixels and r = (a + b) / 2, in each octave

    P = ⟨a b⟩             the power of the picture itself: noise in a and b is independent
    power = ⟨x²⟩ / P      1 for a rendering that keeps the texture and adds nothing
    kept  = ⟨x r⟩ / P     the amplitude of the true texture that x still has
    added = power − kept²  aliasing, noise and ghosts: power that is not in the picture
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from simgen.geometry import Array

Floats = NDArray[np.floating]

FLAT = 1.0
"""grey levels per pixel: gradients below it are lost in the noise of a camera"""
SLOPE_BAND = (0.02, 0.25)
"""cycles per pixel: below are a few coefficients, above is the filter that scaled the image"""
_NUM_SLOPE_BINS = 20


@dataclass(frozen=True)
class PhotoStatistics:
    """What a picture of 8 bits looks like in numbers."""

    slope: float
    """of log power over log frequency"""
    keypoints: float
    """SIFT key points per megapixel"""
    flat: float
    """share of pixels with a gradient below 1 grey level per pixel"""
    contrast: float
    """standard deviation of the grey value, 0 to 1"""
    saturation: float
    """mean saturation (HSV), 0 to 1"""
    kurtosis: float
    """of the horizontal gradient; 3 for a normal distribution"""


def photo_statistics(image: NDArray[np.uint8]) -> PhotoStatistics:
    """Measures an image (H, W, 3) in RGB as it is; its size matters to most of the numbers."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    du, dv = gradient(grey)
    num_keypoints = len(cv2.SIFT.create().detect(grey, None))
    return PhotoStatistics(
        slope=spectral_slope(grey.astype(np.float64)),
        keypoints=1e6 * num_keypoints / grey.size,
        flat=float(np.mean(np.hypot(du, dv) < FLAT)),
        contrast=float(grey.std()) / 255,
        saturation=float(cv2.cvtColor(image, cv2.COLOR_RGB2HSV)[..., 1].mean()) / 255,
        kurtosis=kurtosis(du),
    )


def gradient(grey: NDArray[np.number]) -> tuple[Array, Array]:
    """Derivatives (H, W) along u and v per pixel: Sobel's filters / 8."""
    du, dv = (cv2.Sobel(grey, cv2.CV_64F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return du, dv


def kurtosis(values: Array) -> float:
    """Fourth standardised moment; infinite if nothing varies."""
    centred = values - values.mean()
    variance = np.mean(centred**2)
    return float(np.mean(centred**4) / variance**2) if variance > 0 else float("inf")


def spectral_slope(grey: Array) -> float:
    """Slope of log power over log frequency of (H, W), averaged over all directions.

    The power is that under a Hann window, in rings of equal width in log frequency.
    """
    h, w = grey.shape
    window = np.outer(np.hanning(h), np.hanning(w))
    power = np.abs(np.fft.rfft2((grey - grey.mean()) * window)) ** 2
    edges = np.geomspace(*SLOPE_BAND, _NUM_SLOPE_BINS + 1)
    ring = np.digitize(_frequency((h, w)), edges)
    centres = np.sqrt(edges[1:] * edges[:-1])
    means = [power[ring == k].mean() for k in range(1, len(edges))]
    return float(np.polyfit(np.log(centres), np.log(np.maximum(means, 1e-300)), 1)[0])


def _frequency(hw: tuple[int, int]) -> Array:
    """Cycles per pixel (H, W // 2 + 1) of the coefficients of ``rfft2``."""
    return np.hypot(np.fft.fftfreq(hw[0])[:, None], np.fft.rfftfreq(hw[1]))


# --- octaves -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Octave:
    """How the power of a rendering compares with the picture's own; see the module's notation."""

    power: float
    kept: float
    added: float


def octave_bands(image: Floats, num: int) -> Array:
    """Splits (H, W) into ``num`` octaves (num, H, W), from the finest on.

    Octave k holds the frequencies around 2^−(k + 1.5) cycles per pixel, all above them for k = 0.
    Raised cosines over the logarithm, whose squares add up to one, so that the octaves' powers add
    up to the picture's (Portilla & Simoncelli, *A parametric texture model*, 2000). The image is
    mirrored at its borders.
    """
    h, w = image.shape
    mirrored = np.block([[image, image[:, ::-1]], [image[::-1], image[::-1, ::-1]]])
    spectrum = np.fft.rfft2(mirrored)
    octave = -np.log2(np.maximum(_frequency(mirrored.shape), 1e-9)) - 1.5
    gains = [np.cos(np.pi / 2 * np.clip(octave - k, -1 if k else 0, 1)) for k in range(num)]
    return np.stack([np.fft.irfft2(spectrum * g, mirrored.shape)[:h, :w] for g in gains])


def compare_octaves(x: Array, a: Array, b: Array, where: NDArray[np.bool_]) -> list[Octave]:
    """Compares the octaves (num, H, W) of a rendering x with those of the picture, a and b.

    Only the pixels ``where`` (H, W) count.
    """
    return [_compare(*(band[where] for band in bands)) for bands in zip(x, a, b, strict=True)]


def _compare(x: Array, a: Array, b: Array) -> Octave:
    own = np.mean(a * b)
    power, kept = np.mean(x * x) / own, np.mean(x * (a + b)) / (2 * own)
    return Octave(float(power), float(kept), float(power - kept**2))


# --- two views -----------------------------------------------------------------------------------


def warped(right: Floats, flow: NDArray[np.float32]) -> Array:
    """The right image (H, W) looked up where the flow (H, W, 2) takes the left pixels."""
    h, w = flow.shape[:2]
    i, j = np.mgrid[:h, :w] + np.moveaxis(flow[..., ::-1].astype(np.float64), -1, 0)
    return np.asarray(ndimage.map_coordinates(right, (i, j), np.float64, order=3, mode="nearest"))


def correct_matches(
    uv_left: Array, uv_right: Array, flow: Floats, visible: NDArray[np.bool_], tolerance_px: float
) -> NDArray[np.bool_]:
    """Whether matches (N, 2) → (N, 2) [px] end within the tolerance of the exact flow (H, W, 2).

    The flow is sampled bilinearly at the left point. Nothing is correct where one of the four
    pixels around it is not ``visible`` (H, W) in the right image: an occluded point has no match.
    """
    h, w = visible.shape
    low = np.clip(np.floor(uv_left).astype(int), 0, (w - 2, h - 2))
    (u, v), (s, t) = low.T, (uv_left - low).T
    corners = [(v, u, (1 - s) * (1 - t)), (v, u + 1, s * (1 - t)), (v + 1, u, (1 - s) * t),
               (v + 1, u + 1, s * t)]  # fmt: skip
    expected = uv_left + sum(flow[i, j] * weight[:, None] for i, j, weight in corners)
    seen = np.all([visible[i, j] for i, j, _ in corners], axis=0)
    return seen & (np.linalg.norm(uv_right - expected, axis=1) <= tolerance_px)
