"""Validation on a scene in closed form: everything passes, and each corruption fails its check."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simgen import schema
from simgen.errors import UserError
from simgen.validate import Finding, Report, check_frame, validate_folder

Frame = dict[str, Any]
PAIRS = np.array([[0, 1], [1, 2], [0, 2]], np.uint8)
R_WORLD_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a camera looking along world x


@dataclass(frozen=True)
class Quad:
    """A textured rectangle: corner, two orthogonal edges, ids."""

    corner: tuple[float, float, float]
    edges: tuple[tuple[float, float, float], tuple[float, float, float]]
    semantic: int
    instance: int

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ray parameters (N,), infinite where missed, and positions (N, 2) on the edges [m]."""
        e = np.array(self.edges)
        normal = np.cross(*e)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((np.array(self.corner) - origin) @ normal) / (rays @ normal)
            st = (origin + t[:, None] * rays - self.corner) @ e.T
            size2 = (e**2).sum(axis=1)
            inside = (t > 1e-9) & (st >= 0).all(axis=1) & (st <= size2).all(axis=1)
        return np.where(inside, t, np.inf), st / np.sqrt(size2)


SCENE = (
    Quad((-5, -30, 0), ((60, 0, 0), (0, 60, 0)), schema.LABELS["road"], 0),
    Quad((14, 16, 0), ((8, -22, 0), (0, 0, 7)), schema.LABELS["building"], 7),  # slanted wall
    Quad((7, -2.0, 0.2), ((0, 1.9, 0), (0, 0, 1.8)), schema.LABELS["car"], 300),  # nearer
)


def texture(st: np.ndarray, seed: int) -> np.ndarray:
    """A smooth albedo: sines of several wavelengths, directions and phases."""
    rng = np.random.default_rng(seed)
    value = np.full(len(st), 0.5)
    for wavelength in np.geomspace(0.25, 3.0, 12):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        value += 0.08 * np.sin(st @ [np.cos(angle), np.sin(angle)] * 2 * np.pi / wavelength + phase)
    return value


def trace(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest ray parameter (N,), index of the surface (N,), −1 for the sky, and albedo (N,)."""
    hits = [q.hit(origin, rays) for q in SCENE]
    t = np.stack([h[0] for h in hits])
    which = np.where(np.isinf(t).all(axis=0), -1, t.argmin(axis=0))
    albedo = np.full(len(rays), 0.85)
    for k, (_, st) in enumerate(hits):
        albedo[which == k] = texture(st[which == k], seed=k)
    return t.min(axis=0), which, albedo


def rays_of(K: np.ndarray, T: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """World rays whose parameter is z-depth."""
    return np.column_stack([(uv - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(uv))]) @ T[:3, :3].T


def pixels(hw: tuple[int, int], du: float = 0.0, dv: float = 0.0) -> np.ndarray:
    v, u = np.mgrid[: hw[0], : hw[1]]
    return np.column_stack([u.ravel() + du, v.ravel() + dv])


def photograph(K: np.ndarray, T: np.ndarray, hw: tuple[int, int], du: float = 0.0,
               dv: float = 0.0) -> np.ndarray:  # fmt: skip
    """An image (H, W, 3), averaged over each pixel; (du, dv) moves the pixel centres."""
    offsets = (np.arange(4) + 0.5) / 4 - 0.5
    total = sum(
        trace(T[:3, 3], rays_of(K, T, pixels(hw, du + a, dv + b)))[2]
        for a in offsets
        for b in offsets
    )
    grey = (total / 16 * 255).clip(0, 255).round().astype(np.uint8)
    return np.repeat(grey.reshape(*hw, 1), 3, axis=2)


def flow_and_status(frame: Frame, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) and status (H, W) of camera a's pixels in camera b, by tracing."""
    hw = frame["depth"].shape[1:]
    K, T, uv = frame["K"], frame["T_world_cam"], pixels(hw)
    rays = rays_of(K[a], T[a], uv)
    depth = frame["depth"][a].ravel().astype(np.float64)
    to_point = np.where(
        depth[:, None] > 0, T[a, :3, 3] + depth[:, None] * rays - T[b, :3, 3], rays
    )
    uvw = to_point @ T[b, :3, :3] @ K[b].T
    end = uvw[:, :2] / uvw[:, 2:]
    reach = np.where(depth > 0, 1 - 1e-6, np.inf)
    blocked = trace(T[b, :3, 3], to_point)[0] < reach
    inside = ((end >= -0.5) & (end < np.array(hw[::-1]) - 0.5)).all(axis=1) & (uvw[:, 2] > 0)
    status = np.select([~inside, blocked], [schema.OUT_OF_FRAME, schema.OCCLUDED], schema.VISIBLE)
    status = status + schema.AT_INFINITY * (depth == 0)
    return (end - uv).reshape(*hw, 2).astype(np.float32), status.reshape(hw).astype(np.uint8)


def add_flow(frame: Frame) -> Frame:
    """Flow and status that belong to the frame's own depth, K and poses."""
    forward = [flow_and_status(frame, a, b) for a, b in PAIRS]
    frame["flow"] = np.stack([flow for flow, _ in forward])
    frame["flow_status"] = np.stack([status for _, status in forward])
    frame["flow_status_reverse"] = np.stack([flow_and_status(frame, b, a)[1] for a, b in PAIRS])
    return frame


def make_frame(hw: tuple[int, int] = (180, 320), index: int = 1, seed: int = 5) -> Frame:
    """Three turned cameras on a yawed rig, 0.8 m apart, 1.6 m above the road."""
    rng = np.random.default_rng(seed)
    f = hw[1] / 2
    K = np.array([[f, 0, (hw[1] - 1) / 2], [0, f, (hw[0] - 1) / 2], [0, 0, 1]])
    R_yaw = Rotation.from_euler("z", 6, degrees=True).as_matrix()
    nominal = np.tile(np.eye(4), (3, 1, 1))
    nominal[:, :3, :3] = R_yaw @ R_WORLD_FORWARD
    nominal[:, :3, 3] = [R_yaw @ [0, 0.8 - 0.8 * c, 1.6] for c in range(3)]
    drawn = rng.uniform(-1, 1, (3, 3))
    true = nominal.copy()
    true[:, :3, :3] = nominal[:, :3, :3] @ Rotation.from_rotvec(drawn, degrees=True).as_matrix()
    frame: Frame = {
        "K": np.tile(K, (3, 1, 1)),
        "T_world_cam": true,
        "T_world_cam_nominal": nominal,
        "perturbation_deg": drawn,
        "frame_index": np.int64(index),
        "scene_index": np.int64(index),
        "spec": {"rig": {"perturbation_deg": 1.0}, "daylight": {"name": "noon"}},
        "image": np.stack([photograph(K, T, hw) for T in true]),
    }
    return add_flow(add_surfaces(frame, hw))


def add_surfaces(frame: Frame, hw: tuple[int, int]) -> Frame:
    hits = [
        trace(T[:3, 3], rays_of(K, T, pixels(hw)))
        for K, T in zip(frame["K"], frame["T_world_cam"], strict=True)
    ]
    which = np.stack([h[1] for h in hits]).reshape(-1, *hw)
    depth = np.stack([h[0] for h in hits]).reshape(-1, *hw)
    frame["depth"] = np.where(which < 0, 0, depth).astype(np.float32)
    labels = np.array([q.semantic for q in SCENE] + [schema.LABELS["sky"]], np.uint8)
    frame["semantic"] = labels[which]
    frame["instance"] = np.array([q.instance for q in SCENE] + [0], np.uint16)[which]
    return frame
