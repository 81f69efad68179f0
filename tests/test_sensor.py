"""From radiance to bytes."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from simgen import lens
from simgen.metering import Exposure, expose
from simgen.sensor import develop
from simgen.tone import LUMA_WEIGHTS, WHITE, tone_curve

IDEAL = Exposure(1.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def grey(value: float, hw: tuple[int, int] = (60, 80)) -> np.ndarray:
    return np.full((*hw, 3), value, np.float32)


def linear_brightness(image: np.ndarray) -> np.ndarray:
    """(H, W) exposed values that an ideal sensor's grey image shows."""
    ramp = np.linspace(0, WHITE, 200_001, dtype=np.float32)
    levels = develop(np.repeat(ramp[None, :, None], 3, axis=2), IDEAL, rng=rng())[0, :, 1]
    middle = [ramp[levels == k].mean() for k in range(255)]
    return np.array([*middle, np.nan])[image[..., 1]]


def test_brighter_light_never_gives_a_darker_pixel():
    ramp = np.linspace(0, 12, 3000, dtype=np.float32).reshape(1, -1, 1).repeat(3, axis=2)
    image = develop(ramp, IDEAL, rng=rng())
    assert (np.diff(image[0, :, 0].astype(int)) >= 0).all()
    assert image[0, 0, 0] == 0
    assert image[0, -1, 0] == 255


def test_the_ideal_sensor_is_tone_curve_and_rounding_alone():
    """Against the formula, in float64, on greys."""
    x = np.geomspace(1e-3, WHITE, 500)
    y = tone_curve(x, IDEAL.contrast)
    srgb = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    radiance = np.repeat(x.astype(np.float32)[None, :, None], 3, axis=2)
    image = develop(radiance, IDEAL, rng=rng())[0, :, 1]
    assert np.abs(image - 255 * srgb).max() < 0.53  # rounding, and steps of the tables


def test_the_tone_curve_has_a_toe_and_a_shoulder():
    x = np.geomspace(1e-4, WHITE, 400)
    slope = np.diff(np.log(tone_curve(x, 1.5))) / np.diff(np.log(x))
    assert slope[0] == pytest.approx(1.5, rel=1e-2)
    assert (np.diff(slope) < 0).all()
    assert slope[-1] < 0.1


@pytest.mark.parametrize("brightness", [0.05, 0.5, 3.0])
def test_the_tone_curve_keeps_the_hue(brightness):
    """The middle one of R, G, B lies at the same share of the way from the smallest to largest."""
    light = brightness * np.array([1.5, 0.8, 0.4], np.float32)
    image = develop(np.broadcast_to(light, (4, 4, 3)), IDEAL, rng=rng())[0, 0] / 255
    shown = ((image + 0.055) / 1.055) ** 2.4
    share = (shown[1] - shown[2]) / (shown[0] - shown[2])
    assert share == pytest.approx(0.4 / 1.1, abs=0.02)


DOTS = [(30, 40), (31, 40), (29, 35), (52, 71), (5, 63), (33, 8)]


@pytest.mark.parametrize("ij", DOTS)
@pytest.mark.parametrize("width", [1, 4])
def test_the_lens_never_shifts_a_dot(ij, width):
    """Centre of mass of its blur, near the middle and near the corners, at two widths."""
    dot = np.zeros((64 * width, 80 * width), np.float32)
    row, column = (k * width for k in ij)
    dot[row, column] = 1.0
    spread = lens.defocused(dot, (0.4 * width, 0.7 * width)).astype(np.float64)
    centre = [(spread.sum(axis=1 - k) * np.arange(dot.shape[k])).sum() for k in (0, 1)]
    np.testing.assert_allclose(np.array(centre) / spread.sum(), [row, column], atol=1e-5)


@pytest.mark.parametrize("offset", range(5))
def test_glare_surrounds_its_source_evenly(offset):
    dot = np.zeros((601, 640, 3), np.float32)
    row, column = 300 + offset, 320 - 2 * offset
    dot[row, column] = 1.0
    light = lens.with_glare(dot, 0.04)[..., 1].astype(np.float64)
    assert light.sum() == pytest.approx(1.0, abs=1e-4)
    assert light[row, column] == pytest.approx(0.967, abs=5e-3)
    centre = [(light.sum(axis=1 - k) * np.arange(light.shape[k])).sum() for k in (0, 1)]
    np.testing.assert_allclose(centre, [row, column], atol=1e-3)


