"""Second pass: predictions to figures, pair by pair; see CONVENTIONS.md for what each one means.

A pair for which a method failed is scored with the prior, which is what its user is left with, and
counted. A pose whose rectified images have nothing in common fails, too: it has no figures in
pixels, and takes the prior's, but its angles stay its own. Rectified images are 512×256.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from flowrect.drectify import Rectification, rectify, warp
from flowrect.evaluation.delivered import Delivered, Translation, prior
from flowrect.evaluation.offsets import Look
from flowrect.evaluation.predictions import Prediction
from flowrect.methods import PoseEstimate
from flowrect.metrics import (
    METRIC_WH,
    angles_deg,
    disparity_bias,
    exact_vertical_flow,
    geodesic_deg,
    rectified_image_error,
    unrectified_vertical_flow,
)
from flowrect.sample import Batch, Image, collate

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
    pairs: Delivered,
    rows: Rows,
    translations: Sequence[Translation],
    *,
    looks: Sequence[Look],
    matched: Sequence[int],
) -> Iterator[list[Score]]:
    """Scores of all methods, pair by pair.

    Args:
      looks: they measure what is left between rectified images.
      matched: indices of the pairs for which they do.
    """
    for i in range(len(pairs)):
        prepared = pairs[i]
        batch, pair = collate([prepared]), prepared.input
        look = looks if i in set(matched) else ()
        found = []
        for translation in translations:
            start = prior(pair, translation)
            nominal = PoseEstimate(start[:3, :3], start[:3, 3])
            assert pair.T_right_left is not None
            truth = PoseEstimate(pair.T_right_left[:3, :3], pair.T_right_left[:3, 3])
            own = {UNRECTIFIED: Prediction(i, pair.name, nominal),
                   TRUTH: Prediction(i, pair.name, truth)}  # fmt: skip
            for method in [UNRECTIFIED, *_methods(rows, translation), TRUTH]:
                row = own.get(method) or rows[method, translation].get(i)
                if row is None:
                    continue
                figures, failure = _scored(batch, row, nominal, translation, look)
                known = row.known
                found.append(Score(
                    method, translation, i, pair.name, pair.scene, pair.weather, pair.daylight,
                    figures, failure, "; ".join(known.notes), known.num_matches, known.seconds,
                    row.made_on,
                ))  # fmt: skip
        yield found


def _scored(
    batch: Batch,
    row: Prediction,
    nominal: PoseEstimate,
    translation: Translation,
    looks: Sequence[Look],
) -> tuple[dict[str, float], str]:
    """Figures, and why they, or those in pixels, are the prior's if they are."""
    as_it_is = row.estimate is nominal
    if row.estimate is None:
        return _figures(batch, nominal, translation, looks), row.failure
    figures = _figures(batch, row.estimate, translation, looks, as_it_is=as_it_is)
    if batch.truth is not None and np.isnan(figures["vertical_flow_px"]):
        own = {name: figures[name] for name in ANGLES}
        left_over = _figures(batch, nominal, translation, looks) | own
        return left_over, "its rectified images have nothing in common"
    return figures, ""


def _methods(rows: Rows, translation: Translation) -> list[str]:
    return [m for m, t in rows if t == translation and m not in (UNRECTIFIED, TRUTH)]


@torch.inference_mode()
def _figures(
    batch: Batch,
    estimate: PoseEstimate,
    translation: Translation,
    looks: Sequence[Look],
    *,
    as_it_is: bool = False,
) -> dict[str, float]:
    """All figures of one estimate; t = gt replaces the estimate's own t by the true one.

    ``as_it_is``: images are not warped at all.
    """
    assert batch.R is not None
    assert batch.t is not None
    K_left, K_right = batch.K_left_metric, batch.K_right_metric
    nominal = rectify(batch.R_nominal, batch.t_nominal, K_left, K_right, METRIC_WH)
    t = batch.t if translation == "gt" else _tensor(estimate.t)
    R = _tensor(estimate.R)
    rect = rectify(R, t, K_left, K_right, METRIC_WH)
    one_scale = rectify(R, t, K_left, K_right, METRIC_WH, K_new=nominal.K_new)
    exact = rectify(batch.R, batch.t, K_left, K_right, METRIC_WH, K_new=nominal.K_new)
    views = batch.left_metric, batch.right_metric, K_left, K_right
    error = rectified_image_error(*views, one_scale, exact)
    angles = *angles_deg(batch.R, R)[0].abs().tolist(), geodesic_deg(batch.R, R).item()
    found = {
        **dict(zip(ANGLES, angles, strict=True)),
        "vertical_flow_px": np.nan, "disparity_bias_px": np.nan,
        "mae_paper": error.paper.item(), "mae_valid": error.valid.item(),
    }  # fmt: skip
    if as_it_is:
        error_now = (torch.cat(views[:2]) - torch.cat(_views(batch, exact)[:2])).abs().mean()
        found |= {"mae_paper": 2 * error_now.item(), "mae_valid": np.nan}
    if batch.truth is not None:
        some = batch.truth.subset(slice(None, None, BIAS_EVERY))
        found["disparity_bias_px"] = disparity_bias(one_scale, exact, some).item()
        found["vertical_flow_px"] = (
            unrectified_vertical_flow(batch.truth, K_left, K_right, nominal.vertical).item()
            if as_it_is
            else exact_vertical_flow(rect, batch.truth).item()
        )
    if not looks:
        return found
    everywhere = torch.ones(METRIC_WH[::-1], dtype=torch.bool)
    *both, valid = (*views[:2], everywhere) if as_it_is else _views(batch, rect)
    left, right = map(_image, both)
    for look in looks:
        found |= look.figures(left, right, valid.numpy(), vertical=bool(nominal.vertical))
    return found


def _tensor(x: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(x, dtype=np.float64))[None]


def _views(batch: Batch, rect: Rectification) -> tuple[Tensor, Tensor, Tensor]:
    """Both images (1, 3, h, w), rectified, and where (h, w) both are filled."""
    left, filled_left = warp(
        batch.left_metric, batch.K_left_metric, rect.R_left, rect.K_new, METRIC_WH
    )
    right, filled_right = warp(
        batch.right_metric, batch.K_right_metric, rect.R_right, rect.K_new, METRIC_WH
    )
    return left, right, (filled_left & filled_right)[0, 0]


def _image(x: Tensor) -> Image:
    return (x[0] * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
