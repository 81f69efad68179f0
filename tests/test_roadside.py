"""Laws of the road side: what stands where it does, and what never stands there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely
from flat_sites import RECTS, flat_layout
from test_ground import make_spec

from simgen import barriers, furniture, pavement, roads, roadside, terraces, works
from simgen.layout import Layout, edges
from simgen.mesh import Model, part
from simgen.recipe import recipe_names
from simgen.roads import Given, Network, at_station, offset_line, stations
from simgen.signs import STANDARDS
from simgen.site import Site

POINTER = [part([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]], "matte", 1, color=(0.5, 0.5, 0.5))]
MAP_ONLY = {"no_entry", "keep_right", "roundabout"}
"""Signs for one-way streets, islands and roundabouts, of which our own roads have none."""


def pose(model: Model) -> tuple[np.ndarray, float]:
    """Where a placed POINTER stands (2,), and where it faces."""
    foot, tip = model[0].vertices[:2, :2]
    return foot, float(np.arctan2(*(tip - foot)[::-1]))


@pytest.fixture
def signs_of(monkeypatch: pytest.MonkeyPatch):
    """The traffic signs of a layout: names, place (2,), facing."""
    names: list[tuple[str, ...]] = []
    for other in ("billboard", "street_name_post"):
        monkeypatch.setattr(furniture, other, lambda *_, rng: [])

    def sign(_rects: object, *which: str, rng: np.random.Generator) -> Model:
        names.append(which)
        return POINTER

    monkeypatch.setattr(furniture, "traffic_sign", sign)

    def found(layout: Layout) -> list[tuple[tuple[str, ...], np.ndarray, float]]:
        return [(names[-1], *pose(model)) for model in roadside.signs(layout) if model]

    return found


LAYOUTS = [(recipe, index) for recipe in recipe_names() for index in range(6)]


def own_edge(layout: Layout, xy: np.ndarray, facing: float):
    """The road edge that a sign stands at, for traffic that heads against ``facing``."""

    def away(item) -> float:
        line = item[1]
        k = np.linalg.norm(line[:, :2] - xy, axis=1).argmin()
        turn = abs(np.angle(np.exp(1j * (roads.line_headings(line)[k] + np.pi - facing))))
        return float(np.linalg.norm(line[k, :2] - xy) + 100 * (turn > 0.6))

    return min(((lane, roads.resampled(line, 1.0)) for lane, line in edges(layout)), key=away)


@pytest.mark.parametrize(("recipe", "index"), LAYOUTS)
def test_signs_stand_where_their_message_holds(recipe, index, signs_of):
    layout = flat_layout(recipe, index, signs_per_100m=2.0)
    for names, xy, facing in signs_of(layout):
        lane, line = own_edge(layout, xy, facing)
        s = stations(line)[np.linalg.norm(line[:, :2] - xy, axis=1).argmin()]
        _, headings = at_station(line, np.array([s, s + 30.0, s + 80.0]))
        before_junction = any(np.linalg.norm(line[-1, :2] - j[:2]) < 30.0
                              for j in layout.site.network.junctions)  # fmt: skip
        at_its_end = before_junction and stations(line)[-1] - s < 14.0
        assert np.cos(headings[0] + np.pi - facing) > 0.9, "it faces the traffic of its side"
        assert not MAP_ONLY & set(names)
        if {"stop", "yield"} & set(names):
            assert at_its_end and not roads.is_main(lane)  # noqa: PT018
        if {"priority", "ahead_only"} & set(names):
            assert at_its_end and roads.is_main(lane)  # noqa: PT018
        if "curve_left" in names:
            assert headings[2] - headings[0] > 0.05
        if "chevron" in names:
            assert headings[1] - headings[0] > 0.02


@pytest.mark.parametrize("recipe", recipe_names())
def test_traffic_signs_and_gantries_of_a_given_map_are_the_maps(recipe, signs_of):
    layout = flat_layout(recipe, 1, signs_per_100m=5.0, gantry=True)
    assert signs_of(layout)
    layout.site.network = replace(layout.site.network, given=Given([], []))
    assert not signs_of(layout)
    assert not list(roadside.gantry(layout))


def test_a_straight_road_has_no_curve_signs(signs_of):
    spec = make_spec("rural", 0).road
    layout = flat_layout("rural", 0, road=replace(spec, curvature=0.0, junction="none"),
                         signs_per_100m=5.0)  # fmt: skip
    named = {name for names, *_ in signs_of(layout) for name in names}
    assert named
    assert not named & {"curve_left", "chevron"}


def test_sharp_curves_are_found_where_the_road_bends():
    s = np.linspace(0, 300, 301)
    k = np.where((s > 100) & (s < 200), 1 / 120, 0.0)
    heading = np.cumsum(k)
    line = np.stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), 0 * s], axis=1)
    ((start, end, to_the_left),) = roadside.sharp_curves(line)
    assert (start, end) == pytest.approx((100, 200), abs=9)
    assert to_the_left
    ((*_, mirrored),) = roadside.sharp_curves(line * [1, -1, 1])
    assert not mirrored
    assert not list(roadside.sharp_curves(line * 3))


def test_every_sign_stands_somewhere(signs_of):
    found = {name for recipe, index in LAYOUTS
             for names, *_ in signs_of(flat_layout(recipe, index, signs_per_100m=4.0))
             for name in names}  # fmt: skip
    assert found == {name for name in STANDARDS if name[:3] not in ("km_", "str")} - MAP_ONLY


# --- lamps and signals ---------------------------------------------------------------------------


def lamps_of(layout: Layout, monkeypatch: pytest.MonkeyPatch) -> tuple[set[str], list[np.ndarray]]:
    """Designs, and where they stand (2,)."""
    designs: set[str] = set()

    def lamp(design: str, *, rng: np.random.Generator) -> Model:
        designs.add(design)
        return POINTER

    monkeypatch.setattr(furniture, "street_lamp", lamp)
    return designs, [pose(m)[0] for m in roadside.lamps(layout) if m]


def test_lamps_are_of_the_kind_of_the_road(monkeypatch):
    expected = {
        "urban": {"curved", "straight", "globe"}, "suburban": {"curved", "straight", "globe"},
        "rural": {"curved", "straight"}, "highway": {"curved", "straight", "double"},
    }  # fmt: skip
    for recipe, designs in expected.items():
        seen = set()
        for index in range(14):
            layout = flat_layout(recipe, index, lamps=True)
            found, places = lamps_of(layout, monkeypatch)
            seen |= found
            if found == {"double"}:
                medians = [shapely.LineString(x.centre[:, :2]).buffer(x.width / 2)
                           for x in layout.lanes if x.kind == "median"]  # fmt: skip
                xy = np.array(places)
                assert shapely.contains_xy(shapely.union_all(medians), xy).all()
            if found == {"globe"}:
                assert layout.spec.road.lanes == 1
        assert seen == designs


@pytest.mark.parametrize("wires", [False, True])
def test_one_street_of_a_crossing_has_green_at_a_time(wires, monkeypatch):
    built: list[tuple[str, float]] = []

    def signal(state: str, *, rng: np.random.Generator, reach_m: float) -> Model:
        built.append((state, reach_m))
        return POINTER

    monkeypatch.setattr(furniture, "traffic_signal", signal)
    states = set()
    for index in range(12):
        road = replace(make_spec("urban", index).road, junction="cross")
        layout = flat_layout("urban", index, road=road, trolley_wires=wires)
        shown: dict[tuple[int, bool], set[str]] = {}
        for model in roadside.signals(layout):
            state, reach = built[-1]
            assert not (wires and reach)
            if model:
                xy, facing = pose(model)
                away = [np.linalg.norm(j[:2] - xy) for j in layout.site.network.junctions]
                main = roads.is_main(own_edge(layout, xy, facing)[0])
                shown.setdefault((int(np.argmin(away)), main), set()).add(state)
        assert all(len(x) == 1 for x in shown.values()), "an axis shows one state"
        for junction in {j for j, _ in shown}:
            axes = [shown.get((junction, main), {"red"}) for main in (False, True)]
            assert {"red"} in axes
        states |= {state for state, _ in built}
    assert states == set(furniture.LENSES)
    assert wires or {reach for _, reach in built} == {0.0, 4.5}


# --- over and beside the lanes -------------------------------------------------------------------


@cache
def network_of(recipe: str, index: int) -> Network:
    """A network with little land around it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(roads, "LAND_MARGIN_M", 60.0)
        return roads.build(make_spec(recipe, index))


