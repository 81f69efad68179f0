"""Spray: the mist that wheels throw up from wet roads.

A plume is a row of puffs behind and beside a vehicle that goes fast: Gaussians of extinction that
grow wider and thinner with the distance from the wheels. A ray's optical depth in a Gaussian, up to
the surface where it ends, is an error function. Spray is white: what it hides, it replaces by the
light of the air, as haze does; so it makes no difference how much haze lies before it.

Plumes are of the world: all cameras of a rig see the same ones, each from where it stands.
How dense they are was chosen by eye, not measured; that it grows with the square of the speed
follows the energy of what the tyres throw.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from simgen.along_rays import at_all_pixels, coarser, directions, enlarged
from simgen.geometry import Array, project, transform_points
from simgen.rig import Camera
from simgen.skymap import seen_through

Image = NDArray[Any]
"""float32"""

FROM_WETNESS = 0.5
FROM_M_S = 10.0
_COLUMNS = 512
"""cells of the coarse grid in a row of the image"""
_REACH = 3.0
"""standard deviations at which a puff ends"""
_NEAR_M = 0.1
_NUM_BEHIND = 6


class Wheels(NamedTuple):
    """What the wheels of a class of vehicles throw up."""

    extinction: float
    """at the wheels, on a road with a film of water, at 25 m/s [1/m]"""
    height_m: float
    """of the plume where it begins: a standard deviation"""
    lasts_s: float
    """time after which the plume is thinner by e, the widening apart"""


WHEELS = {
    "car": Wheels(0.16, 0.35, 0.5),
    "truck": Wheels(0.18, 0.65, 0.7),
    "bus": Wheels(0.15, 0.6, 0.7),
    "rider": Wheels(0.08, 0.25, 0.3),
}
"""By class in ``spec["movers"]``; riders so fast are on motorcycles."""


@dataclass(frozen=True)
class Plume:
    """The spray of one mover."""

    instance: int
    extinction_per_m: tuple[float, ...]
    """at the middle of each puff"""
    aside_m: tuple[float, ...]
    """of each puff from the vehicle's track, left is positive"""


@dataclass(frozen=True, eq=False)
class Puffs:
    """Gaussians of extinction."""

    middle: Array
    """(N, 3) in the world"""
    T_puff_world: Array
    """(N, 4, 4): metres to standard deviations along, across and up"""
    extinction: Array
    """(N,) in the middle [1/m]"""


# --- from movers to puffs ------------------------------------------------------------------------


def plumes(
    movers: Sequence[Mapping[str, Any]], wetness: float, *, rng: np.random.Generator
) -> list[Plume]:
    """Draws the spray of a frame's movers (``spec["movers"]``); none on a road that is not wet."""
    if wetness < FROM_WETNESS:
        return []
    return [
        _plume(m, wetness, rng=rng)
        for m in movers
        if m["speed_m_s"] >= FROM_M_S and m["class"] in WHEELS
    ]


def _plume(mover: Mapping[str, Any], wetness: float, *, rng: np.random.Generator) -> Plume:
    behind, sigma = _shape(mover)
    wheels = WHEELS[mover["class"]]
    thinned = sigma[0, 1:].prod() / sigma[:, 1:].prod(axis=1)
    faded = np.exp(-np.maximum(behind, 0) / (wheels.lasts_s * mover["speed_m_s"]))
    thrown = wheels.extinction * wetness * (mover["speed_m_s"] / 25.0) ** 2
    uneven = rng.lognormal(0.0, 0.25, len(behind))
    aside = rng.normal(0.0, 0.15, len(behind)) * sigma[:, 1]
    extinction = thrown * thinned * faded * uneven
    return Plume(mover["instance"], _rounded(extinction), _rounded(aside))


def _rounded(values: Array) -> tuple[float, ...]:
    return tuple(np.round(values, 4).tolist())


def _shape(mover: Mapping[str, Any]) -> tuple[Array, Array]:
    """Distances (n,) behind the vehicle's end, and standard deviations (n, 3) of its puffs.

    The first lies along the vehicle, the others behind, each longer than the one before.
    """
    length, width, _ = mover["size_m"]
    wheels = WHEELS[mover["class"]]
    place = (np.arange(_NUM_BEHIND) + 0.5) / _NUM_BEHIND
    reach = 1.3 * wheels.lasts_s * mover["speed_m_s"]
    behind = np.concatenate([[-0.3 * length], reach * place**2])
    along = np.concatenate([[0.2 * length], 1.2 * reach * place / _NUM_BEHIND])
    wider = np.maximum(behind, 0)
    sigma = np.stack([along, 0.4 * width + 0.04 * wider, wheels.height_m + 0.03 * wider], axis=1)
    return behind, sigma


def puffs(sprayed: Sequence[Plume], movers: Sequence[Mapping[str, Any]]) -> Puffs:
    """Where the plumes' puffs are."""
    by_instance = {m["instance"]: m for m in movers}
    placed = [_placed(p, by_instance[p.instance]) for p in sprayed]
    middle, T, extinction = (np.concatenate(x) for x in zip(*placed, strict=True))
    return Puffs(middle, T, extinction)


