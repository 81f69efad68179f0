"""Street furniture along the road: lamps, signals, signs, rails, poles, fences and small things.

Traffic drives on the right, and lanes run in the direction of travel: the outside of a road is on
the right of its outermost lane.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from simgen import alignment, barriers, furniture, pavement, terraces, vegetation
from simgen.geometry import Array
from simgen.layout import Layout, Placed, along, edges, sunk
from simgen.mesh import Model
from simgen.recipe import RoadSpec
from simgen.roads import Lane, at_station, is_main, offset_line, points_at, resampled, stations


def _kerbside(lane: Lane) -> float:
    """How far left of the outer edge furniture stands: on the pavement by the kerb, or behind."""
    return lane.width - 0.5 if lane.kind == "sidewalk" else -1.5


def _stands(layout: Layout, model: Model, xy: Array, heading: float, radius: float = 0.35) -> Model:
    """The thing on the ground, if its place is free."""
    if not layout.site.claim([(*xy[:2], radius)]):
        return []
    return sunk(layout.stand(model, xy, heading), 0.03)


# --- lights and signs ----------------------------------------------------------------------------


def lamps(layout: Layout) -> Placed:
    """Street lamps at equal distances, arms over the road; those of a street are of one kind."""
    rng = layout.spec.stream("lamps")
    if not layout.spec.lamps:
        return
    median = _median(layout)
    designs = _lamp_designs(layout.spec.road, median is not None)
    design = designs[rng.integers(len(designs))]
    lamp = furniture.street_lamp(design, rng=rng)
    if design == "double" and median is not None:
        lines = [(median.offset(median.width / 2), BESIDE_BARRIER_M)]
    else:
        lines = [(line, _kerbside(lane)) for lane, line in edges(layout)
                 if lane.side == "right" or layout.spec.road.lanes > 1]  # fmt: skip
    for line, offset in lines:
        for point, heading in along(layout, line, layout.spec.lamp_spacing_m, rng, offset):
            if not layout.open_above(point):
                continue
            model = _stands(layout, lamp, point, heading + np.pi / 2)
            if model:
                layout.lights.append(furniture.lamp_heads(model))
            yield model


BESIDE_BARRIER_M = 0.7
"""from the middle of a motorway to the masts between its carriageways"""


def _lamp_designs(road: RoadSpec, has_median: bool) -> list[str]:
    """The LAMPS that light such a road: low globes narrow streets, double arms a median."""
    low = ["globe"] if road.kind == "town" and road.lanes == 1 else []
    return ["curved", "straight", *low, *(["double"] if has_median else [])]


def _median(layout: Layout) -> Lane | None:
    """The right half of a motorway's median, its left side in the middle of the road."""
    return next((x for x in layout.lanes if (x.kind, x.side) == ("median", "right")), None)


_Phase = tuple[str, str]
"""The lit lenses along one street of a junction and across it."""
_PHASES: tuple[_Phase, ...] = (
    ("green", "red"), ("red", "green"), ("green", "red"), ("red", "green"),
    ("amber", "red"), ("red", "amber"), ("red", "red"),
)  # fmt: skip


def _phase(rng: np.random.Generator) -> _Phase:
    return _PHASES[rng.integers(len(_PHASES))]


def signals(layout: Layout) -> Placed:
    """Signals at the stop lines of town crossings, or where a given map has them."""
    rng = layout.spec.stream("signals")
    given = layout.site.network.given
    if given is not None:
        yield from _given_signals(layout, given.things, rng)
        return
    if layout.spec.road.kind != "town" or layout.spec.road.junction != "cross":
        return
    for junction in layout.site.network.junctions:
        phase = _phase(rng)
        for lane, line in edges(layout):
            if _leads_to(line, junction) and rng.random() < 0.85:
                point, heading = _before_end(line, _kerbside(lane), 4.0)
                reach = 0.0 if layout.spec.trolley_wires else float(rng.choice([0.0, 4.5]))
                state = phase[not is_main(lane)]
                model = furniture.traffic_signal(state, rng=rng, reach_m=reach)
                yield _stands(layout, model, point, heading + np.pi)


def _leads_to(line: Array, junction: Array) -> bool:
    return bool(np.linalg.norm(line[-1, :2] - junction[:2]) < 30.0)


def _before_end(line: Array, offset: float, metres: float) -> tuple[Array, float]:
    """A point beside a line, ``metres`` before its end, and the heading there."""
    beside = offset_line(line, offset)
    point, heading = at_station(beside, stations(line)[-1] - metres)
    return point, float(heading)


