"""Optical flow by RAFT, torchvision's networks: weights, images in 0…1, flow out.

Used where there is no depth to take exact flow from: as the frozen teacher of the paper's
self-supervision, which is the large network, fine-tuned on KITTI. Torchvision's own weights can be
fetched where there is a network; ``flowrect.train_flow`` trains the small one where there is none.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional as F
from torchvision.models.optical_flow import (
    Raft_Large_Weights,
    Raft_Small_Weights,
    raft_large,
    raft_small,
)
from torchvision.models.optical_flow.raft import CorrBlock

from flowrect.weights import SHIPPED
from simgen.errors import UserError

FORMAT = "flowrect-flow-1"
MIN_SIDE = 128
"""[px] RAFT looks at an eighth of the size, and halves that three times"""
STRIDE = 8
"""pixels a feature, along each side"""
UPDATES = 12
"""of the flow where the weights do not say; torchvision's too"""
Size = Literal["small", "large"]
SIZES = {"small": (raft_small, 3), "large": (raft_large, 4)}
"""torchvision's builder, and the features around a match that are looked up, on each side"""
TORCHVISION = {
    "torchvision": Raft_Small_Weights.C_T_V2,
    "torchvision-large": Raft_Large_Weights.C_T_SKHT_K_V1,
}
"""weights that torchvision fetches; the large ones, fine-tuned on KITTI, are those of the paper's
release"""


@dataclass(frozen=True)
class FlowCard:
    """What is known of trained flow weights."""

    samples: int = 0
    """pairs seen in training"""
    data: str = ""
    """what they were trained on"""
    magnify: float = 1.0
    updates: int = UPDATES
    """see ``FlowNetwork``"""
    hours: float = 0.0
    """of training, of all runs that led here; 0: not known"""


class Flows(NamedTuple):
    """What RAFT says of pairs."""

    refined: list[Tensor]
    """the flow (B, 2, H, W) [px] from left to right after each update"""
    correlation: Tensor
    """(B, h·w, h·w) of each left feature, row by row, with each right one"""
    feature_wh: tuple[int, int]
    """(w, h): ``magnify`` / STRIDE of the images' size"""


class _Correlation(CorrBlock):
    """Correlations with features of several sizes, in float32 whatever the network's precision.

    Half as precise they would be converted, all of them, each time that some are looked up.
    Torchvision averages the correlations, which is the same: correlation is linear.
    """

    def build_pyramid(self, fmap1: Tensor, fmap2: Tensor) -> None:
        with torch.autocast(fmap1.device.type, enabled=False):
            right = fmap2.float()
            left = fmap1.float().flatten(2).transpose(1, 2) / fmap1.shape[1] ** 0.5
            self.corr_pyramid = []
            for level in range(self.num_levels):
                right = F.avg_pool2d(right, 2) if level else right
                h, w = right.shape[-2:]
                self.corr_pyramid.append((left @ right.flatten(2)).reshape(-1, 1, h, w))


class FlowNetwork(nn.Module):
    """RAFT from images in 0…1.

    Args:
      magnify: images are magnified by this before RAFT sees them. Its features are STRIDE pixels
        apart, and its errors are a share of that.
      updates: how often it refines the flow. More than it was trained for need not be better.
    """

    def __init__(self, size: Size = "small", magnify: float = 1.0, updates: int = UPDATES) -> None:
        super().__init__()
        self.magnify, self.updates = magnify, updates
        build, radius = SIZES[size]
        self.raft = build(weights=None, corr_block=_Correlation(radius=radius))

    def flow(self, left: Tensor, right: Tensor, magnify: float | None = None) -> Tensor:
        """Flow (B, 2, H, W) [px] from left to right images (B, 3, H, W); see ``forward``."""
        return self(left, right, magnify=magnify).refined[-1]

    def forward(
        self, left: Tensor, right: Tensor, updates: int | None = None, magnify: float | None = None
    ) -> Flows:
        """The flow after each update, of which there may be none; H and W: multiples of STRIDE.

        ``updates``, ``magnify``: others than the network's own, in training, and for images of
        another size than it trained on.
        """
        updates = self.updates if updates is None else updates
        magnify = self.magnify if magnify is None else magnify
        h, w = left.shape[-2:]
        if min(h, w) < MIN_SIDE or h % STRIDE or w % STRIDE:
            raise UserError(
                f"images of {w}x{h} px cannot be matched by RAFT: expected at least {MIN_SIDE} px "
                f"along each side, and multiples of {STRIDE}."
            )
        feature_wh = round(w * magnify / STRIDE), round(h * magnify / STRIDE)
        left, right = (self._seen(x, feature_wh) for x in (left, right))
        raft, refined = self.raft, []
        if updates:
            flows = raft(left, right, num_flow_updates=updates)
            refined = [_flow_at_size(flow, (w, h)) for flow in flows]
        else:
            raft.corr_block.build_pyramid(*raft.feature_encoder(torch.cat([left, right])).chunk(2))
        correlation: Tensor = raft.corr_block.corr_pyramid[0]  # (B·h·w, 1, h, w)
        correlation = correlation.reshape(len(left), -1, correlation[0].numel())
        return Flows(refined, correlation, feature_wh)

    @staticmethod
    def _seen(image: Tensor, feature_wh: tuple[int, int]) -> Tensor:
        """The image in -1…1, of a size that gives so many features."""
        hw = feature_wh[1] * STRIDE, feature_wh[0] * STRIDE
        if image.shape[-2:] != hw:
            image = F.interpolate(image, hw, mode="bicubic", align_corners=False).clamp(0, 1)
        return 2 * image - 1

    def frozen(self) -> FlowNetwork:
        """The network as a teacher: gradients pass through it, but it does not learn."""
        return self.eval().requires_grad_(False)


