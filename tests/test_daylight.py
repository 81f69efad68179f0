"""Sun, sky and haze."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from simgen import atmosphere, checks, clouds, daylight
from simgen.atmosphere import clear_dome, sun_direction, sun_klx, transmittance
from simgen.color import luminance
from simgen.daylight import environment, is_night, night_share
from simgen.recipe import DaylightTable, SkySpec, WeatherTable, draw_sky, load_presets
from simgen.samples import LAMPS_BELOW_DEG
from simgen.skymap import DOME_HW, SKY_HW, directions, dome_directions, enlarged, illuminance


def sky(
    elevation: float = 40.0, cover: float = 0.0, azimuth: float = 30.0, visibility: float = 3e4
) -> SkySpec:
    return SkySpec("noon", "clear", elevation, azimuth, cover, 3.0, visibility, 0.0, 0.0)


def solid_angles() -> np.ndarray:
    d = directions()
    return np.sqrt(1 - d[..., 2] ** 2) * (np.pi / SKY_HW[0]) * (2 * np.pi / SKY_HW[1])


@cache
def make(s: SkySpec) -> np.ndarray:
    """Painted once, for all tests that only look at it."""
    return environment(s, rng=np.random.default_rng(0))


def test_texels_cover_the_sphere_once():
    assert solid_angles().sum() == pytest.approx(4 * np.pi, rel=1e-4)
    np.testing.assert_allclose(np.linalg.norm(directions(), axis=-1), 1.0, atol=1e-6)


@pytest.mark.parametrize("elevation,azimuth", [(40.0, 30.0), (5.0, -170.0), (65.0, 179.9)])
def test_the_brightest_texel_is_the_sun(elevation, azimuth):
    s = sky(elevation, azimuth=azimuth)
    row, column = np.unravel_index(luminance(make(s)).argmax(), SKY_HW)
    angle = np.rad2deg(np.arccos(directions()[row, column] @ sun_direction(s)))
    assert angle < 0.5


def test_the_painted_sun_carries_its_illuminance():
    s = sky(50.0)
    image, clear = make(s)[: DOME_HW[0]], enlarged(clear_dome(s))
    near = (dome_directions() @ sun_direction(s)) > np.cos(np.deg2rad(1.0))
    excess = ((image - clear)[near] * solid_angles()[: DOME_HW[0]][near][:, None]).sum(axis=0)
    np.testing.assert_allclose(excess, sun_klx(s), rtol=0.05)


@pytest.mark.parametrize("elevation", [1.5, 5.0, 20.0, 65.0])
@pytest.mark.parametrize("cover", [0.0, 0.5, 1.0])
def test_no_sky_is_black_burnt_or_undefined(elevation, cover):
    image = make(sky(elevation, cover))
    assert image.dtype == np.float32, "a wider type would slow every later step down"
    assert np.isfinite(image).all()
    assert (image >= 0).all()
    assert luminance(image[: SKY_HW[0] // 2]).min() > 0.05


def test_a_low_sun_is_redder_than_a_high_one():
    low, high = (atmosphere.sun_transmittance(sky(e)) for e in (3.0, 60.0))
    assert low[0] / low[2] > 2 * high[0] / high[2]


def test_overcast_casts_no_sun():
    s = sky(40.0, 1.0)
    ratio = luminance(make(s)).max() / luminance(make(s)).mean()
    assert ratio < 20


def test_night_is_dark_but_not_black():
    image = make(sky(-12.0))
    assert 0 < luminance(image).mean() < 0.05


@pytest.mark.parametrize("visibility", [60.0, 300.0, 1000.0])
def test_the_airlight_is_the_foggy_sky_at_the_horizon(visibility):
    """No seam: what is far away ends in the colour of the sky behind it."""
    image = make(sky(30.0, 0.97, visibility=visibility))
    above = image[SKY_HW[0] // 2 - 6]
    np.testing.assert_allclose(daylight.airlight(image)[0], above, rtol=0.05)


def test_dense_fog_takes_shadows_away_but_not_the_light():
    clear, fog = make(sky(50.0)), make(sky(50.0, visibility=60.0))
    assert luminance(fog).max() < 3 * luminance(fog[: DOME_HW[0]]).mean()
    share = illuminance(fog[: DOME_HW[0]]) / illuminance(clear[: DOME_HW[0]])
    assert (share > 0.3).all()
    assert (share < 0.8).all()


def test_clouds_share_the_sky_as_asked():
    """The blue to red ratio tells them from the clear sky."""
    shares = []
    for cover in (0.2, 0.5, 0.8):
        light = daylight._light_on_clouds(sky(40.0), clear_dome(sky(40.0)))
        layers = [clouds.build(cover, light, rng=np.random.default_rng(i)) for i in range(2)]
        shares.append(np.mean([1 - x.clear[150:350].mean() for x in layers]))
    assert shares[0] < shares[1] < shares[2]
    assert 0.2 < shares[1] < 0.85


def test_a_closed_cloud_layer_leaves_no_gap():
    light = daylight._light_on_clouds(sky(40.0), clear_dome(sky(40.0)))
    assert clouds.build(1.0, light, rng=np.random.default_rng(0)).clear.max() < 0.02


def test_haze_at_the_visibility_leaves_two_percent():
    assert transmittance(np.float32(5000), 5000.0) == pytest.approx(0.02, rel=1e-3)
    assert transmittance(np.float32(0), 5000.0) == 1.0


@pytest.mark.usefixtures("mitsuba_active")
def test_the_renderer_sees_the_map_where_directions_say():
    """A bright texel, seen by a Mitsuba camera that looks that way, is in the image's middle."""
    import mitsuba as mi

    from simgen.scene import _sky_dict

    image = np.full((64, 128, 3), 0.01, np.float32)
    image[20, 37] = 100.0
    direction = directions((64, 128))[20, 37].astype(float)
    film = {"type": "hdrfilm", "width": 33, "height": 33, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at([0, 0, 0], direction.tolist(), [0, 0, 1])
    sensor = {"type": "perspective", "fov": 40.0, "to_world": to_world, "film": film}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor,
                          "sky": _sky_dict(image)})  # fmt: skip
    seen = np.array(mi.render(scene, spp=16))[..., 0]
    assert seen.max() > 10, "the bright texel is not in view at all"
    v, u = np.indices(seen.shape)
    assert (u * seen).sum() / seen.sum() == pytest.approx(16.0, abs=0.6)
    assert (v * seen).sum() / seen.sum() == pytest.approx(16.0, abs=0.6)


