"""Road networks, terrain and building masses: the one module that talks to ``roadgen``.

Nothing of roadgen's types leaves it. The network frame is the scene's world: z up, metres,
moved and turned once so that the rig's lane passes the origin along +x.

The main road runs from behind the rig through up to two junctions; side roads leave them. A map
that somebody else drew may take the place of all that: see ``opendrive.py``.
"""

from __future__ import annotations

import itertools
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import roadgen
from numpy.typing import NDArray

from simgen import alignment, given_map, opendrive
from simgen.buildings import Massing
from simgen.geometry import Array
from simgen.recipe import RoadSpec, SceneSpec

BEHIND_M = 90.0
"""the main road starts this far behind the rig"""
AHEAD_M = 520.0
SIDE_M = 170.0
MEDIAN_M = 3.0
KERB_M = 0.13
"""Pavements are lifted by this when the mesh is made; lanes know nothing of it."""
LAND_MARGIN_M = 520.0
GIVEN_LAND_MARGIN_M = 720.0
"""around a map that somebody else drew: the rig may stand where it ends"""

SURFACES = ("road", "sidewalk", "terrain")


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane of one road; points run along its direction of travel."""

    road: str
    kind: str
    """driving | parking | shoulder | median | sidewalk"""
    side: str
    """right | left of the road's reference line"""
    rank: int
    """0 = next to the reference line, counted per side over all kinds"""
    centre: Array
    """(N, 3)"""
    width: float
    in_junction: bool
    widening: Array | float = 0.0
    """(N,) by how much it is wider than ``width`` at the points of ``centre``"""

    def offset(self, metres: float) -> Array:
        """The centre line (N, 3) shifted to the left [m]."""
        return offset_line(self.centre, metres)

    @property
    def outer_edge(self) -> Array:
        """(N, 3)"""
        return offset_line(self.centre, -0.5 * (self.width + self.widening))


