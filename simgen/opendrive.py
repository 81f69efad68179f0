"""Reads road maps that somebody else drew: the OpenDRIVE 1.4 to 1.8 of ordinary streets.

Notation of the standard: a road is a reference line over its station s [m], heading h(s), height
z(s); t [m] points to its left. Lanes are numbered outwards from the reference line, negative ones
on its right, and their widths are cubic polynomials of s. ``alignment.py`` lays a road out in the
plane; ``given_map.py`` finds where to drive, and writes the part back that surfaces are made from.

Left out: superelevation and lane heights. Refused: driving on the left, lanes by their borders.

Source: ASAM OpenDRIVE 1.8.0, sections 8 (geometry), 10 (roads), 11 (lanes), 13 and 14.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from xml.etree import ElementTree

import numpy as np

from simgen.errors import UserError
from simgen.geometry import Array

Element = ElementTree.Element

MAX_COORDINATE_M = 1e8
"""beyond the size of the earth; UTM coordinates are below 1e7"""
MAX_ROAD_M = 100e3
MAX_LANE_M = 50.0
"""wider than any lane, squares and tracks beside the road included"""
GAP_M = 1.0
"""Pieces of a reference line that lie further apart do not belong to one road."""

KINDS = {
    **dict.fromkeys(("driving", "bidirectional", "entry", "exit", "onRamp", "offRamp",
                     "connectingRamp", "slipLane", "bus", "taxi", "HOV", "shared"), "driving"),
    **dict.fromkeys(("sidewalk", "walking"), "sidewalk"),
    "parking": "parking",
    "median": "median",
}  # fmt: skip
"""The kind of a lane by its type; other paved types are shoulders."""
NO_LANE = ("none", "verge")
"""lane types that are not paved"""


# --- what a map says -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Cubic:
    """A piecewise cubic: rows (start, a, b, c, d) are a + b·u + c·u² + d·u³, u = s − start."""

    rows: tuple[tuple[float, ...], ...]

    def __call__(self, s: Array) -> Array:
        """Values (N,) at (N,); zero where there is no piece at all."""
        if not self.rows:
            return np.zeros_like(s)
        table = np.array(self.rows)
        piece = np.maximum(np.searchsorted(table[:, 0], s + 1e-9, side="right") - 1, 0)
        start, a, b, c, d = table[piece].T
        u = s - start
        return np.asarray(a + u * (b + u * (c + u * d)))


@dataclass(frozen=True)
class Geometry:
    """One piece of a reference line."""

    s: float
    x: float
    y: float
    heading: float
    length: float
    shape: str
    """line | arc | spiral | poly3 | paramPoly3"""
    numbers: tuple[float, ...]
    """arc, spiral: curvature at both ends; the others: coefficients of u(p), then of v(p)"""
    normalized: bool
    """whether p of a paramPoly3 runs from 0 to 1 rather than over the arc length"""


@dataclass(frozen=True)
class Mark:
    """A road mark on the outer border of a lane."""

    s: float
    """from the start of its lane section"""
    kind: str
    """as the standard has it: solid, broken, "solid broken", …, inner one first"""
    width: float
    yellow: bool
    dash: tuple[float, float]
    """(paint, gap) where the line is broken [m]"""


@dataclass(frozen=True)
class LaneShape:
    """One lane of a section."""

    number: int
    kind: str | None
    """driving | parking | shoulder | median | sidewalk; None where nothing is paved"""
    width: Cubic
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class Section:
    """Lanes between two stations."""

    start: float
    end: float
    lanes: tuple[LaneShape, ...]
    """from left to right, the centre lane included"""


@dataclass(frozen=True)
class Thing:
    """An object or a signal at its place (s, t)."""

    tag: str
    """object | signal"""
    type: str
    value: str
    """of a sign: its number"""
    s: float
    t: float
    heading: float
    """relative to the road"""
    outline: tuple[tuple[float, float], ...]
    """corners around its place, along and across its heading [m]; empty for a signal"""


@dataclass(frozen=True)
class Road:
    """One road."""

    id: str
    junction: str
    """"-1" outside junctions"""
    length: float
    planview: tuple[Geometry, ...]
    elevation: Cubic
    lane_offset: Cubic
    sections: tuple[Section, ...]
    things: tuple[Thing, ...]


# --- reading -------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def read(data: bytes) -> tuple[Road, ...]:
    """The roads of a map; UserError if there is nothing to drive on."""
    root = parsed(data)
    elements = root.findall("road")
    if not elements:
        raise UserError("the map is empty: no <road> in it.")
    _require_own_ids(elements)
    roads = tuple(_road(e) for e in elements)
    if not any(lane.kind == "driving" for r in roads for x in r.sections for lane in x.lanes):
        raise UserError(
            f"none of its {len(roads)} roads has a lane of type driving (or bus, entry, …)."
        )
    return roads


def _require_own_ids(elements: Sequence[Element]) -> None:
    times = Counter(e.get("id", "") for e in elements)
    (name, num), *_ = times.most_common(1)
    if num > 1:
        raise UserError(f"{num} roads have id={name!r}; expected an id of its own for each road.")


class _NoDoctype(ElementTree.TreeBuilder):
    """Refuses document types, and with them all entities: a map needs none."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise UserError(f"it declares a document type ({name}); expected plain OpenDRIVE XML.")


