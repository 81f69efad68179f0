"""How well trained RAFT sees exact flow on test pairs, and what its vertical-flow metric says.

    python benchmarks/flow_metric.py --data test/ --flow-weights runs/raft/best.safetensors

For pairs as they stand, rectified by the true pose, and rectified by one that is wrong by up to 1°
about each axis: end-point error and |vertical error| at 512×256 over what both cameras see, and the
mean |vertical flow| of each pair by RAFT (all pixels that show image in both) and exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from _table import markdown
from torch import Tensor

from flowrect.flow_network import load_flow
from flowrect.loading import Loading, PairLoader
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing
from flowrect.sources import open_source
from flowrect.train_flow import exact_flow, flow_errors, rectified_wrongly
from simgen.errors import UserError

KINDS = {"as they stand": None, "rectified by the truth": 0.0, "rectified, up to 1° off": 1.0}


@dataclass(frozen=True)
class Options:
    """RAFT against exact flow."""

    data: Path
    """a set of simgen; its test frames are taken"""
    flow_weights: str = "raft"
    limit: int = 0
    """pairs at most, evenly chosen; 0: all"""
    batch: int = 4


@torch.inference_mode()
def main(options: Options) -> None:
    """Prints the table."""
    network = load_flow(options.flow_weights)
    pairs = open_source(options.data, split="test", truth_points=8192)
    if options.limit:
        pairs = pairs[:: max(1, len(pairs) // options.limit)]
    loading = Loading(options.batch, workers=1, shuffle=False, drop_last=False)
    rng = torch.Generator().manual_seed(0)
    errors: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}
    flows: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
    for batch in PairLoader(pairs, Sizing(METRIC_WH), None, loading):
        if batch.R is None or batch.truth is None:
            raise UserError(f"{options.data}: {batch.names[0]} has no exact flow.")
        for kind, error_deg in KINDS.items():
            seen = batch if error_deg is None else rectified_wrongly(batch, error_deg, rng=rng)
            flow = network.flow(seen.left_metric, seen.right_metric)
            error, counted = flow_errors(flow, seen)
            errors[kind].append(error[counted])
            assert seen.truth is not None, "as batch"
            _, exact, _ = exact_flow(seen.truth, seen.K_left_metric, seen.K_right_metric, METRIC_WH)
            filled = seen.left_metric.sum(1) > 0
            for b in range(len(seen)):
                by_raft = flow[b, 1][filled[b]].abs().mean().item()
                flows[kind].append((by_raft, exact[b, counted[b], 1].abs().mean().item()))
    rows = []
    for kind in KINDS:
        error = torch.cat(errors[kind])
        raft, exact_mean = np.array(flows[kind]).T
        correlation = np.corrcoef(raft, exact_mean)[0, 1] if np.ptp(exact_mean) > 0.01 else np.nan
        rows.append([
            kind, error.norm(dim=-1).mean().item(), error.norm(dim=-1).median().item(),
            error[:, 1].abs().mean().item(), error[:, 1].abs().median().item(),
            raft.mean(), exact_mean.mean(), correlation,
        ])  # fmt: skip
    print(f"{len(pairs)} pairs, {options.flow_weights}, px at {METRIC_WH[0]}x{METRIC_WH[1]}\n")
    header = ["", "EPE mean", "median", "vertical error mean", "median", "vertical flow by RAFT",
              "exact", "correlation over pairs"]  # fmt: skip
    print(markdown(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
