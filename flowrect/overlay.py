"""The picture that people judge a rectification by: before and after, on common guide lines.

Left and right stand side by side, as the given calibration rectifies them and as the estimate does;
below, some matches are magnified, the left half of a tile from the left image, the right half from
the right one, cut at the *same* rows. A rectified pair continues across the seam. A pair with a
vertical baseline is shown turned by 90°, so that its epipolar lines are rows, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from flowrect.resize import resized_image
from flowrect.sample import Image
from simgen.geometry import Array

WIDTH, GAP, CAPTION = 1600, 8, 34  # px of the picture
NUM_LINES = 12
NUM_TILES, TILE_PX = 6, 40  # magnified matches; side of a half tile, in rectified pixels
LINE, SEAM, INK = (90, 230, 90), (255, 210, 0), (30, 30, 30)
ROW_TOLERANCE_PX = 3 * TILE_PX  # matches further apart than this are wrong ones


@dataclass(frozen=True, eq=False)
class View:
    """A pair in one rectification."""

    caption: str
    left: Image
    """(H, W, 3)"""
    right: Image
    uv_left: Array
    """(N, 2) [px] of matches; both views have the same N"""
    uv_right: Array

    def upright(self) -> View:
        """The view of a vertical rig turned so that columns become rows."""
        return View(
            self.caption,
            np.rot90(self.left),
            np.rot90(self.right),
            _turned(self.uv_left, self.left.shape[1]),
            _turned(self.uv_right, self.right.shape[1]),
        )


def draw_overlay(title: str, before: View, after: View, *, vertical: bool = False) -> Image:
    """The picture (h, 1600, 3).

    Args:
      title: line of text above everything.
      vertical: the epipolar lines of the views are columns.
    """
    views = [view.upright() if vertical else view for view in (before, after)]
    chosen = choose_matches(*views)
    rows = [_text(title)]
    for view in views:
        rows += [_text(view.caption), _pair_on_lines(view)]
    for view in views if len(chosen) else ():
        rows += [_text(f"magnified: {view.caption}"), _tiles(view, chosen)]
    return np.concatenate(rows)


def choose_matches(before: View, after: View) -> np.ndarray:
    """Indices of up to ``NUM_TILES`` matches, spread out, whose tiles lie inside both views."""
    good = np.all(
        [
            _whole_tile(view.uv_left, view.left) & _whole_tile(view.uv_right, view.right)
            for view in (before, after)
        ],
        axis=0,
    )
    good &= np.abs(after.uv_left - after.uv_right)[:, 1] < ROW_TOLERANCE_PX
    candidates = np.flatnonzero(good)
    chosen: list[int] = []
    distance = np.full(len(candidates), np.inf)
    while len(chosen) < NUM_TILES and len(candidates) and distance.max() > TILE_PX:
        k = int(distance.argmax())  # the candidate furthest from all that are chosen
        chosen.append(int(candidates[k]))
        away = np.linalg.norm(after.uv_left[candidates] - after.uv_left[candidates[k]], axis=1)
        distance = np.minimum(distance, away)
    return np.array(sorted(chosen, key=lambda i: after.uv_left[i, 0]), dtype=int)


def _pair_on_lines(view: View) -> Image:
    h, w = view.left.shape[:2]
    width = (WIDTH - GAP) // 2
    size = width, round(h * width / w)
    halves = [resized_image(np.ascontiguousarray(x), size) for x in (view.left, view.right)]
    row = np.concatenate([halves[0], _gap(size[1]), halves[1]], axis=1)
    for v in np.linspace(0, size[1], NUM_LINES + 1)[1:-1].astype(int):
        row[v] = (0.35 * row[v] + 0.65 * np.array(LINE)).astype(np.uint8)
    return _to_width(row)


def _tiles(view: View, chosen: np.ndarray) -> Image:
    """One row of magnified matches, with a line through the middle of each."""
    side = (WIDTH - (NUM_TILES - 1) * GAP) // NUM_TILES // 2
    parts: list[Image] = []
    for (u_left, v), (u_right, _) in zip(view.uv_left[chosen], view.uv_right[chosen], strict=True):
        halves = [
            cv2.resize(_cut(x, u, v), (side, side), interpolation=cv2.INTER_CUBIC)
            for x, u in ((view.left, u_left), (view.right, u_right))
        ]
        tile = np.concatenate(halves, axis=1)
        tile[side // 2] = LINE
        tile[:, side] = SEAM
        parts += [tile, _gap(side)]
    return _to_width(np.concatenate(parts[:-1], axis=1))


def _cut(image: Image, u: float, v: float) -> Image:
    """The square around a position, to a fraction of a pixel."""
    centre = (float(u), float(v))
    cut: Image = cv2.getRectSubPix(np.ascontiguousarray(image), (TILE_PX, TILE_PX), centre)
    return cut


def _whole_tile(uv: Array, image: Image) -> np.ndarray:
    h, w = image.shape[:2]
    return np.all((uv > TILE_PX / 2) & (uv < np.array([w, h]) - 1 - TILE_PX / 2), axis=1)


def _turned(uv: Array, width: int) -> Array:
    """Positions in ``np.rot90`` of an image of this width."""
    return np.column_stack([uv[:, 1], width - 1 - uv[:, 0]])


def _text(text: str) -> Image:
    strip = Pillow.new("RGB", (WIDTH, CAPTION), "white")
    ImageDraw.Draw(strip).text((8, 6), text, INK, ImageFont.load_default(18))
    return np.asarray(strip)


def _gap(height: int) -> Image:
    return np.full((height, GAP, 3), 255, np.uint8)


def _to_width(row: Image) -> Image:
    return np.pad(row, ((0, 0), (0, WIDTH - row.shape[1]), (0, 0)), constant_values=255)
