"""What a lens does to the light on its way: fall-off, blur, glare.

Everything here is symmetric about each point of the image: a dot's centre of mass stays where it
is, so that pixels remain where ground truth has them. There is no distortion.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Image = NDArray[Any]
"""float32"""

GLARE_WIDTHS_PX = (20, 640)
"""of the images, from coarse to fine, over which glare is spread"""


def fall_off(hw: tuple[int, int], loss: float) -> Image:
    """Share of light (H, W) that arrives: 1 in the centre, 1 - loss in the corners."""
    radius2 = _radius2(hw)
    return 1 - np.float32(loss) * radius2 * radius2


@lru_cache(maxsize=2)
def _radius2(hw: tuple[int, int]) -> Image:
    """Squared distance (H, W) from the centre, 1 in the corners; read-only."""
    h, w = hw
    y, x = (np.linspace(-n, n, n, dtype=np.float32) ** 2 / (h**2 + w**2) for n in (h, w))
    radius2 = y[:, None] + x
    radius2.flags.writeable = False
    return radius2


def blurred(image: Image, sigma_px: float) -> Image:
    """Convolution of (H, W) with a Gaussian that was integrated over pixels."""
    if sigma_px == 0:
        return image
    taps = _taps(sigma_px)
    smooth: Image = cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REPLICATE)
    return smooth


def _taps(sigma_px: float) -> Image:
    reach = max(1, int(np.ceil(3 * sigma_px - 0.5)))
    edges = (np.arange(-reach, reach + 2) - 0.5) / sigma_px
    taps = np.diff(ndtr(edges))
    return (taps / taps.sum()).astype(np.float32)


def defocused(image: Image, sigmas_px: tuple[float, float]) -> Image:
    """Blur of an (H, W) image that grows from the centre to the corners.

    Light is shared out between the two blurs where it comes from, not where it arrives: so each
    point keeps a symmetric spread.
    """
    centre_px, corner_px = sigmas_px
    outer = image * _radius2(image.shape)
    spread = blurred(outer, float(np.sqrt(corner_px**2 - centre_px**2)))
    spread += image
    spread -= outer
    return blurred(spread, centre_px)


def with_glare(image: Image, share: float) -> Image:
    """Scatters a share of the light of (H, W, 3) widely, the same over every octave of distance.

    That is a point spread that falls with the square of the distance, as in lenses and eyes. The
    octaves are the levels of an image pyramid, whose steps keep a dot's centre of mass.

    Source: Talvala et al., Veiling glare in high dynamic range imaging (2007); Spencer et al.,
    Physically-based glare effects for digital images (1995).
    """
    levels = [image]
    while levels[-1].shape[1] > GLARE_WIDTHS_PX[0]:
        levels.append(cv2.pyrDown(levels[-1]))
    num_octaves = sum(level.shape[1] <= GLARE_WIDTHS_PX[1] for level in levels)
    scattered = levels[-1]
    for finer in levels[-2::-1]:
        scattered = cv2.pyrUp(scattered, dstsize=finer.shape[1::-1])
        if finer.shape[1] <= GLARE_WIDTHS_PX[1]:
            scattered += finer
    lit: Image = cv2.addWeighted(image, 1 - share, scattered, share / num_octaves, 0)
    return lit
