"""How well trained RAFT sees exact flow on test pairs, and what its vertical-flow metric says.

    python benchmarks/flow_metric.py --data test/ --flow-weights runs/raft/best.safetensors

For pairs as they stand, rectified by the true pose, and rectified by one that is wrong by up to 1°
about each axis: end-point error and |vertical error| at 512×256 over what both cameras see, the
mean of the vertical error with its sign, over each pair and then over pairs, and the mean
|vertical flow| of each pair by RAFT and exactly, where both images have content. RAFT's is of
every such pixel, as in training (losses.image_flow_loss); the exact one, as everywhere
(metrics.exact_vertical_flow), of those whose ends lie in both frames, occluded ones too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
import tyro
from _table import markdown
from torch import Tensor

from flowrect.flow_network import load_flow
from flowrect.loading import Loading, PairLoader
from flowrect.losses import across_epipolar_lines
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing
from flowrect.sample import Batch
from flowrect.sources import open_source
from flowrect.train_flow import (
    Views,
    as_they_stand,
    error_sizes,
    exact_flow,
    flow_errors,
    rectified_wrongly,
)
from simgen.errors import UserError

KINDS = {"as they stand": None, "rectified by the truth": 0.0, "rectified, up to 1° off": 1.0}
HEADER = ("", "EPE mean", "median", "vertical error mean", "median", "its mean with its sign",
          "vertical flow by RAFT", "exact", "correlation over pairs")  # fmt: skip


@dataclass(frozen=True)
class Options:
    """RAFT against exact flow."""

    data: Path
    """a set of simgen; its test frames are taken"""
    flow_weights: str = "raft"
    limit: int = 0
    """pairs at most, evenly chosen; 0: all"""
    batch: int = 4


class Network(Protocol):
    """What sees flow (B, 2, H, W) [px] between images (B, 3, H, W)."""

    def flow(self, left: Tensor, right: Tensor) -> Tensor: ...


def vertical_flows(flow: Tensor, seen: Views) -> Tensor:
    """Mean |vertical flow| (B, 2) [px] of a predicted flow (B, 2, H, W), and of the exact one."""
    batch = seen.batch
    assert batch.truth is not None, "checked by measured"
    predicted = across_epipolar_lines(flow.permute(0, 2, 3, 1), seen.vertical)
    every = replace(batch.truth, visible=torch.ones_like(batch.truth.visible))
    wh = flow.shape[-1], flow.shape[-2]
    uv, exact, counted = exact_flow(every, batch.K_left_metric, batch.K_right_metric, wh)
    counted = counted & _at_nearest(seen.valid, uv)
    exact = across_epipolar_lines(exact, seen.vertical)
    return torch.stack([_mean(predicted, seen.valid[:, 0]), _mean(exact, counted)], dim=-1)


def vertical_bias(flow: Tensor, seen: Views) -> Tensor:
    """Mean vertical error (B,) [px] of a predicted flow (B, 2, H, W), with its sign."""
    error, counted = flow_errors(flow, seen.batch)
    across = across_epipolar_lines(error, seen.vertical)
    return across.where(counted, torch.nan).nanmean(1)


def _at_nearest(valid: Tensor, uv: Tensor) -> Tensor:
    """valid (B, 1, H, W) at the pixels nearest to uv (B, N, 2)."""
    h, w = valid.shape[-2:]
    u, v = uv.round().long().unbind(-1)
    pair = torch.arange(len(valid), device=valid.device)[:, None]
    return valid[pair, 0, v.clamp(0, h - 1), u.clamp(0, w - 1)]


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Mean size (B,) where counted; NaN where nothing is."""
    return values.abs().where(counted, torch.nan).flatten(1).nanmean(1)


@torch.inference_mode()
def measured(network: Network, batches: Iterable[Batch]) -> list[list[object]]:
    """The rows of the table."""
    rng = torch.Generator().manual_seed(0)
    errors: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}
    flows: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}
    bias: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}
    for batch in batches:
        if batch.R is None or batch.truth is None:
            raise UserError(f"{batch.names[0]} has no exact flow; expected rendered pairs.")
        for kind, error_deg in KINDS.items():
            seen = (
                as_they_stand(batch)
                if error_deg is None
                else rectified_wrongly(batch, error_deg, rng=rng)
            )
            flow = network.flow(seen.batch.left_metric, seen.batch.right_metric)
            errors[kind].append(error_sizes(flow, seen))
            flows[kind].append(vertical_flows(flow, seen))
            bias[kind].append(vertical_bias(flow, seen))
    return [_row(k, *(torch.cat(found[k]) for found in (errors, bias, flows))) for k in KINDS]


def _row(kind: str, errors: Tensor, bias: Tensor, flows: Tensor) -> list[object]:
    """From errors (N, 2) of all points, bias (P,) and vertical flows (P, 2) of all pairs."""
    by_network, exact = flows.double().T.numpy()
    vary = min(np.ptp(by_network), np.ptp(exact)) > 0.01
    correlation = np.corrcoef(by_network, exact)[0, 1] if vary else np.nan
    mean, median = errors.mean(0), errors.median(0).values
    figures = (mean[0], median[0], mean[1], median[1], bias.nanmean(), by_network.mean(),
               exact.mean(), correlation)  # fmt: skip
    return [kind, *map(float, figures)]


def main(options: Options) -> None:
    """Prints the table."""
    network = load_flow(options.flow_weights)
    pairs = open_source(options.data, split="test", truth_points=8192)
    if options.limit:
        pairs = pairs[:: -(-len(pairs) // options.limit)]
    loading = Loading(options.batch, workers=1, shuffle=False, drop_last=False)
    rows = measured(network, PairLoader(pairs, Sizing(METRIC_WH), None, loading))
    print(f"{len(pairs)} pairs, {options.flow_weights}, px at {METRIC_WH[0]}x{METRIC_WH[1]}\n")
    print(markdown(HEADER, rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
