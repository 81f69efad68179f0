"""Maps that somebody else drew: geometry against closed forms, places to drive, bad files."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from flat_sites import RECTS, FlatSite
from scipy.integrate import quad
from test_ground import make_spec

from simgen import __main__ as cli
from simgen import furniture, given_map, markings, passers_by, rendering, roads, roadside, world
from simgen.alignment import lines, reference, require_whole, strips, things
from simgen.config import Job, RenderOptions, resolve
from simgen.errors import UserError
from simgen.layout import Layout
from simgen.mesh import Model
from simgen.opendrive import read
from simgen.recipe import scenes_dir
from simgen.roads import at_station, stations
from simgen.run import SetFolder
from simgen.site import Site

MAPS = {p.stem: p for p in (scenes_dir() / "maps").glob("*.xodr")}
WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
LINE = '<geometry s="0" x="0" y="0" hdg="0" length="200"><line/></geometry>'


def one_road(geometry: str = LINE, *, lane: str = WIDTH, kind: str = "driving", more: str = "",
             road: str = 'rule="RHT"') -> bytes:  # fmt: skip
    """A map of one road with a lane on its right."""
    return f"""<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"/>
    <road id="1" junction="-1" length="200" {road}><planView>{geometry}</planView>{more}
    <lanes><laneSection s="0"><center><lane id="0" type="none"/></center>
    <right><lane id="-1" type="{kind}">{lane}</lane></right></laneSection></lanes></road>
    </OpenDRIVE>""".encode()


def geometry(shape: str, *, x: float = 3.0, y: float = -2.0, heading: float = 0.4) -> str:
    return f'<geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="200">{shape}</geometry>'


# --- reference lines -----------------------------------------------------------------------------

S = np.linspace(0.0, 200.0, 41)


def turned(local: np.ndarray) -> np.ndarray:
    c, s = np.cos(0.4), np.sin(0.4)
    return local @ np.array([[c, s], [-s, c]]) + [3.0, -2.0]


def test_a_line_runs_along_its_heading():
    xyz, heading = reference(read(one_road(geometry("<line/>")))[0], S)
    np.testing.assert_allclose(xyz[:, :2], turned(np.stack([S, 0 * S], axis=1)), atol=1e-9)
    np.testing.assert_allclose(heading, 0.4)


@pytest.mark.parametrize("k", [0.02, -0.004])
def test_an_arc_is_a_circle(k):
    xyz, heading = reference(read(one_road(geometry(f'<arc curvature="{k}"/>')))[0], S)
    circle = np.stack([np.sin(k * S) / k, (1 - np.cos(k * S)) / k], axis=1)
    np.testing.assert_allclose(xyz[:, :2], turned(circle), atol=1e-9)
    np.testing.assert_allclose(heading, 0.4 + k * S)


def test_a_spiral_integrates_a_heading_of_second_order():
    k0, k1 = 0.001, -0.03
    shape = f'<spiral curvStart="{k0}" curvEnd="{k1}"/>'
    xyz, heading = reference(read(one_road(geometry(shape)))[0], S)
    rate = (k1 - k0) / 200

    def angle(u: float) -> float:
        return k0 * u + rate * u * u / 2

    local = [[quad(lambda u, f=f: f(angle(u)), 0, s, epsabs=1e-12)[0] for f in (np.cos, np.sin)]
             for s in S]  # fmt: skip
    np.testing.assert_allclose(xyz[:, :2], turned(np.array(local)), atol=1e-8)
    np.testing.assert_allclose(heading, 0.4 + angle(S))


def test_a_cubic_is_measured_along_its_arc():
    xyz, _ = reference(read(one_road(geometry('<poly3 a="0" b="0" c="0.004" d="0"/>')))[0], S)
    c, s = np.cos(0.4), np.sin(0.4)
    u, v = ((xyz[:, :2] - [3.0, -2.0]) @ np.array([[c, -s], [s, c]])).T
    np.testing.assert_allclose(v, 0.004 * u**2, atol=1e-9)
    arc = [quad(lambda x: np.hypot(1, 0.008 * x), 0, end)[0] for end in u]
    np.testing.assert_allclose(arc, S, atol=1e-4)


@pytest.mark.parametrize("p_range, p", [("arcLength", S), ("normalized", S / 200)])
def test_a_parametric_cubic_follows_its_parameter(p_range, p):
    u, v = (0.0, 1.0, 2e-4, -1e-6), (0.0, 0.0, 3e-3, 2e-6)
    numbers = " ".join(f'{k}{axis}="{value}"' for axis, values in (("U", u), ("V", v))
                       for k, value in zip("abcd", values, strict=True))  # fmt: skip
    shape = f'<paramPoly3 {numbers} pRange="{p_range}"/>'
    xyz, _ = reference(read(one_road(geometry(shape)))[0], S)
    local = np.stack([np.polynomial.Polynomial(k)(p) for k in (u, v)], axis=1)
    np.testing.assert_allclose(xyz[:, :2], turned(local), atol=1e-9)


def test_pieces_of_a_reference_line_meet():
    for path in MAPS.values():
        for road in read(path.read_bytes()):
            for g in road.planview[1:]:
                ends = reference(road, np.array([g.s - 1e-6, g.s]))[0]
                np.testing.assert_allclose(ends[0], ends[1], atol=1e-4)


# --- lanes and marks -----------------------------------------------------------------------------


def test_a_lane_lies_between_its_borders():
    lane = '<width sOffset="0" a="3" b="0.01" c="0" d="0"/>'
    (strip,) = strips(read(one_road(lane=lane))[0])
    x = strip.centre[:, 0]
    np.testing.assert_allclose(strip.widths, 3 + 0.01 * x)
    np.testing.assert_allclose(strip.centre[:, 1], -(3 + 0.01 * x) / 2)


def test_a_driving_lane_narrower_than_a_car_is_a_shoulder():
    """Some tools call every lane of a junction a driving lane, kerbs included."""
    narrow, wide = (one_road(lane=WIDTH.replace("3.5", width)) for width in ("1.7", "1.9"))
    assert [x.kind for x in strips(read(narrow)[0])] == ["shoulder"]
    assert [x.kind for x in strips(read(wide)[0])] == ["driving"]


def test_lanes_on_the_left_run_against_the_reference_line():
    (road,) = (r for r in read(MAPS["signal_crossing"].read_bytes()) if r.id == "1")
    lanes = {x.number: x.centre for x in strips(road)}
    np.testing.assert_allclose(lanes[-1][[0, -1]], [[-164, -1.75, 0], [-14, -1.75, 0]], atol=1e-9)
    np.testing.assert_allclose(lanes[1][[0, -1]], [[-14, 1.75, 0], [-164, 1.75, 0]], atol=1e-9)
    np.testing.assert_allclose(lanes[-3][:, 1], -3.5 - 0.4 - 1.3)


def test_marks_change_where_the_file_says():
    (road,) = (r for r in read(MAPS["signal_crossing"].read_bytes()) if r.id == "1")
    broken, solid = lines(road)
    assert (broken.dash, solid.dash) == ((3.0, 6.0), None)
    np.testing.assert_allclose(broken.points[[0, -1], 0], [-164, -39])
    np.testing.assert_allclose(solid.points[[0, -1], 0], [-39, -14])


def test_a_double_line_has_its_solid_side_inside():
    lane = WIDTH + '<roadMark sOffset="0" type="solid broken" width="0.1" color="yellow"/>'
    inner, outer = lines(read(one_road(lane=lane))[0])
    assert inner.dash is None
    assert outer.dash is not None
    assert inner.points[0, 1] > outer.points[0, 1]
    assert inner.yellow


# --- the network ---------------------------------------------------------------------------------


@cache
def given(name: str) -> roads.Network:
    return roads.build(make_spec("urban", 1), MAPS[name].read_bytes())


@pytest.mark.parametrize("name", MAPS)
def test_the_rig_drives_in_a_lane_of_the_map(name):
    network = given(name)
    point, heading = at_station(network.rig_lane.centre, network.rig_station)
    np.testing.assert_allclose(point, 0.0, atol=1e-9)
    assert abs(float(heading)) < 1e-9
    nearest = min(np.linalg.norm(x.centre, axis=1).min() for x in network.driving)
    assert nearest < 1.0, "a point of a lane's line, which has one every metre"
    ahead = stations(network.rig_lane.centre)[-1] - network.rig_station
    assert ahead >= given_map.SIGHT_M


@pytest.mark.parametrize("name", MAPS)
def test_surfaces_lie_under_the_lanes(name):
    """Lanes are laid out here, surfaces by roadgen: two readers of one file."""
    network = given(name)
    site = Site(network)
    for lane in network.lanes:
        points = roads.resampled(lane.centre, 5.0)[1:-1]
        lift = roads.KERB_M if lane.kind == "sidewalk" else 0.0
        np.testing.assert_allclose(site.height(points[:, :2]), points[:, 2] + lift, atol=0.005)


@pytest.mark.parametrize("name", MAPS)
def test_land_meets_the_road_all_around_the_rig(name):
    site = Site(given(name))
    grid = np.stack(np.meshgrid(np.arange(-245, 550, 9.7), np.arange(-395, 400, 9.7)), axis=-1)
    assert not np.isnan(site.height(grid.reshape(-1, 2))).any()


def test_scenes_can_start_in_every_driving_lane_outside_junctions():
    data = MAPS["signal_crossing"].read_bytes()
    lanes = {(x.strip.road, x.strip.number) for x in given_map.starts(data)}
    inwards, outwards = ({(str(arm), number) for arm in (1, 2, 3, 4)} for number in (-1, 1))
    assert lanes == inwards | outwards


def test_a_drive_goes_on_across_the_junction():
    starts = given_map.starts(MAPS["signal_crossing"].read_bytes())
    (west,) = (x for x in starts if (x.strip.road, x.strip.number) == ("1", -1))
    np.testing.assert_allclose(west.centre[-1], [164, -1.75, 3], atol=1e-6)
    np.testing.assert_allclose(west.centre[:, 1], -1.75, atol=1e-6)


def test_a_map_in_utm_coordinates_is_driven_through_like_one_at_the_origin():
    path, spec = MAPS["signal_crossing"], make_spec("rural", 1)
    text = path.read_text(encoding="utf-8")
    for axis, shift in (("x", 500_000.0), ("y", 5_400_000.0)):
        pieces = text.split(f' {axis}="')
        moved = (f"{float(p.partition(chr(34))[0]) + shift!r}" + '"' + p.partition('"')[2]
                 for p in pieces[1:])  # fmt: skip
        text = f' {axis}="'.join([pieces[0], *moved])
    near, far = roads.build(spec, path.read_bytes()), roads.build(spec, text.encode())
    for a, b in zip(near.lanes, far.lanes, strict=True):
        np.testing.assert_allclose(a.centre, b.centre, atol=1e-5)
    for name in roads.SURFACES:
        np.testing.assert_allclose(near.surfaces[name].vertices[:50],
                                   far.surfaces[name].vertices[:50], atol=1e-4)  # fmt: skip


def test_roads_far_from_the_rig_are_left_out():
    text = one_road().decode()
    start = text.index("<road")
    road = text[start : text.index("</OpenDRIVE>")]
    far = road.replace('id="1"', 'id="2"').replace('x="0"', 'x="5000"')
    both = text.replace("</OpenDRIVE>", far + "</OpenDRIVE>").encode()
    network = roads.build(make_spec("rural", 1), both)
    assert len({x.road for x in network.lanes}) == 1


def test_pieces_without_length_are_left_out():
    """A lane section at the very end of its road: some tools write one, and roadgen refuses it."""
    text = MAPS["signal_crossing"].read_text()
    first, end = text.index("<laneSection"), text.index("</lanes>")
    last = text.index("</laneSection>") + len("</laneSection>")
    copy = text[first:last].replace('s="0"', 's="150.00001"', 1)
    spoilt = text[:end] + copy + text[end:]
    assert given_map.canonical(spoilt.encode(), {"1"}, np.zeros(2), "town").count("150.00001") == 0
    assert roads.build(make_spec("urban", 3), spoilt.encode()).lanes


def test_corners_in_road_coordinates_stay_there_whatever_the_heading():
    """A crossing over s 48 … 52 and t −4 … 4, whose object is turned by a quarter."""
    corners = "".join(f'<cornerRoad s="{s}" t="{t}"/>'
                      for s, t in ((48, -4), (52, -4), (52, 4), (48, 4)))  # fmt: skip
    more = (f'<objects><object type="crosswalk" id="1" s="50" t="0" hdg="{np.pi / 2}">'
            f"<outlines><outline>{corners}</outline></outlines></object></objects>")  # fmt: skip
    [road] = read(one_road(more=more))
    [thing] = things(road)
    np.testing.assert_allclose(np.sort(thing.outline[:, 0]), [48, 48, 52, 52], atol=1e-9)
    np.testing.assert_allclose(np.sort(thing.outline[:, 1]), [-4, -4, 4, 4], atol=1e-9)


def test_paint_is_the_maps():
    network = given("signal_crossing")
    painted = markings.paint(network, make_spec("urban").road, rng=np.random.default_rng(0))
    # four zebras of 8 bars, four stop lines; 14 dashes and a solid line on three streets …
    assert len(painted) >= 4 * 8 + 4 + 3 * 15
    assert len([t for t in network.given.things if t.type == "1000001"]) == 4


# --- what stands on a map ------------------------------------------------------------------------


def flat(name: str) -> Layout:
    """A layout on a map's roads, full of people."""
    spec = replace(make_spec("urban", 1), pedestrians_per_100m=60.0)
    spec = replace(spec, sky=replace(spec.sky, rain_mm_h=0.0))
    return Layout(FlatSite(given(name)), spec, np.array([[-120.0, 0.0]]), RECTS, 1.0)


