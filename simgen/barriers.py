"""What follows the road: guard rails, barriers, noise walls and fences.

``path`` (N, 3) are points on the ground [m]; the part is in the frame of the path. Where the sides
differ, the traffic is on the left of the path. Uprights stay upright on a slope.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from simgen.mesh import Faces, Part, Vertices, loft, merged, part, quads_to_triangles
from simgen.schema import LABELS
from simgen.street_solids import (
    BLACK,
    CONCRETE,
    DARK_GREEN,
    STEEL,
    UP,
    WHITE,
    WOOD,
    Array,
    bars,
    block,
)

WALL, FENCE, GUARD_RAIL = LABELS["wall"], LABELS["fence"], LABELS["guard rail"]
POST_SPACING_M = 2.0  # of guard rails


def _stations(path: ArrayLike, spacing_m: float) -> tuple[Array, Array]:
    """Points (K, 3) about ``spacing_m`` apart, equally, and the direction to the left there."""
    p = np.asarray(path, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or len(p) < 2:
        raise ValueError(f"path has shape {p.shape}, expected (N, 3) with N >= 2")
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    at = np.linspace(0.0, s[-1], max(1, round(s[-1] / spacing_m)) + 1)
    points = np.stack([np.interp(at, s, p[:, i]) for i in range(3)], axis=1)
    ahead = np.gradient(points, axis=0)
    left = np.cross(UP, ahead)
    return points, left / np.linalg.norm(left, axis=1, keepdims=True)


def _spans(path: ArrayLike, spacing_m: float) -> tuple[Array, Array]:
    """Between stations: middles (K, 3), and axes (K, 3, 3) with rows chord [m], left and up.

    What is 1 long in x thus fills the span, and on a slope its uprights stay upright.
    """
    points, _ = _stations(path, spacing_m)
    chord = np.diff(points, axis=0)
    left = np.cross(UP, chord)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return (points[1:] + points[:-1]) / 2, np.stack([chord, left, 0 * left + UP], axis=1)


def _upright(left: Array) -> Array:
    """Axes (K, 3, 3) of posts: rows ahead, left, up."""
    return np.stack([np.cross(left, UP), left, 0 * left + UP], axis=1)


def _repeated(
    p: Part, origins: Array, axes: Array, *, rng: np.random.Generator, uneven: float = 0.0
) -> Part:  # fmt: skip
    """Copies of a part in K frames, their albedo varied by the share ``uneven``."""
    vertices = (p.vertices @ axes + origins[:, None]).reshape(-1, 3)
    offsets = np.arange(len(origins)) * len(p.vertices)
    faces = (p.faces[None] + offsets[:, None, None]).reshape(-1, 3)
    shade = 1 + uneven * rng.uniform(-1, 1, (len(origins), 1, 1))
    color = np.asarray(p.color)[None] * shade
    return part(vertices, faces, p.material, p.semantic, color=color.reshape(-1, 3))


def _swept_sheet(points: Array, left: Array, profile: ArrayLike) -> tuple[Vertices, Faces]:
    """An open profile (M, 2) of (left, up) along the points."""
    y, z = np.asarray(profile, dtype=np.float64).T
    vertices = points[:, None] + y[None, :, None] * left[:, None] + z[None, :, None] * UP
    n, m = vertices.shape[:2]
    i, j = np.meshgrid(np.arange(n - 1) * m, np.arange(m - 1), indexing="ij")
    a = (i + j).reshape(-1)
    return vertices.reshape(-1, 3), quads_to_triangles(np.stack([a, a + 1, a + m + 1, a + m], -1))


W_BEAM = ((0.02, 0.44), (0.083, 0.475), (0.083, 0.525), (0.0, 0.575), (0.0, 0.615), (0.083, 0.665),
          (0.083, 0.715), (0.02, 0.75))  # fmt: skip
RAIL_RAMP_M = 6.0


def guard_rail(path: ArrayLike, *, rng: np.random.Generator) -> Part:
    """A steel W-beam on posts, with the traffic on its left; both ends dip into the ground."""
    points, left = _stations(path, POST_SPACING_M)
    s = np.linspace(0, 1, len(points)) * POST_SPACING_M * (len(points) - 1)
    dip = 0.72 * np.clip(1 - np.minimum(s, s[-1] - s) / RAIL_RAMP_M, 0, 1)
    low = points - dip[:, None] * UP
    zinc = np.array(STEEL) * rng.uniform(0.8, 1.05)
    beam = part(*_swept_sheet(low, left, W_BEAM), "metal", GUARD_RAIL, color=zinc)
    post = merged([
        block((0.06, 0.1, 0.8), (0, -0.17, 0.36), zinc, GUARD_RAIL, "metal"),
        block((0.12, 0.12, 0.26), (0, -0.06, 0.595), zinc * 0.85, GUARD_RAIL, "metal"),
    ])  # fmt: skip
    return merged([beam, _repeated(post, low, _upright(left), rng=rng, uneven=0.12)])


NEW_JERSEY = ((0.30, 0.0), (0.30, 0.08), (0.18, 0.33), (0.08, 0.81))


def concrete_barrier(path: ArrayLike, *, rng: np.random.Generator) -> Part:
    """A New Jersey barrier of elements 4 m long, dirty at the bottom."""
    y, z = np.array([*NEW_JERSEY, *((-y, z) for y, z in NEW_JERSEY[::-1])]).T
    sections = [np.stack([0 * y + x, y, z], axis=1) for x in (-0.496, 0.496)]
    vertices, faces = loft(sections)
    dirt = 0.6 + 0.4 * np.clip(vertices[:, 2:] / 0.45, 0, 1)
    element = part(vertices, faces, "matte", WALL, color=np.array(CONCRETE) * dirt)
    core = block((1.0, 0.1, 0.7), (0, 0, 0.35), np.array(CONCRETE) * 0.4, WALL)  # in the joints
    return _repeated(merged([element, core]), *_spans(path, 4.0), rng=rng, uneven=0.12)


def noise_wall(path: ArrayLike, *, rng: np.random.Generator, height_m: float = 3.5) -> Part:
    """Stacked planks of wood, concrete or painted metal between steel posts."""
    tones = ((0.2, 0.13, 0.08), CONCRETE, (0.07, 0.14, 0.09), (0.33, 0.28, 0.2))
    tone = np.array(tones[rng.integers(len(tones))])
    num = round(height_m / 0.5)
    pitch = height_m / num
    middles, axes = _spans(path, 4.0)
    core = block((1.0, 0.06, height_m), (0, 0, height_m / 2), tone * 0.5, WALL)
    planks = [_repeated(core, middles, axes, rng=rng)]
    for i in range(num):
        plank = block((0.97, 0.11, pitch - 0.025), (0, 0, (i + 0.5) * pitch), tone, WALL)
        planks.append(_repeated(plank, middles, axes, rng=rng, uneven=0.14))
    points, left = _stations(path, 4.0)
    post = block(
        (0.2, 0.2, height_m + 0.4), (0, 0, height_m / 2 - 0.1), np.array(STEEL) * 0.6, WALL
    )
    return merged([*planks, _repeated(post, points, _upright(left), rng=rng)])


def hoarding(path: ArrayLike, *, rng: np.random.Generator, height_m: float = 2.3) -> Part:
    """Boards of painted plywood or ribbed sheet around a building site, with a stripe."""
    tones = ((0.5, 0.5, 0.48), (0.06, 0.1, 0.2), (0.3, 0.2, 0.1), (0.08, 0.16, 0.1))
    tone = np.array(tones[rng.integers(len(tones))])
    board = [block((0.99, 0.03, height_m), (0, 0, height_m / 2 - 0.1), tone, FENCE)]
    if rng.random() < 0.5:
        board.append(block((1.0, 0.034, 0.35), (0, 0, 0.65 * height_m), WHITE, FENCE))
    ribs = np.linspace(-0.45, 0.45, 7)
    board += [block((0.03, 0.05, height_m), (x, 0, height_m / 2 - 0.1), tone * 0.9, FENCE)
              for x in ribs]  # fmt: skip
    panels = _repeated(merged(board), *_spans(path, 2.4), rng=rng, uneven=0.12)
    points, left = _stations(path, 2.4)
    post = block((0.08, 0.1, height_m + 0.1), (0, 0, height_m / 2 - 0.1), WOOD, FENCE)
    return merged([panels, _repeated(post, points, _upright(left), rng=rng)])


_Fence = tuple[Part, Part, float]
"""a panel 1 long in x, a post, the spacing of the posts [m]"""


def _picket(rng: np.random.Generator) -> _Fence:
    color = np.array((WHITE, WOOD, (0.3, 0.24, 0.17))[rng.integers(3)]) * rng.uniform(0.75, 1.0)
    tops = np.linspace(-0.44, 0.44, 15)
    pickets = [block((0.04, 0.02, 0.92), (x, 0.035, 0.56), color, FENCE) for x in tops]
    rails = [block((1.0, 0.04, 0.08), (0, 0, z), color, FENCE) for z in (0.3, 0.8)]
    return merged([*pickets, *rails]), block((0.1, 0.1, 1.3), (0, 0, 0.5), color, FENCE), 2.0


def _mesh(rng: np.random.Generator) -> _Fence:
    """Welded wire, 5 cm × 20 cm, on posts."""
    color = (DARK_GREEN, STEEL, (0.06, 0.065, 0.07))[rng.integers(3)]
    x, z = np.linspace(-0.49, 0.49, 50), np.arange(0.06, 1.7, 0.2)
    foot = np.stack([x, 0 * x, 0 * x + 0.05], axis=1)
    start, end = (np.stack([0 * z + x_end, 0 * z, z], axis=1) for x_end in (-0.5, 0.5))
    rods = bars(foot, foot + 1.65 * UP, 0.003), bars(start, end, 0.004)
    wires = [part(*mesh, "metal", FENCE, color=color) for mesh in rods]
    return merged(wires), block((0.05, 0.06, 2.1), (0, 0, 0.75), color, FENCE, "metal"), 2.5


def _railing(rng: np.random.Generator) -> _Fence:
    """Wrought iron: upright bars between two rails."""
    color = (BLACK, BLACK, DARK_GREEN, (0.2, 0.21, 0.21))[rng.integers(4)]
    x = np.linspace(-0.475, 0.475, 20)
    foot = np.stack([x, 0 * x, 0 * x + 0.1], axis=1)
    upright = part(*bars(foot, foot + 1.05 * UP, 0.009, 4), "metal", FENCE, color=color)
    rails = [block((1.0, 0.035, 0.02), (0, 0, z), color, FENCE, "metal") for z in (0.16, 1.02)]
    return (
        merged([upright, *rails]),
        block((0.06, 0.06, 1.5), (0, 0, 0.5), color, FENCE, "metal"),
        2.0,
    )


FENCES: dict[str, Callable[[np.random.Generator], _Fence]] = {
    "picket": _picket,
    "mesh": _mesh,
    "railing": _railing,
}


def fence(kind: str, path: ArrayLike, *, rng: np.random.Generator) -> Part:
    """A fence with posts; ``kind`` is one of FENCES, pickets are on the left of the rails."""
    if kind not in FENCES:
        raise ValueError(f"fence: unknown kind {kind!r}; choose from {', '.join(FENCES)}")
    panel, post, spacing = FENCES[kind](rng)
    points, left = _stations(path, spacing)
    panels = _repeated(panel, *_spans(path, spacing), rng=rng, uneven=0.08)
    return merged([panels, _repeated(post, points, _upright(left), rng=rng, uneven=0.08)])
