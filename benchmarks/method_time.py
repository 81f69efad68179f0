"""Seconds per pair of every method, stage by stage (the paper's Table 3): one machine, one run.

    python benchmarks/method_time.py --data test/ [--methods network sift+5dof …] [--threads 2]

Batch 1, the same pairs for all, after a warm-up that is not counted. Median and 95th percentile.
The figures hold for the machine that is named, and for nothing else running on it.
"""

from __future__ import annotations

import platform
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from _table import markdown
from rich.progress import track

from flowrect.evaluate import wh_of
from flowrect.evaluation.delivered import Delivery, prior
from flowrect.methods import load_method
from flowrect.solvers import NoSolution
from simgen.errors import UserError


@dataclass(frozen=True)
class Options:
    """Times methods."""

    data: Path
    """a set of simgen"""
    methods: tuple[str, ...] = ("network", "sift+loransac", "sift+magsac", "sift+5dof",
                                "dis+5dof", "network+5dof")  # fmt: skip
    size: str = "1024x512"
    pairs: int = 12
    """that are timed, after one that is not"""
    threads: int = 0
    """of torch and OpenCV; 0: as they choose"""


def timed(name: str, options: Options) -> list[object]:
    """A row: median and 95th percentile of the whole, medians of the stages [s]."""
    method = load_method(name)
    pairs = Delivery(options.data, "test", wh_of(options.size), options.pairs + 1).open()
    whole, stages, failed = [], [], 0
    for i in track(range(len(pairs)), name):
        pair = pairs[i].input
        begin = time.perf_counter()
        try:
            estimate = method(pair.left, pair.right, pair.K_left, pair.K_right,
                              prior(pair, "nominal"))  # fmt: skip
        except NoSolution:
            failed += 1
            continue
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if i > 0:
            whole.append(time.perf_counter() - begin)
            stages.append(estimate.seconds)
    names = list(dict.fromkeys(k for s in stages for k in s))
    parts = ", ".join(f"{k} {np.median([s.get(k, 0) for s in stages]):.2f}" for k in names)
    return [name, float(np.median(whole)), float(np.percentile(whole, 95)), parts, failed]


def main(options: Options) -> None:
    """Prints the table."""
    if options.threads:
        torch.set_num_threads(options.threads)
        cv2.setNumThreads(options.threads)
    rows = []
    for name in options.methods:
        try:
            rows.append(timed(name, options))
        except UserError as error:
            print(f"{name} left out: {error}")
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else platform.processor()
    print(f"\n{options.size}, {device or platform.machine()}, torch {torch.get_num_threads()} and "
          f"OpenCV {cv2.getNumThreads()} threads\n")  # fmt: skip
    print(markdown(["method", "median [s]", "95 % [s]", "stages, median [s]", "failed"], rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
