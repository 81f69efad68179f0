"""What the cameras of a rig agree on."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from simgen.metering import (
    DEMOSAIC_PX,
    ELECTRONS_PER_KCD_S,
    MAX_EXPOSURE,
    MAX_GAIN,
    MAX_TIME_S,
    MIDDLE_GREY,
    SKY_SHARE,
    Exposure,
    expose,
    meter,
    warmth,
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def road(radiance: float, hw: tuple[int, int] = (60, 96)) -> np.ndarray:
    """Grey with some texture, in kcd/m²."""
    texture = rng(1).uniform(0.8, 1.2, (*hw, 1))
    return (radiance * texture).astype(np.float32).repeat(3, axis=2)


@pytest.mark.parametrize("brightness", [0.03, 1.0, 30.0])
def test_exposure_undoes_the_brightness_of_the_day(brightness):
    assert meter([road(brightness)]) * brightness == pytest.approx(MIDDLE_GREY, rel=0.05)


def test_the_night_is_left_darker_than_the_day_but_never_black():
    shown = [meter([road(L)]) * L for L in (2e-3, 5e-4, 1e-4)]
    np.testing.assert_allclose(shown[1:], np.array([5e-4, 1e-4]) * MAX_EXPOSURE, rtol=0.02)
    assert shown[2] < shown[1] < shown[0] == pytest.approx(MIDDLE_GREY, rel=0.05)
    assert meter([road(0.0)]) == MAX_EXPOSURE


@pytest.mark.parametrize("sky", [0.15, 0.5, 5.0, 500.0])
def test_an_open_sky_darkens_the_road_but_by_one_stop_at_most(sky):
    under_sky = road(0.1)
    under_sky[:30] = sky
    stops = np.log2(meter([road(0.1)]) / meter([under_sky]))
    assert stops == pytest.approx(min(1.0, SKY_SHARE * np.log2(sky / 0.1)), abs=0.02)


def test_a_dark_wall_above_the_road_does_not_brighten_it():
    below_wall = road(0.1)
    below_wall[:30] = 0.01
    assert meter([below_wall]) == pytest.approx(meter([road(0.1)]))


def test_bright_walls_are_not_burnt_out():
    wall = road(0.1)
    wall[-10:] = 20.0
    assert meter([wall]) * 20.0 < 3.0


def test_the_cameras_of_a_rig_expose_together():
    exposures = expose("camera", [road(1.0)] * 4, rng=rng())
    individual = {"gain", "blur_px", "white_balance"}
    for name in asdict(exposures[0]):
        assert len({getattr(e, name) for e in exposures}) == (4 if name in individual else 1)
    assert all(abs(e.gain - 1) < 0.06 for e in exposures)


def test_an_ideal_sensor_has_an_exposure_and_nothing_else():
    assert expose("ideal", [road(1.0)] * 3, rng=rng()) == [Exposure(meter([road(1.0)]))] * 3


def test_electrons_are_those_of_light_and_time():
    """Day and night: what the shutter lets in at exposed value 1."""
    for radiance in (3.0, 1e-3, 1e-4):
        light = [road(radiance, (1440 // 8, 2560))]
        e = expose("camera", light, rng=rng())[0]
        assert e.electrons == pytest.approx(ELECTRONS_PER_KCD_S * e.time_s / e.exposure)
        assert 0 < e.time_s <= MAX_TIME_S
        assert 1 <= e.amplification <= 1.5 * MAX_GAIN


def test_a_dark_scene_is_noisier():
    day, dusk, night = (expose("camera", [road(L)], rng=rng())[0] for L in (3.0, 0.03, 1e-3))
    assert day.electrons == pytest.approx(dusk.electrons)
    assert day.time_s < dusk.time_s < night.time_s == MAX_TIME_S
    assert night.amplification > 4
    assert night.electrons < day.electrons / 4


def test_a_small_image_is_a_binned_large_one():
    large, small = (expose("camera", [road(1.0, (60, w))], rng=rng())[0] for w in (2560, 640))
    assert small.electrons == pytest.approx(16 * large.electrons)
    assert small.read_noise == pytest.approx(4 * large.read_noise)
    for name in ("blur_px", "demosaic_px", "sharpening_px"):
        wide, narrow = (np.array(getattr(e, name)) for e in (large, small))
        np.testing.assert_allclose(narrow, wide / 4)
    assert 0.25 < large.blur_px[0] < large.blur_px[1] < 0.8


def test_white_balance_takes_most_of_a_cast_away():
    warm = road(1.0) * np.array([1.4, 1.0, 0.6], np.float32)
    assert warmth([warm]) == pytest.approx(np.log(1.4 / 0.6), abs=0.02)
    left = []
    for seed in range(40):
        red, _, blue = expose("camera", [warm], rng=rng(seed))[0].white_balance
        left.append(np.log(1.4 * red / (0.6 * blue)) / np.log(1.4 / 0.6))
    assert 0.1 < np.mean(left) < 0.4
    assert np.std(left) > 0.05


def test_a_grey_scene_keeps_its_brightness_and_nearly_its_grey():
    for seed in range(20):
        factors = np.array(expose("camera", [road(1.0)], rng=rng(seed))[0].white_balance)
        assert factors @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0)
        assert np.abs(factors - 1).max() < 0.08


def test_the_demosaicing_blur_leaves_the_noise_that_interpolation_leaves():
    """Of R and B: one pixel in four is measured, two are means of two, one is a mean of four."""
    from simgen.lens import blurred

    noise = rng().standard_normal((500, 500)).astype(np.float32)
    expected = (1 + 1 / 2 + 1 / 2 + 1 / 4) / 4
    assert blurred(noise, DEMOSAIC_PX).var() == pytest.approx(expected, rel=0.03)
