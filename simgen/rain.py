"""Rain in the air and on the glass: streaks of falling drops, and drops that sit before a lens.

Works on linear radiance, after haze and before the sensor. Falling drops are points of the world:
all cameras of a rig see the same ones, each from where it stands. What a drop hides during the
exposure is its area, spread over the path of its image: a streak is the fainter the longer it is
(Garg & Nayar, Vision and rain, 2007). Drops whose angle is below ``MIN_ANGLE_RAD`` are not drawn
singly, nor are those that leave no trace (``MIN_SHARE``): they are part of the air's visibility.

``D`` is a drop's diameter. Drops are given in the world frame at mid-exposure, relative to the
rig, which moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simgen.geometry import Array, project, transform_points
from simgen.recipe import Interval, draw
from simgen.rig import Camera
from simgen.skymap import illuminance

Image = NDArray[Any]
"""float32"""

NEAR_M, FAR_M = 0.6, 10.0
"""where drops are drawn: before the rig's windscreen, and as far as the largest can be told"""
MAX_DIAMETER_M = 6e-3
"""larger drops break up"""
MIN_ANGLE_RAD = MAX_DIAMETER_M / FAR_M
"""of a drop that is drawn: 1 mm at 1.7 m; 0.8 px of an image 2560 px and 90° wide"""
APERTURE_M = 1.5e-3
"""of a lens focused far away: a drop is blurred by as much"""
MIN_SHARE = 0.006
"""of a pixel that a drawn streak hides: about one grey level where the drop is three times as
bright as what it hides"""
DROP_TRANSMITS = 0.94
"""Share of the mean radiance around that a drop shows (Garg & Nayar 2007, section 3)."""

EXPOSURE_S: dict[bool, Interval] = {False: (2e-3, 8e-3), True: (15e-3, 33e-3)}
"""by day, and in the dark"""
SPEED_M_S: dict[str, Interval] = {
    "town": (0.0, 12.0),
    "rural": (5.0, 15.0),
    "motorway": (8.0, 15.0),
}
WIND_M_S: Interval = (0.0, 6.0)
GUST_M_S = 0.3
"""standard deviation of each drop's own velocity, per axis"""

LENS_DROPS_MAX = 25
LENS_DIAMETER: Interval = (8 / 2560, 60 / 2560)
"""of the image's width"""
GLASS_BLUR = 4 / 2560
"""of the image's width: how far a rim is blurred to each side; small drops become translucent"""


@dataclass(frozen=True)
class Shower:
    """The rain of one frame."""

    rate_mm_h: float
    exposure_s: float
    wind_m_s: tuple[float, float]
    """towards +x and +y of the world"""
    speed_m_s: float
    """of the rig, forward"""
    lens_drops: tuple[int, ...]
    """drops on the glass of each camera"""


@dataclass(frozen=True, eq=False)
class Drops:
    """Falling drops during an exposure."""

    diameter_m: Array
    """(N,)"""
    start: Array
    """(N, 3) where the shutter opens"""
    end: Array
    """(N, 3) where it closes"""


def draw_shower(
    rate_mm_h: float, road_kind: str, *, dark: bool, num_lenses: int, rng: np.random.Generator
) -> Shower | None:
    """Draws the rain of a frame; None if it does not rain.

    Args:
      rate_mm_h: of the weather.
      road_kind: decides how fast the rig drives.
      dark: whether exposures are long.
      num_lenses: cameras whose glass gets wet.
    """
    if rate_mm_h <= 0:
        return None
    wind = draw(WIND_M_S, rng=rng) * np.exp(2j * np.pi * rng.random())
    since_wiped = rng.uniform(0.1, 1.0)
    on_lens = rng.poisson(since_wiped * min(rate_mm_h, LENS_DROPS_MAX), num_lenses)
    return Shower(
        rate_mm_h=rate_mm_h,
        exposure_s=draw(EXPOSURE_S[dark], rng=rng),
        wind_m_s=(float(wind.real), float(wind.imag)),
        speed_m_s=draw(SPEED_M_S[road_kind], rng=rng),
        lens_drops=tuple(np.minimum(on_lens, LENS_DROPS_MAX).tolist()),
    )


