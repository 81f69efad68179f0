"""What makes every sight of a training pair a new one: swaps, fresh rotations, colour.

Everything is drawn from the generator that is passed in, in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, resized, sized
from flowrect.sample import Image, Pair, Prepared
from flowrect.turn import draw_turn, turned
from simgen.geometry import Array, inverse, rotation_from_vector

LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
MIRROR = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Augmentation:
    """What is drawn anew each time a pair is seen."""

    turn_deg: float = 1.0
    """each camera's rotation vector against its nominal pose, each component uniform within ±
    this, in place of the rotation it has; 0 leaves the cameras as they stand"""
    mirror: float = 0.5
    """probability of swapping the views and mirroring both, so that the rig stays left-first; those
    of a vertical rig are mirrored only"""
    swap: float = 0.0
    """probability of swapping the views alone: the baseline changes its sign"""
    brightness: float = 0.2
    """factor within 1 ± this, for each image alone"""
    contrast: float = 0.2
    """factor within 1 ± this, about the image's mean luma"""
    saturation: float = 0.2
    """factor within 1 ± this, about each pixel's luma"""
    hue_deg: float = 10.0
    """turn of all colours about the grey axis, within ± this"""


def augmented(
    pair: Pair, sizing: Sizing, options: Augmentation, *, rng: np.random.Generator
) -> Prepared:
    """A fresh sight of the pair at the network's size and at ``METRIC_WH``."""
    swap, mirror = rng.random() < options.swap, rng.random() < options.mirror
    pair = swapped(pair) if swap else pair
    if options.turn_deg:
        prepared = _turned_afresh(pair, sizing, options.turn_deg, rng)
    else:
        prepared = sized(pair, sizing)
    left, right = prepared.input.left, prepared.input.right
    colours = draw_colours(left, options, rng=rng), draw_colours(right, options, rng=rng)
    coloured = (recoloured(p, *colours) for p in prepared)
    return Prepared(*(mirrored(p) if mirror else p for p in coloured))


def _turned_afresh(
    pair: Pair, sizing: Sizing, limit_deg: float, rng: np.random.Generator
) -> Prepared:
    """Warps once, at the larger of the two sizes; the smaller is its area mean."""
    turns = draw_turn(limit_deg, rng=rng), draw_turn(limit_deg, rng=rng)
    largest = max(sizing.input_wh, METRIC_WH)
    sharp = turned(pair, *turns, sizing.box(pair.wh), largest)
    return Prepared(resized(sharp, sizing.input_wh), resized(sharp, METRIC_WH))


# --- swaps -------------------------------------------------------------------------------------


def swapped(pair: Pair) -> Pair:
    """The right camera first: (R, t) becomes (Rᵀ, −Rᵀ t)."""
    T, truth = pair.T_right_left, pair.truth
    return replace(
        pair,
        left=pair.right,
        right=pair.left,
        K_left=pair.K_right,
        K_right=pair.K_left,
        T_right_left=None if T is None else inverse(T),
        T_right_left_nominal=inverse(pair.T_right_left_nominal),
        turn_left=pair.turn_right,
        turn_right=pair.turn_left,
        truth=None if truth is None or T is None else truth.swapped(T[:3, :3], T[:3, 3]),
    )


def mirrored(pair: Pair) -> Pair:
    """Both views mirrored left to right; those of a horizontal rig also swapped.

    So a left-first rig stays one, and a vertical rig with the upper camera first, too.
    """
    x, y, _ = np.abs(pair.T_right_left_nominal[:3, 3])
    pair = swapped(pair) if x > y else pair
    T = pair.T_right_left
    return replace(
        pair,
        left=np.ascontiguousarray(pair.left[:, ::-1]),
        right=np.ascontiguousarray(pair.right[:, ::-1]),
        K_left=_mirrored_intrinsics(pair.K_left, pair.wh[0]),
        K_right=_mirrored_intrinsics(pair.K_right, pair.wh[0]),
        T_right_left=None if T is None else _mirrored_pose(T),
        T_right_left_nominal=_mirrored_pose(pair.T_right_left_nominal),
        turn_left=MIRROR @ pair.turn_left @ MIRROR,
        turn_right=MIRROR @ pair.turn_right @ MIRROR,
        truth=pair.truth and pair.truth.mirrored(),
    )


def _mirrored_intrinsics(K: Array, width: int) -> Array:
    """cx becomes W − 1 − cx, and skew changes its sign."""
    K = K.copy()
    K[0, 1:] = -K[0, 1], width - 1 - K[0, 2]
    return K


def _mirrored_pose(T: Array) -> Array:
    M = np.diag([-1.0, 1.0, 1.0, 1.0])
    return M @ T @ M


# --- colour ------------------------------------------------------------------------------------


def draw_colours(image: Image, options: Augmentation, *, rng: np.random.Generator) -> Array:
    """An affine map (3, 4) of RGB in 0..255: hue, saturation, contrast, then brightness."""
    brightness, contrast, saturation = (
        1 + rng.uniform(-amount, amount)
        for amount in (options.brightness, options.contrast, options.saturation)
    )
    angle = np.deg2rad(rng.uniform(-options.hue_deg, options.hue_deg))
    hue = rotation_from_vector(angle / np.sqrt(3) * np.ones(3))
    grey = np.outer(np.ones(3), LUMA)
    linear = contrast * (saturation * np.eye(3) + (1 - saturation) * grey) @ hue
    mean_luma = LUMA @ image.mean(axis=(0, 1))
    offset = np.full((3, 1), (1 - contrast) * mean_luma)
    return brightness * np.hstack([linear, offset])


def recoloured(pair: Pair, left: Array, right: Array) -> Pair:
    """Each image under its own affine map (3, 4) of RGB, rounded and clipped to 8 bits."""
    return replace(
        pair, left=cv2.transform(pair.left, left), right=cv2.transform(pair.right, right)
    )
