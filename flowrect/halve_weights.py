"""Weights in half precision: ``python -m flowrect.halve_weights runs/rpnet/last.safetensors …``.

For shipping what is large: 12 million parameters are 48 MB in float32. Whoever loads the file
computes in float32 again; only the rounding of the weights stays: a 2048th of each, 3e-8 of the
smallest.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from simgen.errors import UserError


@dataclass(frozen=True)
class Options:
    """Rounds matrices and kernels to float16; vectors, the least of it, stay as they are."""

    source: Annotated[Path, tyro.conf.Positional]
    """safetensors of any training of flowrect"""
    target: Annotated[Path, tyro.conf.Positional]
    """what to write"""


def halve(source: Path, target: Path) -> None:
    """Writes the weights and the header of one file into another, atomically.

    Raises:
      UserError: not a safetensors file, or a weight is beyond the range of float16.
    """
    try:
        with safe_open(source, framework="pt") as file:
            metadata = file.metadata()
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise UserError(f"{source} is no safetensors file ({error}).") from error
    halved = {name: _half(name, x, source) for name, x in tensors.items()}
    partial = target.with_name(target.name + ".partial")
    save_file(halved, partial, metadata)
    os.replace(partial, target)


def _half(name: str, x: torch.Tensor, source: Path) -> torch.Tensor:
    if x.dtype != torch.float32 or x.ndim < 2:
        return x
    half = x.half()
    if not half.isfinite().all():
        raise UserError(
            f"{source}: {name!r} reaches {float(x.abs().max()):.3g}, beyond the 65,504 of float16; "
            "it cannot be halved."
        )
    return half


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something."""
    options = tyro.cli(Options, args=arguments, prog="flowrect.halve_weights")
    try:
        halve(options.source, options.target)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    sizes = (path.stat().st_size / 1e6 for path in (options.source, options.target))
    print("{:.1f} MB -> {:.1f} MB".format(*sizes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
