"""What surrounds the road: the buildings beside it, and the land and skyline to the horizon."""

from __future__ import annotations

import numpy as np

from simgen import background, buildings
from simgen.geometry import Array
from simgen.layout import Layout, Placed
from simgen.massing import Massing
from simgen.mesh import Model, placed
from simgen.signs import Rect

FAR_CENTRE = np.array([150.0, 0.0])
FAR_INNER_M = 400.0
"""The modelled land is the square of this half side around FAR_CENTRE; the background goes on."""
FAR_OUTER_M = 3000.0


def houses(layout: Layout) -> Placed:
    """The buildings of the network; shops have names from the sign atlas."""
    shop_names = [r for name, r in layout.sign_rects.items() if name.startswith("shop_")]
    blocks = layout.site.network.buildings
    distance = [layout.distance(np.concatenate([m.footprint for m in b])).min() for b in blocks]
    models: dict[int, Model] = {}
    for number in np.argsort(distance, kind="stable"):  # the nearest choose their sheets' places
        rng = layout.spec.stream(f"building {number}")
        free = np.array([layout.places.free(name) for name in buildings.WALL_MATERIALS])
        walls = rng.choice(buildings.WALL_MATERIALS, 2, replace=False, p=free**4 / (free**4).sum())
        models[number] = [
            p
            for mass in blocks[number]
            if layout.in_view(mass.footprint.mean(axis=0))
            for p in _house(layout, mass, [str(w) for w in walls], shop_names, rng=rng)
        ]
    yield from (models[number] for number in range(len(blocks)) if models[number])


def _house(
    layout: Layout,
    mass: Massing,
    walls: list[str],
    shop_names: list[Rect],
    *,
    rng: np.random.Generator,
) -> Model:
    nearest = mass.footprint[np.argmin(layout.distance(mass.footprint))]
    return buildings.build(
        mass, rng=rng, lod=layout.lod(nearest, 45.0, 130.0), places=layout.places, walls=walls,
        shop_names=shop_names,
    )  # fmt: skip


def horizon(layout: Layout) -> Placed:
    """Hills, woods and a skyline from the edge of the modelled land to the horizon."""
    rng = layout.spec.stream("background")

    def inner_height(xy: Array) -> Array:
        z = layout.site.height(xy + FAR_CENTRE)
        return np.nan_to_num(z)

    land = background.countryside(
        FAR_INNER_M, FAR_OUTER_M, inner_height, relief_m=layout.spec.far_relief_m, rng=rng
    )
    far = [background.terrain_ring(land), background.tree_line(land, rng=rng)]
    yield placed(far, xyz=[*FAR_CENTRE, 0.0])
    blocks = background.skyline(rng=rng, num=layout.spec.skyline, near_m=FAR_INNER_M + 40.0,
                                far_m=2200.0, ground_height=land.height)  # fmt: skip
    for block in blocks:
        yield placed(block, xyz=[*FAR_CENTRE, 0.0])
