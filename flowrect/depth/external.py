"""Stereo networks from elsewhere, such as DLNR or RAFT-Stereo, as ONNX files.

The file's contract, whoever exported it:

    inputs    left, right    (1, 3, H, W) float32, RGB in 0…255, rectified
    output    the first one  (1, 1, H, W) or (1, H, W) float32, u_left − u_right [px]

H and W are free, or those of the images. Weights in a file beside it are those of its name and a
suffix (FILE.onnx.data, as PyTorch writes them). Networks that give the flow's x instead (DLNR and
RAFT-Stereo do) are to be exported with the sign changed, those that want 0…1 with a division.
ONNX, since such a file holds operators and numbers: PyTorch checkpoints and TorchScript are
unpickled when they are read, which runs the code in them. Nothing is unpickled here.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from flowrect.sample import Image
from simgen.errors import UserError

PUBLISHED = (
    "DLNR at https://github.com/David-Zhao-1997/High-frequency-Stereo-Matching-Network (no licence "
    "in its README: ask its authors), RAFT-Stereo at https://github.com/princeton-vl/RAFT-Stereo "
    "(MIT)"
)
VARIABLE = "FLOWRECT_STEREO_ONNX"
"""environment variable that names a file"""
MULTIPLE = 32
"""images are padded to multiples of this: networks halve their size up to five times"""


@dataclass(frozen=True, eq=False)
class OnnxStereo:
    """An ONNX file as a stereo matcher."""

    session: Any
    """onnxruntime.InferenceSession"""
    name: str

    def __call__(self, left: Image, right: Image) -> NDArray[np.float32]:
        """Disparity (H, W) [px] of rectified images (H, W, 3) uint8 RGB."""
        h, w = left.shape[:2]
        size = self._size((h, w))
        names = [x.name for x in self.session.get_inputs()]
        given = dict(zip(names, (_planes(x, size) for x in (left, right)), strict=True))
        try:
            found = np.asarray(self.session.run(None, given)[0])
        except Exception as error:  # its classes derive from RuntimeError or Exception, as it likes
            raise UserError(
                f"{self.name} cannot be run on images of {size[1]}x{size[0]} "
                f"({str(error).splitlines()[0]}). Export it for that size, or with free ones."
            ) from error
        return self._checked(found, size)[:h, :w]

    def _size(self, hw: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns that the network is given."""
        wanted = tuple(self.session.get_inputs()[0].shape[2:])
        fixed = [isinstance(n, int) for n in wanted]
        if any(f and n != own for f, n, own in zip(fixed, wanted, hw, strict=True)):
            raise UserError(
                f"{self.name} takes images of {wanted[1]}x{wanted[0]} only, these are "
                f"{hw[1]}x{hw[0]}. Export it with free sizes, or for this one."
            )
        h, w = (n if f else n + -n % MULTIPLE for f, n in zip(fixed, hw, strict=True))
        return h, w

    def _checked(self, found: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
        if found.shape not in ((1, 1, *size), (1, *size)):
            raise UserError(
                f"{self.name}: its first output is {found.shape}, expected {(1, 1, *size)}: "
                "disparity of every left pixel. Export it with that as the first output."
            )
        disparity: NDArray[np.float32] = found.reshape(size).astype(np.float32)
        return disparity


def find_onnx(weights: str = "") -> Path:
    """The file of that name, else of FLOWRECT_STEREO_ONNX; UserError if there is none."""
    name = weights or os.environ.get(VARIABLE, "")
    if not Path(name).is_file():
        what = f"{name}: no such file" if name else "no file is named"
        raise UserError(
            f"onnx stereo matcher (DLNR and others): no weights, {what}. Nothing is fetched from "
            f"here: take {PUBLISHED}, export the network to ONNX as flowrect/depth/external.py "
            f"says, and name the file (onnx=FILE), or set {VARIABLE} to it. sgbm needs no weights, "
            "and hitnet's are shipped."
        )
    return Path(name)


def files_of(path: Path) -> list[Path]:
    """The ONNX file, and those beside it that may hold its weights."""
    return sorted(p for p in path.parent.iterdir() if p.is_file() and p.name.startswith(path.name))


def onnx_matcher(weights: str = "") -> OnnxStereo:
    """The network of an ONNX file, see ``find_onnx``."""
    path = find_onnx(weights)
    return OnnxStereo(_session(str(path)), path.name)


@cache
def _session(name: str) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError("ONNX files need onnxruntime: pip install 'flowrect[onnx]'.") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()  # one setting for all networks
    try:
        session = onnxruntime.InferenceSession(name, options)
    except Exception as error:  # its classes derive from RuntimeError or Exception, as it likes
        reason = str(error).splitlines()[0]
        raise UserError(f"{name} is no ONNX file that onnxruntime runs ({reason}).") from error
    inputs = [(x.name, x.type, len(x.shape)) for x in session.get_inputs()]
    if [x[1:] for x in inputs] != [("tensor(float)", 4)] * 2:
        raise UserError(
            f"{name}: its inputs are {inputs}, expected two of float32 (1, 3, H, W): the left "
            "image and the right one, RGB in 0…255."
        )
    return session


def _planes(image: Image, size: tuple[int, int]) -> NDArray[np.float32]:
    """(1, 3, H, W), padded below and to the right, where it moves no disparity."""
    rows, columns = (n - m for n, m in zip(size, image.shape, strict=False))
    padded = np.pad(image, ((0, rows), (0, columns), (0, 0)), mode="edge")
    return np.ascontiguousarray(padded.transpose(2, 0, 1)[None], dtype=np.float32)