def _placed(plume: Plume, mover: Mapping[str, Any]) -> tuple[Array, Array, Array]:
    behind, sigma = _shape(mover)
    heading = mover["heading_rad"]
    forward, left = np.array([[np.cos(heading), np.sin(heading), 0],
                              [-np.sin(heading), np.cos(heading), 0]])  # fmt: skip
    axes = np.stack([forward, left, [0.0, 0.0, 1.0]])
    local = np.stack([-behind - mover["size_m"][0] / 2, plume.aside_m, sigma[:, 2]], axis=1)
    middle = mover["xyz"] + local @ axes
    T = np.tile(np.eye(4), (len(middle), 1, 1))
    T[:, :3, :3] = axes / sigma[:, :, None]
    T[:, :3, 3] = -np.einsum("nij,nj->ni", T[:, :3, :3], middle)
    return middle, T, np.array(plume.extinction_per_m)


# --- in the image --------------------------------------------------------------------------------


def seen_in_spray(
    radiance: Image, cloud: Puffs, camera: Camera, distance_m: Image, airlight: Image
) -> Image:
    """Radiance (H, W, 3) with the puffs before it; the same array where none is in view.

    Args:
      distance_m: (H, W) of the scene, infinite for the sky; puffs behind it are hidden.
      airlight: the map of daylight.airlight.
    """
    boxes = _boxes(cloud, camera)
    boxes = boxes[_in_view(boxes)]
    if not len(boxes):
        return radiance
    (left, top), (right, bottom) = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    window = np.s_[top:bottom, left:right]
    view = _cropped(camera, left, top, right, bottom)
    step = -(-camera.wh[0] // _COLUMNS)
    depth = at_all_pixels(partial(optical_depth, cloud), view, distance_m[window], step=step)
    small = coarser(view, 4 * step)
    air = seen_through(airlight, small.K, small.T_world_cam[:3, :3], small.wh)
    added = enlarged(air, view.wh, 4 * step) - radiance[window]
    added *= -np.expm1(-np.maximum(depth, 0))
    seen = radiance.copy()
    seen[window] += added
    return seen


def optical_depth(cloud: Puffs, camera: Camera, distance_m: Image) -> Image:
    """Of all puffs (h, w, 1) along the camera's rays, up to where they end."""
    unit = directions(camera)
    depth = np.zeros((*distance_m.shape, 1), np.float32)
    boxes = _boxes(cloud, camera)
    for i in np.flatnonzero(_in_view(boxes)):
        left, top, right, bottom = boxes[i]
        window, T = np.s_[top:bottom, left:right], cloud.T_puff_world[i]
        along = unit[window] @ T[:3, :3].T.astype(np.float32)
        start = transform_points(T, camera.centre).astype(np.float32)
        length = gaussian_length(start, along, distance_m[window])
        depth[window][..., 0] += np.float32(cloud.extinction[i]) * length
    return depth


def gaussian_length(start: Image, along: Image, end: Image) -> Image:
    """∫ exp(−|start + t·along|²/2) dt from 0 to ``end`` (...).

    ``start`` (3,) and ``along`` (..., 3), of any length, are in standard deviations.
    """
    a = np.einsum("...k,...k->...", along, along)
    b = along @ start
    scale = np.sqrt(2 * a)
    before = b / scale
    closest = np.exp(np.minimum(before**2 - start @ start / 2, 0))
    share = erf(scale * end / 2 + before) - erf(before)
    return np.asarray(closest * share / scale * float(np.sqrt(np.pi)))


def _boxes(cloud: Puffs, camera: Camera) -> NDArray[np.int64]:
    """What part of the image each puff can touch (N, 4): left, top, right, bottom [px].

    The last two are exclusive. It is all of the image if the puff reaches the camera's plane.
    """
    cube = _REACH * np.array([[x, y, z, 1 / _REACH] for x in (-1, 1) for y in (-1, 1)
                              for z in (-1, 1)])  # fmt: skip
    T_cam_puff = camera.T_cam_world @ np.linalg.inv(cloud.T_puff_world)
    corners = cube @ T_cam_puff[:, :3].transpose(0, 2, 1)
    near = corners[..., 2] < _NEAR_M
    uv = project(camera.K, np.where(near[..., None], 1.0, corners))
    first, last = np.floor(uv.min(axis=1)), np.ceil(uv.max(axis=1)) + 1
    boxes = np.clip(np.hstack([first, last]), 0, [*camera.wh, *camera.wh]).astype(np.int64)
    boxes[near.any(axis=1)] = 0, 0, *camera.wh
    boxes[near.all(axis=1)] = 0
    return boxes


def _in_view(boxes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which boxes (N, 4) are not empty."""
    return np.asarray((boxes[:, 2:] > boxes[:, :2]).all(axis=1))


def _cropped(camera: Camera, left: int, top: int, right: int, bottom: int) -> Camera:
    K = camera.K.copy()
    K[:2, 2] -= left, top
    return Camera(K, camera.T_world_cam, (right - left, bottom - top))
