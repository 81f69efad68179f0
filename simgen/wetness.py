"""Water out of doors: where it lies, how much darker it makes things, and how smooth the ground.

One number tells how wet a scene is: 0 is dry, at 1 a film of water covers everything. As water
grows, low places become damp first, then all of them; from FILM_FROM on paved ground shines and
puddles rise in hollows, in wheel tracks and along kerbs. Where water dries away, traffic dries the
wheel tracks first.

What is not on a map of the ground is evenly wet: land further away as much as the ground on
average, what stands upright less.

All images are float32 (H, W) on the raster of one map, unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from simgen.color import linear_from_srgb, srgb_from_linear

Image = NDArray[Any]
"""float32"""

FILM_FROM = 0.25
"""Ground that is less wet is darker where it is damp, but does not shine."""
SPECULAR = 0.25
"""Mitsuba's number for the refractive index of water, 1.33: 2 % are reflected head-on."""

_DRY_ROUGHNESS = 0.95
_FILM_ROUGHNESS = (0.55, 0.27)
"""of asphalt in a film of water, at FILM_FROM and at wetness 1"""
_CALM_ROUGHNESS = 0.09
"""of a puddle; smoother ones sparkle at few samples"""
_RIPPLES = 0.1
"""what rain adds to it, from _RIPPLES_MM_H on"""
_RIPPLES_MM_H = 10.0


@dataclass(frozen=True, eq=False)
class Water:
    """Where water lies."""

    damp: Image
    """share of the surface that is wet, puddles included"""
    puddle: Image
    """share of the surface under standing water"""


def settle(hollows: Image, tracks: Image, gutters: Image, *, wetness: float) -> Water:
    """Where water gathers.

    ``hollows`` is the height of the ground in units of its unevenness, about ±1; ``tracks`` and
    ``gutters`` are the shares of wheel tracks and of the strips along kerbs.
    """
    level = -1.5 + 0.8 * wetness if wetness >= FILM_FROM else -np.inf
    puddle = _rise(level - hollows + 0.3 * tracks + 0.55 * gutters, 0.1)
    damp = _rise(6.0 * wetness - 2.3 - hollows - 0.5 * tracks, 0.4)
    return Water(np.maximum(damp, puddle), puddle)


def _rise(depth: Image, width: float) -> Image:
    """0 where ``depth`` is under −width, 1 over +width, smooth between."""
    t = np.clip(depth * np.float32(0.5 / width) + np.float32(0.5), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def darkening(albedo: Image, water: Water) -> Image:
    """What wet ground's albedo (H, W, 3) is to be multiplied by.

    A film of water of index n lets 1 − R in, and returns the share p of what the ground scatters,
    by total reflection, back to it: albedo' = (1 − R)(1 − p) albedo / (1 − p albedo), with
    p = 1 − (1 − R)/n². Bright colours lose less, so hues grow more saturated. Puddles, which
    soak and shade the ground under them, take another quarter.

    Source: Lekner and Dorf, "Why some things are darker when wet", Applied Optics 27 (1988),
    pp. 1278-1280; without the weaker reflection of grains that lie in water.
    """
    wet = _under_film(albedo)
    wet *= 1 - np.float32(0.25) * water.puddle[..., None]
    factor: Image = 1 + water.damp[..., None] * (wet - 1)
    return factor


def _under_film(albedo: Image) -> Image:
    """What a film of water multiplies albedos by."""
    factor: Image = np.float32((1 - _R) * (1 - _P)) / (1 - np.float32(_P) * albedo)
    return factor


def darkened(albedo: Image, wetness: float, exposure: float = 1.0) -> Image:
    """Albedos (…, 3) out of doors, off the maps; ``exposure`` is 1 where ground is open to rain."""
    damp = settle(_UNEVEN, np.zeros_like(_UNEVEN), np.zeros_like(_UNEVEN), wetness=wetness).damp
    wet: Image = albedo * (1 + np.float32(exposure * damp.mean()) * (_under_film(albedo) - 1))
    return wet


def wet_bytes(image: NDArray[np.uint8], wetness: float, exposure: float) -> NDArray[np.uint8]:
    """An sRGB image :func:`darkened`."""
    if wetness == 0:
        return image
    linear = linear_from_srgb(np.arange(256, dtype=np.float32) / 255)
    encoded = np.rint(255 * srgb_from_linear(darkened(linear, wetness, exposure)))
    return np.take(encoded.astype(np.uint8), image)


UPRIGHT = 0.5
"""exposure of walls, trunks and foliage: rain wets them partly"""
_UNEVEN = np.float32(0.57) * np.sqrt(np.float32(2)) * erfinv(np.linspace(-0.98, 0.98, 50))
"""(50,) evenly likely hollows, spread as those of the maps are"""
_N_WATER = 1.333
_R = 0.066
"""reflectance of water for diffuse light from above"""
_P = 1 - (1 - _R) / _N_WATER**2


def roughness(
    water: Water, paved: Image, texture: Image, *, wetness: float, rain_mm_h: float
) -> NDArray[np.uint8]:
    """Roughness, 255 = 1, of the ground; only ``paved`` ground (share) can shine.

    ``texture`` (about ±1) is the unevenness that pokes through a film.
    """
    share = (wetness - FILM_FROM) / (1 - FILM_FROM)
    film = float(np.interp(share, (0.0, 1.0), _FILM_ROUGHNESS)) * (1 + np.float32(0.25) * texture)
    still = _CALM_ROUGHNESS + _RIPPLES * min(rain_mm_h / _RIPPLES_MM_H, 1.0)
    surface = _DRY_ROUGHNESS + water.damp * paved * (film - _DRY_ROUGHNESS)
    surface += water.puddle * paved * (np.float32(still) - surface)
    return np.round(np.clip(surface, 0.0, 1.0) * 255).astype(np.uint8)
