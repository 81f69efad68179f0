"""Overhead wires of trolley buses: poles in pairs, span wires, two contact wires per direction."""

from __future__ import annotations

import numpy as np

from simgen.furniture import wires
from simgen.geometry import Array
from simgen.layout import Layout, Placed, edges, sunk
from simgen.mesh import Model, Part, part
from simgen.roads import is_main, offset_line, points_at, resampled, stations
from simgen.street_solids import BLACK, POLE, STEEL, UP, assembled, bars, rod

CONTACT_M = 5.7
"""height of the contact wires over the road"""
SPAN_M = 7.2
"""height of the span wires at their poles"""
APART_M = 0.6
"""between the two wires of a lane"""
SPACING_M = 27.0


def overhead(layout: Layout) -> Placed:
    """Poles in pairs along the main road of a town, and all wires as one thing."""
    if not layout.spec.trolley_wires or layout.crossing is not None:
        return
    hung: Model = []
    for lines in _opposite_edges(layout).values():
        if len(lines) == 2:
            for left, right in _pole_pairs(layout, *lines):
                yield [p for foot in (left, right) for p in _pole(layout, foot)]
                hung.append(_span(left, right))
                layout.wires.append(np.stack([left, right])[None] + CONTACT_M * UP)
    if hung:
        yield assembled([*hung, *_contact_lines(layout)])


def _opposite_edges(layout: Layout) -> dict[str, list[Array]]:
    """By piece of the main road: where poles stand on either side, both lines running ahead."""
    lines: dict[str, list[Array]] = {}
    for lane, _ in edges(layout):
        if is_main(lane) and lane.kind == "sidewalk":
            line = lane.offset(lane.width / 2 - 0.45)
            lines.setdefault(lane.road, []).append(line if lane.side == "right" else line[::-1])
    return lines


def _pole_pairs(layout: Layout, a: Array, b: Array) -> list[tuple[Array, Array]]:
    """Feet on both lines, as far along each, where both places are free."""
    pairs = []
    length = stations(a)[-1]
    for share in np.arange(4.0, length - 3.0, SPACING_M) / length:
        feet = [points_at(line, share * stations(line)[-1]) for line in (a, b)]
        discs = [(*foot[:2], 0.3) for foot in feet]
        if all(layout.in_view(f) for f in feet) and layout.site.claim(discs):
            pairs.append((feet[0], feet[1]))
    return pairs


def _pole(layout: Layout, foot: Array) -> Model:
    mast = rod([(0, 0, -0.1), (0, 0, SPAN_M + 0.4)], (0.11, 0.08), np.array(STEEL) * 0.7)
    return sunk(layout.stand([mast], foot), 0.03)


def _span(left: Array, right: Array) -> Part:
    """A wire from pole to pole that hangs down to just above the contact wires."""
    sag = (SPAN_M - CONTACT_M - 0.15) / float(np.linalg.norm(left - right))
    return wires([left + SPAN_M * UP, right + SPAN_M * UP], sag=sag)


def _contact_lines(layout: Layout) -> list[Part]:
    """Two wires over the outermost driving lane of each direction, straight over junctions."""
    parts = []
    for side in ("right", "left"):
        lanes = [x for x in layout.site.network.driving if is_main(x) and x.side == side]
        rank = max((x.rank for x in lanes), default=0)
        pieces = sorted((x for x in lanes if x.rank == rank), key=lambda x: x.road,
                        reverse=side == "left")  # fmt: skip
        if pieces:
            path = resampled(np.concatenate([x.centre for x in pieces]), 6.0)
            parts += [_wire(layout, offset_line(path, y)) for y in (-APART_M / 2, APART_M / 2)]
    return parts


def _wire(layout: Layout, line: Array) -> Part:
    """A contact wire over a line on the road, as far as it is in view."""
    seen = np.array([layout.in_view(p) for p in line])
    high = line[seen] + CONTACT_M * UP
    layout.wires.append(np.stack([high[:-1], high[1:]], axis=1))
    return part(*bars(high[:-1], high[1:], 0.009, 4), "metal", POLE, color=BLACK)
