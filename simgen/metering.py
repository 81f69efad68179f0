"""What a rig's cameras agree on before they take a picture: exposure, gain, white balance.

The scene's radiance is in kcd/m² (see :mod:`simgen.daylight`), so photons can be counted: a lens
of f-number N and transmittance τ lights the sensor with E = π τ L / 4N² [lx], and a pixel of area
A and quantum efficiency η makes 4.09e15 · η · A · E electrons a second (555 nm, 683 lm/W). A
camera opens no longer than ``MAX_TIME_S``; what is then still missing is gain, and noise.

All that is drawn and measured ends up in :class:`Exposure`, one per camera, stored with the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simgen.color import luminance

Image = NDArray[Any]
"""float32"""

SENSORS = ("ideal", "camera")
MIDDLE_GREY = 0.17
MAX_BRIGHT = 2.5
"""the brightest 1 % of the lower half may not be exposed above this"""
SKY_SHARE = 0.4
"""weight of the upper half of the images in the metering"""
DARKEST = 1e-6
"""Radiance [kcd/m²] that counts as black: a moonless night."""
CONTRAST = 1.5
"""of the ideal sensor's tone curve"""
SATURATION = 1.35
"""of the ideal sensor's colours: cameras show more of it than there is"""

NATIVE_WIDTH = 2560
"""Of the sensor [px]. Narrower images are those of the same sensor with its pixels binned: blur
shrinks with the width, electrons grow with the pixel's area."""
PIXEL_AREA_M2 = 3.0e-6**2
F_NUMBER = 1.8
TRANSMITTANCE = 0.85
QUANTUM_EFFICIENCY = 0.55
PHOTONS_PER_LM_S = 4.09e15
ELECTRONS_PER_KCD_S = (
    1000 * np.pi / 4 * TRANSMITTANCE / F_NUMBER**2
    * PIXEL_AREA_M2 * PHOTONS_PER_LM_S * QUANTUM_EFFICIENCY
)  # fmt: skip
"""electrons in a native pixel, per second and kcd/m²"""
DEMOSAIC_PX = 0.34
"""Of the blur that takes from noise what bilinear interpolation of a Bayer mosaic takes: 0.56 of
the variance is left."""
MAX_TIME_S = 1 / 40
MAX_GAIN = 16.0
FULL_WELL = 10_000.0
"""electrons at exposed value 1 that a camera aims at, in a native pixel at gain 1"""
MAX_EXPOSURE = ELECTRONS_PER_KCD_S * MAX_TIME_S * MAX_GAIN / FULL_WELL
"""Exposed value per kcd/m²: what is below 1 cd/m² on the whole stays darker than middle grey."""


@dataclass(frozen=True)
class Exposure:
    """What turned one camera's radiance into its image. The defaults are the ideal sensor's."""

    exposure: float
    """factor on radiance, the same for the whole rig"""
    gain: float = 1.0
    """this camera's share of it, near 1"""
    vignetting: float = 0.0
    """loss of light in the corner, 0…1"""
    blur_px: tuple[float, float] = (0.0, 0.0)
    """standard deviation of the lens's point spread in the centre and in the corner"""
    glare: float = 0.0
    """share of the light that the lens scatters over the image, 0…1"""
    time_s: float = 0.0
    """how long the shutter was open; 0 if nobody asked"""
    amplification: float = 1.0
    """of the signal, where the longest time was not enough"""
    electrons: float = 0.0
    """at exposed value 1, in one pixel; 0 = no noise"""
    read_noise: float = 0.0
    """standard deviation [electrons]"""
    demosaic_px: float = 0.0
    """standard deviation of the blur by which colours are interpolated between pixels"""
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """factors on R, G, B"""
    saturation: float = SATURATION
    """distance of a colour from grey: 1 = as it was"""
    contrast: float = CONTRAST
    """slope of the tone curve in the dark, see :func:`simgen.tone.tone_curve`"""
    sharpening: float = 0.0
    """share of the detail that is added to the encoded luma"""
    sharpening_px: float = 0.0
    """standard deviation of the blur that detail is measured against"""


