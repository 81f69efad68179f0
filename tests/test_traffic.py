"""Vehicles keep apart, whatever stands where."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from flat_sites import flat_layout

from simgen import traffic
from simgen.layout import Mover


def footprint(mover: Mover) -> shapely.Polygon:
    """The rectangle (2D) around the body of a vehicle, below its mirrors."""
    vertices = np.concatenate([p.vertices for p in mover.model])
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    body = vertices[vertices[:, 2] < 0.5 * (low + high), :2]
    return shapely.oriented_envelope(shapely.MultiPoint(body))


@pytest.mark.parametrize("recipe", ["highway", "urban"])
def test_bodies_of_vehicles_do_not_touch(recipe):
    layout = flat_layout(recipe, 0, moving_per_km=20.0)
    movers = [m for step in (traffic.moving, traffic.parked) for m in step(layout)]
    bodies = np.array([footprint(m) for m in movers])
    a, b = shapely.STRtree(bodies).query(bodies, predicate="intersects")
    assert len(bodies) > 20
    assert not (a != b).any()


@pytest.mark.parametrize("family", ["semi_trailer", "bus", "hatchback", "motorcycle"])
def test_what_a_vehicle_takes_covers_all_of_its_footprint(family):
    layout = flat_layout("highway", 0, moving_per_km=2.0, families={family: 1.0})
    for mover in traffic.moving(layout):
        rim = footprint(mover).exterior.segmentize(0.2)
        for x, y in shapely.get_coordinates(rim):
            assert not layout.site.claim([(x, y, 0.01)])
