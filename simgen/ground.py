"""The ground: road, pavement and land, coloured by ortho maps seen from above.

The ground ahead of the rig is cut into bands of growing distance. Each band has a map of its own,
whose texel is about as wide as a pixel there, so that near ground is sharp and far ground does not
alias. Everything lies in world coordinates: nothing repeats, and the next frame of a drive sees
the same road.

A map is painted in layers: land, verge, asphalt, pavement, kerb, paint; each with its own noise.
Where it is wet, water comes last: it darkens the map, and a second map says how smooth it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simgen.color import srgb_from_linear
from simgen.geometry import Array
from simgen.markings import Paint, median_outlines
from simgen.mesh import Part, cross, part
from simgen.noise import fractal
from simgen.recipe import SceneSpec, SkySpec
from simgen.roads import Lane, Network, Surface, at_station, points_at, stations, strip
from simgen.scene import GroundRing
from simgen.schema import LABELS
from simgen.site import Site, rings
from simgen.wetness import FILM_FROM, Water, darkening, roughness, settle

NUM_BANDS = 8
"""The last one is everything that is left: behind, beside, and far away."""
BAND_RATIO = 2.0
MAX_TEXELS = 3072
REST_HALF_M = 420.0

_SEMANTIC = {"road": LABELS["road"], "sidewalk": LABELS["sidewalk"], "terrain": LABELS["terrain"]}

Image = NDArray[Any]
"""float32"""


@dataclass(frozen=True)
class Optics:
    """What decides how fine the ground must be."""

    focal_px: float
    hfov_rad: float
    nearest_m: float
    """distance of the nearest ground in any image"""


@dataclass(frozen=True, eq=False)
class Band:
    """A rectangle of ground in the frame of the rig, and the raster of its map."""

    low: Array
    """(2,) [m] in the rig frame: x forward, y left"""
    high: Array
    shape: tuple[int, int]
    """rows run away from the rig, columns from left to right"""
    A: Array
    """(2, 3): (column, row, 1) of a texel centre to world xy"""

    def texels(self, xy: Array) -> Array:
        """World points (N, 2) as (column, row), texel centres at integers."""
        return (xy - self.A[:, 2]) @ np.linalg.inv(self.A[:, :2]).T


@dataclass(frozen=True, eq=False)
class Layers:
    """Outlines on the ground, world xy."""

    asphalt: list[Array]
    asphalt_color: tuple[float, float, float]
    """linear, of mean 1"""
    pavement: list[Array]
    median: list[Array]
    paint: list[Paint]
    tracks: list[Array]
    """wheel tracks (N, 2)"""
    seams: list[Array]
    """cracks and joints (N, 2)"""
    patches: list[Array]
    """repaired asphalt (N, 2)"""
    covers: Array
    """(M, 3): x, y, radius of manhole covers"""
    stains: Array
    """(M, 3): x, y, radius of oil stains"""


def bands(T_world_rig: Array, optics: Optics) -> list[Band]:
    """The bands for a rig standing at ``T_world_rig`` (4, 4)."""
    edges = 0.85 * optics.nearest_m * BAND_RATIO ** np.arange(NUM_BANDS)
    spread = np.tan(optics.hfov_rad / 2 + 0.05)
    boxes = []
    for near, far in pairwise(edges):
        half = far * spread + 2.0
        across = 2 * half / (2.0 * near / optics.focal_px)
        along = (far - near) / (4.0 * near / optics.focal_px)
        boxes.append((np.array([near, -half]), np.array([far, half]), (along, across)))
    rest = 1.2 * REST_HALF_M
    boxes.append((np.array([-REST_HALF_M + 150.0, -REST_HALF_M]),
                  np.array([REST_HALF_M + 150.0, REST_HALF_M]), (rest, rest)))  # fmt: skip
    return [_band(T_world_rig, low, high, texels) for low, high, texels in boxes]


def _band(T_world_rig: Array, low: Array, high: Array, texels: tuple[float, float]) -> Band:
    h, w = (int(np.clip(n, 64, MAX_TEXELS)) for n in texels)
    du, dv = -(high[1] - low[1]) / w, (high[0] - low[0]) / h
    heading = np.arctan2(T_world_rig[1, 0], T_world_rig[0, 0])
    R = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    to_rig = np.array([[0.0, dv, low[0] + dv / 2], [du, 0.0, high[1] + du / 2]])
    A = R @ to_rig
    A[:, 2] += T_world_rig[:2, 3]
    return Band(low, high, (h, w), A)


def build(
    site: Site,
    spec: SceneSpec,
    paints: Sequence[Paint],
    T_world_rig: Array,
    optics: Optics,
    *,
    far_low: Array,
    far_high: Array,
) -> list[GroundRing]:
    """Meshes and maps of all bands.

    Terrain outside the world box [``far_low``, ``far_high``] (2,) is cut off: the background
    begins there.
    """
    layers = _layers(site, spec, paints)
    all_bands = bands(T_world_rig, optics)
    pieces = _cut(site.network, all_bands, T_world_rig, far_low, far_high)
    seed = int(spec.stream("ground").integers(1 << 31))
    with ThreadPoolExecutor(max_workers=2) as pool:
        maps = list(pool.map(lambda band: _paint(band, layers, spec, seed), all_bands))
    return [
        GroundRing(_textured(surfaces, band), *images)
        for surfaces, band, images in zip(pieces, all_bands, maps, strict=True)
    ]


def _textured(surfaces: dict[str, Surface], band: Band) -> list[Part]:
    h, w = band.shape
    return [
        part(s.vertices, s.faces, "ground", _SEMANTIC[name],
             uv=(band.texels(s.vertices[:, :2]) + 0.5) / [w, h])
        for name, s in surfaces.items() if len(s.faces)
    ]  # fmt: skip


# --- cutting the meshes --------------------------------------------------------------------------


def _cut(
    network: Network, all_bands: Sequence[Band], T_world_rig: Array, far_low: Array, far_high: Array
) -> list[dict[str, Surface]]:
    """Each band's share of every surface, in world coordinates."""
    pieces: list[dict[str, Surface]] = [{} for _ in all_bands]
    R = all_bands[0].A[:, :2] / np.linalg.norm(all_bands[0].A[:, :2], axis=0)
    forward, left = R[:, 1], -R[:, 0]
    for name, surface in network.surfaces.items():
        rest = [surface]
        if name == "terrain":
            slabs = [(np.eye(2)[k], far_low[k], far_high[k]) for k in (0, 1)]
            rest = [clipped(surface, slabs)]
        for piece, band in zip(pieces[:-1], all_bands[:-1], strict=True):
            origin = T_world_rig[:2, 3]
            limits = [
                (axis, band.low[k] + axis @ origin, band.high[k] + axis @ origin)
                for k, axis in enumerate((forward, left))
            ]
            inside, outside = _taken(rest, limits)
            piece[name], rest = _joined(inside), [_joined(outside)]
        pieces[-1][name] = rest[0]
    return pieces


