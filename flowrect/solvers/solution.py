"""What a solver makes of matches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrect.matches import Matches
from simgen.geometry import Array


class NoSolution(Exception):
    """The matches do not say how the cameras stand; the message says why."""

    def __init__(
        self,
        message: str,
        *,
        num_matches: int | None = None,
        seconds: Mapping[str, float] | None = None,
    ) -> None:
        """What it took to find that out, where it is known: matches, and seconds by stage."""
        super().__init__(message)
        self.num_matches, self.seconds = num_matches, dict(seconds or {})


@dataclass(frozen=True, eq=False)
class Solution:
    """A pose, and the matches that support it."""

    R: Array
    """(3, 3) X_right = R X_left + t"""
    t: Array
    """(3,) of the prior's length, which no image shows"""
    inliers: NDArray[np.bool_]
    """(N,) the matches that support the pose"""
    covariance: Array | None = None
    """(5, 5) [rad²] of the turn about the right camera's x, y, z, and of t's direction along the
    two axes across the prior's (y and z of a horizontal rig); None if the solver does not know"""


def require_matches(matches: Matches, least: int) -> None:
    """NoSolution if there are fewer."""
    if len(matches) < least:
        raise NoSolution(
            f"only {len(matches)} matches, expected at least {least}: too dark, too foggy, or "
            "without texture?"
        )
