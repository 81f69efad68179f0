"""The printed surfaces of a scene: one atlas of traffic signs, name plates, boards and posters.

An atlas is an image and the rectangles of its cells, (u0, v0, u1, v1) in [0, 1] with v = 0 at the
top row. ``face`` cuts a cell into the outline of a sign. Each cell is painted on a ``_Plate``,
whose unit is its height: x runs right from 0 to ``aspect``, y runs *down* from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from simgen.mesh import Model, Vertices, loft, part
from simgen.schema import LABELS

Rect = tuple[float, float, float, float]
Color = tuple[int, int, int]  # sRGB
Shape = Literal["rect", "disc", "triangle", "inverted_triangle", "octagon", "diamond"]

SIZE_PX = 2048
OVERSAMPLING = 2
THICKNESS_M = 0.02
BACK = (0.35, 0.35, 0.35)

WHITE: Color = (226, 226, 222)
BLACK: Color = (24, 24, 26)
RED: Color = (172, 26, 32)
BLUE: Color = (14, 72, 148)
GREEN: Color = (8, 92, 62)
YELLOW: Color = (232, 178, 16)
LIMITS = tuple(range(30, 130, 10))


@dataclass(frozen=True, eq=False)
class SignAtlas:
    """All that is printed in a scene."""

    image: NDArray[np.uint8]
    """(2048, 2048, 3) sRGB"""
    rects: dict[str, Rect]
    """name of a cell to (u0, v0, u1, v1)"""


def sign_atlas(*, rng: np.random.Generator) -> SignAtlas:
    """Paints every cell, weathered; texts and layouts are drawn from ``rng``."""
    sheet = Image.new("RGB", (SIZE_PX, SIZE_PX), BLACK)
    rects: dict[str, Rect] = {}
    top = 0
    for (width, height), painters in _shelves(rng):
        columns = SIZE_PX // width
        for i, (name, paint) in enumerate(painters.items()):
            x, y = i % columns * width, top + i // columns * height
            plate = _Plate((width, height))
            paint(plate, rng)
            sheet.paste(plate.reduced(), (x, y))
            rects[name] = _inner(x, y, width, height)
        top += -(-len(painters) // columns) * height
    return SignAtlas(_weathered(np.asarray(sheet), rng), rects)


def face(atlas_rect: Rect, width: float, height: float, shape: Shape = "rect") -> Model:
    """A sheet of ``width`` × ``height`` [m] around the origin that shows the cell towards +x.

    Front and grey back; a disc, octagon or diamond is the one that fits into the rectangle.
    """
    y, z = _OUTLINES[shape].T  # in [-1, 1]², counter-clockwise seen from +x
    front = np.stack([np.zeros_like(y), y * width / 2, z * height / 2], axis=1)
    u0, v0, u1, v1 = atlas_rect
    uv = np.stack([u0 + (u1 - u0) * (1 + y) / 2, v0 + (v1 - v0) * (1 - z) / 2], axis=1)
    back = front - [THICKNESS_M, 0.0, 0.0]
    shell, faces = loft([back, front])
    fan = faces[-(len(y) - 2) :] - len(y)  # the cap at the front
    return [
        part(front, fan, "sign", LABELS["traffic sign"], uv=uv),
        part(shell, faces[: -len(fan)], "metal", LABELS["traffic sign"], color=BACK),
    ]


def _regular(sides: int, start_deg: float, radius: float = 1.0) -> Vertices:
    angle = np.deg2rad(start_deg) + np.arange(sides) * 2 * np.pi / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


_OUTLINES: dict[Shape, Vertices] = {
    "rect": np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
    "disc": _regular(28, 0.0),
    "triangle": np.array([[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]]),
    "inverted_triangle": np.array([[0.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
    "octagon": _regular(8, 22.5, 1 / np.cos(np.pi / 8)),
    "diamond": _regular(4, 0.0),
}


@dataclass(frozen=True)
class Standard:
    """Outline and size of a kind of traffic sign."""

    shape: Shape
    width_m: float
    height_m: float


STANDARDS: dict[str, Standard] = {
    **{f"limit_{v}": Standard("disc", 0.68, 0.68) for v in LIMITS},
    "stop": Standard("octagon", 0.8, 0.8),
    "yield": Standard("inverted_triangle", 0.9, 0.78),
    "no_entry": Standard("disc", 0.68, 0.68),
    "no_parking": Standard("disc", 0.6, 0.6),
    "priority": Standard("diamond", 0.85, 0.85),
    "crossing": Standard("rect", 0.64, 0.64),
    "ahead_only": Standard("disc", 0.6, 0.6),
    "keep_right": Standard("disc", 0.6, 0.6),
    "roundabout": Standard("disc", 0.6, 0.6),
    "curve_left": Standard("triangle", 0.9, 0.78),
    "warning": Standard("triangle", 0.9, 0.78),
    "chevron": Standard("rect", 0.6, 0.6),
    **{f"km_{i}": Standard("rect", 0.3, 0.3) for i in range(4)},
    **{f"street_{i}": Standard("rect", 0.9, 0.225) for i in range(8)},
}
"""the cells that stand on a pole of their own"""


# --- the sheet -----------------------------------------------------------------------------------


def _inner(x: int, y: int, width: int, height: int, margin: int = 2) -> Rect:
    """The cell without the pixels that a bilinear lookup would mix with its neighbours."""
    low, high = (x + margin, y + margin), (x + width - margin, y + height - margin)
    return low[0] / SIZE_PX, low[1] / SIZE_PX, high[0] / SIZE_PX, high[1] / SIZE_PX


def _weathered(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Uneven fading, and streaks of dirt that rain drew down the sheet."""
    fading = rng.uniform(220, 255, (24, 24)).astype(np.uint8)
    streaks = rng.uniform(244, 255, (16, 384)).astype(np.uint8)
    for stain in (fading, streaks):
        gain = cv2.resize(stain, image.shape[:2])
        image = cv2.multiply(image, cv2.merge([gain] * 3), scale=1 / 255)
    return image