def is_main(lane: Lane) -> bool:
    """Whether a lane outside junctions is one of our own main road, not of a side road."""
    return lane.road.startswith("road/main")


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one surface class."""

    vertices: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Given:
    """What a map that somebody else drew states beside its lanes."""

    lines: list[alignment.Line]
    things: list[alignment.Placed]


@dataclass(frozen=True, eq=False)
class Network:
    """A road network with its land, in the world frame."""

    lanes: list[Lane]
    surfaces: dict[str, Surface]
    """by name of SURFACES; kerbs belong to the sidewalk, gutters to the road"""
    buildings: list[list[Massing]]
    """parts of each building"""
    junctions: list[Array]
    """centres (3,)"""
    rig_lane: Lane
    """the lane that the rig drives in; its origin station is ``rig_station``"""
    rig_station: float
    given: Given | None = None
    """of a map that somebody else drew: it takes the place of our own markings and signals"""

    @property
    def driving(self) -> list[Lane]:
        """Driving lanes outside junctions."""
        return [lane for lane in self.lanes if lane.kind == "driving" and not lane.in_junction]


def build(spec: SceneSpec, opendrive_map: bytes = b"", *, drive_m: float = 0.0) -> Network:
    """Builds the network of a scene; ``opendrive_map`` is an OpenDRIVE file to drive through.

    There, the rig starts where its lane goes on for a drive of ``drive_m``.

    Raises RuntimeError where roadgen's triangulation gives up.
    """
    with _panics_raised():
        if opendrive_map:
            return _moved(_read_given(opendrive_map, spec, drive_m))
        plan = _Plan(spec)
        raw = _read(plan, spec)
        lane, station = _choose_rig_lane(raw, spec, rng=spec.stream("rig lane"))
        return _moved(replace(raw, rig_lane=lane, rig_station=station))


@contextmanager
def _panics_raised() -> Iterator[None]:
    """A panic of roadgen's Rust core is no Exception, and cannot be pickled: makes it one.

    What the core itself prints of a panic is left out: the exception says it.
    """
    with _stderr_held_back() as held:
        try:
            yield
        except BaseException as error:
            if type(error).__name__ != "PanicException":
                raise
            held.truncate(0)
            raise RuntimeError(f"roadgen gave up on the terrain: {error}") from None


_HOLDING = threading.Lock()


@contextmanager
def _stderr_held_back() -> Iterator[IO[bytes]]:
    """A file that takes what the process, its native code included, writes to stderr meanwhile.

    What is still in it at the end is written to stderr then. One thread at a time.
    """
    with _HOLDING, tempfile.TemporaryFile(prefix="simgen-") as held:
        if sys.stderr is None:  # closed: descriptor 2 is nobody's, or some other file
            yield held
            return
        sys.stderr.flush()
        stderr = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield held
        finally:
            sys.stderr.flush()
            os.dup2(stderr, 2)
            os.close(stderr)
            held.seek(0)
            with open(2, "wb", closefd=False) as stream:
                shutil.copyfileobj(held, stream)


# --- lines ---------------------------------------------------------------------------------------


def stations(line: Array) -> Array:
    """Horizontal arc length (N,) at the points of a polyline (N, 3)."""
    dx, dy = (line[1:, :2] - line[:-1, :2]).T
    return np.concatenate([[0.0], np.cumsum(np.sqrt(dx * dx + dy * dy))])


def at_station(line: Array, s: Array | float) -> tuple[Array, Array]:
    """Points (…, 3) and headings (…,) [rad] at stations ``s`` along a polyline (N, 3)."""
    headings = np.interp(s, stations(line), np.unwrap(line_headings(line)))
    return points_at(line, s), np.asarray(headings)


def points_at(line: Array, s: Array | float) -> Array:
    """Points (…, 3) at stations ``s`` along a polyline (N, 3)."""
    t = stations(line)
    return np.stack([np.interp(s, t, x) for x in line.T], axis=-1)


def line_headings(line: Array) -> Array:
    """Heading (N,) [rad] of the tangent at the points of a polyline (N, 3)."""
    xy = np.concatenate([line[:1, :2], line[:, :2], line[-1:, :2]])
    x, y = (xy[2:] - xy[:-2]).T
    return np.arctan2(y, x)


def offset_line(line: Array, metres: Array | float) -> Array:
    """A polyline (N, 3) shifted horizontally to its left [m], by one number or by (N,)."""
    heading = line_headings(line)
    normal = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=1)
    return line + np.multiply(metres, normal.T).T


def strip(line: Array, left_m: float, right_m: float) -> Array:
    """Outline (2N, 3) of the band between two offsets (left is positive) of a polyline."""
    return np.concatenate([offset_line(line, left_m), offset_line(line, right_m)[::-1]])


def resampled(line: Array, step: float) -> Array:
    """The polyline with points about every ``step`` metres."""
    length = stations(line)[-1]
    return points_at(line, np.linspace(0.0, length, max(2, round(length / step) + 1)))


# --- planning with roadgen -----------------------------------------------------------------------


class _Plan:
    """A roadgen map under construction, from a drawn road."""

    def __init__(self, spec: SceneSpec) -> None:
        self.road = spec.road
        self.rng = spec.stream("roads")
        self.map = roadgen.Map(name="Scene")
        self.lanes = _cross_section(spec.road)
        self.junctions: list[Array] = []
        main = self._main_road()
        for k, (before, after) in enumerate(itertools.pairwise(main)):
            self._junction(k, before, after)

    def _main_road(self) -> list[Any]:
        """Pieces of the main road; between two of them is a junction."""
        road, roads = self.road, []
        al = roadgen.Alignment(start=(0.0, 0.0, 0.0), heading=0.0)
        for k, length in enumerate(self._piece_lengths()):
            _lay(al, road, length, self.rng)
            roads.append(self._add(f"main{k}", al))
            al = _across(al, 2 * self.clearance)
        return roads

    def _piece_lengths(self) -> list[float]:
        first = BEHIND_M + self.road.junction_distance_m - self.clearance
        if self.road.junction == "none":
            return [BEHIND_M + AHEAD_M]
        block = float(self.rng.uniform(90.0, 180.0))
        rest = BEHIND_M + AHEAD_M - first - block - 4 * self.clearance
        if self.road.kind == "rural" or rest < 60.0:
            return [first, BEHIND_M + AHEAD_M - first - 2 * self.clearance]
        return [first, block, rest]

    @property
    def clearance(self) -> float:
        """From a junction's centre to where its arms end."""
        half = sum(lane.width for lane in self.lanes if lane.direction == "forward")
        return float(half + (8.0 if self.road.kind == "town" else 11.0))

    def _junction(self, k: int, before: Any, after: Any) -> None:
        al = self._ends[before.id]
        centre = np.array(_across(al, self.clearance).point)
        self.junctions.append(centre)
        sides = [1, -1] if self.road.junction == "cross" else [int(self.rng.choice([-1, 1]))]
        arms = [(before, "end"), (after, "start")]
        for side in sides:
            arms.append((self._side_road(f"side{k}{'lr'[side < 0]}", centre, al, side), "start"))
        junction = self.map.add_junction(f"x{k}")
        for (a, end_a), (b, end_b) in itertools.combinations(arms, 2):
            self.map.connect(a, b, junction=junction, ends=(end_a, end_b))

    def _side_road(self, name: str, centre: Array, main: Any, side: int) -> Any:
        heading = main.heading + side * np.pi / 2 + float(self.rng.uniform(-0.12, 0.12))
        start = centre + self.clearance * np.array([np.cos(heading), np.sin(heading), 0.0])
        al = roadgen.Alignment(start=tuple(start.tolist()), heading=heading)
        al.line(25.0)
        al.arc(SIDE_M - 25.0, float(self.rng.uniform(-1, 1)) / 250.0,
               rise=float(self.rng.uniform(-0.02, 0.02)) * SIDE_M)  # fmt: skip
        return self._add(name, al)

    def _add(self, name: str, al: Any) -> Any:
        road = self.map.add_road(lanes=self.lanes, alignment=al, name=name, type_=self.road.kind)
        self._ends = {**getattr(self, "_ends", {}), road.id: al}
        return road