def test_people_cross_on_the_maps_crosswalks():
    layout = flat("signal_crossing")
    zebras = shapely.union_all([shapely.Polygon(t.outline) for t in layout.site.network.given.things
                                if t.type == "crosswalk"])  # fmt: skip
    lanes = shapely.union_all([shapely.LineString(x.centre[:, :2]).buffer(x.width / 2 - 0.2)
                               for x in layout.site.network.driving])  # fmt: skip
    feet = shapely.points([m.xyz[:2] for m in passers_by.pedestrians(layout)])
    crossing = feet[shapely.contains(lanes, feet)]
    assert len(crossing) > 3
    assert shapely.distance(zebras, crossing).max() < 1.5


def test_lights_of_a_maps_crossing_show_one_phase(monkeypatch):
    shown: list[str] = []

    def signal(state: str, *, rng: np.random.Generator, reach_m: float) -> Model:
        shown.append(state)
        return []

    monkeypatch.setattr(furniture, "traffic_signal", signal)
    layout = flat("signal_crossing")
    list(roadside.signals(layout))
    lights = [t for t in layout.site.network.given.things if t.type == "1000001"]
    assert len(shown) == len(lights) == 4
    along = np.array([abs(np.cos(t.heading - lights[0].heading)) > 0.7 for t in lights])
    states = [set(np.array(shown)[axis]) for axis in (along, ~along)]
    assert [len(s) for s in states] == [1, 1]
    assert {"red"} in states


