"""What lies in the air along the rays of a camera, at all its pixels from a coarse grid.

Light scattered, or lost, between the camera and a surface at distance s is a smooth function of
the ray's direction, and of s: in the image it is smooth but for the edges of surfaces. In each
cell of a coarse grid it is evaluated twice, up to the nearest and up to the farthest surface
around, and taken as affine in y = s / (s + HALF_WAY_M) between the two. Both coefficients are
interpolated between cells, and applied to every pixel's own y.

Source: Chen, Adams, Wadhwa and Hasinoff, *Bilateral guided upsampling* (SIGGRAPH Asia 2016), with
the distance as guide.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simgen.rig import Camera

Image = NDArray[Any]
"""float32"""

HALF_WAY_M = 30.0
"""where y is ½: distances around it are told apart best"""
_EQUAL = 1e-6
"""a range of y that is none"""


def at_all_pixels(
    evaluate: Callable[[Camera, Image], Image], camera: Camera, distance_m: Image, *, step: int
) -> Image:
    """A function of direction and distance (H, W, k).

    Args:
      evaluate: takes a camera and the distances (h, w) at which its rays end, infinite for the
        sky, to the values (h, w, k).
      distance_m: (H, W) of the surfaces.
      step: pixels per cell.
    """
    y = 1 - 1 / (1 + distance_m / np.float32(HALF_WAY_M))
    near, far = _range_around(y, step)
    view = coarser(camera, step)
    to_near, to_far = (evaluate(view, _distance(bound)) for bound in (near, far))
    slope = (to_far - to_near) / np.maximum(far - near, _EQUAL)[..., None]
    base = to_near - slope * near[..., None]
    values = enlarged(slope, camera.wh, step)
    values *= y[..., None]
    values += enlarged(base, camera.wh, step)
    return values


def _range_around(y: Image, step: int) -> tuple[Image, Image]:
    """Least and greatest y of each cell and the eight around it, which share in its pixels."""
    h, w = y.shape
    padded = np.pad(y, ((0, -h % step), (0, -w % step)), mode="edge")
    rows, columns = (n // step for n in padded.shape)
    strips, cells = (rows, step, columns * step), (rows, columns, step)
    least = padded.reshape(strips).min(axis=1).reshape(cells).min(axis=2)
    greatest = padded.reshape(strips).max(axis=1).reshape(cells).max(axis=2)
    around = np.ones((3, 3), np.uint8)
    return cv2.erode(least, around), cv2.dilate(greatest, around)


def _distance(y: Image) -> Image:
    with np.errstate(divide="ignore"):
        return np.asarray(np.float32(HALF_WAY_M) * y / (1 - y))


def coarser(camera: Camera, step: int) -> Camera:
    """The camera with pixels ``step`` times as large; the last ones may reach over the rim."""
    w, h = camera.wh
    K = camera.K.copy()
    K[:2] /= step
    K[:2, 2] += 0.5 / step - 0.5
    return Camera(K, camera.T_world_cam, (-(-w // step), -(-h // step)))


def enlarged(coarse: Image, wh: tuple[int, int], step: int) -> Image:
    """An image (h, w, k) of :func:`coarser` at the pixels of the camera itself (H, W, k)."""
    (w, h), (rows, columns, k) = wh, coarse.shape
    fine = cv2.resize(coarse, (columns * step, rows * step))
    return fine.reshape(rows * step, columns * step, k)[:h, :w]


def directions(camera: Camera) -> Image:
    """Unit rays (h, w, 3) through pixel centres, in the world."""
    w, h = camera.wh
    M = camera.T_world_cam[:3, :3] @ np.linalg.inv(camera.K)
    u, v = np.arange(w)[None, :, None], np.arange(h)[:, None, None]
    rays = np.asarray(u * M[:, 0] + v * M[:, 1] + M[:, 2])
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
