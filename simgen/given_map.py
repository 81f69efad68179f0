"""A map that somebody else drew, as the file of a set: where to drive in it, and which part counts.

The file's bytes travel with the job; a set keeps a copy, and its config names it by its sha256.
"""

from __future__ import annotations

import hashlib
import os
from collections import defaultdict
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from simgen.alignment import Strip, followed, require_whole, strips
from simgen.errors import UserError
from simgen.geometry import Array
from simgen.opendrive import COEFFICIENTS, Element, lane_shape, parsed, read

MAX_BYTES = 64 << 20
SIGHT_M = 50.0
"""The rig is put where its lane goes on for at least so long."""
AFTER_DRIVE_M = 4.0
"""and so far beyond the place of the last frame"""
DRIVE_M = 400.0
"""A drive is followed over so much of the lanes ahead."""


# --- the file ------------------------------------------------------------------------------------


def load(path: Path, drive_m: float = 0.0) -> bytes:
    """The bytes of a map; UserError if it is not one that can be driven on for ``drive_m``."""
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= MAX_BYTES else b""
    except OSError as error:
        raise UserError(f"--opendrive {path}: cannot be read ({error.strerror}).") from error
    if size > MAX_BYTES:
        raise UserError(
            f"--opendrive {path}: {size >> 20} MB; expected at most {MAX_BYTES >> 20} MB. Cut the "
            "map down to the roads that are to be driven on."
        )
    try:
        for road in read(data):
            require_whole(road)
        starts(data, drive_m)
    except UserError as error:
        raise UserError(f"--opendrive {path}: {error}") from error
    return data


COPY = "map.xodr"
"""A set's own copy of the map that it drives through."""


def keep(data: bytes, folder: Path) -> None:
    """Puts a copy of the map, if there is one, into the folder of a set."""
    if data:
        temporary = folder / f".{COPY}.tmp"
        temporary.write_bytes(data)
        os.replace(temporary, folder / COPY)


def kept(folder: Path, sha256: str) -> bytes:
    """The map of a set; empty if it has none, UserError if its copy is gone or changed."""
    if not sha256:
        return b""
    path = folder / COPY
    data = path.read_bytes() if path.is_file() else b""
    if hashlib.sha256(data).hexdigest() != sha256:
        raise UserError(
            f"{path}: expected the map that the set was rendered from (sha256 {sha256[:12]}…), "
            f"found {'another one' if data else 'nothing'}. Put the original there."
        )
    return data


# --- where one can drive -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Start:
    """A driving lane outside junctions, followed over the lanes that go on from it."""

    strip: Strip
    centre: Array
    """(N, 3)"""
    usable_m: float
    """the rig may start in this first part"""


@lru_cache(maxsize=2)
def all_strips(data: bytes) -> tuple[Strip, ...]:
    """The paved lanes of a map."""
    return tuple(strip for road in read(data) for strip in strips(road))


@lru_cache(maxsize=2)
def starts(data: bytes, drive_m: float = 0.0) -> tuple[Start, ...]:
    """Where a drive of so many metres can begin; UserError if no lane is long enough."""
    ahead = max(SIGHT_M, drive_m + AFTER_DRIVE_M)
    driving = [x for x in all_strips(data) if x.kind == "driving"]
    found = []
    for strip in driving:
        if strip.junction == "-1":
            centre = followed(strip.centre, [d.centre for d in driving], DRIVE_M)
            usable = min(_length(strip.centre), _length(centre) - ahead)
            if usable > 0:
                found.append(Start(strip, centre, usable))
    if not found:
        fewer = " Ask for fewer --frames-per-scene, or for" if ahead > SIGHT_M else " Take"
        raise UserError(
            f"too short to drive on: no driving lane goes on for {ahead:g} m, the next lanes "
            f"that it leads to included.{fewer} a map of longer roads."
        )
    return tuple(found)


def _length(line: Array) -> float:
    return float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())


_KIND_OF_TYPE = {"motorway": "motorway", "rural": "rural", "lowSpeed": "town"}


@lru_cache(maxsize=2)
def road_kind(data: bytes) -> str:
    """Of most of a map's metres (town, rural, motorway); empty where no road states its type."""
    metres: defaultdict[str, float] = defaultdict(float)
    roads = parsed(data).findall("road")
    for road, length in zip(roads, [r.length for r in read(data)], strict=True):
        stated = road.find("type")
        name = "" if stated is None else stated.get("type", "")
        kind = "town" if name.startswith("town") else _KIND_OF_TYPE.get(name, "")
        metres[kind] += length
    metres.pop("", None)
    return max(metres, key=lambda kind: metres[kind], default="")


