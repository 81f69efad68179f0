"""How objects find their place: where the rig looks, how detailed they must be, what is free.

The modules that place things (surroundings, traffic, planting, roadside) are functions from a
:class:`Layout` to models that stand on the ground. Each draws from its own stream of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from simgen.crossings import Crossing
from simgen.geometry import Array
from simgen.mesh import Model, placed
from simgen.places import Places
from simgen.recipe import SceneSpec
from simgen.roads import Lane, at_station, offset_line, stations
from simgen.schema import LABELS
from simgen.signs import Rect
from simgen.site import Site
from simgen.vehicles import Vehicle

BEHIND_M = -30.0
"""What stands further behind the rig is left out: neither seen nor casting a shadow in view."""
AHEAD_M = 430.0
BESIDE_M = 260.0
AT_HAND_M = 15.0
CLOSE_M = 28.0
"""Plants up to that far have single leaves, for a 90° lens."""
CLOSE_TRIANGLES = 400_000
"""of plants that close, those beyond AT_HAND_M at most half; more plants are less detailed"""
CLOSE_BEHIND_M = 3.0
"""Crowns that far behind the rig reach into no image."""
EYE_M = 1.7
BROADEST_M = 8.0
"""Something whose middle is that far outside the images may yet reach into them."""

_NAMES = {label: name for name, label in LABELS.items()}


@dataclass(frozen=True, eq=False)
class Mover:
    """A model that can move, where it stands, and how fast it goes where it heads."""

    model: Model
    xyz: Array
    heading_rad: float
    speed_m_s: float
    """0 = standing or parked"""

    def record(self, instance: int) -> dict[str, Any]:
        """Plain data, as the spec of a frame keeps it: see CONVENTIONS.md."""
        return {
            "instance": instance,
            "class": _NAMES[min(p.semantic for p in self.model)],
            "xyz": [round(float(x), 3) for x in self.xyz],
            "size_m": self._size_m(),
            "heading_rad": round(self.heading_rad, 4),
            "speed_m_s": round(self.speed_m_s, 2),
        }

    def _size_m(self) -> list[float]:
        """Length, width and height: how far the model reaches along its own axes."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        R_world_model = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        along = [p.vertices @ R_world_model for p in self.model]
        low = np.min([a.min(axis=0) for a in along], axis=0)
        high = np.max([a.max(axis=0) for a in along], axis=0)
        return [round(float(x), 2) for x in high - low]


Placed = Iterator[Model | Mover]


