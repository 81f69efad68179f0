"""Clear skies from noon to night, twilight, fog."""

from __future__ import annotations

import numpy as np
import pytest

from simgen import atmosphere
from simgen.atmosphere import clear_dome, fog_diffusion, fog_transmittance, measured_klx, sun_klx
from simgen.color import luminance
from simgen.errors import UserError
from simgen.recipe import DaylightTable, SkySpec, checked
from simgen.skymap import dome_directions, illuminance


def sky(elevation: float, azimuth: float = 30.0) -> SkySpec:
    return SkySpec("dusk", "clear", elevation, azimuth, 0.0, 3.0, 3e4, 0.0, 0.0)


def ground_klx(elevation: float) -> float:
    """Sky and sun on level ground."""
    s = sky(elevation)
    level = max(float(atmosphere.sun_direction(s)[2]), 0.0)
    return float(luminance(illuminance(clear_dome(s)) + level * sun_klx(s)))


@pytest.mark.parametrize("elevation,lux", [(0.0, 759), (-0.8, 453), (-6.0, 3.41), (-12.0, 0.0083),
                                           (-18.0, 0.00065)])  # fmt: skip
def test_measured_illuminance_is_that_of_the_tables(elevation, lux):
    assert measured_klx(elevation) * 1000 == pytest.approx(lux, rel=0.05)


def test_the_ground_gets_the_measured_light_of_twilight():
    for elevation in (-5.5, -3.0, -1.0):
        assert ground_klx(elevation) == pytest.approx(measured_klx(elevation), rel=0.05)


def test_light_on_the_ground_grows_steadily_with_the_sun_from_night_to_day():
    """Its logarithm has no step: not at sunset, nor where the day model takes over."""
    klx = np.array([ground_klx(e) for e in np.arange(-8.0, 8.0, 0.25)])
    growth = np.diff(np.log(klx))
    assert (growth > 0).all()
    assert growth.max() < 0.35
    assert np.abs(np.diff(growth)).max() < 0.2


def test_twilight_glows_where_the_sun_went_down_and_is_blue_above():
    dome, d = clear_dome(sky(-4.0)), dome_directions(atmosphere.COARSE)
    towards = d @ atmosphere.direction(3.0, 30.0)
    glow, zenith = dome[towards > 0.998].mean(axis=0), dome[0].mean(axis=0)
    opposite = dome[d @ atmosphere.direction(3.0, -150.0) > 0.998].mean(axis=0)
    assert glow[0] > 1.5 * glow[2]
    assert zenith[2] > 1.5 * zenith[0]
    assert luminance(glow) > 5 * luminance(opposite)


def test_fog_hides_the_sky_and_turns_its_light_diffuse():
    assert fog_transmittance(0.5, 60.0) < 1e-3
    assert 0.3 < fog_diffusion(60.0) < fog_diffusion(1000.0) < 1.0
    assert fog_transmittance(0.1, atmosphere.CLEAR_AIR_M) == 1.0


def test_a_sun_far_below_the_horizon_is_refused():
    with pytest.raises(UserError, match="-18 <= low <= high <= 70"):
        checked(DaylightTable, {"share": 1, "sun_elevation_deg": [-30, -30]}, "file.toml")