def _lay(al: Any, road: RoadSpec, length: float, rng: np.random.Generator) -> None:
    """Appends a straight lead, clothoids and an arc, and a crest or dip to an alignment."""
    rise = road.gradient
    if road.curvature == 0.0 or length < 90.0:
        al.line(length / 2, rise=rise * length / 2)
        al.line(length / 2, rise=float(rng.uniform(-0.5, 1.0)) * rise * length / 2)
        return
    bend = road.curvature * float(rng.uniform(0.7, 1.3))
    lead, ease = 0.18 * length, min(40.0, 0.15 * length)
    arc = length - 2 * lead - 2 * ease
    al.line(lead, rise=rise * lead)
    al.spiral(ease, curvature_end=bend, rise=rise * ease)
    al.arc(arc, bend, rise=float(rng.uniform(-0.6, 0.8)) * rise * arc)
    al.spiral(ease, curvature_end=0.0)
    al.line(lead)


def _across(al: Any, length: float) -> Any:
    """A new alignment that starts ``length`` metres straight ahead of another's end, level."""
    x, y, z = al.point
    x, y = x + length * np.cos(al.heading), y + length * np.sin(al.heading)
    return roadgen.Alignment(start=(float(x), float(y), float(z)), heading=al.heading)


_MEDIAN, _PARKING, _SHOULDER, _SIDEWALK = "border", "parking", "shoulder", "sidewalk"
_KIND_OF_TYPE = {_MEDIAN: "median"}


def _cross_section(road: RoadSpec) -> list[Any]:
    """Lanes outwards from the reference line, forward side first."""
    lanes: list[Any] = []
    for direction, parking in (("forward", road.parking_right), ("backward", road.parking_left)):
        if road.kind == "motorway":
            lanes.append(roadgen.Lane(MEDIAN_M / 2, direction, type_=_MEDIAN))
        lanes += [roadgen.Lane(road.lane_width_m, direction) for _ in range(road.lanes)]
        if parking:
            lanes.append(roadgen.Lane(2.2, direction, type_=_PARKING))
        else:
            lanes.append(roadgen.Lane(road.shoulder_m, direction, type_=_SHOULDER))
        if road.pavement_m > 0.5:
            lanes.append(roadgen.Lane(road.pavement_m, direction, type_=_SIDEWALK))
    return lanes


# --- reading back --------------------------------------------------------------------------------