def meter(radiances: Sequence[Image]) -> float:
    """The exposure of a rig: the geometric mean of the lower halves to middle grey.

    A brighter upper half takes up to one stop off, so that a sky keeps its blue and its clouds;
    more would turn the road black. What is bright in the lower half is kept, and the night is left
    dark.
    """
    above, below = (
        np.maximum(luminance(_rows(*part, radiances)).astype(np.float64), DARKEST)
        for part in ((0.0, 0.5), (0.5, 1.0))
    )
    typical = np.log(below).mean()
    typical += np.clip(SKY_SHARE * (np.log(above).mean() - typical), 0, np.log(2))
    brightest = np.quantile(below, 0.99)
    return float(min(MIDDLE_GREY / np.exp(typical), MAX_BRIGHT / brightest, MAX_EXPOSURE))


def warmth(radiances: Sequence[Image]) -> float:
    """Estimated log ratio of red to blue in the light that falls on the scene.

    The mean in the 6-norm, "shades of grey": more of it comes from bright surfaces, which are less
    often coloured. The upper third does not count, as a blue sky says nothing about the light of
    the sun; what is burnt out counts by its colour alone.

    Source: Finlayson and Trezzi, Shades of gray and colour constancy (2004).
    """
    planes = np.array(_rows(1 / 3, 1, radiances).T, dtype=np.float64, order="C")
    planes *= meter(radiances)
    planes = np.maximum(planes / np.maximum(planes.max(axis=0), 1.0), 1e-4)
    red, _, blue = (planes**6).mean(axis=1) ** (1 / 6)
    return float(np.log(red / blue))


def _rows(start: float, stop: float, radiances: Sequence[Image]) -> Image:
    """Every 16th pixel (N, 3) between those shares of the images' height."""
    return np.concatenate(
        [r[int(start * len(r)) : int(stop * len(r)) : 4, ::4].reshape(-1, 3) for r in radiances]
    )


def expose(sensor: str, radiances: Sequence[Image], *, rng: np.random.Generator) -> list[Exposure]:
    """One exposure per camera of a rig, from its radiances (H, W, 3).

    The rig is metered and balanced as one; its cameras are of one make, yet each is an individual.
    """
    exposure = meter(radiances)
    if sensor == "ideal":
        return [Exposure(exposure)] * len(radiances)
    temperature = rng.uniform(0.6, 0.9) * warmth(radiances) + rng.normal(0.0, 0.03)
    make = _draw_make(exposure, radiances[0].shape[1] / NATIVE_WIDTH, rng=rng)
    return [_draw_individual(make, temperature, rng=rng) for _ in radiances]


def _draw_make(exposure: float, scale: float, *, rng: np.random.Generator) -> Exposure:
    """What the cameras of a rig share; ``scale`` is the image's width over the sensor's."""
    full_well = FULL_WELL * rng.uniform(0.8, 1.4)
    needed_s = full_well * exposure / ELECTRONS_PER_KCD_S
    time_s = min(needed_s, MAX_TIME_S)
    return Exposure(
        exposure,
        vignetting=float(rng.uniform(0.08, 0.25)),
        blur_px=(float(rng.uniform(0.3, 0.5) * scale), float(rng.uniform(0.5, 0.7) * scale)),
        glare=float(rng.uniform(0.01, 0.04)),
        time_s=float(time_s),
        amplification=float(needed_s / time_s),
        electrons=float(full_well * time_s / needed_s / scale**2),
        read_noise=float(rng.uniform(1.5, 4.0) / scale),
        demosaic_px=DEMOSAIC_PX * scale,
        saturation=float(SATURATION * rng.uniform(0.85, 1.1)),
        contrast=float(CONTRAST * rng.uniform(0.93, 1.07)),
        sharpening=float(rng.uniform(0.2, 0.6)),
        sharpening_px=float(rng.uniform(0.8, 1.2) * scale),
    )


def _draw_individual(make: Exposure, temperature: float, *, rng: np.random.Generator) -> Exposure:
    """One camera of a make: slightly brighter, sharper, warmer than the next."""
    centre_px, corner_px = make.blur_px
    focus = float(rng.uniform(0.9, 1.1))
    return replace(
        make,
        gain=float(rng.normal(1.0, 0.01)),
        blur_px=(centre_px * focus, corner_px * focus),
        white_balance=_balance(temperature + rng.normal(0.0, 0.01)),
    )


def _balance(warmth: float) -> tuple[float, float, float]:
    """Factors on R, G, B that take a warm light to grey; the luminance of grey stays.

    Along the line from amber to blue only, as daylight and lamps differ; greens are left alone.
    """
    factors = np.exp(warmth * np.array([-0.5, 0.0, 0.5]))
    red, green, blue = factors / luminance(factors)
    return float(red), float(green), float(blue)