def rails_of(layout: Layout) -> shapely.Geometry:
    """The strips that guard rails take, from the beam to the back of the posts."""
    lines = [shapely.LineString(offset_line(line, -0.8)[:, :2]) for _, line in edges(layout)]
    return shapely.union_all(lines).buffer(0.2, cap_style="flat")


def lanes_of(layout: Layout) -> shapely.Geometry:
    return shapely.union_all([
        shapely.LineString(x.centre[:, :2]).buffer(x.width / 2 - 0.05, cap_style="flat")
        for x in layout.site.network.driving
    ])  # fmt: skip


@pytest.mark.parametrize("index", range(12))
def test_a_gantry_spans_road_shoulders_and_rails(index):
    layout = flat_layout("highway", index, gantry=True, overpass=False)
    (model,) = roadside.gantry(layout)
    legs = np.concatenate([p.vertices for p in model])
    legs = legs[legs[:, 2] < legs[:, 2].min() + 1.0, :2]
    paved = [shapely.LineString(x.centre[:, :2]).buffer(x.width / 2, cap_style="flat")
             for x in layout.lanes]  # fmt: skip
    taken = shapely.union_all([*paved, rails_of(layout)])
    assert not shapely.dwithin(taken, shapely.points(legs), 0.3).any()
    middle = shapely.union_all([
        shapely.LineString(x.centre[:, :2]) for x in layout.lanes if x.kind == "median"
    ])  # fmt: skip
    off_centre = shapely.distance(middle, shapely.Point(legs.mean(axis=0)))
    assert off_centre == pytest.approx(roads.MEDIAN_M / 4, abs=0.1)
    assert 40.0 < legs[:, 0].mean() < 170.0, "ahead of the rig"
    for x, y in legs:
        assert not layout.site.claim([(x, y, 0.05)]), "nothing else is put there"


