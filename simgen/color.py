"""The sRGB transfer curve and luminance: the only place where the two encodings meet.

``linear`` values are proportional to light (albedo, radiance); ``srgb`` values are what an 8-bit
image stores, divided by 255. Both are arrays whose last axis, where it matters, is R, G, B with
the Rec. 709 primaries.

Source: IEC 61966-2-1 (the curve), ITU-R BT.709 (the weights).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)

_KNEE = 0.0031308  # linear value below which the curve is a straight line


def srgb_from_linear(linear: ArrayLike) -> NDArray[np.floating]:
    """Encodes light; values outside [0, 1] go along the curve and are not clipped."""
    x = _floating(linear)
    return np.where(x <= _KNEE, 12.92 * x, 1.055 * np.maximum(x, _KNEE) ** (1 / 2.4) - 0.055)


def linear_from_srgb(srgb: ArrayLike) -> NDArray[np.floating]:
    """Decodes to light: the inverse of ``srgb_from_linear``."""
    x = _floating(srgb)
    straight = x <= 12.92 * _KNEE
    return np.where(straight, x / 12.92, ((np.maximum(x, 0.0) + 0.055) / 1.055) ** 2.4)


def luminance(linear: ArrayLike) -> NDArray[np.floating]:
    """Relative luminance (…) of linear RGB (…, 3)."""
    x = _floating(linear)
    return x @ np.asarray(LUMINANCE_WEIGHTS, dtype=x.dtype)


def _floating(values: ArrayLike) -> NDArray[np.floating]:
    """Keeps float32 and float64; integers would be a 0..255 image that forgot its scale."""
    x = np.asarray(values)
    if not np.issubdtype(x.dtype, np.floating):
        raise TypeError(f"colour values must be floats in [0, 1], got {x.dtype}; divide by 255?")
    return x
