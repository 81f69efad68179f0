"""Trains HITNet on exact disparity: ``python -m flowrect.train_depth --data shards/``.

Pairs are rectified by the *true* pose at 512×256, so that what is learned is matching along rows
alone. Truth are the exact correspondences of a pair, which lie between pixels.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
import tyro
from torch import Tensor

from flowrect import loop
from flowrect.config import DepthOptions
from flowrect.depth.hitnet import Hitnet
from flowrect.depth.hitnet_loss import PointTruth, at_points, loss_terms
from flowrect.depth.hitnet_weights import DepthCard, load_hitnet, save_hitnet
from flowrect.drectify import rectified_uv, rectify, warp
from flowrect.geometry import inside, project
from flowrect.loading import PairLoader
from flowrect.metrics import METRIC_WH
from flowrect.sample import Batch
from simgen.errors import UserError


def rectified_truly(batch: Batch, max_disparity: float) -> tuple[Tensor, Tensor, PointTruth]:
    """Images (B, 3, 256, 512) rectified by the true pose, and their exact disparity.

    Points count where the left image shows them, occluded in the right one or not.
    """
    assert batch.R is not None, "checked by DepthTask.require"
    assert batch.t is not None, "checked by DepthTask.require"
    assert batch.truth is not None, "checked by DepthTask.require"
    truth, K_left, K_right = batch.truth, batch.K_left_metric, batch.K_right_metric
    rect = rectify(batch.R, batch.t, K_left, K_right, METRIC_WH)
    left, _ = warp(batch.left_metric, K_left, rect.R_left, rect.K_new, METRIC_WH)
    right, _ = warp(batch.right_metric, K_right, rect.R_right, rect.K_new, METRIC_WH)
    uv = rectified_uv(truth.rays_left, rect.R_left, rect.K_new)
    uv_right = rectified_uv(truth.rays_right, rect.R_right, rect.K_new)
    disparity = uv[..., 0] - uv_right[..., 0]
    known = inside(uv, METRIC_WH) & inside(project(K_left, truth.rays_left), METRIC_WH)
    known &= (disparity > -0.5) & (disparity < max_disparity)
    seen = truth.visible & inside(uv_right, METRIC_WH)
    seen &= inside(project(K_right, truth.rays_right), METRIC_WH)
    return left, right, PointTruth(uv, disparity, known, known & seen, METRIC_WH)


class DepthTask:
    """HITNet and its loss, as ``flowrect.loop`` trains them."""

    score = "end_point_px"

    def __init__(self, options: DepthOptions) -> None:
        self.options = options
        self.input_wh = METRIC_WH
        if options.init:
            network, self._before = load_hitnet(Path(options.init))
        else:
            network, self._before = Hitnet(options.model), DepthCard()
        self.model: Hitnet = network.requires_grad_(True).train()

    def require(self, batch: Batch) -> None:
        """Raises where there is no exact disparity."""
        if batch.R is None or batch.t is None or batch.truth is None:
            raise UserError(
                f"{self.options.data}: {batch.names[0]} has no depth, so there is no exact "
                "disparity to train on; expected a set that simgen rendered."
            )
        if bool((batch.t[:, 0].abs() < batch.t[:, 1].abs()).any() or (batch.t[:, 0] > 0).any()):
            raise UserError(
                f"{self.options.data}: one of {', '.join(batch.names)} has no camera to the left; "
                "HITNet is trained on horizontal rigs, the left camera first."
            )

    def terms(self, network: torch.nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The terms of HITNet's loss."""
        left, right, truth = rectified_truly(batch, self.model.config.max_disparity)
        return loss_terms(network(left, right), truth, self.options.loss)

    @torch.inference_mode()
    def validate(self, loader: PairLoader) -> dict[str, float]:
        """Mean |error| [px] of the points that both cameras see, and shares above 1 and 3 px."""
        device = next(self.model.parameters()).device
        parts = []
        self.model.eval()
        for batch in loader:
            left, right, truth = rectified_truly(batch.to(device), self.model.config.max_disparity)
            found, _, _ = at_points(self.model(left, right).stages[-1], truth)
            parts.append((found - truth.disparity)[truth.visible].abs())
        self.model.train()
        error = torch.cat(parts)
        return {
            "end_point_px": error.mean().item(),
            "above_1px": (error > 1).double().mean().item(),
            "above_3px": (error > 3).double().mean().item(),
        }

    def save(self, path: Path, seen: loop.Seen) -> None:
        """Writes the weights with their card."""
        samples = self._before.samples + seen.samples
        hours = round(self._before.hours + seen.hours, 2)
        save_hitnet(path, self.model, DepthCard(samples, self.options.data.name, hours))


def train_depth(options: DepthOptions) -> dict[str, float]:
    """Trains until the epochs, steps or minutes are over; returns the last validation."""
    return loop.train(lambda: DepthTask(options), options)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(DepthOptions, args=arguments, prog="flowrect.train_depth")
    try:
        scores = train_depth(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(", ".join(f"{name} {value:.3f}" for name, value in scores.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
