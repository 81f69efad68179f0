"""Which settings of matchers and robust solvers are best on training frames.

    python benchmarks/tune_methods.py --data train/ [--limit 60] [--size 1024x512] [--only aliked …]

Test frames are never looked at. Matches are found once a setting; every solver setting gets the
same ones. Geodesic error in degrees; failures are counted with the error of the prior. The last
column says how large squared errors are against the covariance that the fit reports: 1 is honest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from _table import markdown
from rich.progress import track

from flowrect.evaluation.delivered import Delivery, prior, wh_of
from flowrect.matchers import dis, load_matcher, sift
from flowrect.matches import Matcher
from flowrect.solvers import NoSolution, Solver, supported
from flowrect.solvers.essential import Ransac, lo_ransac, magsac, usac
from flowrect.solvers.fit import FIVE_DOF, fit
from simgen.errors import UserError
from simgen.geometry import vector_from_rotation


@dataclass(frozen=True)
class Options:
    """Sweeps settings on training frames."""

    data: Path
    limit: int = 60
    """pairs, evenly chosen"""
    size: str = "1024x512"
    """as flowrect.evaluate delivers them"""
    only: tuple[str, ...] = ()
    """rows of the sweep, such as aliked; all if not given"""


THRESHOLDS = (0.25, 0.5, 1.0, 2.0)
FITS = {"5dof": supported(partial(fit, options=FIVE_DOF))}
RANSACS: dict[str, Solver] = {
    f"{name} {t:g}": supported(partial(solve, options=Ransac(t)))
    for name, solve in (("loransac", lo_ransac), ("usac", usac), ("magsac", magsac))
    for t in THRESHOLDS
}
SETTINGS: dict[str, Matcher] = {
    **{f"sift {c:g} {r:g}": partial(sift.match, options=replace(sift.TUNED, contrast=c, ratio=r))
       for c in (0.04, 0.01, 0.003) for r in (0.75, 0.85)},
    **{f"dis texture {t:g}": partial(dis.match, options=replace(dis.TUNED, texture=t))
       for t in (0.0, 0.5, 1.0, 2.0, 4.0)},
}  # fmt: skip
SWEEP: dict[str, dict[str, Solver]] = {
    **dict.fromkeys((*SETTINGS, "sift-dis"), FITS),
    **dict.fromkeys(("sift", "dis"), RANSACS),
    **dict.fromkeys(("aliked", "disk", "xfeat", "raft"), FITS | RANSACS),
}
"""settings or names of matchers, and the solvers that are tried on their matches"""


def matchers(only: tuple[str, ...]) -> dict[str, Matcher]:
    """Those of the sweep with these names, or all; UserError if there is no such row."""
    if unknown := set(only) - SWEEP.keys():
        raise UserError(f"--only {', '.join(sorted(unknown))}: expected some of {list(SWEEP)}.")
    return {name: SETTINGS.get(name) or load_matcher(name) for name in only or SWEEP}


def main(options: Options) -> None:
    """Prints the table."""
    found = matchers(options.only)
    pairs = Delivery(options.data, "train", wh_of(options.size), options.limit).open()
    errors = {(m, s): [] for m in found for s in SWEEP[m]}
    failed, excess = dict.fromkeys(errors, 0), {key: [] for key in errors}
    for i in track(range(len(pairs)), "pairs"):
        pair = pairs[i].input
        start, R_gt = prior(pair, "nominal"), pair.T_right_left[:3, :3]
        for m, match in found.items():
            matches = match(pair.left, pair.right)
            for s, solver in SWEEP[m].items():
                try:
                    pose = solver(*matches.as_seen(pair.K_left, pair.K_right), start)
                    x = vector_from_rotation(pose.R @ R_gt.T)
                    if pose.covariance is not None:
                        excess[m, s].append(x @ np.linalg.solve(pose.covariance[:3, :3], x) / 3)
                except NoSolution:
                    x, failed[m, s] = vector_from_rotation(start[:3, :3] @ R_gt.T), failed[m, s] + 1
                errors[m, s].append(np.rad2deg(np.linalg.norm(x)))
    rows = [
        [m, s, f"{np.median(e):.3f}", f"{np.mean(e):.3f}", f"{np.percentile(e, 95):.2f}",
         failed[m, s], f"{np.median(excess[m, s]) / 0.79:.1f}" if excess[m, s] else ""]
        for (m, s), e in errors.items()
    ]  # fmt: skip
    print(markdown(["matches", "solver", "median", "mean", "95 %", "failed", "excess"], rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