def test_the_legs_of_a_gantry_reach_the_ground():
    spec = replace(make_spec("highway", 4), gantry=True, overpass=False)
    site = Site(network_of("highway", 4))
    (model,) = roadside.gantry(Layout(site, spec, np.zeros((1, 2)), RECTS, 1.0))
    low = np.concatenate([p.vertices for p in model])
    low = low[low[:, 2] < low[:, 2].min() + 0.05]
    assert (low[:, 2] <= site.height(low[:, :2])).all()


def placed_works(layout: Layout) -> Iterator[np.ndarray]:
    for model in works.road_works(layout):
        yield from (p.vertices[:, :2] for p in model)


@pytest.mark.parametrize("recipe", recipe_names())
@pytest.mark.parametrize("index", range(6))
def test_works_leave_lanes_and_rails_free(recipe, index):
    layout = flat_layout(recipe, index, road_works=True)
    xy = np.concatenate([np.zeros((0, 2)), *placed_works(layout)])
    assert not shapely.contains_xy(lanes_of(layout), xy).any()
    if recipe in ("highway", "rural"):
        assert not shapely.contains_xy(rails_of(layout), xy).any()


def test_works_come_with_cones_boards_and_a_digger():
    num = [len([m for m in works.road_works(flat_layout("highway", index, road_works=True)) if m])
           for index in range(4)]  # fmt: skip
    assert min(num) > 8


# --- detail along a drive ------------------------------------------------------------------------

DRIVEN_M = 120.0


def on_a_drive(index: int, **changes: object) -> Layout:
    """A town whose rig drives ahead from the origin."""
    still = flat_layout("urban", index, **changes)
    way = np.stack([np.arange(0.0, DRIVEN_M + 1, 3.0), np.zeros(41)], axis=1)
    return Layout(still.site, still.spec, way, RECTS, 1.0)


