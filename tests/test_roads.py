"""Road networks: the rig's lane, its neighbours, and things that stand on the ground."""

from __future__ import annotations

import os

import numpy as np
import pytest
from test_ground import make_spec, network_of

from simgen import roads
from simgen.recipe import recipe_names
from simgen.roads import at_station, offset_line, stations, strip
from simgen.site import Site


@pytest.mark.parametrize("name", recipe_names())
@pytest.mark.parametrize("scene", [1, 2])
def test_the_rig_drives_along_x_through_the_origin(name, scene):
    network = network_of(name, scene)
    point, heading = at_station(network.rig_lane.centre, network.rig_station)
    np.testing.assert_allclose(point, 0.0, atol=1e-9)
    assert abs(float(heading)) < 1e-9
    assert network.rig_lane.side == "right"


@pytest.mark.parametrize("name", recipe_names())
def test_traffic_drives_on_the_right(name):
    """Beside the rig, oncoming lanes are on its left and run against it; its own run with it."""
    network = network_of(name, 2)
    for lane in network.driving:
        if lane.road != network.rig_lane.road:
            continue
        nearest = int(np.argmin(np.linalg.norm(lane.centre[:, :2], axis=1)))
        tangent = np.gradient(lane.centre, axis=0)[nearest]
        if lane.side == "left":
            assert tangent[0] < 0
            assert lane.centre[nearest, 1] > 0
        else:
            assert tangent[0] > 0


@pytest.mark.parametrize("name", recipe_names())
def test_lanes_lie_on_the_ground(name):
    network = network_of(name, 2)
    site = Site(network)
    for lane in network.lanes[:8]:
        points = roads.resampled(lane.centre, 5.0)[1:-1]
        height = site.height(points[:, :2])
        lift = roads.KERB_M if lane.kind == "sidewalk" else 0.0
        np.testing.assert_allclose(height, points[:, 2] + lift, atol=0.05)


@pytest.mark.parametrize("scene", range(1, 6))
def test_pavements_meet_at_junctions_without_a_step(scene):
    """Else one looks through the crack between an arm's pavement and the corner's."""
    network = network_of("urban", scene)
    site = Site(network)
    for lane in network.lanes:
        if lane.kind == "sidewalk" and lane.in_junction:
            ends = at_station(lane.centre, np.array([0.1, stations(lane.centre)[-1] - 0.1]))[0]
            np.testing.assert_allclose(
                site.height(ends[:, :2]), ends[:, 2] + roads.KERB_M, atol=0.02
            )


def test_kerbs_lift_the_pavement():
    network = network_of("urban", 1)
    walk = next(x for x in network.lanes if x.kind == "sidewalk" and not x.in_junction)
    beside = walk.offset(walk.width / 2 + 0.4)
    site = Site(network)
    step = site.height(walk.centre[1:-1, :2]) - site.height(beside[1:-1, :2])
    assert np.median(step) == pytest.approx(roads.KERB_M, abs=0.03)


def test_the_land_has_no_hole_near_the_rig():
    for name in recipe_names():
        site = Site(network_of(name, 4))
        grid = np.stack(np.meshgrid(np.arange(-200, 500, 9.7), np.arange(-300, 300, 9.7)), axis=-1)
        assert not np.isnan(site.height(grid.reshape(-1, 2))).any()


def test_stations_of_a_bent_line():
    line = np.array([[0.0, 0, 0], [3, 0, 1], [3, 4, 1]])
    np.testing.assert_allclose(stations(line), [0, 3, 7])
    point, _ = at_station(line, 5.0)
    np.testing.assert_allclose(point, [3, 2, 1])


def test_offset_is_to_the_left():
    line = np.array([[0.0, 0, 0], [10, 0, 0]])
    np.testing.assert_allclose(offset_line(line, 2.0), [[0, 2, 0], [10, 2, 0]])
    assert strip(line, 1.0, -1.0).shape == (4, 3)


def test_same_spec_same_network():
    a, b = network_of("urban", 5), roads.build(make_spec("urban", 5))
    for name in roads.SURFACES:
        np.testing.assert_array_equal(a.surfaces[name].vertices, b.surfaces[name].vertices)
    assert len(a.buildings) == len(b.buildings)


class PanicException(BaseException):
    """As pyo3 raises it."""


def _said_meanwhile(error: BaseException | None) -> None:
    """What roadgen does: prints, past Python's own stderr, and maybe raises."""
    with roads._panics_raised():
        os.write(2, b"thread '<unnamed>' says")
        if error:
            raise error


def test_a_panic_of_roadgen_is_an_exception_and_prints_nothing(capfd):
    with pytest.raises(RuntimeError, match="roadgen gave up on the terrain: of a triangle"):
        _said_meanwhile(PanicException("of a triangle"))
    os.write(2, b"afterwards")
    assert capfd.readouterr().err == "afterwards"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_what_else_roadgen_says_is_passed_on(capfd, error):
    _said_meanwhile(None)
    with pytest.raises(error):
        _said_meanwhile(error())
    assert capfd.readouterr().err == 2 * "thread '<unnamed>' says"


def test_taken_places_stay_taken():
    site = Site(network_of("rural", 1))
    assert site.claim([(5.0, 5.0, 1.0)])
    assert not site.claim([(6.5, 5.0, 0.6)])
    assert site.claim([(7.0, 5.0, 0.6)])
    assert not site.claim([(30.0, 0.0, 1.0), (5.0, 4.0, 0.5)])
    assert site.claim([(30.0, 0.0, 1.0)]), "a refused claim takes nothing"
