"""Sun, sky, clouds and fog as one environment map, and the airlight that belongs to it.

The map is that of skymap.py; radiance is in kcd/m². From above the clouds down: clear sky
(atmosphere.py), low clouds (clouds.py), sun, a layer of fog of the visibility that the scene's
air has.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from simgen import atmosphere, clouds
from simgen.atmosphere import SUNSET_DEG, sun_direction
from simgen.color import luminance
from simgen.geometry import Array
from simgen.recipe import DaylightTable, SkySpec
from simgen.samples import LAMPS_BELOW_DEG
from simgen.skymap import (
    SKY_HW,
    Image,
    directions,
    dome_directions,
    enlarged,
    illuminance,
    texel,
)

SUN_RADIUS_DEG = SUNSET_DEG
"""Of the painted disc, soft at the rim: the map's texels are 0.18° wide. The true one is 0.27°."""
CLOUDS_SEE_SUN_DEG = 2.0
"""How much longer than the ground clouds see the sun: the dip of the horizon from 4 km."""


def is_night(sky: SkySpec) -> bool:
    """Whether lamps burn: from sunset on, so that dusk and night share one set of lights."""
    return sky.sun_elevation_deg < LAMPS_BELOW_DEG


def night_share(presets: Mapping[str, DaylightTable]) -> float:
    """The expected share of frames in which lamps burn."""
    shares = np.array([preset.share for preset in presets.values()])
    low, high = np.array([preset.sun_elevation_deg for preset in presets.values()]).T
    dark = (LAMPS_BELOW_DEG - low) / np.maximum(high - low, 1e-9)
    return float(shares @ np.clip(dark, 0, 1) / shares.sum())


def environment(sky: SkySpec, *, rng: np.random.Generator) -> Image:
    """The sky with clouds, sun and fog: (H, W, 3) linear radiance."""
    clear = atmosphere.clear_dome(sky)
    layer = clouds.build(sky.cloud_cover, _light_on_clouds(sky, clear), rng=rng)
    dome = layer.over(enlarged(clear))
    sun = sun_direction(sky)
    direct = atmosphere.sun_klx(sky) * layer.share_of_sun(sun)
    through = atmosphere.fog_transmittance(sun[2], sky.visibility_m)
    dome = _under_fog(dome, direct * max(float(sun[2]), 0.0), sky)
    _paint_sun(dome, sun, direct * through)
    return _with_ground(dome)


def airlight(environment_map: Image) -> Image:
    """Radiance of the air by azimuth: a map (1, W, 3), to be read like any other.

    It is the sky's just above the horizon, without the sun and smooth over some 12°, so that what
    is far away goes over into the sky behind it.
    """
    return _at_horizon(environment_map[: environment_map.shape[0] // 2])


def _at_horizon(dome: Image) -> Image:
    band = np.median(dome[-24:-4], axis=0)
    width = 65
    wrapped = np.concatenate([band[-width:], band, band[:width]])[None]
    smooth = cv2.blur(cv2.blur(wrapped, (width, 1)), (width, 1))
    return np.ascontiguousarray(smooth[:, width:-width], dtype=np.float32)


def _light_on_clouds(sky: SkySpec, clear: Image) -> clouds.Light:
    """What clouds send on: broken ones the colour of the sun, a closed layer that of the light on
    level ground, which a low sun has little part in."""
    up = sky.sun_elevation_deg + CLOUDS_SEE_SUN_DEG
    seen = np.clip((up + 1.0) / 3.0, 0, 1) ** 2
    sun = atmosphere.direction(max(up, 0.0), sky.sun_azimuth_deg)
    sun_klx = atmosphere.sun_klx(sky) * seen
    on_level = illuminance(clear) + sun_klx * float(sun[2])
    mixed = on_level * (luminance(sun_klx) / luminance(on_level))
    sun_klx += clouds.closed(sky.cloud_cover) * (mixed - sun_klx)
    return clouds.Light(sun, sun_klx, illuminance(clear) / np.pi)


def _under_fog(dome: Image, sun_on_level: Array, sky: SkySpec) -> Image:
    """The dome from within a layer of fog: what gets through, and the light that fog scatters."""
    if sky.visibility_m >= atmosphere.CLEAR_AIR_M:
        return dome
    coarse = dome[::4, ::4]
    arriving = atmosphere.fog_diffusion(sky.visibility_m) * (illuminance(coarse) + sun_on_level)
    up = dome_directions()[:, :1, 2]
    through = atmosphere.fog_transmittance(up, sky.visibility_m)[..., None]
    scattered = np.maximum(arriving - illuminance(dome * through), 0)
    shape = (1 - through) * (0.7 + 0.3 * up[..., None])
    fog = shape * scattered / illuminance(np.broadcast_to(shape, (*up.shape[:1], 8, 3)))
    return (dome * through + fog).astype(np.float32)


def _paint_sun(dome: Image, sun: Array, irradiance: Array) -> None:
    """Adds a disc whose texels carry the irradiance; what is below the horizon is lost."""
    d = directions()
    h, w = SKY_HW
    row, _ = texel(sun)
    rows = slice(max(0, row - 8), row + 9)
    angle = np.rad2deg(np.linalg.norm(np.cross(d[rows], sun), axis=-1))
    weight = np.clip(1.5 - angle / SUN_RADIUS_DEG, 0, 1) * (d[rows] @ sun > 0)
    size = np.sqrt(1 - d[rows, :, 2] ** 2) * (np.pi / h) * (2 * np.pi / w)
    disc = (weight / (weight * size).sum())[..., None] * irradiance
    seen = dome[rows]
    seen += disc[: len(seen)]


def _with_ground(dome: Image) -> Image:
    """Below the horizon: what a far plain would send back, so that nothing is lit by black."""
    ground = np.broadcast_to(np.float32(0.35) * _at_horizon(dome), dome.shape)
    return np.concatenate([dome, ground])