def _read(plan: _Plan, spec: SceneSpec) -> Network:
    surfaces = _land(plan.map, spec, LAND_MARGIN_M, rng=plan.rng)
    lanes = list(_read_lanes(plan.map, plan.lanes))
    return Network(
        lanes=lanes, surfaces=surfaces, buildings=_read_buildings(plan.map, spec),
        junctions=plan.junctions, rig_lane=lanes[0], rig_station=0.0,
    )  # fmt: skip


def _land(
    road_map: Any, spec: SceneSpec, margin: float, *, rng: np.random.Generator
) -> dict[str, Surface]:
    """Puts land and buildings around the roads of a map; returns its ground."""
    road_map.generate_land(
        relief=max(0.05, spec.road.relief_m), cell=12.0, margin=margin,
        wavelength=float(rng.uniform(120.0, 320.0)), seed=int(rng.integers(1 << 31)),
    )  # fmt: skip
    if spec.building_rules != "none":
        road_map.generate_buildings(
            rules=roadgen.building_rules(spec.building_rules), seed=int(rng.integers(1 << 31))
        )
    with tempfile.TemporaryDirectory(prefix="simgen-") as folder:
        files = road_map.export_carla(folder, name="Scene", buildings="omitted",
                                       kerb_height=KERB_M, trace=False)  # fmt: skip
        return _read_surfaces(Path(files["obj"]))


def _read_lanes(road_map: Any, cross_section: list[Any]) -> Iterable[Lane]:
    forward = [i for i, lane in enumerate(cross_section) if lane.direction == "forward"]
    for lane_id in road_map.lane_ids():
        _, *road, index = lane_id.split("/")
        in_junction = len(road) > 1
        # A connector is named after the lanes that it joins: main0_2_side0l_1 is lane 2 of main0.
        original = int(road[-1].split("_")[1]) if in_junction else int(index)
        lane = cross_section[original]
        is_forward = original in forward
        yield Lane(
            road="road/" + "/".join(road),
            kind=_KIND_OF_TYPE.get(lane.type_, lane.type_),
            side="right" if is_forward else "left",
            rank=original if is_forward else original - len(forward),
            centre=np.array(road_map.lane_centerline(lane_id)),
            width=lane.width,
            in_junction=in_junction,
        )


_SURFACE_OF_OBJECT = {
    "Road_Road": "road", "Road_Gutter": "road", "Road_Sidewalk": "sidewalk",
    "Road_Curb": "sidewalk", "Terrain_Ground": "terrain",
}  # fmt: skip


def _read_surfaces(obj_path: Path) -> dict[str, Surface]:
    """Ground triangles of roadgen's OBJ, whose (x, y, z) is our (x, z, −y).

    Read in whole columns: as Python's own numbers they would take three times the time, and leave
    holes in memory that stay.
    """
    vertices = []
    faces: dict[str, list[NDArray[np.int64]]] = {name: [] for name in SURFACES}
    for item in obj_path.read_text().split("\no ")[1:]:
        name, *lines = item.splitlines()
        vertices.append(_columns(lines, "v "))
        surface = next((s for k, s in _SURFACE_OF_OBJECT.items() if k in name), None)
        if surface is not None:
            faces[surface].append(_columns(lines, "f ").astype(np.int64) - 1)
    xyz = np.concatenate(vertices)[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    none = np.zeros((0, 3), dtype=np.int64)
    return {k: _compact(xyz, np.concatenate([none, *f])) for k, f in faces.items()}


def _columns(lines: list[str], key: str) -> Array:
    """The three numbers (N, 3) of each line that begins with ``key``."""
    text = " ".join(line[len(key) :] for line in lines if line.startswith(key))
    return np.fromstring(text, sep=" ").reshape(-1, 3)


def _compact(vertices: Array, faces: NDArray[np.int64]) -> Surface:
    used, inverse = np.unique(faces, return_inverse=True)
    v, f = vertices[used], inverse.reshape(-1, 3)
    normal_z = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])[:, 2]
    return Surface(v, np.where((normal_z < 0)[:, None], f[:, ::-1], f))


def _read_buildings(road_map: Any, spec: SceneSpec) -> list[list[Massing]]:
    rng = spec.stream("lots")
    return [
        _massings(road_map, building)
        for building in road_map.building_ids()
        if rng.random() < spec.building_keep
    ]  # fmt: skip


