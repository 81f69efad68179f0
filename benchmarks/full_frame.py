"""Seconds per stage of full-size rig frames, peak memory, and kernels compiled, in one process.

    python benchmarks/full_frame.py [--frames 4] [--size 2560x1440] [--weather rain]

Prints a table to compare with the bar: at most 60 s per rig frame on two cores after the first
frame, at most 12 s of it neither path tracing (with its first-hit features) nor denoising, at most
6 GiB. Kernels are counted by Dr.Jit's own history: "new" are those that no earlier frame used, by
their hashes; "compiled" are neither in memory nor on disk, so that none is once a machine has
rendered such frames.
"""

from __future__ import annotations

import platform
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import psutil
import tyro

from simgen import engine
from simgen.checks import check_frame
from simgen.config import RenderOptions, resolve
from simgen.produce import make_frame, start
from simgen.store import write_frame

TRACED = ("path", "features", "denoise")


@dataclass(frozen=True)
class Options:
    """Full-size frames, stage by stage."""

    frames: int = 4
    """rig frames; the first one is not counted in the mean"""
    size: str = "2560x1440"
    recipes: str = ""
    """comma-separated names; all if not given"""
    seed: int = 0
    weather: str = "clear,partly_cloudy,overcast"
    """presets; wet ground (rain, after_rain) is another structure, so other kernels"""
    daylight: str = "morning,noon,afternoon"
    """presets; below the horizon (night, some of dawn and dusk) lamps are another structure"""
    spp: int = RenderOptions(n=1).spp


def main(options: Options) -> None:
    """Renders the frames and prints the table."""
    chosen = engine.choose()
    job = resolve(
        RenderOptions(n=1, size=options.size, recipes=options.recipes, seed=options.seed,
                      spp=options.spp, weather=options.weather, daylight=options.daylight),
        chosen.variant,
    )  # fmt: skip
    start(chosen, psutil.cpu_count(), job.wh)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    rows: list[dict[str, float]] = []
    used: set[int] = set()
    with tempfile.TemporaryDirectory() as folder:
        for index in range(options.frames):
            began = time.perf_counter()
            frame, seconds = make_frame(job, index, attempt=0)
            pairs = np.array(job.rig.pairs, dtype=np.uint8)
            lap = time.perf_counter()
            check_frame(frame, pairs, thorough=False)
            seconds["check"] = time.perf_counter() - lap
            lap = time.perf_counter()
            write_frame(Path(folder) / "f.h5", frame, pairs=job.rig.pairs, compression="gzip")
            seconds["write"] = time.perf_counter() - lap
            seconds["total"] = time.perf_counter() - began
            seconds["other than tracing"] = seconds["total"] - sum(seconds[k] for k in TRACED)
            kernels = [k for k in dr.kernel_history() if "hash" in k]
            seconds["new kernels"] = len(_hashes(kernels) - used)
            seconds["compiled kernels"] = _num_compiled(kernels)
            used |= _hashes(kernels)
            print(f"frame {index}: {frame['spec']['recipe']}, {seconds['total']:.1f} s", flush=True)
            rows.append(seconds)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    machine = f"{platform.machine()}, {dr.thread_count()} threads, {chosen.variant}"
    print(f"\n{machine}, {options.size}, {options.spp} spp, peak memory {peak:.2f} GiB\n")
    titles = [f"frame {i}" for i in range(len(rows))] + ["mean 1…"]
    print(f"{'stage':20}" + "".join(f"{title:>10}" for title in titles))
    for stage in rows[0]:
        values = [r.get(stage, 0.0) for r in rows]
        mean = np.mean(values[1:]) if len(values) > 1 else np.nan
        print(f"{stage:20}" + "".join(f"{v:10.1f}" for v in values) + f"{mean:10.1f}")


def _hashes(kernels: list[dict[str, Any]]) -> set[int]:
    return {k["hash"] for k in kernels}


def _num_compiled(kernels: list[dict[str, Any]]) -> int:
    return sum(not k["cache_hit"] and not k["cache_disk"] for k in kernels)


if __name__ == "__main__":
    main(tyro.cli(Options))
