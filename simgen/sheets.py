"""Surface sheets: seeded images of walls, roofs, bark and turf that repeat without a seam.

A sheet covers a square of ``metres`` × ``metres``. Pixel (i, j) holds u = (j + ½)/N · metres and
v = (i + ½)/N · metres; on a wall v points up, on a roof up the slope, so row 0 is the *bottom*.
Work is done on one colour channel at a time and in sRGB values of 0..255, where tints and noise
look alike on dark and light surfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from inspect import signature

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.color import linear_from_srgb, srgb_from_linear
from simgen.mesh import blocks

Field = NDArray[np.float32]  # (N, N), one value per pixel
Layer = tuple[Field, ArrayLike]  # (N, N) coverage in 0..1, and the sRGB 0..255 that covers

WALL_M = 32.0
"""Side of a wall's sheet."""
BARK_M = 16.0
RISE_M = 3.2
"""The heights of a wall's courses repeat after so much, their blocks do not: whole rises apart, two
places of a sheet continue each other's courses."""

_STEPS = (1 << 16) - 1  # of linear light in 16 bits: half a step is 1/40 of a dark byte's
_LINEAR_OF_BYTE = np.rint(_STEPS * linear_from_srgb(np.arange(256) / 255)).astype(np.uint16)
_BYTE_OF_LINEAR = np.rint(255 * srgb_from_linear(np.arange(_STEPS + 1) / _STEPS)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A surface that continues on the opposite side of each of its borders."""

    image: NDArray[np.uint8]
    """(N, N, 3) sRGB"""
    metres: float
    """length of the side of the square that the image covers"""


def wall_sheet(
    kind: str,
    color: ArrayLike,
    *,
    rng: np.random.Generator,
    size_px: int = 2048,
    metres: float = WALL_M,
) -> Sheet:
    """Draws a wall: "brick", "plaster", "concrete", "stone" or "timber".

    Args:
        kind: a key of ``WALLS``.
        color: (3,) linear RGB albedo of the clean surface.
        size_px: N, a power of two from 64 on.
    """
    if kind not in WALLS:
        raise ValueError(f"wall_sheet: kind {kind!r} is unknown; choose from {sorted(WALLS)}")
    return WALLS[kind](_Canvas(size_px, metres, rng), _bytes(color))


def roof_sheet(*, rng: np.random.Generator, size_px: int = 2048, metres: float = 32.0) -> Sheet:
    """Draws a pitched roof: clay tiles or slates, some moss."""
    return _tiles(_Canvas(size_px, metres, rng), *_ROOFS[rng.integers(len(_ROOFS))])


def bark_sheet(*, rng: np.random.Generator, size_px: int = 2048, metres: float = BARK_M) -> Sheet:
    """Draws bark: plates between furrows that run along v, lichen."""
    canvas = _Canvas(size_px, metres, rng)
    furrow = 1 - np.abs(canvas.noise(wave_m=(0.06, 0.5), octaves=4))
    furrow += 0.4 * (1 - np.abs(canvas.noise(wave_m=(0.02, 0.12), octaves=2)))
    depth = np.clip((furrow - 0.55) / 0.7, 0, 1).astype(np.float32)
    shade = 1 + 0.1 * canvas.noise(0.25) + 0.12 * canvas.grain()
    lichen = 0.6 * canvas.spots(0.35, share=0.15)
    bark = _bytes(rng.uniform((0.09, 0.065, 0.045), (0.17, 0.14, 0.11)))
    return canvas.sheet(bark, shade, [(lichen, (128, 132, 105)), (0.85 * depth, 0.35 * bark)])


def turf_sheet(*, rng: np.random.Generator, size_px: int = 2048, metres: float = 32.0) -> Sheet:
    """Draws rough grass as it lies on a slope: tufts, dry and bare patches."""
    canvas = _Canvas(size_px, metres, rng)
    tufts = canvas.noise((0.35, 0.6), octaves=4)
    shade = 1 + 0.16 * tufts + 0.3 * canvas.grain() + 0.1 * canvas.noise(6.0)
    dry = 0.7 * canvas.spots(5.0, share=0.45, sharpness=0.7)
    straw = 0.6 * canvas.spots((0.4, 0.9), share=0.25, sharpness=0.8)
    bare = 0.8 * canvas.spots((1.2, 0.8), share=0.06)
    grass, hay, soil = (_bytes(c) for c in ((0.055, 0.085, 0.024), (0.15, 0.135, 0.06),
                                            (0.12, 0.088, 0.058)))  # fmt: skip
    return canvas.sheet(grass, shade, [(dry, 0.5 * (grass + hay)), (straw, hay), (bare, soil)])


def blank_like(paint: Callable[..., Sheet]) -> Sheet:
    """Middle grey, as large as what ``paint`` gives, for a surface that a scene does not have.

    Size and scale of a texture are part of the renderer's kernels: others would compile.
    """
    given = {k: p.default for k, p in signature(paint).parameters.items()}
    size_px = given["size_px"]
    return Sheet(np.full((size_px, size_px, 3), 128, np.uint8), given["metres"])


def filtered(sheet: Sheet, factor: int) -> Sheet:
    """The same sheet with ``factor`` times larger pixels: block means of *light*, not of bytes."""
    size = len(sheet.image)
    if factor < 1 or size % factor:
        raise ValueError(f"filtered: factor {factor} does not divide the sheet's {size} pixels")
    linear = cv2.LUT(sheet.image, _LINEAR_OF_BYTE)
    small = cv2.resize(linear, (size // factor,) * 2, interpolation=cv2.INTER_AREA)
    return replace(sheet, image=np.take(_BYTE_OF_LINEAR, small))


def _bytes(linear: ArrayLike) -> NDArray[np.float64]:
    """Linear albedo (…, 3) to sRGB 0..255."""
    return (255 * srgb_from_linear(np.asarray(linear, dtype=np.float64))).astype(np.float64)


class _Canvas:
    """A periodic N × N pixel square: noise fields on it, and the way from fields to a sheet."""

    def __init__(self, size: int, metres: float, rng: np.random.Generator) -> None:
        if size < 64 or size & (size - 1):
            raise ValueError(f"sheet size must be a power of two from 64 on, got {size} px")
        self.size, self.metres, self.rng = size, metres, rng
        self.pixel_m = metres / size

    def grain(self) -> Field:
        """White noise in −1..1, a value per pixel."""
        raw = np.frombuffer(self.rng.bytes(self.size**2), np.uint8).reshape(self.size, self.size)
        return np.asarray(cv2.addWeighted(raw, 2 / 255, raw, 0, -1, dtype=cv2.CV_32F), np.float32)

    def noise(self, wave_m: float | tuple[float, float], octaves: int = 3) -> Field:
        """Smooth noise with unit variance, or so; ``wave_m``: the coarsest lattice, (u, v) [m].

        A few random lattices, each twice as fine and 0.6 times as strong as the one before.
        """
        wave_u, wave_v = (wave_m, wave_m) if isinstance(wave_m, float) else wave_m
        w, h = self._cells(wave_u), self._cells(wave_v)
        field, gain = self.rng.standard_normal((h, w), np.float32), 1.0
        for _ in range(octaves - 1):
            if max(w, h) == self.size:
                break
            w, h, gain = 2 * w, 2 * h, 0.6 * gain
            field = _enlarged(field, (h, w))
            field += gain * self.rng.standard_normal((h, w), np.float32)
        strength = np.sqrt(np.mean(np.square(field)))
        return _enlarged(field / strength, (self.size, self.size))

    def spots(
        self, wave_m: float | tuple[float, float], share: float, sharpness: float = 1.5
    ) -> Field:
        """Areas (0..1) that cover about ``share`` of the square and fade towards their edges."""
        field = self.noise(wave_m, octaves=5)
        level = float(np.quantile(field[::8, ::8], 1 - share))
        field -= level
        field *= sharpness
        return np.clip(field, 0, 1, out=field)

    def strokes(self, count: int, length_m: float, turn_rad: float, width_px: int = 1) -> Field:
        """Wandering lines (0..1), such as cracks."""
        mask = np.zeros((self.size, self.size), np.uint8)
        steps = 24
        heading = self.rng.uniform(0, 2 * np.pi, (count, 1))
        heading = heading + np.cumsum(self.rng.normal(0, turn_rad, (count, steps)), axis=1)
        step_px = length_m / steps / self.pixel_m * self.rng.uniform(0.3, 1, (count, 1))
        x = self.rng.uniform(0, self.size, (count, 1)) + np.cumsum(step_px * np.cos(heading), 1)
        y = self.rng.uniform(0, self.size, (count, 1)) + np.cumsum(step_px * np.sin(heading), 1)
        for shift in np.ndindex(3, 3):
            path = np.stack([x, y], axis=-1) + (np.array(shift) - 1) * self.size
            cv2.polylines(mask, list(np.rint(path * 8).astype(np.int32)), False, 255, width_px,
                          cv2.LINE_AA, shift=3)  # fmt: skip
        return np.float32(1 / 255) * mask.astype(np.float32)

    def sheet(
        self, base: Sequence[Field] | NDArray[np.float64], shade: Field, layers: Sequence[Layer]
    ) -> Sheet:
        """Paints layers over base × shade; ``base`` is three fields or numbers, R, G, B."""
        image = np.empty((self.size, self.size, 3), np.uint8)
        fields = [np.broadcast_to(np.asarray(b, np.float32), shade.shape) for b in base]
        colors = [np.asarray(color, np.float32) for _, color in layers]
        for rows in blocks(self.size, 16):  # strips stay in the cache
            for c in range(3):
                x = shade[rows] * fields[c][rows]
                for (mask, _), color in zip(layers, colors, strict=True):
                    x += mask[rows] * (color[c] - x)
                image[rows, :, c] = cv2.convertScaleAbs(np.maximum(x, 0, out=x))
        return Sheet(image, self.metres)

    def _cells(self, wave_m: float) -> int:
        """The power of two that makes lattice cells about ``wave_m`` wide."""
        cells = 2 ** round(np.log2(self.metres / wave_m))
        return int(np.clip(cells, 4, self.size))


def _enlarged(lattice: Field, hw: tuple[int, int]) -> Field:
    """Interpolates a periodic lattice to ``hw``, integer multiples of its own shape."""
    sy, sx = hw[0] // lattice.shape[0], hw[1] // lattice.shape[1]
    if max(sx, sy) > 8:  # in two steps, since the margin grows with the step
        middle = (lattice.shape[0] * min(sy, 8), lattice.shape[1] * min(sx, 8))
        return _enlarged(_enlarged(lattice, middle), hw)
    margin = cv2.copyMakeBorder(lattice, 2, 2, 2, 2, cv2.BORDER_WRAP)
    wh = (margin.shape[1] * sx, margin.shape[0] * sy)
    fine = np.asarray(cv2.resize(margin, wh, interpolation=cv2.INTER_CUBIC), np.float32)
    return fine[2 * sy : -2 * sy, 2 * sx : -2 * sx]


@dataclass(frozen=True, eq=False)
class _Courses:
    """Rows of blocks: which block a pixel belongs to, and how far its joints are."""

    canvas: _Canvas
    row: NDArray[np.int64]
    """(N,) course of each pixel row"""
    rise: NDArray[np.float32]
    """(N,) height above the bottom of the course [m]"""
    bed: NDArray[np.float32]
    """(N,) distance to the nearest horizontal joint [m]"""
    block: NDArray[np.int64]
    """(courses, N) block of each pixel column, numbered through all courses"""
    perpend: NDArray[np.float32]
    """(courses, N) distance to the nearest upright joint [m]"""
    num_blocks: int

    def joints(self, width_m: float) -> Field:
        """How much of each pixel is joint (0..1), for joints of a given width."""
        half, pixel = width_m / 2, self.canvas.pixel_m
        upright = np.clip(0.5 + (half - self.perpend) / pixel, 0, 1)
        level = np.clip(0.5 + (half - self.bed) / pixel, 0, 1)
        joints = upright[self.row]
        return np.maximum(joints, level[:, None], out=joints)

    def spread(self, per_block: NDArray[np.float32]) -> Field:
        """One value per block (num_blocks,) to the pixels."""
        return per_block[self.block][self.row]

    def tinted(
        self, color: NDArray[np.float64], light: float, hue: float, burnt: float = 0.0
    ) -> list[Field]:
        """Three channels around ``color``, each block with a lightness and a hue of its own.

        A share ``burnt`` of the blocks is much darker.
        """
        rng = self.canvas.rng
        deviation = rng.standard_normal((4, self.num_blocks)).clip(-2, 2)
        lightness = (1 + light * deviation[0]) * np.where(
            rng.random(self.num_blocks) < burnt, 0.65, 1
        )
        channels = color[:, None] * lightness * (1 + hue * deviation[1:])
        return [self.spread(channel) for channel in channels.astype(np.float32)]


def _courses(
    canvas: _Canvas,
    height_m: tuple[float, float],
    width_m: tuple[float, float],
    bond: float | None,
) -> _Courses:
    """Lays blocks of drawn heights and widths; courses are shifted by 0, bond, 0, bond, …

    ``bond`` is a share of the block width; None shifts each course at random.
    """
    rng, n = canvas.rng, canvas.size
    rises = 2 * max(round(canvas.metres / (2 * RISE_M)), 1)  # even, so that bonds close
    per_rise = max(round(2 * canvas.metres / rises / sum(height_m)), 1)
    num_courses = rises * per_rise
    per_course = max(round(2 * canvas.metres / sum(width_m)), 1)
    position = (np.arange(n) + 0.5) * canvas.pixel_m
    heights = np.tile(rng.uniform(*height_m, (1, per_rise)), rises)
    bottom = _partition(heights, canvas.metres)[0]
    row = np.searchsorted(bottom, position, side="right") - 1
    rise = position - bottom[row]
    bed = np.minimum(rise, bottom[row + 1] - position)

    left = _partition(rng.uniform(*width_m, (num_courses, per_course)), canvas.metres)
    if bond is None:
        shift = rng.uniform(0, canvas.metres, num_courses)
    else:
        shift = np.arange(num_courses) % 2 * bond * canvas.metres / per_course
    lane = (np.arange(num_courses) * 2 * canvas.metres)[:, None]  # keeps the courses apart
    at = (position + shift[:, None]) % canvas.metres
    edges = (left + lane).ravel()
    index = np.searchsorted(edges, (at + lane).ravel(), side="right").reshape(at.shape) - 1
    perpend = np.minimum(at + lane - edges[index], edges[index + 1] - at - lane)
    return _Courses(canvas, row, rise.astype(np.float32), bed.astype(np.float32), index,
                    perpend.astype(np.float32), edges.size)  # fmt: skip


def _partition(parts: NDArray[np.float64], total: float) -> NDArray[np.float64]:
    """Edges (R, M + 1) from 0 to ``total`` of rows of parts (R, M), scaled to fill it."""
    edges = np.cumsum(parts, axis=1) * (total / parts.sum(axis=1, keepdims=True))
    return np.concatenate([np.zeros((len(parts), 1)), edges], axis=1)


def _brick(canvas: _Canvas, color: NDArray[np.float64]) -> Sheet:
    rng = canvas.rng
    courses = _courses(canvas, (0.075, 0.075), (0.25, 0.25), bond=0.5)
    base = courses.tinted(color, light=0.13, hue=0.025, burnt=0.05)
    shade = 1 + 0.06 * canvas.noise(3.0, octaves=5) + 0.07 * canvas.grain()
    mortar = rng.uniform(0.75, 1.25) * np.array([150.0, 143, 132])
    soot = rng.uniform(0.2, 0.5) * canvas.spots((4.0, 8.0), share=0.5, sharpness=0.5)
    salt = rng.uniform(0.1, 0.4) * canvas.spots((2.0, 1.0), share=0.15, sharpness=0.6)
    return canvas.sheet(
        base,
        shade,
        [
            (0.85 * courses.joints(0.012), mortar),
            (salt, (205, 200, 192)),
            (soot, 0.35 * color + 8),
        ],
    )


def _plaster(canvas: _Canvas, color: NDArray[np.float64]) -> Sheet:
    rng = canvas.rng
    shade = 1 + 0.025 * canvas.noise(4.0, octaves=6) + 0.05 * canvas.grain()
    shade += 0.015 * canvas.noise(0.12)
    runs = rng.uniform(0.1, 0.3) * canvas.spots((0.5, 4.0), share=0.15)
    damp = rng.uniform(0.1, 0.3) * canvas.spots(4.0, share=0.1)
    repairs = 0.4 * (canvas.spots(5.0, share=0.04) > 0.4).astype(np.float32)
    cracks = 0.45 * canvas.strokes(count=40, length_m=3.0, turn_rad=0.35)
    light = np.minimum(1.12 * color + 6, 235)
    return canvas.sheet(
        color,
        shade,
        [(repairs, light), (runs, 0.72 * color), (damp, 0.7 * color), (cracks, 0.45 * color)],
    )


def _concrete(canvas: _Canvas, color: NDArray[np.float64]) -> Sheet:
    courses = _courses(canvas, (1.6, 1.6), (3.2, 3.2), bond=0.0)
    base = courses.tinted(color, light=0.05, hue=0.008)
    shade = 1 + 0.03 * canvas.noise(1.5, octaves=6) + 0.04 * canvas.grain()
    squared = np.square(courses.perpend - 0.8)[courses.row]  # ties at the quarters of a panel
    squared += np.square(courses.bed - 0.4)[:, None]
    ties = (squared < 0.03**2).astype(np.float32)
    streaks = canvas.spots((0.12, 3.0), share=0.3)
    streaks *= np.exp((courses.rise - 1.6) / 0.5)[:, None]  # they fade down from the joint
    pores = (canvas.grain() > 0.985).astype(np.float32)
    return canvas.sheet(
        base,
        shade,
        [
            (0.35 * canvas.spots((0.4, 6.0), share=0.12), 0.75 * color),
            (0.45 * streaks, 0.6 * color),
            (0.35 * pores, 0.5 * color),
            (0.85 * np.maximum(ties, courses.joints(0.022)), 0.35 * color),
        ],
    )


def _stone(canvas: _Canvas, color: NDArray[np.float64]) -> Sheet:
    courses = _courses(canvas, (0.22, 0.42), (0.4, 1.0), bond=None)
    base = courses.tinted(color, light=0.08, hue=0.008)
    shade = 1 + 0.05 * canvas.noise(0.5, octaves=5) + 0.05 * canvas.grain()
    worn = courses.joints(0.05)
    soot = 0.4 * canvas.spots((2.0, 6.0), share=0.5, sharpness=0.5)
    return canvas.sheet(
        base,
        shade,
        [
            (0.25 * worn, 0.6 * color),
            (0.7 * courses.joints(0.012), 0.55 * color + 20),
            (soot, 0.5 * color),
        ],
    )


def _timber(canvas: _Canvas, color: NDArray[np.float64]) -> Sheet:
    courses = _courses(canvas, (0.16, 0.16), (2.4, 4.8), bond=None)
    base = courses.tinted(color, light=0.045, hue=0.008)
    fibre = canvas.noise((1.0, 0.03), octaves=3)
    shade = 1 + 0.03 * fibre + 0.03 * canvas.noise(4.0, octaves=4) + 0.03 * canvas.grain()
    shade *= (1.06 - 0.6 * courses.rise)[:, None]  # each board leans over the one below
    lap = np.exp(-(0.16 - courses.rise) / 0.012)[:, None]  # its shadow on the board below
    peeling = 0.4 * canvas.spots((2.0, 0.4), share=0.06)
    return canvas.sheet(
        base,
        shade,
        [
            (peeling, 0.7 * color + 25),
            (0.6 * courses.joints(0.006), 0.35 * color),
            (np.broadcast_to(0.75 * lap, fibre.shape), 0.3 * color),
        ],
    )


def _tiles(canvas: _Canvas, color: NDArray[np.float64], width_m: float, roll: float) -> Sheet:
    """Rows of tiles, 0.29 m apart; ``roll`` is the depth of shading across a curved tile."""
    bond = 0.0 if roll else 0.5
    courses = _courses(canvas, (0.29, 0.29), (width_m, width_m), bond)
    base = courses.tinted(color, light=0.1, hue=0.015)
    shade = 1 + 0.05 * canvas.noise(2.0, octaves=6) + 0.06 * canvas.grain()
    across = 1 - roll * (1 - 2 * courses.perpend / width_m) ** 2
    shade *= across[courses.row]
    nose = np.exp(-(0.291 - courses.rise) / 0.025)[:, None]  # shadow below the next row's edge
    moss = canvas.rng.uniform(0.1, 0.6) * canvas.spots(1.0, share=0.15)
    soot = canvas.rng.uniform(0.1, 0.4) * canvas.spots((1.0, 6.0), share=0.5, sharpness=0.5)
    return canvas.sheet(
        base,
        shade,
        [
            (soot, 0.45 * color),
            (moss, (78, 82, 48)),
            (0.65 * courses.joints(0.012), 0.35 * color),
            (np.broadcast_to(0.8 * nose, shade.shape), 0.25 * color),
        ],
    )


WALLS: dict[str, Callable[[_Canvas, NDArray[np.float64]], Sheet]] = {
    "brick": _brick,
    "plaster": _plaster,
    "concrete": _concrete,
    "stone": _stone,
    "timber": _timber,
}
_ROOFS: list[tuple[NDArray[np.float64], float, float]] = [  # sRGB colour, tile width [m], roll
    (_bytes((0.24, 0.09, 0.05)), 0.24, 0.45),  # clay pantiles
    (_bytes((0.17, 0.075, 0.05)), 0.17, 0.0),  # flat clay tiles
    (_bytes((0.075, 0.078, 0.085)), 0.25, 0.0),  # slates
    (_bytes((0.10, 0.095, 0.09)), 0.33, 0.3),  # concrete tiles
]