Limits = list[tuple[Array, float, float]]
"""(horizontal axis (2,), low, high): the slab low <= axis · xy < high"""


def clipped(surface: Surface, limits: Limits) -> Surface:
    """The part of a surface inside all slabs."""
    return _joined(_taken([surface], limits)[0])


def _taken(surfaces: list[Surface], limits: Limits) -> tuple[list[Surface], list[Surface]]:
    """(what lies inside all slabs, the rest)."""
    inside, rest = surfaces, []
    for axis, low, high in limits:
        for bound, keep_above in ((low, True), (high, False)):
            halves = [split(s, axis, bound) for s in inside]
            inside = [h[keep_above] for h in halves]
            rest += [h[not keep_above] for h in halves]
    return inside, rest


def split(surface: Surface, axis: Array, bound: float) -> tuple[Surface, Surface]:
    """(below, above) the vertical plane axis · xy = bound; triangles across it are cut."""
    v, f = surface.vertices, surface.faces
    d = v[:, :2] @ axis - bound
    above = d[f] >= 0
    num_above = above.sum(axis=1)
    lone_above, lone_below = f[num_above == 1], f[num_above == 2]
    cuts = []
    for crossing, lone in ((lone_above, above[num_above == 1]),
                           (lone_below, ~above[num_above == 2])):  # fmt: skip
        first = np.argmax(lone, axis=1)
        cuts.append(np.take_along_axis(crossing, (first[:, None] + [0, 1, 2]) % 3, axis=1))
    tri = np.concatenate(cuts)  # the lone corner first
    a, b, c = tri.T
    p = v[a] + (v[b] - v[a]) * (d[a] / (d[a] - d[b]))[:, None]
    q = v[a] + (v[c] - v[a]) * (d[a] / (d[a] - d[c]))[:, None]
    n, m = len(v), len(tri)
    ip, iq = n + np.arange(m), n + m + np.arange(m)
    tip = np.stack([a, ip, iq], axis=1)
    base = np.concatenate([np.stack([ip, b, c], axis=1), np.stack([ip, c, iq], axis=1)])
    is_above = np.arange(m) < len(lone_above)
    vertices = np.concatenate([v, p, q])
    return (
        _surface(vertices, [f[num_above == 0], tip[~is_above], base[np.tile(is_above, 2)]]),
        _surface(vertices, [f[num_above == 3], tip[is_above], base[np.tile(~is_above, 2)]]),
    )