def test_small_things_that_a_drive_passes_are_built_for_their_place(monkeypatch):
    models: list[Model] = []
    places: list[np.ndarray] = []

    def stands(_layout: Layout, model: Model, xy: np.ndarray, *_: float) -> Model:
        models.append(model)
        places.append(xy[:2])
        return model

    monkeypatch.setattr(roadside, "_small", lambda *_: [*POINTER])
    monkeypatch.setattr(roadside, "_stands", stands)
    layout = on_a_drive(0, small_per_100m=20.0)
    list(roadside.small_things(layout))
    near = layout.distance(np.array(places)) < roadside.UNIQUE_WITHIN_M - 5.0
    late = np.array(places)[:, 0] > roadside.UNIQUE_WITHIN_M + 5.0
    assert (near & late).sum() > 5
    close = [m for m, n in zip(models, near, strict=True) if n]
    assert len({id(m) for m in close}) == len(close)
    assert len({id(m) for m in models}) < len(models)


def test_fences_reach_as_far_ahead_of_the_last_frame_as_of_the_first(monkeypatch):
    runs: list[np.ndarray] = []

    def fence(_kind: str, run: np.ndarray, *, rng: np.random.Generator) -> object:
        runs.append(run.mean(axis=0)[:2])
        return POINTER[0]

    monkeypatch.setattr(barriers, "fence", fence)
    layout = on_a_drive(0, hedges=0.0, fences=1.0)
    list(roadside.frontage(layout))
    middles = np.array(runs)
    assert layout.distance(middles).max() <= roadside.FRONTAGE_AHEAD_M
    assert middles[:, 0].max() > roadside.FRONTAGE_AHEAD_M + 0.5 * DRIVEN_M


# --- all that is built ---------------------------------------------------------------------------

SPOT_BUILDERS = {
    furniture: ("street_lamp", "traffic_signal", "traffic_sign", "street_name_post", "gantry",
                "billboard", "delineator", "kilometre_post", "utility_line"),
    works: ("barrier_board", "excavator", "soil_heap", "tower_crane"),
}  # fmt: skip
LINE_BUILDERS = ("guard_rail", "concrete_barrier", "noise_wall", "fence", "hoarding")
STEPS = (roadside.signals, works.road_works, roadside.lamps, roadside.signs,
         roadside.utility_poles, roadside.gantry, roadside.rails, roadside.noise_walls,
         works.building_site, roadside.small_things, roadside.frontage)  # fmt: skip


def test_every_kind_of_furniture_stands_somewhere(monkeypatch):
    built: set[str] = set()

    def recorder(name: str, result: object):
        def record(*args: object, **_: object) -> object:
            built.add(f"fence {args[0]}" if name == "fence" else name)
            return result

        return record

    def small(_layout: Layout, kind: str, _rng: np.random.Generator) -> Model:
        built.add(kind)
        return POINTER

    monkeypatch.setattr(roadside, "_small", small)
    for module, names in SPOT_BUILDERS.items():
        for name in names:
            monkeypatch.setattr(module, name, recorder(name, POINTER))
    for name in LINE_BUILDERS:
        monkeypatch.setattr(barriers, name, recorder(name, POINTER[0]))
    optional = dict.fromkeys(("guard_rail", "utility_poles", "gantry", "noise_wall", "road_works",
                              "building_site", "lamps"), True)  # fmt: skip
    for recipe, index in LAYOUTS[::3]:
        layout = flat_layout(recipe, index, small_per_100m=20.0, hedges=0.0, fences=1.0, **optional)
        for step in STEPS:
            list(step(layout))
    spots = {name for names in SPOT_BUILDERS.values() for name in names}
    lines = {*LINE_BUILDERS, *(f"fence {kind}" for kind in barriers.FENCES)} - {"fence"}
    small_kinds = {*pavement.CLUTTER, *terraces.TERRACE, *roadside._PRINTED}
    assert built == spots | lines | small_kinds