_LIGHTS = ("1000001", "1000009", "1000010", "1000011", "1000012")
"""signal types of lights for vehicles"""
_PLATES = {"101": "warning", "205": "yield", "206": "stop", "209": "ahead_only",
           "215": "roundabout", "222": "keep_right", "267": "no_entry", "283": "no_parking",
           "301": "priority", "306": "priority", "350": "crossing", "625": "chevron"}  # fmt: skip
"""signs by their German numbers, which maps use for all countries"""
SAME_JUNCTION_M = 60.0


def _given_signals(
    layout: Layout, things: Sequence[alignment.Placed], rng: np.random.Generator
) -> Placed:
    """Lights and signs beside the road; those over it hang from what the map does not tell."""
    phases: list[tuple[alignment.Placed, _Phase]] = []
    for thing in things:
        usable = thing.tag == "signal" and layout.in_view(thing.xyz)
        if not usable or not layout.site.clear_of(thing.xyz[:2], road=0.0, pavement=-1,
                                                  buildings=0.1)[0]:  # fmt: skip
            continue
        facing = thing.heading + np.pi
        plate = f"limit_{thing.value}" if thing.type == "274" else _PLATES.get(thing.type, "")
        if thing.type in _LIGHTS:
            signal = furniture.traffic_signal(_state(thing, phases, rng), rng=rng, reach_m=0.0)
            yield _stands(layout, signal, thing.xyz, facing)
        elif plate in layout.sign_rects:
            sign = furniture.traffic_sign(layout.sign_rects, plate, rng=rng)
            yield _stands(layout, sign, thing.xyz, facing)


def _state(
    light: alignment.Placed,
    phases: list[tuple[alignment.Placed, _Phase]],
    rng: np.random.Generator,
) -> str:
    """What a light shows: that of its junction's first light, or the other street's."""
    for first, phase in phases:
        if np.linalg.norm(light.xyz - first.xyz) < SAME_JUNCTION_M:
            across = abs(np.cos(light.heading - first.heading)) < np.sqrt(0.5)
            return phase[int(across)]
    phases.append((light, _phase(rng)))
    return phases[-1][1][0]


_ANYWHERE = {
    "town": ("limit_30", "limit_40", "limit_50", "no_parking", "crossing", "warning"),
    "rural": ("limit_60", "limit_70", "limit_80", "limit_90", "limit_100", "warning"),
    "motorway": ("limit_80", "limit_100", "limit_110", "limit_120", "warning"),
}
"""Signs by kind of road; junctions and curves have their own."""


def signs(layout: Layout) -> Placed:
    """Traffic signs on the right; street names in town, and now and then a billboard.

    On a map that somebody else drew, traffic signs are the map's.
    """
    rng = layout.spec.stream("traffic signs")
    if layout.spec.signs_per_100m <= 0:
        return
    given = layout.site.network.given is not None
    if not given:
        yield from _signs_at_junctions(layout, rng)
        yield from _signs_in_curves(layout, rng)
    kind = layout.spec.road.kind
    spacing = 100.0 / layout.spec.signs_per_100m
    for lane, line in edges(layout):
        for point, heading in along(layout, line, spacing, rng, _kerbside(lane)):
            choice = rng.random()
            if choice < 0.07:
                yield _billboard(layout, point, heading, rng)
            elif choice < 0.17 and kind == "town":
                post = furniture.street_name_post(layout.sign_rects, rng=rng)
                yield _stands(layout, post, point, heading + np.pi + float(rng.normal(0, 0.06)))
            elif not given:
                name = _ANYWHERE[kind][rng.integers(len(_ANYWHERE[kind]))]
                yield _sign(layout, [name], point, heading, rng)


def _sign(
    layout: Layout, names: Sequence[str], point: Array, heading: float, rng: np.random.Generator
) -> Model:
    """Signs on one pole, for those who head there."""
    sign = furniture.traffic_sign(layout.sign_rects, *names, rng=rng)
    return _stands(layout, sign, point, heading + np.pi + float(rng.normal(0, 0.06)))