def test_a_dot_stays_where_it_is_in_the_picture():
    """The whole chain without noise: centre of mass of the brightness above the background."""
    light = grey(0.2, (90, 120))
    light[41:44, 70:73] = 0.5
    camera = Exposure(
        1.0, vignetting=0.0, blur_px=(0.5, 0.7), demosaic_px=0.34, saturation=1.2,
        sharpening=0.5, sharpening_px=1.0,
    )  # fmt: skip
    extra = linear_brightness(develop(light, camera, rng=rng())) - 0.2
    extra = np.where(np.abs(extra) > 0.004, extra, 0)
    centre = [(extra.sum(axis=1 - k) * np.arange(extra.shape[k])).sum() for k in (0, 1)]
    np.testing.assert_allclose(np.array(centre) / extra.sum(), [42, 71], atol=1e-3)


def test_noise_has_the_variance_of_its_electrons():
    noisy_one = replace(IDEAL, electrons=8000.0, read_noise=30.0, saturation=1.0)
    noisy = linear_brightness(develop(grey(0.5, (300, 300)), noisy_one, rng=rng()))
    assert noisy.mean() == pytest.approx(0.5, abs=2e-3)
    assert noisy.std() == pytest.approx(np.sqrt(0.5 * 8000 + 30**2) / 8000, rel=0.05)


def test_interpolated_colours_have_a_grain():
    plain = replace(IDEAL, electrons=500.0, read_noise=2.0)
    grain = replace(plain, demosaic_px=0.34)
    one, other = (
        linear_brightness(develop(grey(0.5, (200, 200)), e, rng=rng())) for e in (plain, grain)
    )
    assert other.std() < 0.85 * one.std()
    assert np.corrcoef(one[:, 1:].ravel(), one[:, :-1].ravel())[0, 1] < 0.02
    assert np.corrcoef(other[:, 1:].ravel(), other[:, :-1].ravel())[0, 1] > 0.1


def test_vignetting_darkens_corners_only():
    image = develop(grey(0.5, (61, 81)), replace(IDEAL, vignetting=0.3), rng=rng())
    brightness = linear_brightness(image)
    assert brightness[0, 0] == pytest.approx(0.5 * 0.7, abs=0.01)
    assert brightness[30, 40] == pytest.approx(0.5, abs=0.005)


def test_sharpening_steepens_edges_and_leaves_areas_alone():
    edge = grey(0.1)
    edge[:, 40:] = 0.3
    soft = develop(edge, replace(IDEAL, blur_px=(0.6, 0.8)), rng=rng()).astype(int)
    sharp = develop(
        edge, replace(IDEAL, blur_px=(0.6, 0.8), sharpening=0.5, sharpening_px=1.0), rng=rng()
    ).astype(int)
    assert np.ptp(np.diff(sharp[30, :, 0])) > 1.1 * np.ptp(np.diff(soft[30, :, 0]))
    np.testing.assert_array_equal(sharp[:, :30], soft[:, :30])


def test_saturation_moves_colours_away_from_their_grey():
    light = np.broadcast_to(np.array([0.2, 0.15, 0.1], np.float32), (4, 4, 3))
    pale, vivid = (
        develop(light, replace(IDEAL, saturation=s), rng=rng())[0, 0].astype(int)
        for s in (1.0, 1.3)
    )
    assert np.ptp(vivid) > 1.2 * np.ptp(pale)
    assert (vivid - pale) @ LUMA_WEIGHTS == pytest.approx(0, abs=2)


def test_a_developed_image_follows_from_the_stored_exposure():
    light = rng().uniform(0.1, 3, (54, 96, 3)).astype(np.float32)
    exposure = expose("camera", [light], rng=rng())[0]
    stored = Exposure(**json.loads(json.dumps(asdict(exposure))))
    images = [develop(light, e, rng=np.random.default_rng(5)) for e in (exposure, stored)]
    np.testing.assert_array_equal(*images)
