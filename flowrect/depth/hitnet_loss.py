"""What HITNet is trained for, at exact points that lie between pixels.

The paper compares dense maps; here truth are points u, v with their disparity, as exact
correspondences give them, and the plane of the tile that a point falls on is evaluated right there.
Source: HITNet (Tankovich et al., CVPR 2021), the section on losses.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from flowrect.config import HitnetLoss
from flowrect.depth.hitnet import Init, Stage, TilePrediction
from flowrect.depth.tiles import TILE, tile_cost_at

MARGIN = 1.0
"""β: how far the cost of the best wrong match should be from 0"""
APART_PX = 1.5
"""a match that is this far from the truth is wrong; so is a hypothesis (C2)"""
NEAR_PX = 1.0
"""a hypothesis this near is right (B and C1)"""
ALPHA, WIDTH_PX = 0.9, 0.1
"""shape α and scale c of Barron's robust loss. The paper can cut errors off (A); exact truth has no
outliers to cut, so A = ∞"""
WINDOW = 9
"""side of the square whose points a slope is fitted to [px]"""
FLAT_PX = 0.3
"""RMS distance of those points from their plane, at most: else there is an edge between them"""


@dataclass(frozen=True)
class PointTruth:
    """Exact disparity of B rectified pairs."""

    uv: Tensor
    """(B, N, 2) [px] of the left image"""
    disparity: Tensor
    """(B, N) [px]"""
    known: Tensor
    """(B, N) bool: in the left image, with a disparity that can be looked for"""
    visible: Tensor
    """(B, N) bool: known, and seen by both cameras"""
    wh: tuple[int, int]


def loss_terms(
    prediction: TilePrediction, truth: PointTruth, weights: HitnetLoss
) -> dict[str, Tensor]:
    """The weighted terms, each a mean over what counts, summed over levels and stages."""
    slopes, flat = fitted_slopes(truth)
    terms = {"init": torch.stack([init_loss(x, truth) for x in prediction.inits]).sum()}
    parts = [stage_losses(stage, truth, slopes, flat) for stage in prediction.stages]
    for name in ("disparity", "slant", "confidence"):
        terms[name] = torch.stack([part[name] for part in parts if name in part]).sum()
    return {name: getattr(weights, name) * term for name, term in terms.items()}


# --- initialisation ----------------------------------------------------------------------------


def init_loss(init: Init, truth: PointTruth) -> Tensor:
    """Mean of ψ(d_gt) + max(β − ψ(d_nm), 0) over tiles that show a visible point.

    d_gt is the nearest surface of the tile, d_nm the best match that is ``APART_PX`` away from it.
    """
    d = nearest_of_tile(truth, init.scale) / init.scale
    levels = init.costs.shape[1]
    counted = (d >= 0) & (d <= levels - 1)
    d = torch.where(counted, d, 0.0).to(init.left)
    candidates = torch.arange(levels, device=d.device)[:, None, None]
    wrong = (candidates - d[:, None]).abs() > APART_PX
    best, d_wrong = init.costs.masked_fill(~wrong, float("inf")).min(1)
    match = tile_cost_at(init.left, init.right, d)
    other = tile_cost_at(init.left, init.right, d_wrong.to(d))
    other = torch.where(best.isfinite(), other, MARGIN)  # there is no other at the left border
    return _mean(match + (MARGIN - other).clamp(0), counted)


def nearest_of_tile(truth: PointTruth, scale: int) -> Tensor:
    """Greatest disparity (B, rows, columns) [full px] of a tile's visible points; −1 if none."""
    index, shape = _tile_of(truth, TILE * scale)
    values = torch.where(truth.visible, truth.disparity, -1.0)
    empty = values.new_full((len(values), shape[0] * shape[1]), -1.0)
    return empty.scatter_reduce(1, index, values, "amax").unflatten(1, shape)


# --- hypotheses --------------------------------------------------------------------------------


