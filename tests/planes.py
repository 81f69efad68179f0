"""Pairs of textured planes in closed form: rectified ones, and one plane seen by a turned rig."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flowrect.correspondences import Correspondences
from flowrect.sample import Image, Pair
from simgen.geometry import transform

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


# --- a rig in front of one plane ---------------------------------------------------------------

WH = (192, 96)
K = np.array([[96.0, 0, 95.5], [0, 96.0, 47.5], [0, 0, 1]])
BASELINE_M = 1.5


def turned(x: float = 0, y: float = 0, z: float = 0) -> torch.Tensor:
    """(1, 3, 3) of a rotation vector [°]."""
    return torch.from_numpy(Rotation.from_rotvec([x, y, z], degrees=True).as_matrix())[None]


def along_x() -> torch.Tensor:
    return torch.tensor([[-BASELINE_M, 0.0, 0.0]], dtype=torch.float64)


def plane_truth(normal: np.ndarray, R: torch.Tensor, t: torch.Tensor) -> Correspondences:
    """All left pixels of a plane n·X = 1 of the left camera frame."""
    u, v = np.meshgrid(np.arange(WH[0]), np.arange(WH[1]))
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(K).T
    depth = 1 / (rays @ normal)
    X_right = (rays * depth[:, None]) @ R[0].numpy().T + t[0].numpy()
    seen = np.ones(len(rays), bool)
    return Correspondences(rays, X_right / X_right[:, 2:], seen, seen, depth)


def plane_pair(R: torch.Tensor, t: torch.Tensor, normal: np.ndarray) -> Pair:
    """A textured plane n·X = 1 seen by two cameras."""
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(200, 400, 3)), (0, 0), 1.2)
    canvas = np.clip(127 + 50 * noise / noise.std(), 0, 255).astype(np.uint8)
    K_canvas = K + np.array(
        [[0, 0, 100], [0, 0, 50], [0, 0, 0]]
    )  # a wider view from the left camera
    to_right = K @ (R[0].numpy() + np.outer(t[0].numpy(), normal)) @ np.linalg.inv(K_canvas)
    left = canvas[50 : 50 + WH[1], 100 : 100 + WH[0]].copy()
    right = cv2.warpPerspective(canvas, to_right, WH, flags=cv2.INTER_CUBIC)
    T = transform(R[0].numpy(), t[0].numpy())
    return Pair(left, right, K, K, T, T, truth=plane_truth(normal, R, t), name="plane")
