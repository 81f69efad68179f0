"""Calibration files: recognised by their content, one module a format.

rig = read_calibration([Path("rig.yaml")])                        # OpenCV, or Kalibr's camchain
rig = read_calibration([Path("intrinsics.yml"), Path("extrinsics.yml")])   # OpenCV's stereo_calib
rig = read_calibration([Path("left.yaml"), Path("right.yaml")])            # ROS camera_info
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from flowrect.calibration import Calibration
from flowrect.formats import kalibr, opencv, ros
from simgen.errors import UserError

EXPECTED = """Expected one of
  one or more files of OpenCV    K_left, K_right, R, T, image_width, image_height, or stereo_calib's
                                 M1, D1, M2, D2, R, T; the first line is %YAML:1.0 or %YAML 1.2
  one camchain of Kalibr         cam0 and cam1
  two camera_info of ROS         camera_matrix, …: the left camera's file, then the right one's"""

OPENCV_MARKS = ("%YAML", "<?xml", "{")  # how its files begin; those of Kalibr and ROS do not

__all__ = ["kalibr", "opencv", "read_calibration", "ros"]


def read_calibration(paths: Sequence[Path], wh: tuple[int, int] | None = None) -> Calibration:
    """Reads a rig from its files; UserError says what they lack.

    Args:
      wh: (width, height) of the images, for files that do not say it.
    """
    contents = [_content(path) for path in paths]
    kinds = [_kind(content) for content in contents]
    if kinds and set(kinds) == {"opencv"}:
        return opencv.read(paths, wh)
    if kinds == ["kalibr"]:
        return kalibr.read(paths[0], contents[0])
    if kinds == ["ros", "ros"]:
        return ros.read((paths[0], paths[1]), (contents[0], contents[1]))
    found = "; ".join(
        f"{path}: {kind or ', '.join(map(str, content)) or 'nothing'}"
        for path, kind, content in zip(paths, kinds, contents, strict=True)
    )
    raise UserError(f"no calibration of a pair in {found or 'no file'}.\n{EXPECTED}")


def _content(path: Path) -> dict[Any, Any]:
    """What a YAML file says; for OpenCV's dialect, which YAML does not read, its mark alone."""
    if not path.is_file():
        raise UserError(f"{path}: no such calibration.")
    try:
        text = path.read_text(encoding="utf-8")
        if text.startswith(OPENCV_MARKS):
            return {"K_left": None}
        content = yaml.safe_load(text)
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{path}: not a YAML file.\n{EXPECTED}") from error
    return content if isinstance(content, dict) else {}


def _kind(content: dict[Any, Any]) -> str:
    marks = {"cam0": "kalibr", "camera_matrix": "ros", "K_left": "opencv", "M1": "opencv"}
    return next((kind for mark, kind in marks.items() if mark in content), "")
