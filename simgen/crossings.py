"""Where a bridge crosses over the road ahead of the rig, and what has to make way for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from simgen.geometry import Array
from simgen.recipe import SceneSpec
from simgen.roads import Lane, at_station, points_at, stations
from simgen.site import Site

Kind = Literal["road", "rail", "foot"]

AHEAD_M = (40.0, 220.0)
REACH_M = 110.0
"""How far the embankments of a road or a railway go on to either side."""
MAX_STEP_M = 2.5
"""The land at the ends of the deck is at most this much higher or lower than the road."""
CLEARANCE_M = (4.7, 5.5)
_HALF_WIDTH_M: dict[Kind, tuple[float, float]] = {
    "road": (4.5, 6.5), "rail": (3.2, 5.2), "foot": (1.4, 2.0),
}  # fmt: skip
_MARGIN_M: dict[Kind, float] = {"road": 2.5, "rail": 0.4, "foot": 0.6}
"""from the paved ground to the supports"""


@dataclass(frozen=True, eq=False)
class Crossing:
    """A deck across the rig's road. Its frame: x along that road, y to the left, along the deck."""

    kind: Kind
    origin: Array
    """(3,) on the road below the middle of the deck, in the world"""
    heading: float
    """of the frame's x [rad]"""
    right_m: float
    left_m: float
    """the supports stand at y = −right_m and left_m"""
    half_width_m: float
    soffit_m: float
    """z of the underside of the deck"""
    median_m: float | None
    """y of a median wide enough for a pier"""

    def world(self, xy: Array) -> Array:
        """World coordinates (N, 2) of points (N, 2) of the frame."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return xy @ np.array([[c, s], [-s, c]]) + self.origin[:2]

    def discs(self) -> Array:
        """(N, 3) what it takes of the ground and the air beside the road, as (x, y, radius)."""
        if self.kind == "foot":
            x = np.arange(-2.0, 13.0, 2.0)
            ends = [np.stack([side * x, 0 * x + y], axis=1)
                    for side, y in ((1, self.left_m + 0.9), (-1, -self.right_m - 0.9))]  # fmt: skip
            xy, radius = np.concatenate(ends), 1.8
        else:
            y = np.arange(0.0, REACH_M, 3.0)
            y = np.concatenate([self.left_m + y, -self.right_m - y])
            xy = np.stack([0 * y, y], axis=1)
            radius = self.half_width_m + (6.0 if self.kind == "road" else 2.5)
        return np.column_stack([self.world(xy), np.full(len(xy), radius)])

    def near(self, xy: Array, metres: float) -> bool:
        """Whether something across the road at ``xy`` comes closer to the deck than this."""
        along = np.array([np.cos(self.heading), np.sin(self.heading)])
        return bool(abs((np.asarray(xy)[:2] - self.origin[:2]) @ along) < metres)


def plan(site: Site, spec: SceneSpec) -> Crossing | None:
    """Finds room for the bridge of a spec, if it has one, and clears its ground of buildings."""
    rng = spec.stream("crossing")
    kind = _kind(spec)
    if kind is None:
        return None
    for lane, s in _spots(site, rng):
        crossing = _crossing(site, kind, lane, s, rng)
        if crossing is not None:
            site.demolish(shapely.union_all(
                [shapely.Point(x, y).buffer(r + 1.0) for x, y, r in crossing.discs()]
            ))  # fmt: skip
            return crossing
    return None


def _kind(spec: SceneSpec) -> Kind | None:
    if spec.overpass:
        return "rail" if spec.road.kind == "town" else "road"
    return "foot" if spec.footbridge else None


def _spots(site: Site, rng: np.random.Generator) -> list[tuple[Lane, float]]:
    """Stations of lanes that lead ahead, in random order with near ones first by tendency."""
    origin = points_at(site.network.rig_lane.centre, site.network.rig_station)
    spots: list[tuple[float, Lane, float]] = []
    for lane in site.network.driving:
        s = np.arange(12.0, stations(lane.centre)[-1] - 12.0, 6.0)
        points, headings = at_station(lane.centre, s)
        x, y = (points - origin)[:, :2].T
        ahead = (AHEAD_M[0] < x) & (x < AHEAD_M[1]) & (np.abs(y) < 0.4 * x)
        ahead &= np.abs(headings) < 0.5
        spots += [(float(d), lane, float(a)) for d, a in zip(x[ahead], s[ahead], strict=True)]
    order = np.argsort([d * rng.uniform(0.5, 2.0) for d, *_ in spots])
    return [spots[i][1:] for i in order[:30]]


def _crossing(
    site: Site, kind: Kind, lane: Lane, s: float, rng: np.random.Generator
) -> Crossing | None:
    """The bridge at one place; None if other roads or the lie of the land forbid it."""
    origin, tangent = at_station(lane.centre, s)
    heading = float(tangent) + float(rng.normal(0, 0.08 if kind != "foot" else 0.02))
    half_width = float(rng.uniform(*_HALF_WIDTH_M[kind]))
    bare = Crossing(kind, origin, heading, 0.0, 0.0, half_width, 0.0, None)
    y = np.arange(-REACH_M, REACH_M, 0.5)
    columns = [bare.world(np.stack([0 * y + x, y], axis=1)) for x in (-half_width, half_width)]
    paved = np.any([_paved(site, xy) for xy in columns], axis=0)
    right, left = _opening(paved, y)
    reach = REACH_M if kind != "foot" else 14.0
    outside = (y > left) | (y < right)
    if paved[outside & (np.abs(y) < reach)].any() or left - right > 55.0:
        return None
    height = np.stack([site.height(xy) for xy in columns]) - origin[2]
    if np.isnan(height).any() or np.abs(height[:, np.abs(y) < 40.0]).max() > MAX_STEP_M:
        return None
    margin = _MARGIN_M[kind]
    soffit = float(height[:, ~outside].max() + rng.uniform(*CLEARANCE_M))
    return Crossing(kind, origin, heading, margin - right, margin + left, half_width, soffit,
                    _median(site, bare))  # fmt: skip


def _paved(site: Site, xy: Array) -> NDArray[np.bool_]:
    return ~site.clear_of(xy, road=0.1, pavement=0.1, buildings=-1)


def _opening(paved: NDArray[np.bool_], y: Array) -> tuple[float, float]:
    """The ends of the paved ground around y = 0; gaps of up to 4 m (a median) are part of it."""
    gap = 8
    closed = np.convolve(paved, np.ones(2 * gap + 1), "same") > 0
    middle = int(np.argmin(np.abs(y)))
    low = middle - int(np.argmin(closed[middle::-1])) + gap + 1
    high = middle + int(np.argmin(closed[middle:])) - gap - 1
    return float(y[low]), float(y[high])


def _median(site: Site, crossing: Crossing) -> float | None:
    """y of the middle of the median, if the road has one."""
    medians = [x.centre for x in site.network.lanes if x.kind == "median" and x.side == "right"]
    if not medians:
        return None
    points = np.concatenate(medians)[:, :2] - crossing.origin[:2]
    c, s = np.cos(crossing.heading), np.sin(crossing.heading)
    x, y = points @ [c, s], points @ [-s, c]
    order = np.argsort(x)
    return float(np.interp(0.0, x[order], y[order])) if x.min() < 0 < x.max() else None
