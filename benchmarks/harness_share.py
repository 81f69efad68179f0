"""How much of an evaluation is the harness: reading, preparing, scoring, tables, pictures.

    python benchmarks/harness_share.py --data test/ [--method network] [--limit 0] [--jobs 0]

Runs ``flowrect.evaluate`` for one method into a folder of its own and compares its wall time, of
each process that predicts, with the seconds that the method itself took, as its predictions have
them. The bar is a share of 10 %.
Offsets are measured by SIFT alone: what ALIKED and RAFT take is theirs, not the harness's.
"""

from __future__ import annotations

import csv
import math
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from simgen.errors import UserError


@dataclass(frozen=True)
class Options:
    """Times one evaluation."""

    data: Path
    """a set of simgen"""
    method: str = "network"
    size: str = "1024x512"
    limit: int = 0
    """pairs; 0: all"""
    jobs: int = 0
    """as flowrect.evaluate has it; by default one process predicts, with all cores"""
    out: Path | None = None
    """a new folder, from which flowrect.evaluate may go on; without it nothing is kept"""


def main(options: Options) -> None:
    """Prints the shares; one translation, so that nothing is matched once and counted twice."""
    if options.out is not None and options.out.exists():
        raise UserError(
            f"{options.out} exists; expected a new folder: what is there takes no time."
        )
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        start = time.perf_counter()
        command = ["--data", options.data, "--methods", options.method, "--translations", "nominal",
                   "--size", options.size, "--limit", options.limit, "--out", folder,
                   "--jobs", options.jobs,
                   "--offsets", "sift-paper", "--flow-network", ""]  # fmt: skip
        subprocess.run([sys.executable, "-m", "flowrect.evaluate", *map(str, command)], check=True)
        whole = time.perf_counter() - start
        with (folder / "scores.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["method"] == options.method]
    jobs = options.jobs or 1
    own = sum(s for row in rows if math.isfinite(s := float(row["seconds"])))
    print(
        f"{len(rows)} pairs on {platform.processor() or platform.machine()}: {whole:.0f} s of "
        f"{jobs} predicting, of which {options.method} took {own:.0f} s; the harness is "
        f"{1 - own / (jobs * whole):.1%}"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
