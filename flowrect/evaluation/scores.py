"""Second pass: predictions to figures, pair by pair; see CONVENTIONS.md for what each one means.

A pair for which a method failed is scored with the prior, which is what its user is left with, and
counted. A pose whose rectified images have nothing in common fails, too, and so does one that lays
the baseline of a horizontal rig upright: it has no figures in pixels, and takes the prior's, but
its angles stay its own. Rectified images are 512×256.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from flowrect.correspondences import Correspondences
from flowrect.drectify import Rectification, rectify
from flowrect.evaluation.delivered import Delivered, Translation, prior
from flowrect.evaluation.offsets import Look
from flowrect.evaluation.predictions import Prediction
from flowrect.methods import PoseEstimate
from flowrect.metrics import (
    METRIC_WH,
    RectifiedViews,
    angles_deg,
    disparity_bias,
    exact_vertical_flow,
    geodesic_deg,
    rectified_image_error,
    rectified_views,
    unrectified_vertical_flow,
)
from flowrect.sample import Batch, Image, Prepared, collate

ANGLES = ("pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg")
TRUTH, UNRECTIFIED = "truth", "unrectified"
BIAS_EVERY = 31
"""every so many-th left pixel is enough for a bias, which is smooth"""


@dataclass(frozen=True)
class Score:
    """Figures of one method on one pair."""

    method: str
    translation: Translation
    index: int
    name: str
    scene: str
    weather: str
    daylight: str
    figures: Mapping[str, float]
    """NaN where there is none"""
    failure: str = ""
    notes: str = ""
    """what the method itself says against its estimate"""
    num_matches: int | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    """by stage; empty where they are not known"""
    made_on: str = ""
    """machine and threads"""


Rows = Mapping[tuple[str, str], Mapping[int, Prediction]]
"""predictions by method, translation and pair"""


def scored(
    pairs: Delivered, rows: Rows, translations: Sequence[Translation], i: int, looks: Sequence[Look]
) -> list[Score]:
    """Scores of all methods on pair ``i``; ``looks`` measure what is left once it is rectified."""
    prepared = pairs[i]
    pair, truth = prepared.input, _Truth.of(prepared)
    found = []
    for translation in translations:
        start = prior(pair, translation)
        nominal = PoseEstimate(start[:3, :3], start[:3, 3])
        assert pair.T_right_left is not None
        exact = PoseEstimate(pair.T_right_left[:3, :3], pair.T_right_left[:3, 3])
        own = {UNRECTIFIED: Prediction(i, pair.name, nominal),
               TRUTH: Prediction(i, pair.name, exact)}  # fmt: skip
        for method in [UNRECTIFIED, *_methods(rows, translation), TRUTH]:
            row = own.get(method) or rows[method, translation].get(i)
            if row is None:
                continue
            figures, failure = _scored(truth, row, nominal, translation, looks)
            known = row.known
            found.append(Score(
                method, translation, i, pair.name, pair.scene, pair.weather, pair.daylight,
                figures, failure, "; ".join(known.notes), known.num_matches, known.seconds,
                row.made_on,
            ))  # fmt: skip
    return found


@dataclass(frozen=True)
class _Truth:
    """A pair, and all that is the same for every estimate of its pose."""

    batch: Batch
    nominal: Rectification
    exact: Rectification
    """by the true pose, with the nominal one's K_new"""
    exact_views: RectifiedViews
    some: Correspondences | None
    """of its points, enough for what is smooth"""

    @staticmethod
    @torch.inference_mode()
    def of(prepared: Prepared) -> _Truth:
        batch = collate([Prepared(prepared.metric, prepared.metric)])  # the input is not looked at
        K = batch.K_left_metric, batch.K_right_metric
        nominal = rectify(batch.R_nominal, batch.t_nominal, *K, METRIC_WH)
        assert batch.R is not None
        assert batch.t is not None
        exact = rectify(batch.R, batch.t, *K, METRIC_WH, K_new=nominal.K_new)
        views = rectified_views(batch.left_metric, batch.right_metric, *K, exact)
        every = slice(None, None, BIAS_EVERY)
        some = batch.truth.subset(every) if batch.truth is not None else None
        return _Truth(batch, nominal, exact, views, some)


