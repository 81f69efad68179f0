"""The picture that a camera makes of what its sensor counted: colour, tone curve, sharpening.

Images are planes (3, H, W), so that OpenCV and NumPy work on contiguous memory. "Exposed" values
are linear, middle grey at ``MIDDLE_GREY``; "shown" ones are what a display should emit, 0…1;
"encoded" ones follow sRGB, 0…255.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.color import LUMINANCE_WEIGHTS, srgb_from_linear
from simgen.lens import blurred
from simgen.mesh import IMAGE_ROWS, blocks
from simgen.metering import MIDDLE_GREY

Image = NDArray[Any]
"""float32"""

WHITE = 8.0
"""exposed value that is shown as 1, as is everything brighter"""
SHOWN_GREY = 0.15
"""what middle grey is shown as"""
LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""of encoded R, G, B (ITU-R BT.601)"""

_STEPS = 65535


def tone_curve(exposed: ArrayLike, contrast: float) -> NDArray[np.floating]:
    """Shown value of an exposed one: a toe, a straight part, and a shoulder that rolls off.

    It is the S-curve x^c / (x^c + k) by which photoreceptors answer to light; k puts middle grey
    in its place. In log–log its slope falls from the contrast c, in the dark, to 0.

    Source: Naka and Rushton (1966); Reinhard and Devlin, Dynamic range reduction inspired by
    photoreceptor physiology (2005), eq. 1.
    """

    def response(x: ArrayLike) -> NDArray[np.floating]:
        power = (np.asarray(x) / MIDDLE_GREY) ** contrast
        return power / (power + (1 / SHOWN_GREY - 1))

    return response(exposed) / response(WHITE)


def balanced(exposed: Image, white_balance: tuple[float, float, float], saturation: float) -> Image:
    """Exposed planes with grey made grey, and colours moved away from it."""
    weights = np.tile(LUMINANCE_WEIGHTS, (3, 1))
    matrix = saturation * np.eye(3) + (1 - saturation) * weights
    flat = (matrix * white_balance).astype(np.float32) @ exposed.reshape(3, -1)
    return flat.reshape(exposed.shape)


def shown(exposed: Image, contrast: float) -> Image:
    """The tone curve on planes: each pixel's largest and smallest follow it, the hue stays.

    Source: Adobe's DNG SDK, RefBaselineRGBTone.
    """
    curve = _curve(contrast)
    x = np.clip(exposed, 0, np.float32(WHITE))
    high, low = (of(of(x[0], x[1]), x[2]) for of in (cv2.max, cv2.min))
    top, bottom = (_look_up(curve, np.sqrt(y / np.float32(WHITE))) for y in (high, low))
    x -= low
    x *= (top - bottom) / np.maximum(high - low, np.float32(1e-9))
    x += bottom
    return x


@lru_cache(maxsize=2)
def _curve(contrast: float) -> Image:
    """The tone curve over the square root of what is exposed, WHITE = 1; read-only."""
    curve = tone_curve(np.linspace(0, 1, _STEPS + 1) ** 2 * WHITE, contrast).astype(np.float32)
    curve.flags.writeable = False
    return curve


def encoded(x: Image) -> Image:
    """sRGB values, 0…255 and not rounded, of shown planes."""
    return _look_up(_SRGB, x)


def _look_up(table: Image, x: Image) -> Image:
    """A table over [0, 1] at its entry nearest to x."""
    index = x * np.float32(_STEPS) + np.float32(0.5)
    return np.take(table, np.minimum(index, _STEPS).astype(np.uint16))


_SRGB = (255 * srgb_from_linear(np.arange(_STEPS + 1) / _STEPS)).astype(np.float32)


def sharpen(encoded: Image, amount: float, sigma_px: float) -> None:
    """Adds detail of the luma to all planes, in place: an unsharp mask."""
    luma = np.tensordot(np.array(LUMA_WEIGHTS, np.float32), encoded, 1)
    luma -= blurred(luma, sigma_px)
    luma *= np.float32(amount)
    for plane in encoded:
        plane += luma


def rounded(encoded: Image) -> NDArray[np.uint8]:
    """Planes as an 8-bit image (H, W, 3)."""
    levels = np.empty(encoded.shape, np.uint8)
    for plane, level in zip(encoded, levels, strict=True):
        for rows in blocks(len(plane), IMAGE_ROWS):
            level[rows] = np.clip(plane[rows], 0, 255) + np.float32(0.5)
    image: NDArray[np.uint8] = cv2.merge(list(levels))
    return image
