"""The cloudless sky from the deep night to noon, and what air and fog do to light.

By day, luminance and colour follow Preetham, Shirley and Smits, *A Practical Analytic Model for
Daylight* (1999), in kcd/m² and klx. Its authors fitted it to a sun above the horizon; near the
horizon it hands over to a twilight whose illuminance on the ground is the measured one of
Janiczek and DeYoung, *Computer Programs for Sun and Moon Illuminance* (US Naval Observatory
Circular 171, 1987; also in Seidelmann, *Explanatory Supplement to the Astronomical Almanac*,
1992): 759 lx with the sun on the horizon, 3.4 lx at −6°, 0.0006 lx at −18°. How that light is
spread over the sky follows the description of Rozenberg, *Twilight* (1966): a warm segment at the
horizon over the sun that flattens and reddens as it sinks, a deep blue zenith, and opposite the
shadow of the earth below a rosy belt. Below all of it lies the glow of towns.

Mitsuba's own ``sunsky`` costs 2 to 5 s a scene (it sets itself up in hundreds of small kernels,
and compiles new ones) and is black with the sun below the horizon; a test holds one against the
other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from simgen.color import luminance
from simgen.geometry import Array
from simgen.recipe import SkySpec
from simgen.skymap import COARSE, Image, direction, dome_directions, illuminance

MAX_AIR_MASS = 8.0
"""The model's haze would put a sun below 7° out; a real low sun still throws warm light."""
TWILIGHT_DEG = 4.0
"""Sun elevation at which the day model begins to give way; at 0° it has no part left."""
FOG_TOP_M = 150.0
"""thickness of the layer that the visibility holds for; fogs over land reach 100 to 300 m"""
CLEAR_AIR_M = 10000.0
"""visibility from which on there is haze, but no fog"""
_WAVELENGTH_UM = np.array([0.65, 0.55, 0.45])
_SUN_KLX = 128.0
"""illuminance of the sun outside the atmosphere"""


def sun_direction(sky: SkySpec) -> Array:
    """Unit vector (3,) towards the sun."""
    return direction(sky.sun_elevation_deg, sky.sun_azimuth_deg)


def clear_dome(sky: SkySpec) -> Image:
    """The sunless clear sky: a coarse dome (h, w, 3) [kcd/m²]."""
    share = float(np.clip(sky.sun_elevation_deg / TWILIGHT_DEG, 0, 1))
    day = _preetham(sky) if share > 0 else _twilight(sky)
    if share < 1:
        twilight = _twilight(sky)
        by_day, by_table = luminance(illuminance(day)), measured_klx(sky.sun_elevation_deg)
        klx = by_day**share * by_table ** (1 - share)
        dusky = twilight * (by_day / luminance(illuminance(twilight)))
        day = (day * share + dusky * (1 - share)) * (klx / by_day)
    return (day + _town_glow()).astype(np.float32)


def sun_klx(sky: SkySpec) -> Array:
    """Illuminance (3,) of the sun on a surface that faces it; 0 once it has set."""
    return _SUN_KLX * sun_transmittance(sky) * float(sky.sun_elevation_deg > -SUNSET_DEG)


SUNSET_DEG = 0.4
"""The radius of the painted disc, see daylight.py."""


def sun_transmittance(sky: SkySpec) -> Array:
    """Share (3,) of the sun's light that gets through air and aerosol, for R, G, B."""
    elevation = max(sky.sun_elevation_deg, 0.0)
    air_mass = 1 / (np.sin(np.deg2rad(elevation)) + 0.15 * (elevation + 3.885) ** -1.253)
    air_mass = min(air_mass, MAX_AIR_MASS)
    beta = 0.04608 * sky.turbidity - 0.04586
    rayleigh = 0.008735 * _WAVELENGTH_UM**-4.08
    aerosol = beta * _WAVELENGTH_UM**-1.3
    return np.exp(-(rayleigh + aerosol) * air_mass)


# --- air and fog ---------------------------------------------------------------------------------


def extinction(visibility_m: float) -> float:
    """Of the air [1/m] (Koschmieder: 2 % contrast is left at the visibility)."""
    return float(np.log(50.0)) / visibility_m


def transmittance(distance_m: Image, visibility_m: float) -> Image:
    """Share of light that gets through the haze."""
    return np.exp(-distance_m * extinction(visibility_m)).astype(np.float32)


def fog_transmittance(sin_elevation: ArrayLike, visibility_m: float) -> Image:
    """Share of light from beyond the layer of fog that arrives unscattered."""
    depth = _fog_depth(visibility_m)
    return np.exp(-depth / np.maximum(sin_elevation, 1e-3)).astype(np.float32)


def _fog_depth(visibility_m: float) -> float:
    """Vertical optical depth; the sky holds that of clear air already."""
    excess = extinction(visibility_m) - extinction(CLEAR_AIR_M)
    return max(excess, 0.0) * FOG_TOP_M


