"""Seconds per pair of every method, stage by stage (the paper's Table 3): one machine, one run.

    python benchmarks/method_time.py --data test/ [--methods network sift+5dof …] [--threads 2]

Batch 1, the same pairs for all, after a warm-up that is not counted. Median and 95th percentile
over all pairs, those for which a method fails included. Methods run in a process of their own,
which begins with the number of threads that torch, OpenCV, NumPy and SciPy may use. The table goes
to OUT/times.csv and OUT/times.md. It holds for the machine that is named, and for nothing else
running on it.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
import tyro
from _table import markdown, write_csv
from rich.progress import track

from flowrect.evaluation.delivered import Delivery, prior, wh_of
from flowrect.evaluation.seconds import by_stage, spread
from flowrect.files import make_folder
from flowrect.matchers import load_matcher
from flowrect.memory import keep_freed_memory
from flowrect.methods import TABLE, FromMatches, Method, load_method
from flowrect.sample import Pair
from flowrect.solvers import NoSolution
from simgen.errors import UserError

HEADER = ("method", "median / 95 % [s]", "stages", "pairs", "failed")
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""read once, when NumPy, SciPy and torch are imported"""


@dataclass(frozen=True)
class Options:
    """Times methods."""

    data: Path
    """a set of simgen"""
    methods: tuple[str, ...] = TABLE
    """all rows of the tables, which match every pair anew; those without weights are left out"""
    size: str = "1024x512"
    pairs: int = 20
    """that are timed, after one that is not"""
    threads: int = 0
    """of torch, OpenCV, NumPy and SciPy; 0: as they choose"""
    out: Path = Path("results")
    """folder for times.csv and times.md"""


@dataclass(frozen=True)
class Timing:
    """What a pair took."""

    seconds: float
    stages: dict[str, float]
    """[s]; none where the method raised"""
    failed: bool


def timed(name: str, options: Options) -> list[Timing]:
    """Of each pair, without the first one."""
    keep_freed_memory()  # as the commands do
    if options.threads:
        torch.set_num_threads(options.threads)
        cv2.setNumThreads(options.threads)
    method = load_method(name)
    if isinstance(method, FromMatches):
        load_matcher(method.matcher)  # says now if its weights are missing
    pairs = Delivery(options.data, "test", wh_of(options.size), options.pairs + 1).open()
    return [once(method, pairs[i].input) for i in track(range(len(pairs)), name)][1:]


def once(method: Method, pair: Pair) -> Timing:
    """One pair, from images to pose."""
    start, begin = prior(pair, "nominal"), time.perf_counter()
    try:
        stages = method(pair.left, pair.right, pair.K_left, pair.K_right, start).seconds
        failed = False
    except NoSolution as error:
        stages, failed = error.seconds, True
    except Exception as error:  # a failure of this pair; the others are timed all the same
        print(f"{pair.name}: {type(error).__name__}: {error}")
        stages, failed = {}, True
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return Timing(time.perf_counter() - begin, stages, failed)


def row(name: str, timings: Sequence[Timing]) -> list[object]:
    """Median and 95th percentile of the whole, and of the stages of pairs that it solved."""
    stages = by_stage([t.stages for t in timings if not t.failed])
    return [name, spread([t.seconds for t in timings]), stages, len(timings),
            sum(t.failed for t in timings)]  # fmt: skip


def main(options: Options) -> None:
    """Prints the table, and writes it after each method."""
    make_folder(options.out)
    os.environ.update(dict.fromkeys(POOLS, str(options.threads)) if options.threads else {})
    rows = []
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for name in options.methods:
            try:
                rows.append(row(name, pool.apply(timed, (name, options))))
            except UserError as error:
                print(f"{name} left out: {error}")
            text = f"{_conditions(options)}\n\n{markdown(HEADER, rows)}\n"
            (options.out / "times.md").write_text(text, encoding="utf-8")
            write_csv(options.out / "times.csv", HEADER, rows)
    print(f"\n{text}")


def _conditions(options: Options) -> str:
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else platform.processor()
    threads = f"{options.threads} threads" if options.threads else "threads as libraries choose"
    return (
        f"{options.size}, one pair at a time after one that is not counted, "
        f"{device or platform.machine()} of {os.cpu_count()} cores, {threads}."
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