def stage_losses(
    stage: Stage, truth: PointTruth, slopes: Tensor, flat: Tensor
) -> dict[str, Tensor]:
    """Means over known points; slopes (B, N, 2) count where ``flat`` (B, N)."""
    disparity, slants, confidence = at_points(stage, truth)
    error = disparity - truth.disparity
    size = error.detach().abs()
    near = truth.known & (size < NEAR_PX)
    losses = {
        "disparity": _mean(robust(error), truth.known),
        "slant": _mean((slants - slopes).abs().sum(-1), near & flat),
    }
    if confidence is not None:
        wanting = (1 - confidence).clamp(0) * (size < NEAR_PX)
        undue = confidence.clamp(0) * (size > APART_PX)
        losses["confidence"] = _mean(wanting + undue, truth.known)
    return losses


def at_points(stage: Stage, truth: PointTruth) -> tuple[Tensor, Tensor, Tensor | None]:
    """Disparity (B, N) [full px], slopes (B, N, 2) and confidence (B, N) of a stage at points."""
    side = stage.side * stage.scale
    index, (_, columns) = _tile_of(truth, side)
    planes = _taken(stage.hypothesis[:, :3].flatten(2), index)
    tile = torch.stack([index % columns, index // columns], dim=-1)
    offset = truth.uv - (side * (tile + 0.5) - 0.5)
    disparity = stage.scale * planes[:, 0] + (planes[:, 1:].mT * offset).sum(-1)
    confidence = None
    if stage.confidence is not None:
        confidence = stage.confidence.flatten(1).gather(1, index)
    return disparity, planes[:, 1:].mT, confidence


def robust(x: Tensor) -> Tensor:
    """Barron's general robust loss ρ(x, α, c). Source: CVPR 2019, Eq. 1."""
    a = abs(ALPHA - 2)
    return a / ALPHA * (((x / WIDTH_PX) ** 2 / a + 1) ** (ALPHA / 2) - 1)


def fitted_slopes(truth: PointTruth) -> tuple[Tensor, Tensor]:
    """∂d/∂u and ∂d/∂v (B, N, 2) at each point, and where they are one surface's (B, N).

    Least squares over the known points of a square of ``WINDOW`` px around the point's pixel, by
    moments: no point is looked up twice.
    """
    w, h = truth.wh
    u, v = truth.uv.double().unbind(-1)
    d = truth.disparity.double()
    one = truth.known.double()
    moments = torch.stack(
        [x * one for x in (one, u, v, d, u * u, u * v, v * v, u * d, v * d, d * d)], 1
    )
    index, _ = _tile_of(truth, 1)
    maps = moments.new_zeros(len(d), moments.shape[1], h * w)
    maps = maps.scatter_add(2, index[:, None].expand_as(moments), moments).unflatten(2, (h, w))
    half = WINDOW // 2
    for kernel, padding in (((WINDOW, 1), (half, 0)), ((1, WINDOW), (0, half))):
        maps = F.avg_pool2d(maps, kernel, 1, padding) * WINDOW
    n, *sums = _taken(maps.flatten(2), index).unbind(1)
    mu, mv, md, uu, uv, vv, ud, vd, dd = (x / n.clamp(min=1) for x in sums)
    uu, uv, vv, ud, vd, dd = (
        uu - mu * mu, uv - mu * mv, vv - mv * mv, ud - mu * md, vd - mv * md, dd - md * md,
    )  # fmt: skip
    determinant = uu * vv - uv * uv
    solvable = (n > 4) & (determinant > 1)  # px⁴: points on a line have 0
    safe = torch.where(solvable, determinant, 1.0)
    dx, dy = (vv * ud - uv * vd) / safe, (uu * vd - uv * ud) / safe
    flat = truth.known & solvable & (dd - dx * ud - dy * vd < FLAT_PX**2)
    return torch.stack([dx, dy], dim=-1), flat


def _tile_of(truth: PointTruth, side: int) -> tuple[Tensor, tuple[int, int]]:
    """Index (B, N) of each point's tile, row by row, and (rows, columns); 0 if unknown."""
    w, h = truth.wh
    rows, columns = h // side, w // side
    column, row = ((truth.uv + 0.5) / side).floor().long().unbind(-1)
    index = row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)
    return torch.where(truth.known, index, 0), (rows, columns)


def _taken(maps: Tensor, index: Tensor) -> Tensor:
    """(B, C, N) of (B, C, tiles) at index (B, N)."""
    return maps.gather(2, index[:, None].expand(-1, maps.shape[1], -1))


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    return torch.where(counted, values, 0.0).sum() / counted.sum().clamp(min=1)
