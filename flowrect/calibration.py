"""A rig of two cameras as OpenCV YAML: what a user writes down, and what stereo tools exchange.

Entries: ``K_left``, ``K_right`` (3×3) [px]; ``R`` (3×3), ``T`` (3) of X_right = R X_left + T;
``image_width``, ``image_height`` of the images that K belongs to; ``dist_left``, ``dist_right``
(OpenCV's distortion coefficients; left out: none). ``cv2.FileStorage`` reads and writes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrect.files import matrix, rotation
from simgen.errors import UserError
from simgen.geometry import Array, transform

NUM_DIST = (4, 5, 8, 12, 14)  # lengths that OpenCV knows
REQUIRED = ("K_left", "K_right", "R", "T", "image_width", "image_height")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Intrinsics and relative pose of a pair."""

    K_left: Array
    K_right: Array
    T_right_left: Array
    """(4, 4)"""
    wh: tuple[int, int]
    """(width, height) [px] of the images that K belongs to"""
    dist_left: Array = field(default_factory=lambda: np.zeros(5))
    dist_right: Array = field(default_factory=lambda: np.zeros(5))

    def require_size(self, wh: tuple[int, int], where: str) -> None:
        """UserError unless images have the calibrated size."""
        if wh != self.wh:
            raise UserError(
                f"{where}: an image of {wh[0]}x{wh[1]}, but the calibration is for "
                f"{self.wh[0]}x{self.wh[1]}. Give images of that size, or a calibration of theirs."
            )

    def save(self, path: Path) -> None:
        """Writes the YAML file."""
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        try:
            for name in ("K_left", "K_right", "dist_left", "dist_right"):
                storage.write(name, getattr(self, name))
            storage.write("R", self.T_right_left[:3, :3])
            storage.write("T", self.T_right_left[:3, 3:])
            storage.write("image_width", self.wh[0])
            storage.write("image_height", self.wh[1])
        finally:
            storage.release()

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Reads the YAML file; UserError says which entry is missing or wrong."""
        values = _entries(path)
        R, t = rotation(values["R"], f"{path}: R"), matrix(values["T"], (3,), f"{path}: T")
        return cls(
            K_left=matrix(values["K_left"], (3, 3), f"{path}: K_left"),
            K_right=matrix(values["K_right"], (3, 3), f"{path}: K_right"),
            T_right_left=transform(R, t),
            wh=(int(values["image_width"]), int(values["image_height"])),
            dist_left=_distortion(values.get("dist_left"), f"{path}: dist_left"),
            dist_right=_distortion(values.get("dist_right"), f"{path}: dist_right"),
        )


def _entries(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise UserError(f"{path}: no such calibration.")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise UserError(f"{path}: not OpenCV YAML; its first line must be %YAML:1.0.") from error
    try:
        root = storage.root()
        values = {name: _value(root.getNode(name)) for name in root.keys()}  # noqa: SIM118
    finally:
        storage.release()
    missing = [name for name in REQUIRED if values.get(name) is None]
    if missing:
        raise UserError(
            f"{path}: no entry {', '.join(missing)}; found {', '.join(values) or 'nothing'}. "
            f"Expected {', '.join(REQUIRED)}, and dist_left, dist_right unless they are 0."
        )
    return values


def _value(node: cv2.FileNode) -> Any:
    """A matrix, a list or a number of a node; None for anything else."""
    if node.isMap():
        return np.asarray(node.mat(), dtype=np.float64)
    if node.isSeq():
        return np.array([node.at(i).real() for i in range(node.size())])
    return np.float64(node.real()) if node.isInt() or node.isReal() else None


def _distortion(values: Array | None, where: str) -> Array:
    if values is None:
        return np.zeros(5)
    if values.size not in NUM_DIST:
        raise UserError(f"{where}: {values.size} coefficients, expected one of {NUM_DIST}.")
    return matrix(values, (values.size,), where)
