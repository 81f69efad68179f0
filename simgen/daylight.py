"""Sun, sky and clouds as one environment map; and the haze in front of everything.

The map is latitude–longitude, linear radiance, rows from the zenith to the nadir. Column x of W
looks along azimuth ``az`` (counter-clockwise from +x, seen from above) with
``x + ½ = W · (½ − az/2π)`` modulo W: :func:`directions` is the one place that says so, and a test
holds it against what the renderer sees.

The clear sky and the sun's light follow Preetham, Shirley and Smits, *A Practical Analytic Model
for Daylight* (1999), in kcd/m² and klx. Mitsuba's own ``sunsky`` costs 2 to 5 s a scene here (it
sets itself up in hundreds of small kernels, and compiles new ones), this 0.3 s; a test holds one
against the other. With the sun below the horizon both are undefined: night has its own gradient.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simgen.color import luminance
from simgen.geometry import Array
from simgen.noise import fractal
from simgen.recipe import SkySpec

SKY_HW = (1024, 2048)
SUN_RADIUS_DEG = 0.4
"""Of the painted disc, soft at the rim: the map's texels are 0.18° wide. The true one is 0.27°."""
MIN_SUN_ELEVATION_DEG = 0.0

MAX_AIR_MASS = 8.0
"""The model's haze would put a sun below 7° out; a real low sun still throws warm light."""

Image = NDArray[Any]
"""float32"""


@lru_cache(maxsize=2)
def directions(hw: tuple[int, int] = SKY_HW) -> Image:
    """Unit world directions (H, W, 3) of the map's texels; read-only."""
    h, w = hw
    polar = (np.arange(h) + 0.5) / h * np.pi
    azimuth = (0.5 - (np.arange(w) + 0.5) / w) * 2 * np.pi
    sin = np.sin(polar)[:, None]
    along = [sin * np.cos(azimuth), sin * np.sin(azimuth), np.cos(polar)[:, None] + 0 * azimuth]
    unit = np.stack(along, axis=-1).astype(np.float32)
    unit.flags.writeable = False
    return unit


def sun_direction(sky: SkySpec) -> Array:
    """Unit vector (3,) towards the sun."""
    el, az = np.deg2rad([sky.sun_elevation_deg, sky.sun_azimuth_deg])
    return np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])


def is_night(sky: SkySpec) -> bool:
    """Whether lamps burn and the sun gives nothing."""
    return sky.sun_elevation_deg < MIN_SUN_ELEVATION_DEG


