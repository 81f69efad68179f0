"""Image statistics on pictures whose numbers are known in advance."""

from __future__ import annotations

import numpy as np
import pytest

from simgen.geometry import pixel_grid
from simgen.statistics import (
    compare_octaves,
    correct_matches,
    gradient,
    kurtosis,
    octave_bands,
    photo_statistics,
    spectral_slope,
    warped,
)

HW = (180, 320)
EVERYWHERE = np.ones(HW, dtype=bool)


def noise(exponent: float, seed: int = 0, hw: tuple[int, int] = HW) -> np.ndarray:
    """Random picture (H, W) of standard deviation 1 whose power falls with frequency^-exponent."""
    white = np.random.default_rng(seed).standard_normal(hw)
    f = np.hypot(np.fft.fftfreq(hw[0])[:, None], np.fft.rfftfreq(hw[1]))
    f[0, 0] = np.inf
    picture = np.fft.irfft2(np.fft.rfft2(white) * f ** (-exponent / 2), hw)
    return picture / picture.std()


def wave(cycles_per_pixel: float) -> np.ndarray:
    return np.sin(2 * np.pi * cycles_per_pixel * pixel_grid(HW)[..., 0])


# --- photographs ---------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.0, 1.5, 2.5, 3.0])
def test_the_slope_of_power_law_noise_is_minus_its_exponent(exponent: float) -> None:
    slopes = [spectral_slope(noise(exponent, seed, (360, 640))) for seed in range(4)]
    assert np.mean(slopes) == pytest.approx(-exponent, abs=0.06)


def test_the_slope_depends_on_neither_contrast_nor_brightness() -> None:
    picture = noise(2.0)
    assert spectral_slope(30 + 7 * picture) == pytest.approx(spectral_slope(picture), abs=1e-9)


def test_a_ramp_has_the_gradient_of_its_steps() -> None:
    u, v = pixel_grid(HW)[..., 0], pixel_grid(HW)[..., 1]
    du, dv = gradient(3 * u - 2 * v)
    np.testing.assert_allclose(du[1:-1, 1:-1], 3.0)
    np.testing.assert_allclose(dv[1:-1, 1:-1], -2.0)


def test_kurtosis_is_3_for_normal_and_6_for_laplacian_values() -> None:
    rng = np.random.default_rng(0)
    assert kurtosis(rng.normal(2, 5, 400_000)) == pytest.approx(3, abs=0.05)
    assert kurtosis(rng.laplace(2, 5, 400_000)) == pytest.approx(6, abs=0.2)


def test_a_uniform_picture_is_flat_without_contrast_or_key_points() -> None:
    found = photo_statistics(np.full((*HW, 3), (200, 100, 50), dtype=np.uint8))
    assert (found.flat, found.contrast, found.keypoints) == (1.0, 0.0, 0.0)
    assert found.saturation == pytest.approx(0.75, abs=0.01)


