"""Images of dots whose places are known, and where the dots are found again."""

from __future__ import annotations

from functools import cache

import numpy as np

from flowrect.correspondences import Correspondences
from flowrect.sample import Image, Pair
from simgen.geometry import Array, project, rotation_from_vector, transform, unproject

WH = (640, 360)
SIGMA = 3.0
K_LEFT = np.array([[330.0, 0, 325.3], [0, 322.0, 177.1], [0, 0, 1]])
K_RIGHT = np.array([[318.0, 0, 311.8], [0, 325.0, 184.6], [0, 0, 1]])


def dots(wh: tuple[int, int], uv: Array, sigma: float = SIGMA) -> Image:
    """White Gaussian dots on black, centred at ``uv`` (N, 2) in the pixel-centre convention."""
    u, v = np.arange(wh[0]), np.arange(wh[1])
    along_u = np.exp(-0.5 * ((u - uv[:, :1]) / sigma) ** 2)
    along_v = np.exp(-0.5 * ((v - uv[:, 1:]) / sigma) ** 2)
    grey = np.clip(240 * np.einsum("nv,nu->vu", along_v, along_u), 0, 255)
    return np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=-1)


def centroids(image: Image, uv: Array, radius: int) -> Array:
    """Centre of mass (N, 2) of the light around each ``uv``; the windows must lie inside."""
    found = []
    for u0, v0 in np.round(uv).astype(int):
        window = image[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1, 1].astype(
            float
        )
        window -= window.min()
        span = np.arange(-radius, radius + 1)
        mass = window.sum()
        found.append([u0 + (window.sum(0) @ span) / mass, v0 + (window.sum(1) @ span) / mass])
    return np.array(found)


def away_from_border(uv: Array, wh: tuple[int, int], margin: float) -> np.ndarray:
    """True (N,) where a dot of this radius is whole."""
    return np.all((uv > margin) & (uv < np.array(wh) - 1 - margin), axis=1)


def grid_points(K: Array, wh: tuple[int, int], rng: np.random.Generator) -> Array:
    """Points (N, 3) in a camera's frame, about 60 px apart, 20 to 60 m away."""
    u, v = np.meshgrid(np.arange(20, wh[0], 60.0), np.arange(15, wh[1], 55.0))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2) + rng.uniform(-5, 5, (u.size, 2))
    return unproject(K, uv, rng.uniform(20, 60, len(uv)))


@cache
def painted_pair(seed: int = 0, turn_deg: float = 1.0, *, vertical: bool = False) -> Pair:
    """Dots at known points, seen by two different cameras that are turned at random.

    The left camera comes first, or the upper one of a vertical rig.
    """
    rng = np.random.default_rng(seed)
    turns = [rotation_from_vector(np.deg2rad(rng.uniform(-1, 1, 3) * turn_deg)) for _ in "lr"]
    t = [0.02, -0.8, 0.05] if vertical else [-0.8, 0.02, 0.05]
    nominal = transform(rotation_from_vector(np.array([0.004, -0.01, 0.006])), t)
    zero = np.zeros(3)
    T = transform(turns[1].T, zero) @ nominal @ transform(turns[0], zero)
    left = grid_points(K_LEFT, WH, rng)
    right = left @ T[:3, :3].T + T[:3, 3]
    yes = np.ones(len(left), dtype=bool)
    return Pair(
        left=dots(WH, project(K_LEFT, left)),
        right=dots(WH, project(K_RIGHT, right)),
        K_left=K_LEFT,
        K_right=K_RIGHT,
        T_right_left=T,
        T_right_left_nominal=nominal,
        turn_left=turns[0],
        turn_right=turns[1],
        truth=Correspondences(left / left[:, 2:], right / right[:, 2:], yes, yes, left[:, 2]),
        name=f"painted {seed}",
    )
