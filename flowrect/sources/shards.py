"""Pairs of a set that simgen has rendered, with exact ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np

from flowrect.correspondences import Correspondences, from_depth
from flowrect.sample import Pair
from flowrect.sources.pairs import Pairs, digest
from simgen.errors import UserError
from simgen.geometry import Array, inverse, rotation_from_vector
from simgen.shards import Frame, ShardSet


@dataclass(frozen=True)
class Item:
    """One pair of one frame."""

    frame: int
    """index in the set"""
    position: int
    """in the rig's list of pairs"""
    cameras: tuple[int, int]
    """(left, right)"""
    scene: int
    reverse: bool = False
    """from the pair's right camera to its left one, which then goes by the name of right"""

    def reversed(self) -> Item:
        """The same pair in the other direction."""
        return replace(self, cameras=self.cameras[::-1], reverse=not self.reverse)


def open_shards(
    folder: Path, split: str | None = None, *, truth_points: int | None = 2048
) -> Pairs[Item]:
    """Every pair of every frame, frame by frame.

    Args:
      split: "train", "test" or None for both; decided when the set was rendered (test: scene
        index divisible by 10).
      truth_points: about how many correspondences a pair carries; None: one per left pixel; 0:
        none, and neither depth nor visibility is read.
    """
    frames = ShardSet(folder, split)
    if not frames:
        raise UserError(_nothing(folder, split))
    shards = [s for s in frames.manifest.shards if split in (None, s.split)]
    missing = [s.name for s in shards if not (folder / s.name).is_file()]
    if missing:
        raise UserError(
            f"{folder}: {len(missing)} of {len(shards)} shards are missing, first {missing[0]}. "
            "Copy them anew, or run the same render command again."
        )
    cameras = frames[0].pairs  # of the rig, the same for all frames
    frames.close()
    in_scene = int(frames.manifest.config["frames_per_scene"])
    return Pairs(
        [
            Item(index, i, pair, index // in_scene)
            for index in frames.indices
            for i, pair in enumerate(cameras)
        ],
        partial(_read, frames, truth_points),
        layout=f"{folder}: simgen shards, {split or 'train and test'}",
        fingerprint=digest([f"{s.name} {s.sha256}" for s in shards] + [str(truth_points)]),
        largest_turn_deg=float(frames.manifest.config["rig"]["perturbation_deg"]),
        rig=attrgetter("cameras"),
        scene=attrgetter("scene"),
        reverse=Item.reversed,
    )


def _nothing(folder: Path, split: str | None) -> str:
    have = len(ShardSet(folder))
    if not have:
        return f'{folder}: a set without a frame. Run "simgen render" to the end first.'
    return (
        f"{folder}: no {split} frames among its {have}. Frames whose scene index is divisible by "
        "10 are for testing, all others for training: render more pairs (a larger --n), or "
        "without --split."
    )


def _read(frames: ShardSet, truth_points: int | None, item: Item) -> Pair:
    frame, (left, right) = frames.frame(item.frame), item.cameras
    K, T, T_nominal, drawn_deg = (
        frame.read(name) for name in ("K", "T_world_cam", "T_world_cam_nominal", "perturbation_deg")
    )
    spec, T_right_left = frame.spec, inverse(T[right]) @ T[left]
    return Pair(
        left=frame.read("image", left),
        right=frame.read("image", right),
        K_left=K[left],
        K_right=K[right],
        T_right_left=T_right_left,
        T_right_left_nominal=inverse(T_nominal[right]) @ T_nominal[left],
        turn_left=_turn(drawn_deg[left]),
        turn_right=_turn(drawn_deg[right]),
        truth=None if truth_points == 0 else _truth(frame, item, truth_points),
        name=f"frame {item.frame}, cameras {left} and {right}",
        scene=str(frame.scene_index),
        weather=str(spec["weather"]["name"]),
        daylight=str(spec["daylight"]["name"]),
    )


def _truth(frame: Frame, item: Item, num: int | None) -> Correspondences:
    left, right = item.cameras
    T, status = frame.read("T_world_cam"), "flow_status_reverse" if item.reverse else "flow_status"
    return from_depth(
        frame.read("depth", left),
        frame.read(status, item.position),
        frame.read("K", left),
        inverse(T[right]) @ T[left],
        num=num,
    )


def _turn(drawn_deg: Array) -> Array:
    return rotation_from_vector(np.deg2rad(drawn_deg))
