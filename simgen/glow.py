"""The light of faces that burn, as it reaches a camera; the lens makes glare of it, fog halos.

Lamps are small: what a pixel sees of them is found with several rays of its own, and only where a
glowing face can be.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simgen.atmosphere import transmittance
from simgen.geometry import Array
from simgen.groundtruth import trace
from simgen.rig import Camera
from simgen.scene import Scene

Image = NDArray[Any]
"""float32"""

OFFSETS_PX = (np.array([[-3, 1], [-1, -3], [1, 3], [3, -1]]) / 8.0).tolist()
"""(u, v) of the rays of a pixel: one in each row and column of a 4 × 4 grid"""


def emitted(scene: Scene, camera: Camera, visibility_m: float) -> Image:
    """Radiance (H, W, 3) that glowing faces send through the air into the camera."""
    w, h = camera.wh
    light = np.zeros((h, w, 3), dtype=np.float32)
    if not len(scene.glow.face):
        return light
    v, u = np.nonzero(_possible(scene, camera))
    for offset in OFFSETS_PX:
        uv1 = np.stack([u + offset[0], v + offset[1], np.ones(len(u))])
        rays = camera.T_world_cam[:3, :3] @ np.linalg.inv(camera.K) @ uv1
        light[v, u] += _seen(scene, camera, rays, visibility_m) / np.float32(len(OFFSETS_PX))
    return light


def _seen(scene: Scene, camera: Camera, rays: Array, visibility_m: float) -> Image:
    """What arrives (N, 3) along rays (3, N) of any length."""
    unit = rays / np.linalg.norm(rays, axis=0)
    face = trace(scene, camera.centre, unit.astype(np.float32))
    index = np.minimum(np.searchsorted(scene.glow.face, face), len(scene.glow.face) - 1)
    glows = scene.glow.face[index] == face
    distance = np.linalg.norm(scene.glow.corners.mean(axis=1) - camera.centre, axis=1)
    arriving = scene.glow.radiance * transmittance(distance, visibility_m)[:, None]
    return arriving[index] * glows[:, None]


def _possible(scene: Scene, camera: Camera) -> NDArray[np.uint8]:
    """Pixels (H, W) that a glowing face may reach."""
    w, h = camera.wh
    pixels = np.zeros((h, w), dtype=np.uint8)
    T = camera.K @ camera.T_cam_world[:3]
    uvw = scene.glow.corners @ T[:, :3].T + T[:, 3]
    uvw = uvw[(uvw[..., 2] > 0.1).all(axis=1)]
    uv = uvw[..., :2] / uvw[..., 2:]
    near = ((uv > -w) & (uv < 2 * w)).all(axis=(1, 2))
    triangles = np.round(uv[near]).astype(np.int32)
    cv2.polylines(pixels, list(triangles), True, 1, thickness=3)
    for triangle in triangles:
        cv2.fillConvexPoly(pixels, triangle, 1)
    return pixels