def _massings(road_map: Any, building: str) -> list[Massing]:
    """The parts of a building; its foundation is part of its walls."""
    parts = [p for p in road_map.building_parts(building)
             if road_map.building_part_kind(p) != "foundation"]  # fmt: skip
    ground_z = min(road_map.building_part_shape(p)[0] for p in parts)
    return [_massing(road_map, building, p, ground_z) for p in parts]


def _massing(road_map: Any, building: str, part: str, ground_z: float) -> Massing:
    ring = np.array(road_map.building_footprint(part))
    base_z, wall_height, roof, roof_height, ridge_rad, _levels = road_map.building_part_shape(part)
    footprint = ring[:, :2] if _area(ring) > 0 else ring[::-1, :2]
    frontage = road_map.building_frontage(building)
    return Massing(
        footprint=footprint, base_z=base_z, wall_height=wall_height, roof=roof,
        roof_height=roof_height, ridge_rad=ridge_rad,
        kind=road_map.building_part_kind(part) or road_map.building_kind(building),
        front=_front_wall(footprint, road_map, frontage),
        on_ground=base_z - ground_z < 0.5,
    )  # fmt: skip


def _area(ring: Array) -> float:
    x, y = ring[:, 0], ring[:, 1]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _front_wall(footprint: Array, road_map: Any, frontage: tuple[str, str, float] | None) -> int:
    """The wall whose middle lies next to the road that the building faces."""
    if frontage is None:
        return 0
    road_id = frontage[0].removeprefix("road/")
    line = np.array(road_map.lane_centerline(f"lane/{road_id}/0"))[:, :2]
    middle = 0.5 * (footprint + np.roll(footprint, -1, axis=0))
    distance = np.linalg.norm(middle[:, None] - resampled_2d(line)[None], axis=2).min(axis=1)
    return int(np.argmin(distance))


def resampled_2d(line: Array) -> Array:
    """A planar polyline (N, 2) with a point about every 2 m."""
    return resampled(np.column_stack([line, np.zeros(len(line))]), 2.0)[:, :2]


# --- a map that somebody else drew ---------------------------------------------------------------

REACH_M = 650.0
"""Roads that come no nearer to the rig are left out."""
MAX_LAND_M2 = 100e6
"""of the box around the others and their land, which takes half a minute"""


def _read_given(data: bytes, spec: SceneSpec, drive_m: float) -> Network:
    """The part of an OpenDRIVE map around a place drawn for the rig."""
    starts = given_map.starts(data, drive_m)
    start, station = _choose_start(starts, spec, rng=spec.stream("rig lane"))
    origin = points_at(start.centre, station) * [1.0, 1.0, 0.0]
    near = {x.road for x in given_map.all_strips(data) if _reaches(x.centre, origin)}
    _require_small([x.centre for x in given_map.all_strips(data) if x.road in near])
    roads = [alignment.moved(r, origin) for r in opendrive.read(data) if r.id in near]
    road_map = _parsed(given_map.canonical(data, near, origin, spec.road.kind))
    surfaces = _land(road_map, spec, GIVEN_LAND_MARGIN_M, rng=spec.stream("roads"))
    lanes = [_given_lane(strip) for road in roads for strip in alignment.strips(road)]
    rig_lane = replace(_given_lane(start.strip), centre=start.centre - origin, widening=0.0)
    return Network(
        lanes=lanes, surfaces=surfaces, buildings=_read_buildings(road_map, spec), junctions=[],
        rig_lane=rig_lane, rig_station=station,
        given=Given([line for road in roads if road.junction == "-1"
                     for line in alignment.lines(road)],
                    [thing for road in roads for thing in alignment.things(road)]),
    )  # fmt: skip


def _choose_start(
    starts: Sequence[given_map.Start], spec: SceneSpec, *, rng: np.random.Generator
) -> tuple[given_map.Start, float]:
    """A place anywhere on the map's driving lanes, and its station."""
    if spec.rig_lane == "right":
        outermost: dict[tuple[str, int, bool], given_map.Start] = {}
        for start in sorted(starts, key=lambda x: abs(x.strip.number)):
            strip = start.strip
            outermost[strip.road, strip.section, strip.number > 0] = start
        starts = list(outermost.values())
    usable = np.array([x.usable_m for x in starts])
    start = starts[rng.choice(len(starts), p=usable / usable.sum())]
    return start, float(rng.uniform(0.0, start.usable_m))