# --- falling drops -------------------------------------------------------------------------------


def terminal_speed(diameter_m: Array) -> Array:
    """Of drops in still air [m/s].

    Source: Atlas, Srivastava, Sekhon, Doppler radar characteristics of precipitation at vertical
    incidence, 1973: a fit to the measurements of Gunn & Kinzer, 1949.
    """
    return np.maximum(9.65 - 10.3 * np.exp(-600 * diameter_m), 0.0)


def falling(
    shower: Shower,
    cameras: Sequence[Camera],
    T_world_vehicle: Array,
    *,
    rng: np.random.Generator,
) -> Drops:
    """Drops of at least MIN_ANGLE_RAD before the rig that leave a trace (MIN_SHARE).

    Diameters and number follow N(D) = N₀ exp(−ΛD) per volume, N₀ = 8000 m⁻³ mm⁻¹ and
    Λ = 4.1 R^(−0.21) mm⁻¹. At distance x drops count from D = MIN_ANGLE_RAD · x on, of which there
    are (N₀/Λ) exp(−ΛD); what D is beyond that is exponential again.

    Source: Marshall & Palmer, The distribution of raindrops with size, 1948.
    """
    per_m = 4.1e3 * shower.rate_mm_h**-0.21
    centre = np.mean([c.centre for c in cameras], axis=0)
    R_world_vehicle = T_world_vehicle[:3, :3]
    slope, reach = _field_of_view(cameras, centre, R_world_vehicle)
    x = np.linspace(NEAR_M, FAR_M, 1024)
    half = x[:, None] * slope + reach
    density = 4 * half.prod(axis=1) * 8e6 / per_m * np.exp(-per_m * MIN_ANGLE_RAD * x)
    expected = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(x))])

    num = int(rng.poisson(expected[-1]))
    ahead = np.interp(rng.uniform(0, expected[-1], num), expected, x)
    aside = rng.uniform(-1, 1, (num, 2)) * (ahead[:, None] * slope + reach)
    diameter_m = MIN_ANGLE_RAD * ahead + rng.exponential(1 / per_m, num)
    diameter_m = np.minimum(diameter_m, MAX_DIAMETER_M)
    middle = np.column_stack([ahead, aside]) @ R_world_vehicle.T + centre
    path = shower.exposure_s * _velocity(shower, diameter_m, R_world_vehicle[:, 0], rng=rng)
    blurred_m2 = np.linalg.norm(path, axis=1) * np.hypot(diameter_m, APERTURE_M)
    seen = np.pi / 4 * diameter_m**2 > MIN_SHARE * blurred_m2
    return Drops(diameter_m[seen], (middle - path / 2)[seen], (middle + path / 2)[seen])


def _velocity(
    shower: Shower, diameter_m: Array, forward: Array, *, rng: np.random.Generator
) -> Array:
    """Of drops (N, 3) in the world, relative to the rig."""
    velocity = rng.normal(0, GUST_M_S, (len(diameter_m), 3))
    velocity[:, :2] += shower.wind_m_s
    velocity[:, 2] -= terminal_speed(diameter_m)
    return velocity - shower.speed_m_s * forward


def _field_of_view(
    cameras: Sequence[Camera], centre: Array, R_world_vehicle: Array
) -> tuple[Array, float]:
    """Half width and height (2,) of what the cameras see, per metre ahead, and at no distance."""
    tangents = []
    for camera in cameras:
        w, h = camera.wh
        corners = np.array([[u, v, 1] for u in (-0.5, w - 0.5) for v in (-0.5, h - 0.5)])
        rays = corners @ np.linalg.inv(camera.K).T @ camera.T_world_cam[:3, :3].T @ R_world_vehicle
        tangents.append(np.abs(rays[:, 1:] / rays[:, :1]).max(axis=0))
    reach = max(float(np.linalg.norm(c.centre - centre)) for c in cameras)
    return np.max(tangents, axis=0), reach + 0.2


