"""Depth error by range: what a rectification is worth to a stereo matcher (paper, section 5.2).

The disparity of an *estimated* rectification gives points of the estimate's rectified left frame.
They are turned back to the left camera by the estimate's own R_left and compared there, pixel by
pixel, with the z that the pixel truly has: a point lies on the ray of its pixel whatever the
estimate, so z_left = z_rectified / (R_left ray)_z for a ray with z = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from flowrect.correspondences import Correspondences
from flowrect.depth import StereoMatcher
from flowrect.depth.frame import DepthFrame
from flowrect.drectify import Rectification, warp
from flowrect.geometry import inside, project
from flowrect.metrics import bootstrap_sums, interval_of
from flowrect.sample import Image, Pair
from simgen.errors import UserError

Float = NDArray[np.float64]

EDGES_M = (0.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0)
"""of the ranges of Fig. 4, [0, 300] m"""
EDGE_PX = 1.0
"""four neighbours whose disparities differ by more lie on two surfaces"""
ROUNDING_PX = 1e-6
"""what a pixel on the border may seem to lie outside"""


class RangeError(NamedTuple):
    """Errors of one range of true depth; NaN where nothing was answered."""

    from_m: float
    to_m: float
    pixels: int
    """that both cameras see, at this depth"""
    answered: int
    """of those, with a depth"""
    mae_m: float
    median_m: float
    """of |estimated − true|"""
    bias_m: float
    """mean of estimated − true"""

    @property
    def coverage(self) -> float:
        """Share of the pixels that were answered."""
        return self.answered / self.pixels if self.pixels else float("nan")


class RangeComparison(NamedTuple):
    """Errors of one range of true depth, of one way to rectify the pairs."""

    own: RangeError
    """of all its answers"""
    common: RangeError
    """of pixels that the true pose gives an answer for as well"""
    by_truth: RangeError
    """what the true pose leaves of the same pixels"""


class MeanError(NamedTuple):
    """Mean of the mean errors of the ranges that have pixels, each of the same weight [m].

    Of pixels that the true pose gives an answer for as well. Infinite where a range has none: the
    far ones, which go first, weigh most.
    """

    mae_m: float
    truth_mae_m: float
    """what the true pose leaves of the same pixels"""
    interval_m: tuple[float, float]
    """95 % bootstrap interval of ``mae_m`` over scenes; NaN where these are too few"""
    excess_interval_m: tuple[float, float]
    """the same of ``mae_m`` − ``truth_mae_m``"""


class Comparison(NamedTuple):
    """Errors of one way to rectify the pairs, beside those of the true pose."""

    ranges: list[RangeComparison]
    mean: MeanError


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """True and estimated z in the left camera frame [m] of pixels that both cameras see."""

    true_m: Float
    """(N,)"""
    estimated_m: NDArray[np.floating]
    """(N,) NaN where there is no answer"""

    @staticmethod
    def joined(samples: Sequence[DepthSamples]) -> DepthSamples:
        """Those of several pairs."""
        none = np.empty(0)
        return DepthSamples(np.concatenate([none, *(s.true_m for s in samples)]),
                            np.concatenate([none, *(s.estimated_m for s in samples)]))  # fmt: skip

    def subset(self, index: NDArray[np.bool_]) -> DepthSamples:
        """The chosen pixels."""
        return DepthSamples(self.true_m[index], self.estimated_m[index])

    def by_range(self, edges_m: Sequence[float] = EDGES_M) -> list[RangeError]:
        """One row for each range of *true* depth, from ≤ z < to.

        An estimate beyond the last edge counts as one at the last edge: one pixel at 10 km would
        outweigh a hundred thousand others. So does one at infinity, an answer as well.
        """
        return [self._of_range(a, b, edges_m[-1]) for a, b in pairwise(edges_m)]

    def _of_range(self, from_m: float, to_m: float, limit_m: float) -> RangeError:
        within = (self.true_m >= from_m) & (self.true_m < to_m)
        error = np.minimum(self.estimated_m[within], limit_m) - self.true_m[within]  # float64
        error = error[~np.isnan(error)]
        figures = (float("nan"),) * 3
        if error.size:
            size = np.abs(error)
            figures = (float(size.mean()), float(np.median(size)), float(error.mean()))
        return RangeError(from_m, to_m, int(within.sum()), error.size, *figures)

    def sums(self, edges_m: Sequence[float] = EDGES_M) -> Float:
        """(2, ranges): of |estimated − true| [m] as in ``by_range``, and how many answers."""
        known = ~np.isnan(self.estimated_m)
        true_m, estimated_m = self.true_m[known], self.estimated_m[known]
        error = np.abs(np.minimum(estimated_m, edges_m[-1]) - true_m)
        index = np.searchsorted(edges_m, true_m, side="right")  # 0: nearer than all
        columns = (np.bincount(index, weights, len(edges_m) + 1) for weights in (error, None))
        return np.stack([x[1:-1] for x in columns]).astype(float)


def compared(
    own: Sequence[DepthSamples], by_truth: Sequence[DepthSamples], scenes: Sequence[str]
) -> Comparison:
    """From the samples of the same pairs, and the scenes that these come from.

    Where a pose is wrong a stereo matcher answers fewer pixels, and the easier ones: its errors
    can be held against those of the true pose on the same pixels alone.
    """
    answers = [(~np.isnan(a.estimated_m), ~np.isnan(b.estimated_m))
               for a, b in zip(own, by_truth, strict=True)]  # fmt: skip
    common = [
        [s.subset(a & b) for s, (a, b) in zip(samples, answers, strict=True)]
        for samples in (own, by_truth)
    ]
    columns = (DepthSamples.joined(x).by_range() for x in (own, *common))
    ranges = [RangeComparison(*row) for row in zip(*columns, strict=True)]
    known = [i for i, x in enumerate(ranges) if x.own.pixels]
    if not known or not all(ranges[i].common.answered for i in known):
        return Comparison(ranges, MeanError(np.inf, np.inf, (np.nan, np.nan), (np.nan, np.nan)))
    sums = np.stack([np.stack([s.sums()[:, known] for s in pair])
                     for pair in zip(*common, strict=True)])  # fmt: skip
    return Comparison(ranges, _mean_error(sums, scenes))


def _mean_error(sums: Float, scenes: Sequence[str]) -> MeanError:
    """Of sums (pairs, 2, 2, ranges): by the pose and by the truth, of errors and of answers."""
    draws = bootstrap_sums(sums.reshape(len(sums), -1), scenes, rng=np.random.default_rng(0))
    mae, truth = _mean_of_ranges(sums.sum(0))
    own, by_truth = _mean_of_ranges(draws.reshape(-1, *sums.shape[1:])).T
    return MeanError(float(mae), float(truth), interval_of(own), interval_of(own - by_truth))


def _mean_of_ranges(sums: Float) -> Float:
    """(…) of (…, 2, ranges); NaN where a range has no answer."""
    with np.errstate(invalid="ignore"):
        mean: Float = (sums[..., 0, :] / sums[..., 1, :]).mean(-1)
    return mean


def depth_samples(
    disparity: NDArray[np.floating], frame: DepthFrame, truth: Correspondences
) -> DepthSamples:
    """Estimated depth at the left pixels of one pair.

    Args:
      disparity: (H, W) u_left − u_right [px] on the rectified left image, NaN where unknown.
      frame: of the estimate that the pair was rectified by.
      truth: of ``comparable``, NumPy fields (N, …); the samples share its depths.
    """
    return DepthSamples(truth.depth, left_depth(disparity, frame, truth.rays_left))


def left_depth(disparity: NDArray[np.floating], frame: DepthFrame, rays_left: Float) -> Float:
    """z in the left *camera* frame (N,) [m] that the disparity gives to rays (N, 3) with z = 1."""
    rays = rays_left @ frame.R_left.T
    in_front = rays[:, 2] > 0
    uvw = rays @ frame.K_new.T
    uv = uvw[:, :2] / np.where(in_front, uvw[:, 2], np.nan)[:, None]
    depth: Float = frame.rectified_depth(disparity_at(disparity, uv)) / rays[:, 2]
    return depth


def disparity_at(disparity: NDArray[np.floating], uv: Float) -> Float:
    """Disparity (N,) at uv (N, 2) [px]; NaN where unknown or outside the hull of pixel centres.

    Bilinear, so exact on planes, where the four pixels around are known and of one surface; else
    that of the nearest pixel.
    """
    h, w = disparity.shape
    last = np.array([w - 1, h - 1])
    answer = np.full(len(uv), np.nan)
    shown = ((uv >= -ROUNDING_PX) & (uv <= last + ROUNDING_PX)).all(1)
    u, v = np.clip(uv[shown], 0, last).T
    j, i = (np.clip(np.floor(x).astype(int), 0, n - 2) for x, n in ((u, w), (v, h)))
    corners = np.stack([disparity[i + a, j + b] for a in (0, 1) for b in (0, 1)]).astype(float)
    du, dv = u - j, v - i
    weights = np.stack([(1 - dv) * (1 - du), (1 - dv) * du, dv * (1 - du), dv * du])
    nearest = disparity[np.rint(v).astype(int), np.rint(u).astype(int)]
    smooth = np.ptp(corners, axis=0) <= EDGE_PX  # False if one is NaN
    answer[shown] = np.where(smooth, (weights * corners).sum(0), nearest)
    return answer


# --- of a pair ---------------------------------------------------------------------------------


def rectified_images(pair: Pair, rect: Rectification) -> tuple[Image, Image]:
    """Both images of a pair, rectified at their size; black outside. ``rect`` is a batch of one."""
    left, right = (
        _warped(image, K, R, rect)
        for image, K, R in (
            (pair.left, pair.K_left, rect.R_left),
            (pair.right, pair.K_right, rect.R_right),
        )
    )
    return left, right


def _warped(image: Image, K: Float, R_rect: torch.Tensor, rect: Rectification) -> Image:
    planes = torch.from_numpy(image.transpose(2, 0, 1).copy()).float()[None]
    h, w = image.shape[:2]
    warped, _ = warp(planes, torch.from_numpy(K)[None], R_rect, rect.K_new, (w, h))
    rounded: Image = warped[0].round().byte().permute(1, 2, 0).contiguous().numpy()
    return rounded


def comparable(pair: Pair) -> Correspondences:
    """The points at finite depth that both images of the pair, cut as they may be, show."""
    if pair.truth is None:
        raise UserError(
            f"{pair.name}: has no depth to compare with; expected a pair that was rendered."
        )
    ends = ((pair.K_left, pair.truth.rays_left), (pair.K_right, pair.truth.rays_right))
    chosen = pair.truth.visible & (pair.truth.depth > 0)
    for K, rays in ends:
        uv = project(torch.from_numpy(K), torch.from_numpy(rays))
        chosen = chosen & inside(uv, pair.wh).numpy()
    return pair.truth.subset(chosen)


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """A pair, rectified by some pose, and what a stereo matcher says of it."""

    left: Image
    right: Image
    """rectified"""
    disparity: NDArray[np.floating]
    """(H, W) u_left − u_right [px] on the rectified left image, NaN where unknown"""
    frame: DepthFrame

    def samples(self, truth: Correspondences) -> DepthSamples:
        """Its depth where the pair, from before it was rectified, knows the truth.

        In single precision, 6e-8 of a depth: those of all pairs and methods are held at once.
        """
        exact = depth_samples(self.disparity, self.frame, truth)
        return replace(exact, estimated_m=exact.estimated_m.astype(np.float32))


def matched(
    pair: Pair, rect: Rectification, frame: DepthFrame, match: StereoMatcher
) -> MatchedPair:
    """The pair, rectified by ``rect`` (a batch of one) and matched."""
    left, right = rectified_images(pair, rect)
    return MatchedPair(left, right, match(left, right), frame)