def _scored(
    truth: _Truth,
    row: Prediction,
    nominal: PoseEstimate,
    translation: Translation,
    looks: Sequence[Look],
) -> tuple[dict[str, float], str]:
    """Figures, and why they, or those in pixels, are the prior's if they are."""
    if row.estimate is nominal:
        return _figures(truth, nominal, translation, looks, as_it_is=True), ""
    if row.estimate is None:
        return _figures(truth, nominal, translation, looks), row.failure
    if useless := _useless(truth, row.estimate, translation):
        own = _angles(truth, row.estimate)
        return _figures(truth, nominal, translation, looks) | own, useless
    return _figures(truth, row.estimate, translation, looks), ""


def _useless(truth: _Truth, estimate: PoseEstimate, translation: Translation) -> str:
    """Why nobody could match the images that a pose rectifies; empty if one can."""
    batch = truth.batch
    assert batch.t is not None
    t = batch.t if translation == "gt" else _tensor(estimate.t)
    K = batch.K_left_metric, batch.K_right_metric
    rect = rectify(_tensor(estimate.R), t, *K, METRIC_WH)
    if bool(rect.vertical != truth.exact.vertical):
        return "its baseline lies across that of the rig"
    if truth.some is None:
        views = rectified_views(batch.left_metric, batch.right_metric, *K, rect)
        meet = bool(views.filled.all(1).any())
    else:
        meet = not exact_vertical_flow(rect, truth.some).isnan()
    return "" if meet else "its rectified images have nothing in common"


def _methods(rows: Rows, translation: Translation) -> list[str]:
    return [m for m, t in rows if t == translation and m not in (UNRECTIFIED, TRUTH)]


@torch.inference_mode()
def _figures(
    truth: _Truth,
    estimate: PoseEstimate,
    translation: Translation,
    looks: Sequence[Look],
    *,
    as_it_is: bool = False,
) -> dict[str, float]:
    """All figures of one estimate; t = gt replaces the estimate's own t by the true one.

    ``as_it_is``: images are not warped at all.
    """
    batch, K = truth.batch, (truth.batch.K_left_metric, truth.batch.K_right_metric)
    assert batch.R is not None
    assert batch.t is not None
    views = batch.left_metric, batch.right_metric, *K
    t = batch.t if translation == "gt" else _tensor(estimate.t)
    R = _tensor(estimate.R)
    rect = rectify(R, t, *K, METRIC_WH)
    one_scale = rectify(R, t, *K, METRIC_WH, K_new=truth.nominal.K_new)
    images, filled = torch.stack(views[:2], dim=1), torch.ones((1, 2, *METRIC_WH[::-1])).bool()
    as_they_are = RectifiedViews(images, filled, truth.nominal.K_new)
    seen = as_they_are if as_it_is else rectified_views(*views, one_scale)
    error = rectified_image_error(seen, truth.exact_views)
    found = {
        **_angles(truth, estimate),
        "vertical_flow_px": np.nan, "disparity_bias_px": np.nan,
        "mae_paper": error.paper.item(), "mae_valid": error.valid.item(),
    }  # fmt: skip
    if batch.truth is not None and truth.some is not None:
        found["disparity_bias_px"] = disparity_bias(one_scale, truth.exact, truth.some).item()
        found["vertical_flow_px"] = (
            unrectified_vertical_flow(batch.truth, *K, truth.exact.vertical).item()
            if as_it_is
            else exact_vertical_flow(rect, batch.truth).item()
        )
    if not looks:
        return found
    seen = as_they_are if as_it_is else rectified_views(*views, rect)
    left, right = map(_image, seen.images.unbind(1))
    valid = seen.filled[0].all(0).numpy()
    for look in looks:
        found |= look.figures(left, right, valid, vertical=bool(truth.exact.vertical))
    return found


def _angles(truth: _Truth, estimate: PoseEstimate) -> dict[str, float]:
    """Sizes of its errors [°]."""
    assert truth.batch.R is not None
    R = _tensor(estimate.R)
    errors = *angles_deg(truth.batch.R, R)[0].abs().tolist(), geodesic_deg(truth.batch.R, R).item()
    return dict(zip(ANGLES, errors, strict=True))


def _tensor(x: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(x, dtype=np.float64))[None]


def _image(x: Tensor) -> Image:
    return (x[0] * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
