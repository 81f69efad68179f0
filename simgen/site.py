"""A road network as a place to put things: where the ground is, and what is taken already."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from simgen.geometry import Array
from simgen.mesh import cross
from simgen.roads import Network, Surface

_CELL_M = 8.0


class Site:
    """Ground heights, paved areas, and the discs that placed objects occupy."""

    def __init__(self, network: Network) -> None:
        self.network = network
        with ThreadPoolExecutor(max_workers=2) as pool:  # Shapely lets other threads run
            asphalt = pool.submit(covered, network.surfaces["road"])
            pavement = pool.submit(covered, network.surfaces["sidewalk"])
            self._height = _Heights(list(network.surfaces.values()))
            self.asphalt, self.pavement = asphalt.result(), pavement.result()
        self.built = _built(network)
        self._discs: defaultdict[tuple[int, int], list[tuple[float, float, float]]]
        self._discs = defaultdict(list)
        for area in (self.asphalt, self.pavement, self.built):
            shapely.prepare(area)

    def demolish(self, area: shapely.Geometry) -> None:
        """Takes away the buildings that touch an area."""
        keep = [
            b for b in self.network.buildings
            if not any(shapely.Polygon(m.footprint).intersects(area) for m in b)
        ]  # fmt: skip
        self.network = replace(self.network, buildings=keep)
        self.built = _built(self.network)
        shapely.prepare(self.built)

    def height(self, xy: ArrayLike) -> Array:
        """z (N,) of the topmost ground at (N, 2); NaN outside the network's land."""
        return self._height(np.asarray(xy, dtype=np.float64).reshape(-1, 2))

    def clear_of(
        self, xy: ArrayLike, *, road: float, pavement: float, buildings: float
    ) -> NDArray[np.bool_]:
        """Which points (N, 2) keep these distances [m]; a negative one does not matter."""
        points = shapely.points(np.asarray(xy, dtype=np.float64).reshape(-1, 2))
        keep = np.ones(len(points), dtype=bool)
        for area, distance in ((self.asphalt, road), (self.pavement, pavement),
                               (self.built, buildings)):  # fmt: skip
            if distance >= 0:
                keep &= ~shapely.dwithin(area, points, distance)
        return keep

    def room(self, xy: ArrayLike) -> Array:
        """Distances (2,) [m] from a point to the nearest house and to the nearest asphalt."""
        point = shapely.Point(np.asarray(xy, dtype=np.float64)[:2])
        areas = np.array([self.built, self.asphalt])
        return np.where(shapely.is_empty(areas), np.inf, shapely.distance(areas, point))

    def claim(self, discs: ArrayLike) -> bool:
        """Takes the discs (M, 3) as (x, y, radius) if none of them touches a taken one."""
        mine = [tuple(map(float, d)) for d in np.asarray(discs, dtype=np.float64).reshape(-1, 3)]
        for x, y, r in mine:
            for ox, oy, other in self._around(x, y, r):
                if (x - ox) ** 2 + (y - oy) ** 2 < (r + other) ** 2:
                    return False
        for x, y, r in mine:
            for cell in _cells(x, y, r):
                self._discs[cell].append((x, y, r))
        return True

    def _around(self, x: float, y: float, r: float) -> Iterator[tuple[float, float, float]]:
        for cell in _cells(x, y, r):
            yield from self._discs.get(cell, ())


def _built(network: Network) -> shapely.Geometry:
    """The ground that buildings stand on."""
    return shapely.union_all([shapely.Polygon(m.footprint) for b in network.buildings for m in b])


def _cells(x: float, y: float, r: float) -> Iterable[tuple[int, int]]:
    columns = range(int((x - r) // _CELL_M), int((x + r) // _CELL_M) + 1)
    rows = range(int((y - r) // _CELL_M), int((y + r) // _CELL_M) + 1)
    return product(columns, rows)


def covered(surface: Surface) -> shapely.Geometry:
    """The area that a surface covers seen from above; a centimetre closes its seams."""
    if not len(surface.faces):
        return shapely.Polygon()
    triangles = shapely.polygons(surface.vertices[surface.faces][..., :2])
    return shapely.union_all(triangles).buffer(0.01)


def rings(area: shapely.Geometry) -> list[Array]:
    """All boundaries (N, 2) of an area, holes included."""
    polygons = [p for p in shapely.get_parts(area) if not p.is_empty]
    return [np.array(r.coords) for p in polygons for r in (p.exterior, *p.interiors)]


class _Heights:
    """Looks up the topmost triangle over a point."""

    def __init__(self, surfaces: list[Surface]) -> None:
        self.triangles = np.concatenate([s.vertices[s.faces] for s in surfaces if len(s.faces)])
        self.tree = shapely.STRtree(shapely.polygons(self.triangles[..., :2]))

    def __call__(self, xy: Array) -> Array:
        which, triangle = self.tree.query(shapely.points(xy), predicate="intersects")
        z = np.full(len(xy), -np.inf)
        np.maximum.at(z, which, _plane_height(self.triangles[triangle], xy[which]))
        return np.where(np.isinf(z), np.nan, z)


def _plane_height(triangles: Array, xy: Array) -> Array:
    """z (N,) at (N, 2) of the planes of triangles (N, 3, 3); the top of upright ones."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    n = cross(b - a, c - a)
    upright = np.abs(n[:, 2]) < 1e-6 * np.linalg.norm(n, axis=1)
    safe = np.where(upright, 1.0, n[:, 2])
    sloped = a[:, 2] - ((xy - a[:, :2]) * n[:, :2]).sum(axis=1) / safe
    return np.where(upright, triangles[..., 2].max(axis=1), sloped)
