"""What surrounds the road: the buildings beside it, and the land and skyline to the horizon."""

from __future__ import annotations

import numpy as np

from simgen import background, buildings
from simgen.geometry import Array
from simgen.layout import Layout, Placed
from simgen.mesh import Model, placed

FAR_CENTRE = np.array([150.0, 0.0])
FAR_INNER_M = 400.0
"""The modelled land is the square of this half side around FAR_CENTRE; the background goes on."""
FAR_OUTER_M = 3000.0


def houses(layout: Layout) -> Placed:
    """The buildings of the network; shops have names from the sign atlas."""
    shop_names = [r for name, r in layout.sign_rects.items() if name.startswith("shop_")]
    for number, masses in enumerate(layout.site.network.buildings):
        rng = layout.spec.stream(f"building {number}")
        model: Model = []
        walls = rng.permutation(["wall_0", "wall_1", "wall_2", "wall_3"])
        for mass in masses:
            middle = mass.footprint.mean(axis=0)
            if layout.in_view(middle):
                nearest = mass.footprint[np.argmin(layout.distance(mass.footprint))]
                model += buildings.build(mass, rng=rng, lod=layout.lod(nearest, 45.0, 130.0),
                                         walls=[str(w) for w in walls[:2]],
                                         shop_names=shop_names)  # fmt: skip
        if model:
            yield model


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
