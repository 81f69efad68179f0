"""Solvers by name: from matches, intrinsics and a prior to a pose; all with one signature.

Thresholds are in pixels of what the matcher saw: hand over what ``Matches.as_seen`` returns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from flowrect.matches import Matches
from flowrect.solvers import essential
from flowrect.solvers.essential import Ransac
from flowrect.solvers.fit import FIVE_DOF, THREE_DOF, fit, require_support
from flowrect.solvers.solution import NoSolution, Solution
from simgen.geometry import Array

__all__ = ["COARSE", "SOLVERS", "NoSolution", "Solution", "Solver"]

Solver = Callable[[Matches, Array, Array, Array], Solution]
"""matches, K_left, K_right (3, 3) [px], prior T_right_left (4, 4)"""


def supported(solve: Solver) -> Solver:
    """The solver, whose pose must have enough matches behind it and lie near the prior.

    One bar for all but the settings of the paper: else those that give up would look better.
    """

    def checked(matches: Matches, K_left: Array, K_right: Array, prior: Array) -> Solution:
        solution = solve(matches, K_left, K_right, prior)
        require_support(solution, matches, K_left, K_right, prior)
        return solution

    return checked


PAPER = Ransac(threshold_px=1.0, normalised=True)
"""a threshold of one pixel taken on normalised points, as in the paper's release: no match is ever
too far off"""

# Thresholds were swept on training frames, see benchmarks/tune_methods.py.
COARSE: dict[str, Solver] = {
    "loransac": supported(partial(essential.lo_ransac, options=Ransac(threshold_px=1.0))),
    "usac": supported(partial(essential.usac, options=Ransac(threshold_px=1.0))),
}
"""for matches of whole pixels, which are as wrong as .5 px along each axis"""
SOLVERS: dict[str, Solver] = {
    "loransac": supported(partial(essential.lo_ransac, options=Ransac(threshold_px=0.5))),
    "usac": supported(partial(essential.usac, options=Ransac(threshold_px=0.5))),
    "magsac": supported(partial(essential.magsac, options=Ransac(threshold_px=1.0))),
    "loransac-paper": partial(essential.lo_ransac, options=PAPER),
    "usac-paper": partial(essential.usac, options=PAPER),
    "magsac-paper": partial(essential.magsac, options=PAPER),
    "3dof": supported(partial(fit, options=THREE_DOF)),
    "5dof": supported(partial(fit, options=FIVE_DOF)),
}