def environment(sky: SkySpec, *, rng: np.random.Generator) -> Image:
    """The sky with clouds and sun: (H, W, 3) linear radiance."""
    if is_night(sky):
        return _night(rng=rng)
    clear, sun_irradiance = _clear_sky(sky)
    ambient = clear[: SKY_HW[0] // 2].mean(axis=(0, 1))
    cover, thickness = _clouds(sky, rng=rng)
    towards_sun = np.clip(directions() @ sun_direction(sky).astype(np.float32), 0, 1)
    lit = ambient + np.float32(0.55 / np.pi) * sun_irradiance * (
        0.35 + 0.65 * towards_sun[..., None] ** 6
    )
    grey = luminance(ambient + 0.25 * sun_irradiance / np.pi)
    shade = thickness[..., None]
    dark = np.float32(grey) * np.array([0.62, 0.66, 0.72], dtype=np.float32)
    cloud = lit * (1 - shade) + shade * dark
    dimmed = 1.0 - 0.85 * max(0.0, sky.cloud_cover - 0.6) / 0.4
    image = clear * (1 - cover[..., None]) + cover[..., None] * cloud
    _paint_sun(image, sky, sun_irradiance * dimmed * (1 - _cover_at_sun(cover, sky)))
    return _with_ground(image).astype(np.float32)


def seen_through(
    environment_map: Image, K: Array, R_world_cam: Array, wh: tuple[int, int]
) -> Image:
    """The map at the pixel centres of a camera (H, W, 3), as if nothing stood in the way."""
    u, v = np.meshgrid(np.arange(wh[0], dtype=np.float32), np.arange(wh[1], dtype=np.float32))
    M = (R_world_cam @ np.linalg.inv(K)).astype(np.float32)
    x, y, z = (m[0] * u + m[1] * v + m[2] for m in M)
    h, w = environment_map.shape[:2]
    column = (0.5 - np.arctan2(y, x) / np.float32(2 * np.pi)) * w - 0.5
    row = np.arctan2(np.hypot(x, y), z) / np.float32(np.pi) * h - 0.5
    seam = np.concatenate([environment_map, environment_map[:, :1]], axis=1)
    seen: Image = cv2.remap(
        seam, column % w, np.clip(row, 0, h - 1), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return seen


def haze_radiance(environment_map: Image) -> Image:
    """Colour (3,) of distant haze: the mean of the sky just above the horizon, without the sun."""
    horizon = environment_map.shape[0] // 2
    band = environment_map[horizon - horizon // 12 : horizon].reshape(-1, 3)
    return np.median(band, axis=0).astype(np.float32)


def transmittance(distance_m: Image, visibility_m: float) -> Image:
    """Share of light that gets through the haze (Koschmieder: 2 % contrast at the visibility)."""
    return np.exp(-distance_m * (np.log(50.0) / visibility_m)).astype(np.float32)


# --- clear sky -----------------------------------------------------------------------------------

# Perez coefficients A…E, each (slope, offset) in the turbidity, for Y, x, y (Preetham, table 2).
_PEREZ = {
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771),
          (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989),
          (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537),
          (-0.0109, 0.0529)),
}  # fmt: skip
# Zenith chromaticity: powers of the turbidity (2, 1, 0) × powers of the sun's angle (3, 2, 1, 0).
_ZENITH = {
    "x": np.array([[0.00166, -0.00375, 0.00209, 0.0], [-0.02903, 0.06377, -0.03202, 0.00394],
                   [0.11693, -0.21196, 0.06052, 0.25886]]),
    "y": np.array([[0.00275, -0.00610, 0.00317, 0.0], [-0.04214, 0.08970, -0.04153, 0.00516],
                   [0.15346, -0.26756, 0.06670, 0.26688]]),
}  # fmt: skip
_RGB_FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
_WAVELENGTH_UM = np.array([0.65, 0.55, 0.45])
_SUN_KLX = 128.0
"""illuminance of the sun outside the atmosphere"""


def _clear_sky(sky: SkySpec) -> tuple[Image, Image]:
    """The sunless clear sky (H, W, 3) [kcd/m²], and the sun's illuminance (3,) facing it [klx].

    The map's lower half is left black for _with_ground.
    """
    d = directions()[: SKY_HW[0] // 2]
    zenith_cos = np.maximum(d[..., 2], np.float32(0.01))
    sun_cos = d @ sun_direction(sky).astype(np.float32)
    t, sun_angle = sky.turbidity, np.deg2rad(90.0 - max(sky.sun_elevation_deg, 0.0))
    chi = (4 / 9 - t / 120) * (np.pi - 2 * sun_angle)
    zenith = {
        name: float(np.array([t * t, t, 1]) @ m @ sun_angle ** np.arange(3, -1, -1))
        for name, m in _ZENITH.items()
    }
    zenith["Y"] = max((4.0453 * t - 4.9710) * np.tan(chi) - 0.2155 * t + 2.4192, 0.05)
    Y, x, y = (zenith[n] * _perez(n, t, zenith_cos, sun_cos, sun_angle) for n in "Yxy")
    xyz = np.stack([x / y * Y, Y, (1 - x - y) / y * Y], axis=-1)
    rgb = np.zeros((*SKY_HW, 3), dtype=np.float32)
    rgb[: len(d)] = np.maximum(xyz.astype(np.float32) @ _RGB_FROM_XYZ.T.astype(np.float32), 0)
    return rgb, (_SUN_KLX * sun_transmittance(sky)).astype(np.float32)


def _perez(
    name: str, turbidity: float, zenith_cos: Image, sun_cos: Image, sun_angle: float
) -> Image:
    """Sky over zenith value, F(θ, γ) / F(0, θ_sun)."""
    a, b, c, d, e = (slope * turbidity + offset for slope, offset in _PEREZ[name])
    gamma = np.arccos(np.clip(sun_cos, -1, 1))
    at_view = (1 + a * np.exp(b / zenith_cos)) * (1 + c * np.exp(d * gamma) + e * sun_cos**2)
    cos_sun = np.cos(sun_angle)
    at_zenith = (1 + a * np.exp(b)) * (1 + c * np.exp(d * sun_angle) + e * cos_sun**2)
    return at_view / at_zenith


def sun_transmittance(sky: SkySpec) -> Array:
    """Share (3,) of the sun's light that gets through air and aerosol, for R, G, B."""
    elevation = max(sky.sun_elevation_deg, 0.0)
    air_mass = 1 / (np.sin(np.deg2rad(elevation)) + 0.15 * (elevation + 3.885) ** -1.253)
    air_mass = min(air_mass, MAX_AIR_MASS)
    beta = 0.04608 * sky.turbidity - 0.04586
    rayleigh = 0.008735 * _WAVELENGTH_UM**-4.08
    aerosol = beta * _WAVELENGTH_UM**-1.3
    return np.exp(-(rayleigh + aerosol) * air_mass)


# --- clouds, sun, ground -------------------------------------------------------------------------


def _clouds(sky: SkySpec, *, rng: np.random.Generator) -> tuple[Image, Image]:
    """Coverage and thickness (H, W) in [0, 1] of a cloud layer seen from below.

    The layer is flat near the zenith and bends down towards the horizon, where clouds crowd.
    """
    seed = int(rng.integers(1 << 31))
    d = directions()
    lift = np.maximum(d[..., 2], 0.0) + 0.06
    x, y = d[..., 0] / lift, d[..., 1] / lift
    size = 2048
    sheet = fractal((size, size), wavelength=size / 26, octaves=7, gain=0.55, seed=seed)
    uv = [((c + 17.0) * (size / 34.0)).astype(np.float32) for c in (x, y)]
    density = cv2.remap(sheet, uv[0], uv[1], cv2.INTER_LINEAR)
    level = np.quantile(sheet[::4, ::4], 1 - np.clip(sky.cloud_cover, 0.0, 1.0))
    spread = float(sheet.std())
    soft = 0.35 if sky.cloud_cover < 0.9 else 1.5
    cover = np.clip((density - level) / (soft * spread) + (sky.cloud_cover >= 0.9), 0, 1)
    thickness = np.clip((density - level) / (2.2 * spread), 0, 1)
    cover *= d[..., 2] > -0.02
    return cover.astype(np.float32), thickness.astype(np.float32)


def _cover_at_sun(cover: Image, sky: SkySpec) -> float:
    row, column = _texel(sun_direction(sky))
    return float(cover[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3].mean())


def _texel(direction: Array) -> tuple[int, int]:
    h, w = SKY_HW
    azimuth = np.arctan2(direction[1], direction[0])
    row = np.arccos(np.clip(direction[2], -1, 1)) / np.pi * h
    return int(row), int((0.5 - azimuth / (2 * np.pi)) * w) % w


def _paint_sun(image: Image, sky: SkySpec, irradiance: Image) -> None:
    """Adds a disc whose texels carry the irradiance."""
    d = directions()
    sun = sun_direction(sky)
    h, w = SKY_HW
    row, _ = _texel(sun)
    rows = slice(max(0, row - 8), row + 9)
    angle = np.rad2deg(np.linalg.norm(np.cross(d[rows], sun), axis=-1))
    weight = np.clip(1.5 - angle / SUN_RADIUS_DEG, 0, 1) * (d[rows] @ sun > 0)
    texel = np.sqrt(1 - d[rows, :, 2] ** 2) * (np.pi / h) * (2 * np.pi / w)
    image[rows] += (weight / (weight * texel).sum())[..., None] * irradiance


def _with_ground(image: Image) -> Image:
    """Below the horizon: what a far plain would send back, so that nothing is lit by black."""
    half = image.shape[0] // 2
    horizon = image[half - 4 : half].mean(axis=0)
    image[half:] = 0.35 * np.clip(horizon, 0, np.percentile(horizon, 90, axis=0))
    return image


def _night(*, rng: np.random.Generator) -> Image:
    """A dark gradient with the glow of a town at the horizon and some stars."""
    up = np.clip(directions()[..., 2:], -0.1, 1)
    glow = np.exp(-np.abs(up) * 7.0) * np.array([0.010, 0.0065, 0.0040], np.float32)
    zenith = np.array([0.0009, 0.0012, 0.0022], np.float32)
    stars = (rng.random(SKY_HW) > 0.9995)[..., None] * np.float32(0.02) * (up > 0.1)
    return (glow + zenith * (up > -0.05) + stars).astype(np.float32)
