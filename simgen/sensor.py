"""Linear radiance → 8-bit image.

The cameras of a rig expose together: one exposure is metered over all their images. ``ideal`` is
exposure, tone curve and rounding, nothing else. ``camera`` adds what every real one has: a small
difference in gain, vignetting, shot noise and read noise. All parameters are recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simgen.color import luminance, srgb_from_linear

Image = NDArray[Any]
"""float32"""

SENSORS = ("ideal", "camera")
MIDDLE_GREY = 0.17
WHITE = 8.0
"""exposed value that the tone curve takes to 1"""
MAX_BRIGHT = 4.0
"""the brightest 1 % of the lower half may not be exposed above this"""

MAX_EXPOSURE = 180.0
"""per kcd/m²: what 1/30 s at f/2 and ISO 1600 take to middle grey is 0.9 cd/m² (ISO 2720 with
K = 12.5). Darker scenes look dark."""


@dataclass(frozen=True)
class Exposure:
    """What turned one camera's radiance into its image."""

    exposure: float
    """factor on radiance, the same for the whole rig"""
    gain: float
    """this camera's share of it, near 1"""
    full_well: float
    """electrons at exposed value 1; 0 = no noise"""
    read_noise: float
    """standard deviation [electrons]"""
    vignetting: float
    """loss of light in the corner, 0…1"""
    tone_curve: str = f"x(1 + x/{WHITE:g}²)/(1 + x), then sRGB"


def meter(radiances: Sequence[Image]) -> float:
    """The exposure of a rig: the geometric mean of the lower halves to middle grey.

    The sky does not count: it may burn out in places, as it does in a dash camera, but it must not
    turn the road black. What is bright in the lower half is kept.
    """
    light = np.concatenate([luminance(r[r.shape[0] // 2 :: 4, ::4]).ravel() for r in radiances])
    typical = np.exp(np.log(np.maximum(light.astype(np.float64), 1e-9)).mean())
    bright = np.quantile(light, 0.99)
    return float(min(MIDDLE_GREY / typical, MAX_BRIGHT / max(bright, 1e-9), MAX_EXPOSURE))


def draw_exposures(
    sensor: str, exposure: float, num_cameras: int, *, rng: np.random.Generator
) -> list[Exposure]:
    """One exposure per camera of a rig."""
    if sensor == "ideal":
        return [Exposure(exposure, 1.0, 0.0, 0.0, 0.0)] * num_cameras
    full_well, read_noise = float(rng.uniform(6000, 14000)), float(rng.uniform(2.0, 6.0))
    vignetting = float(rng.uniform(0.08, 0.25))
    gains = rng.normal(1.0, 0.01, num_cameras)
    return [Exposure(exposure, float(g), full_well, read_noise, vignetting) for g in gains]


def develop(radiance: Image, exposure: Exposure, *, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image (H, W, 3) of a radiance (H, W, 3)."""
    exposed = radiance * np.float32(exposure.exposure * exposure.gain)
    if exposure.vignetting > 0:
        exposed *= _vignette(exposed.shape[:2], exposure.vignetting)[..., None]
    if exposure.full_well > 0:
        _add_noise(exposed, exposure, rng)
    np.clip(exposed, 0.0, WHITE, out=exposed)
    shown = exposed * (1 + exposed / np.float32(WHITE**2)) / (1 + exposed)
    return np.take(_ENCODE, np.minimum(shown * np.float32(65535), 65535).astype(np.uint16))


_ENCODE = np.round(srgb_from_linear(np.arange(65536) / 65535) * 255).astype(np.uint8)


def _vignette(hw: tuple[int, int], loss: float) -> Image:
    h, w = hw
    y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in (h, w))
    radius2 = (y[:, None] ** 2 * h**2 + x[None] ** 2 * w**2) / (h**2 + w**2)
    return 1 - np.float32(loss) * radius2 * radius2


def _add_noise(exposed: Image, exposure: Exposure, rng: np.random.Generator) -> None:
    """Gaussian approximation of shot noise (variance = electrons), and read noise."""
    electrons = np.maximum(exposed, 0) * np.float32(exposure.full_well)
    sigma = np.sqrt(electrons + np.float32(exposure.read_noise**2))
    noise = rng.standard_normal(exposed.shape, dtype=np.float32)
    exposed += noise * sigma / np.float32(exposure.full_well)
