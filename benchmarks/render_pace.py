"""Seconds of the clock per rig frame of a set that was rendered in one run, stage by stage.

    python -m simgen render --n 36 --seed 31 --out set; python benchmarks/render_pace.py set

Workers render at the same time, so that a frame costs less of the clock than it takes its worker.
The pace is that of the frames after the first of each worker; it is split by stages as the seconds
of the workers are. The bar: at most 60 s per rig frame on two cores, at most 12 s of it neither
path tracing (with its first-hit features) nor denoising.
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
    workers = len({frame["pid"] for frame in frames})
    if len(frames) < 2 * workers + 1:
        raise UserError(f"{options.folder}: expected more than two frames of each worker.")
    first, later = frames[workers - 1], frames[workers:]
    pace = (later[-1]["time"] - first["time"]) / len(later)
    spent = {k: np.mean([f["seconds"].get(k, 0.0) for f in later]) for k in _stages(later)}
    total = sum(spent.values())
    traced = sum(spent[k] for k in TRACED)
    print(f"{len(later)} rig frames after the first of each of {workers} workers\n")
    print(f"{'stage':20}{'of a worker':>12}{'of the clock':>14}")
    rows = {**spent, "tracing, denoising": traced, "everything else": total - traced, "": total}
    for name, seconds in rows.items():
        print(f"{name or 'rig frame':20}{seconds:10.1f} s{seconds * pace / total:12.1f} s")


def _stages(frames: list[dict]) -> list[str]:
    return list(dict.fromkeys(k for frame in frames for k in frame["seconds"]))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