def _reaches(line: Array, xyz: Array) -> bool:
    return bool(np.linalg.norm(line[:, :2] - xyz[:2], axis=1).min() < REACH_M)


def _require_small(lines: Sequence[Array]) -> None:
    points = np.concatenate(lines)[:, :2]
    x, y = points.max(axis=0) - points.min(axis=0) + 2 * GIVEN_LAND_MARGIN_M
    if x * y > MAX_LAND_M2:
        raise RuntimeError(
            f"the roads that pass the rig, with their land, fill {x / 1000:.1f} km × "
            f"{y / 1000:.1f} km; expected at most {MAX_LAND_M2 / 1e6:g} km²: split long roads"
        )


def _parsed(text: str) -> Any:
    with tempfile.TemporaryDirectory(prefix="simgen-") as folder:
        path = Path(folder) / "near.xodr"
        path.write_text(text, encoding="utf-8")
        try:
            return roadgen.read_opendrive(str(path), sampling=alignment.STEP_M)
        except ValueError as error:
            reason = str(error).splitlines()[0]
            # Of this part of a map, maybe not of another: the frame is drawn again elsewhere.
            raise RuntimeError(f"no surfaces can be made of the map's roads: {reason}") from error


def _given_lane(strip: alignment.Strip) -> Lane:
    width = float(strip.widths.mean())
    return Lane(
        road=f"road/{strip.road}/{strip.section}",
        kind=strip.kind,
        side="left" if strip.number > 0 else "right",
        rank=abs(strip.number) - 1,
        centre=strip.centre,
        width=width,
        in_junction=strip.junction != "-1",
        widening=strip.widths - width,
    )


# --- the rig's place -----------------------------------------------------------------------------


def _choose_rig_lane(
    network: Network, spec: SceneSpec, *, rng: np.random.Generator
) -> tuple[Lane, float]:
    """A forward driving lane of the first piece of the main road, BEHIND_M from its start."""
    candidates = sorted(
        (x for x in network.driving if x.road.startswith("road/main0") and x.side == "right"),
        key=lambda x: x.rank,
    )
    lane = candidates[-1] if spec.rig_lane == "right" else candidates[rng.integers(len(candidates))]
    return lane, min(BEHIND_M, stations(lane.centre)[-1] - 10.0)


def _moved(network: Network) -> Network:
    """The network moved and turned about z so that the rig's place is the origin, heading +x."""
    point, heading = at_station(network.rig_lane.centre, network.rig_station)
    c, s = np.cos(-heading), np.sin(-heading)
    R = np.array([[c, -s], [s, c]])

    def move(p: Array) -> Array:
        return np.column_stack([(p[:, :2] - point[:2]) @ R.T, p[:, 2] - point[2]])

    def move_massing(m: Massing) -> Massing:
        footprint = (m.footprint - point[:2]) @ R.T
        return replace(m, footprint=footprint, base_z=m.base_z - point[2],
                       ridge_rad=m.ridge_rad - float(heading))  # fmt: skip

    def move_lane(lane: Lane) -> Lane:
        return replace(lane, centre=move(lane.centre))

    def move_given(given: Given) -> Given:
        return Given(
            [replace(x, points=move(x.points)) for x in given.lines],
            [replace(x, xyz=move(x.xyz[None])[0], heading=x.heading - float(heading),
                     outline=(x.outline - point[:2]) @ R.T) for x in given.things],
        )  # fmt: skip

    return replace(
        network,
        lanes=[move_lane(lane) for lane in network.lanes],
        surfaces={k: Surface(move(v.vertices), v.faces) for k, v in network.surfaces.items()},
        buildings=[[move_massing(m) for m in parts] for parts in network.buildings],
        junctions=[move(j[None])[0] for j in network.junctions],
        rig_lane=move_lane(network.rig_lane),
        given=network.given and move_given(network.given),
    )
