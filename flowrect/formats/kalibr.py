"""Kalibr's camchain: one YAML file with ``cam0`` (left) and ``cam1`` (right).

``cam1.T_cn_cnm1`` takes points of cam0 to cam1, so it *is* T_right_left. Kalibr finds corners with
OpenCV: its pixel centres lie at whole numbers, like ours. Read: pinhole cameras with ``radtan``
(k1, k2, p1, p2), ``equidistant`` (cv2.fisheye's k1 … k4) or no distortion; IMU entries are ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flowrect.calibration import Calibration
from flowrect.files import matrix, rotation
from simgen.errors import UserError
from simgen.geometry import Array, transform

LENSES = ("radtan", "equidistant", "none")


def read(path: Path, chain: dict[str, Any]) -> Calibration:
    """The rig of a camchain that YAML has parsed."""
    cameras = sorted(name for name in chain if name.startswith("cam"))
    if cameras != ["cam0", "cam1"]:
        raise UserError(
            f"{path}: a camchain of {', '.join(cameras)}, expected cam0 (left) and cam1 (right). "
            "Keep the two cameras of the pair, with T_cn_cnm1 between them."
        )
    left, right = (_camera(chain[name], f"{path}: {name}") for name in cameras)
    if left["lens"] != right["lens"] or left["wh"] != right["wh"]:
        raise UserError(f"{path}: cam0 and cam1 have different lens models or resolutions.")
    T = matrix(_entry(chain["cam1"], "T_cn_cnm1", f"{path}: cam1"), (4, 4), f"{path}: T_cn_cnm1")
    return Calibration(
        K_left=left["K"],
        K_right=right["K"],
        T_right_left=transform(rotation(T[:3, :3], f"{path}: T_cn_cnm1"), T[:3, 3]),
        wh=left["wh"],
        dist_left=left["dist"],
        dist_right=right["dist"],
        lens=left["lens"],
    )


def write(path: Path, rig: Calibration) -> None:
    """Writes the camchain; UserError if Kalibr's lens models cannot hold the rig's."""
    if reason := unwritable(rig):
        raise UserError(f"{path}: {reason}")
    chain = {
        "cam0": _entries(rig, rig.K_left, rig.dist_left, "left"),
        "cam1": _entries(rig, rig.K_right, rig.dist_right, "right"),
    }
    chain["cam1"]["T_cn_cnm1"] = rig.T_right_left.tolist()
    path.write_text(yaml.safe_dump(chain, default_flow_style=None, sort_keys=False))


def unwritable(rig: Calibration) -> str:
    """Why a camchain cannot hold the rig; empty if it can."""
    higher = np.any(rig.dist_left[4:]) or np.any(rig.dist_right[4:])
    return "Kalibr's radtan ends at k1, k2, p1, p2; the lens has more." if higher else ""


def _camera(entries: Any, where: str) -> dict[str, Any]:
    if not isinstance(entries, dict):
        raise UserError(f"{where} is {entries!r}; expected a camera's entries below it.")
    model, lens = entries.get("camera_model"), entries.get("distortion_model", "none")
    if model != "pinhole" or lens not in LENSES:
        raise UserError(
            f"{where}: camera_model {model!r} with distortion_model {lens!r}; expected 'pinhole' "
            f"with one of {', '.join(LENSES)}. Calibrate with one of these."
        )
    fx, fy, cx, cy = matrix(_entry(entries, "intrinsics", where), (4,), f"{where}: intrinsics")
    coefficients = [0.0] * 4 if lens == "none" else _entry(entries, "distortion_coeffs", where)
    width, height = matrix(_entry(entries, "resolution", where), (2,), f"{where}: resolution")
    return {
        "K": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        "dist": matrix(coefficients, (4,), f"{where}: distortion_coeffs"),
        "lens": "fisheye" if lens == "equidistant" else "polynomial",
        "wh": (int(width), int(height)),
    }


def _entry(entries: dict[str, Any], name: str, where: str) -> Any:
    if name not in entries:
        raise UserError(f"{where} has no entry {name}; it has {', '.join(entries)}.")
    return entries[name]


def _entries(rig: Calibration, K: Array, dist: Array, side: str) -> dict[str, Any]:
    return {
        "camera_model": "pinhole",
        "intrinsics": [float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
        "distortion_model": "equidistant" if rig.lens == "fisheye" else "radtan",
        "distortion_coeffs": dist[:4].tolist(),
        "resolution": list(rig.wh),
        "rostopic": f"/{side}/image_raw",
    }
