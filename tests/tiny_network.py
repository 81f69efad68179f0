"""Networks small enough for tests, and what they are fed: noise, poses and a set on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation
from small_set import make_frame, write_set

from flowrect.config import PAPER, SMALL, TRAINING, TrainOptions
from flowrect.loading import Loading
from flowrect.model import Prediction, Rectifier

WH = (64, 32)
TINY = replace(
    SMALL, input_wh=WH, channels=16, blocks=1, strides=(2, 1, 2, 1), head_hw=(2, 4)
)  # fmt: skip
TINY_PAPER = replace(
    PAPER, input_wh=WH, channels=16, blocks=1, strides=(2, 1, 2, 1), head_hw=(4, 8),
    decoder_rows=4, decoder_channels=(4, 4, 4, 4, 4),
)  # fmt: skip


def network(config=TINY, *, seed: int = 0) -> Rectifier:
    """A network with fixed random weights."""
    torch.manual_seed(seed)
    return Rectifier(config).eval()


def pairs(n: int, *, seed: int, wh: tuple[int, int] = WH, limit_deg: float = 2.0) -> dict:
    """Arguments of the network: noise images, a 90° lens, priors turned by up to a limit."""
    generator = torch.Generator().manual_seed(seed)
    left, right = torch.rand(2, n, 3, wh[1], wh[0], generator=generator)
    f, (cx, cy) = wh[0] / 2, ((wh[0] - 1) / 2, (wh[1] - 1) / 2)
    K = torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=torch.float64).expand(n, 3, 3)
    vectors = (2 * torch.rand(n, 3, generator=generator, dtype=torch.float64) - 1) * limit_deg
    t = torch.tensor([[-0.8, 0.02, -0.03]], dtype=torch.float64).expand(n, 3)
    return {
        "left": left, "right": right, "K_left": K, "K_right": K, "R_init": rotations(vectors),
        "t_init": t,
    }  # fmt: skip


def rotations(vectors_deg: torch.Tensor) -> torch.Tensor:
    """(n, 3, 3) of rotation vectors (n, 3) in degrees, by SciPy."""
    return torch.from_numpy(Rotation.from_rotvec(vectors_deg.numpy(), degrees=True).as_matrix())


def predict(net: Rectifier, arguments: dict) -> Prediction:
    """One pass without gradients."""
    with torch.no_grad():
        return net(**arguments)


def road_set(folder: Path, frames: int = 5) -> Path:
    """A set of simgen's on disk: three pairs a frame; frame 0 is a test frame."""
    return write_set(folder, [make_frame(index) for index in range(frames)])


def training(data: Path, out: Path, **changes: object) -> TrainOptions:
    """Options of a run that takes a second or two."""
    options = replace(
        TRAINING["small"], data=data, out=out, model=TINY, max_steps=3, val_every=9, val_pairs=3,
        loading=Loading(batch=2, workers=0), warmup_steps=0,
    )  # fmt: skip
    return replace(options, **changes)