def _signs_at_junctions(layout: Layout, rng: np.random.Generator) -> Placed:
    """The main road has priority, and some of it leads straight on only; side roads give way."""
    for lane, line in edges(layout):
        if any(_leads_to(line, j) for j in layout.site.network.junctions):
            ahead_only = ["ahead_only"] if rng.random() < 0.25 else []
            gives_way = "stop" if rng.random() < 0.4 else "yield"
            names = ["priority", *ahead_only] if is_main(lane) else [gives_way]
            point, heading = _before_end(line, _kerbside(lane), 9.0)
            if layout.in_view(point):
                yield _sign(layout, names, point, heading, rng)


SHARP_PER_M = 1 / 300
"""Curves from this curvature on are signed."""
CHEVRONS_M = 14.0
WARNED_M = 45.0
"""A sign stands this far before the curve that it warns of."""


def _signs_in_curves(layout: Layout, rng: np.random.Generator) -> Placed:
    """Before a sharp curve a warning, and along the outside of one to the left, chevrons."""
    for lane, line in edges(layout):
        kerb = offset_line(line, _kerbside(lane))
        for start, end, to_the_left in sharp_curves(kerb):
            point, heading = at_station(kerb, max(start - WARNED_M, 2.0))
            name = "curve_left" if to_the_left else "warning"
            if layout.in_view(point):
                yield _sign(layout, [name], point, float(heading), rng)
            for s in np.arange(start, end, CHEVRONS_M) if to_the_left else ():
                point, heading = at_station(kerb, float(s))
                if layout.in_view(point):
                    yield _sign(layout, ["chevron"], point, float(heading), rng)


def sharp_curves(line: Array) -> Iterator[tuple[float, float, bool]]:
    """Stretches of a line from SHARP_PER_M on: (start, end) [m], and whether it bends left."""
    step = 8.0
    s = np.arange(0.0, stations(line)[-1], step)
    _, heading = at_station(line, s)
    bend = np.gradient(heading, step) if len(s) > 1 else 0 * s
    for sign in (1, -1):
        sharp = np.concatenate([[0], (sign * bend > SHARP_PER_M).astype(int), [0]])
        change = np.diff(sharp)
        for k, end in zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1), strict=True):
            if end - k > 2:
                yield float(s[k]), float(s[end - 1]), sign > 0


def _billboard(layout: Layout, point: Array, heading: float, rng: np.random.Generator) -> Model:
    to_the_right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    place = point + 6.0 * to_the_right
    free = layout.site.clear_of(place[:2], road=2.0, pavement=0.5, buildings=2.5)[0]
    if not free or not layout.open_above(place, 5.0):
        return []
    model = furniture.billboard(layout.sign_rects, rng=rng)
    return _stands(layout, model, place, heading + np.pi - 0.35, radius=2.0)


GANTRY_AHEAD_M = (50.0, 160.0)
BEYOND_ROAD_M = 1.5
"""from the paved ground to the legs of a gantry: behind the guard rails"""


def gantry(layout: Layout) -> Placed:
    """A gantry with direction boards across both carriageways of a motorway."""
    rng = layout.spec.stream("gantry")
    median = _median(layout)
    if not layout.spec.gantry or median is None or layout.site.network.given is not None:
        return
    middle = resampled(median.offset(median.width / 2), 2.0)
    half = max(_half_width(layout, median.road, side) for side in ("left", "right"))
    half += BEYOND_ROAD_M
    rig = stations(middle)[np.linalg.norm(middle[:, :2] - layout.rig_xy, axis=1).argmin()]
    for ahead in rng.uniform(*GANTRY_AHEAD_M, 8):
        point, heading = at_station(middle, rig + ahead)
        left = np.array([-np.sin(heading), np.cos(heading)])
        feet = point[:2] + np.array([[half + 0.2], [-half - 0.2]]) * left
        free = layout.site.clear_of(feet, road=1.0, pavement=0.3, buildings=0.5).all()
        if (
            free
            and layout.open_above(point, 20.0)
            and layout.site.claim(np.column_stack([feet, [0.4, 0.4]]))
        ):
            model = furniture.gantry(layout.sign_rects, 2 * half, rng=rng)
            yield layout.stand(model, point, float(heading) + np.pi, z=float(point[2]))
            return


def _half_width(layout: Layout, road: str, side: str) -> float:
    """From the reference line of a road to its outer edge on one side [m]."""
    return sum(x.width for x in layout.lanes if (x.road, x.side) == (road, side))


# --- along the edge ------------------------------------------------------------------------------


