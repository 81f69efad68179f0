"""The renderer's camera is ours: pose, axes, focal length, principal point and half a pixel."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from small_scenes import camera, parallelogram, scene_of

from simgen import groundtruth as gt
from simgen import render as renderer
from simgen.geometry import project, transform_points
from simgen.render import load_sensor, render

pytestmark = pytest.mark.usefixtures("mitsuba_active")

WH = (64, 48)
CAMERAS = [
    ((0, 0, 0), (0, 0, 0), (0.0, 0.0)),
    ((0.2, -0.3, 0.1), (3, -4, 25), (7.3, -5.6)),
    ((-0.1, 0.2, -0.2), (-5, 6, -140), (-6.1, 4.9)),
]


def polygon_centroid(uv):
    """Centroid of a polygon (N, 2) by the shoelace formula."""
    x, y = uv.T
    x1, y1 = np.roll(uv, -1, axis=0).T
    cross = x * y1 - x1 * y
    return np.array([(x + x1) @ cross, (y + y1) @ cross]) / (3 * cross.sum())


def intensity_centroid(image, outline):
    """Centroid of the light in and near an outline (N, 2)."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    (u0, v0), (u1, v1) = outline.min(axis=0) - 1, outline.max(axis=0) + 1
    light = image * ((u >= u0) & (u <= u1) & (v >= v0) & (v <= v1))
    return np.array([(u * light).sum(), (v * light).sum()]) / light.sum()


@pytest.fixture(params=range(len(CAMERAS)))
def cam(request):
    """A camera: straight; tilted; nearly upside down. The last two with an off-centre axis."""
    centre, turn_deg, off_centre_px = CAMERAS[request.param]
    return camera(centre, turn_deg, wh=WH, f_px=40.0, off_centre_px=off_centre_px)


def in_view(cam, corner, edge_a, edge_b, **look):
    """A parallelogram given in the axes of the camera."""
    R = cam.T_world_cam[:3, :3]
    return parallelogram(
        cam.centre + R @ np.array(corner), R @ np.array(edge_a), R @ np.array(edge_b), **look
    )


def test_bright_patches_are_rendered_where_projection_puts_them(cam, worst):
    spots = [(-2.3, -1.7, 5.0), (1.1, -1.9, 5.0), (-2.0, 0.9, 5.0), (1.0, 1.0, 5.0)]
    white, black = (0.8, 0.8, 0.8), (0.0, 0.0, 0.0)
    patches = [in_view(cam, s, (1, 0, 0), (0, 1, 0.4), color=white) for s in spots]
    dark = in_view(cam, (-40, -40, 9), (80, 0, 0), (0, 80, 0), color=black)
    radiance, *_ = render(scene_of([*patches, dark]), cam, spp=64, denoise=False, seed=1)
    image = radiance.mean(axis=2)
    outlines = [project(cam.K, transform_points(cam.T_cam_world, p.vertices)) for p in patches]
    error = np.stack([intensity_centroid(image, o) - polygon_centroid(o) for o in outlines])
    worst("centroid of a rendered patch against projection, each", error, 0.15)
    worst("centroids of four rendered patches against projection", error.mean(axis=0), 0.05)


def test_rendered_distance_is_that_of_the_pixel_centres(cam, worst):
    """Shift and offset between the two images, fitted: half a pixel or 1 cm would show."""
    wall = in_view(cam, (-90, -90, 30), (180, 0, -30), (0, 180, -20))
    scene = scene_of([wall])
    _, features, _ = render(scene, cam, spp=1, denoise=False, seed=2)
    v, u = np.mgrid[: WH[1], : WH[0]]
    x, y = (u - cam.K[0, 2]) / 40.0, (v - cam.K[1, 2]) / 40.0
    stretch = np.sqrt(1 + x**2 + y**2)
    ours = gt.depth(gt.look(scene, cam)) * stretch
    dv, du = np.gradient(ours)
    columns = np.stack([du, dv, stretch], axis=-1).reshape(-1, 3)
    *shift, offset = np.linalg.lstsq(columns, (features.distance_m - ours).ravel(), rcond=None)[0]
    worst("shift between rendered distance and depth", shift, 0.05)
    worst("offset of rendered distance", offset, 0.01, "m")