class Layout:
    """A scene's site, seen from where the rig stands."""

    def __init__(
        self,
        site: Site,
        spec: SceneSpec,
        way: Array,
        sign_rects: Mapping[str, Rect],
        zoom: float,
        crossing: Crossing | None = None,
    ) -> None:
        """``way`` (N, 2) is where the rig stands in the frames of the scene; what is near or in
        view counts from the nearest of them, so that all frames show the same scene. ``zoom`` is
        the focal length over that of a 90° lens: detail counts in pixels.

        ``crossing`` is the bridge over the road ahead.
        """
        self.site, self.spec, self.way, self.rig_xy = site, spec, way, way[0]
        self._ahead = _directions(way)
        self.lanes = site.network.lanes
        self.sign_rects = sign_rects
        self.zoom = zoom
        self.lights: list[Array] = []
        """(N, 3) world positions of lamps that burn at night"""
        self.designs: dict[tuple[str, int, bool], Vehicle] = {}
        """of the scene's vehicles, by family, number and whether ridden: built when first met"""
        self.far_trees: dict[tuple[str, int], Model] = {}
        """by species and number, likewise"""
        self.tree_triangles = 0
        """of trees that are individuals, so far"""
        self.close_triangles, self.close_triangles_beyond = 0, 0
        """of plants with single leaves, so far: of all, and of those beyond AT_HAND_M"""
        self.wires: list[Array] = []
        """(N, 2, 3) pieces of the wires over the scene, so far, from point to point"""
        self.crossing = crossing
        blocks = [m for masses in site.network.buildings for m in masses]
        self.places = Places(way, blocks, rng=spec.stream("sheet places"))
        """of walls and roofs on their sheets"""

    def distance(self, xy: ArrayLike) -> Array:
        """From points (N, 2) to the rig where it comes nearest to them [m]."""
        points = np.asarray(xy, dtype=np.float64).reshape(-1, 1, 2)
        return np.asarray(np.linalg.norm(points - self.way, axis=2).min(axis=1))

    def lod(self, xy: Array, near: float = 32.0, far: float = 95.0) -> Literal[0, 1, 2]:
        """Level of detail: 0 near the rig, 2 far away, both for a 90° lens.

        A long lens magnifies what its images show, and leaves the rest as it is.
        """
        offset = np.asarray(xy)[:2] - self.way
        along, aside = np.einsum("kni,ni->kn", self._ahead, offset)
        reach = np.maximum(along, 0) / self.zoom + BROADEST_M
        shown = (along > -BROADEST_M) & (np.abs(aside) < reach)
        magnified = np.where(shown, self.zoom, min(self.zoom, 1.0))
        distance = float((np.linalg.norm(offset, axis=1) / magnified).min())
        return 0 if distance <= near else 1 if distance <= far else 2

    def close_eyes(self, points: ArrayLike, heading: float = 0.0) -> Array | None:
        """Where the rig is (E, 3) in the frame of a plant, if that deserves single leaves.

        ``points`` (N, 2) are the plant's outline or foot; their mean is the origin of its frame. A
        long lens sees it from nearer. None if it is too far or behind, or the triangles are spent.
        """
        outline = np.asarray(points, dtype=np.float64)[:, :2]
        nearest = outline[np.argmin(self.distance(outline))]
        ahead = ((nearest - self.way) * self._ahead[0]).sum(axis=1).max()
        ring = self.lod(nearest, AT_HAND_M, CLOSE_M)
        spent = self.close_triangles >= CLOSE_TRIANGLES
        spent |= ring == 1 and self.close_triangles_beyond >= CLOSE_TRIANGLES // 2
        if spent or ahead < -CLOSE_BEHIND_M or ring == 2:
            return None
        offset = (self.way - outline.mean(axis=0)) / self.zoom
        c, s = np.cos(heading), np.sin(heading)
        turned = offset @ np.array([[c, -s], [s, c]])
        return np.column_stack([turned, np.full(len(turned), EYE_M)])

    def spend_close(self, model: Model, eyes: Array | None) -> None:
        """Counts the triangles of a plant that has single leaves, seen from ``eyes``."""
        if eyes is not None:
            num = sum(len(p.faces) for p in model)
            self.close_triangles += num
            if np.linalg.norm(eyes[:, :2], axis=1).min() > AT_HAND_M:
                self.close_triangles_beyond += num

    def in_view(self, xy: Array) -> bool:
        """Whether something at ``xy`` can matter for an image."""
        low, high = self.around((BEHIND_M, -BESIDE_M), (AHEAD_M, BESIDE_M))
        return bool((low < xy[:2]).all() and (xy[:2] < high).all())

    def around(self, low: ArrayLike, high: ArrayLike) -> tuple[Array, Array]:
        """Corners (2,) of the rectangle that reaches from ``low`` to ``high`` about the rig."""
        return self.way.min(axis=0) + low, self.way.max(axis=0) + high

    def open_above(self, xy: Array, margin: float = 3.0) -> bool:
        """Whether something tall can stand at ``xy``: no bridge over it or close by."""
        bridge = self.crossing
        return bridge is None or not bridge.near(xy, bridge.half_width_m + margin)

    def stand(
        self,
        model: Model,
        xy: Array,
        heading: float = 0.0,
        *,
        z: float | None = None,
        normal: Array | None = None,
    ) -> Model:
        """The model on the ground; empty where there is none."""
        ground = float(self.site.height(xy[:2])[0]) if z is None else z
        if np.isnan(ground):
            return []
        return placed(model, xyz=[xy[0], xy[1], ground], heading_rad=heading, normal=normal)

    def mover(
        self,
        model: Model,
        xy: Array,
        heading: float,
        speed_m_s: float,
        *,
        z: float | None = None,
        normal: Array | None = None,
    ) -> Mover:
        """A model that can move, on the ground as by :meth:`stand`."""
        ground = float(self.site.height(xy[:2])[0]) if z is None else z
        standing = self.stand(model, xy, heading, z=ground, normal=normal)
        return Mover(standing, np.array([xy[0], xy[1], ground]), heading, speed_m_s)

    def keep_clear_of_rig(self) -> None:
        """Nothing may stand on the rig's way, or within a car's length of its ends."""
        x, y = self.rig_xy
        ahead = self.way[-1] + [[2.0, 0.0], [5.0, 0.0]]
        spots = np.concatenate([[(x - 4.0, y), (x - 1.0, y)], self.way, ahead])
        self.site.claim(np.column_stack([spots, np.full(len(spots), 2.2)]))


def _directions(way: Array) -> Array:
    """Unit vectors (2, N, 2) ahead and to the left of the rig at each point of its way."""
    ahead = np.gradient(way, axis=0) if len(way) > 1 else np.array([[1.0, 0.0]])
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.stack([ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)])


def edges(layout: Layout) -> Iterator[tuple[Lane, Array]]:
    """The outermost lane of every road side outside junctions, and its outer edge (N, 3)."""
    outermost: dict[tuple[str, str], Lane] = {}
    for lane in layout.lanes:
        key = (lane.road, lane.side)
        if not lane.in_junction and (key not in outermost or lane.rank > outermost[key].rank):
            outermost[key] = lane
    for lane in outermost.values():
        yield lane, lane.outer_edge


def along(
    layout: Layout, line: Array, spacing: float, rng: np.random.Generator, offset: float = 0.0
) -> Iterator[tuple[Array, float]]:
    """Points in view and headings, about every ``spacing`` metres, ``offset`` to the left."""
    shifted = offset_line(line, offset)
    start = float(rng.uniform(0.2, 1.0)) * spacing
    for s in np.arange(start, stations(shifted)[-1] - 2.0, spacing):
        point, heading = at_station(shifted, float(s) + float(rng.normal(0, 0.03 * spacing)))
        if layout.in_view(point):
            yield point, float(heading)


def sunk(model: Model, depth_m: float) -> Model:
    """Lowered a little, so that sloping ground leaves no gap."""
    return [replace(p, vertices=p.vertices - [0.0, 0.0, depth_m]) for p in model]
