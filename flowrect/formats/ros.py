"""ROS camera_info: one YAML file a camera, as camera_calibration writes them.

The relative pose is not in them but follows from the rectification: the rectified right camera
stands at t_rect = (P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0) (ROS: Tx = −fx · baseline), and with
the rectification matrices R1, R2: R = R2ᵀ R1, t = R2ᵀ t_rect. Pixel centres lie at whole numbers.
Source: sensor_msgs/CameraInfo.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flowrect.calibration import Calibration, Lens, Projections, distortion
from flowrect.files import matrix, rotation
from simgen.errors import UserError
from simgen.geometry import Array, transform

SHAPES = {
    "camera_matrix": (3, 3),
    "rectification_matrix": (3, 3),
    "projection_matrix": (3, 4),
}
MODELS = ("plumb_bob", "rational_polynomial", "equidistant")


def read(paths: tuple[Path, Path], infos: tuple[dict[str, Any], dict[str, Any]]) -> Calibration:
    """The rig of the left and the right camera's file, which YAML has parsed."""
    (left, right), where = (_camera(*x) for x in zip(paths, infos, strict=True)), str(paths[1])
    if left["wh"] != right["wh"] or left["lens"] != right["lens"]:
        raise UserError(f"{where}: another lens model or image size than {paths[0]}.")
    t_rect = right["shift"] - left["shift"]
    if not t_rect.any():
        raise UserError(
            f"{where}: projection_matrix has no baseline, P[0, 3] and P[1, 3] are those of the "
            "left camera. Expected the files of a stereo calibration, left first."
        )
    R1, R2 = left["R"], right["R"]
    return Calibration(
        K_left=left["K"],
        K_right=right["K"],
        T_right_left=transform(R2.T @ R1, R2.T @ t_rect),
        wh=left["wh"],
        dist_left=left["dist"],
        dist_right=right["dist"],
        lens=left["lens"],
    )


def write(left: Path, right: Path, rig: Calibration, rectified: Projections) -> None:
    """Writes both files."""
    for path, name, K, dist, R, P in (
        (left, "left", rig.K_left, rig.dist_left, rectified.R1, rectified.P1),
        (right, "right", rig.K_right, rig.dist_right, rectified.R2, rectified.P2),
    ):
        model, coefficients = _model(rig, dist)
        info = {
            "image_width": rig.wh[0],
            "image_height": rig.wh[1],
            "camera_name": name,
            "camera_matrix": _block(K),
            "distortion_model": model,
            "distortion_coefficients": _block(coefficients[None]),
            "rectification_matrix": _block(R),
            "projection_matrix": _block(P),
        }
        path.write_text(yaml.safe_dump(info, default_flow_style=None, sort_keys=False))


def _model(rig: Calibration, dist: Array) -> tuple[str, Array]:
    """ROS's name of the lens model, and the coefficients that it expects."""
    if rig.lens == "fisheye":
        return "equidistant", dist
    if len(dist) <= 5:
        return "plumb_bob", np.pad(dist, (0, 5 - len(dist)))
    return "rational_polynomial", dist


def _block(array: Array) -> dict[str, Any]:
    rows, columns = array.shape
    return {"rows": rows, "cols": columns, "data": array.ravel().tolist()}


def _camera(path: Path, info: dict[str, Any]) -> dict[str, Any]:
    model = info.get("distortion_model", "plumb_bob")
    if model not in MODELS:
        raise UserError(f"{path}: distortion_model {model!r}, expected one of {', '.join(MODELS)}.")
    K, R, P = (matrix(_data(info, n, path), shape, f"{path}: {n}") for n, shape in SHAPES.items())
    lens: Lens = "fisheye" if model == "equidistant" else "polynomial"
    stated = _data(info, "distortion_coefficients", path)
    try:
        coefficients = np.array(stated, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{path}: distortion_coefficients: expected numbers, found {stated!r}."
        ) from error
    return {
        "K": K,
        "R": rotation(R, f"{path}: rectification_matrix"),
        "shift": np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0]),
        "dist": distortion(coefficients, lens, f"{path}: distortion_coefficients"),
        "lens": lens,
        "wh": tuple(int(_entry(info, name, path)) for name in ("image_width", "image_height")),
    }


def _data(info: dict[str, Any], name: str, path: Path) -> Any:
    block = _entry(info, name, path)
    return _entry(block, "data", path) if isinstance(block, dict) else block


def _entry(entries: dict[str, Any], name: str, path: Path) -> Any:
    if name not in entries:
        raise UserError(f"{path}: no entry {name}; it has {', '.join(entries)}.")
    return entries[name]