# --- a job with a map ----------------------------------------------------------------------------


def job(path: Path) -> Job:
    return resolve(RenderOptions(n=3, opendrive=path), "scalar_rgb")


def test_a_set_names_its_map_by_its_hash_and_keeps_a_copy(tmp_path):
    mine = job(MAPS["signal_crossing"])
    given_map.keep(mine.opendrive, tmp_path)
    content = mine.content()
    assert Job.from_content(content, given_map.kept(tmp_path, content["opendrive"])) == mine
    assert content != job(MAPS["station_street"]).content()


def test_the_recipes_of_a_map_are_those_of_its_roads_unless_some_are_named():
    town, silent = (MAPS[name] for name in ("signal_crossing", "station_street"))
    assert set(job(town).recipes) == {"urban", "suburban"}
    assert job(silent).recipes == resolve(RenderOptions(n=3), "scalar_rgb").recipes
    named = resolve(RenderOptions(n=3, opendrive=town, recipes="highway"), "scalar_rgb")
    assert set(named.recipes) == {"highway"}


@pytest.mark.parametrize("stated, kind", [("motorway", "motorway"), ("townArterial", "town"),
                                          ("rural", "rural"), ("unknown", "")])  # fmt: skip
def test_a_map_is_of_the_kind_of_most_of_its_metres(stated, kind):
    assert given_map.road_kind(one_road(more=f'<type s="0" type="{stated}"/>')) == kind


