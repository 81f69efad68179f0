"""Weights of HITNet in files: safetensors with config and card in the header, nothing unpickled."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from flowrect.config import HitnetConfig
from flowrect.depth.hitnet import Hitnet
from flowrect.sample import Image
from flowrect.weights import SHIPPED
from simgen.errors import UserError

FORMAT = "flowrect-hitnet-1"
VARIABLE = "FLOWRECT_HITNET"
"""environment variable that names a file"""
HOW_TO_TRAIN = "python -m flowrect.train_depth --data shards/"


@dataclass(frozen=True)
class DepthCard:
    """What is known of trained weights."""

    samples: int = 0
    """pairs seen in training"""
    data: str = ""
    """what they were trained on"""
    hours: float = 0.0
    """of training; 0: not known"""


def save_hitnet(path: Path, network: Hitnet, card: DepthCard) -> None:
    """Writes a file that ``load_hitnet`` reads, atomically."""
    tensors = {k: x.detach().cpu().contiguous() for k, x in network.state_dict().items()}
    partial = path.with_name(path.name + ".partial")
    metadata = {
        "format": FORMAT,
        "config": json.dumps(asdict(network.config)),
        "card": json.dumps(asdict(card)),
    }
    save_file(tensors, partial, metadata)
    os.replace(partial, path)


def load_hitnet(path: Path) -> tuple[Hitnet, DepthCard]:
    """The network of a file, ready to use on the CPU, and its card; UserError if it is none."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        if metadata.get("format") != FORMAT:
            raise UserError(
                f"{path}: expected format {FORMAT!r} in its header, found "
                f"{metadata.get('format')!r}; take weights of {HOW_TO_TRAIN}."
            )
        network = Hitnet(TypeAdapter(HitnetConfig).validate_json(metadata["config"]))
        card = TypeAdapter(DepthCard).validate_json(metadata["card"])
        network.load_state_dict(load_file(path))
    except (OSError, SafetensorError, KeyError, ValidationError, RuntimeError) as error:
        raise UserError(
            f"{path} holds no HITNet that this version builds ({str(error).splitlines()[0]}). Take "
            f"another copy, or train one: {HOW_TO_TRAIN}."
        ) from error
    return network.eval().requires_grad_(False), card


def find_hitnet(weights: str = "") -> Path:
    """The file of that name, else of the variable FLOWRECT_HITNET, else what is shipped.

    UserError if none is named or shipped.
    """
    shipped = SHIPPED / "hitnet.safetensors"
    name = weights or os.environ.get(VARIABLE, "") or (str(shipped) if shipped.is_file() else "")
    if not name:
        raise UserError(
            f"hitnet: no weights are shipped. Train some with {HOW_TO_TRAIN}, and name the file, "
            f"or set {VARIABLE} to it."
        )
    if not Path(name).is_file():
        raise UserError(f"hitnet: {name}: no such file. Check the name, or leave it out.")
    return Path(name)


def hitnet_matcher(
    weights: str, largest_px: float
) -> Callable[[Image, Image], NDArray[np.float32]]:
    """The trained network as a stereo matcher.

    Args:
      weights: as for ``find_hitnet``.
      largest_px: the largest disparity that can occur.
    """
    path = find_hitnet(weights)
    network = _loaded(path)
    if largest_px > network.config.max_disparity:
        raise UserError(
            f"{path} looks for disparities up to {network.config.max_disparity} px, but "
            f"{largest_px:.0f} can occur. Take a greater nearest range, smaller images, or train "
            "with a greater --model.max-disparity."
        )
    return network.match


@cache
def _loaded(path: Path) -> Hitnet:
    network, _ = load_hitnet(path)
    return network
