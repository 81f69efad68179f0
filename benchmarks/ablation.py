"""Ablations of `small`: the same training in several arms, several seeds each.

    python benchmarks/ablation.py --data train/ --test test/ [--steps 250] [--seeds 3] [--jobs 2]
    python benchmarks/ablation.py --data train/ --test test/ --arms "with flow loss" \\
        "without matching" "conv3d decoder" "without matching, conv3d decoder"

The first is the paper's, with and without the flow loss; the second takes away what `small` has
beyond the paper. All arms get the same data, steps and seeds. Every run has a folder of its own
under ``--out``; the same command again goes on where it stopped. Each arm's difference from the
first one is a mean over seeds and pairs, its interval a bootstrap over seeds and scenes.
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
from typing import Literal

import numpy as np
import tyro
from _table import markdown

from simgen.errors import UserError

FIGURES = ("pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg", "vertical_flow_px")


@dataclass(frozen=True)
class Arm:
    """What an arm trains differently."""

    teacher: str = "exact"
    matching: bool = True
    """whether matches are supervised, with the weight of the options"""
    decoder: str = "displacement"


ARMS = {
    "with flow loss": Arm(),
    "without": Arm(teacher="none"),
    "without matching": Arm(matching=False),
    "conv3d decoder": Arm(decoder="conv3d"),
    "without matching, conv3d decoder": Arm(matching=False, decoder="conv3d"),
}


@dataclass(frozen=True)
class Options:
    """Trains and scores arms."""

    data: Path
    """a set of simgen to train on"""
    test: Path
    """a set of simgen whose test frames are scored"""
    limit: int = 0
    """test pairs at most, evenly chosen; 0: all"""
    out: Path = Path("runs/ablation")
    steps: int = 250
    batch: int = 4
    seeds: int = 3
    jobs: int = 2
    """runs at a time, one thread each"""
    translation: str = "gt"
    """t of the prior in training and test: gt or nominal"""
    matching: float = 0.5
    """weight of matching supervision, in the arms that have it; 0: the paper's two losses alone. It
    is drawn from exact flow, too, so with it the arm "without" lacks the flow loss but not flow"""
    arms: tuple[Literal[*ARMS], ...] = ("with flow loss", "without")
    """the others are compared with the first one"""


def folder(options: Options, arm: Arm, seed: int) -> Path:
    """Of one run: it says all that tells the run from others."""
    data, matching = options.data.name, options.matching * arm.matching
    settings = f"{options.steps}x{options.batch}-{matching:g}-{options.translation}"
    beyond = "" if arm.decoder == "displacement" else f"-{arm.decoder}"
    return options.out / f"{data}-{arm.teacher}-{seed}-{settings}{beyond}"


def commands(options: Options, arm: Arm, seed: int) -> list[list[object]]:
    """The modules that train and score one run, with their arguments."""
    out = folder(options, arm, seed)
    train = ["flowrect.train", "--preset", "small", "--data", options.data, "--out", out,
             "--teacher", arm.teacher, "--max-steps", options.steps, "--val-every", options.steps,
             "--val-pairs", 12, "--loading.batch", options.batch, "--loading.workers", 0,
             "--loading.seed", seed, "--loss.matching", options.matching * arm.matching,
             "--model.decoder", arm.decoder, "--translation", options.translation]  # fmt: skip
    test = ["flowrect.evaluate", "--data", options.test, "--methods", _method(out),
            "--size", "512x256", "--translations", options.translation, "--matched-pairs", 0,
            "--limit", options.limit, "--out", _scores(options, out)]  # fmt: skip
    return [train, test]


def _scores(options: Options, out: Path) -> Path:
    """The folder of what `evaluate` says of the network in ``out``."""
    return out / (f"on-{options.test.name}" + (f"-{options.limit}" if options.limit else ""))


def scored(options: Options, name: str, seed: int) -> list[dict[str, str]]:
    """Trains one network, unless that was done before; the rows of every test pair."""
    out = folder(options, ARMS[name], seed)
    scores = _scores(options, out) / "scores.csv"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    for command in [] if scores.exists() else commands(options, ARMS[name], seed):
        subprocess.run([sys.executable, "-m", *map(str, command)], env=environment, check=True,
                       stdout=subprocess.DEVNULL)  # fmt: skip
    print(f"{name}, seed {seed}: done", flush=True)
    with scores.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["method"] == _method(out)]


def _method(out: Path) -> str:
    return f"network={out / 'last.safetensors'}"


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


def table(found: dict[str, np.ndarray], scenes: np.ndarray) -> list[list[str]]:
    """Rows of figures (seeds, pairs, figures) by arm, then of differences from the first arm."""
    rows = [
        [arm, *(f"{v.mean():.3f} ({v.mean(1).min():.3f} to {v.mean(1).max():.3f})"
                for v in np.moveaxis(values, 2, 0))]
        for arm, values in found.items()
    ]  # fmt: skip
    first, *others = found
    for arm in others:
        cells = []
        for values in np.moveaxis(found[arm] - found[first], 2, 0):
            low, high = interval(values, scenes, rng=np.random.default_rng(0))
            cells.append(f"{values.mean():+.3f} [{low:+.3f}, {high:+.3f}]")
        rows.append([f"{arm} − {first} [95 %]", *cells])
    return rows


def main(options: Options) -> None:
    """Runs what is missing, and prints the table."""
    runs = list(product(options.arms, range(options.seeds)))
    if len({folder(options, ARMS[arm], seed) for arm, seed in runs}) < len(runs):
        raise UserError(f"two of {options.arms} train the same; name each once, with --matching.")
    with ThreadPoolExecutor(options.jobs) as pool:
        records = dict(zip(runs, pool.map(lambda run: scored(options, *run), runs), strict=True))
    scenes = np.array([r["scene"] for r in records[runs[0]]])
    figures = {run: [[float(r[f]) for f in FIGURES] for r in records[run]] for run in runs}
    found = {arm: np.array([figures[arm, s] for s in range(options.seeds)]) for arm in options.arms}
    budget = f"{options.steps} steps of {options.batch}, {options.seeds} seeds"
    print(f"\n{len(scenes)} pairs, {budget}; mean (over seeds: smallest to largest)\n")
    print(markdown(["", *FIGURES], table(found, scenes)))


if __name__ == "__main__":
    main(tyro.cli(Options))
