"""KITTI raw, colour cameras 02 and 03: ``<date>/<drive>/image_02/data/*.png``.

Drives that end in ``_sync`` are rectified by KITTI: ``P_rect_0x`` hold K and the baseline, and the
rotation is the identity. Drives that end in ``_extract`` are raw: ``K_0x``, ``D_0x`` (the images
are undistorted here) and ``R_0x``, ``T_0x``, which take camera 00 to camera 0x, so
``T_right_left = T_03 · T_02⁻¹``. The calibration counts as the truth.
Source: Geiger et al., *Vision meets Robotics: The KITTI Dataset*, 2013, and its raw-data readme.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path

import numpy as np

from flowrect.files import matrix, read_rgb, read_rows, undistorted
from flowrect.sample import Image, Pair
from flowrect.sources.pairs import Pairs, digest_files
from flowrect.sources.rim import without_rim
from simgen.errors import UserError
from simgen.geometry import Array, inverse, transform

COLUMNS = ("left", "right", "calib", "date", "drive")
CALIBRATION = "calib_cam_to_cam.txt"
LEFT, RIGHT = "02", "03"


@dataclass(frozen=True)
class Item:
    """Files of one pair."""

    left: Path
    right: Path
    calib: Path
    drive: str


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera of a calibration file."""

    K: Array
    dist: Array
    T_cam_reference: Array
    """(4, 4)"""
    wh: tuple[int, int]


def open_kitti(root: Path, rows: Sequence[dict[str, str]] | None = None) -> Pairs[Item]:
    """All pairs below ``root``, or those of a list.

    Args:
      root: holds the folders of the dates.
      rows: of a list with ``COLUMNS``. Paths that do not exist are looked up below ``root``.
    """
    items = _found(root) if rows is None else [_listed(root, row) for row in rows]
    files = {path for item in items for path in (item.left, item.right, item.calib)}
    return Pairs(
        items,
        _read,
        layout=f"{root}: KITTI raw",
        fingerprint=digest_files(sorted(files)),
        rig=attrgetter("calib", "drive"),
    )


def read_list(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV list."""
    return read_rows(path, COLUMNS)


def _found(root: Path) -> list[Item]:
    items = []
    for calib in sorted(root.glob(f"*/{CALIBRATION}")):
        for left in sorted(calib.parent.glob(f"*/image_{LEFT}/data/*.png")):
            drive = left.parents[2]
            right = drive / f"image_{RIGHT}" / "data" / left.name
            if right.is_file():  # a raw drive may lack the last frame of one camera
                items.append(Item(left, right, calib, drive.name))
    return items


def _listed(root: Path, row: dict[str, str]) -> Item:
    day, drive = root / row["date"], row["drive"]

    def image(column: str, camera: str) -> Path:
        path = root / row[column]  # an absolute path stays itself
        moved = day / drive / f"image_{camera}" / "data" / path.name
        return path if path.exists() else moved

    calib = root / row["calib"]
    return Item(
        image("left", LEFT),
        image("right", RIGHT),
        calib if calib.exists() else day / CALIBRATION,
        drive,
    )


def _read(item: Item) -> Pair:
    left, right = (_camera(item, name) for name in (LEFT, RIGHT))
    T_right_left = right.T_cam_reference @ inverse(left.T_cam_reference)
    pair = Pair(
        left=_image(item.left, left),
        right=_image(item.right, right),
        K_left=left.K,
        K_right=right.K,
        T_right_left=T_right_left,
        T_right_left_nominal=T_right_left,
        name=f"{item.drive} {item.left.stem}",
        scene=item.drive,
    )
    return without_rim(pair, left.dist, right.dist)


def _image(path: Path, camera: Camera) -> Image:
    image = read_rgb(path)
    h, w = image.shape[:2]
    if (w, h) != camera.wh:
        raise UserError(
            f"{path}: {w}x{h}, but {CALIBRATION} is for {camera.wh[0]}x{camera.wh[1]}: resized "
            "images, or a drive of another day? Take KITTI's own images."
        )
    return undistorted(image, camera.K, camera.dist)


def _camera(item: Item, name: str) -> Camera:
    values, where = _calibration(item.calib), f"{item.calib}, camera {name}"

    def entry(key: str, shape: tuple[int, ...]) -> Array:
        if f"{key}_{name}" not in values:
            raise UserError(f"{item.calib}: no entry {key}_{name}; is it {CALIBRATION} of KITTI?")
        return matrix(values[f"{key}_{name}"], shape, f"{where}: {key}")

    if item.drive.endswith("_sync"):
        P, size = entry("P_rect", (3, 4)), entry("S_rect", (2,))
        K, dist = P[:, :3], np.zeros(5)
        T = transform(np.eye(3), np.linalg.inv(K) @ P[:, 3])
    elif item.drive.endswith("_extract"):
        K, dist, size = entry("K", (3, 3)), entry("D", (5,)), entry("S", (2,))
        T = transform(entry("R", (3, 3)), entry("T", (3,)))
    else:
        raise UserError(
            f"{item.drive}: expected a drive whose name ends in _sync (rectified images) or "
            "_extract (raw ones): the calibration depends on it."
        )
    return Camera(K, dist, T, (int(size[0]), int(size[1])))


@cache
def _calibration(path: Path) -> dict[str, list[str]]:
    """The entries ``name: numbers`` of a calibration file."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise UserError(f"{path}: no KITTI calibration here ({error.strerror}).") from error
    split = (line.partition(":") for line in lines if ":" in line)
    return {name.strip(): values.split() for name, _, values in split}
