"""Halos of lamps in fog: light that droplets scatter into the camera, once.

Where the air has an extinction β, a lamp of intensity I at distance d gives a ray, at h from it
where they are closest, the radiance

    L = β I exp(−β d) / (4π h) ∫ p(α) dα,

α being the angle by which light is turned at a point of the ray. It grows along the ray, from that
between ray and lamp at the camera to that at the surface where the ray ends. (With r the distance
from the lamp and t along the ray, dt / r² = dα / h.) In x = tan(α/2), which is elementary at both
ends, the integral is an arc tangent for the phase function

    p(α) ∝ 1 / (1 + g² − 2 g cos α),

that of Reynolds and McCormick, *Approximate two-parameter phase function for light scattering*
(JOSA 70, 1980), with their exponent 1 + a at a = 0 (Henyey and Greenstein have a = ½).

Every path is dimmed like the straight one, exp(−β d). One by way of a droplet is longer, little
where droplets turn light by little, as most do: of a lamp at 30 m in air of 100 m visibility, the
halo comes out 1 % too bright 3° beside the lamp, 8 % at 11° and 33 % at 29°, where it is faint.
Sun, Ramamoorthi, Narasimhan and Nayar, *A practical analytic single scattering model for real time
rendering* (SIGGRAPH 2005), from whom the geometry is, keep the detour and pay with a table.

Lamps cast no shadows into the air, but only those that the rig sees count: behind a wall a lamp
has no halo. Its intensity is what it sends towards the rig, which is what the droplets near the
line of sight, that turn light by little, receive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simgen.along_rays import at_all_pixels, directions
from simgen.atmosphere import extinction
from simgen.geometry import Array
from simgen.groundtruth import trace
from simgen.rig import Camera
from simgen.scene import Scene

Image = NDArray[Any]
"""float32"""

BELOW_M = 2000.0
"""visibility [m] from which on halos are left out"""
MOST_LIGHTS = 32
"""that a frame has, the strongest"""
LAMP_M = 0.5
"""Faces that glow in one cube of this size are one light."""
FORWARD = 0.9975
"""g: a mean cosine of 0.85, that of the droplets of fog (Bohren, *Multiple scattering*, 1987)"""
_COLUMNS = 320
"""cells of the coarse grid in a row"""
_FAR_M = 1e5
"""where rays to the sky end"""


@dataclass(frozen=True, eq=False)
class Lights:
    """Points that burn."""

    xyz: Array
    """(N, 3) in the world"""
    intensity: Array
    """(N, 3) towards the rig [kcd]"""
    radius_m: Array
    """(N,) of a disc as large as what burns"""


def lights(scene: Scene, cameras: Sequence[Camera], visibility_m: float) -> Lights:
    """What the cameras of a rig see to burn, the same for all of them; the strongest first.

    A face that only some of them see counts in proportion.
    """
    a, b, c = np.moveaxis(scene.glow.corners, 1, 0)
    middle, across = (a + b + c) / 3, np.cross(b - a, c - a) / 2
    seen_m2 = np.mean([_seen_area(scene, camera, middle, across) for camera in cameras], axis=0)
    middle, seen_m2, radiance = (
        array[seen_m2 > 0] for array in (middle, seen_m2, scene.glow.radiance)
    )
    cubes, of = np.unique(np.floor(middle / LAMP_M), axis=0, return_inverse=True)

    def total(weight: Array) -> Array:
        return np.asarray(np.bincount(of.ravel(), weight, len(cubes))[:, None], dtype=float)

    area = total(seen_m2)
    xyz = np.hstack([total(seen_m2 * x) for x in middle.T]) / area
    intensity = np.hstack([total(seen_m2 * color) for color in radiance.T])
    distance = np.linalg.norm(xyz - np.mean([c.centre for c in cameras], axis=0), axis=1)
    strength = intensity.sum(axis=1) * np.exp(-extinction(visibility_m) * distance) / distance
    first = np.argsort(-strength, kind="stable")[:MOST_LIGHTS]
    return Lights(xyz[first], intensity[first], np.sqrt(area[first, 0] / np.pi))


def _seen_area(scene: Scene, camera: Camera, middle: Array, across: Array) -> Array:
    """Area (G,) of the glowing faces as it appears from a camera; 0 behind others [m²]."""
    rays = middle - camera.centre
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    face = trace(scene, camera.centre, unit.T.astype(np.float32))
    projected = np.abs(np.einsum("gk,gk->g", unit, across))
    return np.asarray(projected * (face == scene.glow.face))


def scattered(
    shining: Lights, camera: Camera, distance_m: Image, visibility_m: float
) -> Image | np.float32:
    """Radiance (H, W, 3) of the halos before surfaces at ``distance_m`` (H, W); 0 without any."""
    if not len(shining.xyz):
        return np.float32(0)
    evaluate = partial(_halos, shining=shining, beta=extinction(visibility_m))
    step = -(-camera.wh[0] // _COLUMNS)
    return at_all_pixels(evaluate, camera, distance_m, step=step)


def _halos(camera: Camera, distance_m: Image, *, shining: Lights, beta: float) -> Image:
    """Radiance (h, w, 3); no lamp is smaller than the pixels, or its peak would be lost."""
    unit, end = directions(camera), np.minimum(distance_m, np.float32(_FAR_M))
    towards = (shining.xyz - camera.centre).astype(np.float32)
    distance = np.linalg.norm(towards, axis=1)
    radius = np.hypot(shining.radius_m, 0.5 / camera.K[0, 0] * distance)
    light = np.zeros((*end.shape, 3), np.float32)
    for i, intensity in enumerate(shining.intensity.astype(np.float32)):
        dim = halo(unit @ towards[i], float(distance[i]), end, float(radius[i]), beta)
        light += dim[..., None] * intensity
    return light


def halo(closest_m: Array, distance_m: float, end_m: Array, radius_m: float, beta: float) -> Array:
    """Radiance along rays per intensity of a lamp [1/m²].

    Args:
      closest_m: how far along each ray the lamp is closest; negative behind the camera.
      distance_m: of the lamp.
      end_m: where the rays end.
      radius_m: of the lamp: rays pass it at no less.
      beta: extinction of the air [1/m].
    """
    h2 = np.maximum(distance_m**2 - closest_m**2, 0) + radius_m**2
    h = np.sqrt(h2)
    start = _half_tangent(-closest_m, h, h2)
    end = _half_tangent(end_m - closest_m, h, h2)
    w = (1 - FORWARD) / (1 + FORWARD)
    turned = np.arctan2(w * (end - start), w**2 + start * end)
    dimmed = beta * float(np.exp(-beta * distance_m)) / (4 * np.pi)
    return np.asarray(dimmed * _NORM * turned / h)


def _half_tangent(t: Array, h: Array, h2: Array) -> Array:
    """x = tan(α/2) = (t + √(t² + h²)) / h at t beyond the closest point, without cancellation."""
    length = np.abs(t) + np.sqrt(t**2 + h2)
    return np.where(t > 0, length / h, h / length)


_NORM = 4 * FORWARD / (1 - FORWARD**2) / float(np.log((1 + FORWARD) / (1 - FORWARD)))
"""makes the mean of p over all directions 1, and its integral this times the arc tangent"""