def fog_diffusion(visibility_m: float) -> float:
    """Share of all light on top of the fog that reaches the ground, scattered or not.

    Source: two-stream solution for a layer that does not absorb, 1 / (1 + ¾ (1 − g) τ), with the
    asymmetry g = 0.85 of droplets (Bohren, *Multiple scattering of light*, 1987).
    """
    return 1 / (1 + 0.75 * 0.15 * _fog_depth(visibility_m))


# --- day: Preetham, Shirley and Smits ------------------------------------------------------------

# Perez coefficients A…E, each (slope, offset) in the turbidity, for Y, x, y (table 2).
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


def _preetham(sky: SkySpec) -> Image:
    d = dome_directions(COARSE)
    zenith_cos = np.maximum(d[..., 2], np.float32(0.01))
    sun_cos = d @ sun_direction(sky).astype(np.float32)
    t, sun_angle = sky.turbidity, np.deg2rad(90.0 - sky.sun_elevation_deg)
    chi = (4 / 9 - t / 120) * (np.pi - 2 * sun_angle)
    zenith = {
        name: float(np.array([t * t, t, 1]) @ m @ sun_angle ** np.arange(3, -1, -1))
        for name, m in _ZENITH.items()
    }
    zenith["Y"] = max((4.0453 * t - 4.9710) * np.tan(chi) - 0.2155 * t + 2.4192, 0.05)
    Y, x, y = (zenith[n] * _perez(n, t, zenith_cos, sun_cos, sun_angle) for n in "Yxy")
    xyz = np.stack([x / y * Y, Y, (1 - x - y) / y * Y], axis=-1)
    return np.maximum(xyz.astype(np.float32) @ _RGB_FROM_XYZ.T.astype(np.float32), 0)


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


# --- twilight and night --------------------------------------------------------------------------

# log10(lx) = polynomial in (elevation / 90°), from each lower bound [deg] up.
_ILLUMINANCE = (
    (5.0, (3.05, 13.28, -45.98, 64.33)),
    (-0.8, (2.88, 22.26, -207.64, 1034.30)),
    (-5.0, (2.88, 21.81, -258.11, -858.36)),
    (-12.0, (2.70, 12.17, -431.69, -1899.83)),
    (-18.0, (13.84, 262.72, 1447.42, 2797.93)),
)


def measured_klx(elevation_deg: float) -> float:
    """Illuminance on level ground under a clear sky, for a sun from −18° to 20°."""
    terms = next((c for low, c in _ILLUMINANCE if elevation_deg >= low), _ILLUMINANCE[-1][1])
    x = max(elevation_deg, -18.0) / 90.0
    return float(10 ** np.polynomial.polynomial.polyval(x, terms)) / 1000.0


def _twilight(sky: SkySpec) -> Image:
    """The spread of twilight over the dome (h, w, 3), in no particular unit."""
    sunk = float(np.clip(-sky.sun_elevation_deg / 6.0, 0, 1))
    d = dome_directions(COARSE)
    height = np.rad2deg(np.arcsin(d[..., 2:]))
    towards = direction(0, sky.sun_azimuth_deg).astype(np.float32)
    level = np.hypot(d[..., :1], d[..., 1:2])
    facing = np.clip((d @ towards)[..., None] / level, -1, 1)  # cosine of the azimuth
    near_sun = ((1 + facing) / 2) ** (1.5 + 1.5 * sunk)
    zenith = 1.0 + 0.9 * np.exp(-height / 25.0)
    red = np.exp(-height / (7.0 - 2.5 * sunk))
    gold = np.exp(-height / (20.0 - 6.0 * sunk))
    belt_deg = 8.0 + 12.0 * sunk
    opposite = np.clip(-facing, 0, 1) * (1 - 0.8 * sunk)
    belt = np.exp(-(((height - belt_deg) / 7.0) ** 2))
    shadow = np.clip(1.2 - height / belt_deg, 0, 1) * np.clip(0.5 - facing, 0, 1)
    light = zenith * np.array([0.36, 0.56, 1.0])
    light = light * (1 - 0.45 * shadow) + 0.9 * opposite * belt * np.array([1.0, 0.62, 0.66])
    light = light + (5.0 + 4.0 * sunk) * near_sun * (
        gold * np.array([1.0, 0.74, 0.40]) + (1.5 + sunk) * red * np.array([1.0, 0.38, 0.10])
    )
    return light.astype(np.float32)


def _town_glow() -> Image:
    """The light of towns, on air: 0.03 cd/m² at the zenith, ten times as much at the horizon."""
    up = dome_directions(COARSE)[..., 2:]
    glow = 3e-4 * np.exp(-6.0 * up) * np.array([1.0, 0.72, 0.46])
    return (glow + 3e-5 * np.array([0.8, 0.95, 1.25])).astype(np.float32)
