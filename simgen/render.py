"""Scene and camera → linear radiance, denoised. The only module that renders.

Two passes: a path tracer with few samples, and a cheap first-hit pass with many that measures
albedo, normals and distance. The denoiser works on *irradiance* (radiance / albedo of the same
samples); multiplying by the well-sampled albedo brings the texture back untouched. The sky is
added last and never denoised.

Mitsuba's camera has x to the left and y up where ours (OpenCV) has x right and y down: the flip
is here and nowhere else.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from simgen.atmosphere import transmittance
from simgen.denoiser import denoised
from simgen.mesh import IMAGE_ROWS, blocks
from simgen.rig import Camera
from simgen.samples import FEATURE_SPP, MAX_DEPTH
from simgen.scene import Scene
from simgen.skymap import seen_through

Image = NDArray[Any]
"""float32"""

RR_DEPTH = 1
"""Russian roulette from the first bounce: on an urban scene 2.3 instead of 5.8 s of CPU
time, and the same mean radiance to 4 digits."""
MIN_ALBEDO = 0.06
"""Irradiance of darker surfaces is not divided further: black would blow the noise up, and what
dark paint mirrors would spill over lighter neighbours. What is left of their albedo guides the
denoiser: without that, panes and seams of a black car were smeared into its paint. In a trial
before that, cars had 1.9 to 2.6 times the true power at 4 to 8 px with 0.03, 1.2 to 1.5 times so,
and with 0.1 the road lost a fifth of its finest octave (docs/scenes.md).
"""
EDGES_BELOW_M = 5000.0
"""In clearer air than this [m], a mean distance at an edge is as good."""
FLIP = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Features:
    """First-hit means over each pixel."""

    albedo: Image
    """(H, W, 3) of what surfaces cover, times their coverage"""
    normal: Image
    """(H, W, 3), 0 for the sky"""
    distance_m: Image
    """(H, W) mean distance of the surfaces in the pixel"""
    coverage: Image
    """(H, W) share of the pixel that surfaces cover"""
    sky: Image
    """(H, W, 3) radiance of the sky, times the share of the pixel that it fills"""


@dataclass(frozen=True)
class Timings:
    """Seconds per stage."""

    path: float
    features: float
    denoise: float


def render(
    scene: Scene, camera: Camera, *, spp: int, denoise: bool, seed: int
) -> tuple[Image, Features, Timings]:
    """Linear radiance (H, W, 3) without haze, and the first-hit features.

    Raises ArithmeticError if any of it is not finite.
    """
    start = time.perf_counter()
    surfaces, noisy_albedo = _trace_paths(scene, camera, spp, seed)
    traced = time.perf_counter()
    features = _trace_features(scene, camera, seed + 1)
    measured = time.perf_counter()
    if denoise:
        divisor = _lifted(features.albedo, features.coverage)
        left_over = np.ones_like(divisor)
        np.divide(features.albedo, divisor, out=left_over, where=divisor > 0)
        irradiance = denoised(surfaces / noisy_albedo, left_over, features.normal)
        surfaces = irradiance * divisor
    radiance = surfaces + features.sky
    if not np.isfinite(radiance).all():
        raise ArithmeticError("render: the radiance is not finite everywhere")
    done = time.perf_counter()
    return radiance, features, Timings(traced - start, measured - traced, done - measured)


def through_haze(
    radiance: Image, features: Features, camera: Camera, airlight: Image, visibility_m: float
) -> Image:
    """Adds the light of the air between camera and surfaces (Koschmieder) to (H, W, 3).

    ``airlight`` is the map of daylight.airlight. The sky is left alone: its map already holds the
    whole depth of the air.
    """
    lost = 1 - mean_transmittance(features, visibility_m)[..., None]
    hazy = _smooth_map_seen(airlight, camera)
    for rows in blocks(len(hazy), IMAGE_ROWS):
        hazy[rows] *= features.coverage[rows, :, None]
        hazy[rows] -= radiance[rows] - features.sky[rows]
        hazy[rows] *= lost[rows]
        hazy[rows] += radiance[rows]
    return hazy


def mean_transmittance(features: Features, visibility_m: float) -> Image:
    """Of the surfaces in each pixel, of which only the mean distance is known.

    At an edge that would be a distance at which nothing is. A pixel is taken as a mixture of what
    is nearest and farthest around it, in the proportion that gives its mean. The sky does not
    count.
    """
    if visibility_m >= EDGES_BELOW_M:
        return transmittance(features.distance_m, visibility_m)
    around = np.ones((3, 3), np.uint8)
    distance_m, covered = features.distance_m, features.coverage > 0
    far = cv2.dilate(distance_m, around)
    near = np.minimum(cv2.erode(np.where(covered, distance_m, far), around), far)
    share = (far - distance_m) / np.maximum(far - near, 1e-6)
    through_near, through_far = (transmittance(d, visibility_m) for d in (near, far))
    mean: Image = through_far + share * (through_near - through_far)
    return mean


def _smooth_map_seen(sky_map: Image, camera: Camera, step: int = 8) -> Image:
    """A map without detail at all pixels (H, W, 3), read at every ``step``-th and enlarged."""
    w, h = camera.wh
    small = (-(-w // step), -(-h // step))
    to_small = np.array([[small[0] / w, 0, 0], [0, small[1] / h, 0], [0, 0, 1]])
    K = to_small @ camera.K
    K[:2, 2] += 0.5 * np.diag(to_small)[:2] - 0.5
    coarse = seen_through(sky_map, K, camera.T_world_cam[:3, :3], small)
    fine: Image = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_LINEAR)
    return fine


def load_sensor(camera: Camera, sampler: str = "independent") -> Any:
    """A Mitsuba pinhole with a box filter for one of our cameras.

    Raises ValueError for pixels that are not square, which Mitsuba cannot have.
    """
    (w, h), K = camera.wh, camera.K
    if not (np.isclose(K[0, 0], K[1, 1], rtol=1e-12) and K[0, 1] == 0):
        raise ValueError(f"load_sensor: expected fx = fy and no skew, got K = {K.tolist()}")
    to_world = camera.T_world_cam.copy()
    to_world[:3, :3] = to_world[:3, :3] @ FLIP
    # Principal point: Mitsuba counts from the image's outer corner, in shares of the image.
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.rad2deg(2 * np.arctan(0.5 * w / K[0, 0]))),
            "principal_point_offset_x": float(0.5 - (K[0, 2] + 0.5) / w),
            "principal_point_offset_y": float(0.5 - (K[1, 2] + 0.5) / h),
            "near_clip": 1e-3,  # Mitsuba measures distance from there
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "film": {
                "type": "hdrfilm", "width": w, "height": h, "pixel_format": "rgba",
                "component_format": "float32", "rfilter": {"type": "box"},
            },
            "sampler": {"type": sampler},
        }
    )  # fmt: skip


# In wavefronts, the same sampler and seed give the same camera rays, so that passes of one
# integrator each see the same samples. Nested in one "aov" integrator, they took twice the time
# (tests hold them equal). Scalar variants draw a pixel's samples one after the other: there, passes
# would part.
_PATHS = {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": RR_DEPTH, "hide_emitters": True}
_ALBEDO = {"type": "aov", "aovs": "albedo:albedo"}
_SURFACE = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
_DISTANCE = {"type": "depth"}


def _trace_paths(scene: Scene, camera: Camera, spp: int, seed: int) -> tuple[Image, Image]:
    """Radiance of the surfaces in view (H, W, 3), and the albedo (H, W, 3) of the same samples."""
    paths, albedo = _paths_and_albedo(scene, load_sensor(camera), spp, seed)
    return paths[..., :3], np.maximum(_lifted(albedo, paths[..., 3]), 1e-4)


def _paths_and_albedo(scene: Scene, sensor: Any, spp: int, seed: int) -> tuple[Image, Image]:
    """RGBA and albedo (H, W, 4), (H, W, 3) of the same samples."""
    if str(mi.variant()).startswith("scalar"):
        both = _rendered(scene, mi.load_dict({**_ALBEDO, "paths": _PATHS}), sensor, spp, seed)
        return both[..., :4], both[..., 4:]
    return (
        _rendered(scene, mi.load_dict(_PATHS), sensor, spp, seed),
        _rendered(scene, _first_hit_integrator(str(mi.variant())), sensor, spp, seed)[..., :3],
    )


def _trace_features(scene: Scene, camera: Camera, seed: int) -> Features:
    """Stratified samples: with independent ones a country road had 1.4 times the true power in
    the finest octave, so 1.2 times. With 8 of them, leaves against a bright sky had 1.24 times."""
    albedo, coverage, normal, distance = _first_hits(
        scene, load_sensor(camera, "multijitter"), FEATURE_SPP, seed
    )
    mean_distance = distance / np.maximum(coverage, 1e-6)
    sky = seen_through(scene.sky, camera.K, camera.T_world_cam[:3, :3], camera.wh)
    sky *= 1 - coverage[..., None]
    return Features(albedo, normal, mean_distance, coverage, sky)


def _first_hits(
    scene: Scene, sensor: Any, spp: int, seed: int
) -> tuple[Image, Image, Image, Image]:
    """Means over each pixel: albedo (H, W, 3), coverage (H, W), normal (H, W, 3), distance (H, W),
    all times the coverage."""
    if str(mi.variant()).startswith("scalar"):
        surface = _rendered(scene, mi.load_dict(_SURFACE), sensor, spp, seed)
        first = _rendered(scene, mi.load_dict(_DISTANCE), sensor, spp, seed)
        return surface[..., :3], first[..., 3], surface[..., 3:], first[..., 0]
    both = _rendered(scene, _first_hit_integrator(str(mi.variant())), sensor, spp, seed)
    return both[..., :3], both[..., 3], both[..., 4:7], both[..., 7]


@cache
def _first_hit_integrator(variant: str) -> Any:
    """What _ALBEDO, _SURFACE and _DISTANCE tell, of one ray: 16 samples for the price of 8.

    Mitsuba's classes belong to a ``variant``, so this one is made when that is known.
    """

    class FirstHit(mi.SamplingIntegrator):
        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            # Coherent: camera rays in packets take a third of the time.
            si = scene.ray_intersect(ray, mi.RayFlags.All, True, active)
            hit = active & si.is_valid()
            albedo = si.bsdf().eval_diffuse_reflectance(si, hit)
            n = si.sh_frame.n
            features = [dr.select(hit, x, 0.0) for x in (n.x, n.y, n.z, si.t)]
            return dr.select(hit, albedo, 0.0), hit, features

        def aov_names(self) -> list[str]:
            return ["normal.x", "normal.y", "normal.z", "distance"]

    return FirstHit(mi.Properties())


def _lifted(albedo: Image, coverage: Image) -> Image:
    """Albedo of at least MIN_ALBEDO on what surfaces cover."""
    return np.maximum(albedo, MIN_ALBEDO * coverage[..., None])


def _rendered(scene: Scene, integrator: Any, sensor: Any, spp: int, seed: int) -> Image:
    image = np.array(
        mi.render(scene.mi_scene, integrator=integrator, sensor=sensor, spp=spp,
                  seed=seed & 0xFFFFFFFF),
        dtype=np.float32,
    )  # fmt: skip
    dr.flush_malloc_cache()  # 0.4 GiB at 2560x1440, which the denoiser can have
    return image