@pytest.mark.parametrize("spoil", [Path.unlink, lambda p: p.write_bytes(b"<OpenDRIVE/>")])
def test_a_set_without_its_map_cannot_be_rendered_again(spoil, tmp_path):
    mine = job(MAPS["signal_crossing"])
    given_map.keep(mine.opendrive, tmp_path)
    spoil(tmp_path / given_map.COPY)
    with pytest.raises(UserError, match=r"expected the map that the set was rendered from"):
        given_map.kept(tmp_path, mine.opendrive_sha256)


# --- bad files -----------------------------------------------------------------------------------

SHAPELESS = '<geometry s="0" x="0" y="0" hdg="0" length="200"><bezier/></geometry>'
ENTITY = b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><OpenDRIVE>&a;</OpenDRIVE>'
CUBIC = '<geometry s="0" x="0" y="0" hdg="0" length="200"><poly3 a="0" b="0" c="0" d="1e5"/>'


def two_pieces(s: float, x: float) -> str:
    """A straight piece of 100 m, and another one."""
    first, second = (LINE.replace('length="200"', 'length="100"') for _ in range(2))
    return first + second.replace('s="0" x="0"', f's="{s}" x="{x}"')


def twice(text: bytes) -> bytes:
    """A map with all its roads written twice."""
    start, end = text.index(b"<road"), text.index(b"</OpenDRIVE>")
    return text[:end] + text[start:end] + text[end:]


