"""Trains RAFT on exact flow: ``python -m flowrect.train_flow --data shards/``.

A teacher of vertical flow meets unrectified pairs and pairs that were rectified by a wrong pose, so
both are trained on, at 512×256, where the losses and metrics live. Truth are the exact
correspondences of a pair, which lie between pixels: the predicted flow is interpolated there.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from torch import Tensor
from torch.nn import functional as F

from flowrect import loop
from flowrect.config import FlowOptions
from flowrect.correspondences import Correspondences
from flowrect.drectify import rectify, warp
from flowrect.flow_network import (
    MIN_SIDE,
    STRIDE,
    FlowCard,
    FlowNetwork,
    Flows,
    card_of,
    load_flow,
    save_flow,
)
from flowrect.geometry import inside, project, rotation_from_vector
from flowrect.loading import PairLoader
from flowrect.losses import across_epipolar_lines, match_cross_entropy
from flowrect.metrics import METRIC_WH
from flowrect.sample import Batch
from simgen.errors import UserError

DECAY = 0.8
"""weight of each refinement over the next one's. Source: RAFT (Teed and Deng, 2020), Eq. 7"""


class Views(NamedTuple):
    """Pairs as a flow network meets them, at ``METRIC_WH``."""

    batch: Batch
    """its metric images, with their K and truth"""
    valid: Tensor
    """(B, 1, H, W) bool: both images have content here"""
    vertical: Tensor
    """(B,) bool: the baseline is vertical"""


def as_they_stand(batch: Batch) -> Views:
    """The pairs unrectified, which fill their images."""
    assert batch.R is not None, "checked by FlowTask.require"
    assert batch.t is not None, "checked by FlowTask.require"
    rect = rectify(batch.R, batch.t, batch.K_left_metric, batch.K_right_metric, METRIC_WH)
    return Views(batch, torch.ones_like(batch.left_metric[:, :1], dtype=torch.bool), rect.vertical)


def rectified_wrongly(batch: Batch, error_deg: float, *, rng: torch.Generator) -> Views:
    """The pairs rectified by a pose whose rotation is wrong; images at ``METRIC_WH``.

    Each component of the error's rotation vector is uniform within ± ``error_deg``.
    """
    assert batch.R is not None, "checked by FlowTask.require"
    assert batch.t is not None, "checked by FlowTask.require"
    assert batch.truth is not None, "checked by FlowTask.require"
    unit = 2 * torch.rand(len(batch), 3, generator=rng, dtype=torch.float64) - 1
    error = rotation_from_vector(torch.deg2rad(error_deg * unit).to(batch.R.device))
    K_left, K_right = batch.K_left_metric, batch.K_right_metric
    rect = rectify(error @ batch.R, batch.t, K_left, K_right, METRIC_WH)
    left, valid_left = warp(batch.left_metric, K_left, rect.R_left, rect.K_new, METRIC_WH)
    right, valid_right = warp(batch.right_metric, K_right, rect.R_right, rect.K_new, METRIC_WH)
    shown = inside(project(K_left, batch.truth.rays_left), METRIC_WH)
    shown &= inside(project(K_right, batch.truth.rays_right), METRIC_WH)
    turned = batch.truth.rotated(left=rect.R_left, right=rect.R_right)
    turned = replace(turned, visible=turned.visible & shown)  # elsewhere there is only black
    values = {**vars(batch), "left_metric": left, "right_metric": right, "truth": turned,
              "K_left_metric": rect.K_new, "K_right_metric": rect.K_new}  # fmt: skip
    return Views(Batch(**values), valid_left & valid_right, rect.vertical)


def cropped(batch: Batch, wh: tuple[int, int], *, rng: torch.Generator) -> Batch:
    """The same window, drawn anew, of all images at ``METRIC_WH``; K (B, 3, 3) follows."""
    (w, h), (W, H) = wh, METRIC_WH
    u, v = (int(torch.randint(n + 1, (), generator=rng)) for n in (W - w, H - h))
    offset = torch.zeros(3, 3, dtype=torch.float64)
    offset[:2, 2] = torch.tensor([u, v])
    window = (..., slice(v, v + h), slice(u, u + w))
    values = {
        **vars(batch),
        "left_metric": batch.left_metric[window], "right_metric": batch.right_metric[window],
        "K_left_metric": batch.K_left_metric - offset.to(batch.K_left_metric),
        "K_right_metric": batch.K_right_metric - offset.to(batch.K_right_metric),
    }  # fmt: skip
    return Batch(**values)


