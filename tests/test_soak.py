"""Hundreds of frames in one run: memory stays flat, workers are recycled (make test-slow)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

NUM_FRAMES = int(os.environ.get("SIMGEN_SOAK_FRAMES", "300"))
RECYCLE = 25


@pytest.mark.slow
def test_memory_is_flat_over_hundreds_of_frames(tmp_path: Path) -> None:
    """Resident memory after every frame, from the first recycling on: within 5 % of its median."""
    command = [sys.executable, "-m", "simgen", "render", "--n", str(3 * NUM_FRAMES), "--size",
               "160x90", "--recycle", str(RECYCLE), "--workers", str(os.cpu_count()),
               "--out", str(tmp_path / "set")]  # fmt: skip
    subprocess.run(command, check=True)
    lines = (tmp_path / "set" / "render.jsonl").read_text().splitlines()
    log = [r for r in map(json.loads, lines) if "seconds" in r]
    assert len(log) == NUM_FRAMES
    workers = list(dict.fromkeys(r["pid"] for r in log))
    assert len(workers) >= NUM_FRAMES // RECYCLE
    first = workers[: os.cpu_count()]
    later = np.array([r["rss_bytes"] for r in log if r["pid"] not in first]) / 2**20
    low, middle, high = np.min(later), np.median(later), np.max(later)
    print(f"{len(workers)} workers, resident memory {low:.0f} … {middle:.0f} … {high:.0f} MiB")
    assert high / middle < 1.05
    assert low / middle > 0.95
