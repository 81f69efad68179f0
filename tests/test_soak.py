"""Hundreds of frames in one run: memory stays flat, workers are recycled (make test-slow)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

NUM_FRAMES = int(os.environ.get("SIMGEN_SOAK_FRAMES", "300"))
RECYCLE = 25
RENDER = [sys.executable, "-m", "simgen", "render", "--size", "160x90"]


@pytest.mark.slow
def test_memory_is_flat_over_hundreds_of_frames(tmp_path: Path) -> None:
    """Resident memory after every frame, from the first recycling on: within 5 % of its median."""
    _compile_all_kernels(tmp_path / "warm-up")
    render = subprocess.Popen(
        [*RENDER, "--n", str(3 * NUM_FRAMES), "--recycle", str(RECYCLE),
         "--workers", str(os.cpu_count()), "--out", str(tmp_path / "set")]
    )  # fmt: skip
    killed = _kill_a_worker(tmp_path / "set" / "render.jsonl", render)
    assert render.wait() == 0
    log = _frames(tmp_path / "set" / "render.jsonl")
    assert sorted(r["index"] for r in log) == list(range(NUM_FRAMES))

    of_worker: dict[int, list[float]] = {}
    for r in log:
        of_worker.setdefault(r["pid"], []).append(r["rss_bytes"] / 2**20)
    assert len(of_worker) >= NUM_FRAMES // RECYCLE
    later = list(of_worker.values())[os.cpu_count() :]
    for rss in later:
        print(f"{len(rss)} frames, {min(rss):.0f} to {max(rss):.0f} MiB, mean {np.mean(rss):.0f}")
    frames = np.concatenate(later)
    low, middle, high = np.min(frames), np.median(frames), np.max(frames)
    print(f"resident memory {low:.0f} … {middle:.0f} … {high:.0f} MiB; worker {killed} was killed")
    assert high / middle < 1.05
    assert low / middle > 0.95


def _compile_all_kernels(out: Path) -> None:
    """By day and night, dry and wet: compiling seems to leave a worker 50 MiB larger for good."""
    for daylight, weather in product(("noon", "night"), ("clear", "rain")):
        sky = ["--daylight", daylight, "--weather", weather]
        subprocess.run(
            [*RENDER, "--n", "6", *sky, "--out", f"{out}-{daylight}-{weather}"], check=True
        )


def _frames(path: Path) -> list[dict[str, Any]]:
    return [r for r in map(json.loads, path.read_text().splitlines()) if "seconds" in r]


def _kill_a_worker(log: Path, render: subprocess.Popen[bytes]) -> int:
    """Kills (-9) the worker that made the tenth frame, when that frame is done; its pid."""
    while render.poll() is None:
        if log.exists() and len(done := _frames(log)) >= 10:
            os.kill(done[9]["pid"], signal.SIGKILL)
            return int(done[9]["pid"])
        time.sleep(0.2)
    pytest.fail("the run ended before the tenth frame")
