"""Solvers by name: from matches, intrinsics and a prior to a pose; all with one signature."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from flowrect.matches import Matches
from flowrect.solvers import essential
from flowrect.solvers.essential import Ransac
from flowrect.solvers.fit import FIVE_DOF, THREE_DOF, fit
from flowrect.solvers.solution import NoSolution, Solution
from simgen.geometry import Array

__all__ = ["SOLVERS", "NoSolution", "Solution", "Solver"]

Solver = Callable[[Matches, Array, Array, Array], Solution]
"""matches, K_left, K_right (3, 3) [px], prior T_right_left (4, 4)"""

PAPER = Ransac(threshold_px=1.0, normalised=True)
"""a threshold of one pixel taken on normalised points, as in the paper's release: no match is ever
too far off"""

# Thresholds were swept on training frames, see benchmarks/tune_methods.py.
SOLVERS: dict[str, Solver] = {
    "loransac": partial(essential.lo_ransac, options=Ransac(threshold_px=0.5)),
    "magsac": partial(essential.magsac, options=Ransac(threshold_px=0.25)),
    "loransac-paper": partial(essential.lo_ransac, options=PAPER),
    "magsac-paper": partial(essential.magsac, options=PAPER),
    "3dof": partial(fit, options=THREE_DOF),
    "5dof": partial(fit, options=FIVE_DOF),
}
