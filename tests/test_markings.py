"""What is painted on the roads of drawn junctions."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from flat_sites import flat_layout

from simgen import markings
from simgen.markings import Paint
from simgen.roads import Lane


def _along(lane: Lane, paint: Paint) -> tuple[np.ndarray, np.ndarray]:
    """Metres (N,) of an outline before the end of a lane, and to its left."""
    ahead = lane.centre[-1, :2] - lane.centre[-2, :2]
    ahead = ahead / np.linalg.norm(ahead)
    xy = lane.centre[-1, :2] - paint.outline
    return xy @ ahead, xy @ [ahead[1], -ahead[0]]


def _bars(paints: list[Paint], lane: Lane, width_m: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rectangles with a side of that width in the last metres of a lane."""
    found = []
    for p in paints:
        before, left = _along(lane, p)
        near = before.min() > -3.0 and before.max() < 9.0 and np.abs(left).max() < lane.width / 2
        sides = np.linalg.norm(np.diff(p.outline, axis=0), axis=1)
        if near and len(sides) == 3 and np.isclose(sides, width_m).any():
            found.append((before, left))
    return found


def test_every_lane_into_a_crossing_ends_with_a_stop_line_and_a_zebra():
    """The line spans the lane, short of the bars, which lie along the direction of travel."""
    layout = flat_layout("urban", 0)
    network, road = layout.site.network, layout.spec.road
    paints = markings.paint(network, road, rng=SimpleNamespace(random=lambda: 1.0))
    assert road.junction == "cross"
    for junction in network.junctions:
        lanes = [x for x in network.lanes if x.kind == "driving" and not x.in_junction
                 and np.linalg.norm(x.centre[-1, :2] - junction[:2]) < 30.0]  # fmt: skip
        assert len(lanes) == 4 * road.lanes
        for lane in lanes:
            ((stop, across),) = _bars(paints, lane, 0.4)
            assert lane.width - np.ptp(across) == pytest.approx(0.3, abs=0.02)
            assert np.ptp(stop) == pytest.approx(0.4, abs=0.03)
            zebra = _bars(paints, lane, 0.5)
            assert len(zebra) == round(lane.width)
            for before, left in zebra:
                assert np.ptp(before) == pytest.approx(3.0, abs=0.1)
                assert np.ptp(left) == pytest.approx(0.5, abs=0.1)
                assert 0.0 < before.min() < before.max() < stop.min() - 0.5


@pytest.mark.parametrize("scene", [0, 1, 2])
def test_no_line_and_no_bay_reaches_a_zebra(scene):
    layout = flat_layout("urban", scene)
    network, road = layout.site.network, layout.spec.road
    paints = markings.paint(network, road, rng=SimpleNamespace(random=lambda: 1.0))
    without = markings.paint(network, road, rng=SimpleNamespace(random=lambda: 0.0))
    others = {p.outline.tobytes() for p in without}
    zebras = [p.outline for p in paints if p.outline.tobytes() not in others]
    bars = shapely.union_all([shapely.Polygon(z).buffer(0.3) for z in zebras])
    assert len(zebras) > 10 * len(network.junctions)
    assert not any(bars.intersects(shapely.Polygon(p.outline)) for p in without)
