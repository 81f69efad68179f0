"""Seconds of the clock per rig frame of a set that was rendered in one run, stage by stage.

    python -m simgen render --n 36 --seed 31 --out set; python benchmarks/render_pace.py set

Workers render at the same time, so that a frame costs less of the clock than it takes its worker:
the mean time from one frame of a worker to its next, divided by their number. The first frame of
each worker is left out, and the last of all, which has the machine for itself. The bar: at most
60 s per rig frame on two cores, at most 12 s of it neither path tracing (with its first-hit
features) nor denoising.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from simgen.errors import UserError
from simgen.survey import read_log

TRACED = ("path", "features", "denoise")


@dataclass(frozen=True)
class Options:
    """Where the time of a set went."""

    folder: Annotated[Path, tyro.conf.Positional]


def main(options: Options) -> None:
    """Prints the table."""
    frames = sorted(read_log(options.folder).finished, key=lambda frame: frame["time"])
    workers = {frame.get("workers") for frame in frames}
    if len(workers) != 1 or None in workers:
        raise UserError(f"{options.folder}: expected one run by one number of workers: {workers}.")
    (num,) = workers
    ended: dict[int, float] = {}
    taken, counted = [], []
    for frame in frames[:-1]:
        if (before := ended.get(frame["pid"])) is not None:
            taken.append(frame["time"] - before)
            counted.append(frame)
        ended[frame["pid"]] = frame["time"]
    if not counted:
        raise UserError(f"{options.folder}: expected more than two frames of a worker.")
    spent = {k: np.mean([f["seconds"].get(k, 0.0) for f in counted]) for k in _stages(counted)}
    traced = sum(spent[k] for k in TRACED)
    whole = float(np.mean(taken))
    print(f"{len(counted)} rig frames of {num} workers, each after its first\n")
    print(f"{'stage':20}{'of a worker':>12}{'of the clock':>14}")
    rows = {**spent, "between frames": whole - sum(spent.values()), "tracing, denoising": traced,
            "everything else": whole - traced, "rig frame": whole}  # fmt: skip
    for name, seconds in rows.items():
        print(f"{name:20}{seconds:10.1f} s{seconds / num:12.1f} s")


def _stages(frames: list[dict]) -> list[str]:
    return list(dict.fromkeys(k for frame in frames for k in frame["seconds"]))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
