"""What a run needs to go on as if it had not stopped, in one file, written atomically.

The file is PyTorch's own format, read with ``weights_only=True``: tensors and plain values only, so
reading one runs no code. The learning rate is a function of the step and needs no state.

On a CPU a run that goes on computes the same bits. On CUDA it goes on from the same bits, but some
kernels add in an order that changes from run to run, with or without an interruption.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from simgen.errors import UserError

BUDGET = frozenset({"out", "data", "root", "minutes", "val_every", "init", "preset"})
"""options that may differ when a run goes on: they change when it ends, not what is computed; that
``data`` and ``root`` hold the same pairs is checked by their fingerprint"""


def random_state() -> dict[str, Any]:
    """State of torch's generators: the CPU's, and the current GPU's if there is one."""
    cuda = torch.cuda.get_rng_state() if torch.cuda.is_available() else None
    return {"cpu": torch.get_rng_state(), "cuda": cuda}


def restore_random_state(state: dict[str, Any]) -> None:
    """Sets what ``random_state`` returned."""
    torch.set_rng_state(state["cpu"])
    if state["cuda"] is not None and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])


def save(path: Path, state: dict[str, Any]) -> None:
    """Writes a checkpoint; a crash leaves the former one."""
    partial = path.with_name(path.name + ".partial")
    torch.save(state, partial)
    os.replace(partial, path)


def load(path: Path, options: dict[str, Any], fingerprint: str) -> dict[str, Any]:
    """Reads a checkpoint of a run with these options on the pairs of this fingerprint.

    Raises:
      UserError: damaged, foreign, or of a run with other options.
    """
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        saved, pairs = state["options"], state["fingerprint"]
    except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} is no checkpoint of flowrect.train ({error}). Remove it to start anew; "
            "--init takes weights (.safetensors), not checkpoints."
        ) from error
    saved, options = ({**o, "loading": {**o["loading"], "workers": 0}} for o in (saved, options))
    names = [n for n in saved if n not in BUDGET and saved[n] != options.get(n)]
    if names:
        changes = "; ".join(f"{n} was {saved[n]!r}, now {options.get(n)!r}" for n in names)
        raise UserError(
            f"{path} belongs to a run with other options: {changes}. Give the former ones to "
            "resume, or another --out to start anew (--init takes over its weights)."
        )
    if pairs != fingerprint:
        raise UserError(
            f"{path} belongs to a run on other pairs than those in {options['data']}: validation "
            "pairs would have been trained on. Give the former set to resume, or another --out to "
            "start anew (--init takes over its weights)."
        )
    return state
