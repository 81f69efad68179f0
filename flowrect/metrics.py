"""How good an estimate is: one definition of each figure, for training, evaluation and reports.

Per pair everywhere, (B,) or (B, 3), so that summaries can be taken by scene, weather or daylight.
Rectified images are 512×256 in every report, whatever size a method works on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from flowrect.correspondences import Correspondences
from flowrect.drectify import Rectification, rectified_uv, warp
from flowrect.geometry import angles_per_axis_rad, geodesic_rad, inside, project
from flowrect.losses import across_epipolar_lines, rectified_vertical_flow

METRIC_WH = (512, 256)


# --- rotations ---------------------------------------------------------------------------------


def angles_deg(R_gt: Tensor, R: Tensor) -> Tensor:
    """Signed error (B, 3) about the right camera's axes: pitch, yaw, roll [°]."""
    return angles_per_axis_rad(R_gt.double(), R.double()).rad2deg()


def geodesic_deg(R_gt: Tensor, R: Tensor) -> Tensor:
    """Angle (B,) of the rotation between truth and estimate [°]."""
    return geodesic_rad(R_gt.double(), R.double()).rad2deg()


# --- rectified positions -----------------------------------------------------------------------


def exact_vertical_flow(
    rect: Rectification, truth: Correspondences, wh: tuple[int, int] = METRIC_WH
) -> Tensor:
    """Mean |vertical flow| (B,) [px] after rectification, by exact correspondences.

    Over all left pixels, sky and occluded ones included, whose two ends lie in the rectified
    frames; NaN if none does.
    """
    return _mean_per_pair(*rectified_vertical_flow(rect, truth, wh))


def unrectified_vertical_flow(
    truth: Correspondences,
    K_left: Tensor,
    K_right: Tensor,
    vertical: Tensor,
    wh: tuple[int, int] = METRIC_WH,
) -> Tensor:
    """Mean |vertical flow| (B,) [px] of the resized images as they are, K (B, 3, 3) theirs."""
    uv_left, uv_right = project(K_left, truth.rays_left), project(K_right, truth.rays_right)
    counted = inside(uv_left, wh) & inside(uv_right, wh)
    return _mean_per_pair(across_epipolar_lines(uv_right - uv_left, vertical), counted)


def disparity_bias(
    rect: Rectification,
    rect_gt: Rectification,
    truth: Correspondences,
    wh: tuple[int, int] = METRIC_WH,
) -> Tensor:
    """Mean of disparity minus true disparity (B,) [px]: what a yaw error does to depth.

    Both rectified with one K_new; over the correspondences that lie in all four frames.
    """
    _require_one_scale(rect, rect_gt)
    (estimate, counted), (exact, counted_gt) = (_disparity(r, truth, wh) for r in (rect, rect_gt))
    return _mean_per_pair(estimate - exact, counted & counted_gt, signed=True)


