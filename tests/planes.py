"""Rectified pairs of textured planes, rendered in closed form: disparity a + b u + c v each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowrect.sample import Image

Plane = tuple[float, float, float]
"""a, b, c: disparity a + b u + c v at left pixel (u, v)"""


@dataclass(frozen=True)
class PlanarPair:
    """A pair in front of a background plane, with a nearer rectangle (or none)."""

    left: Image
    right: Image
    disparity: np.ndarray
    """(H, W) exact, on left pixels"""
    visible: np.ndarray
    """(H, W) True where the right image shows the same point"""


def disparity_of(plane: Plane, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    a, b, c = plane
    return a + b * u + c * v


def planar_pair(
    back: Plane, front: Plane | None = None, box: tuple[int, int, int, int] = (0, 0, 0, 0),
    *, wh: tuple[int, int], seed: int,
) -> PlanarPair:  # fmt: skip
    """Smooth noise on both planes; ``box`` (u0, v0, u1, v1) in the left image is the front's.

    The left pixel that right pixel (u, v) shows solves u_left − disparity(u_left, v) = u.
    """
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(wh[0], dtype=float), np.arange(wh[1], dtype=float))
    left, right = _painted(back, u, v, rng)
    disparity, visible = disparity_of(back, u, v), np.ones(u.shape, bool)
    if front is not None:
        near_left, near_right = _painted(front, u, v, rng)
        here, there = _within(u, v, box), _within(_source(front, u, v), v, box)
        left, right = np.where(here[..., None], near_left, left), np.where(
            there[..., None], near_right, right
        )  # fmt: skip
        visible = here | ~_within(_source(front, u - disparity, v), v, box)
        disparity = np.where(here, disparity_of(front, u, v), disparity)
    visible &= u - disparity >= 0
    left, right = (np.rint(x).astype(np.uint8) for x in (left, right))
    return PlanarPair(left, right, disparity, visible)


def _source(plane: Plane, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """u of the left pixel that shows what the right one shows."""
    a, b, c = plane
    return (u + a + c * v) / (1 - b)


def _within(u: np.ndarray, v: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    u0, v0, u1, v1 = box
    return (u >= u0) & (u < u1) & (v >= v0) & (v < v1)


def _painted(
    plane: Plane, u: np.ndarray, v: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The plane's texture as both images show it; it goes on for 100 px beyond the left one."""
    h, w = u.shape
    noise = cv2.GaussianBlur(rng.normal(size=(h, w + 400, 3)), (0, 0), 1.2)
    noise = np.clip(127 + 50 * noise / noise.std(), 0, 255).astype(np.float32)
    maps = [(x.astype(np.float32) + 100, v.astype(np.float32)) for x in (u, _source(plane, u, v))]
    first, second = (cv2.remap(noise, *m, cv2.INTER_CUBIC) for m in maps)
    return np.clip(first, 0, 255), np.clip(second, 0, 255)
