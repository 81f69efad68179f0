"""``simgen show``: one frame as one picture, for a person to judge.

From top to bottom: the images of the rig; depth and labels of the pair's left camera; the pair's
flow and visibility; the pair as rendered, and rectified with its true poses, where a surface must
lie on the same guide line left and right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from simgen import paint
from simgen.errors import UserError
from simgen.geometry import Array, inverse, pixel_grid, rectifying_rotations
from simgen.paint import Rgb
from simgen.schema import AT_INFINITY, GLASS, LABELS, OCCLUDED, OUT_OF_FRAME, VISIBLE
from simgen.shards import Frame

WIDTH_PX = 2000
_DPI = 100
_MARGIN, _GAP, _TITLE, _LEGEND, _HEADER = 28, 18, 30, 44, 92  # px
_NUM_GUIDES = 9
_OUTSIDE = (140, 140, 140)  # what no camera saw, in rectified images
_INK = "#222222"

_Corner = Literal["upper left", "upper right"]


def save_picture(frame: Frame, pair: int, path: Path) -> Path:
    """Draws a frame as a PNG; UserError if the rig has no such pair or the file cannot be written.

    Args:
      pair: row of ``frame.pairs``.
    """
    if not 0 <= pair < len(frame.pairs):
        listed = ", ".join(f"{k}: cameras {a} and {b}" for k, (a, b) in enumerate(frame.pairs))
        raise UserError(f"--pair {pair}: this set has {len(frame.pairs)} pairs ({listed}).")
    figure = _figure(frame, pair)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="png", dpi=_DPI)
    except OSError as error:
        raise UserError(
            f"{path}: cannot write the picture ({error.strerror}). Choose another place with --out."
        ) from error
    return path


# --- rectification -------------------------------------------------------------------------------


def rectifying_homographies(
    K_left: Array, K_right: Array, T_right_left: Array
) -> tuple[Array, Array]:
    """``(H_rect_left, H_rect_right)`` (3, 3): pixels as rendered to rectified pixels.

    Both new cameras have the left camera's K and one orientation (see
    ``geometry.rectifying_rotations``), so a point has the same v in both. Pixel (0, 0) is the
    centre of the top-left pixel, which is also the convention of ``cv2.warpPerspective``.
    """
    R_left, R_right = rectifying_rotations(T_right_left)
    return K_left @ R_left @ np.linalg.inv(K_left), K_left @ R_right @ np.linalg.inv(K_right)


def rectified_pair(frame: Frame, pair: int) -> tuple[Rgb, Rgb]:
    """Both images of a pair, rectified with the true K and poses."""
    left, right = frame.pairs[pair]
    K, T = frame.K, frame.T_world_cam
    homographies = rectifying_homographies(K[left], K[right], inverse(T[right]) @ T[left])
    first, second = (
        _warped(frame.read("image", camera), H)
        for camera, H in zip((left, right), homographies, strict=True)
    )
    return first, second


def _warped(image: Rgb, H: Array) -> Rgb:
    wh = image.shape[1::-1]
    warped = cv2.warpPerspective(image, H, wh, flags=cv2.INTER_CUBIC, borderValue=_OUTSIDE)
    return np.asarray(warped, np.uint8)


def pulled_back(image_right: Rgb, flow: NDArray[np.float32], status: NDArray[np.uint8]) -> Rgb:
    """The right image seen through the flow, on left pixels; grey where it is not visible."""
    uv_right = (pixel_grid(flow.shape[:2]) + flow).astype(np.float32)
    u, v = uv_right[..., 0], uv_right[..., 1]
    seen = cv2.remap(image_right, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    visible = (status & VISIBLE)[..., None] > 0
    return np.where(visible, seen, np.array(_OUTSIDE, np.uint8))


# --- layout --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Row:
    """Images side by side, as wide as the page together."""

    num_columns: int
    legend_px: int = 0

    def height(self, aspect: float) -> float:
        return _TITLE + self.image_wh(aspect)[1] + self.legend_px + _GAP

    def image_wh(self, aspect: float) -> tuple[float, float]:
        inner = WIDTH_PX - 2 * _MARGIN - (self.num_columns - 1) * _GAP
        width = inner / self.num_columns
        return width, width / aspect


class _Page:
    """A figure of rows, filled from the top; positions are in pixels."""

    def __init__(self, rows: Sequence[_Row], aspect: float) -> None:
        self.rows, self.aspect = rows, aspect
        self.height = _HEADER + sum(row.height(aspect) for row in rows) + _MARGIN - _GAP
        self.figure = Figure(figsize=(WIDTH_PX / _DPI, self.height / _DPI), dpi=_DPI)

    def axes(self, x: float, y: float, w: float, h: float) -> Axes:
        """Empty axes; (x, y) is the top-left corner, measured from the top."""
        box = (x / WIDTH_PX, 1 - (y + h) / self.height, w / WIDTH_PX, h / self.height)
        axes = self.figure.add_axes(box)
        axes.set_axis_off()
        return axes

    def text(self, x: float, y: float, text: str, size: float, **style: Any) -> None:
        style = {"color": _INK, "va": "top", **style}
        self.figure.text(x / WIDTH_PX, 1 - y / self.height, text, size=size, **style)

    def image(self, row: int, column: int, image: Rgb, title: str) -> tuple[Axes, Axes]:
        """Places an image; returns its axes, and those of the strip for a legend below it."""
        top = _HEADER + sum(r.height(self.aspect) for r in self.rows[:row])
        w, h = self.rows[row].image_wh(self.aspect)
        x = _MARGIN + column * (w + _GAP)
        self.text(x, top + 6, title, 12, weight="bold")
        axes = self.axes(x, top + _TITLE, w, h)
        axes.imshow(image, aspect="auto", interpolation="antialiased")
        strip = self.axes(x, top + _TITLE + h, w, max(1, self.rows[row].legend_px))
        return axes, strip


def _figure(frame: Frame, pair: int) -> Figure:
    left, right = frame.pairs[pair]
    images = frame.image
    num_cameras, height, width = images.shape[:3]
    rows = (_Row(num_cameras), _Row(3, _LEGEND), _Row(3, _LEGEND), _Row(2), _Row(2))
    page = _Page(rows, width / height)
    _draw_header(page, frame, pair, (width, height))
    for c in range(num_cameras):
        role = {left: ", left of the pair", right: ", right of the pair"}.get(c, "")
        page.image(0, c, images[c], f"Camera {c}{role}")
    _draw_surfaces(page, frame, left)
    _draw_flow(page, frame, pair)
    _draw_pair(page, 3, (images[left], images[right]), "as rendered")
    _draw_pair(page, 4, rectified_pair(frame, pair), "rectified with the true poses")
    return page.figure


def _draw_header(page: _Page, frame: Frame, pair: int, wh: tuple[int, int]) -> None:
    spec, (left, right) = frame.spec, frame.pairs[pair]
    weather = spec["weather"]["name"].replace("_", " ")
    T = frame.T_world_cam
    baseline_m = np.linalg.norm(T[left, :3, 3] - T[right, :3, 3])
    angles = "   ".join(
        f"{c}: ({', '.join(f'{a:+.2f}' for a in frame.perturbation_deg[c])})" for c in range(len(T))
    )
    page.text(_MARGIN, 20, f"Frame {int(frame.frame_index)}, pair {pair}", 19, weight="bold")
    page.text(
        _MARGIN, 56,
        f"{spec['recipe']}, {spec['daylight']['name']}, {weather}    "
        f"sun {spec['daylight']['sun_elevation_deg']:.1f}° high    "
        f"{wh[0]} × {wh[1]} px    baseline {baseline_m:.2f} m    "
        f"drawn rotation x, y, z [°] of camera {angles}", 12,
    )  # fmt: skip


# --- surfaces ------------------------------------------------------------------------------------


def _draw_surfaces(page: _Page, frame: Frame, camera: int) -> None:
    depth = frame.read("depth", camera)
    range_m = _depth_range(depth)
    _, strip = page.image(1, 0, paint.depth_colors(depth, range_m), f"Depth [m], camera {camera}")
    _draw_scale(strip, range_m)
    semantic = frame.read("semantic", camera)
    _, strip = page.image(1, 1, paint.label_colors(semantic), f"Classes, camera {camera}")
    _draw_patches(strip, _largest_labels(semantic), 5)
    instance = frame.read("instance", camera)
    _, strip = page.image(1, 2, paint.instance_colors(instance), f"Instances, camera {camera}")
    num = len(np.unique(instance[instance > 0]))
    _say(strip, f"{num} objects; an object has the same colour in all cameras")


def _depth_range(depth: NDArray[np.float32]) -> tuple[float, float]:
    """The ends of the scale [m]: all but half a percent of the surfaces lie between."""
    known = depth[depth > 0]
    if not known.size:
        return 1.0, 100.0
    low, high = np.percentile(known, (0.5, 99.5))
    return float(low), float(max(high, 1.1 * low))


def _draw_scale(strip: Axes, range_m: tuple[float, float]) -> None:
    scale = strip.inset_axes((0.0, 0.58, 0.84, 0.24))
    bar = ScalarMappable(LogNorm(*range_m), paint.DEPTH_MAP)
    ticks = [t for t in _ONE_TWO_FIVE if range_m[0] <= t <= range_m[1]]
    strip.figure.colorbar(bar, cax=scale, orientation="horizontal", ticks=ticks)
    scale.minorticks_off()
    scale.set_xticks(ticks, [f"{t:g}" for t in ticks], size=10, color=_INK)
    scale.tick_params(length=3, color=_INK)
    _legend(strip, [_patch(paint.SKY_COLOR, "sky")], 1, loc="upper right")


_ONE_TWO_FIVE = [m * 10**e for e in range(5) for m in (1, 2, 5)]


def _largest_labels(semantic: NDArray[np.uint8], num: int = 10) -> list[tuple[Rgb, str]]:
    """Colours and names of the classes with most pixels."""
    counts = np.bincount(semantic.ravel(), minlength=256)
    colors = paint.label_colors(np.arange(256, dtype=np.uint8))
    names = {label: name for name, label in LABELS.items()}
    largest = [i for i in np.argsort(-counts, kind="stable")[:num] if counts[i]]
    return [(colors[i], names.get(int(i), f"id {i}")) for i in largest]


# --- flow ----------------------------------------------------------------------------------------


def _draw_flow(page: _Page, frame: Frame, pair: int) -> None:
    left, right = frame.pairs[pair]
    flow, status = frame.flow(pair), frame.read("flow_status", pair)
    length = np.hypot(flow[..., 0], flow[..., 1])
    rim_px = max(1.0, float(np.percentile(length, 99)))
    title = f"Flow, camera {left} to {right}"
    axes, strip = page.image(2, 0, paint.flow_colors(flow, rim_px), title)
    _draw_wheel(axes, page.aspect)
    _say(strip, f"rim of the wheel: {rim_px:.1f} px;  longer vectors are dark, "
                f"the longest has {length.max():.1f} px")  # fmt: skip
    title = f"Where the pixels of camera {left} are in camera {right}"
    _, strip = page.image(2, 1, paint.status_colors(status), title)
    _draw_patches(strip, _status_legend(status), 3)
    title = f"Camera {right} brought to camera {left} by the flow"
    _, strip = page.image(2, 2, pulled_back(frame.read("image", right), flow, status), title)
    _say(strip, f"must look like camera {left}; grey where the surface is not visible")


def _draw_wheel(axes: Axes, aspect: float) -> None:
    """The colours of all directions, in the top right corner of the flow."""
    span = np.linspace(-1.0, 1.0, 160)
    vectors = np.stack(np.meshgrid(span, span), axis=-1).astype(np.float32)
    inside = np.hypot(vectors[..., 0], vectors[..., 1]) <= 1
    disc = np.dstack([paint.flow_colors(vectors, 1.0), np.where(inside, 255, 0).astype(np.uint8)])
    corner = axes.inset_axes((0.985 - 0.24 / aspect, 0.74, 0.24 / aspect, 0.24))
    corner.imshow(disc)
    corner.set_axis_off()
    corner.plot([80], [80], "+", color=_INK, markersize=5)


def _status_legend(status: NDArray[np.uint8]) -> list[tuple[Any, str]]:
    """Colours and names, in the order of a legend that fills columns of two."""
    entries = (
        (paint.STATUS_COLORS[VISIBLE], "visible", VISIBLE),
        (paint.LIGHTENED, "pale: at infinity", AT_INFINITY),
        (paint.STATUS_COLORS[OCCLUDED], "occluded", OCCLUDED),
        (paint.DARKENED, "dark: glass", GLASS),
        (paint.STATUS_COLORS[OUT_OF_FRAME], "out of frame", OUT_OF_FRAME),
    )
    return [
        (color, f"{name} {100 * np.mean((status & bit) > 0):.0f} %") for color, name, bit in entries
    ]


# --- the pair ------------------------------------------------------------------------------------


def _draw_pair(page: _Page, row: int, images: tuple[Rgb, Rgb], what: str) -> None:
    """Two images with guide lines on the same image rows."""
    for column, (image, side) in enumerate(zip(images, ("Left", "Right"), strict=True)):
        axes, _ = page.image(row, column, image, f"{side} image, {what}")
        for v in np.linspace(-0.5, len(image) - 0.5, _NUM_GUIDES + 2)[1:-1]:
            axes.axhline(v, color="#ff2e88", linewidth=0.9, alpha=0.85)


# --- legends -------------------------------------------------------------------------------------


def _draw_patches(strip: Axes, entries: Sequence[tuple[Any, str]], num_columns: int) -> None:
    patches = [_patch(color, label) for color, label in entries]
    _legend(strip, patches, num_columns, loc="upper left")


def _patch(color: Any, label: str) -> Patch:
    face = tuple(c / 255 for c in color)
    return Patch(facecolor=face, edgecolor="#999999", linewidth=0.5, label=label)


def _legend(strip: Axes, patches: Sequence[Patch], num_columns: int, loc: _Corner) -> None:
    strip.legend(
        handles=patches, loc=loc, ncols=num_columns, frameon=False, fontsize=10,
        labelcolor=_INK, handlelength=1.1, handleheight=1.1, handletextpad=0.4,
        columnspacing=1.4, borderaxespad=0.0, borderpad=0.4, labelspacing=0.3,
    )  # fmt: skip


def _say(strip: Axes, text: str) -> None:
    strip.text(0, 0.86, text, size=10, color=_INK, va="top")