class _Plate:
    """A cell to paint on, held enlarged so that edges come out smooth."""

    def __init__(self, wh: tuple[int, int]) -> None:
        self.aspect = wh[0] / wh[1]
        self._unit = wh[1] * OVERSAMPLING
        self._image = Image.new("RGB", (wh[0] * OVERSAMPLING, self._unit))
        self._draw = ImageDraw.Draw(self._image)

    def reduced(self) -> Image.Image:
        """The plate at the size of its cell."""
        return self._image.reduce(OVERSAMPLING)

    def fill(self, color: Color) -> None:
        """One colour all over."""
        self._image.paste(color, (0, 0, *self._image.size))

    def gradient(self, top: Color, bottom: Color) -> None:
        """From one colour at the top to another at the bottom."""
        w, h = self._image.size
        rows = np.linspace(top, bottom, h).astype(np.uint8)
        self._image.paste(Image.fromarray(np.repeat(rows[:, None], w, axis=1)))

    def polygon(self, points: ArrayLike, color: Color) -> None:
        """A filled polygon (N, 2)."""
        self._draw.polygon(self._px(points), fill=color)

    def box(self, x0: float, y0: float, x1: float, y1: float, color: Color, r: float = 0) -> None:
        """A filled rectangle with corners of radius ``r``."""
        self._draw.rounded_rectangle(self._px([[x0, y0], [x1, y1]]), r * self._unit, fill=color)

    def disc(self, x: float, y: float, radius: float, color: Color) -> None:
        """A filled circle."""
        corners = self._px([[x - radius, y - radius], [x + radius, y + radius]])
        self._draw.ellipse(corners, fill=color)

    def line(self, points: ArrayLike, width: float, color: Color) -> None:
        """A polyline with round joints."""
        self._draw.line(self._px(points), fill=color, width=round(width * self._unit),
                        joint="curve")  # fmt: skip

    def arrow(self, points: ArrayLike, width: float, color: Color) -> None:
        """A line with a head at its last point, which is the tip."""
        p = np.asarray(points, dtype=np.float64)
        along = (p[-1] - p[-2]) / np.linalg.norm(p[-1] - p[-2])
        across = np.array([-along[1], along[0]])
        neck = p[-1] - 1.9 * width * along
        self.line([*p[:-1], neck], width, color)
        self.polygon([p[-1], neck + 1.5 * width * across, neck - 1.5 * width * across], color)

    def text(self, string: str, x: float, y: float, height: float, color: Color, *,
             room: float = 99.0, bold: float = 0.02, anchor: str = "mm") -> None:  # fmt: skip
        """A line of text, made smaller where it is wider than ``room``."""
        size = height * self._unit
        size *= min(1.0, room * self._unit / max(_font(round(size)).getlength(string), 1.0))
        self._draw.text((x * self._unit, y * self._unit), string, color, _font(round(size)),
                        anchor=anchor, stroke_width=round(bold * size))  # fmt: skip

    def _px(self, points: ArrayLike) -> list[tuple[float, float]]:
        return [(x, y) for x, y in (np.asarray(points, dtype=np.float64) * self._unit).tolist()]


