"""What the pages about an evaluation draw alike: colours of methods, pictures of pairs."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from html import escape

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from flowrect.sample import Image
from simgen.charts import SERIES, SIZE, empty

PICTURE_W = 384
GUIDES = 8
"""horizontal lines over an overlay"""
NAME_LENGTH = 28
"""of a method in a legend"""
SOME_CHARTED = (
    "Charts show {} of {} methods: of each matcher, or network, the one with the least error."
)
LEGEND_W, LINE_H = 1.8, 0.175
"""inches of a legend, and of one of its lines"""


def best_of_each(errors: Mapping[str, float]) -> list[str]:
    """Of each matcher, or network, the method with the least error; in their order.

    A network alone and what refines it are two. A chart of some forty methods shows nothing;
    tables have them all.
    """
    best: dict[tuple[str, bool], str] = {}
    for method, error in errors.items():
        head, plus, _ = method.partition("+")
        family = head, bool(plus)
        if family not in best or error < errors[best[family]]:
            best[family] = method
    return [method for method in errors if method in best.values()]


def chart(num_methods: int) -> tuple[Figure, Axes]:
    """An empty one, with room for a legend of so many methods beside it."""
    w, h = SIZE
    return empty((w + LEGEND_W, max(h, 0.5 + LINE_H * num_methods)))


def labels(methods: Sequence[str]) -> dict[str, str]:
    """Names that fit a legend: of long paths their ends, where these differ."""
    ends = {m: m if len(m) <= NAME_LENGTH else "…" + m[1 - NAME_LENGTH :] for m in methods}
    return {m: end if list(ends.values()).count(end) == 1 else m for m, end in ends.items()}


def colours(methods: Collection[str]) -> dict[str, str]:
    """One for each method, no two alike."""
    if len(methods) <= len(SERIES):
        return dict(zip(methods, SERIES, strict=False))
    spread = colormaps["turbo"](np.linspace(0.02, 0.98, len(methods)))
    return {m: to_hex(color) for m, color in zip(methods, spread, strict=True)}


def small(image: Image) -> Image:
    """The image at the width of a page's pictures."""
    h, w = image.shape[:2]
    wh = PICTURE_W, round(h * PICTURE_W / w)
    return np.asarray(cv2.resize(image, wh, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def overlay(left: Image, right: Image) -> Image:
    """Mean of both images, small, with guide lines."""
    mixed = small(np.asarray(cv2.addWeighted(left, 0.5, right, 0.5, 0)))
    for k in range(1, GUIDES):
        y = round(k * len(mixed) / GUIDES)
        cv2.line(mixed, (0, y), (PICTURE_W, y), (255, 220, 60), 1)
    return mixed


def captioned(images: Sequence[Image], caption: str) -> str:
    """HTML of images (h, w, 3) below each other, which it contains."""
    pictures = "".join(
        f'<img src="data:image/jpeg;base64,{_jpeg(image)}" alt="{escape(caption)}">'
        for image in images
    )
    return f"<figure>{pictures}<figcaption>{escape(caption)}</figcaption></figure>"


def one_column_a_method(cells: Mapping[tuple[str, str], str], methods: Sequence[str]) -> str:
    """HTML of cells by pair and method: a row for each pair, as wide as it takes."""
    pairs = dict.fromkeys(pair for pair, _ in cells)
    inner = "".join(cells.get((pair, m), "<div></div>") for pair in pairs for m in methods)
    grid = f'<div class="rows" style="--columns: {len(methods)}">{inner}</div>'
    return f'<div class="scroll">{grid}</div>'


def _jpeg(image: Image) -> str:
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return base64.b64encode(data.tobytes()).decode()