def _surface(vertices: Array, faces: list[NDArray[np.int64]]) -> Surface:
    """Only the vertices in use, without faces that have no area."""
    f = np.concatenate(faces)
    a, b, c = (vertices[corner] for corner in f.T)
    area = np.linalg.norm(cross(b - a, c - a), axis=1)
    used, index = np.unique(f[area > 1e-9], return_inverse=True)
    return Surface(vertices[used], index.reshape(-1, 3))


def _joined(surfaces: Sequence[Surface]) -> Surface:
    offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    return Surface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + o for s, o in zip(surfaces, offsets, strict=True)]),
    )


# --- what lies on the ground ---------------------------------------------------------------------


def _layers(site: Site, spec: SceneSpec, paints: Sequence[Paint]) -> Layers:
    network = site.network
    rng = spec.stream("asphalt")
    lanes = [lane for lane in network.lanes if lane.kind in ("driving", "parking")]
    driving = [lane for lane in lanes if lane.kind == "driving"]
    wear = spec.road.wear
    seams = [s for lane in driving for s in _seams(lane.centre, lane.width, wear, rng)]
    pavements = [lane for lane in network.lanes if lane.kind == "sidewalk"]
    return Layers(
        asphalt=rings(site.asphalt),
        asphalt_color=_asphalt_color(wear, rng=spec.stream("stone")),
        pavement=rings(site.pavement),
        median=median_outlines(network),
        paint=list(paints),
        tracks=[strip(lane.offset(side), 0.28, -0.28)[:, :2]
                for lane in driving for side in (0.8, -0.8)],
        seams=seams + [s for lane in pavements for s in _slab_joints(lane.centre, lane.width)],
        patches=[p for lane in lanes for p in _patches(lane.centre, lane.width, wear, rng)],
        covers=_scattered(driving, 0.012, (0.28, 0.36), rng),
        stains=_scattered(lanes, 0.04 + 0.08 * wear, (0.05, 0.45), rng),
    )  # fmt: skip


def _asphalt_color(wear: float, *, rng: np.random.Generator) -> tuple[float, float, float]:
    """Bitumen is black; as it wears off, the colour of the stones shows, more or less brown.

    Source: Herold and Roberts, Spectral characteristics of asphalt road aging and deterioration
    (Applied Optics, 2005): reflectance rises with age, and towards red.
    """
    brown = (0.3 + 0.7 * wear) * rng.uniform(0.3, 1.0)
    return 1 + 0.13 * brown, 1.0, 1 - 0.24 * brown


