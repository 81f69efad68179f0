"""What a set holds, in numbers: every frame measured on a grid of pixels, and the log of its run.

For the report, where a share to the nearest percent is enough; ``simgen validate`` reads all.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simgen.geometry import Array
from simgen.run import LOG
from simgen.schema import VISIBLE
from simgen.shards import Frame

DEPTH_EDGES_M: Array = np.geomspace(0.5, 20_000.0, 70)
FAR_M = (100.0, 300.0)
FLOW_EDGES_PX: Array = np.geomspace(0.1, 10_000.0, 76)
_GRID_WIDTH = 240
"""about so many pixels of a row are looked at"""

_FINISHED = {"index", "seconds", "rss_bytes", "pid", "host", "time"}
"""keys that the record of a finished frame has"""

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class Measured:
    """One frame: C cameras, P pairs."""

    index: int
    recipe: str
    daylight: str
    weather: str
    sun_elevation_deg: float
    perturbation_deg: Array
    """(C, 3)"""
    depth_range_m: tuple[float, float]
    """nearest and farthest surface of all cameras; NaN where there is none"""
    depth_counts: Counts
    """pixels of all cameras between DEPTH_EDGES_M, without the sky"""
    far_shares: Array
    """(2,) share of all pixels that show a surface beyond each of FAR_M"""
    flow_longest_px: Array
    """(P,)"""
    flow_counts: Counts
    """(P, bins) left pixels between FLOW_EDGES_PX"""
    overlap: Array
    """(P,) share of the left pixels that the right camera sees"""
    brightness: Array
    """(C,) mean of the image, 0 to 1"""
    label_counts: Counts
    """(256,) pixels of all cameras by label id"""
    num_instances: int
    """in view of any camera, if only by one pixel"""

    @property
    def stratum(self) -> tuple[str, str, str]:
        """What the frame was drawn from: recipe, daylight, weather."""
        return self.recipe, self.daylight, self.weather

    @property
    def num_classes(self) -> int:
        """Classes in view of any camera, the sky among them."""
        return int(np.count_nonzero(self.label_counts[1:]))


def measure(frame: Frame) -> Measured:
    """Measures a frame on a grid of its pixels."""
    spec, pairs = frame.spec, range(len(frame.pairs))
    images, depth = frame.image, frame.depth
    stride = max(1, depth.shape[2] // _GRID_WIDTH)
    grid = (slice(None), slice(stride // 2, None, stride), slice(stride // 2, None, stride))
    surfaces = depth[grid][depth[grid] > 0]
    lengths = [np.linalg.norm(frame.flow(p)[grid[1:]], axis=-1) for p in pairs]
    return Measured(
        index=int(frame.frame_index),
        recipe=spec["recipe"],
        daylight=spec["daylight"]["name"],
        weather=spec["weather"]["name"],
        sun_elevation_deg=float(spec["daylight"]["sun_elevation_deg"]),
        perturbation_deg=frame.perturbation_deg,
        depth_range_m=_range(surfaces),
        depth_counts=_histogram(surfaces, DEPTH_EDGES_M),
        far_shares=np.array([np.mean(depth[grid] > far) for far in FAR_M]),
        flow_longest_px=np.array([length.max() for length in lengths]),
        flow_counts=np.array([_histogram(length, FLOW_EDGES_PX) for length in lengths]),
        overlap=np.mean((frame.flow_status[grid] & VISIBLE) > 0, axis=(1, 2)),
        brightness=images[grid].mean(axis=(1, 2, 3)) / 255,
        label_counts=np.bincount(frame.semantic[grid].ravel(), minlength=256),
        num_instances=int(np.count_nonzero(np.bincount(frame.instance.ravel())[1:])),
    )


def _range(values: NDArray[np.floating]) -> tuple[float, float]:
    return (float(values.min()), float(values.max())) if values.size else (np.nan, np.nan)


def _histogram(values: NDArray[np.floating], edges: Array) -> Counts:
    """Counts; what lies beyond an end is in the last bin on that side."""
    return np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]


# --- the log of the run --------------------------------------------------------------------------


@dataclass(frozen=True)
class RunLog:
    """render.jsonl: what the set's frames took."""

    finished: Sequence[dict[str, Any]]
    """the last record of each finished frame, in the order of time"""
    num_unreadable: int
    """lines that are no JSON, since a run was ended while it wrote one, or not ours"""

    def stage_seconds(self) -> dict[str, Array]:
        """Seconds of every frame for each stage, in the order of the stages."""
        stages = dict.fromkeys(stage for record in self.finished for stage in record["seconds"])
        return {
            stage: np.array([record["seconds"].get(stage, 0.0) for record in self.finished])
            for stage in stages
        }


def read_log(folder: Path) -> RunLog:
    """Reads the log of a set; empty if the set was moved without it."""
    path = folder / LOG
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    records = [_record(line) for line in lines]
    finished = {r["index"]: r for r in records if r is not None and "seconds" in r}
    in_time = sorted(finished.values(), key=lambda r: float(r["time"]))
    return RunLog(in_time, sum(r is None for r in records))


def _record(line: str) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except ValueError:
        return None
    if not isinstance(value, dict) or ("seconds" in value and not value.keys() >= _FINISHED):
        return None
    return value