# --- writing back --------------------------------------------------------------------------------

_KEPT: dict[str, tuple[str, ...]] = {
    "road": ("name", "length", "id", "junction"),
    "link": (), "planView": (), "line": (), "lanes": (), "left": (), "center": (), "right": (),
    "elevationProfile": (), "elevation": ("s", *"abcd"), "laneOffset": ("s", *"abcd"),
    "predecessor": ("elementType", "elementId", "contactPoint", "id"),
    "successor": ("elementType", "elementId", "contactPoint", "id"),
    "geometry": ("s", "x", "y", "hdg", "length"), "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"), "poly3": tuple("abcd"),
    "paramPoly3": (*COEFFICIENTS["paramPoly3"], "pRange"),
    "laneSection": ("s",), "lane": ("id", "type"), "width": ("sOffset", *"abcd"),
    "junction": ("name", "id"), "laneLink": ("from", "to"),
    "connection": ("id", "incomingRoad", "connectingRoad", "contactPoint"),
}  # fmt: skip
"""Elements and attributes that decide surfaces."""


def canonical(data: bytes, kept: set[str], origin: Array, kind: str) -> str:
    """The map again with the ``kept`` roads only, in a frame with its origin at ``origin``.

    ``kind`` is the road type (town, rural, motorway) that all roads get.
    """
    root = ElementTree.Element("OpenDRIVE")
    ElementTree.SubElement(root, "header", revMajor="1", revMinor="4", name="given")
    for element in parsed(data):
        if element.tag == "road" and element.get("id", "") in kept:
            road = _copied(element)
            road.insert(1, ElementTree.Element("type", s="0", type=kind))
            root.append(road)
        elif element.tag == "junction":
            junction = _copied(element)
            for c in list(junction):
                if not {c.get("incomingRoad"), c.get("connectingRoad")} <= kept:
                    junction.remove(c)
            if len(junction):
                root.append(junction)
    _mend(root, origin)
    return ElementTree.tostring(root, encoding="unicode")


def _copied(element: Element) -> Element:
    """The understood part of an element."""
    names = _KEPT[element.tag]
    stated = {k: element.attrib[k] for k in names if k in element.attrib}
    copy = ElementTree.Element(element.tag, stated)
    copy.extend(_copied(child) for child in element if child.tag in _KEPT)
    return copy


SHORTEST_M = 1e-3
"""of what some tools write as a piece of a road, and roadgen refuses"""


def _drop_empty_pieces(road: Element) -> None:
    """Takes out geometries and lane sections that have no length."""
    for plan in road.findall("planView"):
        pieces = [g for g in plan if float(g.get("length", "0")) >= SHORTEST_M]
        plan[:] = pieces or list(plan)
        end = float(plan[-1].attrib["s"]) + float(plan[-1].attrib["length"])
        for lanes in road.findall("lanes"):
            sections = lanes.findall("laneSection")
            starts = [float(x.get("s", "0")) for x in sections]
            for section, start, stop in zip(sections, starts, [*starts[1:], end], strict=True):
                if stop - start < SHORTEST_M and len(sections) > 1:
                    lanes.remove(section)


_WRITTEN_TYPE: dict[str | None, str] = {None: "none", "median": "shoulder"}


def _mend(root: Element, origin: Array) -> None:
    """Moves the origin, names lane types simply, and cuts links to what is not there."""
    present = {(e.tag, e.get("id")) for e in root}
    for g in root.iter("geometry"):
        for axis, shift in zip("xy", origin, strict=False):
            g.set(axis, repr(float(g.attrib[axis]) - float(shift)))
    for road in root.iter("road"):
        _drop_empty_pieces(road)
        *_, last = road.iterfind("planView/geometry")
        road.set("length", repr(float(last.attrib["s"]) + float(last.attrib["length"])))
    for lane in root.iter("lane"):
        kind = lane_shape(lane).kind
        lane.set("type", _WRITTEN_TYPE.get(kind, str(kind)))
    for road in root.iter("road"):
        if ("junction", road.get("junction")) not in present:
            road.set("junction", "-1")
        for link in road.findall("link"):
            for end in list(link):
                if (end.get("elementType"), end.get("elementId")) not in present:
                    link.remove(end)