def mean_radiance(emitter: dict[str, object], look: np.ndarray) -> np.ndarray:
    """Seen by a narrow camera: (3,)."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().look_at([0, 0, 0], look.tolist(), [0, 0.1, 1])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "path", "max_depth": 1}, "emitter": emitter,
         "sensor": {"type": "perspective", "fov": 10.0, "to_world": to_world, "film": film}}
    )  # fmt: skip
    return np.array(mi.render(scene, spp=4))[..., :3].mean(axis=(0, 1))


@pytest.mark.usefixtures("mitsuba_active")
def test_our_sky_agrees_with_mitsubas():
    """Preetham (ours) against Hosek & Wilkie (sunsky): brighter and bluer in the same places.

    The two models differ by up to a factor of 2 between zenith and horizon.
    """
    import mitsuba as mi

    from simgen.scene import _sky_dict

    s = sky(35.0)
    sunsky = {"type": "sunsky", "sun_scale": 0.0, "turbidity": s.turbidity,
              "sun_direction": mi.ScalarVector3f(*sun_direction(s).tolist())}  # fmt: skip
    dome = enlarged(clear_dome(s))
    mine = _sky_dict(np.concatenate([dome, np.zeros_like(dome)]))
    azimuth = np.deg2rad(np.arange(0, 360, 30))
    looks = np.stack([np.cos(azimuth), np.sin(azimuth), 0.2 + 0.8 * (azimuth % 1.0)], axis=1)
    theirs, ours = (np.array([mean_radiance(e, d) for d in looks]) for e in (sunsky, mine))
    bright, blue = (np.corrcoef(np.log(f(theirs)), np.log(f(ours)))[0, 1]
                    for f in (luminance, lambda rgb: rgb[:, 2] / rgb[:, 0]))  # fmt: skip
    assert bright > 0.8
    assert blue > 0.8


def test_a_frame_is_checked_as_one_by_night_if_its_lamps_burn():
    for degrees in (-18.0, LAMPS_BELOW_DEG - 1e-9, LAMPS_BELOW_DEG, 40.0):
        spec = {"daylight": {"sun_elevation_deg": degrees}}
        assert checks.is_night(spec) == is_night(sky(degrees)) == (degrees < LAMPS_BELOW_DEG)


def test_the_expected_share_of_nights_is_that_of_the_draws():
    presets = load_presets("daylight", DaylightTable)
    weather = load_presets("weather", WeatherTable)
    drawn = [is_night(draw_sky(presets, weather, seed=(0, i, 0))) for i in range(1000)]
    expected = night_share(presets)
    assert 0.1 < expected < 0.5
    assert abs(np.mean(drawn) - expected) < 4 * np.sqrt(expected * (1 - expected) / len(drawn))
    assert night_share({"night": presets["night"]}) == 1.0
    assert night_share({"noon": presets["noon"]}) == 0.0