# --- streaks in the image ------------------------------------------------------------------------


def streaks(drops: Drops, camera: Camera, distance_m: Image) -> Image:
    """How much of each pixel (H, W) drops hide, as an optical depth: overlapping ones add up.

    Args:
      distance_m: (H, W) of the scene, infinite for the sky; drops behind it are hidden.
    """
    w, h = camera.wh
    start, end = (transform_points(camera.T_cam_world, p) for p in (drops.start, drops.end))
    z = (start[:, 2] + end[:, 2]) / 2
    in_view = _in_view(start, end, camera)
    per_m = camera.K[0, 0] / np.where(in_view, z, 1.0)
    width_px = per_m * np.hypot(drops.diameter_m, APERTURE_M)
    area_px = np.pi / 4 * (per_m * drops.diameter_m) ** 2
    octave = np.round(np.log2(np.maximum(width_px, 1))).astype(int)
    hidden = np.zeros((h, w), np.float32)
    for k in np.unique(octave[in_view]):
        chosen = in_view & (octave == k)
        paths = _Paths(start[chosen], end[chosen], area_px[chosen])
        hidden += _drawn(paths, camera, distance_m, step=2 ** int(k))
    return hidden


def _in_view(start: Array, end: Array, camera: Camera) -> NDArray[np.bool_]:
    """Which segments (N, 3), (N, 3) of the camera frame may cross the image."""
    ahead = np.minimum(start[:, 2], end[:, 2]) > NEAR_M / 4
    uv = np.stack([project(camera.K, np.where(ahead[:, None], p, 1.0)) for p in (start, end)])
    crosses = (uv.max(axis=0) > -1) & (uv.min(axis=0) < camera.wh)
    return ahead & crosses.all(axis=1)


@dataclass(frozen=True, eq=False)
class _Paths:
    """Segments in the camera frame, and the area [px²] of what moves along each."""

    start: Array
    end: Array
    area_px: Array


