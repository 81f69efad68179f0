"""Linear radiance → 8-bit image.

The cameras of a rig expose together: one exposure is metered over all their images. ``ideal`` is
exposure, tone curve and rounding, nothing else. ``camera`` adds what every real one has, in the
order in which light meets it: the lens's fall-off, blur and glare; noise of photons and read-out,
the more the darker the scene, as the shutter cannot stay open; interpolation of colours, as the
small blur alone that gives noise its grain; white balance, a colour matrix, sharpening. All
parameters are recorded, see :class:`simgen.metering.Exposure`. Nothing shifts the image by any
part of a pixel.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from simgen import lens, tone
from simgen.mesh import IMAGE_ROWS, blocks
from simgen.metering import Exposure

Image = NDArray[Any]
"""float32"""

_NORMAL = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)).astype(np.float32)
"""values of equal probability: drawing from them takes a quarter of the time of drawing floats"""


def develop(radiance: Image, exposure: Exposure, *, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image (H, W, 3) of a radiance (H, W, 3)."""
    exposed = _exposed(radiance, exposure)
    if exposure.electrons > 0:
        _add_noise(exposed, exposure, rng=rng)
    if exposure.demosaic_px > 0:
        for plane in exposed:
            plane[:] = lens.blurred(plane, exposure.demosaic_px)
    for rows in blocks(exposed.shape[1], IMAGE_ROWS):
        strip = tone.balanced(exposed[:, rows], exposure.white_balance, exposure.saturation)
        exposed[:, rows] = tone.encoded(tone.shown(strip, exposure.contrast))
    encoded = exposed
    if exposure.sharpening > 0:
        tone.sharpen(encoded, exposure.sharpening, exposure.sharpening_px)
    return tone.rounded(encoded)


def _exposed(radiance: Image, exposure: Exposure) -> Image:
    """The light (3, H, W) that falls on the pixels, middle grey at MIDDLE_GREY."""
    lit = lens.with_glare(radiance, exposure.glare) if exposure.glare > 0 else radiance
    light = np.stack(cv2.split(lit))
    light *= np.float32(exposure.exposure * exposure.gain)
    light *= lens.fall_off(radiance.shape[:2], exposure.vignetting)
    if exposure.blur_px[1] > 0:
        for plane in light:
            plane[:] = lens.defocused(plane, exposure.blur_px)
    return light


def _add_noise(exposed: Image, exposure: Exposure, *, rng: np.random.Generator) -> None:
    """Gaussian approximation of shot noise (variance = electrons), and read noise, in place."""
    read_variance = np.float32((exposure.read_noise / exposure.electrons) ** 2)
    for plane in exposed:
        for rows in blocks(len(plane), IMAGE_ROWS):
            variance = np.maximum(plane[rows], 0) / np.float32(exposure.electrons)
            variance += read_variance
            noise = np.take(_NORMAL, rng.integers(1 << 16, size=variance.shape, dtype=np.uint16))
            noise *= np.sqrt(variance, out=variance)
            plane[rows] += noise
