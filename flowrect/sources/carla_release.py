"""The Carla set of the paper's release: ``cam_{i}/``, ``cam_p_{i}/`` and a JSON file per frame.

``########.json`` holds ``rgb_cam{i}_matrix`` (nominal) and ``rgb_p_cam{i}_matrix`` (perturbed),
camera to world in Unreal's axes (x forward, y right, z up; left-handed). With P below,
``T_world_cam = P M P⁻¹`` in OpenCV's axes. ``config_args.json`` holds ``fov``, the horizontal field
of view in degrees, and ``dim``, the image size. Images are without distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from flowrect.files import matrix, read_json, read_rgb, read_rows
from flowrect.sample import Image, Pair
from flowrect.sources.pairs import Pairs, digest_files
from simgen.errors import UserError
from simgen.geometry import Array, intrinsics, inverse, vector_from_rotation

COLUMNS = ("target_cam", "ref_cam", "left_perturbed", "right_perturbed", "left", "right")
CONFIG = "config_args.json"
PAIRS = ((0, 1), (1, 2), (0, 2))
P = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # OpenCV from Unreal


@dataclass(frozen=True)
class View:
    """One image of a pair."""

    camera: int
    perturbed: bool
    image: Path


@dataclass(frozen=True)
class Item:
    """One pair."""

    left: View
    right: View
    poses: Path


def open_carla(root: Path, rows: Sequence[dict[str, str]] | None = None) -> Pairs[Item]:
    """The pairs of a list, or the perturbed pairs (0, 1), (1, 2), (0, 2) of every frame.

    Args:
      root: holds ``config_args.json``, the image folders and, anywhere below, the poses.
      rows: of a list with ``COLUMNS``; image paths are relative to ``root``.
    """
    poses = {p.stem: p for p in sorted(root.rglob("*.json")) if p.name != CONFIG}
    if rows is None:
        rows = [_row(frame, *pair) for frame in poses for pair in PAIRS]
    items = [_item(root, poses, row) for row in rows]
    config = root / CONFIG
    files = {f for item in items for f in (item.left.image, item.right.image, item.poses)}
    return Pairs(
        items,
        partial(_read, *_optics(config)),
        layout=f"{root}: the release's Carla set",
        fingerprint=digest_files([config, *sorted(files)]),
        largest_turn_deg=_largest_turn_deg(items),
        scene=attrgetter("poses"),
    )


def _largest_turn_deg(items: Sequence[Item]) -> float:
    """Of all perturbed cameras against their nominal poses, about each axis."""
    views = {(item.poses, v.camera) for item in items for v in (item.left, item.right)
             if v.perturbed}  # fmt: skip
    contents = {path: read_json(path) for path, _ in views}
    turns = [
        vector_from_rotation(
            _pose(contents[path], path, camera, False)[:3, :3].T
            @ _pose(contents[path], path, camera, True)[:3, :3]
        )
        for path, camera in views
    ]
    return float(np.rad2deg(np.abs(turns).max())) if turns else 0.0


def read_list(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV list."""
    return read_rows(path, COLUMNS)


def _row(frame: str, left: int, right: int) -> dict[str, str]:
    images = (f"cam_p_{camera}/{frame}.png" for camera in (left, right))
    return dict(zip(COLUMNS, (str(left), str(right), "True", "True", *images), strict=True))


def _item(root: Path, poses: dict[str, Path], row: dict[str, str]) -> Item:
    left = View(int(row["target_cam"]), _flag(row["left_perturbed"]), root / row["left"])
    right = View(int(row["ref_cam"]), _flag(row["right_perturbed"]), root / row["right"])
    frame = left.image.stem
    if frame not in poses or right.image.stem != frame:
        raise UserError(
            f"{root}: no poses {frame}.json for {row['left']} and {row['right']}. Both images of a "
            "pair bear the frame's number, and its JSON file lies below the same folder."
        )
    return Item(left, right, poses[frame])


def _flag(text: str) -> bool:
    if text not in ("True", "False"):
        raise UserError(f"{text!r} in a column *_perturbed: expected True or False.")
    return text == "True"


def _optics(config: Path) -> tuple[float, tuple[int, ...]]:
    """Field of view [degrees] and image size, sorted: the release states it in either order."""
    content = read_json(config)
    try:
        fov, dim = np.ravel(content["fov"])[0], np.ravel(content["dim"])[:2]
        return float(fov), tuple(sorted(int(n) for n in dim))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise UserError(f"{config}: expected fov [degrees] and dim, two sides in px.") from error


def _read(fov_deg: float, sides: tuple[int, ...], item: Item) -> Pair:
    left, right = (_image(view.image, sides) for view in (item.left, item.right))
    content = read_json(item.poses)
    poses = [_pose(content, item.poses, v.camera, v.perturbed) for v in (item.left, item.right)]
    nominal = [_pose(content, item.poses, v.camera, False) for v in (item.left, item.right)]
    # The release puts the centre at W/2 from the outer corner: (W − 1)/2 here.
    K = intrinsics((left.shape[1], left.shape[0]), fov_deg)
    return Pair(
        left=left,
        right=right,
        K_left=K,
        K_right=K,
        T_right_left=inverse(poses[1]) @ poses[0],
        T_right_left_nominal=inverse(nominal[1]) @ nominal[0],
        turn_left=(inverse(nominal[0]) @ poses[0])[:3, :3],
        turn_right=(inverse(nominal[1]) @ poses[1])[:3, :3],
        name=f"{item.poses.stem}, cameras {item.left.camera} and {item.right.camera}",
        scene=item.poses.stem,
    )


def _image(path: Path, sides: tuple[int, ...]) -> Image:
    image = read_rgb(path)
    h, w = image.shape[:2]
    if tuple(sorted((w, h))) != sides:
        raise UserError(f"{path}: {w}x{h}, but {CONFIG} says {sides[1]}x{sides[0]}.")
    return image


def _pose(content: Any, path: Path, camera: int, perturbed: bool) -> Array:
    """T_world_cam (4, 4) in OpenCV's axes."""
    key = f"rgb_p_cam{camera}_matrix" if perturbed else f"rgb_cam{camera}_matrix"
    if key not in content:
        raise UserError(f"{path}: no {key}; found {', '.join(content)}.")
    return P @ matrix(content[key], (4, 4), f"{path}: {key}") @ P.T
