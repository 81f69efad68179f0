"""Small things on pavements and verges: bins, benches, boxes, bollards.

Each is a model in its own frame: +x is where it faces, z up, origin on the ground.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from simgen.mesh import Model, Part, merged, part
from simgen.schema import LABELS
from simgen.street_solids import (
    BLACK,
    CONCRETE,
    POLE,
    RED,
    STATIC,
    STEEL,
    UP,
    WHITE,
    WOOD,
    assembled,
    bars,
    block,
    moved,
    rod,
    turned,
)  # fmt: skip

DYNAMIC, VEGETATION = LABELS["dynamic"], LABELS["vegetation"]
Builder = Callable[..., Model]


def bollard(*, rng: np.random.Generator) -> Model:
    """Cast iron with a knob, a steel tube with a reflecting band, or a concrete one."""
    kind = rng.integers(3)
    if kind == 0:
        shape = [(0.1, -0.1), (0.1, 0.12), (0.065, 0.16), (0.055, 0.75), (0.08, 0.8), (0.05, 0.85),
                 (0.075, 0.92), (0.03, 0.99)]  # fmt: skip
        return [turned(shape, BLACK, POLE, "paint", 10)]
    if kind == 1:
        shape = [(0.05, -0.1), (0.05, 0.7), (0.051, 0.7), (0.051, 0.85), (0.05, 0.85), (0.05, 1.0)]
        return [turned(shape, [STEEL, STEEL, RED, RED, STEEL, STEEL], POLE, "metal", 10)]
    return [turned([(0.16, -0.1), (0.15, 0.6), (0.11, 0.7), (0.04, 0.74)], CONCRETE, POLE)]


def litter_bin(*, rng: np.random.Generator) -> Model:
    """A hooded bin on a post, or a slatted drum."""
    color = np.array(((0.04, 0.08, 0.05), (0.45, 0.16, 0.02), (0.05, 0.055, 0.06))[rng.integers(3)])
    if rng.random() < 0.5:
        drum = turned(
            [(0.17, 0.45), (0.21, 0.95), (0.2, 0.95), (0.18, 0.6)], color, material="paint"
        )
        hood = turned([(0.215, 1.1), (0.2, 1.16), (0.06, 1.2)], color * 0.8, material="paint")
        post = rod([(-0.24, 0, -0.1), (-0.24, 0, 1.2)], 0.03, STEEL)
        clasp = block((0.12, 0.06, 0.06), (-0.2, 0, 1.12), STEEL, material="metal")
        return assembled([drum, moved(hood, (0, 0, -0.02)), post, clasp])
    angle = np.arange(18) * 2 * np.pi / 18
    foot = np.stack([0.27 * np.cos(angle), 0.27 * np.sin(angle), 0 * angle + 0.06], axis=1)
    slats = part(*bars(foot, foot + 0.74 * UP, 0.035, 4), "matte", STATIC, color=WOOD)
    liner = turned([(0.24, 0.0), (0.25, 0.84), (0.22, 0.84), (0.2, 0.4)], color, material="paint")
    return assembled([slats, liner])


def bench(*, rng: np.random.Generator) -> Model:
    """Wooden slats on two iron sides; who sits looks to +x."""
    wood = np.array(WOOD) * rng.uniform(0.6, 1.5)
    seat = [
        block((0.1, 1.7, 0.035), (x, 0, 0.45), wood * s)
        for x, s in ((-0.15, 1), (-0.03, 0.9), (0.09, 1.1), (0.21, 1))
    ]
    back = [
        block((0.035, 1.7, 0.11), (-0.25 - 0.12 * (z - 0.5), 0, z), wood)
        for z in (0.58, 0.72, 0.86)
    ]
    iron: list[Part] = []
    for y in (-0.7, 0.7):
        iron += [
            block((0.5, 0.05, 0.04), (0.0, y, 0.41), BLACK),
            block((0.05, 0.05, 0.45), (0.2, y, 0.2), BLACK),
            block((0.05, 0.05, 0.95), (-0.27, y, 0.45), BLACK),
        ]
    return assembled([*seat, *back, *iron])


def hydrant(*, rng: np.random.Generator) -> Model:
    """A cast pillar with a bonnet and three outlets."""
    color = np.array((RED, (0.5, 0.32, 0.02))[rng.integers(2)])
    shape = [(0.17, -0.05), (0.17, 0.05), (0.11, 0.08), (0.1, 0.5), (0.14, 0.53), (0.14, 0.57),
             (0.12, 0.62), (0.07, 0.7), (0.03, 0.72), (0.03, 0.77)]  # fmt: skip
    body = turned(shape, color, material="paint")
    sides = [rod([(0, -0.19, 0.42), (0, 0.19, 0.42)], 0.05, color * 0.8, STATIC, "paint"),
             rod([(0, 0, 0.38), (0.2, 0, 0.38)], 0.065, color * 0.8, STATIC, "paint")]  # fmt: skip
    return assembled([body, *sides])


def utility_cabinet(*, rng: np.random.Generator) -> Model:
    """A grey or green cabinet of one to three doors with vents, on a plinth."""
    doors, height = int(rng.integers(1, 4)), rng.uniform(1.0, 1.45)
    color = np.array(((0.33, 0.34, 0.32), (0.1, 0.16, 0.1), (0.4, 0.38, 0.32))[rng.integers(3)])
    width = 0.62 * doors
    parts = [
        block((0.34, width - 0.04, 0.14), (0, 0, 0.05), np.array(CONCRETE) * 0.8),
        block((0.38, width, height), (0, 0, 0.12 + height / 2), color * 0.9),
        block((0.44, width + 0.06, 0.05), (0, 0, 0.14 + height), color * 0.75),
    ]
    for y in (np.arange(doors) - (doors - 1) / 2) * 0.62:
        parts.append(block((0.02, 0.57, height - 0.1), (0.19, y, 0.12 + height / 2), color))
        parts.append(block((0.03, 0.03, 0.14), (0.2, y + 0.2, 0.1 + height / 2), BLACK))
        for z in 0.2 + 0.05 * np.arange(4):
            parts.append(block((0.004, 0.3, 0.02), (0.202, y, z), color * 0.3))
    return assembled(parts)


def post_box(*, rng: np.random.Generator) -> Model:
    """A red pillar, or a yellow or blue box on a post."""
    if rng.random() < 0.4:
        pillar = [(0.25, 0.0), (0.25, 0.2), (0.22, 0.24), (0.22, 1.35), (0.26, 1.38), (0.26, 1.45),
                  (0.16, 1.55), (0.03, 1.58)]  # fmt: skip
        colors = [BLACK, BLACK, *[RED] * 6]
        slot = block((0.03, 0.22, 0.04), (0.21, 0, 1.22), BLACK)
        notice = block((0.02, 0.18, 0.22), (0.212, 0, 1.02), WHITE)
        return assembled([turned(pillar, colors, material="paint", sides=16), slot, notice])
    color = np.array(((0.62, 0.4, 0.02), (0.02, 0.06, 0.25))[rng.integers(2)])
    return assembled([
        rod([(0, 0, -0.1), (0, 0, 0.8)], 0.045, STEEL),
        block((0.4, 0.5, 0.6), (0, 0, 1.05), color, material="paint"),
        block((0.44, 0.54, 0.06), (0, 0, 1.37), color * 0.9, material="paint"),
        block((0.02, 0.36, 0.035), (0.2, 0, 1.25), BLACK),
        block((0.01, 0.2, 0.26), (0.2, 0, 0.98), WHITE),
    ])  # fmt: skip


def cone(*, rng: np.random.Generator) -> Model:
    """A traffic cone, 0.5 m or 0.75 m high, on its square foot."""
    orange, white = np.array((0.62, 0.1, 0.02)), np.array(WHITE)
    h, r = (0.75, 0.16) if rng.random() < 0.5 else (0.5, 0.12)
    z = np.array([0.04, 0.4, 0.4, 0.6, 0.6, 0.75, 0.75, 0.87, 0.87, 1.0]) * h
    radius = r - (r - 0.025) * z / h
    bands = [c for c in (orange, white, orange, white, orange) for _ in range(2)]
    profile = list(zip(radius, z, strict=True))
    foot = block((2.5 * r, 2.5 * r, 0.04), (0, 0, 0.02), orange * 0.5, DYNAMIC)
    return assembled([turned(profile, bands, DYNAMIC, sides=14), foot])


def planter(*, rng: np.random.Generator) -> Model:
    """A tub of concrete or wood with leaves and flowers."""
    if rng.random() < 0.5:
        tub = turned([(0.3, 0.0), (0.42, 0.45), (0.44, 0.5), (0.39, 0.5), (0.38, 0.44)], CONCRETE)
    else:
        tub = merged([block((0.7, 0.7, 0.14), (0, 0, 0.08 + 0.15 * i), np.array(WOOD) * s)
                      for i, s in enumerate((1.0, 1.15, 0.9))])  # fmt: skip
    num = 150
    angle, r = rng.uniform(0, 2 * np.pi, num), 0.36 * np.sqrt(rng.random(num))
    root = np.stack([r * np.cos(angle), r * np.sin(angle), 0.44 + rng.gamma(3, 0.06, num)], axis=1)
    leaves = root[:, None] + rng.normal(0, 0.07, (num, 3, 3))
    bloom = np.array(((0.55, 0.03, 0.06), (0.6, 0.45, 0.03), (0.4, 0.08, 0.4)))[rng.integers(3)]
    green = np.array((0.07, 0.13, 0.035)) * rng.uniform(0.6, 1.3, (num, 1))
    color = np.where(rng.random((num, 1)) < 0.2, bloom, green)
    foliage = part(
        leaves, np.arange(3 * num), "leaf", VEGETATION, color=np.repeat(color, 3, axis=0)
    )
    return [tub, foliage]


CLUTTER: dict[str, Builder] = {
    "bollard": bollard,
    "litter_bin": litter_bin,
    "bench": bench,
    "hydrant": hydrant,
    "utility_cabinet": utility_cabinet,
    "post_box": post_box,
    "cone": cone,
    "planter": planter,
}
"""Small things by name; each takes ``rng`` alone."""