def _disparity(
    rect: Rectification, truth: Correspondences, wh: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    uv_left = rectified_uv(truth.rays_left, rect.R_left, rect.K_new)
    uv_right = rectified_uv(truth.rays_right, rect.R_right, rect.K_new)
    along = across_epipolar_lines(uv_left - uv_right, ~rect.vertical)
    return along, inside(uv_left, wh) & inside(uv_right, wh)


# --- rectified images --------------------------------------------------------------------------


@dataclass(frozen=True)
class ImageError:
    """Mean absolute error (B,) of a rectified pair, colours in [0, 1]."""

    paper: Tensor
    """summed over both views, borders without image counted as black"""
    valid: Tensor
    """mean over both views and the pixels that both rectifications fill; NaN if there is none"""


@dataclass(frozen=True)
class RectifiedViews:
    """Both images of each pair in the rectified frame."""

    images: Tensor
    """(B, 2, C, H, W), left and right; black where there is no image"""
    filled: Tensor
    """(B, 2, H, W) as drectify.warp has it"""
    K_new: Tensor
    """(B, 3, 3) [px]"""


def rectified_views(
    left: Tensor,
    right: Tensor,
    K_left: Tensor,
    K_right: Tensor,
    rect: Rectification,
    wh: tuple[int, int] = METRIC_WH,
) -> RectifiedViews:
    """Images (B, C, h, w) with K (B, 3, 3), warped into the rectified frame."""
    sides = (left, K_left, rect.R_left), (right, K_right, rect.R_right)
    both = [warp(image, K, R_rect, rect.K_new, wh) for image, K, R_rect in sides]
    images, filled = (torch.stack(x, dim=1) for x in zip(*both, strict=True))
    return RectifiedViews(images, filled[:, :, 0], rect.K_new)


def rectified_image_error(estimate: RectifiedViews, exact: RectifiedViews) -> ImageError:
    """Images rectified by the estimate against the same rectified by the truth.

    Both with one K_new, of the nominal rig: otherwise the error would be that of the scale.
    """
    _require_one_scale(estimate, exact)
    error = (estimate.images - exact.images).abs().mean(2)
    filled = estimate.filled & exact.filled
    return ImageError(error.sum(1).mean((-2, -1)), _mean_per_pair(error, filled))


# --- summaries ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Summary:
    """A figure over many pairs."""

    mean: float
    median: float
    p95: float
    interval: tuple[float, float]
    """95 % bootstrap interval of the mean, over scenes"""
    num: int


def summarise(values: ArrayLike, scenes: ArrayLike, *, rng: np.random.Generator) -> Summary:
    """Mean, median, 95th percentile and interval of values (n,) whose pairs come from scenes (n,).

    Raises:
      ValueError: there is no value, or one that is not finite (count and drop those openly).
    """
    values = np.asarray(values, dtype=np.float64)
    if not values.size or not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).sum())
        raise ValueError(
            f"summarise: {bad} of {values.size} values are not finite, expected at least one value "
            "and all finite; leave out pairs without a figure, and say how many."
        )
    return Summary(
        mean=float(values.mean()),
        median=float(np.median(values)),
        p95=float(np.percentile(values, 95)),
        interval=bootstrap_interval(values, scenes, rng=rng),
        num=values.size,
    )


MIN_SCENES = 5
"""fewer say nothing about how scenes differ"""


def bootstrap_interval(
    values: ArrayLike,
    scenes: ArrayLike,
    *,
    rng: np.random.Generator,
    level: float = 0.95,
    num: int = 2000,
) -> tuple[float, float]:
    """Percentile interval of the mean of values (n,), drawing whole *scenes* with replacement.

    Pairs of one scene share everything but their baseline: drawn singly they would pass for
    independent, and the interval would come out too narrow. NaN for less than ``MIN_SCENES``.
    """
    values = np.asarray(values, dtype=np.float64)
    columns = np.stack([values, np.ones_like(values)], axis=1)
    sums, counts = bootstrap_sums(columns, scenes, rng=rng, num=num).T
    return interval_of(sums / counts, level)


def bootstrap_sums(
    values: ArrayLike, scenes: ArrayLike, *, rng: np.random.Generator, num: int = 2000
) -> NDArray[np.float64]:
    """Sums (num, k) of values (n, k) over the pairs of scenes drawn with replacement.

    For figures that are made of sums, such as means over pixels. NaN for less than ``MIN_SCENES``.
    """
    values = np.asarray(values, dtype=np.float64)
    _, scene = np.unique(np.asarray(scenes), return_inverse=True)
    by_scene = np.stack([np.bincount(scene, weights=column) for column in values.T], axis=1)
    of = len(by_scene)
    if of < MIN_SCENES:
        return np.full((num, values.shape[1]), np.nan)
    return np.asarray(by_scene[rng.integers(0, of, (num, of))].sum(1))


def interval_of(figures: NDArray[np.float64], level: float = 0.95) -> tuple[float, float]:
    """Percentile interval of a figure (num,) over draws; NaN, where one has none, are left out."""
    known = figures[~np.isnan(figures)]
    if not known.size:
        return np.nan, np.nan
    low, high = np.quantile(known, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _mean_per_pair(values: Tensor, counted: Tensor, *, signed: bool = False) -> Tensor:
    """Mean (B,) of values, or of their sizes, where counted; NaN where nothing is."""
    values = (values if signed else values.abs()).where(counted, 0.0)
    return values.flatten(1).sum(1) / counted.flatten(1).sum(1)


def _require_one_scale(
    estimate: Rectification | RectifiedViews, exact: Rectification | RectifiedViews
) -> None:
    difference = float((estimate.K_new - exact.K_new).abs().max())
    if difference > 0:
        raise ValueError(
            f"the two rectifications have intrinsics {difference:.3g} px apart, expected one K_new "
            "for both: pass the nominal rig's to rectify(..., K_new=...)."
        )