def test_the_sensors_rays_are_those_of_the_pixel_centres(cam, worst):
    """Without sampling: the sensor is asked for the ray through each pixel's middle."""
    import mitsuba as mi

    sensor = load_sensor(cam)
    for u, v in ((0, 0), (63, 0), (0, 47), (63, 47), (31, 11)):
        middle = mi.Point2f((u + 0.5) / WH[0], (v + 0.5) / WH[1])
        ray, _ = sensor.sample_ray(0.0, 0.0, middle, mi.Point2f(0.5, 0.5))
        origin, direction = (np.array(x, dtype=np.float64).ravel() for x in (ray.o, ray.d))
        point = origin + 10 * direction
        worst(
            "sensor rays against projection",
            project(cam.K, transform_points(cam.T_cam_world, point)) - [u, v],
            1e-3,
        )


@pytest.mark.usefixtures("mitsuba_active")
def test_the_sky_we_add_is_the_sky_that_the_renderer_sees() -> None:
    """Two routes to the sky behind everything: our lookup of the map, and Mitsuba's."""
    import mitsuba as mi

    from simgen import render, skymap
    from simgen.scene import _sky_dict

    d = skymap.directions((128, 256))
    sky = (1.5 + np.sin(3 * d) * np.cos(2 * d[..., ::-1])).astype(np.float32)
    seen = camera(turn_deg=(-25.0, 40.0, 10.0))
    scene = mi.load_dict({"type": "scene", "sky": _sky_dict(sky)})
    path = mi.load_dict({"type": "path", "max_depth": 1})
    theirs = np.array(mi.render(scene, integrator=path, sensor=render.load_sensor(seen), spp=16))
    ours = skymap.seen_through(sky, seen.K, seen.T_world_cam[:3, :3], seen.wh)
    np.testing.assert_allclose(ours, theirs[..., :3], atol=0.03)


def test_passes_of_one_seed_see_the_same_samples(cam):
    """Radiance and albedo are divided sample by sample: as if one integrator had held both."""
    import mitsuba as mi

    patch = in_view(cam, (-2, -2, 5), (4, 0, 1), (0, 3, 0.4), color=(0.8, 0.3, 0.1))
    scene, sensor = scene_of([patch]), load_sensor(cam)
    nested = mi.load_dict({"type": "aov", "aovs": "albedo:albedo", "paths": renderer._PATHS})
    both = renderer._rendered(scene, nested, sensor, 2, 7)
    paths, albedo = renderer._paths_and_albedo(scene, sensor, 2, 7)
    assert albedo.max() > 0.5
    np.testing.assert_array_equal(both, np.concatenate([paths, albedo], axis=-1))


def test_first_hits_are_those_of_the_renderers_own_integrators(cam):
    import mitsuba as mi

    patch = in_view(cam, (-2, -2, 5), (4, 0, 1), (0, 3, 0.4), color=(0.8, 0.3, 0.1))
    scene, sensor = scene_of([patch]), load_sensor(cam, "multijitter")
    surface, distance = (
        renderer._rendered(scene, mi.load_dict(x), sensor, 16, 7)
        for x in (renderer._SURFACE, renderer._DISTANCE)
    )
    albedo, coverage, normal, distance_m = renderer._first_hits(scene, sensor, 16, 7)
    assert 0 < coverage.mean() < 1
    np.testing.assert_array_equal(np.concatenate([albedo, normal], axis=-1), surface)
    np.testing.assert_array_equal(coverage, distance[..., 3])
    np.testing.assert_array_equal(distance_m, distance[..., 0])


def test_rendering_does_not_load_torch() -> None:
    """PyTorch, where it is installed, would cost every worker 0.3 GiB."""
    code = "import sys, simgen.denoiser; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
