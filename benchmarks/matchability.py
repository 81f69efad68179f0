"""How well the pairs of a set can be matched: SIFT with a ratio test, judged by the ground truth.

    simgen render --n 60 --size 1024x576 --weather clear,fog,rain --daylight noon,night --out set
    python benchmarks/matchability.py set [--csv pairs.csv]

Descriptors are RootSIFT (Arandjelović & Zisserman, 2012); a match is kept if each point is the
other's nearest and the second nearest is farther by the ratio test (Lowe, 2004). A match is correct
if it ends within the tolerance of the exact flow, sampled bilinearly at the left point; judged are
matches whose left point is visible in the right image. The inlier share is that of the correct
among all matches kept. Images wider than 1024 pixels are scaled to it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from _table import markdown, write_csv
from numpy.typing import NDArray

from simgen.schema import VISIBLE
from simgen.shards import Frame, ShardSet
from simgen.statistics import correct_matches

WIDTH = 1024
RATIO = 0.8
CONTRAST = 0.01
"""a quarter of OpenCV's default: fog and night leave little"""


@dataclass(frozen=True)
class Options:
    """Correct SIFT matches per pair and their share, by weather and daylight."""

    folder: Annotated[Path, tyro.conf.Positional]
    """of the set"""
    tolerance_px: float = 1.5
    csv: Path | None = None
    """writes the numbers of every pair to this file"""


@dataclass(frozen=True)
class Score:
    """One pair."""

    num_points: int
    num_matches: int
    num_correct: int

    @property
    def inliers(self) -> float:
        """Share of the correct matches; 0 if there is none."""
        return self.num_correct / max(1, self.num_matches)


def main(options: Options) -> None:
    """Prints the table."""
    strata: dict[tuple[str, str], list[Score]] = defaultdict(list)
    rows = []
    for frame in ShardSet(options.folder):
        spec = frame.spec
        stratum = spec["weather"]["name"], spec["daylight"]["name"]
        for pair, score in enumerate(_scores(frame, options.tolerance_px)):
            strata[stratum].append(score)
            rows.append((int(frame.frame_index), pair, *stratum, score.num_points,
                         score.num_matches, score.num_correct, score.inliers))  # fmt: skip
    header = ("weather", "daylight", "pairs", "points", "matches", "correct", "fewest", "inliers")
    table = [(*stratum, *_summary(scores)) for stratum, scores in sorted(strata.items())]
    every = [score for scores in strata.values() for score in scores]
    table.append(("all", "all", *_summary(every)))
    tolerance = f"{options.tolerance_px:g} px of images of at most {WIDTH} px"
    print(f"Medians per pair; correct within {tolerance}\n")
    print(markdown(header, table))
    if options.csv:
        write_csv(options.csv, ("frame", "pair", *header[:2], *header[3:6], "inliers"), rows)


def _summary(scores: list[Score]) -> tuple[object, ...]:
    num_points, num_matches, num_correct = np.transpose(
        [(s.num_points, s.num_matches, s.num_correct) for s in scores]
    )
    medians = [float(np.median(values)) for values in (num_points, num_matches, num_correct)]
    inliers = float(np.median([s.inliers for s in scores]))
    return len(scores), *medians, int(num_correct.min()), inliers


def _scores(frame: Frame, tolerance_px: float) -> Iterator[Score]:
    images = frame.image
    scale = min(1.0, WIDTH / images.shape[2])
    seen = [_features(image, scale) for image in images]
    for pair, (left, right) in enumerate(frame.pairs):
        uv_left, uv_right = _matched(seen[left], seen[right])
        visible = (frame.read("flow_status", pair) & VISIBLE) > 0
        correct = correct_matches(
            uv_left, uv_right, frame.flow(pair), visible, tolerance_px / scale
        )
        yield Score(len(seen[left][0]), len(correct), int(correct.sum()))


Features = tuple[NDArray[np.float64], NDArray[np.float32]]
"""points (N, 2) in pixels of the stored image, descriptors (N, 128)"""


def _features(image: NDArray[np.uint8], scale: float) -> Features:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, described = cv2.SIFT.create(contrastThreshold=CONTRAST).detectAndCompute(grey, None)
    if not points:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    uv = np.array([p.pt for p in points])
    return (uv + 0.5) / scale - 0.5, np.sqrt(described / described.sum(axis=1, keepdims=True))


def _matched(left: Features, right: Features) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (M, 2) of both images that are each other's nearest and pass the ratio test."""
    if min(len(left[1]), len(right[1])) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    matcher = cv2.BFMatcher()
    back = {m.queryIdx: m.trainIdx for m in matcher.match(right[1], left[1])}
    kept = [
        best
        for best, second in matcher.knnMatch(left[1], right[1], k=2)
        if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    return left[0][[m.queryIdx for m in kept]], right[0][[m.trainIdx for m in kept]]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
