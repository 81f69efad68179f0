"""Sun, sky and clouds as one environment map; and the haze in front of everything.

The map is latitude–longitude, linear radiance, rows from the zenith to the nadir. Column x of W
looks along azimuth ``az`` (counter-clockwise from +x, seen from above) with
``x + ½ = W · (½ − az/2π)`` modulo W: :func:`directions` is the one place that says so, and a test
holds it against what the renderer sees.

The clear sky is Mitsuba's ``sunsky`` (Hosek & Wilkie 2012), read through a cube of cameras. Its
sun is too small for a cube face, so its radiance is measured apart and painted as a disc of a few
texels with the same irradiance. Under the horizon ``sunsky`` is black: night has its own gradient.
"""

from __future__ import annotations

from typing import Any

import cv2
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from simgen.color import luminance
from simgen.geometry import Array
from simgen.noise import fractal
from simgen.recipe import SkySpec

SKY_HW = (1024, 2048)
SUN_RADIUS_DEG = 0.35
"""Of the painted disc: two texels. The true one is 0.27°."""
_CUBE_FACE_PX = 256
MIN_SUNSKY_ELEVATION_DEG = 1.0

Image = NDArray[np.float32]


def directions(hw: tuple[int, int] = SKY_HW) -> Image:
    """Unit world directions (H, W, 3) of the map's texels."""
    h, w = hw
    polar = (np.arange(h) + 0.5) / h * np.pi
    azimuth = (0.5 - (np.arange(w) + 0.5) / w) * 2 * np.pi
    sin = np.sin(polar)[:, None]
    return np.stack(
        [sin * np.cos(azimuth), sin * np.sin(azimuth), np.cos(polar)[:, None] + 0 * azimuth],
        axis=-1,
    ).astype(np.float32)


def sun_direction(sky: SkySpec) -> Array:
    """Unit vector (3,) towards the sun."""
    el, az = np.deg2rad([sky.sun_elevation_deg, sky.sun_azimuth_deg])
    return np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])


def is_night(sky: SkySpec) -> bool:
    """Whether lamps burn and the sun gives nothing."""
    return sky.sun_elevation_deg < MIN_SUNSKY_ELEVATION_DEG


