"""Buildings: from a massing (footprint, heights, roof form, kind) to a detailed model.

Levels of detail: 0 has real openings and everything that sticks out (up to 45 m away), 1 has flat
windows, doors, roofs and chimneys (45 to 130 m), 2 is walls, dark panes and a roof; the distances
are those for a 90° lens (see :meth:`simgen.layout.Layout.lod`). All three draw the same style and
the same openings from the same generator state.

massing.py says what goes in, facades.py lays out the walls, fittings.py and shopfronts.py fill
them, roofs.py is the geometry of roofs and roofing.py builds them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Literal

import numpy as np

from simgen.facades import (
    Wall,
    drawn_openings,
    drawn_style,
    joints,
    panelled,
    plain_surface,
    wall_surface,
    walls_of,
)
from simgen.fittings import detailed_openings, far_openings, flat_openings
from simgen.massing import KINDS, Massing
from simgen.mesh import Model, Part, merged
from simgen.places import Places
from simgen.roofing import flat_roof, gable_profile, pitched_roof
from simgen.roofs import roof_surface
from simgen.signs import Rect

__all__ = ["MAX_FAR_TRIANGLES", "WALL_MATERIALS", "Massing", "build"]

WALL_MATERIALS = ("wall_0", "wall_1", "wall_2", "wall_3")
MAX_FAR_TRIANGLES = 300
"""of a building at level of detail 2 whose footprint has at most 12 corners"""


def build(
    massing: Massing,
    *,
    rng: np.random.Generator,
    lod: Literal[0, 1, 2],
    places: Places,
    walls: Sequence[str] = WALL_MATERIALS,
    shop_names: Sequence[Rect] = (),
) -> Model:
    """Builds one massing in world coordinates, one part per material.

    Args:
        lod: level of detail, see the module's docstring.
        places: where walls and roofs find theirs on the sheets of the scene.
        walls: wall materials to choose from; repeat a name to make it likelier.
        shop_names: cells of the sign atlas with what is written over shops.
    """
    if lod not in (0, 1, 2):
        raise ValueError(f"build: level of detail {lod} is unknown; choose 0, 1 or 2")
    kind = KINDS[massing.kind]
    style = drawn_style(kind, walls, rng=rng)
    parapet_m = rng.uniform(0.35, 0.9) if massing.roof == "flat" else 0.0
    roof = roof_surface(massing.footprint, massing.roof, massing.roof_height, massing.ridge_rad)
    sides = [
        panelled(wall, style, places, float(gable_profile(wall, roof)[1].max()))
        for wall in walls_of(massing, kind, parapet_m)
    ]
    layouts = [drawn_openings(wall, kind, style, rng=rng) for wall in sides]
    model: Model = []
    for wall, openings in zip(sides, layouts, strict=True):
        if lod == 0:
            model.append(wall_surface(wall, style, openings))
            model += detailed_openings(wall, kind, style, openings, shop_names, rng=rng)
        elif lod == 1:
            model.append(plain_surface(wall, style))
            model += flat_openings(wall, style, openings, shop_names, rng=rng)
        else:
            model.append(plain_surface(wall, style))
            model += far_openings(wall, openings, _max_panes(sides), rng=rng)
        if lod < 2:
            model += joints(wall, style)
    if massing.roof == "flat":
        model += flat_roof(massing, parapet_m, style, rng=rng, lod=lod)
    else:
        model += pitched_roof(massing, roof, sides, style, places, rng=rng, lod=lod)
    return _by_material(model)


def _max_panes(sides: Sequence[Wall]) -> int:
    """Panes per wall that MAX_FAR_TRIANGLES leaves after walls, gables and roof."""
    n = len(sides)
    panels = sum((len(s.panels.x) - 1) * (len(s.panels.y) - 1) for s in sides)
    return max((MAX_FAR_TRIANGLES - 8 * n - 2 * panels) // (2 * n), 1)


def _by_material(model: Model) -> Model:
    groups: dict[str, list[Part]] = defaultdict(list)
    for part in model:
        if len(part.faces):
            groups[part.material].append(part)
    return [merged(parts) for parts in groups.values()]
