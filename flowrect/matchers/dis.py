"""Dense optical flow by inverse search (Kroeger et al., DIS, ECCV 2016), with OpenCV.

Nothing is learned. A point counts as matched if the flow back from where it went returns to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrect.matches import Matches
from flowrect.sample import Image
from simgen.geometry import Array


@dataclass(frozen=True)
class Dis:
    """How flow is computed, and which of its vectors are matches."""

    preset: int = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
    step: int = 6
    """pixels between the points that are kept"""
    cycle_px: float = 1.0
    """largest distance of a point from where forward and backward flow take it"""
    texture: float = 0.5
    """least root of the smaller eigenvalue of the structure tensor [grey levels per pixel]: where
    there is nothing to match flow is smooth, agrees with itself, and is wrong"""
    window: int = 9
    """pixels over which texture is looked for"""
    worth: float = 60.0
    """independent matches that a flow field is worth at most: on training frames squared errors of
    poses were thirty times what 1,800 independent matches would give"""


TUNED = Dis()
"""swept on training frames (benchmarks/tune_methods.py)"""


def match(left: Image, right: Image, options: Dis = TUNED) -> Matches:
    """A grid of left pixels with their flow, where the flow back agrees."""
    first, second = (cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in (left, right))
    dis = cv2.DISOpticalFlow.create(options.preset)
    forth = dis.calc(first, second, None)
    back = dis.calc(second, first, None)
    matches = consistent(forth, back, step=options.step, cycle_px=options.cycle_px)
    u, v = matches.uv_left.astype(int).T
    matches = matches.subset(texture(first, options.window)[v, u] >= options.texture)
    return worth(matches, options.worth)


def worth(matches: Matches, most: float) -> Matches:
    """The matches with equal weights that add up to at most so many."""
    weight = min(1.0, most / max(1, len(matches)))
    return replace(matches, weight=np.full(len(matches), weight))


def texture(grey: NDArray[np.uint8], window: int) -> NDArray[np.float32]:
    """Root of the structure tensor's smaller eigenvalue (H, W), in grey levels per pixel."""
    # Sobel's kernel sums to 8; OpenCV's scale of an 8-bit image is 1 / (255 * window * 4).
    found = cv2.cornerMinEigenVal(grey, window, ksize=3) * (255 * window * 4 / 8) ** 2 / window**2
    return np.sqrt(np.maximum(found, 0), dtype=np.float32)


def consistent(forth: NDArray[Any], back: NDArray[Any], *, step: int, cycle_px: float) -> Matches:
    """Matches on a grid of ``step`` pixels where flow (H, W, 2) and flow back cancel."""
    h, w = forth.shape[:2]
    v, u = np.mgrid[step // 2 : h : step, step // 2 : w : step]
    uv_left: Array = np.stack([u, v], axis=-1).astype(np.float64)
    uv_right = uv_left + forth[v, u]
    inside = ((uv_right >= 0) & (uv_right <= [w - 1, h - 1])).all(-1)
    # As a grid: a map of one column may have fewer rows (2^15) than there are points.
    returned = cv2.remap(back, uv_right.astype(np.float32), None, cv2.INTER_LINEAR)
    cycle = np.linalg.norm(forth[v, u] + returned, axis=-1)
    kept = inside & (cycle <= cycle_px)
    return Matches(uv_left[kept], uv_right[kept], 1 / (1 + cycle[kept]))