def flow_at(flow: Tensor, uv: Tensor) -> Tensor:
    """Flow (B, N, 2) of (B, 2, H, W), interpolated bilinearly at uv (B, N, 2) [px]."""
    size = uv.new_tensor([flow.shape[-1], flow.shape[-2]])
    grid = ((2 * uv + 1) / size - 1).to(flow.dtype)[:, None]
    sampled = F.grid_sample(flow, grid, padding_mode="border", align_corners=False)
    return sampled[:, :, 0].mT


def exact_flow(
    truth: Correspondences, K_left: Tensor, K_right: Tensor, wh: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Left ends (B, N, 2) [px], their flow (B, N, 2) [px], and where it counts (B, N).

    It counts where the point is seen by both cameras and lies in both images.
    """
    uv_left, uv_right = project(K_left, truth.rays_left), project(K_right, truth.rays_right)
    counted = truth.visible & inside(uv_left, wh) & inside(uv_right, wh)
    return uv_left, uv_right - uv_left, counted


def flow_errors(predicted: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """(du, dv) errors (B, N, 2) [px] of a predicted flow, and where they count (B, N)."""
    assert batch.truth is not None, "checked by FlowTask.require"
    h, w = predicted.shape[-2:]
    uv, flow, counted = exact_flow(batch.truth, batch.K_left_metric, batch.K_right_metric, (w, h))
    error = flow_at(predicted, uv) - flow
    return torch.where(counted[..., None], error, 0.0), counted


def error_sizes(predicted: Tensor, seen: Views) -> Tensor:
    """End-point and |vertical| error (N, 2) [px] of a predicted flow, wherever they count.

    Vertical is across the epipolar lines: the error of du if the baseline is vertical.
    """
    error, counted = flow_errors(predicted, seen.batch)
    across = across_epipolar_lines(error, seen.vertical).abs()
    return torch.stack([error.norm(dim=-1), across], dim=-1)[counted]


def weighted_l1(error: Tensor, vertical: Tensor, weight: float) -> Tensor:
    """|du| + |dv| (B, N) [px] of errors (B, N, 2), the one across the epipolar lines weighted."""
    return error.abs().sum(-1) + (weight - 1) * across_epipolar_lines(error, vertical).abs()


def correlation_loss(flows: Flows, batch: Batch) -> Tensor:
    """Cross-entropy [nats] of matches by ``Flows.correlation`` alone against exact flow."""
    assert batch.truth is not None, "checked by FlowTask.require"
    h, w = batch.left_metric.shape[-2:]
    uv, flow, counted = exact_flow(batch.truth, batch.K_left_metric, batch.K_right_metric, (w, h))
    log_matches = flows.correlation.float().log_softmax(-1)
    seen_px = uv.new_tensor(flows.feature_wh) * STRIDE / uv.new_tensor([w, h])
    left, right = (((end + 0.5) * seen_px - 0.5) / STRIDE for end in (uv, uv + flow))
    return match_cross_entropy(log_matches, left, right, counted, flows.feature_wh)


class FlowTask:
    """RAFT and its loss, as ``flowrect.loop`` trains them."""

    def __init__(self, options: FlowOptions) -> None:
        if not (options.updates or options.matching):
            raise UserError(
                "nothing to minimise: --updates and --matching are 0. Take one of them."
            )
        if any(
            c % STRIDE or not MIN_SIDE <= c <= m
            for c, m in zip(options.crop_wh, METRIC_WH, strict=True)
        ):
            raise UserError(
                f"--crop-wh {options.crop_wh}: expected multiples of {STRIDE} from {MIN_SIDE} px "
                f"to {METRIC_WH}."
            )
        options = as_initial(options)
        assert options.magnify is not None
        if not 1 <= options.magnify <= 4:
            raise UserError(f"--magnify {options.magnify:g}: expected 1 to 4.")
        if options.refine is None or options.refine < 1:
            raise UserError(f"--refine {options.refine}: expected at least 1.")
        self.options = options
        self.input_wh = METRIC_WH
        self._before = card_of(options.init) if options.init else FlowCard()
        seen = options.magnify, options.refine
        network = load_flow(options.init, *seen) if options.init else FlowNetwork("small", *seen)
        network.requires_grad_(True)
        if not options.updates:
            network.requires_grad_(False).raft.feature_encoder.requires_grad_(True)
        self.model: FlowNetwork = network.train().to(memory_format=torch.channels_last)
        self.score = "rectified_vertical_median_px" if options.updates else "matching_nats"

    def require(self, batch: Batch) -> None:
        """Raises where there is no exact flow."""
        if batch.R is None or batch.truth is None:
            raise UserError(
                f"{self.options.data}: {batch.names[0]} has no depth, so there is no exact flow to "
                "train on; expected a set that simgen rendered."
            )

    def terms(self, network: torch.nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Mean error of each refinement [px], the later the heavier; and that of its matches."""
        rng = torch.default_generator
        if torch.rand(()) < self.options.rectified:
            seen = rectified_wrongly(batch, self.options.error_deg, rng=rng)
        else:
            seen = as_they_stand(batch)
        batch = cropped(seen.batch, self.options.crop_wh, rng=rng)
        updates = self.options.updates
        flows: Flows = network(batch.left_metric, batch.right_metric, updates)
        terms = {}
        if updates:
            total = batch.left_metric.new_zeros((), dtype=torch.float64)
            for k, flow in enumerate(flows.refined):
                error, counted = flow_errors(flow, batch)
                sizes = weighted_l1(error, seen.vertical, self.options.vertical)
                mean = sizes.sum() / counted.sum().clamp(min=1)
                total = total + DECAY ** (updates - 1 - k) * mean
            terms["flow"] = total
        if self.options.matching:
            terms["matching"] = self.options.matching * correlation_loss(flows, batch)
        return terms

    @torch.inference_mode()
    def validate(self, loader: PairLoader) -> dict[str, float]:
        """Of perturbed and of rectified pairs: mean end-point error and median |vertical error|
        [px], if any refinement is trained, and mean cross-entropy of the matches [nats]."""
        device = next(self.model.parameters()).device
        rng = torch.Generator().manual_seed(0)
        errors: dict[str, list[Tensor]] = {"": [], "rectified_": []}
        nats: dict[str, list[Tensor]] = {"": [], "rectified_": []}
        self.model.eval()
        for batch in loader:
            batch = batch.to(device)
            wrong = rectified_wrongly(batch, self.options.error_deg, rng=rng)
            for kind, seen in (("", as_they_stand(batch)), ("rectified_", wrong)):
                updates = self.model.updates if self.options.updates else 0
                flows = self.model(seen.batch.left_metric, seen.batch.right_metric, updates)
                nats[kind].append(correlation_loss(flows, seen.batch))
                if updates:
                    errors[kind].append(error_sizes(flows.refined[-1], seen))
        self.model.train()
        scores = {}
        for kind in errors:
            if errors[kind]:
                end_point, vertical = torch.cat(errors[kind]).unbind(-1)
                scores[f"{kind}end_point_px"] = end_point.mean().item()
                scores[f"{kind}vertical_median_px"] = vertical.median().item()
            scores[f"{kind}matching_nats"] = torch.stack(nats[kind]).mean().item()
        return scores

    def save(self, path: Path, seen: loop.Seen) -> None:
        """Writes the weights with their card."""
        samples = self._before.samples + seen.samples
        data, model = str(self.options.data.name), self.model
        hours = round(self._before.hours + seen.hours, 2)
        save_flow(path, model, FlowCard(samples, data, model.magnify, model.updates, hours))


def as_initial(options: FlowOptions) -> FlowOptions:
    """The options with what the weights of ``--init`` remember, unless something else is given."""
    card = card_of(options.init) if options.init else FlowCard()
    magnify = card.magnify if options.magnify is None else options.magnify
    refine = card.updates if options.refine is None else options.refine
    return replace(options, magnify=magnify, refine=refine)


def train_flow(options: FlowOptions) -> dict[str, float]:
    """Trains until the epochs, steps or minutes are over; returns the last validation."""
    options = as_initial(options)
    return loop.train(lambda: FlowTask(options), options)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(FlowOptions, args=arguments, prog="flowrect.train_flow")
    try:
        scores = train_flow(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(", ".join(f"{name} {value:.3f}" for name, value in scores.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
