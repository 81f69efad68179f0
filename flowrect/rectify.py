"""Rectifying one's own images: ``python -m flowrect.rectify LEFT RIGHT --calib rig.yaml``.

Each pair gets a folder OUT/NAME: ``left.png``, ``right.png``, ``overlay.png``, the corrected
calibration as ``opencv.yaml``, ``camchain.yaml`` (Kalibr), ``ros_left.yaml`` and
``ros_right.yaml``, and ``quality.json``. OUT/summary.csv has one line for each of them. A folder
appears when its pair is complete, so an interrupted run leaves whole results only.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from flowrect.calibration import Calibration, Projections, projections
from flowrect.files import make_folder, read_json, read_rgb
from flowrect.formats import kalibr, opencv, read_calibration, ros
from flowrect.memory import keep_freed_memory
from flowrect.methods import Method, PoseEstimate, load_method
from flowrect.overlay import View, draw_overlay
from flowrect.quality import MIN_MATCHES, MatchedRays, sift_matches
from flowrect.sample import Image
from flowrect.solvers import NoSolution
from flowrect.sources.folder import match_by_name
from simgen.errors import UserError
from simgen.geometry import Array, vector_from_rotation

ANGLES = ("pitch_deg", "yaw_deg", "roll_deg")
QUALITY = "quality.json"
"""the file that a result is known by"""
SUMMARY = ("name", *ANGLES, "num_matches", "num_inliers", "num_sift_matches", "before_px",
           "after_px", "notes")  # fmt: skip
"""columns of summary.csv"""


@dataclass(frozen=True)
class RectifyOptions:
    """Rectifies pairs of images: estimates how the cameras stand now, and warps accordingly."""

    left: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LEFT")]
    """image of the left camera, or a folder of them"""
    right: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RIGHT")]
    """image of the right camera, or a folder with the same file names"""
    calib: tuple[Path, ...]
    """nominal calibration: OpenCV YAML, a Kalibr camchain, or two ROS camera_info (left, right)"""
    method: str = "network+5dof"
    """network+5dof: the network, then a fit of rotation and direction of t to SIFT and flow
    matches; network: the network alone, which leaves t as given, unless it is a rival that predicts
    it; MATCHER+SOLVER: matches alone. A method that does not exist is answered by the list of those
    that do"""
    weights: str = "small"
    """of the network, where the method has one: name of shipped weights, or a file of
    flowrect.train"""
    out: Path = Path("rectified")
    """folder for the results, one folder a pair"""
    existing: Literal["refuse", "keep", "replace"] = "refuse"
    """pairs whose result is in OUT already: stop, leave them as they are, or make them again"""


class PairFiles(NamedTuple):
    """Where a pair is, and what its result is called."""

    name: str
    left: Path
    right: Path


@dataclass(frozen=True)
class Quality:
    """What is known of how good an estimate is; angles in degrees, disparities in pixels."""

    name: str
    method: str
    correction_deg: tuple[float, float, float]
    """of R against the given calibration, about the right camera's x, y, z"""
    sigma_deg: tuple[float, float, float] | None
    """standard deviation of these, from the fit to matches; None if the method knows none"""
    num_matches: int | None
    """that the method found"""
    num_inliers: int | None
    """that agree with the estimate"""
    num_sift_matches: int
    """of the check, see flowrect.quality"""
    before_px: float | None
    """median |vertical disparity| of the SIFT matches, rectified by the given calibration"""
    after_px: float | None
    """the same, rectified by the estimate; None: too few matches"""
    notes: tuple[str, ...]
    """what speaks against the estimate"""


# --- one pair ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Rectified:
    """The result of one pair."""

    rig: Calibration
    """corrected"""
    rectification: Projections
    left: Image
    right: Image
    overlay: Image
    quality: Quality


def rectify_pair(method: Method, name: str, rig: Calibration, files: PairFiles) -> Rectified:
    """Estimates the pose of a pair and rectifies it.

    Args:
      name: what the method is called in ``Quality``.
      rig: nominal; its lens distortion is undone first.

    Raises UserError if the files are no pair of this rig, or the method finds no pose.
    """
    left, right = read_rgb(files.left), read_rgb(files.right)
    for path, image in ((files.left, left), (files.right, right)):
        rig.require_size((image.shape[1], image.shape[0]), str(path))
    straight = rig.undistorted(left, right)
    pose = _estimated(method, rig, *straight)
    nominal, estimate = (
        projections(T, rig.K_left, rig.K_right, rig.wh)
        for T in (rig.T_right_left, pose.T_right_left)
    )
    matches = sift_matches(*straight, rig.K_left, rig.K_right)
    quality = _quality(files.name, name, rig, pose, matches, (nominal, estimate))
    rectified = rig.rectified(left, right, estimate)
    overlay = draw_overlay(
        f"{files.name}: turned by {_axes(quality)}; {len(matches)} SIFT matches",
        View(
            f"given calibration: median vertical disparity {_px(quality.before_px)}",
            *rig.rectified(left, right, nominal),
            *matches.rectified(nominal),
        ),
        View(
            f"estimate: median vertical disparity {_px(quality.after_px)}",
            *rectified,
            *matches.rectified(estimate),
        ),
        vertical=estimate.vertical,
    )
    corrected = rig.with_pose(pose.R, pose.t)
    return Rectified(corrected, estimate, *rectified, overlay, quality)