@lru_cache(maxsize=64)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(size, 6))


_Painter = Callable[[_Plate, np.random.Generator], None]


def _shelves(
    rng: np.random.Generator,
) -> list[tuple[tuple[int, int], dict[str, _Painter]]]:
    """Cell sizes [px] from the top of the sheet down, with what is painted in the cells."""
    ground = YELLOW if rng.random() < 0.2 else WHITE
    roads = GREEN if rng.random() < 0.4 else BLUE
    plates = [(WHITE, BLACK), (BLUE, WHITE), (GREEN, WHITE)][rng.integers(3)]
    shops = [_SHOPS[i] for i in rng.permutation(len(_SHOPS))[:16]]
    slogans = [_SLOGANS[i] for i in rng.permutation(len(_SLOGANS))[:6]]
    return [
        ((204, 204), {
            **{f"limit_{v}": partial(_limit, value=v, ground=ground) for v in LIMITS},
            **_PICTOGRAMS,
            "curve_left": partial(_curve, ground=ground),
            "warning": partial(_warning, ground=ground),
            **{f"km_{i}": partial(_kilometre, ground=roads) for i in range(4)},
        }),
        ((512, 128), {f"street_{i}": partial(_street, colors=plates) for i in range(8)}),
        ((512, 256), {
            **{f"board_{i}": partial(_board, ground=roads) for i in range(6)},
            **{f"billboard_{i}": partial(_billboard, slogan=s) for i, s in enumerate(slogans)},
        }),
        ((512, 103), {f"shop_{i}": partial(_shop, name=s) for i, s in enumerate(shops)}),
    ]  # fmt: skip


# --- traffic signs -------------------------------------------------------------------------------


def _limit(plate: _Plate, rng: np.random.Generator, *, value: int, ground: Color) -> None:
    plate.fill(RED)
    plate.disc(0.5, 0.5, 0.385, ground)
    plate.text(str(value), 0.5, 0.5, 0.5, BLACK, room=0.6, bold=0.03)


