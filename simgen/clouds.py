"""A layer of low clouds and a veil of high ones, lit by sun and sky, seen from below.

The low clouds are a height field h(x, y) [km] on a flat base: lumpy tops, level bottoms. Rays
march up through it; at each step the light is what the sun sends through the cloud on its way
(h averaged towards the sun), plus what is left of all light after many scatterings, less where
the cloud is thick: so edges and tops are bright and thick bases are grey.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from simgen.geometry import Array
from simgen.mesh import blocks
from simgen.skymap import COARSE, DOME_HW, Image, dome_directions, enlarged, texel

BASE_KM = 1.2
TOP_KM = (0.9, 1.3)
"""no cloud is higher above the base, if they are single ones and in a closed layer: the field of
single ones is flattened towards it, or their peaks would be tents"""
STEPS = 9
SHARP_BELOW_DEG = 36.0
"""Higher up, where no camera of a rig looks, clouds are made on the coarse dome."""
_TILE = 1024
_TILE_KM = 9.0
_PATCH_KM = 3.0
_HORIZON = 0.035
"""added to the sine of the elevation: the earth bends away, so distances stay finite"""
_DENSITY = 7.0
"""optical depth per km towards the sun, as far as it takes light out of the beam"""
_HAZE_KM = 22.0
"""distance at which air hides two thirds of a cloud"""


@dataclass(frozen=True, eq=False)
class Light:
    """What falls on the clouds."""

    towards_sun: Array
    sun_klx: Array
    """(3,) facing the sun"""
    sky: Array
    """(3,) mean radiance of the clear sky"""


@dataclass(frozen=True, eq=False)
class Clouds:
    """A dome of clouds, to be laid over a clear one."""

    radiance: Image
    """(h, w, 3) of the clouds, times the share of the texel that they hide"""
    clear: Image
    """(h, w) share of what is behind that shows"""

    def over(self, dome: Image) -> Image:
        """The sky with the clouds in front."""
        return dome * self.clear[..., None] + self.radiance

    def share_of_sun(self, towards_sun: Array) -> float:
        """What the clouds leave of the sun's direct light."""
        row, column = texel(towards_sun)
        patch = self.clear[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
        return float(patch.mean()) if patch.size else 1.0


def build(cover: float, light: Light, *, rng: np.random.Generator) -> Clouds:
    """Clouds over a share ``cover`` of the sky; from 0.95 up no gap is left."""
    field = _drawn_field(cover, light.towards_sun, rng=rng)
    upper = _seen(field, dome_directions(COARSE), light)
    first = round(DOME_HW[0] * (1 - SHARP_BELOW_DEG / 90))
    lower = _seen(field, dome_directions()[first:], light)
    radiance, clear = (
        np.concatenate([enlarged(u)[:first], v]) for u, v in zip(upper, lower, strict=True)
    )
    return Clouds(radiance, clear)


def closed(cover: float) -> float:
    """How far a cover is a closed layer: 1 from 0.95 up, 0 below 0.85."""
    return float(np.clip((cover - 0.85) / 0.1, 0, 1))


# --- shape ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Field:
    """Heights of the clouds over the base: they grow with lumps + patches; below 0 is none."""

    lumps: Image
    """(N, N, 2): periodic tile, and its mean over the path that sunlight takes through a cloud"""
    patches: Image
    """(M, M) where clouds gather, less the level below which there are none"""
    solid: float
    """1 for a closed layer"""
    top_km: float
    start_km: Array
    """(2,) of the sheet, above the camera"""
    combed: tuple[float, float]
    """angle [rad] and amount of the veil"""


def _drawn_field(cover: float, towards_sun: Array, *, rng: np.random.Generator) -> _Field:
    lumps = _lumps(rng)
    patches = 0.75 * rng.standard_normal((64, 64), dtype=np.float32)
    solid = closed(cover)
    mixed = lumps[::16, ::16] + cv2.resize(patches, (64, 64), interpolation=cv2.INTER_CUBIC)
    level = np.quantile(mixed, 1 - np.clip(cover, 0.0, 1.0)) - 1.2 * solid
    top_km = float(np.interp(solid, (0, 1), TOP_KM))
    both = np.dstack([lumps, _towards_sun(lumps, towards_sun, top_km)])
    combed = float(rng.uniform(0, np.pi)), float(rng.uniform(-0.6, 0.5))
    return _Field(both, patches - np.float32(level), solid, top_km, rng.uniform(0, 100, 2), combed)


def _lumps(rng: np.random.Generator) -> Image:
    """Heights of cauliflower (N, N) about 0, periodic: coarse waves and ever finer bulges, which
    are round on top and meet in creases."""
    total = np.zeros((_TILE, _TILE), dtype=np.float32)
    for octave, cells in enumerate((8, 16, 32, 64, 128, 256)):
        noise = _periodic(rng.standard_normal((cells, cells), dtype=np.float32))
        total += (noise if octave < 1 else np.abs(noise)) * np.float32(0.58**octave)
    return total - float(total.mean())


def _periodic(lattice: Image) -> Image:
    """A lattice enlarged smoothly to a tile that can be repeated."""
    zoom = _TILE // len(lattice)
    padded = np.pad(lattice, 2, mode="wrap")
    large = cv2.resize(padded, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    tile: Image = large[2 * zoom : -2 * zoom, 2 * zoom : -2 * zoom]
    return tile


def _towards_sun(lumps: Image, towards_sun: Array, top_km: float) -> Image:
    slope = towards_sun[:2] / max(float(towards_sun[2]), 0.35)
    offsets = np.arange(1, 5)[:, None] * 0.1 * top_km * slope * (_TILE / _TILE_KM)
    moved = [np.roll(lumps, (-round(o[1]), -round(o[0])), axis=(0, 1)) for o in offsets]
    mean: Image = np.stack(moved).mean(axis=0)
    return mean


# --- light ---------------------------------------------------------------------------------------


def _seen(field: _Field, d: Image, light: Light) -> tuple[Image, Image]:
    """Radiance and share of what shows behind (see Clouds) along directions (h, w, 3)."""
    lift = d[..., 2] + np.float32(_HORIZON)
    reach = 1 / lift
    per_km = d[..., :2] * reach[..., None]
    base = (field.start_km + BASE_KM * per_km).astype(np.float32)
    raised = _looked_up(
        field.patches, base / np.float32(_PATCH_KM * len(field.patches)), cv2.INTER_CUBIC
    )
    through, sunlit, diffuse = _march(field, raised, base, per_km, reach)
    air = np.exp(-reach * np.float32(BASE_KM / _HAZE_KM))
    if field.solid:  # far away a closed layer is one grey
        diffuse += (1 - air) * np.float32(field.solid) * (diffuse.mean() - diffuse)
    kept = air + (1 - air) * np.float32(field.solid)
    grazing = 1 + field.solid * ((1 + 2 * d[..., 2]) * (9 / 21) - 1)  # CIE overcast
    color = _radiance(light, d, sunlit, diffuse * grazing.astype(np.float32), field.solid)
    hides = (1 - through) * kept
    veil = _veil(field, base) * air * through
    ice = (0.2 * light.sun_klx / np.pi + light.sky).astype(np.float32)
    return color * kept[..., None] + veil[..., None] * ice, (1 - hides) * (1 - veil)


def _looked_up(tile: Image, at: Image, how: int = cv2.INTER_LINEAR) -> Image:
    """A square tile at (h, w, 2) columns and rows, counted in tiles; it repeats for ever."""
    return _sampled(_wrapped(tile), at, how)


_MARGIN = 2


def _wrapped(tile: Image) -> Image:
    """The tile with a margin; OpenCV's own wrapping costs four times as much."""
    return cv2.copyMakeBorder(tile, _MARGIN, _MARGIN, _MARGIN, _MARGIN, cv2.BORDER_WRAP)


def _sampled(wrapped: Image, at: Image, how: int = cv2.INTER_LINEAR) -> Image:
    n = len(wrapped) - 2 * _MARGIN
    inside = (at - np.floor(at)) * np.float32(n) + np.float32(_MARGIN)
    found: Image = cv2.remap(wrapped, inside, None, how)
    return found


def _march(
    field: _Field, raised: Image, base: Image, per_km: Image, reach: Image
) -> tuple[Image, Image, Image]:
    """Through the layer: what gets through, and direct and diffuse light on what does not."""
    marched = np.empty((3, *raised.shape), np.float32)
    wrapped = _wrapped(field.lumps)
    for rows in blocks(len(raised), 32):  # they stay in the cache
        seen = raised[rows], base[rows], per_km[rows], reach[rows]
        marched[:, rows] = _march_rows(wrapped, field, *seen)
    through, sunlit, diffuse = (cv2.blur(x, (4, 4)) for x in marched)
    return through, sunlit, diffuse


def _march_rows(
    wrapped: Image, field: _Field, raised: Image, base: Image, per_km: Image, reach: Image
) -> tuple[Image, Image, Image]:
    """The same for some rows, the first of which is a multiple of 4, before it is smoothed."""
    top_km = field.top_km
    through = np.ones_like(raised)
    sunlit, diffuse = np.zeros_like(raised), np.zeros_like(raised)
    dense = np.minimum(np.float32(22.0 * top_km / STEPS) * reach, 20.0)
    h, w = reach.shape
    first = np.tile(_FIRST, (-(-h // 4), -(-w // 4)))[:h, :w]
    step = np.float32(top_km / STEPS)
    flattened = np.float32((1 - field.solid) / top_km)
    for k in range(STEPS):
        z = (first + np.float32(k)) * step
        at = (base + per_km * z[..., None]) * np.float32(1 / _TILE_KM)
        height = _RISE_KM * (_sampled(wrapped, at) + raised[..., None])
        height /= 1 + flattened * np.maximum(height, 0)
        top = height - z[..., None]
        above = np.maximum(top[..., 1], 0)
        inside = np.clip(top[..., 0], 0, 0.35)
        taken = through * (1 - np.exp(-dense * inside))
        through -= taken
        sunlit += taken * np.exp(-_DENSITY * above)
        diffuse += taken / (1 + np.float32(0.4 * _DENSITY) * np.maximum(above, inside))
    return through, sunlit, diffuse


_FIRST = np.array(
    [[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]], dtype=np.float32
) / np.float32(16)  # fmt: skip
"""Where neighbouring rays take their first step (Bayer's matrix): the mean over any 4×4 of them,
which is what is kept, sees 16 times as many levels."""
_RISE_KM = np.float32(0.312)
"""of height per unit of the field; with twice as much, small clouds are cones"""


def _radiance(light: Light, d: Image, sunlit: Image, diffuse: Image, solid: float) -> Image:
    """Of what _march took out of the rays (h, w, 3)."""
    cos = np.maximum(d @ light.towards_sun.astype(np.float32), 0)
    eighth = np.square(np.square(np.square(cos)))
    narrow = np.square(np.square(np.square(np.square(eighth))))
    phase = 0.5 + 0.8 * eighth + 3.0 * narrow  # droplets scatter forward: bright rims
    level = max(float(light.towards_sun[2]), 0.12)
    scattered = light.sky * 0.9 + (0.55 + 0.25 * level) * level * light.sun_klx / np.pi
    direct = (1 - solid) * light.sun_klx / np.pi
    lit = (sunlit * phase)[..., None] * direct.astype(np.float32)
    return lit + diffuse[..., None] * scattered.astype(np.float32)


def _veil(field: _Field, base: Image) -> Image:
    """Opacity (h, w) of combed-out ice clouds."""
    angle, amount = field.combed
    c, s = np.cos(angle), np.sin(angle)
    comb = np.array([[0.3 * c, 0.3 * s], [-1.5 * s, 1.5 * c]]) / _TILE_KM
    at = base @ comb.T.astype(np.float32)
    at[..., 1] += np.float32(0.03) * np.sin(10 * at[..., 0])
    noise = _looked_up(field.lumps[..., 0], at)
    return np.clip(0.22 * (1 - field.solid) * (noise + np.float32(amount)), 0, 0.5)
