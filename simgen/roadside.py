"""Street furniture along the road: lamps, signals, signs, rails, poles, fences and small things.

Traffic drives on the right, and lanes run in the direction of travel: the outside of a road is on
the right of its outermost lane.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from simgen import furniture, vegetation
from simgen.furniture import Furniture
from simgen.geometry import Array
from simgen.layout import Layout, Placed, along, edges, sunk
from simgen.mesh import Model
from simgen.roads import Lane, at_station, offset_line, resampled, stations

MAX_RAIL_M = 40.0
"""Rails, walls and fences are cut into pieces of this length, so that each can be left out."""


def _kerbside(lane: Lane) -> float:
    """How far left of the outer edge furniture stands: on the pavement by the kerb, or behind."""
    return lane.width - 0.5 if lane.kind == "sidewalk" else -1.5


def _stands(
    layout: Layout, made: Furniture, xy: Array, heading: float, radius: float = 0.35
) -> Model:
    """The thing on the ground, if its place is free; its lights are noted for the night."""
    if not layout.site.claim([(*xy[:2], radius)]):
        return []
    model = sunk(layout.stand(made.model, xy, heading), 0.03)
    if model and len(made.lights):
        c, s = np.cos(heading), np.sin(heading)
        turned = made.lights @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        ground = float(layout.site.height(xy[:2])[0])
        layout.lights.append(turned + [xy[0], xy[1], ground])
    return model


# --- lights and signs ----------------------------------------------------------------------------


def lamps(layout: Layout) -> Placed:
    """Street lamps at equal distances, arms over the road."""
    rng = layout.spec.stream("lamps")
    if not layout.spec.lamps:
        return
    height, arm = float(rng.uniform(6.0, 10.0)), float(rng.uniform(0.8, 2.4))
    style = int(rng.integers(1 << 31))  # all lamps of a street are of one kind
    for lane, line in edges(layout):
        if lane.side == "left" and layout.spec.road.lanes == 1:
            continue
        for point, heading in along(layout, line, layout.spec.lamp_spacing_m, rng, _kerbside(lane)):
            made = furniture.street_lamp(height, arm, rng=np.random.default_rng(style))
            yield _stands(layout, made, point, heading + np.pi / 2)


def signals(layout: Layout) -> Placed:
    """Signals at the stop lines of town crossings."""
    rng = layout.spec.stream("signals")
    if layout.spec.road.kind != "town" or layout.spec.road.junction != "cross":
        return
    for lane, line in edges(layout):
        for junction in layout.site.network.junctions:
            if np.linalg.norm(line[-1, :2] - junction[:2]) < 30.0 and rng.random() < 0.85:
                length = stations(line)[-1]
                point, heading = at_station(offset_line(line, _kerbside(lane)), length - 4.0)
                mast = float(rng.choice([0.0, 4.5]))
                made = furniture.traffic_signal(rng=rng, mast_m=mast)
                yield _stands(layout, made, point, float(heading) + np.pi)


_TOWN_SIGNS = ("limit_30", "limit_50", "no_parking", "priority", "crossing", "no_entry", "yield")
_ROAD_SIGNS = ("limit_70", "limit_80", "limit_100", "curve_left", "warning", "priority")
_MOTORWAY_SIGNS = ("limit_100", "limit_120", "board_0", "board_1", "warning")


def signs(layout: Layout) -> Placed:
    """Traffic signs on the right, street names at corners, now and then a billboard."""
    rng = layout.spec.stream("traffic signs")
    if layout.spec.signs_per_100m <= 0:
        return
    names = {"town": _TOWN_SIGNS, "rural": _ROAD_SIGNS, "motorway": _MOTORWAY_SIGNS}
    known = [n for n in names[layout.spec.road.kind] if n in layout.sign_rects]
    for lane, line in edges(layout):
        for point, heading in along(layout, line, 100.0 / layout.spec.signs_per_100m, rng,
                                    _kerbside(lane)):  # fmt: skip
            if rng.random() < 0.06:
                yield _billboard(layout, point, heading, rng)
            else:
                name = known[rng.integers(len(known))]
                made = furniture.traffic_sign(layout.sign_rects, name, rng=rng)
                yield _stands(layout, made, point, heading + np.pi + float(rng.normal(0, 0.06)))


def _billboard(layout: Layout, point: Array, heading: float, rng: np.random.Generator) -> Model:
    back = np.array([np.sin(heading), -np.cos(heading), 0.0]) * 6.0  # right of the edge
    place = point + back
    if not layout.site.clear_of(place[:2], road=2.0, pavement=0.5, buildings=2.5)[0]:
        return []
    made = furniture.billboard(layout.sign_rects, rng=rng)
    return _stands(layout, made, place, heading + np.pi - 0.35, radius=2.0)


def gantry(layout: Layout) -> Placed:
    """A gantry with direction boards across a motorway."""
    rng = layout.spec.stream("gantry")
    if not layout.spec.gantry:
        return
    lane = layout.site.network.rig_lane
    point, heading = at_station(lane.centre, layout.site.network.rig_station
                                + float(rng.uniform(50.0, 160.0)))  # fmt: skip
    width = 2 * (layout.spec.road.lanes * layout.spec.road.lane_width_m + 5.0)
    made = furniture.gantry(width, layout.sign_rects, rng=rng)
    yield layout.stand(made.model, _middle_of_road(layout, point), float(heading) + np.pi)


def _middle_of_road(layout: Layout, point: Array) -> Array:
    """The nearest point of the line between the carriageways."""
    medians = [lane.centre for lane in layout.lanes if lane.kind == "median"]
    line = np.concatenate(medians) if medians else point[None]
    nearest = line[np.argmin(np.linalg.norm(line[:, :2] - point[:2], axis=1))]
    return np.append(nearest[:2], point[2])


# --- along the edge ------------------------------------------------------------------------------


def rails(layout: Layout) -> Placed:
    """Guard rails outside, and a barrier between the carriageways of a motorway."""
    rng = layout.spec.stream("rails")
    if layout.spec.guard_rail:
        for lane, line in edges(layout):
            if layout.spec.road.kind == "motorway" or rng.random() < 0.5:
                for piece in _pieces(layout, line, -0.7):
                    yield furniture.guard_rail(piece, rng=rng)
    concrete = rng.random() < 0.5
    for lane in layout.lanes:
        if lane.kind == "median" and lane.side == "right":
            for piece in _pieces(layout, lane.offset(lane.width / 2), -0.3):
                yield (
                    furniture.concrete_barrier(piece)
                    if concrete
                    else furniture.guard_rail(piece[::-1], rng=rng)
                )


def _pieces(layout: Layout, line: Array, offset: float) -> Iterator[Array]:
    """A line beside the road, on the ground, cut into pieces in view."""
    shifted = resampled(offset_line(line, offset), 2.0)
    z = layout.site.height(shifted[:, :2])
    on_ground = np.column_stack([shifted[:, :2], z])
    step = int(MAX_RAIL_M / 2.0)
    for i in range(0, len(on_ground) - 1, step):
        piece = on_ground[i : i + step + 1]
        if len(piece) > 1 and not np.isnan(piece).any() and layout.in_view(piece.mean(axis=0)):
            yield piece


def utility_poles(layout: Layout) -> Placed:
    """Wooden poles with wires along one side."""
    rng = layout.spec.stream("utility poles")
    if not layout.spec.utility_poles:
        return
    height = float(rng.uniform(7.5, 9.5))
    _, line = next(edges(layout))
    tops = []
    for point, heading in along(layout, line, float(rng.uniform(32, 45)), rng, -2.6):
        if layout.site.clear_of(point[:2], road=0.8, pavement=0.2, buildings=1.0)[0]:
            yield _stands(layout, furniture.utility_pole(height, rng=rng), point, heading)
            tops.append([*point[:2], float(layout.site.height(point[:2])[0]) + height - 0.4])
    if len(tops) > 1:
        yield [furniture.wires(np.array(tops))]


_SMALL_TOWN = ("bollard", "bin", "bench", "hydrant", "cabinet", "post_box", "planter",
               "bus_shelter", "advertising_column", "cone")  # fmt: skip
_SMALL_RADIUS = {"bus_shelter": 2.2, "bench": 1.0, "advertising_column": 0.8, "planter": 0.7}


def small_things(layout: Layout) -> Placed:
    """Bins, benches, bollards and the like on pavements; reflector posts on open roads."""
    rng = layout.spec.stream("small things")
    if layout.spec.road.kind != "town":
        yield from _delineators(layout, rng)
        return
    if layout.spec.small_per_100m <= 0:
        return
    for lane, line in edges(layout):
        if lane.kind != "sidewalk":
            continue
        for point, heading in along(layout, line, 100.0 / layout.spec.small_per_100m, rng):
            kind = _SMALL_TOWN[rng.integers(len(_SMALL_TOWN))]
            radius = _SMALL_RADIUS.get(kind, 0.35)
            inward = (radius + 0.2) if rng.random() < 0.5 else lane.width - 0.35
            left = np.array([-np.sin(heading), np.cos(heading), 0.0])
            place = point + left * (inward if radius < 0.6 else min(radius, lane.width / 2))
            made = furniture.small(kind, rng=rng)
            yield _stands(layout, made, place, heading + np.pi / 2, radius)


def _delineators(layout: Layout, rng: np.random.Generator) -> Placed:
    for _, line in edges(layout):
        for point, heading in along(layout, line, 50.0, rng, -0.5):
            yield _stands(layout, furniture.small("delineator", rng=rng), point, heading + np.pi)


def frontage(layout: Layout) -> Placed:
    """Hedges and fences between the road and the gardens or fields, with gaps."""
    rng = layout.spec.stream("frontage")
    kinds = ("picket", "wood_panel", "iron", "mesh")
    for lane, line in edges(layout):
        kind = kinds[rng.integers(len(kinds))]
        behind = -0.6 if lane.kind == "sidewalk" else -3.2
        for piece in _short_pieces(layout, line, behind, rng):
            chance = rng.random()
            if chance < layout.spec.hedges:
                yield _hedge(layout, piece, rng)
            elif chance < layout.spec.hedges + layout.spec.fences:
                yield furniture.fence(piece, kind, rng=rng)


def _short_pieces(
    layout: Layout, line: Array, offset: float, rng: np.random.Generator
) -> Iterator[Array]:
    """Stretches of 6 to 16 m that meet no road, house or anything placed before."""
    length = stations(line)[-1]
    s = float(rng.uniform(0, 5))
    while s < length - 4.0:
        span = float(rng.uniform(6.0, 16.0))
        stretch = at_station(offset_line(line, offset), np.linspace(s, min(length, s + span), 9))[0]
        z = layout.site.height(stretch[:, :2])
        s += span + (float(rng.uniform(3.0, 5.0)) if rng.random() < 0.3 else 0.0)
        free = layout.site.clear_of(stretch[:, :2], road=0.25, pavement=0.12, buildings=0.9).all()
        if not free or np.isnan(z).any() or not layout.in_view(stretch.mean(axis=0)):
            continue
        if np.linalg.norm(stretch.mean(axis=0)[:2] - layout.rig_xy) > 140.0:
            continue
        if layout.site.claim(np.column_stack([stretch[:, :2], np.full(9, 0.3)])):
            yield np.column_stack([stretch[:, :2], z])


def _hedge(layout: Layout, piece: Array, rng: np.random.Generator) -> Model:
    """A straight hedge from the first to the last point of a stretch."""
    chord = piece[-1, :2] - piece[0, :2]
    heading = float(np.arctan2(chord[1], chord[0]))
    middle = piece.mean(axis=0)
    model = vegetation.hedge(
        float(np.linalg.norm(chord)), float(rng.uniform(0.9, 2.0)), float(rng.uniform(0.5, 0.9)),
        rng=rng, lod=layout.lod(middle, 18.0, 55.0),
    )  # fmt: skip
    return sunk(layout.stand(model, middle, heading, z=float(piece[:, 2].min())), 0.05)