def parsed(data: bytes) -> Element:
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoDoctype()))
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise UserError(f"not valid XML: {error}. Is the file complete?") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "OpenDRIVE":
        raise UserError(f"not OpenDRIVE: its root is <{root.tag}>, expected <OpenDRIVE>.")
    return root


def _road(element: Element) -> Road:
    name = element.get("id", "")
    if element.get("rule") == "LHT":
        raise UserError(
            f'road {name}: traffic drives on the left (rule="LHT"); traffic, kerbs and signs of '
            "simgen's scenes are made for driving on the right."
        )
    try:
        planview = tuple(_geometry(g) for g in element.iterfind("planView/geometry"))
        if not planview:
            raise UserError("no <geometry> in its <planView>.")
        length = _length(element, planview)
        return Road(
            id=name,
            junction=element.get("junction", "-1"),
            length=length,
            planview=planview,
            elevation=_cubic(element, "elevationProfile/elevation", "s"),
            lane_offset=_cubic(element, "lanes/laneOffset", "s"),
            sections=_sections(element, length),
            things=tuple(_things(element)),
        )
    except UserError as error:
        raise UserError(f"road {name}: {error}") from error


def _length(element: Element, planview: Sequence[Geometry]) -> float:
    """Of a road: where its pieces, which must follow each other, end."""
    end = 0.0
    for k, g in enumerate(planview):
        if abs(g.s - end) > GAP_M:
            raise UserError(
                f"piece {k} of its <planView> has s={g.s:g}; expected {end:g}, "
                f"{'where the piece before it ends' if k else 'the start of the road'}."
            )
        end = g.s + g.length
    longest = max(end, _number(element, "length", 0.0))
    if longest > MAX_ROAD_M:
        raise UserError(
            f"it is {longest / 1000:g} km long; expected at most {MAX_ROAD_M / 1000:g} km."
        )
    return end


def _number(element: Element, name: str, default: float | None = None) -> float:
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_COORDINATE_M:
        raise UserError(
            f"<{element.tag}> has {name}={text!r}; expected a number within ±{MAX_COORDINATE_M:g}."
        )
    return value


def _cubic(element: Element, path: str, start: str) -> Cubic:
    rows = [tuple(_number(e, k) for k in (start, *"abcd")) for e in element.iterfind(path)]
    return Cubic(tuple(sorted(rows)))


COEFFICIENTS = {
    "line": (),
    "arc": ("curvature", "curvature"),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": tuple("abcd"),
    "paramPoly3": tuple(k + axis for axis in "UV" for k in "abcd"),
}