def _seams(line: Array, width: float, wear: float, rng: np.random.Generator) -> list[Array]:
    """Cracks as thin wandering bands; a joint between lanes is one of them."""
    length = stations(line)[-1]
    cracks = []
    for s in np.sort(rng.uniform(0, length, rng.poisson(length * 0.05 * wear**2 + 0.2))):
        along = rng.random() < 0.4
        num, step = int(rng.integers(6, 26)), float(rng.uniform(0.15, 0.4))
        heading = float(at_station(line, s)[1]) + (0.0 if along else np.pi / 2)
        turn = np.cumsum(rng.normal(0, 0.25, num)) + heading
        walk = np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1) * step, axis=0)
        start = points_at(line, s)[:2] + rng.uniform(-0.4, 0.4, 2) * width
        cracks.append(_thin(walk + start, float(rng.uniform(0.006, 0.022))))
    return cracks


def _slab_joints(line: Array, width: float) -> list[Array]:
    """Joints across a pavement every 0.8 m, and one along it."""
    points, headings = at_station(line, np.arange(0.4, stations(line)[-1], 0.8))
    along = np.stack([np.cos(headings), np.sin(headings)], axis=1)[:, None]
    across = along[..., ::-1] * [-1, 1]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [0.006, width / 2]
    joints = points[:, None, :2] + corners[:, :1] * along + corners[:, 1:] * across
    return [_thin(line[:, :2], 0.012), *joints]


def _thin(line: Array, width: float) -> Array:
    flat = np.column_stack([line, np.zeros(len(line))])
    return strip(flat, width / 2, -width / 2)[:, :2]


def _patches(line: Array, width: float, wear: float, rng: np.random.Generator) -> list[Array]:
    """Rectangles of newer asphalt: trenches along or across the lane."""
    length = stations(line)[-1]
    out = []
    for s in rng.uniform(4, max(5, length - 4), rng.poisson(length * 0.012 * (0.3 + wear))):
        long_m, wide_m = float(rng.uniform(0.8, 12.0)), float(rng.uniform(0.5, 0.9 * width))
        sub = points_at(line, np.linspace(s, min(length, s + long_m), 6))
        middle = float(rng.uniform(-0.5, 0.5)) * (width - wide_m)
        out.append(strip(sub, middle + wide_m / 2, middle - wide_m / 2)[:, :2])
    return out