def _stop(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(WHITE)
    plate.polygon(_scaled("octagon", 0.94), RED)
    plate.text("STOP", 0.5, 0.5, 0.38, WHITE, room=0.78, bold=0.03)


def _yield(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(RED)
    plate.polygon([(0.17, 0.113), (0.83, 0.113), (0.5, 0.773)], WHITE)


def _no_entry(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(WHITE)
    plate.disc(0.5, 0.5, 0.475, RED)
    plate.box(0.14, 0.42, 0.86, 0.58, WHITE)


def _no_parking(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(RED)
    plate.disc(0.5, 0.5, 0.39, BLUE)
    plate.line([(0.2, 0.2), (0.8, 0.8)], 0.1, RED)


def _priority(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(BLACK)
    plate.polygon(_scaled("diamond", 0.96), WHITE)
    plate.polygon(_scaled("diamond", 0.68), YELLOW)


def _crossing(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(BLUE)
    plate.polygon([(0.5, 0.1), (0.93, 0.88), (0.07, 0.88)], WHITE)
    for x in (0.24, 0.4, 0.56, 0.72):
        plate.box(x - 0.045, 0.76, x + 0.045, 0.84, BLACK)
    plate.disc(0.51, 0.32, 0.05, BLACK)
    plate.line([(0.5, 0.38), (0.49, 0.56)], 0.1, BLACK)
    plate.line([(0.5, 0.55), (0.58, 0.65), (0.6, 0.76)], 0.05, BLACK)
    plate.line([(0.48, 0.55), (0.43, 0.66), (0.34, 0.75)], 0.05, BLACK)
    plate.line([(0.38, 0.53), (0.5, 0.41), (0.61, 0.52)], 0.035, BLACK)


def _ordered(plate: _Plate, rng: np.random.Generator, *, path: Sequence[Sequence[float]]) -> None:
    """A white arrow along ``path`` on a blue disc."""
    plate.fill(WHITE)
    plate.disc(0.5, 0.5, 0.48, BLUE)
    plate.arrow(path, 0.12, WHITE)


def _roundabout(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(WHITE)
    plate.disc(0.5, 0.5, 0.48, BLUE)
    for start in (90, 210, 330):
        angle = np.deg2rad(start - np.linspace(10, 100, 12))  # counter-clockwise, y down
        plate.arrow(0.5 + 0.28 * np.stack([np.cos(angle), np.sin(angle)], axis=1), 0.085, WHITE)


def _chevron(plate: _Plate, rng: np.random.Generator) -> None:
    plate.fill(RED)
    for x in (-0.32, 0.28, 0.88):
        plate.polygon([(x, 0.5), (x + 0.4, 0), (x + 0.7, 0), (x + 0.3, 0.5), (x + 0.7, 1),
                       (x + 0.4, 1)], WHITE)  # fmt: skip


def _danger(plate: _Plate, ground: Color) -> None:
    """The red triangle that the pictogram goes on."""
    plate.fill(RED)
    plate.polygon([(0.5, 0.227), (0.83, 0.887), (0.17, 0.887)], ground)


def _curve(plate: _Plate, rng: np.random.Generator, *, ground: Color) -> None:
    _danger(plate, ground)
    angle = np.deg2rad(np.linspace(0, -55, 10))
    bend = [0.36, 0.72] + 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    plate.arrow([(0.56, 0.85), *bend, (0.37, 0.48)], 0.065, BLACK)


def _warning(plate: _Plate, rng: np.random.Generator, *, ground: Color) -> None:
    _danger(plate, ground)
    plate.polygon([(0.455, 0.42), (0.545, 0.42), (0.52, 0.7), (0.48, 0.7)], BLACK)
    plate.disc(0.5, 0.78, 0.045, BLACK)


def _kilometre(plate: _Plate, rng: np.random.Generator, *, ground: Color) -> None:
    _bordered(plate, ground, WHITE)
    plate.text("km", 0.5, 0.24, 0.24, WHITE)
    plate.text(str(rng.integers(1, 600)), 0.5, 0.62, 0.5, WHITE, room=0.76)


def _scaled(shape: Shape, factor: float) -> NDArray[np.float64]:
    """The outline of a shape on a square plate, made smaller about the middle."""
    return 0.5 + 0.5 * factor * _OUTLINES[shape] * [1, -1]


def _bordered(plate: _Plate, ground: Color, border: Color, inset: float = 0.03) -> None:
    """A rounded field inside a line."""
    plate.fill(ground)
    a, line = plate.aspect, 0.025
    plate.box(inset, inset, a - inset, 1 - inset, border, r=0.08)
    inset += line
    plate.box(inset, inset, a - inset, 1 - inset, ground, r=0.06)


_PICTOGRAMS: dict[str, _Painter] = {
    "stop": _stop,
    "yield": _yield,
    "no_entry": _no_entry,
    "no_parking": _no_parking,
    "priority": _priority,
    "crossing": _crossing,
    "ahead_only": partial(_ordered, path=((0.5, 0.84), (0.5, 0.15))),
    "keep_right": partial(_ordered, path=((0.26, 0.26), (0.75, 0.75))),
    "roundabout": _roundabout,
    "chevron": _chevron,
}


# --- names and boards ----------------------------------------------------------------------------

_STEMS = ("Ash", "Beck", "Cold", "Dun", "Elm", "Fair", "Glen", "Hart", "Kings", "Lang", "Mill",
          "North", "Oak", "Rose", "Stan", "Thorn", "Wal", "West", "Linden", "Marken")  # fmt: skip
_ENDS = ("bridge", "bury", "dale", "field", "ford", "ham", "ley", "mouth", "stead", "ton",
         "wick", "wood", "bach", "heim", "burg")  # fmt: skip
_WAYS = ("Street", "Road", "Lane", "Avenue", "Way", "Square", "Hill", "Gate")


def _place(rng: np.random.Generator) -> str:
    return _STEMS[rng.integers(len(_STEMS))] + _ENDS[rng.integers(len(_ENDS))]


def _street(plate: _Plate, rng: np.random.Generator, *, colors: tuple[Color, Color]) -> None:
    ground, ink = colors
    _bordered(plate, ground, ink)
    name = f"{_place(rng)} {_WAYS[rng.integers(len(_WAYS))]}"
    plate.text(name, plate.aspect / 2, 0.5, 0.52, ink, room=plate.aspect - 0.4)


def _board(plate: _Plate, rng: np.random.Generator, *, ground: Color) -> None:
    """Places with distances or lane arrows, and the number of the road."""
    _bordered(plate, ground, WHITE)
    distances = rng.random() < 0.5
    num = int(rng.integers(2, 4)) if distances else 2
    floor = 0.95 if distances else 0.7
    for i in range(num):
        y = 0.26 + (floor - 0.26) * (i + 0.5) / num
        plate.text(_place(rng), 0.14, y, 0.21, WHITE, room=1.2, anchor="lm")
        if distances:
            km = int(rng.integers(2 + 20 * i, 25 * (i + 1)))
            plate.text(str(km), plate.aspect - 0.14, y, 0.21, WHITE, anchor="rm")
    if not distances:
        for x in np.linspace(0.35, plate.aspect - 0.35, num):
            plate.arrow([(x, 0.74), (x, 0.93)], 0.05, WHITE)
    number = f"{'AEM'[rng.integers(3)]}{rng.integers(1, 99)}"
    plate.box(0.12, 0.09, 0.5, 0.27, RED if rng.random() < 0.5 else YELLOW, r=0.03)
    plate.text(number, 0.31, 0.18, 0.15, WHITE)
    if rng.random() < 0.6:
        plate.text(f"{rng.integers(2, 40) * 100} m", plate.aspect - 0.14, 0.18, 0.14, WHITE,
                   anchor="rm")  # fmt: skip


# --- shops and posters ---------------------------------------------------------------------------

_SHOPS = ("BAKERY", "Cafe Mira", "Pharmacy", "BOOKS & MORE", "Hair Studio", "FLOWERS", "Optik Lund",
          "Pizzeria Roma", "SUPERMARKET", "Shoes", "Bank", "Kiosk", "JEWELLER", "Bike Works",
          "Noodle Bar", "TOYS", "Fashion House", "Butcher & Son", "Hotel Astra", "Dentist",
          "PHONE REPAIR", "Wine Cellar", "Kebab", "Laundry", "ELECTRO", "Garden Cafe")  # fmt: skip
_SLOGANS = (("FRESH", "every morning"), ("DRIVE", "the new one"), ("-50 %", "until Sunday"),
            ("ESCAPE", "flights from 49"), ("COLA", "ice cold"), ("HOME", "move in now"),
            ("5G", "everywhere"), ("LIVE", "city arena, 21 May"), ("TASTE", "the summer"),
            ("SAVE", "on your energy"))  # fmt: skip


def _vivid(rng: np.random.Generator, low: float = 0.2, high: float = 0.85) -> Color:
    """A printable colour: any hue, brightness between the bounds."""
    hue = rng.uniform(0, 2 * np.pi) + np.array([0.0, 2.1, 4.2])
    wave = 0.5 + 0.5 * np.cos(hue)
    rgb = 255 * rng.uniform(low, high) * (1 - rng.uniform(0.4, 0.95) * (1 - wave))
    return _color(rgb)


def _color(rgb: NDArray[np.float64]) -> Color:
    red, green, blue = (int(c) for c in rgb)
    return red, green, blue


def _ink(ground: Color) -> Color:
    """The colour of text that can be read on ``ground``."""
    return WHITE if np.dot(ground, (0.3, 0.59, 0.11)) < 120 else BLACK


def _shop(plate: _Plate, rng: np.random.Generator, *, name: str) -> None:
    ground = WHITE if rng.random() < 0.25 else _vivid(rng)
    plate.fill(ground)
    stripe = _vivid(rng)
    plate.box(0, 0.9, plate.aspect, 1, stripe)
    x = plate.aspect / 2
    if rng.random() < 0.5:
        x += 0.25
        plate.disc(0.55, 0.45, 0.3, stripe)
        plate.text(name[0], 0.55, 0.45, 0.42, _ink(stripe))
    plate.text(name, x, 0.46, rng.uniform(0.5, 0.66), _ink(ground), room=3.2,
               bold=rng.uniform(0.01, 0.06))  # fmt: skip


def _billboard(plate: _Plate, rng: np.random.Generator, *, slogan: tuple[str, str]) -> None:
    """A sky of two colours, overlapping shapes, a product, two lines of text."""
    top, bottom = _vivid(rng), _vivid(rng)
    plate.gradient(top, bottom)
    for _ in range(rng.integers(2, 6)):
        x, y = rng.uniform((0, 0), (plate.aspect, 1))
        plate.disc(x, y, rng.uniform(0.08, 0.4), _vivid(rng))
    slope = rng.uniform(-0.25, 0.25)
    ground = _vivid(rng, 0.1, 0.5)
    plate.polygon([(0, 0.75 - slope), (2, 0.75 + slope), (2, 1), (0, 1)], ground)
    right = rng.random() < 0.5
    _product(plate, 1.6 if right else 0.4, rng)
    x, ink = (0.68 if right else 1.32), _ink(_color(np.mean([top, bottom], axis=0)))
    plate.text(slogan[0], x, 0.35, 0.42, ink, room=1.15, bold=0.035)
    plate.text(slogan[1], x, 0.68, 0.15, ink, room=1.15)
    plate.text(_place(rng).lower() + ".example", x, 0.92, 0.09, _ink(ground), bold=0.0)


def _product(plate: _Plate, x: float, rng: np.random.Generator) -> None:
    """A bottle with a label."""
    body, label = _vivid(rng), _vivid(rng)
    half, top = rng.uniform(0.12, 0.24), rng.uniform(0.2, 0.4)
    plate.box(x - half / 2.5, top - 0.14, x + half / 2.5, 0.6, label, r=0.03)
    plate.box(x - half, top, x + half, 0.92, body, r=0.08)
    plate.box(x - half, top + 0.16, x + half, top + 0.36, label)
    plate.text(_STEMS[rng.integers(len(_STEMS))], x, top + 0.26, 0.13, _ink(label), room=1.8 * half)
    plate.box(x - 0.75 * half, top + 0.04, x - 0.6 * half, 0.86, WHITE, r=0.01)