def test_grey_levels_count_as_shares_of_255() -> None:
    halves = np.zeros((*HW, 3), dtype=np.uint8)
    halves[:, HW[1] // 2 :] = 255
    found = photo_statistics(halves)
    assert found.contrast == pytest.approx(0.5)
    assert found.saturation == 0
    assert found.flat == pytest.approx(1 - 2 / HW[1])


def test_key_points_are_counted_per_megapixel() -> None:
    tile = np.clip(128 + 40 * noise(2.0), 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)
    one, four = photo_statistics(tile), photo_statistics(np.tile(tile, (2, 2, 1)))
    assert one.keypoints > 500
    assert four.keypoints == pytest.approx(one.keypoints, rel=0.15)


# --- octaves -------------------------------------------------------------------------------------


@pytest.mark.parametrize("octave", range(4))
def test_a_wave_is_in_the_octave_of_its_frequency(octave: int) -> None:
    power = np.mean(octave_bands(wave(2 ** -(octave + 1.5)), 5) ** 2, axis=(1, 2))
    assert np.argmax(power) == octave
    assert power[octave] == pytest.approx(0.5, rel=0.08)
    assert power.sum() == pytest.approx(0.5, rel=0.05)


def test_the_powers_of_the_octaves_add_up_to_that_of_the_picture() -> None:
    picture = noise(0.0)
    power = np.mean(octave_bands(picture, 7) ** 2, axis=(1, 2))
    assert power.sum() == pytest.approx(picture.var(), rel=0.01)
    np.testing.assert_allclose(power[2:5] / power[1:4], 0.25, rtol=0.15)  # areas of rings


def test_noise_in_the_reference_does_not_count_as_texture() -> None:
    """A blurred picture is seen to have lost amplitude, though both references are noisy."""
    picture = octave_bands(noise(1.0), 4)
    a, b = (picture + octave_bands(noise(0.0, seed), 4) for seed in (1, 2))
    for octave in compare_octaves(0.7 * picture, a, b, EVERYWHERE):
        assert octave.kept == pytest.approx(0.7, rel=0.1)
        assert octave.power == pytest.approx(0.49, rel=0.2)
        assert octave.added == pytest.approx(0, abs=0.03)


def test_noise_in_the_rendering_counts_as_added_power() -> None:
    picture = octave_bands(noise(1.0), 4)
    other = octave_bands(noise(1.0, seed=1), 4)
    for octave in compare_octaves(picture + 0.5 * other, picture, picture, EVERYWHERE)[:3]:
        assert octave.kept == pytest.approx(1, abs=0.1)
        assert octave.added == pytest.approx(0.25, abs=0.06)
        assert octave.power == pytest.approx(octave.kept**2 + octave.added)


def test_octaves_are_compared_only_where_asked() -> None:
    picture, where = octave_bands(noise(1.0), 3), EVERYWHERE.copy()
    where[: HW[0] // 2] = False
    broken = np.where(where, picture, 100.0)
    for octave in compare_octaves(broken, picture, picture, where):
        assert octave.power == pytest.approx(1)


# --- two views -----------------------------------------------------------------------------------


def test_a_warped_image_shows_what_the_flow_points_at() -> None:
    right = np.hypot(*np.moveaxis(pixel_grid(HW) + 50, -1, 0))
    flow = np.broadcast_to(np.float32([-7.25, 3.5]), (*HW, 2))
    expected = np.hypot(*np.moveaxis(pixel_grid(HW) + 50 + flow, -1, 0))
    inner = (slice(20, -20), slice(20, -20))
    np.testing.assert_allclose(warped(right, flow)[inner], expected[inner], atol=1e-4)


def test_matches_along_the_flow_are_correct_within_the_tolerance() -> None:
    """The flow is linear in the pixel, so that its bilinear samples are exact."""
    flow = pixel_grid(HW) @ np.array([[0.1, 0.02], [-0.05, 0.0]]) - [20, 1]
    uv = np.random.default_rng(0).uniform(0, [HW[1] - 1, HW[0] - 1], (100, 2))
    end = uv + uv @ np.array([[0.1, 0.02], [-0.05, 0.0]]) - [20, 1]
    for error, correct in ((0.0, True), (1.45, True), (1.55, False)):
        moved = end + error * np.array([0.6, -0.8])
        assert (correct_matches(uv, moved, flow, EVERYWHERE, 1.5) == correct).all()


def test_a_match_beside_an_occluded_pixel_is_not_correct() -> None:
    visible = EVERYWHERE.copy()
    visible[10, 20] = False
    uv = np.array([[19.5, 10.0], [18.5, 10.0], [20.5, 9.5], [20.5, 11.5]])
    correct = correct_matches(uv, uv, np.zeros((*HW, 2)), visible, 1.5)
    assert correct.tolist() == [False, True, False, True]


def test_no_match_at_all_is_no_error() -> None:
    nothing = np.empty((0, 2))
    assert correct_matches(nothing, nothing, np.zeros((*HW, 2)), EVERYWHERE, 1.5).shape == (0,)
