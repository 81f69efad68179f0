"""SIFT key points and nearest neighbours (D. Lowe, IJCV 2004), with OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrect.matches import Matches
from flowrect.resize import resized_image
from flowrect.sample import Image
from simgen.geometry import Array


@dataclass(frozen=True)
class Sift:
    """What is detected, and which neighbours are matches. The defaults are OpenCV's and Lowe's."""

    max_features: int = 0
    """the strongest ones; 0: all"""
    contrast: float = 0.04
    """below it a key point is dropped"""
    ratio: float = 0.75
    """of the distances to the best and the second best descriptor"""
    mutual: bool = False
    """both ends must be each other's best, by the ratio test both ways"""
    max_pixels: int = 0
    """larger images are shrunk; 0: never"""


PAPER = Sift()
"""of the metric "SIFT offset": ratio 0.75, one way"""
TUNED = Sift(max_features=5000, contrast=0.003, ratio=0.85, mutual=True)
"""many points of little contrast: a robust solver can choose. Swept on training frames
(benchmarks/tune_methods.py), where all had less than 5000; time grows with their square"""
WEIGHT = 0.5
"""of a match: squared errors of poses were twice what independent matches would give"""
_ROWS = 1024
"""descriptors that are compared with all others at once"""
QUICK = Sift(max_features=4000, mutual=True, max_pixels=1_500_000)
"""for a check of one pair, whatever its size"""


def match(left: Image, right: Image, options: Sift = TUNED) -> Matches:
    """Nearest neighbours among SIFT descriptors that pass the ratio test."""
    (uv_left, first), (uv_right, second) = (_features(x, options) for x in (left, right))
    forth = _best(first, second, options.ratio)
    if options.mutual:
        back = _best(second, first, options.ratio)
        forth = forth[_partner_of(back, len(second))[forth[:, 1]] == forth[:, 0]]
    weight = np.full(len(forth), WEIGHT)
    return Matches(uv_left[forth[:, 0]], uv_right[forth[:, 1]], np.ones(len(forth)), weight)


def _features(image: Image, options: Sift) -> tuple[Array, NDArray[np.float32]]:
    """Positions (N, 2) [px] and descriptors (N, 128)."""
    h, w = image.shape[:2]
    scale = min(1.0, (options.max_pixels / (w * h)) ** 0.5) if options.max_pixels else 1.0
    wh = round(w * scale), round(h * scale)
    grey = cv2.cvtColor(resized_image(image, wh), cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(options.max_features, contrastThreshold=options.contrast)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    uv = np.array([k.pt for k in keypoints], dtype=np.float64)
    return (uv + 0.5) * np.array([w / wh[0], h / wh[1]]) - 0.5, descriptors


def _best(
    first: NDArray[np.float32], second: NDArray[np.float32], ratio: float
) -> NDArray[np.int64]:
    """Indices (M, 2) of descriptors and their best partners, where the next is far worse.

    Distances come from one matrix product, in a fifth of the time of OpenCV's matcher. They are
    exact: descriptors are whole numbers whose squares sum to less than 2²⁴.
    """
    if not len(first) or len(second) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    squares = [np.square(x).sum(axis=1) for x in (first, second)]
    found = []
    for start in range(0, len(first), _ROWS):
        rows = np.arange(start, min(start + _ROWS, len(first)))
        squared = squares[0][rows, None] + squares[1] - 2 * first[rows] @ second.T
        nearest, each = squared.argmin(axis=1), np.arange(len(rows))
        distance = np.sqrt(squared[each, nearest])
        squared[each, nearest] = np.inf
        kept = distance < ratio * np.sqrt(squared.min(axis=1))
        found.append(np.stack([rows, nearest], axis=1)[kept])
    return np.concatenate(found)


def _partner_of(pairs: NDArray[np.int64], num: int) -> NDArray[np.int64]:
    """The partner (num,) of each index that comes first in ``pairs``; −1 where it has none."""
    partner = np.full(num, -1, dtype=np.int64)
    partner[pairs[:, 0]] = pairs[:, 1]
    return partner
