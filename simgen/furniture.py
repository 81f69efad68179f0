"""Street furniture that stands on one spot: lamps, signals, signs, shelters; and overhead wires.

A model is in its own frame: +x is where it faces (the reader of a sign, the road below a lamp), z
up, origin on the ground. Equal things along a road are *one* model that is placed many times. What
follows a line is in barriers.py, small things are in pavement.py. ``rects`` are those of the
scene's sign atlas.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from simgen.mesh import Model, Part, loft, merged, part, placed, quads_to_triangles, tube
from simgen.schema import LABELS
from simgen.signs import STANDARDS, Rect, face
from simgen.street_solids import (
    BLACK,
    CONCRETE,
    DARK_GREEN,
    POLE,
    STATIC,
    STEEL,
    UP,
    WHITE,
    WOOD,
    Array,
    assembled,
    bars,
    block,
    moved,
    rod,
    turned,
)  # fmt: skip

LIGHT, SIGN = LABELS["traffic light"], LABELS["traffic sign"]
LAMP_WHITE = (0.75, 0.73, 0.68)
LENSES = {"red": (0.8, 0.04, 0.02), "amber": (0.8, 0.35, 0.02), "green": (0.03, 0.65, 0.3)}
UNLIT = 0.06  # of the colour that a lens has when lit


# --- lamps ---------------------------------------------------------------------------------------


def lamp_heads(model: Sequence[Part]) -> Array:
    """Centres (N, 3) [m] of the street lamps in a model, before or after it is placed."""
    heads = [p.vertices.mean(axis=0) for p in model if p.material == "lamp" and p.semantic == POLE]
    return np.array(heads).reshape(-1, 3)


def _head(x: float, z: float, color: ArrayLike, size: tuple[float, float, float]) -> list[Part]:
    """A flat luminaire, its lit panel below."""
    length, width, depth = size
    shell = np.array([(-0.5, -0.4), (0.3, -0.5), (0.5, -0.3), (0.5, 0.3), (0.3, 0.5), (-0.5, 0.4)])
    low = np.pad(shell * (length, width), ((0, 0), (0, 1))) + np.array([x, 0, z])
    high = low * (1, 0.7, 1) + depth * UP
    y = 0.36 * width
    quad = [(x - 0.3 * length, y), (x + 0.4 * length, y), (x + 0.4 * length, -y),
            (x - 0.3 * length, -y)]  # fmt: skip
    panel = [(*xy, z - 0.004) for xy in quad]
    return [
        part(*loft([low, high]), "metal", POLE, color=color),
        part(panel, [(0, 1, 2), (0, 2, 3)], "lamp", POLE, color=LAMP_WHITE),
    ]


def _foot(radius: float, color: ArrayLike) -> list[Part]:
    """The thicker foot of a mast, with its door."""
    sleeve = turned([(1.3 * radius, -0.1), (1.3 * radius, 1.3), (radius, 1.4)], color, POLE,
                     "metal", 8)  # fmt: skip
    door = block((0.02, radius, 0.4), (1.3 * radius, 0, 0.85), np.asarray(color) * 0.7, POLE)
    return [sleeve, door]


def _curved_lamp(height: float, color: Array) -> list[Part]:
    bend = np.deg2rad(np.linspace(0, 80, 6))
    r = 1.6
    arc = np.stack([r - r * np.cos(bend), 0 * bend, height - r + r * np.sin(bend)], axis=1)
    path = np.concatenate([[(0, 0, -0.1)], arc])
    x, z = arc[-1, 0] + 0.3, arc[-1, 2]
    mast = rod(path, np.linspace(0.085, 0.035, len(path)), color)
    return [mast, *_foot(0.085, color), *_head(x, z, color, (0.75, 0.3, 0.13))]


def _straight_lamp(arms: Sequence[float], height: float, color: Array) -> list[Part]:
    """A mast with an arm to each of ``arms`` (+1 ahead, -1 behind)."""
    parts = [rod([(0, 0, -0.1), (0, 0, height)], (0.09, 0.05), color), *_foot(0.09, color)]
    for side in arms:
        arm = rod([(0, 0, height - 0.12), (1.3 * side, 0, height + 0.1)], 0.03, color, sides=6)
        head = _head(1.6, height + 0.09, color, (0.7, 0.28, 0.08))
        parts += [arm, *placed(head, xyz=(0, 0, 0), heading_rad=0.0 if side > 0 else np.pi)]
    return parts


def _globe_lamp(height: float, color: Array) -> list[Part]:
    """A park lamp: a fluted post and an opal globe under a hat."""
    post = [(0.14, 0.0), (0.14, 0.25), (0.075, 0.35), (0.05, height - 0.6), (0.07, height - 0.55),
            (0.11, height - 0.4)]  # fmt: skip
    polar = np.deg2rad(np.linspace(-65, 75, 6))
    opal = [(0.21 * np.cos(a), height - 0.2 + 0.21 * np.sin(a)) for a in polar]
    hat = [(0.24, height - 0.02), (0.22, height + 0.03), (0.06, height + 0.1)]
    dark = np.array(BLACK)
    return [
        turned(post, dark, POLE, "paint", 10),
        turned(opal, LAMP_WHITE, POLE, "lamp", 8),
        turned(hat, dark, POLE, "paint", 10),
    ]


LAMPS: dict[str, Callable[[float, Array], list[Part]]] = {
    "curved": _curved_lamp,
    "straight": lambda height, color: _straight_lamp([1.0], height, color),
    "double": lambda height, color: _straight_lamp([1.0, -1.0], height, color),
    "globe": _globe_lamp,
}
LAMP_HEIGHT_M = {"curved": (8.0, 10.0), "straight": (6.5, 11.0), "double": (9.0, 12.0),
                 "globe": (3.6, 4.6)}  # fmt: skip


def street_lamp(design: str, *, rng: np.random.Generator) -> Model:
    """A lamp of one of the LAMPS, its arm over +x; its lights are at ``lamp_heads(model)``."""
    if design not in LAMPS:
        raise ValueError(f"street_lamp: unknown design {design!r}; choose from {', '.join(LAMPS)}")
    tones = (STEEL, STEEL, DARK_GREEN, (0.08, 0.085, 0.09))
    color = np.array(tones[rng.integers(len(tones))])
    return assembled(LAMPS[design](float(rng.uniform(*LAMP_HEIGHT_M[design])), color))


# --- signals and signs ---------------------------------------------------------------------------


def _disc(radius: float, center: ArrayLike, color: ArrayLike, semantic: int) -> Part:
    """A lens that faces +x."""
    angle = np.arange(12) * 2 * np.pi / 12
    rim = radius * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    k = np.arange(1, 11)
    fan = np.stack([0 * k, k, k + 1], axis=1)
    return part(rim + np.asarray(center), fan, "lamp", semantic, color=color)


def _signal_head(state: str, center: ArrayLike) -> list[Part]:
    """Three lenses under hoods before a board with a white rim, facing +x."""
    parts = [
        block((0.2, 0.3, 0.98), (0, 0, 0), BLACK, LIGHT, "paint"),
        block((0.02, 0.56, 1.24), (-0.06, 0, 0), BLACK, LIGHT),
        block((0.015, 0.62, 1.3), (-0.065, 0, 0), WHITE, LIGHT),
    ]
    a = np.deg2rad(np.linspace(-30, 210, 9))
    hood = np.stack([0 * a, 0.125 * np.cos(a), 0.125 * np.sin(a)], axis=1)
    for z, (name, color) in zip((0.31, 0.0, -0.31), LENSES.items(), strict=True):
        shown = np.array(color) * (1.0 if name == state else UNLIT)
        parts.append(_disc(0.105, (0.104, 0, z), shown, LIGHT))
        rims = np.stack([np.add(hood, (0.1, 0, z)), np.add(hood * (1, 1, 0.96), (0.3, 0, z))])
        i = np.arange(len(a) - 1)
        quads = np.stack([i, i + 9, i + 10, i + 1], axis=1)
        parts.append(
            part(rims.reshape(-1, 3), quads_to_triangles(quads), "matte", LIGHT, color=BLACK)
        )
    return [moved(p, center) for p in parts]


def traffic_signal(state: str, *, rng: np.random.Generator, reach_m: float = 0.0) -> Model:
    """A signal for drivers who come towards it, on their right.

    Args:
        state: the lit lens, a key of LENSES.
        reach_m: length of the arm that holds a second head over the road, on -y; 0 for none.
    """
    if state not in LENSES:
        raise ValueError(
            f"traffic_signal: unknown state {state!r}; choose from {', '.join(LENSES)}"
        )
    color = np.array((STEEL, (0.06, 0.065, 0.07))[rng.integers(2)])
    height = 3.4 if reach_m == 0 else 6.1
    parts = [rod([(0, 0, -0.1), (0, 0, height)], 0.06 if reach_m == 0 else 0.11, color)]
    parts += [
        *_signal_head(state, (0.24, 0, 2.75)),
        block((0.2, 0.05, 0.6), (0.1, 0, 2.75), color, POLE),
    ]
    if reach_m > 0:
        arm = [(0, 0, 5.75), (0, -0.6 * reach_m, 6.0), (0, -reach_m, 6.0)]
        parts += [
            rod(arm, (0.09, 0.06, 0.05), color),
            *_signal_head(state, (0.2, 0.4 - reach_m, 5.75)),
        ]
    button = block((0.1, 0.12, 0.22), (0, 0.1, 1.05), (0.6, 0.4, 0.03), POLE, "paint")
    return assembled([*parts, button])


def traffic_sign(rects: Mapping[str, Rect], *names: str, rng: np.random.Generator) -> Model:
    """Signs of ``signs.STANDARDS`` above each other on a pole, from the top down."""
    lowest = float(rng.uniform(1.9, 2.3))
    z = lowest
    parts: list[Part] = []
    for name in reversed(names):
        kind = STANDARDS[name]
        sheet = face(rects[name], kind.width_m, kind.height_m, kind.shape)
        parts += [moved(p, (0.06, 0, z + kind.height_m / 2)) for p in sheet]
        z += kind.height_m + 0.05
    pole = rod([(0, 0, -0.1), (0, 0, z + 0.02)], 0.035, np.array(STEEL) * rng.uniform(0.8, 1.1))
    return assembled([pole, *parts])


def street_name_post(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """Name plates of two crossing streets, legible from both sides; one is read from ±x."""
    parts = [rod([(0, 0, -0.1), (0, 0, 2.95)], 0.03, STEEL)]
    chosen = rng.choice([n for n in rects if n.startswith("street_")], 2, replace=False)
    for name, z, turn in zip(chosen, (2.8, 2.52), (0.0, np.pi / 2), strict=True):
        kind = STANDARDS[name]
        sheet = face(rects[name], kind.width_m, kind.height_m)
        plate = [moved(p, (0.022, 0.5, z)) for p in sheet]
        other = [moved(p, (0.022, -0.5, z)) for p in sheet]
        for model, heading in ((plate, turn), (other, turn + np.pi)):
            parts += placed(model, xyz=(0, 0, 0), heading_rad=heading)
    return assembled(parts)


def gantry(rects: Mapping[str, Rect], width_m: float, *, rng: np.random.Generator) -> Model:
    """A lattice girder across ``width_m`` of motorway (along y) with direction boards."""
    half, low, high = width_m / 2, 5.9, 7.1
    zinc = np.array(STEEL) * rng.uniform(0.8, 1.0)
    y = np.linspace(-half, half, max(2, round(width_m / 1.4)) + 1)
    corners = [(x, z) for x in (-0.4, 0.4) for z in (low, high)]
    chords = [rod([(x, -half, z), (x, half, z)], 0.055, zinc, sides=6) for x, z in corners]
    legs = [block((0.5, 0.4, high + 0.3), (0, side * (half + 0.2), high / 2 + 0.05), zinc, POLE,
                 "metal") for side in (-1, 1)]  # fmt: skip
    lattice = [
        part(*bars(a, b, 0.03, 4), "metal", POLE, color=zinc) for a, b in _lattice(y, low, high)
    ]
    return assembled([*chords, *legs, *lattice, *_boards(rects, half, rng)])


def _lattice(y: Array, low: float, high: float) -> list[tuple[Array, Array]]:
    """Zigzag bars in the four sides of a girder along y, as (starts, ends)."""
    up = np.arange(len(y)) % 2
    front = np.stack([0 * y + 0.4, y, np.where(up, high, low)], axis=1)
    back = front * (-1, 1, 1)
    flat = np.stack([np.where(up, 0.4, -0.4), y, 0 * y + low], axis=1)
    top = flat + (high - low) * UP
    return [(zigzag[:-1], zigzag[1:]) for zigzag in (front, back, flat, top)]


def _boards(rects: Mapping[str, Rect], half: float, rng: np.random.Generator) -> list[Part]:
    """Direction boards side by side over the right of the road, as its drivers see it."""
    names = [n for n in rects if n.startswith("board_")]
    num = int(np.clip(2 * half // 5.2, 1, 3))
    parts: list[Part] = []
    for i, name in enumerate(rng.choice(names, num, replace=False)):
        at = (0.5, half - 2.7 - 5.0 * i, 6.75)
        parts += [moved(p, at) for p in face(rects[name], 4.6, 2.3)]
        struts = [block((0.06, 0.08, 2.2), np.add(at, (-0.06, dy, 0)), STEEL, SIGN, "metal")
                  for dy in (-1.5, 1.5)]  # fmt: skip
        parts += struts
    return parts


def _poster(rect: Rect, width: float, height: float, center: ArrayLike) -> list[Part]:
    """An advertisement, which is no traffic sign."""
    sheet = face(rect, width, height)
    return [moved(replace(p, semantic=STATIC), center) for p in sheet]


def _billboards(rects: Mapping[str, Rect], num: int, rng: np.random.Generator) -> list[Rect]:
    """``num`` different advertisements."""
    names = [n for n in rects if n.startswith("billboard_")]
    return [rects[name] for name in rng.choice(names, num, replace=False)]


def billboard(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """A hoarding of 5.6 m × 2.8 m on two posts."""
    z = float(rng.uniform(2.6, 4.5))
    frame = np.array((0.08, 0.085, 0.09))
    (rect,) = _billboards(rects, 1, rng)
    parts = _poster(rect, 5.6, 2.8, (0.2, 0, z))
    for y in (-1.7, 1.7):
        parts.append(
            block((0.18, 0.18, z + 1.3), (0, y, (z + 1.3) / 2 - 0.1), STEEL, POLE, "metal")
        )
    for dz, dy, size in ((1.44, 0, (0.12, 5.84, 0.12)), (-1.44, 0, (0.12, 5.84, 0.12)),
                         (0, 2.86, (0.12, 0.12, 2.8)), (0, -2.86, (0.12, 0.12, 2.8))):  # fmt: skip
        parts.append(block(size, (0.18, dy, z + dz), frame))
    return assembled(parts)


def delineator(*, rng: np.random.Generator) -> Model:
    """The white reflector post of country roads; its reflector faces +x."""
    lean = rng.normal(0, 0.02, 2)
    x, y = np.array([(0.05, -0.06), (0.05, 0.06), (-0.05, 0.0)]).T

    def section(z: float, slant: float = 0.0) -> Array:
        shift = lean * z
        return np.stack([x + shift[0], y + shift[1], z + slant * y], axis=1)

    def piece(low: Array, high: Array, color: ArrayLike) -> Part:
        return part(*loft([low, high]), "paint", POLE, color=color)

    band, rim = section(0.72, 0.6), section(0.92, 0.6)
    body = [
        piece(section(-0.1), band, WHITE),
        piece(band, rim, BLACK),
        piece(rim, section(1.02, 1.0), WHITE),
    ]
    middle = (0.05 + 0.82 * lean[0], 0.82 * lean[1], 0.82)
    eye = block((0.01, 0.045, 0.15), middle, (0.65, 0.6, 0.5), POLE)
    return assembled([*body, eye])


def kilometre_post(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """A small plate with the kilometre on a short post."""
    name = str(rng.choice([n for n in rects if n.startswith("km_")]))
    kind = STANDARDS[name]
    plate = face(rects[name], kind.width_m, kind.height_m)
    post = rod([(0, 0, -0.1), (0, 0, 1.25)], 0.03, STEEL)
    return assembled([post, *(moved(p, (0.055, 0, 1.1)) for p in plate)])


# --- shelters and wires --------------------------------------------------------------------------


def bus_shelter(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """Glass behind and on one side, a poster on the other, a bench; open to +x."""
    frame, pane = np.array((0.05, 0.055, 0.06)), (0.04, 0.055, 0.055)
    posts = [
        block((0.07, 0.07, 2.4), (x, y, 1.2), frame) for x in (-0.7,) for y in np.linspace(-2, 2, 4)
    ]
    posts += [block((0.07, 0.07, 2.4), (0.6, y, 1.2), frame) for y in (-2.0, 2.0)]
    back = [
        block((0.012, 1.2, 1.9), (-0.7, y, 1.25), pane, STATIC, "glass") for y in (-1.33, 0, 1.33)
    ]
    side = block((1.15, 0.012, 1.9), (-0.05, 2.0, 1.25), pane, STATIC, "glass")
    case = block((1.25, 0.14, 1.95), (-0.05, -2.0, 1.2), frame)
    roof = block((1.65, 4.4, 0.1), (0, 0, 2.45), frame * 2)
    seat = [block((0.35, 2.6, 0.05), (-0.42, 0.2, 0.47), WOOD),
            *(block((0.06, 0.06, 0.45), (-0.45, y, 0.23), frame) for y in (-0.9, 1.3))]  # fmt: skip
    parts = [*posts, *back, side, case, roof, *seat]
    for heading, y in ((np.pi / 2, -1.91), (-np.pi / 2, -2.09)):
        for rect, z in zip(_billboards(rects, 3, rng), (0.62, 1.2, 1.78), strict=True):
            poster = _poster(rect, 1.14, 0.57, (0, 0, z))
            parts += placed(poster, xyz=(-0.05, y, 0), heading_rad=heading)
    return assembled(parts)


def advertising_column(rects: Mapping[str, Rect], *, rng: np.random.Generator) -> Model:
    """A round column with two rows of posters, a plinth and a hat."""
    radius, sides = 0.66, 16
    green = np.array(DARK_GREEN) * rng.uniform(0.8, 1.6)
    plinth = turned([(0.72, 0.0), (0.72, 0.35), (0.66, 0.4), (0.66, 2.9)], CONCRETE, sides=sides)
    hat = turned(
        [(0.7, 2.85), (0.78, 2.9), (0.78, 3.05), (0.5, 3.3), (0.12, 3.45)], green, sides=sides
    )
    parts = [plinth, hat]
    places = [(z, start) for z in (0.5, 1.7) for start in (0, sides // 2)]
    for rect, (z, start) in zip(_billboards(rects, 4, rng), places, strict=True):
        parts.append(_wrapped(rect, radius + 0.004, z, 1.1, start, sides))
    return assembled(parts)


def _wrapped(rect: Rect, radius: float, z: float, height: float, start: int, sides: int) -> Part:
    """A poster around one half of a column of ``sides`` facets, from facet ``start`` on."""
    num = sides // 2
    angle = (start + np.arange(num + 1)) * 2 * np.pi / sides
    low = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + z], axis=1)
    u = rect[0] + (rect[2] - rect[0]) * np.linspace(0, 1, num + 1)
    uv = np.concatenate([np.stack([u, 0 * u + v], axis=1) for v in (rect[3], rect[1])])
    i = np.arange(num)
    faces = quads_to_triangles(np.stack([i, i + 1, i + num + 2, i + num + 1], axis=1))
    return part(np.concatenate([low, low + height * UP]), faces, "sign", STATIC, uv=uv)


WIRE_RADIUS_M = 0.01
WIRE_SPOTS = np.array([
    [0.12, -0.85, 8.42], [0.12, 0.85, 8.42], [0.12, -0.55, 7.52], [0.12, 0.55, 7.52],
])  # fmt: skip
"""where wires hang on a utility pole, in its frame [m]"""


SAG = 0.025


def wires(tops: ArrayLike, *, sag: float = SAG) -> Part:
    """A wire through ``tops`` (N, 3), hanging by the share ``sag`` of each span as a catenary."""
    p = np.asarray(tops, dtype=np.float64)
    spans = [_catenary(a, b, sag) for a, b in pairwise(p)]
    tubes = [tube(span, WIRE_RADIUS_M, sides=4, caps=False) for span in spans]
    return merged([part(*t, "metal", POLE, color=BLACK) for t in tubes])


def _catenary(a: Array, b: Array, sag: float) -> Array:
    """13 points from a to b, lowest in the middle of the chord; for small sag c = span² / 8 sag."""
    t = np.linspace(-1, 1, 13)
    k = 4 * sag  # half the span over c
    drop = sag * np.linalg.norm(b - a) * (1 - (np.cosh(k * t) - 1) / (np.cosh(k) - 1))
    return a + (t[:, None] + 1) / 2 * (b - a) - drop[:, None] * UP


def spans(bases: Array) -> Array:
    """(S, 2, 3) lines as low as the lowest wire between poles on ``bases`` (N, 3): the middle, and
    where the outermost wires hang."""
    a, b = bases[:-1], bases[1:]
    length = np.linalg.norm(b - a, axis=1)[:, None]
    low = WIRE_SPOTS[:, 2].min() * UP - SAG * length * UP
    left = np.cross(UP, (b - a) / length) * np.abs(WIRE_SPOTS[:, 1]).max()
    return np.concatenate(
        [np.stack([a, b], axis=1) + (low + k * left)[:, None] for k in (-1, 0, 1)]
    )


def utility_pole(*, rng: np.random.Generator) -> Model:
    """A wooden pole with two cross arms along y and insulators under ``WIRE_SPOTS``."""
    brown = np.array((0.16, 0.11, 0.075)) * rng.uniform(0.7, 1.2)
    parts = [rod([(0, 0, -0.3), (0, 0, 9.0)], (0.15, 0.1), brown, material="matte", sides=10)]
    for width, z in ((1.9, 8.25), (1.3, 7.35)):
        parts.append(block((0.1, width, 0.11), (0.12, 0, z), brown, POLE))
    for spot in WIRE_SPOTS:
        glaze = turned([(0.03, -0.13), (0.05, -0.09), (0.03, -0.05), (0.045, -0.01)],
                        (0.3, 0.14, 0.08), POLE, "paint", 6)  # fmt: skip
        parts.append(moved(glaze, spot))
    return assembled(parts)


def utility_line(bases: ArrayLike, *, rng: np.random.Generator) -> Model:
    """Utility poles on ``bases`` (N, 3), across the line, and the wires between them."""
    points = np.asarray(bases, dtype=np.float64)
    ahead = np.gradient(points, axis=0)
    headings = np.arctan2(ahead[:, 1], ahead[:, 0])
    pole = utility_pole(rng=rng)
    standing = [placed(pole, xyz=p, heading_rad=h) for p, h in zip(points, headings, strict=True)]
    along = np.stack([np.cos(headings), np.sin(headings), 0 * headings], axis=1)
    left = np.cross(UP, along)
    hung = [wires(points + x * along + y * left + z * UP) for x, y, z in WIRE_SPOTS]
    return assembled([p for model in [*standing, hung] for p in model])