def _drawn(paths: _Paths, camera: Camera, distance_m: Image, *, step: int) -> Image:
    """Streaks about ``step`` pixels wide (H, W), drawn on a grid as coarse as that."""
    w, h = camera.wh
    K = camera.K
    length = np.linalg.norm(project(K, paths.end) - project(K, paths.start), axis=-1)
    num = np.ceil(length / step).astype(int) + 1
    of = np.repeat(np.arange(len(num)), num)
    time = (np.arange(len(of)) - np.repeat(np.cumsum(num) - num, num) + 0.5) / num[of]
    p = paths.start[of] + time[:, None] * (paths.end - paths.start)[of]
    uv = project(K, p)
    weight = (paths.area_px / num / step**2)[of] * _seen(p, uv, distance_m)
    small = (-(-w // step), -(-h // step))
    coarse = _splat((uv + 0.5) / step - 0.5, weight, small)
    fine: Image = cv2.resize(coarse, (small[0] * step, small[1] * step))
    return fine[:h, :w]


def _seen(p: Array, uv: Array, distance_m: Image) -> NDArray[np.bool_]:
    """Which points (N, 3) of the camera frame are in the image and before the scene."""
    h, w = distance_m.shape
    u, v = np.round(uv).astype(int).T
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    scene_m = distance_m[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)]
    return inside & (np.linalg.norm(p, axis=-1) < scene_m)


def _splat(uv: Array, weight: Array, wh: tuple[int, int]) -> Image:
    """Weights (N,) shared out among the four pixels around each ``uv`` (N, 2)."""
    w, h = wh
    use = weight > 0
    uv = uv[use] + 1  # a frame of one pixel takes what lies beyond
    corner = uv.astype(int)
    du, dv = (uv - corner).T
    pixel = corner[:, 1] * (w + 2) + corner[:, 0] + np.array([[0], [1], [w + 2], [w + 3]])
    share = np.stack([(1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv]) * weight[use]
    total = np.bincount(pixel.ravel(), share.ravel(), (h + 2) * (w + 2))
    return total.reshape(h + 2, w + 2)[1:-1, 1:-1].astype(np.float32)


def seen_through(radiance: Image, hidden: Image, sky: Image) -> Image:
    """Radiance (H, W, 3) with streaks of optical depth ``hidden`` (H, W) before it.

    A drop shows 165° of what is around it: half of it the sky (a map, see skymap.py), half of it
    the scene in its part of the picture.
    """
    h, w = hidden.shape
    dome = sky[: sky.shape[0] // 2 : 8, ::8]
    scene = cv2.resize(radiance, (8, 5), interpolation=cv2.INTER_AREA)
    light = scene + (illuminance(dome) / np.pi).astype(np.float32)
    seen: Image = cv2.resize(np.float32(DROP_TRANSMITS / 2) * light, (w, h))
    seen -= radiance
    seen *= -np.expm1(-hidden)[..., None]
    seen += radiance
    return seen


# --- drops on the glass --------------------------------------------------------------------------


def through_wet_glass(radiance: Image, num: int, *, rng: np.random.Generator) -> Image:
    """Radiance (H, W, 3) behind ``num`` drops on the glass before the lens."""
    if not num:
        return radiance
    wet = radiance.copy()
    blurred = cv2.resize(radiance, (24, 14), interpolation=cv2.INTER_AREA)
    for _ in range(num):
        _put_drop(wet, blurred, rng=rng)
    return wet


def _put_drop(wet: Image, blurred: Image, *, rng: np.random.Generator) -> None:
    """Draws one drop: it shows what is around, upside down, and is dark towards its rim."""
    h, w = wet.shape[:2]
    low, high = LENS_DIAMETER
    radius = 0.5 * w * low * (high / low) ** (rng.random() ** 1.5)
    centre = rng.uniform(0, (w, h))
    first = np.clip(np.floor(centre - 2 * radius), 0, (w, h)).astype(int)
    last = np.clip(np.ceil(centre + 2 * radius) + 1, 0, (w, h)).astype(int)
    u, v = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
    x, y = (u - centre[0]) / radius, (v - centre[1]) / radius
    rim = np.hypot(x, y) / _outline(np.arctan2(y, x), rng=rng)
    softness = GLASS_BLUR * w / radius
    cover = np.clip((1 + softness - rim) / (2 * softness), 0, 1)
    cover = (cover * cover * (3 - 2 * cover))[..., None].astype(np.float32)
    shade = 1 - 0.5 * np.clip(rim, 0, 1)[..., None].astype(np.float32) ** 4
    window = wet[first[1] : last[1], first[0] : last[0]]
    window += cover * (shade * _upside_down(blurred, centre / (w, h), x, y) - window)


def _outline(angle: Array, *, rng: np.random.Generator) -> Array:
    """Radius of a drop by angle: nearly round."""
    waves = [(m, rng.normal(0, 0.12 / m), rng.uniform(0, 2 * np.pi)) for m in (2, 3, 4, 5)]
    return np.asarray(1 + sum(a * np.cos(m * angle + phase) for m, a, phase in waves))


def _upside_down(blurred: Image, place: Array, x: Array, y: Array) -> Image:
    """What a drop at ``place`` (shares of the image) shows at (x, y), its rim being at 1."""
    h, w = blurred.shape[:2]
    column, row = (place[0] - 0.35 * x) * w - 0.5, (place[1] - 0.6 * y) * h - 0.5
    shown: Image = cv2.remap(
        blurred, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return shown