def rails(layout: Layout) -> Placed:
    """Guard rails outside, and a barrier between the carriageways of a motorway."""
    rng = layout.spec.stream("rails")
    if layout.spec.guard_rail:
        for _, line in edges(layout):
            if layout.spec.road.kind == "motorway" or rng.random() < 0.5:
                for run in _runs(layout, line, -0.7):
                    yield [barriers.guard_rail(run, rng=rng)]
    build = barriers.concrete_barrier if rng.random() < 0.5 else barriers.guard_rail
    for lane in layout.lanes:
        if lane.kind == "median" and lane.side == "right":
            for run in _runs(layout, lane.offset(lane.width / 2), -0.3):
                yield [build(run[::-1], rng=rng)]


def noise_walls(layout: Layout) -> Placed:
    """Walls against noise behind the guard rails, on one side or both, with gaps."""
    rng = layout.spec.stream("noise walls")
    if not layout.spec.noise_wall:
        return
    height = float(rng.uniform(2.5, 5.0))
    for lane, line in edges(layout):
        if lane.side == "left" and rng.random() < 0.5:
            continue
        for run in _runs(layout, line, -4.2, claimed_m=0.4):
            yield [barriers.noise_wall(run, rng=rng, height_m=height)]


def _runs(layout: Layout, line: Array, offset: float, claimed_m: float = 0.0) -> Iterator[Array]:
    """The stretches (N, 3) of a line beside the road that are in view and on the ground.

    With ``claimed_m`` they take that radius of ground, and end where something else stands.
    """
    shifted = resampled(offset_line(line, offset), 2.0)
    on_ground = np.column_stack([shifted[:, :2], layout.site.height(shifted[:, :2])])
    usable = ~np.isnan(on_ground[:, 2]) & [layout.in_view(p) for p in on_ground]
    if claimed_m:
        free = [layout.site.claim([(x, y, claimed_m)]) for x, y, _ in on_ground[usable]]
        usable[usable] = free
    change = np.diff(np.concatenate([[0], usable.astype(int), [0]]))
    for start, end in zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1), strict=True):
        if end - start > 7:  # shorter ones would be all sloping ends
            yield on_ground[start:end]


def utility_poles(layout: Layout) -> Placed:
    """Wooden poles with wires along one side."""
    rng = layout.spec.stream("utility poles")
    if not layout.spec.utility_poles or layout.crossing is not None:
        return
    _, line = next(edges(layout))
    bases = []
    for point, _ in along(layout, line, float(rng.uniform(32, 45)), rng, -2.6):
        ground = float(layout.site.height(point[:2])[0])
        free = layout.site.clear_of(point[:2], road=0.8, pavement=0.2, buildings=1.0)[0]
        if free and not np.isnan(ground) and layout.site.claim([(*point[:2], 0.35)]):
            bases.append([*point[:2], ground])
    if len(bases) > 1:
        poles = np.array(bases)
        layout.wires.append(furniture.spans(poles))
        yield furniture.utility_line(poles, rng=rng)


_RADIUS_M = {
    "bus_shelter": 2.2, "bench": 1.0, "advertising_column": 0.8, "planter": 0.7, "cafe_table": 1.1,
    "market_stall": 1.5, "shop_board": 0.4, "bicycle_rack": 1.4, "parcel_locker": 1.3,
    "flower_bed": 1.0,
}  # fmt: skip
_PRINTED = {
    "bus_shelter": furniture.bus_shelter,
    "advertising_column": furniture.advertising_column,
    "market_stall": terraces.market_stall,
    "shop_board": terraces.shop_board,
}
"""Small things that show cells of the sign atlas."""
UNIQUE_WITHIN_M = 40.0
"""Nearer to the rig every small thing is built for its place; farther ones are seen again."""
_SHOPPING_STREETS = ("town", "downtown")


