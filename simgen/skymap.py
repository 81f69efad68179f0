"""A sky as a latitude–longitude map of linear radiance: where its texels look, how to read it.

Rows go from the zenith to the nadir. Column x of W looks along azimuth ``az`` (counter-clockwise
from +x, seen from above) with ``x + ½ = W · (½ − az/2π)`` modulo W: :func:`directions` is the one
place that says so, and a test holds it against what the renderer sees.

A *dome* is the upper half of a map, (H/2, W). Smooth domes are made coarse and enlarged.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simgen.geometry import Array

SKY_HW = (1024, 2048)
DOME_HW = (SKY_HW[0] // 2, SKY_HW[1])
COARSE = 4
"""A coarse dome has so many times fewer rows and columns."""

Image = NDArray[Any]
"""float32"""


@lru_cache(maxsize=4)
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


def dome_directions(step: int = 1) -> Image:
    """Those of the dome whose texels are ``step`` times larger."""
    h, w = SKY_HW
    return directions((h // step, w // step))[: h // step // 2]


def direction(elevation_deg: float, azimuth_deg: float) -> Array:
    """Unit vector (3,)."""
    el, az = np.deg2rad([elevation_deg, azimuth_deg])
    return np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])


def texel(towards: Array) -> tuple[int, int]:
    """Row and column of a full-size map that looks along a unit vector (3,)."""
    h, w = SKY_HW
    azimuth = np.arctan2(towards[1], towards[0])
    row = np.arccos(np.clip(towards[2], -1, 1)) / np.pi * h
    return int(row), int((0.5 - azimuth / (2 * np.pi)) * w) % w


def enlarged(coarse: Image) -> Image:
    """A coarse dome at full size; it goes on over the seam."""
    padded = np.concatenate([coarse[:, -1:], coarse, coarse[:, :1]], axis=1)
    h, w = padded.shape[:2]
    fine: Image = cv2.resize(padded, (w * COARSE, h * COARSE), interpolation=cv2.INTER_LINEAR)
    return fine[:, COARSE:-COARSE]


def illuminance(dome: Image) -> Array:
    """On the ground (3,): the radiance of a dome (h, w, 3) of any size times the cosine."""
    h, w = dome.shape[:2]
    polar = (np.arange(h) + 0.5) / h * np.pi / 2
    weight = np.sin(polar) * np.cos(polar) * (np.pi / 2 / h) * (2 * np.pi / w)
    return np.asarray(weight @ dome.sum(axis=1, dtype=np.float64))


def seen_through(sky_map: Image, K: Array, R_world_cam: Array, wh: tuple[int, int]) -> Image:
    """The map at the pixel centres of a camera (H, W, 3), as if nothing stood in the way."""
    u, v = np.meshgrid(np.arange(wh[0], dtype=np.float32), np.arange(wh[1], dtype=np.float32))
    M = (R_world_cam @ np.linalg.inv(K)).astype(np.float32)
    x, y, z = (m[0] * u + m[1] * v + m[2] for m in M)
    h, w = sky_map.shape[:2]
    column = (0.5 - np.arctan2(y, x) / np.float32(2 * np.pi)) * w - 0.5
    row = np.arctan2(np.hypot(x, y), z) / np.float32(np.pi) * h - 0.5
    seam = np.concatenate([sky_map, sky_map[:, :1]], axis=1)
    seen: Image = cv2.remap(
        seam, column % w, np.clip(row, 0, h - 1), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return seen
