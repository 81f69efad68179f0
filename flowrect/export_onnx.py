"""Exporting a trained network: ``python -m flowrect.export_onnx WEIGHTS OUT.onnx``.

Inputs, one pair of the network's own size (``ModelConfig.input_wh``, see flowrect.resize for how
images are fitted to it): ``left``, ``right`` (1, 3, h, w) float32 RGB in 0..1; ``K_left``,
``K_right`` (1, 3, 3) float64 [px] of that size; the prior ``R_init`` (1, 3, 3), ``t_init`` (1, 3)
float64. Outputs: ``R`` (1, 3, 3) float64 and ``match_probability`` (1,) float32, the mean
probability of the best matches. The header holds the card of the weights as ``flowrect_card``.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor, nn

from flowrect.model import Prediction, Rectifier
from flowrect.weights import Card, find_weights, load_weights
from simgen.errors import UserError

INPUTS = ("left", "right", "K_left", "K_right", "R_init", "t_init")
OUTPUTS = ("R", "match_probability")


@dataclass(frozen=True)
class ExportOptions:
    """Exports a trained network to ONNX."""

    weights: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WEIGHTS")]
    """name of shipped weights, or a file of flowrect.train"""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """the .onnx file; weights go into it"""
    overwrite: bool = False
    """replace a file that exists"""


class _Outputs(nn.Module):
    """The network, with tensors for outputs."""

    def __init__(self, network: Rectifier) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        prediction: Prediction = self.network(*inputs)
        return prediction.R, prediction.log_matches.amax(-1).exp().mean(-1)


def export(network: Rectifier, card: Card, path: Path) -> None:
    """Writes the network to a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.onnx deprecates its own internals as it runs
        program = torch.onnx.export(
            _Outputs(network).eval(),
            example_inputs(network),
            dynamo=True,
            input_names=INPUTS,
            output_names=OUTPUTS,
            optimize=False,  # more than half of the time, for what runtimes do as they load
            verbose=False,
        )
    assert program is not None, "dynamo returns one"
    program.model.metadata_props["flowrect_card"] = json.dumps(asdict(card))
    program.save(path, external_data=False)


def example_inputs(network: Rectifier) -> tuple[Tensor, ...]:
    """Grey images, a lens of 90°, an ideal rig."""
    w, h = network.config.input_wh
    images = torch.full((2, 1, 3, h, w), 0.5)
    K = torch.tensor([[[w / 2, 0, (w - 1) / 2], [0, w / 2, (h - 1) / 2], [0, 0, 1]]]).double()
    t = torch.tensor([[-1.0, 0, 0]]).double()
    return images[0], images[1], K, K.clone(), torch.eye(3).double()[None], t


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(ExportOptions, args=arguments, prog="flowrect.export_onnx")
    try:
        if options.out.exists() and not options.overwrite:
            raise UserError(f"{options.out} exists. Choose another name, or say --overwrite.")
        if not options.out.parent.is_dir():
            raise UserError(f"{options.out.parent}: no such folder to write {options.out.name} to.")
        network, card = load_weights(find_weights(options.weights))
        if not isinstance(network, Rectifier):
            raise UserError(
                f"{options.weights} holds a {type(network).__name__}; expected weights of the "
                "paper's network: rivals are not exported."
            )
        export(network, card, options.out)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.out}: {', '.join(INPUTS)} -> {', '.join(OUTPUTS)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