def _estimated(method: Method, rig: Calibration, left: Image, right: Image) -> PoseEstimate:
    if np.array_equal(left, right):
        raise UserError("the two images are identical; expected a left and a right view.")
    try:
        return method(left, right, rig.K_left, rig.K_right, rig.T_right_left)
    except NoSolution as error:
        raise UserError(f"no pose found: {error}") from error


def _quality(
    name: str,
    method: str,
    rig: Calibration,
    pose: PoseEstimate,
    matches: MatchedRays,
    rectifications: tuple[Projections, Projections],
) -> Quality:
    before, after = (matches.median_vertical_disparity(x) for x in rectifications)
    turn = np.rad2deg(vector_from_rotation(pose.R @ rig.T_right_left[:3, :3].T))
    return Quality(
        name=name,
        method=method,
        correction_deg=_three(turn),
        sigma_deg=None if pose.covariance is None else _three(_sigma_deg(pose.covariance)),
        num_matches=pose.num_matches,
        num_inliers=pose.num_inliers,
        num_sift_matches=len(matches),
        before_px=before,
        after_px=after,
        notes=(*pose.notes, *_disparity_notes(before, after, len(matches))),
    )


def _sigma_deg(covariance: Array) -> Array:
    return np.rad2deg(np.sqrt(np.diag(covariance)[:3]))


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _disparity_notes(before: float | None, after: float | None, num: int) -> list[str]:
    if before is None or after is None:
        return [f"only {num} SIFT matches, {MIN_MATCHES} are needed: the result is unchecked."]
    if after <= before:
        return []
    return [
        f"the estimate leaves more vertical disparity ({after:.2f} px) than the given calibration "
        f"({before:.2f} px) on {num} SIFT matches: prefer the given one."
    ]


def write_result(folder: Path, result: Rectified) -> list[str]:
    """Writes the files of a pair; returns a note for each format that cannot hold the rig."""
    for name in ("left", "right", "overlay"):
        write_rgb(folder / f"{name}.png", getattr(result, name))
    rig, rectification = result.rig, result.rectification
    opencv.write(folder / "opencv.yaml", rig, rectification)
    ros.write(folder / "ros_left.yaml", folder / "ros_right.yaml", rig, rectification)
    reason = kalibr.unwritable(rig)
    if not reason:
        kalibr.write(folder / "camchain.yaml", rig)
    text = json.dumps(asdict(result.quality), indent=2)  # the last file: what has it is complete
    (folder / QUALITY).write_text(text + "\n", encoding="utf-8")
    return [f"no camchain.yaml: {reason}"] if reason else []


def write_rgb(path: Path, image: Image) -> None:
    """Writes an RGB image."""
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise UserError(f"{path}: cannot be written. Is the disk full?")


# --- many pairs --------------------------------------------------------------------------------


def find_pairs(left: Path, right: Path) -> list[PairFiles]:
    """The pair of two images, or the pairs of two folders by name."""
    for path in (left, right):
        if not path.exists():
            raise UserError(f"{path}: no such image or folder.")
    if left.is_dir() != right.is_dir():
        raise UserError(f"{left}, {right}: one is a folder, one is not; expected two of a kind.")
    if not left.is_dir():
        return [PairFiles(left.stem, left, right)]
    items = match_by_name(left, right)
    if not items:
        raise UserError(f"{left}, {right}: no images in them.")
    return [PairFiles(first.stem, first, second) for first, second in items]


def pairs_to_do(pairs: Sequence[PairFiles], options: RectifyOptions) -> list[PairFiles]:
    """The pairs without those that have a result to be kept; UserError if some may not exist."""
    done = [pair for pair in pairs if (options.out / pair.name).exists()]
    if done and options.existing == "refuse":
        raise UserError(
            f"{options.out}: holds results of {len(done)} of {len(pairs)} pairs, first "
            f"{done[0].name}. Choose another --out, or say --existing keep or --existing replace."
        )
    for pair in done:
        folder = options.out / pair.name
        if options.existing == "replace" and not (folder / QUALITY).is_file():
            raise UserError(
                f"{folder}: holds no {QUALITY}, so it is not a result that could be replaced. "
                "Choose another --out, or put it elsewhere."
            )
    return [pair for pair in pairs if options.existing == "replace" or pair not in done]


