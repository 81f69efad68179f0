"""From radiance to bytes."""

from __future__ import annotations

import numpy as np
import pytest

from simgen.sensor import Exposure, develop, draw_exposures, meter

IDEAL = Exposure(1.0, 1.0, 0.0, 0.0, 0.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_brighter_light_never_gives_a_darker_pixel():
    ramp = np.linspace(0, 12, 3000, dtype=np.float32).reshape(1, -1, 1).repeat(3, axis=2)
    image = develop(ramp, IDEAL, rng=rng())
    assert (np.diff(image[0, :, 0].astype(int)) >= 0).all()
    assert image[0, 0, 0] == 0
    assert image[0, -1, 0] == 255


def test_exposure_undoes_the_brightness_of_the_scene():
    scene = np.random.default_rng(1).uniform(0.1, 1.0, (40, 60, 3)).astype(np.float32)
    images = [
        develop(scene * k, Exposure(meter([scene * k]), 1, 0, 0, 0), rng=rng())
        for k in (1e-3, 1.0, 1e4)
    ]
    assert np.abs(images[0].astype(int) - images[1]).max() <= 1
    assert np.abs(images[2].astype(int) - images[1]).max() <= 1


def test_an_open_sky_does_not_darken_the_road():
    road = np.full((60, 40, 3), 0.1, np.float32)
    under_sky = road.copy()
    under_sky[:30] = 5.0
    assert meter([under_sky]) == pytest.approx(meter([road]))


def test_shot_noise_has_the_variance_of_its_electrons():
    grey = np.full((300, 300, 3), 0.5, np.float32)
    exposure = Exposure(1.0, 1.0, full_well=8000.0, read_noise=3.0, vignetting=0.0)
    noisy = develop(grey, exposure, rng=rng()).astype(float)
    clean = develop(grey, IDEAL, rng=rng()).astype(float)
    assert abs(noisy.mean() - clean.mean()) < 0.3
    step = 0.02
    slope = (develop(grey + step, IDEAL, rng=rng()).mean() - clean.mean()) / step
    expected = slope * np.sqrt(0.5 * 8000 + 9) / 8000
    assert noisy.std() == pytest.approx(expected, rel=0.15)


def test_the_cameras_of_a_rig_expose_together():
    exposures = draw_exposures("camera", 2.0, 4, rng=rng())
    assert {e.exposure for e in exposures} == {2.0}
    assert all(abs(e.gain - 1) < 0.06 for e in exposures)
    assert len({e.gain for e in exposures}) == 4
    assert len(set(draw_exposures("ideal", 2.0, 4, rng=rng()))) == 1


def test_vignetting_darkens_corners_only():
    grey = np.full((60, 80, 3), 0.5, np.float32)
    image = develop(grey, Exposure(1, 1, 0, 0, 0.3), rng=rng()).astype(int)
    assert image[30, 40, 0] - image[0, 0, 0] > 10
    assert image[30, 40, 0] == develop(grey, IDEAL, rng=rng())[30, 40, 0]
