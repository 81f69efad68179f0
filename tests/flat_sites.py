"""Sites of drawn roads without land: flat, free everywhere, and quickly made."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from test_ground import make_spec

from simgen import roads
from simgen.geometry import Array
from simgen.layout import Layout
from simgen.roads import Network
from simgen.signs import sign_atlas
from simgen.site import Site

RECTS = sign_atlas(rng=np.random.default_rng(0)).rects


class FlatSite(Site):
    """Level ground that only what is placed takes."""

    def __init__(self, network: Network) -> None:
        self.network, self._discs = network, defaultdict(list)

    def height(self, xy: ArrayLike) -> Array:
        return np.zeros(np.asarray(xy).reshape(-1, 2).shape[0])

    def clear_of(self, xy: ArrayLike, **_: float) -> NDArray[np.bool_]:
        return np.ones(np.asarray(xy).reshape(-1, 2).shape[0], dtype=bool)


def flat_layout(recipe: str, index: int, **changes: Any) -> Layout:
    """The roads of a drawn spec, some of whose fields are changed, in the rig's frame."""
    spec = replace(make_spec(recipe, index), **changes)
    plan = roads._Plan(spec)
    lanes = list(roads._read_lanes(plan.map, plan.lanes))
    network = Network(lanes, {}, [], plan.junctions, lanes[0], 0.0)
    lane, station = roads._choose_rig_lane(network, spec, rng=spec.stream("rig lane"))
    moved = roads._moved(replace(network, rig_lane=lane, rig_station=station))
    return Layout(FlatSite(moved), spec, np.zeros((1, 2)), RECTS, 1.0)
