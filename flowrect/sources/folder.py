"""A plain folder: left/ and right/ hold images of the same names, calib.yaml the rig."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flowrect.calibration import Calibration
from flowrect.files import IMAGE_SUFFIXES, read_rgb
from flowrect.formats import read_calibration
from flowrect.sample import Pair
from flowrect.sources.pairs import Pairs, digest_files
from flowrect.sources.rim import without_rim
from simgen.errors import UserError

CALIBRATION = "calib.yaml"

Item = tuple[Path, Path]  # left and right image


def open_folder(folder: Path, *, trusted: bool = False) -> Pairs[Item]:
    """The pairs by name.

    Args:
      trusted: the calibration is the truth, not only where a method starts from.
    """
    path = folder / CALIBRATION
    items = match_by_name(folder / "left", folder / "right")
    return Pairs(
        items,
        partial(_read, read_calibration([path]), trusted, folder.name),
        layout=f"{folder}: left/, right/ and {CALIBRATION}",
        fingerprint=digest_files([path, *(image for item in items for image in item)]),
    )


def match_by_name(left_dir: Path, right_dir: Path) -> list[Item]:
    """The images of two folders whose names are equal but for the suffix, sorted."""
    left, right = _images(left_dir), _images(right_dir)
    single = sorted(left.keys() ^ right.keys())
    if single:
        raise UserError(
            f"{len(single)} images stand in only one of {left_dir} and {right_dir}, first "
            f"{single[0]!r}. Both views of a pair need the same file name."
        )
    return [(left[name], right[name]) for name in sorted(left)]


def _images(folder: Path) -> dict[str, Path]:
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    images = {p.stem: p for p in paths}
    if len(images) < len(paths):
        double = next(p for p in paths if images[p.stem] != p)
        raise UserError(
            f"{folder}: {double.name} and {images[double.stem].name} are one name; keep one."
        )
    return images


def _read(rig: Calibration, trusted: bool, scene: str, item: Item) -> Pair:
    left, right = (read_rgb(path) for path in item)
    for image, path in ((left, item[0]), (right, item[1])):
        rig.require_size((image.shape[1], image.shape[0]), str(path))
    left, right = rig.undistorted(left, right)
    pair = Pair(
        left=left,
        right=right,
        K_left=rig.K_left,
        K_right=rig.K_right,
        T_right_left=rig.T_right_left if trusted else None,
        T_right_left_nominal=rig.T_right_left,
        name=item[0].stem,
        scene=scene,
    )
    if rig.lens == "fisheye":  # straightened, its border moves outwards
        return pair
    return without_rim(pair, rig.dist_left, rig.dist_right)