@contextmanager
def complete_or_absent(folder: Path) -> Iterator[Path]:
    """A folder to fill, which takes the name ``folder`` if all went well, and vanishes if not."""
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_summary(out: Path) -> None:
    """summary.csv from all results in the folder."""
    results = [read_json(path) for path in sorted(out.glob(f"*/{QUALITY}"))]
    results = [
        x for x in results if isinstance(x, dict) and {"correction_deg", "notes"} <= x.keys()
    ]
    with (out / "summary.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(SUMMARY)
        for x in results:
            flat = {**x, **dict(zip(ANGLES, x["correction_deg"], strict=True))}
            # Results of an earlier version, which are kept, may lack a figure.
            rows.writerow([flat.get(name, "") for name in SUMMARY[:-1]] + [" ".join(x["notes"])])


# --- the command -------------------------------------------------------------------------------


def run(options: RectifyOptions, console: Console) -> int:
    """Rectifies all pairs; returns how many failed."""
    pairs = find_pairs(options.left, options.right)
    todo = pairs_to_do(pairs, options)
    if len(todo) < len(pairs):
        console.print(f"kept: {len(pairs) - len(todo)} of {len(pairs)} pairs have a result already")
    rig = read_calibration(options.calib, size_of_first(pairs))
    method = load_method(_with_weights(options))
    make_folder(options.out)
    failed = 0
    try:
        for pair in track(todo, "rectifying", console=console, disable=len(todo) < 2):
            try:
                result = rectify_pair(method, options.method, rig, pair)
                with complete_or_absent(options.out / pair.name) as folder:
                    lacks = write_result(folder, result)
            except (UserError, ValueError, ArithmeticError, cv2.error) as error:
                failed += 1
                failure = f"[red]{escape(pair.name)} failed:[/red] {escape(str(error))}"
                console.print(failure, soft_wrap=True)
                continue
            _say(console, result.quality, lacks)
    finally:
        write_summary(options.out)
    summary = f"rectified: {len(todo) - failed} of {len(todo)} pairs, in {options.out}"
    console.print(summary, soft_wrap=True, markup=False)
    return failed


def size_of_first(pairs: Sequence[PairFiles]) -> tuple[int, int]:
    """Width and height of the first left image that can be read; UserError if none can."""
    for pair in pairs:
        try:
            h, w = read_rgb(pair.left).shape[:2]
        except UserError:  # it fails when its turn comes, and is counted
            continue
        return w, h
    read_rgb(pairs[0].left)  # raises, and says why
    raise AssertionError


def _with_weights(options: RectifyOptions) -> str:
    """The method's name with the weights that are asked for."""
    head, plus, solver = options.method.partition("+")
    if head == "network":
        return f"network={options.weights}{plus}{solver}"
    if options.weights != "small":
        raise UserError(
            f"--weights {options.weights}: goes with --method network, network+3dof and "
            f"network+5dof, not with {options.method}. Leave it out, or ask for one of these; they "
            "take weights of any network of flowrect.train."
        )
    return options.method


def _say(console: Console, quality: Quality, lacks: Sequence[str]) -> None:
    checked = f"{_px(quality.before_px)} before, {_px(quality.after_px)} after"
    console.print(
        f"{quality.name}: turned by {_axes(quality)}; median vertical disparity of "
        f"{quality.num_sift_matches} SIFT matches: {checked}",
        soft_wrap=True, markup=False,
    )  # fmt: skip
    for note in (*quality.notes, *lacks):
        console.print(f"  [yellow]note:[/yellow] {escape(note)}", soft_wrap=True)


def _px(median_px: float | None) -> str:
    return "not measured" if median_px is None else f"{median_px:.2f} px"


def _axes(quality: Quality) -> str:
    pitch, yaw, roll = quality.correction_deg
    return f"pitch {pitch:+.2f}°, yaw {yaw:+.2f}°, roll {roll:+.2f}°"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something, 130 after Ctrl-C."""
    options = tyro.cli(RectifyOptions, args=arguments, prog="flowrect.rectify")
    keep_freed_memory()
    console = Console(highlight=False)
    try:
        return 2 if run(options, console) else 0
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        console.print(
            f"interrupted: what is in {options.out} is complete. Go on with --existing keep.",
            soft_wrap=True, markup=False,
        )  # fmt: skip
        return 130


if __name__ == "__main__":
    sys.exit(main())