def stated(length: str) -> bytes:
    return one_road().replace(b'length="200" rule', f'length="{length}" rule'.encode())


BAD = {
    "broken": (one_road()[:-20], "not valid XML: .* Is the file complete?"),
    "binary": (b"\x00\x01\x02", "not valid XML"),
    "nothing": (b"", "not valid XML: no element found"),
    "not OpenDRIVE": (b"<osm/>", "not OpenDRIVE: its root is <osm>"),
    "empty": (b"<OpenDRIVE><header/></OpenDRIVE>", "the map is empty: no <road> in it"),
    "pavement only": (one_road(kind="sidewalk"), "none of its 1 roads has a lane of type driving"),
    "not a number": (one_road(LINE.replace('"200"', '"nan"')), "has length='nan'; expected a numb"),
    "absurd": (one_road(LINE.replace('x="0"', 'x="1e12"')), "road 1: <geometry> has x='1e12'"),
    "unknown shape": (one_road(SHAPELESS), "its geometry holds <bezier>; expected one of line, "),
    "no geometry": (one_road(""), "road 1: no <geometry> in its <planView>"),
    "too short": (one_road(LINE.replace('"200"', '"30"')), "too short to drive on: .* for 50 m"),
    "on the left": (one_road(road='rule="LHT"'), "traffic drives on the left"),
    "one side": (
        one_road().replace(b'<laneSection s="0">', b'<laneSection s="0" singleSide="true">'),
        "road 1: a <laneSection> is of one side only",
    ),
    "borders": (one_road(lane='<border a="3"/>'), "lane -1 is given by its <border>"),
    "entities": (ENTITY, "it declares a document type"),
    "one id": (twice(one_road()), "2 roads have id='1'; expected an id of its own for each"),
    "apart": (one_road(two_pieces(100, 500)), "road 1: piece 1 .* begins 400 m from where the"),
    "a gap": (one_road(two_pieces(9100, 9100)), "road 1: piece 1 .* has s=9100; expected 100"),
    "backwards": (one_road(two_pieces(0, 0)), "road 1: piece 1 .* has s=0; expected 100"),
    "absurd cubic": (one_road(CUBIC + "</geometry>"), "its roads cannot be built, wherever the rig "
                     r"starts \(3 places tried\).* a polyline needs at least 2 distinct points"),
    "endless": (one_road(LINE.replace("200", "99000000")), "road 1: it is 99000 km long; expected "
                "at most 100 km"),
    "much land": (one_road(LINE.replace("200", "15000").replace('hdg="0"', 'hdg="0.8"')),
                  "its roads cannot be built, .* fill 11.9 km × 12.2 km; expected at most 100 km²"),
    "a wide lane": (one_road(lane=WIDTH.replace("3.5", "50000")), "road 1: lane -1 is 50000 m wide;"
                    " expected at most 50 m"),
    "length in words": (stated("abc"), "road 1: <road> has length='abc'; expected a number"),
    "no length": (stated(""), "road 1: <road> has length=''; expected a number"),
    "stated endless": (stated("99000000"), "road 1: it is 99000 km long; expected at most 100 km"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_map_is_one_paragraph_and_writes_nothing(name, tmp_path, capsys):
    data, message = BAD[name]
    path, out = tmp_path / "mine.xodr", tmp_path / "set"
    path.write_bytes(data)
    args = ["--out", str(out), "--size", "96x54", "--variant", "scalar_rgb"]
    assert cli.main(["render", "--n", "3", "--opendrive", str(path), *args]) == 2
    said = capsys.readouterr().err
    assert re.match(rf"^simgen: --opendrive .*mine\.xodr: .*{message}", said)
    assert said.count("\n") == 1
    assert not out.exists()


def test_pieces_that_meet_within_a_metre_are_one_road():
    """Tools round, and some add up less exactly than others."""
    for data in (one_road(two_pieces(100.4, 100.0)), one_road(two_pieces(100.0, 100.9))):
        require_whole(read(data)[0])


def test_a_map_is_tried_out_before_the_folder_is_made(tmp_path, monkeypatch):
    tried = []

    def build(spec, data, *, drive_m):
        tried.append(drive_m)
        if len(tried) < 3:
            raise ValueError("of this place")

    monkeypatch.setattr(roads, "build", build)
    mine = replace(job(MAPS["signal_crossing"]), frames_per_scene=3)
    rendering._require_buildable(tmp_path, mine, [0])
    assert tried == [6.0] * 3, "one place to drive in is enough"


@pytest.mark.parametrize("split, scenes", [("all", [0, 1, 2]), ("train", [1, 2, 3]),
                                           ("test", [0, 10])])  # fmt: skip
def test_the_first_scenes_that_are_to_be_rendered_are_tried(
    tmp_path, monkeypatch, capsys, split, scenes
):
    tried = []

    def build(spec, data, *, drive_m):
        tried.append(spec.seed)
        raise ValueError("no road")

    monkeypatch.setattr(roads, "build", build)
    assert _begun(tmp_path, "--split", split, "--frames-per-scene", "2") == 2
    assert tried == [(0, scene, attempt) for scene in scenes for attempt in range(3)]
    said = capsys.readouterr().err
    assert f"({len(tried)} places tried); of the last: no road. Mend the map, cut it" in said
    assert "by another --seed" in said


def test_a_map_is_not_tried_out_again_for_a_set_that_was_begun(tmp_path, monkeypatch, capsys):
    folder = SetFolder(tmp_path / "set")
    with folder.locked():
        folder.open_manifest(replace(job(MAPS["signal_crossing"]), seed=1).content(), 16, 3)
    monkeypatch.setattr(roads, "build", lambda *_, **__: pytest.fail("tried"))
    assert _begun(tmp_path) == 2
    assert "was rendered with other options" in capsys.readouterr().err


def _begun(folder: Path, *args: str) -> int:
    """The exit status of a run of 22 frames that is refused."""
    path = MAPS["signal_crossing"]
    return cli.main(["render", "--n", "66", "--opendrive", str(path), "--out", str(folder / "set"),
                     "--size", "96x54", "--variant", "scalar_rgb", *args])  # fmt: skip


# --- drives of many frames -----------------------------------------------------------------------


def test_a_drive_starts_where_its_lane_is_long_enough():
    """21 frames are 60 m: on a road of 70 m, all scenes start in its first 6 m."""
    data = one_road(LINE.replace("200", "70"))
    starts = given_map.starts(data, 60.0)
    assert [x.usable_m for x in starts] == [pytest.approx(6.0)]
    assert [x.usable_m for x in given_map.starts(data, 45.0)] == [pytest.approx(20.0)]
    drive = world.drive(make_spec("rural", 1), 20, data, num_steps=21)
    assert len(drive.way) == 21


def test_a_drive_longer_than_all_lanes_is_refused(tmp_path):
    path = tmp_path / "mine.xodr"
    path.write_bytes(one_road(LINE.replace("200", "62")))
    options = RenderOptions(n=3, opendrive=path, frames_per_scene=21)
    with pytest.raises(
        UserError, match=r"no driving lane goes on for 64 m.* fewer --frames-per-sc"
    ):
        resolve(options, "scalar_rgb")
    assert resolve(replace(options, frames_per_scene=16), "scalar_rgb").opendrive


def test_a_missing_map_is_explained(tmp_path):
    with pytest.raises(UserError, match=r"--opendrive .*none\.xodr: cannot be read \(No such"):
        job(tmp_path / "none.xodr")


def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.xodr"
    with open(path, "wb") as file:
        file.truncate(given_map.MAX_BYTES + (1 << 20))
    with pytest.raises(UserError, match=r"65 MB; expected at most 64 MB"):
        job(path)


def test_no_map_leaves_a_job_as_it_is():
    plain = resolve(RenderOptions(n=3), "scalar_rgb")
    assert plain.content()["opendrive"] == ""
    assert replace(plain, opendrive=b"x").content() != plain.content()
