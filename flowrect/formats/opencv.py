"""OpenCV's own files (``cv2.FileStorage``: YAML, XML, JSON).

Entries: ``K_left``, ``K_right`` (3×3) [px]; ``R`` (3×3), ``T`` (3) of X_right = R X_left + T;
``image_width``, ``image_height``; ``dist_left``, ``dist_right`` (left out: none). The names of
OpenCV's stereo_calib sample are understood, too, which spreads them over two files and leaves the
size out: ``M1``, ``D1``, ``M2``, ``D2``. A fisheye says ``distortion_model: equidistant``. What is
written also has ``R1``, ``R2``, ``P1``, ``P2``, ``Q``.

Conventions are ours: pixel centres at whole numbers, R and T from left to right.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrect.calibration import Calibration, Lens, Projections, distortion
from flowrect.files import matrix, rotation
from simgen.errors import UserError
from simgen.geometry import transform

NAMES = {
    "K_left": ("K_left", "M1", "K1", "cameraMatrix1"),
    "K_right": ("K_right", "M2", "K2", "cameraMatrix2"),
    "dist_left": ("dist_left", "D1", "distCoeffs1"),
    "dist_right": ("dist_right", "D2", "distCoeffs2"),
    "R": ("R",),
    "T": ("T",),
    "image_width": ("image_width",),
    "image_height": ("image_height",),
    "distortion_model": ("distortion_model",),
}
"""what an entry may be called"""
LENSES: dict[str, Lens] = {
    "plumb_bob": "polynomial", "rational_polynomial": "polynomial", "equidistant": "fisheye",
    "fisheye": "fisheye",
}  # fmt: skip
"""distortion_model, by the names that ROS and OpenCV have for it"""
REQUIRED = ("K_left", "K_right", "R", "T")


def read(paths: Sequence[Path], wh: tuple[int, int] | None = None) -> Calibration:
    """The rig that the entries of one or more files make.

    Args:
      wh: image size where the files do not say it.
    """
    where = ", ".join(map(str, paths))
    values = _renamed({k: v for path in paths for k, v in _entries(path).items()}, where)
    if "image_width" in values and "image_height" in values:
        wh = int(values["image_width"]), int(values["image_height"])
    if wh is None:
        raise UserError(f"{where}: no entry image_width, image_height: which size is K for?")
    R, t = rotation(values["R"], f"{where}: R"), matrix(values["T"], (3,), f"{where}: T")
    model = values.get("distortion_model", "plumb_bob")
    if model not in LENSES:
        raise UserError(
            f"{where}: distortion_model {model!r} is unknown; expected one of {sorted(LENSES)}."
        )
    lens = LENSES[model]
    return Calibration(
        K_left=matrix(values["K_left"], (3, 3), f"{where}: K_left"),
        K_right=matrix(values["K_right"], (3, 3), f"{where}: K_right"),
        T_right_left=transform(R, t),
        wh=wh,
        dist_left=distortion(values.get("dist_left"), lens, f"{where}: dist_left"),
        dist_right=distortion(values.get("dist_right"), lens, f"{where}: dist_right"),
        lens=lens,
    )


def write(path: Path, rig: Calibration, rectified: Projections | None = None) -> None:
    """Writes the rig, and its rectification, to a file whose suffix says YAML, XML or JSON."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    try:
        storage.write("image_width", rig.wh[0])
        storage.write("image_height", rig.wh[1])
        if rig.lens == "fisheye":
            storage.write("distortion_model", "equidistant")
        for name in ("K_left", "K_right", "dist_left", "dist_right"):
            storage.write(name, getattr(rig, name))
        storage.write("R", rig.T_right_left[:3, :3])
        storage.write("T", rig.T_right_left[:3, 3:])
        for name in ("R1", "R2", "P1", "P2", "Q") if rectified else ():
            storage.write(name, getattr(rectified, name))
    finally:
        storage.release()


def _entries(path: Path) -> dict[str, Any]:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise UserError(f"{path}: not a file of cv2.FileStorage ({error}).") from error
    try:
        root = storage.root()
        return {name: _value(root.getNode(name)) for name in root.keys()}  # noqa: SIM118
    finally:
        storage.release()


def _renamed(values: dict[str, Any], where: str) -> dict[str, Any]:
    """The entries by our names; UserError if one is missing."""
    found = {
        name: values[alias]
        for name, aliases in NAMES.items()
        for alias in reversed(aliases)
        if values.get(alias) is not None
    }
    missing = [name for name in REQUIRED if name not in found]
    if missing:
        raise UserError(
            f"{where}: no entry {', '.join(missing)}; found {', '.join(values) or 'nothing'}. "
            f"Expected {', '.join(REQUIRED)} (or M1, M2, R, T of stereo_calib), image_width and "
            "image_height, and dist_left, dist_right unless they are 0."
        )
    return found


def _value(node: cv2.FileNode) -> Any:
    """A matrix, a list, a number or a text of a node; None for anything else."""
    if node.isMap():
        try:
            return np.asarray(node.mat(), dtype=np.float64)
        except cv2.error:  # a map, but no matrix
            return None
    if node.isSeq():
        return np.array([node.at(i).real() for i in range(node.size())])
    if node.isString():
        return node.string()
    return np.float64(node.real()) if node.isInt() or node.isReal() else None
