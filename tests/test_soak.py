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
    """Within 5 % between the worker generations after the first."""
    command = [sys.executable, "-m", "simgen", "render", "--n", str(3 * NUM_FRAMES), "--size",
               "160x90", "--recycle", str(RECYCLE), "--out", str(tmp_path / "set")]  # fmt: skip
    subprocess.run(command, check=True)
    lines = (tmp_path / "set" / "render.jsonl").read_text().splitlines()
    log = [r for r in map(json.loads, lines) if "seconds" in r]
    assert len(log) == NUM_FRAMES
    workers = list(dict.fromkeys(r["pid"] for r in log))
    assert len(workers) >= NUM_FRAMES // RECYCLE
    peaks = [max(r["rss_bytes"] for r in log if r["pid"] == pid) for pid in workers]
    later = np.array(peaks[1:]) / 2**20
    print(f"peak resident memory of the workers [MiB]: {np.round(later).tolist()}")
    assert later.max() / np.median(later) < 1.05
