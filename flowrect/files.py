"""Reading files that people hand over: images, JSON, CSV lists, and numbers in them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrect.sample import Image
from simgen.errors import UserError
from simgen.geometry import Array

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def make_folder(path: Path) -> None:
    """Makes a folder and those above it; UserError if it cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be made ({error.strerror}). Choose another --out."
        ) from error


def read_rgb(path: Path) -> Image:
    """An 8-bit image (H, W, 3) in RGB; a grey one becomes three equal channels.

    Pixels lie as they are stored, which K belongs to, whatever orientation a viewer is told.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such image.")
    as_stored = cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | as_stored)
    if image is None:
        raise UserError(f"{path}: cannot be decoded as an image; damaged, or of an unknown kind?")
    if image.dtype != np.uint8:
        raise UserError(
            f"{path}: samples of {image.dtype}, expected 8 bits. Scale its range to 0…255 first, "
            "as the left and the right image alike."
        )
    rgb: Image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return rgb


def undistorted(image: Image, K: Array, dist: Array) -> Image:
    """The image that a lens without distortion would give, with the same K.

    Args:
      dist: OpenCV's coefficients (k1, k2, p1, p2[, k3[, …]]).
    """
    if not np.any(dist):
        return image
    straight: Image = cv2.undistort(image, K, np.asarray(dist, dtype=np.float64))
    return straight


def read_json(path: Path) -> Any:
    """The content of a JSON file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file.") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as JSON ({error}).") from error


def read_rows(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """Rows of a CSV list by column name; a line that repeats the names is a header."""
    rows = [row for row in read_csv(path) if tuple(row) != columns]
    for number, row in enumerate(rows, 1):
        if len(row) != len(columns):
            raise UserError(
                f"{path}, row {number}: {len(row)} columns, expected {len(columns)}: "
                f"{', '.join(columns)}."
            )
    return [dict(zip(columns, row, strict=True)) for row in rows]


def read_csv(path: Path) -> list[list[str]]:
    """Rows of a CSV file without the empty ones, cells stripped of blanks."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return [[cell.strip() for cell in row] for row in csv.reader(file) if row]
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such list.") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as CSV ({error}).") from error


def matrix(values: Any, shape: tuple[int, ...], where: str) -> Array:
    """Numbers as float64 of a shape; UserError if they do not fill it, or are not finite."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: {values!r} are not numbers ({error}).") from error
    if array.size != np.prod(shape) or not np.isfinite(array).all():
        raise UserError(
            f"{where}: {array.size} numbers, expected {int(np.prod(shape))} finite ones ({shape})."
        )
    return array.reshape(shape)


def rotation(values: Any, where: str) -> Array:
    """A rotation matrix (3, 3), orthogonal to 1e-3, as its nearest exact rotation."""
    R = matrix(values, (3, 3), where)
    U, _, Vt = np.linalg.svd(R)
    nearest: Array = U @ Vt
    if np.abs(R - nearest).max() > 1e-3 or np.linalg.det(nearest) < 0:
        raise UserError(f"{where}:\n{R}\nis no rotation: its columns are not orthonormal.")
    return nearest
