"""The Semi-Truck Highway set of the paper's release: images, CSV lists, JSON calibrations.

A JSON file maps capture → camera type → ``{"extrinsics": {"i_j": {rmat, tvec}}, "intrinsics":
{"i": {K, dist}}}``; ``rmat`` (9), ``tvec`` (3) take camera i to camera j. It lies anywhere below
the root, in a folder named like the week. The calibration counts as the truth. K is taken as
OpenCV gives it: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from flowrect.files import matrix, read_json, read_rgb, read_rows, rotation, undistorted
from flowrect.sample import Pair
from flowrect.sources.pairs import Pairs, digest_files
from flowrect.sources.rim import without_rim
from simgen.errors import UserError
from simgen.geometry import Array, inverse, transform

COLUMNS = ("dataset", "week", "capture", "cam_type", "target_cam", "ref_cam", "left", "right")
DAYLIGHTS = ("noon", "morning", "dusk", "night")
NUM_DIST = (4, 5, 8, 12, 14)  # lengths that OpenCV knows

Rig = dict[str, Any]
Rigs = dict[tuple[str, str], dict[str, Rig]]  # (week, capture) → camera type → rig


@dataclass(frozen=True)
class Item:
    """One pair."""

    week: str
    capture: str
    cam_type: str
    cameras: tuple[str, str]
    left: Path
    right: Path


def open_semi_truck(root: Path, rows: Sequence[dict[str, str]]) -> Pairs[Item]:
    """The pairs of a list.

    Args:
      root: image paths are relative to it; the calibrations lie below it.
      rows: of a list with ``COLUMNS``.
    """
    files = sorted(root.rglob("*.json"))
    items = [_item(root, row) for row in rows]
    images = {path for item in items for path in (item.left, item.right)}
    return Pairs(
        items,
        partial(_read, _rigs(files)),
        layout=f"{root}: the release's Semi-Truck set",
        fingerprint=digest_files([*files, *sorted(images)]),
        rig=attrgetter("week", "capture", "cam_type", "cameras"),
    )


def read_list(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV list."""
    return read_rows(path, COLUMNS)


def _item(root: Path, row: dict[str, str]) -> Item:
    return Item(
        week=row["week"],
        capture=row["capture"],
        cam_type=row["cam_type"],
        cameras=(row["target_cam"], row["ref_cam"]),
        left=root / row["left"],
        right=root / row["right"],
    )


def _rigs(files: Sequence[Path]) -> Rigs:
    contents = [(file.parent.name, read_json(file)) for file in files]
    return {
        (week, capture): rigs for week, content in contents for capture, rigs in content.items()
    }


def _read(rigs: Rigs, item: Item) -> Pair:
    rig, where = _rig(rigs, item), f"{item.capture}, {item.cam_type}"
    T_right_left = _relative_pose(rig["extrinsics"], *item.cameras, where)
    K_left, dist_left = _optics(rig["intrinsics"], item.cameras[0], where)
    K_right, dist_right = _optics(rig["intrinsics"], item.cameras[1], where)
    pair = Pair(
        left=undistorted(read_rgb(item.left), K_left, dist_left),
        right=undistorted(read_rgb(item.right), K_right, dist_right),
        K_left=K_left,
        K_right=K_right,
        T_right_left=T_right_left,
        T_right_left_nominal=T_right_left,
        name=f"{item.left.stem} and {item.right.stem}",
        scene=f"{item.week} {item.capture}",
        daylight=next((d for d in DAYLIGHTS if d in str(item.left)), ""),
    )
    return without_rim(pair, dist_left, dist_right)


def _rig(rigs: Rigs, item: Item) -> Rig:
    capture = rigs.get((item.week, item.capture), {})
    if item.cam_type not in capture:
        known = sorted(f"{week}/{name}" for week, name in rigs)
        raise UserError(
            f"{item.left}: no calibration of {item.week}/{item.capture}, {item.cam_type}; have "
            f"{', '.join(known[:8]) or 'none'}. Put the JSON file of the capture below the root, "
            "in a folder named like the week."
        )
    return capture[item.cam_type]


def _relative_pose(extrinsics: Rig, left: str, right: str, where: str) -> Array:
    if f"{left}_{right}" in extrinsics:
        return _pose(extrinsics[f"{left}_{right}"], f"{where}, extrinsics {left}_{right}")
    if f"{right}_{left}" in extrinsics:
        return inverse(_pose(extrinsics[f"{right}_{left}"], f"{where}, extrinsics {right}_{left}"))
    raise UserError(f"{where}: no extrinsics {left}_{right}; have {', '.join(extrinsics)}.")


def _pose(entry: Rig, where: str) -> Array:
    return transform(rotation(entry["rmat"], where), matrix(entry["tvec"], (3,), where))


def _optics(intrinsics: Rig, camera: str, where: str) -> tuple[Array, Array]:
    if camera not in intrinsics:
        raise UserError(f"{where}: no intrinsics of camera {camera}.")
    K, dist = intrinsics[camera]["K"], intrinsics[camera].get("dist", [0.0] * 5)
    if len(dist) not in NUM_DIST:
        raise UserError(f"{where}: {len(dist)} coefficients in dist, expected one of {NUM_DIST}.")
    return matrix(K, (3, 3), f"{where}: K"), matrix(dist, (len(dist),), f"{where}: dist")
