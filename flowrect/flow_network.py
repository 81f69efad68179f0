"""Optical flow by RAFT (small), torchvision's network: weights, images in 0…1, flow out.

Used where there is no depth to take exact flow from: as the frozen teacher of the paper's
self-supervision. Torchvision's own weights can be
fetched where there is a network; ``flowrect.train_flow`` trains some where there is none.
"""

from __future__ import annotations

import json
import os
import pickle
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torchvision.models.optical_flow import Raft_Small_Weights, raft_small

from flowrect.weights import SHIPPED
from simgen.errors import UserError

FORMAT = "flowrect-flow-1"
MIN_SIDE = 128
"""[px] RAFT looks at an eighth of the size, and halves that three times"""
UPDATES = 12


@dataclass(frozen=True)
class FlowCard:
    """What is known of trained flow weights."""

    samples: int = 0
    """pairs seen in training"""
    data: str = ""
    """what they were trained on"""


class FlowNetwork(nn.Module):
    """RAFT from images in 0…1."""

    def __init__(self) -> None:
        super().__init__()
        self.raft = raft_small(weights=None)

    def flow(self, left: Tensor, right: Tensor) -> Tensor:
        """Flow (B, 2, H, W) [px] from left to right images (B, 3, H, W)."""
        last: Tensor = self(left, right)[-1]
        return last

    def forward(self, left: Tensor, right: Tensor, updates: int = UPDATES) -> list[Tensor]:
        """The flow after each of its updates; H and W are multiples of 8."""
        h, w = left.shape[-2:]
        if min(h, w) < MIN_SIDE or h % 8 or w % 8:
            raise UserError(
                f"images of {w}x{h} px cannot be matched by RAFT: expected at least {MIN_SIDE} px "
                "along each side, and multiples of 8."
            )
        flows: list[Tensor] = self.raft(2 * left - 1, 2 * right - 1, num_flow_updates=updates)
        return flows

    def frozen(self) -> FlowNetwork:
        """The network as a teacher: gradients pass through it, but it does not learn."""
        return self.eval().requires_grad_(False)


def save_flow(path: Path, network: FlowNetwork, card: FlowCard) -> None:
    """Writes a file that ``load_flow`` reads, atomically."""
    tensors = {k: x.detach().cpu().contiguous() for k, x in network.raft.state_dict().items()}
    partial = path.with_name(path.name + ".partial")
    save_file(tensors, partial, {"format": FORMAT, "card": json.dumps(asdict(card))})
    os.replace(partial, path)


def load_flow(name: str) -> FlowNetwork:
    """A frozen network.

    Args:
      name: a file of ``flowrect.train_flow`` (.safetensors), the name of shipped weights, a file of
        torchvision's ``raft_small`` (.pth), or "torchvision", which fetches that file and checks
        its hash.

    Raises:
      UserError: there are no such weights, or they are not RAFT's.
    """
    network = FlowNetwork()
    state = _torchvision_state() if name == "torchvision" else _state_of_file(_find(name))
    try:
        network.raft.load_state_dict(state)
    except RuntimeError as error:
        raise UserError(f"{name} does not hold weights of raft_small: {error}") from error
    return network.frozen()


def read_card(path: Path) -> FlowCard:
    """The card of a file of ``save_flow``; UserError if it is none."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        if metadata.get("format") != FORMAT:
            raise UserError(
                f"{path}: expected format {FORMAT!r} in its header, found "
                f"{metadata.get('format')!r}; take weights written by flowrect.train_flow."
            )
        return TypeAdapter(FlowCard).validate_json(metadata["card"])
    except (SafetensorError, KeyError, ValidationError) as error:
        raise UserError(
            f"{path} holds no weights of flowrect.train_flow ({error}). Take another copy."
        ) from error


def _find(name: str) -> Path:
    for path in (Path(name), SHIPPED / f"{name}.safetensors"):
        if path.is_file():
            return path
    raise UserError(
        f"flow weights {name!r}: no such file, and none of that name are shipped. Train some with "
        "python -m flowrect.train_flow --data shards/, or take torchvision's: --flow-weights "
        "torchvision where there is a network, else a copy of its raft_small_C_T_V2-01064c6d.pth."
    )


def _state_of_file(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        read_card(path)
        return load_file(path)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if isinstance(state, dict):
            return state
        raise RuntimeError(f"it holds one {type(state).__name__}")
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise UserError(
            f"{path}: expected .safetensors of flowrect.train_flow or torchvision's .pth, which "
            f"holds tensors only ({str(error).splitlines()[0]})."
        ) from error


def _torchvision_state() -> dict[str, Tensor]:
    try:
        state = Raft_Small_Weights.C_T_V2.get_state_dict(progress=True, check_hash=True)
    except (OSError, RuntimeError) as error:
        url = Raft_Small_Weights.C_T_V2.url
        raise UserError(
            f"torchvision's weights could not be fetched from {url} ({error}). Take a copy of that "
            "file, or train some with python -m flowrect.train_flow --data shards/."
        ) from error
    return dict(state)
