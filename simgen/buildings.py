"""Buildings: from a massing (footprint, heights, roof form, kind) to a detailed model.

Levels of detail: 0 has real openings and everything that sticks out (up to 40 m away), 1 has flat
windows, doors, roofs and chimneys (40 to 120 m), 2 is walls, dark panes and a roof. All three
draw the same style and the same openings from the same generator state.

facades.py fills the walls, roofs.py shapes the roof.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simgen.facades import (
    BELOW_GROUND_M,
    KINDS,
    Kind,
    Openings,
    Style,
    Wall,
    detailed_openings,
    drawn_openings,
    drawn_style,
    far_openings,
    flat_openings,
    pipe,
    plain_surface,
    wall_sheeted,
    wall_surface,
)
from simgen.mesh import Model, Part, merged, part, tube
from simgen.roofs import RoofForm, RoofSurface, convex_pieces, roof_surface
from simgen.schema import LABELS
from simgen.solids import (
    WORLD,
    Frame,
    band,
    boxes,
    curtain,
    offset_ring,
    painted,
    rectangles,
    sheeted,
    slabs,
    upright,
)

Array = NDArray[np.float64]
Color = tuple[float, float, float]

WALL_MATERIALS = ("wall_0", "wall_1", "wall_2", "wall_3")
MAX_FAR_TRIANGLES = 300
"""of a building at level of detail 2"""

def build(
    massing: Massing,
    *,
    rng: np.random.Generator,
    lod: Literal[0, 1, 2],
    walls: Sequence[str] = WALL_MATERIALS,
) -> Model:
    """Builds one massing in world coordinates, one part per material.

    Args:
        lod: level of detail, see the module's docstring.
        walls: wall materials to choose from; repeat a name to make it likelier.
    """
    kind = KINDS[massing.kind]
    style = drawn_style(kind, list(walls), rng=rng)
    roof = roof_surface(massing.footprint, massing.roof, massing.roof_height, massing.ridge_rad)
    parapet = rng.uniform(0.35, 0.9) if massing.roof == "flat" else 0.0
    sides = _walls(massing, kind, parapet)
    openings = [drawn_openings(wall, kind, style, rng=rng) for wall in sides]
    model: Model = []
    for wall, holes in zip(sides, openings, strict=True):
        model += _side(wall, holes, style, rng, lod, num_sides=len(sides))
    if massing.roof == "flat":
        model += _flat_roof(massing, parapet, style, rng, lod)
    else:
        model += _pitched_roof(massing, roof, sides, style, rng, lod)
    return _by_material(model)


def _by_material(model: Model) -> Model:
    groups: dict[str, list[Part]] = defaultdict(list)
    for p in model:
        if len(p.faces):
            groups[p.material].append(p)
    return [merged(parts) for parts in groups.values()]


# ---- walls ------------------------------------------------------------------------------------


def _walls(massing: Massing, kind: Kind, parapet: float) -> list[Wall]:
    ring = massing.footprint
    edges = np.roll(ring, -1, axis=0) - ring
    lengths = np.linalg.norm(edges, axis=1)
    starts = np.cumsum(lengths) - lengths
    out = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / lengths[:, None]
    floors = _floors(massing, kind, parapet)
    return [
        Wall(
            frame=upright([*ring[i], massing.base_z], out[i]),
            length_m=float(lengths[i]),
            floors=floors,
            side=_side_name(float(out[i] @ out[massing.front % len(ring)]), i == massing.front),
            on_ground=massing.on_ground,
            uv_start=float(starts[i]),
        )
        for i in range(len(ring))
    ]


def _side_name(cosine: float, is_front: bool) -> Literal["front", "side", "back"]:
    """By the angle between a wall and the front."""
    if is_front:
        return "front"
    return "back" if abs(cosine) > 0.7 else "side"


def _floors(massing: Massing, kind: Kind, parapet: float) -> Array:
    """Heights of the floors above the base, and of the top of the wall."""
    height = massing.wall_height
    ground = kind.ground_m if massing.on_ground and kind.ground_m < 0.8 * height else 0.0
    count = max(round((height - ground) / kind.storey_m), 1)
    upper = np.linspace(ground, height, count + 1)
    floors = np.concatenate([[0.0], upper]) if ground else upper
    floors[-1] += parapet
    return floors


def _side(
    wall: Wall,
    openings: Openings,
    style: Style,
    rng: np.random.Generator,
    lod: int,
    num_sides: int,
) -> Model:
    if lod == 0:
        surface = wall_surface(wall, style, openings)
        return [surface, *detailed_openings(wall, style, openings, rng=rng)]
    surface = plain_surface(wall, style)
    if lod == 1:
        return [surface, *flat_openings(wall, style, openings, rng=rng)]
    max_quads = (MAX_FAR_TRIANGLES // 2 - 60) // num_sides
    return [surface, *far_openings(wall, openings, max_quads, rng=rng)]


