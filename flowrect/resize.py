"""Windows of an image: crop about the centre, then an area filter, with K exact at every step.

A *window* is a box of whole native pixels, twice as wide as high like the network's input, centred
in the image; ``keep`` says how much of the largest such box it takes. Cutting columns and rows
only shifts the principal point; resizing by s takes f to s f and c to s (c + ½) − ½, since images
begin at −½. Ground truth is untouched by either: it travels as rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from flowrect.metrics import METRIC_WH
from flowrect.sample import Image, Pair, Prepared
from simgen.errors import UserError
from simgen.geometry import Array


@dataclass(frozen=True)
class Box:
    """Whole pixels of an image: columns from ``left`` on, rows from ``top`` on."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class Sizing:
    """How a native image becomes the network's input."""

    input_wh: tuple[int, int] = (256, 128)
    """network input (width, height) [px]"""
    fit: Literal["crop", "stretch"] = "crop"
    """crop: cut to 2:1, square pixels; stretch: squeeze the whole image, as the paper's release"""
    keep: float = 1.0
    """share of the window's sides that is kept: below 1 it leaves room for drawn rotations. The
    focal length in pixels follows from it, so train and use a model with the same value"""

    def __post_init__(self) -> None:
        w, h = self.input_wh
        if min(w, h) < 1 or not 0 < self.keep <= 1:
            raise UserError(f"{self}: expected a positive size and 0 < keep <= 1.")
        if self.fit == "crop" and w != 2 * h:
            raise UserError(
                f"input_wh {w}x{h}: expected twice as wide as high, like the {METRIC_WH[0]}x"
                f"{METRIC_WH[1]} of the losses. Take {2 * h}x{h}, or fit = stretch."
            )

    def box(self, wh: tuple[int, int]) -> Box:
        """The window of an image of size ``wh``."""
        (w, h), keep = wh, self.keep + 1e-9
        width, height = int(keep * w), int(keep * h)
        if self.fit == "crop":
            height = int(keep * min(h, w // 2))
            width = 2 * height
        if not width or not height:
            raise UserError(f"an image of {w}x{h} is too small to cut a window from.")
        return Box((w - width) // 2, (h - height) // 2, width, height)


def cropped_intrinsics(K: Array, left: float, top: float) -> Array:
    """K (3, 3) of an image cut so that pixel (left, top) becomes (0, 0)."""
    return K - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])


def resized_intrinsics(K: Array, scale_x: float, scale_y: float) -> Array:
    """K (3, 3) of an image resized by new / old size."""
    scale = np.diag([scale_x, scale_y, 1.0])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    resized: Array = np.linalg.inv(half) @ scale @ half @ K
    return resized


def window_intrinsics(K: Array, box: Box, wh: tuple[int, int]) -> Array:
    """K (3, 3) of the window ``box`` delivered at size ``wh``."""
    cut = cropped_intrinsics(K, box.left, box.top)
    return resized_intrinsics(cut, wh[0] / box.width, wh[1] / box.height)


def cropped(pair: Pair, box: Box) -> Pair:
    """The pair's pixels inside ``box``."""
    rows = slice(box.top, box.top + box.height)
    columns = slice(box.left, box.left + box.width)
    return replace(
        pair,
        left=pair.left[rows, columns],
        right=pair.right[rows, columns],
        K_left=cropped_intrinsics(pair.K_left, box.left, box.top),
        K_right=cropped_intrinsics(pair.K_right, box.left, box.top),
    )


def resized(pair: Pair, wh: tuple[int, int]) -> Pair:
    """The whole pair at another size (width, height) [px]; itself if it has that size already."""
    if wh == pair.wh:
        return pair
    scale = wh[0] / pair.wh[0], wh[1] / pair.wh[1]
    return replace(
        pair,
        left=resized_image(pair.left, wh),
        right=resized_image(pair.right, wh),
        K_left=resized_intrinsics(pair.K_left, *scale),
        K_right=resized_intrinsics(pair.K_right, *scale),
    )


def resized_image(image: Image, wh: tuple[int, int]) -> Image:
    """Mean over each new pixel's area along a side that shrinks, linear along one that grows.

    cv2's INTER_AREA is an area filter only if *both* sides shrink; else it shifts the image.
    """
    (h, w), (w_new, h_new) = image.shape[:2], wh
    if (w_new > w) == (h_new > h):
        return _resize(image, wh)
    return _resize(_resize(image, (w_new, h)), wh)


def _resize(image: Image, wh: tuple[int, int]) -> Image:
    h, w = image.shape[:2]
    shrinks = wh[0] <= w and wh[1] <= h
    resized: Image = cv2.resize(
        image, wh, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return resized


def sized(pair: Pair, sizing: Sizing) -> Prepared:
    """The pair as it stands, at the network's size and at ``METRIC_WH``, of the same window."""
    window = cropped(pair, sizing.box(pair.wh))
    return Prepared(resized(window, sizing.input_wh), resized(window, METRIC_WH))