def environment(sky: SkySpec, *, rng: np.random.Generator) -> Image:
    """The sky with clouds and sun: (H, W, 3) linear radiance."""
    if is_night(sky):
        return _night(rng=rng)
    clear, sun_irradiance = _clear_sky(sky)
    ambient = clear[: SKY_HW[0] // 2].mean(axis=(0, 1))
    cover, thickness = _clouds(sky, rng=rng)
    towards_sun = np.clip(directions() @ sun_direction(sky).astype(np.float32), 0, 1)
    lit = ambient + sun_irradiance / np.pi * 0.55 * (0.35 + 0.65 * towards_sun[..., None] ** 6)
    grey = luminance(ambient + 0.25 * sun_irradiance / np.pi)
    shade = thickness[..., None]
    cloud = lit * (1 - shade) + shade * grey * np.array([0.62, 0.66, 0.72], dtype=np.float32)
    dimmed = 1.0 - 0.85 * max(0.0, sky.cloud_cover - 0.6) / 0.4
    image = clear * (1 - cover[..., None]) + cover[..., None] * cloud
    _paint_sun(image, sky, sun_irradiance * dimmed * (1 - _cover_at_sun(cover, sky)))
    return _with_ground(image)


def haze_radiance(environment_map: Image) -> Image:
    """Colour (3,) of distant haze: the mean of the sky just above the horizon, without the sun."""
    horizon = environment_map.shape[0] // 2
    band = environment_map[horizon - horizon // 12 : horizon].reshape(-1, 3)
    return np.median(band, axis=0).astype(np.float32)


def transmittance(distance_m: Image, visibility_m: float) -> Image:
    """Share of light that gets through the haze (Koschmieder: 2 % contrast at the visibility)."""
    return np.exp(-distance_m * (np.log(50.0) / visibility_m)).astype(np.float32)


# --- clear sky through Mitsuba -------------------------------------------------------------------


def _clear_sky(sky: SkySpec) -> tuple[Image, Image]:
    """The sunless clear sky (H, W, 3), and the sun's irradiance (3,) on a plane facing it."""
    shared = {
        "type": "sunsky",
        "sun_direction": mi.ScalarVector3f(*sun_direction(sky).tolist()),
        "turbidity": sky.turbidity,
    }
    dome = mi.load_dict({**shared, "sun_scale": 0.0})
    sun = mi.load_dict({**shared, "sky_scale": 0.0})
    cube = {axis: _photograph(dome, look, up) for axis, (look, up) in _CUBE.items()}
    centre = _photograph(sun, sun_direction(sky), (1.0, 0.0, 0.02), fov_deg=0.2)
    solid_angle = 2 * np.pi * (1 - np.cos(np.deg2rad(0.5358 / 2)))
    return _from_cube(cube), centre.mean(axis=(0, 1)) * np.float32(solid_angle)


# Looking direction and up vector of each face; rows and columns follow the image.
_CUBE = {
    "+x": ((1, 0, 0), (0, 0, 1)), "-x": ((-1, 0, 0), (0, 0, 1)), "+y": ((0, 1, 0), (0, 0, 1)),
    "-y": ((0, -1, 0), (0, 0, 1)), "+z": ((0, 0, 1), (-1, 0, 0)),
}  # fmt: skip


def _photograph(emitter: Any, look: Any, up: Any, fov_deg: float = 90.0) -> Image:
    size = _CUBE_FACE_PX if fov_deg == 90.0 else 8
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 1},
            "emitter": emitter,
            "sensor": {
                "type": "perspective",
                "fov": fov_deg,
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=[0, 0, 0], target=[float(x) for x in look], up=[float(x) for x in up]
                ),
                "film": {"type": "hdrfilm", "width": size, "height": size,
                         "rfilter": {"type": "box"}},
            },
        }
    )  # fmt: skip
    return np.array(mi.render(scene, spp=4, seed=0), dtype=np.float32)[..., :3]


def _from_cube(cube: dict[str, Image]) -> Image:
    """Resamples the faces to the upper half of the map; below the horizon is _with_ground's."""
    d = directions()
    image = np.zeros((*SKY_HW, 3), dtype=np.float32)
    major = np.argmax(np.abs(d), axis=-1)
    for name, (look, up) in _CUBE.items():
        forward, vertical = np.array(look, np.float32), np.array(up, np.float32)
        ahead = d @ forward
        x, y = d @ np.cross(forward, vertical) / ahead, -(d @ vertical) / ahead
        half = _CUBE_FACE_PX / 2
        face = cv2.remap(cube[name], x * half + half - 0.5, y * half + half - 0.5,
                         cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
        mine = (major == np.abs(look).argmax()) & (ahead > 0)
        image[mine] = face[mine]
    return np.maximum(image, 0.0)


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
    sheet = fractal((size, size), wavelength=size / 14, octaves=7, gain=0.55, seed=seed)
    uv = [((c + 17.0) * (size / 34.0)).astype(np.float32) for c in (x, y)]
    density = cv2.remap(sheet, uv[0], uv[1], cv2.INTER_LINEAR)
    level = np.quantile(sheet, 1 - np.clip(sky.cloud_cover, 0.0, 1.0))
    spread = float(sheet.std())
    soft = 0.35 if sky.cloud_cover < 0.9 else 1.5
    cover = np.clip((density - level) / (soft * spread) + (sky.cloud_cover >= 0.9), 0, 1)
    thickness = np.clip((density - level) / (2.2 * spread), 0, 1)
    return cover * (d[..., 2] > -0.02), thickness


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
    inside = d @ sun_direction(sky).astype(np.float32) > np.cos(np.deg2rad(SUN_RADIUS_DEG))
    h, w = SKY_HW
    texel = np.sqrt(1 - d[..., 2] ** 2) * (np.pi / h) * (2 * np.pi / w)
    image[inside] += irradiance / texel[inside].sum()


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