def _geometry(element: Element) -> Geometry:
    shape = next((e for e in element if e.tag in COEFFICIENTS), None)
    if shape is None:
        found = ", ".join(f"<{e.tag}>" for e in element) or "nothing"
        known = ", ".join(COEFFICIENTS)
        raise UserError(f"its geometry holds {found}; expected one of {known}.")
    numbers = tuple(_number(shape, k) for k in COEFFICIENTS[shape.tag])
    s, x, y, heading, length = (_number(element, k) for k in ("s", "x", "y", "hdg", "length"))
    if length < 0:
        raise UserError(f"a geometry has length {length:g}; expected 0 or more.")
    return Geometry(
        s, x, y, heading, length, shape.tag,
        (0.0, 1.0, 0.0, 0.0, *numbers) if shape.tag == "poly3" else numbers,
        normalized=shape.get("pRange") == "normalized",
    )  # fmt: skip


def _sections(element: Element, length: float) -> tuple[Section, ...]:
    found = element.findall("lanes/laneSection")
    starts = [_number(e, "s") for e in found]
    if not found:
        raise UserError("no <laneSection> in it.")
    if any(e.get("singleSide") == "true" for e in found):
        raise UserError(
            'a <laneSection> is of one side only; expected none with singleSide="true".'
        )
    return tuple(
        Section(start, end, tuple(lane_shape(x) for side in ("left", "center", "right")
                                  for x in _by_number(e.findall(f"{side}/lane"))))
        for e, start, end in zip(found, starts, [*starts[1:], length], strict=True)
        if end > start
    )  # fmt: skip


def _by_number(lanes: Sequence[Element]) -> list[Element]:
    return sorted(lanes, key=lambda e: -_number(e, "id"))


def lane_shape(element: Element) -> LaneShape:
    number, kind = int(_number(element, "id")), element.get("type", "none")
    width = _cubic(element, "width", "sOffset")
    if element.find("border") is not None and not width.rows:
        raise UserError(f"lane {number} is given by its <border>; expected <width>.")
    return LaneShape(
        number,
        None if number == 0 or kind in NO_LANE else KINDS.get(kind, "shoulder"),
        width,
        tuple(_mark(e) for e in element.findall("roadMark")),
    )


def _mark(element: Element) -> Mark:
    line = element.find("type/line")
    return Mark(
        s=_number(element, "sOffset", 0.0),
        kind=element.get("type", "none"),
        width=_number(element, "width", 0.12) or 0.12,
        yellow=element.get("color") == "yellow",
        dash=(3.0, 6.0) if line is None else (_number(line, "length"), _number(line, "space")),
    )


def _things(element: Element) -> Iterator[Thing]:
    for tag in ("object", "signal"):
        for e in element.iterfind(f"{tag}s/{tag}"):
            against = np.pi if e.get("orientation") == "-" and tag == "signal" else 0.0
            turn = _number(e, "hdg" if tag == "object" else "hOffset", 0.0)
            yield Thing(
                tag, e.get("type", ""), e.get("value", ""), _number(e, "s"), _number(e, "t"),
                against + turn, _outline(e, turn) if tag == "object" else (),
            )  # fmt: skip


def _outline(element: Element, turn: float) -> tuple[tuple[float, float], ...]:
    """Corners in the axes of an object that is turned against the road."""
    corners = element.findall(".//outline/cornerLocal")
    if corners:
        return tuple((_number(c, "u"), _number(c, "v")) for c in corners)
    corners = element.findall(".//outline/cornerRoad")
    if corners:
        s, t = _number(element, "s"), _number(element, "t")
        along = [(_number(c, "s") - s, _number(c, "t") - t) for c in corners]
        cos, sin = float(np.cos(turn)), float(np.sin(turn))
        return tuple((cos * u + sin * v, cos * v - sin * u) for u, v in along)
    u, v = _number(element, "length", 0.0) / 2, _number(element, "width", 0.0) / 2
    return ((u, v), (-u, v), (-u, -v), (u, -v)) if u * v > 0 else ()
