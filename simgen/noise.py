"""Seeded value noise that is a function of place: the same point has the same value in any window.

A lattice of hashed values is upsampled smoothly. Windows may be turned and stretched against the
lattice, so that the ortho maps of a moving rig always show the same ground.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]
"""float32"""


def hashed(ix: NDArray[np.int64], iy: NDArray[np.int64], seed: int) -> Image:
    """Uniform values in [−1, 1) of lattice points, from an integer hash (murmur3's mixer)."""
    with np.errstate(over="ignore"):
        x = ix.astype(np.uint32) * np.uint32(0x9E3779B1) ^ iy.astype(np.uint32) * np.uint32(
            0x85EBCA77
        )
        x ^= np.uint32((seed * 0xC2B2AE3D) & 0xFFFFFFFF)
        for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
            x ^= x >> np.uint32(shift)
            x *= np.uint32(factor)
        x ^= x >> np.uint32(16)
    return (x >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-23) - np.float32(1.0)


def octave(hw: tuple[int, int], A: NDArray[np.float64], wavelength: float, seed: int) -> Image:
    """Noise (H, W) in about [−1, 1] of one wavelength.

    ``A`` (2, 3) takes pixel (column, row, 1) to world metres, in which ``wavelength`` is given.
    """
    h, w = hw
    to_lattice = A / wavelength
    corners = to_lattice @ np.array([[0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1], [1, 1, 1, 1]])
    low = np.floor(corners.min(axis=1)).astype(np.int64) - 2
    high = np.ceil(corners.max(axis=1)).astype(np.int64) + 3
    ix, iy = np.arange(low[0], high[0])[None, :], np.arange(low[1], high[1])[:, None]
    window = to_lattice.copy()
    window[:, 2] -= low
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP  # the matrix leads from output to lattice
    warped: Image = cv2.warpAffine(hashed(ix, iy, seed), window, (w, h), flags=flags)
    return warped


def fractal(
    hw: tuple[int, int],
    *,
    wavelength: float,
    octaves: int,
    seed: int,
    A: NDArray[np.float64] | None = None,
    gain: float = 0.5,
) -> Image:
    """A sum of octaves from ``wavelength`` down, each half as long and ``gain`` as strong.

    Octaves fade out from four pixels to two: what a pixel cannot show would only alias. Long waves
    are made on coarse rasters and enlarged on the way to finer ones, so that all of them together
    cost little more than the finest one. (It also keeps OpenCV's warp, which steps by 1/32 of a
    lattice cell, from showing.)
    """
    A = np.eye(2, 3) if A is None else A
    pixel = np.linalg.norm(A[:, :2], axis=0)
    total = np.zeros((0, 0), dtype=np.float32)
    factors = (0, 0)
    for k in range(octaves):
        scale = wavelength / 2**k
        weight = np.clip(scale / (2.0 * pixel.max()) - 1.0, 0.0, 1.0) * gain**k
        if weight == 0.0:
            break
        finer = tuple(_power_of_two(scale / (_CELL_PX * p)) for p in pixel)
        total = _enlarged(total, factors, finer, hw)
        factors = (finer[0], finer[1])
        coarser = np.array([[finer[0], 0, (finer[0] - 1) / 2], [0, finer[1], (finer[1] - 1) / 2],
                            [0, 0, 1]])  # fmt: skip
        total += np.float32(weight) * octave(total.shape, A @ coarser, scale, seed + 101 * k)
    return _enlarged(total, factors, (1, 1), hw)[: hw[0], : hw[1]]


_CELL_PX = 4


def _power_of_two(x: float) -> int:
    return 1 << max(0, int(np.floor(np.log2(max(x, 1.0)))))


def _enlarged(
    image: Image, factors: tuple[int, ...], finer: tuple[int, ...], hw: tuple[int, int]
) -> Image:
    """From a raster ``factors`` (across, down) times coarser than ``hw`` to a finer one."""
    if image.size == 0:
        return np.zeros((-(-hw[0] // finer[1]), -(-hw[1] // finer[0])), dtype=np.float32)
    zoom = (factors[0] // finer[0], factors[1] // finer[1])
    if zoom == (1, 1):
        return image
    h, w = image.shape
    large = cv2.resize(image, (w * zoom[0], h * zoom[1]), interpolation=cv2.INTER_LINEAR)
    return large[: -(-hw[0] // finer[1]), : -(-hw[1] // finer[0])]
