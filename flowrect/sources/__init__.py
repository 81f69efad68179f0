"""Where pairs come from: one file a layout, all of them lazy lists of ``flowrect.sample.Pair``.

pairs = open_source("shards", split="train")
print(pairs)          # shards: simgen shards, train: 6948 pairs
pair = pairs[0]       # read now
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from flowrect.files import read_csv
from flowrect.sources import carla_release, kitti, semi_truck
from flowrect.sources.folder import open_folder
from flowrect.sources.pairs import Pairs
from flowrect.sources.shards import open_shards
from simgen.errors import UserError
from simgen.shards import MANIFEST

EXPECTED = f"""Expected one of
  {MANIFEST}                    a set that simgen has rendered
  left/, right/, calib.yaml        images of the same names, and the rig as OpenCV YAML
  <date>/{kitti.CALIBRATION}    KITTI raw
  {carla_release.CONFIG}              the release's Carla set
or a CSV list of {len(kitti.COLUMNS)} (KITTI), {len(carla_release.COLUMNS)} (Carla) or \
{len(semi_truck.COLUMNS)} (Semi-Truck) columns, with root the folder of its images."""

__all__ = ["Pairs", "open_source"]


def open_source(
    path: str | Path,
    *,
    split: str | None = None,
    root: str | Path | None = None,
    truth_points: int | None = 2048,
    trusted: bool = False,
) -> Pairs[Any]:
    """Recognises the layout of a folder, or of a CSV list, and opens it.

    Args:
      split: "train" or "test" of a rendered set; the other layouts are split by their lists.
      root: the folder that a list's paths are relative to; the list's own folder if None.
      truth_points: about how many correspondences a rendered pair carries; None: all pixels; 0:
        none.
      trusted: the calibration of a plain folder is the truth.
    """
    path = Path(path)
    if path.is_file():
        return _open_list(path, Path(root) if root else path.parent)
    if not path.is_dir():
        raise UserError(f"{path}: no such folder or list.")
    if (path / MANIFEST).is_file():
        return open_shards(path, split, truth_points=truth_points)
    if split is not None:
        raise UserError(
            f"{path}: split {split!r} is known for rendered sets only, and there is no {MANIFEST} "
            "here. Give a CSV list of the pairs you want, or no split."
        )
    if (path / "left").is_dir() and (path / "right").is_dir():
        return open_folder(path, trusted=trusted)
    if (path / carla_release.CONFIG).is_file():
        return carla_release.open_carla(path)
    if any(path.glob(f"*/{kitti.CALIBRATION}")):
        return kitti.open_kitti(path)
    found = ", ".join(sorted(p.name for p in path.iterdir())[:8]) or "nothing"
    raise UserError(f"{path}: no layout that is known; it holds {found}.\n{EXPECTED}")


def _open_list(path: Path, root: Path) -> Pairs[Any]:
    rows = read_csv(path)
    openers: dict[int, Callable[[], Pairs[Any]]] = {
        len(kitti.COLUMNS): lambda: kitti.open_kitti(root, kitti.read_list(path)),
        len(carla_release.COLUMNS): lambda: carla_release.open_carla(
            root, carla_release.read_list(path)
        ),
        len(semi_truck.COLUMNS): lambda: semi_truck.open_semi_truck(
            root, semi_truck.read_list(path)
        ),
    }
    columns = len(rows[0]) if rows else 0
    if columns not in openers:
        raise UserError(f"{path}: a list of {columns} columns.\n{EXPECTED}")
    return openers[columns]()
