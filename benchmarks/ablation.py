"""The paper's ablation: the same training with and without the flow loss, several seeds each.

    python benchmarks/ablation.py --data train/ --test test/ [--steps 250] [--seeds 3] [--jobs 2]

Both arms get the same data, steps and settings. Every run has a folder of its own under ``--out``;
the same command again goes on where it stopped. The difference between the arms is a mean over
seeds and pairs, its interval a bootstrap over seeds and scenes.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import tyro
from _table import markdown

ARMS = {"with flow loss": "exact", "without": "none"}
FIGURES = ("pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg", "vertical_flow_px")


@dataclass(frozen=True)
class Options:
    """Trains and scores both arms."""

    data: Path
    """a set of simgen to train on"""
    test: Path
    """a set of simgen whose test frames are scored"""
    out: Path = Path("runs/ablation")
    steps: int = 250
    batch: int = 4
    seeds: int = 3
    jobs: int = 2
    """runs at a time, one thread each"""
    translation: str = "gt"
    """t of the prior in training and test: gt or nominal"""
    matching: float = 0.5
    """weight of matching supervision, in both arms; 0: the paper's two losses alone. It is drawn
    from exact flow, too, so with it the arm "without" lacks the flow loss but not flow"""


def scored(options: Options, teacher: str, seed: int) -> list[dict[str, str]]:
    """Trains one network, unless that was done before; the rows of every test pair."""
    settings = f"{options.steps}x{options.batch}-{options.matching:g}-{options.translation}"
    out = options.out / f"{options.data.name}-{teacher}-{seed}-{settings}"
    name, results = f"network={out / 'last.safetensors'}", out / f"on-{options.test.name}"
    scores = results / "scores.csv"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if not scores.exists():
        train = ["flowrect.train", "--preset", "small", "--data", options.data, "--out", out,
                 "--teacher", teacher, "--max-steps", options.steps, "--val-every", options.steps,
                 "--val-pairs", 12, "--loading.batch", options.batch, "--loading.workers", 0,
                 "--loading.seed", seed, "--loss.matching", options.matching,
                 "--translation", options.translation]  # fmt: skip
        test = ["flowrect.evaluate", "--data", options.test, "--methods", name, "--size", "512x256",
                "--translations", options.translation, "--matched-pairs", 0, "--out",
                results]  # fmt: skip
        for command in (train, test):
            subprocess.run([sys.executable, "-m", *map(str, command)], env=environment, check=True,
                           stdout=subprocess.DEVNULL)  # fmt: skip
    print(f"{teacher}, seed {seed}: done", flush=True)
    with scores.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["method"] == name]


def interval(
    values: np.ndarray, scenes: np.ndarray, *, rng: np.random.Generator, num: int = 2000
) -> tuple[float, float]:
    """95 % interval of the mean of values (seeds, pairs), drawing seeds and whole scenes."""
    _, scene = np.unique(scenes, return_inverse=True)
    counts = np.bincount(scene)
    sums = np.stack([np.bincount(scene, weights=v) for v in values])  # (seeds, scenes)
    means = []
    for _ in range(num):
        seeds = rng.integers(0, len(values), len(values))
        drawn = rng.integers(0, len(counts), len(counts))
        means.append(sums[seeds][:, drawn].mean(0).sum() / counts[drawn].sum())
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def main(options: Options) -> None:
    """Runs what is missing, and prints the table."""
    runs = list(product(ARMS.values(), range(options.seeds)))
    with ThreadPoolExecutor(options.jobs) as pool:
        records = dict(zip(runs, pool.map(lambda run: scored(options, *run), runs), strict=True))
    scenes = np.array([r["scene"] for r in records[runs[0]]])
    # (seeds, pairs, figures) of each arm
    found = {
        arm: np.array(
            [
                [[float(r[f]) for f in FIGURES] for r in records[teacher, s]]
                for s in range(options.seeds)
            ]
        )
        for arm, teacher in ARMS.items()
    }
    rows = [
        [arm, *(f"{v.mean():.3f} ({v.mean(1).min():.3f} to {v.mean(1).max():.3f})"
                for v in np.moveaxis(values, 2, 0))]
        for arm, values in found.items()
    ]  # fmt: skip
    difference = found["without"] - found["with flow loss"]
    cells = []
    for values in np.moveaxis(difference, 2, 0):
        low, high = interval(values, scenes, rng=np.random.default_rng(0))
        cells.append(f"{values.mean():+.3f} [{low:+.3f}, {high:+.3f}]")
    rows.append(["difference [95 %]", *cells])
    budget = f"{options.steps} steps of {options.batch}, {options.seeds} seeds"
    print(f"\n{len(scenes)} pairs, {budget}; mean (over seeds: smallest to largest)\n")
    print(markdown(["", *FIGURES], rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
