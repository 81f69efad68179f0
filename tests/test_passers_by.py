"""Who is out: on the ground, apart from everything, as many as the spec says, fewer in rain."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from test_ground import make_spec

from simgen import passers_by, roads, traffic
from simgen.layout import Layout, Mover
from simgen.recipe import SceneSpec
from simgen.roads import Network
from simgen.schema import LABELS
from simgen.site import Site


def busy(rain_mm_h: float = 0.0) -> SceneSpec:
    spec = make_spec("urban", 3)
    return replace(spec, pedestrians_per_100m=10.0, cyclists_per_km=6.0,
                   sky=replace(spec.sky, rain_mm_h=rain_mm_h))  # fmt: skip


@pytest.fixture(scope="module")
def network() -> Network:
    return roads.build(busy())


def layout_of(network: Network, spec: SceneSpec) -> Layout:
    return Layout(Site(network), spec, np.zeros((1, 2)), {}, 1.0)


@pytest.fixture(scope="module")
def placed(network: Network) -> tuple[Layout, dict[str, list[Mover]]]:
    layout = layout_of(network, busy())
    steps = (traffic.moving, traffic.parked, passers_by.cyclists, passers_by.bicycles,
             passers_by.pedestrians)  # fmt: skip
    return layout, {step.__name__: list(step(layout)) for step in steps}


def test_feet_and_wheels_are_on_the_ground(placed):
    layout, movers = placed
    for name in ("pedestrians", "cyclists", "bicycles"):
        for mover in movers[name]:
            ground = layout.site.height(mover.xyz[:2])[0]
            assert mover.xyz[2] == pytest.approx(ground, abs=1e-9)
            lowest = min(p.vertices[:, 2].min() for p in mover.model)
            assert abs(lowest - ground) < 0.06  # a wheel may stand lower on a slope


def test_nobody_stands_in_anything_that_moves(placed):
    _, movers = placed
    people = np.array([m.xyz[:2] for m in movers["pedestrians"]])
    apart = np.linalg.norm(people[:, None] - people[None], axis=2) + 1e3 * np.eye(len(people))
    assert apart.min() >= 0.6
    for mover in movers["moving"] + movers["parked"]:
        c, s = np.cos(mover.heading_rad), np.sin(mover.heading_rad)
        own = (people - mover.xyz[:2]) @ np.array([[c, -s], [s, c]])
        body = np.concatenate([p.vertices for p in mover.model])
        half = np.abs((body[:, :2] - mover.xyz[:2]) @ np.array([[c, -s], [s, c]])).max(axis=0)
        assert not (np.abs(own) < half - [0.0, 0.25]).all(axis=1).any()  # but for mirrors


def test_people_on_foot_use_pavements_and_crossings(placed):
    layout, movers = placed
    xy = np.array([m.xyz[:2] for m in movers["pedestrians"]])
    on_road = ~layout.site.clear_of(xy, road=0.0, pavement=-1, buildings=-1)
    assert 0 < on_road.mean() < 0.25
    mouths = np.array([j[:2] for j in layout.site.network.junctions])
    distance = np.linalg.norm(xy[on_road, None] - mouths, axis=2).min(axis=1)
    assert distance.max() < 40.0


def test_cyclists_ride_with_the_traffic_at_its_right(placed):
    layout, movers = placed
    lanes = layout.site.network.driving
    assert movers["cyclists"]
    for mover in movers["cyclists"]:

        def away(lane, at=mover.xyz[:2]):
            return np.linalg.norm(lane.centre[:, :2] - at, axis=1).min()

        lane = min(lanes, key=away)
        k = np.linalg.norm(lane.centre[:, :2] - mover.xyz[:2], axis=1).argmin()
        way = roads.line_headings(lane.centre)[k]
        assert np.cos(mover.heading_rad - way) > 0.95
        left = [-np.sin(way), np.cos(way)]
        assert (mover.xyz[:2] - lane.centre[k, :2]) @ left < -0.3


def test_rain_sends_people_home_and_brings_umbrellas_out(network):
    dry, wet = (list(passers_by.pedestrians(layout_of(network, busy(r)))) for r in (0.0, 20.0))
    assert 0 < len(wet) < 0.5 * len(dry)

    def widths(movers):
        return [np.ptp(np.concatenate([p.vertices[:, :2] for p in m.model]), axis=0).min()
                for m in movers]  # fmt: skip

    assert np.mean(np.array(widths(wet)) > 0.85) > 0.4
    assert np.mean(np.array(widths(dry)) > 0.85) < 0.1


def test_nobody_walks_where_the_spec_has_no_one(network):
    empty = replace(busy(), pedestrians_per_100m=0.0, cyclists_per_km=0.0)
    layout = layout_of(network, empty)
    for step in (passers_by.pedestrians, passers_by.cyclists, passers_by.bicycles):
        assert not list(step(layout))


def test_speeds_are_those_of_their_kind(placed):
    _, movers = placed
    speeds = {name: np.array([m.speed_m_s for m in ms]) for name, ms in movers.items()}
    assert (speeds["parked"] == 0).all()
    assert (speeds["bicycles"] == 0).all()
    assert speeds["pedestrians"].max() < 2.0
    assert 0.5 < np.mean(speeds["pedestrians"] > 0) < 1.0
    assert (speeds["cyclists"] >= 2.5).all()
    assert speeds["moving"].max() < 20.0


@pytest.mark.parametrize("step", [traffic.moving, traffic.parked])
def test_motorcycles_have_a_rider_exactly_where_they_move(network, step):
    spec = replace(busy(), families={"motorcycle": 1.0}, moving_per_km=30.0, parked=0.9)
    movers = list(step(layout_of(network, spec)))
    assert len(movers) > 5
    expected = "rider" if step is traffic.moving else "motorcycle"
    assert {m.record(1)["class"] for m in movers} == {expected}


def test_a_driver_keeps_a_second_from_the_car_ahead():
    rng = np.random.default_rng(0)
    for gap in (5.0, 9.0, 15.0, 40.0, np.inf):
        for kind, (mean, _) in traffic._FREE_M_S.items():
            speed = traffic._speed(kind, gap, rng)
            assert 0.0 <= speed <= 1.5 * mean
            assert speed * 1.0 <= max(gap - traffic.STANDING_GAP_M, 0.0)


def test_records_are_plain_data(placed):
    _, movers = placed
    classes = {name: {m.record(1)["class"] for m in ms} for name, ms in movers.items()}
    assert classes["pedestrians"] == {"person"}
    assert classes["cyclists"] == {"rider"}
    assert classes["bicycles"] == {"bicycle"}
    assert classes["moving"] <= LABELS.keys()
    record = movers["pedestrians"][0].record(7)
    assert json.loads(json.dumps(record)) == record
    assert record["instance"] == 7