def _flow_at_size(flow: Tensor, wh: tuple[int, int]) -> Tensor:
    """Flow (B, 2, H, W) of images of another size, as flow (B, 2, h, w) of images of this one."""
    h, w = flow.shape[-2:]
    if (w, h) == wh:
        return flow
    smaller = F.interpolate(flow, wh[::-1], mode="bilinear", align_corners=False)
    return smaller * flow.new_tensor([wh[0] / w, wh[1] / h])[:, None, None]


def save_flow(path: Path, network: FlowNetwork, card: FlowCard) -> None:
    """Writes a file that ``load_flow`` reads, atomically."""
    tensors = {k: x.detach().cpu().contiguous() for k, x in network.raft.state_dict().items()}
    partial = path.with_name(path.name + ".partial")
    save_file(tensors, partial, {"format": FORMAT, "card": json.dumps(asdict(card))})
    os.replace(partial, path)


def load_flow(name: str, magnify: float | None = None, updates: int | None = None) -> FlowNetwork:
    """A frozen network, small or large as the weights are.

    Args:
      name: a file of ``flowrect.train_flow`` (.safetensors), the name of shipped weights, a file of
        torchvision's (.pth), or "torchvision" (small) or "torchvision-large", which fetch theirs.
        A hash in the name of a .pth is checked, fetched or not.
      magnify, updates: see FlowNetwork; None: as the weights say, else 1 and ``UPDATES``.

    Raises:
      UserError: there are no such weights, or they are not RAFT's.
    """
    state = _fetched(name) if name in TORCHVISION else _state_of_file(find_flow(name))
    size: Size = "large" if any(k.startswith("mask_predictor.") for k in state) else "small"
    card = card_of(name)
    magnify = card.magnify if magnify is None else magnify
    network = FlowNetwork(size, magnify, card.updates if updates is None else updates)
    try:
        network.raft.load_state_dict(state)
    except RuntimeError as error:
        raise UserError(f"{name} does not hold weights of raft_{size}: {error}") from error
    return network.frozen()


def card_of(name: str) -> FlowCard:
    """What is known of weights that ``load_flow`` takes: nothing of torchvision's."""
    path = None if name in TORCHVISION else find_flow(name)
    return read_card(path) if path and path.suffix == ".safetensors" else FlowCard()


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


def find_flow(name: str) -> Path:
    """The file of that name, or the shipped one; UserError if there is neither."""
    for path in (Path(name), SHIPPED / f"{name}.safetensors"):
        if path.is_file():
            return path
    raise UserError(
        f"flow weights {name!r}: no such file, and none of that name are shipped. Train some with "
        "python -m flowrect.train_flow --data shards/, or take torchvision's, by the name of "
        "torchvision or torchvision-large where there is a network, else a copy of "
        f"{' or '.join(Path(w.url).name for w in TORCHVISION.values())}."
    )


def _state_of_file(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        read_card(path)
        return load_file(path)
    _require_hash(path)
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


def _require_hash(path: Path) -> None:
    """UserError if the name says another hash than the content, as torchvision's names do."""
    stated = re.search(r"-([0-9a-f]{8})\.pth$", path.name)
    if stated is None:
        return
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(stated[1]):
        raise UserError(
            f"{path}: its name says that its sha256 begins with {stated[1]}, but it is {found}: "
            "incomplete, or not the file of that name. Take another copy."
        )


def _fetched(name: str) -> dict[str, Tensor]:
    weights = TORCHVISION[name]
    try:
        return dict(weights.get_state_dict(progress=True, check_hash=True))
    except (OSError, RuntimeError) as error:
        raise UserError(
            f"torchvision's weights could not be fetched from {weights.url} ({error}). Take a copy "
            "of that file, or train some with python -m flowrect.train_flow --data shards/."
        ) from error