def _scattered(
    lanes: Sequence[Lane], per_m: float, radius: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Discs (M, 3) as (x, y, radius) strewn over lanes."""
    discs = [np.zeros((0, 3))]
    for lane in lanes:
        length = stations(lane.centre)[-1]
        num = rng.poisson(per_m * length)
        points = points_at(lane.centre, rng.uniform(0, length, num))[:, :2]
        points += rng.uniform(-0.45, 0.45, (num, 2)) * lane.width
        discs.append(np.column_stack([points, rng.uniform(*radius, num)]))
    return np.concatenate(discs)


# --- painting a map ------------------------------------------------------------------------------

# Linear colours; a map is a grey tone of full resolution times a colour of half resolution.
_GRASS = np.array([0.060, 0.092, 0.026], np.float32)
_DRY = np.array([0.150, 0.135, 0.060], np.float32)
_SOIL = np.array([0.120, 0.088, 0.058], np.float32)
_GRAVEL, _SLAB, _KERB = (0.170, 0.155, 0.130), (0.245, 0.225, 0.190), (0.310, 0.290, 0.252)
_AGGREGATE_M = 0.009
"""diameter of the stones in asphalt and concrete"""


Maps = tuple[NDArray[np.uint8], NDArray[np.uint8] | None]
"""((H, W, 3) sRGB, (H/2, W/2) roughness where the ground shines)"""


def _paint(band: Band, layers: Layers, spec: SceneSpec, seed: int) -> Maps:
    """The maps of one band."""
    canvas = _Canvas(band, seed)
    wear = spec.road.wear
    road, pavement = canvas.mask(layers.asphalt), canvas.mask(layers.pavement)
    median = canvas.mask(layers.median)
    shoulder = np.clip(1.6 * canvas.blurred(np.maximum(road, pavement), 0.5), 0, 1) * 0.8
    kerb = pavement - _eroded(pavement, canvas.sigma(0.14))
    tracks = canvas.blurred(canvas.mask(layers.tracks), 0.16)

    tone, color = canvas.land()
    gravel = canvas.gravel()
    for share, (layer_tone, layer_color) in (
        (shoulder, gravel),
        (road, canvas.asphalt(layers, tracks, wear)),
        (median * 0.9, gravel),
        (pavement, canvas.slabs()),
        (kerb, (1 + 0.12 * canvas.grain, _KERB)),
    ):
        if not share.any():
            continue
        tone += (layer_tone - tone) * share
        color += (np.asarray(layer_color, np.float32) - color) * _half(share)[..., None]
    tone *= 1 - 0.6 * np.maximum(road, pavement) * canvas.mask(layers.seams, thin=0.01)
    canvas.cover(tone, color, layers.covers)
    canvas.draw_lines(tone, color, layers.paint, wear)
    gloss = None
    if spec.sky.wetness > 0:
        water = canvas.water(tracks, road * canvas.blurred(kerb, 0.3), spec.sky.wetness)
        color *= darkening(color * _half(tone)[..., None], water)
        gloss = _gloss(canvas, water, np.maximum(road, pavement), spec.sky)
    return _encoded(tone, color), gloss


def _gloss(canvas: _Canvas, water: Water, paved: Image, sky: SkySpec) -> NDArray[np.uint8] | None:
    if sky.wetness < FILM_FROM:
        return None
    return roughness(
        water, _half(paved), _half(canvas.middle), wetness=sky.wetness, rain_mm_h=sky.rain_mm_h
    )


def _half(image: Image) -> Image:
    h, w = image.shape[:2]
    return cv2.resize(image, (w // 2, h // 2), interpolation=cv2.INTER_AREA)


_ENCODE = np.round(srgb_from_linear(np.arange(4096) / 4095) * 255).astype(np.uint8)


def _encoded(tone: Image, color: Image) -> NDArray[np.uint8]:
    h, w = tone.shape
    linear = cv2.resize(color, (w, h), interpolation=cv2.INTER_LINEAR)
    linear *= cv2.merge([tone * np.float32(4095)] * 3)
    return np.take(_ENCODE, np.clip(linear, 40, 3500, out=linear).astype(np.uint16))


def _eroded(mask: Image, sigma: tuple[float, float]) -> Image:
    size = tuple(max(1, 2 * round(s) + 1) for s in sigma)
    return np.minimum(mask, cv2.erode(mask, np.ones(size[::-1], np.uint8)))


Layer = tuple[Image, Image | tuple[float, float, float]]
"""(tone (H, W), colour: (H/2, W/2, 3) or one)"""


class _Canvas:
    """One map under work: its raster, its masks, and the noises that all layers share.

    Layers lie beside each other, so one noise can serve them all without being seen twice. Three
    noises are functions of place; ``speckle`` stands for grains that a texel does not resolve.
    """

    def __init__(self, band: Band, seed: int) -> None:
        self.band, self.seed = band, seed
        self.texel = np.linalg.norm(band.A[:, :2], axis=0)  # (across, along) [m]
        self.broad = self._noise(64.0, 6, seed, gain=0.55)
        self.middle = self._noise(1.8, 5, seed + 1, gain=0.65)
        self.grain = self._noise(0.09, 4, seed + 2, gain=0.9)
        bytes_ = np.random.default_rng([seed, *band.shape]).integers(256, size=band.shape,
                                                                     dtype=np.uint8)  # fmt: skip
        self.speckle = (bytes_ - np.float32(127.5)) / np.float32(73.9)
        """white, of variance 1"""

    def _noise(self, wavelength: float, octaves: int, seed: int, gain: float) -> Image:
        return fractal(self.band.shape, wavelength=wavelength, octaves=octaves, gain=gain,
                       seed=seed, A=self.band.A)  # fmt: skip

    def grains(self, diameter_m: float, contrast: float) -> Image:
        """Relative tone (H, W) of loose grains: a texel holds the mean of those that it covers."""
        area = float(self.texel[0] * self.texel[1])
        return self.speckle * np.float32(contrast * min(1.0, diameter_m / area**0.5))

    def sigma(self, metres: float) -> tuple[float, float]:
        """A length in texels (across, along)."""
        return float(metres / self.texel[0]), float(metres / self.texel[1])

    def blurred(self, mask: Image, sigma_m: float) -> Image:
        """Gaussian blur; wide ones on a coarser raster."""
        step = 2 ** int(np.clip(np.log2(max(min(self.sigma(sigma_m)) / 2, 1)), 0, 5))
        h, w = mask.shape
        small = cv2.resize(mask, (-(-w // step), -(-h // step)), interpolation=cv2.INTER_AREA)
        sigma = [max(0.3, s / step) for s in self.sigma(sigma_m)]
        soft = cv2.GaussianBlur(small, (0, 0), sigma[0], sigmaY=sigma[1])
        return cv2.resize(soft, (w, h), interpolation=cv2.INTER_LINEAR)

    def mask(self, rings: Sequence[Array], thin: float | None = None) -> Image:
        """Coverage (H, W) of outlines; a ring inside a ring is a hole.

        With ``thin``, outlines may overlap and are only that wide [m]: where a texel is wider, they
        get a share of it.
        """
        h, w = self.band.shape
        fine = int(np.clip(np.ceil(self.texel[0] / 0.05), 1, 4))
        points = self._visible(rings, fine)
        if not points:
            return np.zeros((h, w), dtype=np.float32)
        raster = np.zeros((h, w * fine), dtype=np.uint8)
        for group in [points] if thin is None else [[p] for p in points]:
            cv2.fillPoly(raster, group, 255, cv2.LINE_AA, shift=4)
        coverage = cv2.resize(raster, (w, h), interpolation=cv2.INTER_AREA) if fine > 1 else raster
        weight = 1.0 if thin is None else min(1.0, thin / (self.texel[0] / fine))
        return coverage * np.float32(weight / 255)

    def _visible(self, rings: Sequence[Array], fine: int) -> list[NDArray[np.int32]]:
        """The rings that touch the band, in 1/16 of texels that are ``fine`` times finer across."""
        if not len(rings):
            return []
        texels = self.band.texels(np.concatenate(rings))
        ends = np.cumsum([len(r) for r in rings])
        starts = ends - [len(r) for r in rings]
        low, high = (of.reduceat(texels, starts) for of in (np.minimum, np.maximum))
        touches = ((low < self.band.shape[::-1]) & (high > 0)).all(axis=1)
        points = np.round((texels + 0.5) * [16 * fine, 16] - 8).astype(np.int32)
        return [points[a:b] for a, b in zip(starts[touches], ends[touches], strict=True)]

    def land(self) -> tuple[Image, Image]:
        """Grass with dry and bare places."""
        tone = 1 + 0.42 * self.middle + 0.3 * self.grain + self.grains(0.03, 0.5)
        tone = np.clip(tone, 0.25, 2.2)
        broad, middle = _half(self.broad), _half(self.middle)
        dryness = np.clip(0.3 + 0.7 * broad + 0.25 * middle, 0, 1)[..., None]
        bare = np.clip(1.5 * (middle - broad) - 0.8, 0, 1)[..., None]
        color = _GRASS + (_DRY - _GRASS) * dryness
        return tone, color + (_SOIL - color) * bare

    def gravel(self) -> Layer:
        tone = 1 + 0.15 * self.middle + 0.3 * self.grain + self.grains(0.02, 0.4)
        return np.clip(tone, 0.3, 1.9), _GRAVEL

    def asphalt(self, layers: Layers, tracks: Image, wear: float) -> Layer:
        tone = 1 + 0.12 * self.broad + 0.07 * self.middle + 0.05 * self.grain
        tone += self.grains(_AGGREGATE_M, 0.32)
        tone *= np.float32(0.10 + 0.06 * wear)
        tone *= 1 + np.float32(0.22 * wear - 0.16) * tracks
        tone *= 1 - 0.32 * self.mask(layers.patches)
        spread = np.clip(0.55 + 0.9 * self.middle + 0.4 * self.grain, 0, 1)
        tone *= 1 - 0.42 * spread * self.blurred(self.mask(_discs(layers.stains)), 0.06)
        return tone, layers.asphalt_color

    def slabs(self) -> Layer:
        tone = 1 + 0.1 * self.broad + 0.06 * self.middle + 0.08 * self.grain
        return tone + self.grains(_AGGREGATE_M, 0.2), _SLAB

    def water(self, tracks: Image, gutters: Image, wetness: float) -> Water:
        """Where water lies, at half the resolution."""
        return settle(
            self._hollows(), _half(tracks), np.minimum(5 * _half(gutters), 1), wetness=wetness
        )

    def _hollows(self) -> Image:
        """Unevenness of the ground, about ±1, at half the resolution.

        Made on a raster that reaches beyond the band: along the rim of a raster, long waves are
        not quite those of its neighbour, and puddles would end there.
        """
        h, w = self.band.shape
        step = np.maximum(2.0, np.round(0.12 / self.texel))
        margin = np.ceil(1.5 / (step * self.texel))
        columns, rows = (np.ceil([w, h] / step) + 2 * margin).astype(int)
        A = self.band.A @ np.vstack([np.column_stack([np.diag(step), -step * margin]), [0, 0, 1]])
        coarse = fractal((rows, columns), wavelength=9.0, octaves=6, gain=0.55,
                         seed=self.seed + 3, A=A)  # fmt: skip
        to_coarse = np.column_stack([np.diag(2 / step), 0.5 / step + margin])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        fine: Image = cv2.warpAffine(coarse, to_coarse, (w // 2, h // 2), flags=flags)
        return fine

    def draw_lines(self, tone: Image, color: Image, paints: Sequence[Paint], wear: float) -> None:
        """Paint, worn away where noise says so."""
        flake = self.middle + 0.5 * self.grain
        kept = np.clip(1.05 - 0.75 * wear - 1.1 * wear * flake, 0.0, 1.0)
        dirt = 1 - (0.12 + 0.2 * wear) * (0.5 + 0.5 * flake)
        for rgb in sorted({p.color for p in paints}):
            share = self.mask([p.outline for p in paints if p.color == rgb], thin=1.0) * kept
            tone += (dirt - tone) * share
            color += (np.array(rgb, np.float32) - color) * _half(share)[..., None]

    def cover(self, tone: Image, color: Image, discs: Array) -> None:
        """Manhole covers: dirt in the hollows of a cast lid, iron where tyres polish its bars."""
        share = self.mask(_discs(discs)) * np.float32(0.95)
        if not share.any():
            return
        raised: Image | np.float32 = np.float32(_LID_SHARE)
        if self.texel.min() < _LID_SEEN_M:
            raised = self.mask([d[:2] + d[2] * ring for d in discs for ring in _LID])
        iron = (0.05 + 0.09 * raised) * (1 + 0.1 * self.grain)
        tone += (iron - tone) * share
        color += (1 - color) * _half(share)[..., None]


def _lid() -> list[Array]:
    """Outlines of what stands out on a lid of radius 1: a frame, a ring, and three rows of bars."""

    def arc(radius: float, start: float, end: float, num: int) -> Array:
        angle = np.linspace(start, end, num)
        return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    rings = [arc(r, 0, 2 * np.pi, 25)[:-1] for r in (0.99, 0.9, 0.18, 0.07)]
    for inner, outer, num in ((0.26, 0.43, 8), (0.48, 0.63, 14), (0.68, 0.83, 20)):
        for start in np.arange(num) * 2 * np.pi / num:
            end = start + np.pi / num
            rings.append(np.concatenate([arc(inner, start, end, 3), arc(outer, end, start, 3)]))
    return rings


_LID = _lid()
_LID_SHARE = 0.45
"""of a lid that stands out"""
_LID_SEEN_M = 0.05
"""Texels from this size on hold several bars."""


def _discs(discs: Array) -> list[Array]:
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return [d[:2] + d[2] * circle for d in discs]
