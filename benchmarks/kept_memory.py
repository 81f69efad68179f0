"""What it is worth on a CPU that freed memory is kept (``flowrect/memory.py``).

    python benchmarks/kept_memory.py --data test/ [--size 1024x512] [--threads 2]

A training step of the small preset (8 pairs), and methods on one pair, with and without, each in a
process of its own, in turn: medians, and their ratio; and the peak of the process's memory.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from _table import markdown

from flowrect.evaluation.delivered import Delivery, prior, wh_of
from flowrect.losses import rotation_loss
from flowrect.matchers import load_matcher
from flowrect.memory import keep_freed_memory
from flowrect.methods import load_method
from flowrect.sample import collate
from flowrect.weights import find_weights, load_weights

BATCH = 8
PEAK = "peak of the whole [GiB]"


@dataclass(frozen=True)
class Options:
    """Times the same with memory kept and given back."""

    data: Path
    """a set of simgen"""
    size: str = "1024x512"
    """of the pair that matchers and methods see"""
    threads: int = 2
    repeats: int = 5
    """of which the median is taken, after one that is not counted"""
    rounds: int = 2
    """of both, in turn"""
    only: str = ""
    """kept or given-back: the figures of one process, as JSON"""


def training_step(data: Path) -> Callable[[], object]:
    """Forward, the rotation's loss, backward, and Adam's update."""
    pairs = Delivery(data, "all", (256, 128), BATCH).open()
    batch = collate([pairs[i] for i in range(BATCH)])
    network, _ = load_weights(find_weights("small"))
    network.train().requires_grad_(True)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-6)

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        found = network(batch.left, batch.right, batch.K_left, batch.K_right, batch.R_nominal,
                        batch.t_nominal)  # fmt: skip
        rotation_loss(batch.R, found.R).backward()
        optimiser.step()

    return step


def tasks(options: Options) -> dict[str, Callable[[], object]]:
    """What is timed."""
    pair = Delivery(options.data, "all", wh_of(options.size), 1).open()[0].input
    images, start = (pair.left, pair.right), prior(pair, "nominal")
    found = {f"{m}, matching": lambda m=m: load_matcher(m)(*images) for m in ("aliked", "raft")}
    for name in ("network", "dis+5dof"):
        method = load_method(name)
        found[name] = lambda f=method: f(*images, pair.K_left, pair.K_right, start)
    found = {"training step": training_step(options.data), **found}
    return {f"{name} [s]": task for name, task in found.items()}


def median_seconds(task: Callable[[], object], repeats: int) -> float:
    """Of one call, after the first."""
    task()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        task()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def in_a_process(which: str) -> dict[str, float]:
    """Seconds of every task and the peak, with memory kept or given back."""
    command = [sys.executable, *sys.argv, "--only", which]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main(options: Options) -> None:
    """Prints the table."""
    if options.only:
        torch.set_num_threads(options.threads)
        if options.only == "kept" and not keep_freed_memory():
            sys.exit("This C library is not glibc: nothing can be kept.")
        seconds = {n: median_seconds(t, options.repeats) for n, t in tasks(options).items()}
        peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(json.dumps({**seconds, PEAK: peak_gib}))
        return
    kinds = ("given-back", "kept")
    found = {kind: [] for kind in kinds}
    for _ in range(options.rounds):
        for kind in kinds:
            found[kind].append(in_a_process(kind))
    rows = []
    for name in found["kept"][0]:
        before, after = (float(np.median([x[name] for x in found[kind]])) for kind in kinds)
        rows.append([name, f"{before:.3f}", f"{after:.3f}", f"{after / before:.2f}"])
    print(markdown(("", "given back", "kept", "ratio"), rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
