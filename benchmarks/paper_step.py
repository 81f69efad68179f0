"""Parameters, FLOPs, seconds and peak memory of one real training step, and of inference.

    python benchmarks/paper_step.py [--preset paper] [--batch 1] [--device cpu]

A noise pair with exact correspondences goes through the network, both losses of the paper, the
backward pass and Adam; each mode runs in a process of its own, so that the peak is its own. FLOPs
are those of matrix products, attention and convolutions (torch.utils.flop_counter), two per
multiply-add.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import tyro
from _table import markdown
from torch.utils.flop_counter import (
    FlopCounterMode,
    sdpa_backward_flop_count,
    sdpa_flop_count,
)

from flowrect.config import TRAINING, TrainOptions
from flowrect.correspondences import Correspondences
from flowrect.metrics import METRIC_WH
from flowrect.model import Rectifier
from flowrect.sample import Batch
from flowrect.train import loss_terms, predict
from simgen.geometry import intrinsics

aten = torch.ops.aten
CPU_ATTENTION = {  # the counter knows the kernels of GPUs only
    aten._scaled_dot_product_flash_attention_for_cpu: (
        lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v)
    ),
    aten._scaled_dot_product_flash_attention_for_cpu_backward: (
        lambda grad, q, k, v, *_, **__: sdpa_backward_flop_count(grad, q, k, v)
    ),
}


@dataclass(frozen=True)
class Options:
    """One step of training, and one of inference."""

    preset: Literal["paper", "small"] = "paper"
    batch: int = 1
    device: str = "cpu"
    threads: int = 2


def noise_batch(num: int, wh: tuple[int, int]) -> Batch:
    """Pairs of noise with a 90° lens, unturned cameras 0.8 m apart, points 8 m and further away."""
    generator = torch.Generator().manual_seed(0)
    images = [
        torch.rand(num, 3, h, w, generator=generator) for w, h in (wh, wh, METRIC_WH, METRIC_WH)
    ]
    K, K_metric = (
        torch.from_numpy(np.tile(intrinsics(x, 90.0), (num, 1, 1))) for x in (wh, METRIC_WH)
    )
    R = torch.eye(3, dtype=torch.float64).expand(num, 3, 3).contiguous()
    t = torch.tensor([-0.8, 0.0, 0.0], dtype=torch.float64).expand(num, 3).contiguous()
    left = 2 * torch.rand(num, 2048, 3, generator=generator, dtype=torch.float64) - 1
    left[..., 1] *= 0.5
    left[..., 2] = 1
    inverse_depth = torch.rand(num, 2048, generator=generator, dtype=torch.float64) / 8
    right = left + inverse_depth[..., None] * t[:, None]
    true = torch.ones(num, 2048, dtype=torch.bool)
    truth = Correspondences(left, right, true, true, 1 / inverse_depth)
    return Batch(images[0], images[1], K, K, images[2], images[3], K_metric, K_metric, R, t, R, t,
                 truth, [""] * num)  # fmt: skip


def measure(mode: str, options: Options) -> tuple[float, float, float]:
    """Seconds, peak memory [GiB] and FLOPs [G] per pair of the second run of ``mode``."""
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    training = TRAINING[options.preset]
    model = Rectifier(training.model).to(options.device)
    optimiser = torch.optim.Adam(model.parameters(), lr=training.lr)
    batch = noise_batch(options.batch, training.model.input_wh).to(options.device)
    run_once(mode, model, optimiser, batch, training)
    started = time.perf_counter()
    run_once(mode, model, optimiser, batch, training)
    seconds, peak = time.perf_counter() - started, peak_gib(options.device)
    with FlopCounterMode(display=False, custom_mapping=CPU_ATTENTION) as flops:
        run_once(mode, model, optimiser, batch, training)
    return seconds, peak, flops.get_total_flops() / options.batch / 1e9


def run_once(
    mode: str, model: Rectifier, optimiser: torch.optim.Optimizer, batch: Batch,
    training: TrainOptions,
) -> None:  # fmt: skip
    """One training step, or one inference; waits for the device."""
    model.train(mode == "training")  # norms and the number of passes differ
    with torch.set_grad_enabled(mode == "training"):
        prediction = predict(model, batch, training)
        if mode == "training":
            loss = torch.stack(list(loss_terms(prediction, batch, training).values())).sum()
            assert torch.isfinite(loss), "the loss of a training step is finite"
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    if batch.left.is_cuda:
        torch.cuda.synchronize()


def peak_gib(device: str) -> float:
    """Largest memory so far: of the process, or of what torch holds on the GPU."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main(options: Options) -> None:
    """Prints the table."""
    config = TRAINING[options.preset].model
    parameters = sum(p.numel() for p in Rectifier(config).parameters())
    w, h = config.input_wh
    print(f"preset {options.preset}, {w}x{h}, batch {options.batch}, {options.device}, "
          f"{options.threads} threads: {parameters:,} parameters\n")  # fmt: skip
    rows = []
    for mode in ("inference", "training"):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append((mode, *pool.apply(measure, (mode, options))))
    print(markdown(("mode", "s per step", "peak GiB", "GFLOP per pair"), rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
