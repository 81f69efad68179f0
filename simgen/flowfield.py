"""The one formula of flow: depth, intrinsics and poses of a pair to (du, dv) on the left pixels.

With H = K_right R K_left⁻¹ and e = K_right t (R, t of T_right_left), a left pixel x = (u, v, 1) at
depth z is seen in the right camera at ``x' ~ H x + e / z``. A point at infinity has 1 / z = 0 and
moves by H alone. The generator stores this function's result and the reader of a set without
stored flow calls it, so both hold the same bits.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from simgen.geometry import Array, infinite_homography

NUM_THREADS = min(4, os.cpu_count() or 1)  # beyond four, memory bandwidth is the limit
_BLOCK_PIXELS = 1 << 14  # the float64 temporaries of a block stay in the cache


def flow_from_depth(
    depth: NDArray[np.float32], K_left: Array, K_right: Array, T_right_left: Array
) -> NDArray[np.float32]:
    """Flow (H, W, 2) [px] with ``uv_right = uv_left + flow``, computed in float64.

    Args:
      depth: (H, W) z in the left camera [m]; 0 where there is no surface, taken as infinite.
      K_left, K_right: (3, 3) [px], pixel-centre convention.
      T_right_left: (4, 4), left camera frame to right camera frame.

    A point that is not in front of the right camera (z' ≤ 0) has no image there: its flow is 0.
    """
    H = infinite_homography(K_left, K_right, T_right_left[:3, :3])
    e = K_right @ T_right_left[:3, 3]
    flow = np.empty((*depth.shape, 2), np.float32)
    rows = max(1, _BLOCK_PIXELS // depth.shape[1])

    def fill(top: int) -> None:
        _fill_rows(flow[top : top + rows], depth[top : top + rows], top, H, e)

    with ThreadPoolExecutor(NUM_THREADS) as pool:
        list(pool.map(fill, range(0, len(depth), rows)))
    return flow


def _fill_rows(
    flow: NDArray[np.float32], depth: NDArray[np.float32], top: int, H: Array, e: Array
) -> None:
    """Writes the flow of the image rows from ``top`` on into ``flow``."""
    z = depth.astype(np.float64)
    inverse_z = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
    u = np.arange(depth.shape[1], dtype=np.float64)
    v = np.arange(top, top + len(depth), dtype=np.float64)[:, None]

    def component(i: int) -> Array:
        return inverse_z * e[i] + (H[i, 0] * u + (H[i, 1] * v + H[i, 2]))

    scale = component(2)  # z' / z, or the sign of z' for a point at infinity
    in_front = scale > 0
    scale[~in_front] = 1.0
    flow[..., 0] = np.where(in_front, component(0) / scale - u, 0.0)
    flow[..., 1] = np.where(in_front, component(1) / scale - v, 0.0)