def small_things(layout: Layout) -> Placed:
    """Bins, benches, bollards and the like on pavements; posts along open roads."""
    rng = layout.spec.stream("small things")
    if layout.spec.road.kind != "town":
        yield from _posts(layout, rng)
        return
    if layout.spec.small_per_100m <= 0:
        return
    kinds = [*pavement.CLUTTER, "bus_shelter", "parking_meter", "flower_bed"]
    if layout.spec.building_rules in _SHOPPING_STREETS:
        kinds += [*terraces.TERRACE, "cafe_table", "advertising_column", "market_stall",
                  "shop_board"]  # fmt: skip
    stock: dict[str, Model] = {}
    for lane, line in edges(layout):
        if lane.kind != "sidewalk":
            continue
        for point, heading in along(layout, line, 100.0 / layout.spec.small_per_100m, rng):
            kind = kinds[rng.integers(len(kinds))]
            radius = _RADIUS_M.get(kind, 0.35)
            at_the_back = min(radius, lane.width / 2) + 0.1
            by_the_kerb = lane.width - radius - 0.15
            inward = at_the_back if radius > 0.5 or rng.random() < 0.5 else by_the_kerb
            left = np.array([-np.sin(heading), np.cos(heading), 0.0])
            near = layout.distance(point[:2])[0] < UNIQUE_WITHIN_M
            model = None if near else stock.get(kind)
            if model is None:
                model = stock[kind] = _small(layout, kind, rng)
            yield _stands(layout, model, point + inward * left, heading + np.pi / 2, radius)


def _small(layout: Layout, kind: str, rng: np.random.Generator) -> Model:
    if kind in _PRINTED:
        return _PRINTED[kind](layout.sign_rects, rng=rng)
    return (pavement.CLUTTER | terraces.TERRACE)[kind](rng=rng)


def _posts(layout: Layout, rng: np.random.Generator) -> Placed:
    """Reflectors every 50 m, kilometres every 500 m."""
    for _, line in edges(layout):
        for point, heading in along(layout, line, 50.0, rng, -0.5):
            yield _stands(layout, furniture.delineator(rng=rng), point, heading + np.pi)
        for point, heading in along(layout, line, 500.0, rng, -0.9):
            post = furniture.kilometre_post(layout.sign_rects, rng=rng)
            yield _stands(layout, post, point, heading + np.pi)


# --- between road and land -----------------------------------------------------------------------


def frontage(layout: Layout) -> Placed:
    """Hedges and fences between the road and the gardens or fields, with gaps."""
    rng = layout.spec.stream("frontage")
    kinds = list(barriers.FENCES)
    for lane, line in edges(layout):
        kind = kinds[rng.integers(len(kinds))]
        behind = -0.6 if lane.kind == "sidewalk" else -3.2
        for stretch in _stretches(layout, line, behind, rng):
            chance = rng.random()
            if chance < layout.spec.hedges:
                yield _hedge(layout, stretch, rng)
            elif chance < layout.spec.hedges + layout.spec.fences:
                yield [barriers.fence(kind, stretch, rng=rng)]


FRONTAGE_AHEAD_M = 140.0
"""Further away, fences and hedges are not worth their triangles."""


def _stretches(
    layout: Layout, line: Array, offset: float, rng: np.random.Generator
) -> Iterator[Array]:
    """Stretches (9, 3) of 6 to 16 m that meet no road, house or anything placed before."""
    shifted = offset_line(line, offset)
    length = stations(shifted)[-1]
    s = float(rng.uniform(0, 5))
    while s < length - 4.0:
        span = float(rng.uniform(6.0, 16.0))
        xy = points_at(shifted, np.linspace(s, min(length, s + span), 9))[:, :2]
        s += span + (float(rng.uniform(3.0, 5.0)) if rng.random() < 0.3 else 0.0)
        far = layout.distance(xy.mean(axis=0))[0] > FRONTAGE_AHEAD_M
        if far or not layout.in_view(xy.mean(axis=0)):
            continue
        z = layout.site.height(xy)
        free = layout.site.clear_of(xy, road=0.25, pavement=0.12, buildings=0.9).all()
        discs = np.column_stack([xy, np.full(len(xy), 0.3)])
        if free and not np.isnan(z).any() and layout.site.claim(discs):
            yield np.column_stack([xy, z])


def _hedge(layout: Layout, stretch: Array, rng: np.random.Generator) -> Model:
    """A straight hedge from the first to the last point of a stretch."""
    chord = stretch[-1, :2] - stretch[0, :2]
    middle, heading = stretch.mean(axis=0), float(np.arctan2(chord[1], chord[0]))
    eyes = layout.close_eyes(stretch, heading)
    model = vegetation.hedge(
        float(np.linalg.norm(chord)), float(rng.uniform(0.9, 2.0)), float(rng.uniform(0.5, 0.9)),
        rng=rng, lod=layout.lod(middle, 18.0, 55.0), eyes=eyes,
    )  # fmt: skip
    layout.spend_close(model, eyes)
    return sunk(layout.stand(model, middle, heading, z=float(stretch[:, 2].min())), 0.05)
