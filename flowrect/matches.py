"""Matches of a pair: what every matcher returns, and every solver starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrect.resize import resized_intrinsics
from flowrect.sample import Image
from simgen.geometry import Array


@dataclass(frozen=True, eq=False)
class Matches:
    """N points of the left image and where the right one shows them; pinhole images."""

    uv_left: Array
    """(N, 2) [px]"""
    uv_right: Array
    score: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) how sure the matcher is, more is better, on a scale of its own; 1 if it does not say"""
    weight: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) one over the number of matches that share one error: neighbours of dense flow are not
    independent. 1 if the matcher does not say"""
    seen_px: float = field(default=1.0, kw_only=True)
    """side [px] of a pixel that the matcher saw: more than 1 if it shrank the images. Positions are
    as exact as those pixels, so that thresholds are counted in them, see ``as_seen``"""

    def __post_init__(self) -> None:
        for name in ("uv_left", "uv_right"):
            uv = np.asarray(getattr(self, name), dtype=np.float64).reshape(-1, 2)
            object.__setattr__(self, name, uv)
        num = len(self.uv_left)
        for name in ("score", "weight"):
            given = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, given if given.size else np.ones(num))
        lengths = [len(x) for x in (self.uv_left, self.uv_right, self.score, self.weight)]
        if len(set(lengths)) > 1:
            raise ValueError(f"Matches: {lengths} left and right points, scores and weights; "
                             "expected one number")  # fmt: skip

    def __len__(self) -> int:
        return len(self.uv_left)

    def subset(self, index: NDArray[Any]) -> Matches:
        """The matches ``index`` (integers or booleans)."""
        parts = (self.uv_left, self.uv_right, self.score, self.weight)
        return Matches(*(x[index] for x in parts), seen_px=self.seen_px)

    def as_seen(self, K_left: Array, K_right: Array) -> tuple[Matches, Array, Array]:
        """The matches in pixels that the matcher saw, and K (3, 3) of images of such pixels."""
        if self.seen_px == 1:
            return self, K_left, K_right
        scale = 1 / self.seen_px
        left, right = ((uv + 0.5) * scale - 0.5 for uv in (self.uv_left, self.uv_right))
        K_left, K_right = (resized_intrinsics(K, scale, scale) for K in (K_left, K_right))
        return replace(self, uv_left=left, uv_right=right, seen_px=1.0), K_left, K_right

    def rays(self, K_left: Array, K_right: Array) -> tuple[Array, Array]:
        """K⁻¹ (u, v, 1)ᵀ (N, 3) of both ends, in their cameras."""
        return rays(self.uv_left, K_left), rays(self.uv_right, K_right)


Matcher = Callable[[Image, Image], Matches]
"""left and right image (H, W, 3) uint8 RGB to matches in their pixels"""


def rays(uv: Array, K: Array) -> Array:
    """K⁻¹ (u, v, 1)ᵀ (N, 3) of points uv (N, 2) [px]."""
    return np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(K).T
