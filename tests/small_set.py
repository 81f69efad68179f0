"""A set on disk without a renderer: cameras over an empty road, everything in closed form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from simgen.config import RenderOptions, resolve
from simgen.flowfield import flow_from_depth
from simgen.geometry import intrinsics, inverse, pixel_grid, rotation_from_vector, transform
from simgen.rendering import CONVENTIONS, UNITS
from simgen.run import LOG, split_of
from simgen.schema import AT_INFINITY, LABELS, OUT_OF_FRAME, SCHEMA_VERSION, VISIBLE
from simgen.shards import Manifest
from simgen.store import Source, assemble, write_frame

HW = (54, 96)
PAIRS = ((0, 1), (1, 2), (0, 2))
HEIGHT_M = 1.5
R_WORLD_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def make_frame(index: int, *, limit_deg: float = 1.0, hw: tuple[int, int] = HW) -> dict[str, Any]:
    """Three turned cameras 0.8 m apart that see a road (label 7) under the sky (label 23)."""
    rng = np.random.default_rng(index)
    K = np.tile(intrinsics((hw[1], hw[0]), 90.0), (3, 1, 1))
    drawn = rng.uniform(-limit_deg, limit_deg, (3, 3))
    centres = [[0.0, 0.8 - 0.8 * c, HEIGHT_M] for c in range(3)]
    nominal = np.stack([transform(R_WORLD_FORWARD, np.array(t)) for t in centres])
    T = nominal.copy()
    T[:, :3, :3] = [R_WORLD_FORWARD @ rotation_from_vector(np.deg2rad(a)) for a in drawn]
    depth = np.stack([_depth(K[c], T[c], hw) for c in range(3)])
    flow = np.stack([_flow(depth, K, T, a, b) for a, b in PAIRS])
    reverse = np.stack([_flow(depth, K, T, b, a) for a, b in PAIRS])
    return {
        "image": rng.integers(0, 256, (3, *hw, 3), dtype=np.uint8),
        "depth": depth,
        "semantic": np.where(depth > 0, LABELS["road"], LABELS["sky"]).astype(np.uint8),
        "instance": np.where(depth > 20, 5, 0).astype(np.uint16),
        "flow": flow,
        "flow_status": _status(flow, depth[[a for a, _ in PAIRS]]),
        "flow_status_reverse": _status(reverse, depth[[b for _, b in PAIRS]]),
        "K": K,
        "T_world_cam": T,
        "T_world_cam_nominal": nominal,
        "perturbation_deg": drawn,
        "frame_index": np.int64(index),
        "scene_index": np.int64(index),
        "spec": {
            "recipe": ("urban", "rural")[index % 2],
            "daylight": {"name": "noon", "sun_elevation_deg": 40.0 + index},
            "weather": {"name": "partly_cloudy"},
            "samples": {"spp": 2, "features_spp": 8, "max_depth": 4},
            "versions": {"mitsuba": "3.9.1", "simgen": "0.1.0"},
        },
    }


def _depth(K: np.ndarray, T: np.ndarray, hw: tuple[int, int]) -> np.ndarray:
    uv1 = np.concatenate([pixel_grid(hw), np.ones((*hw, 1))], axis=-1)
    down = -(uv1 @ np.linalg.inv(K).T @ T[:3, :3].T)[..., 2]
    return np.where(down > 1e-3, HEIGHT_M / np.maximum(down, 1e-3), 0).astype(np.float32)


def _flow(depth: np.ndarray, K: np.ndarray, T: np.ndarray, a: int, b: int) -> np.ndarray:
    return flow_from_depth(depth[a], K[a], K[b], inverse(T[b]) @ T[a])


def _status(flow: np.ndarray, depth: np.ndarray) -> np.ndarray:
    h, w = depth.shape[1:]
    uv = pixel_grid((h, w)) + flow
    inside = ((uv >= -0.5) & (uv < np.array([w, h]) - 0.5)).all(axis=-1)
    status = np.where(inside, VISIBLE, OUT_OF_FRAME) + AT_INFINITY * (depth == 0)
    return status.astype(np.uint8)


def write_set(
    folder: Path, frames: list[dict[str, Any]], *, flow: bool = True, **changes: Any
) -> Path:
    """Writes frames as a finished set; ``changes`` replace entries of the manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    options = RenderOptions(
        out=folder, n=3 * max(1, len(frames)), size=f"{HW[1]}x{HW[0]}", flow=flow
    )
    config = resolve(options, "llvm_ad_rgb").content()
    shards = []
    for split in ("train", "test"):
        chosen = [f for f in frames if split_of(int(f["scene_index"])) == split]
        sources = [_written(folder, f, flow) for f in chosen]
        if sources:
            shards.append(assemble(
                folder / f"{split}-00000.h5", sources, split=split, compression="gzip",
                attributes={"schema_version": SCHEMA_VERSION, "units": UNITS,
                            "conventions": CONVENTIONS},
            ))  # fmt: skip
    entries = {"shards": shards, **changes}
    Manifest(SCHEMA_VERSION, 0, "0.1.0", config, 16, 3 * len(frames), **entries).save(folder)
    (folder / LOG).write_text("".join(_log_line(int(f["frame_index"])) for f in frames))
    return folder


def _written(folder: Path, frame: dict[str, Any], flow: bool) -> Source:
    path = folder / f"one-{int(frame['frame_index'])}.h5"
    kept = {k: v for k, v in frame.items() if flow or k != "flow"}
    return Source(path, 0, write_frame(path, kept, pairs=PAIRS, compression="gzip"))


def _log_line(index: int) -> str:
    seconds = {"build": 1.0 + index, "path": 2.0}
    record = {"index": index, "attempt": 0, "seconds": seconds, "rss_bytes": 10**9,
              "pid": 1, "host": "here", "time": float(index)}  # fmt: skip
    return json.dumps(record) + "\n"
