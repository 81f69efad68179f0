from __future__ import annotations

import numpy as np
import pytest

from simgen import world
from simgen.color import linear_from_srgb, luminance
from simgen.sheets import (
    RISE_M,
    WALLS,
    Sheet,
    _Canvas,
    _courses,
    _enlarged,
    bark_sheet,
    filtered,
    roof_sheet,
    turf_sheet,
    wall_sheet,
)

COLOR = (0.3, 0.2, 0.15)


def drawn(kind: str, seed: int = 0, size_px: int = 256, metres: float = 4.0) -> Sheet:
    rng = np.random.default_rng(seed)
    if kind == "roof":
        return roof_sheet(rng=rng, size_px=size_px, metres=metres)
    if kind == "bark":
        return bark_sheet(rng=rng, size_px=size_px, metres=metres)
    if kind == "turf":
        return turf_sheet(rng=rng, size_px=size_px, metres=metres)
    return wall_sheet(kind, COLOR, rng=rng, size_px=size_px, metres=metres)


ALL = pytest.mark.parametrize("kind", [*WALLS, "roof", "bark", "turf"])


@ALL
def test_sheets_are_srgb_bytes_and_follow_from_the_generator(kind: str) -> None:
    a, b, c = (drawn(kind, seed) for seed in (1, 1, 2))
    assert a.image.shape == (256, 256, 3)
    assert a.image.dtype == np.uint8
    assert np.array_equal(a.image, b.image)
    assert not np.array_equal(a.image, c.image)


@ALL
@pytest.mark.parametrize("axis", [0, 1])
def test_the_border_is_no_seam(kind: str, axis: int) -> None:
    """Opposite borders differ no more than neighbouring rows inside do at most."""
    for seed in range(2):
        image = drawn(kind, seed).image.astype(float)
        step = np.abs(np.roll(image, -1, axis=axis) - image).mean(axis=(1 - axis, 2))
        assert step[-1] <= 1.1 * step[:-1].max()


@pytest.mark.parametrize("shape", [(8, 8), (4, 64)])
def test_interpolation_commutes_with_wrapping_around(shape: tuple[int, int]) -> None:
    lattice = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    fine = _enlarged(lattice, (256, 256))
    rolled = _enlarged(np.roll(lattice, (1, 3), axis=(0, 1)), (256, 256))
    shift = (256 // shape[0], 3 * 256 // shape[1])
    np.testing.assert_allclose(rolled, np.roll(fine, shift, axis=(0, 1)), atol=1e-5)


@ALL
def test_no_shift_of_a_sheet_repeats_it(kind: str) -> None:
    sheet = drawn(kind, seed=3, size_px=512, metres=8.0 if kind != "bark" else 2.0)
    gray = luminance(linear_from_srgb(filtered(sheet, 4).image / 255))
    spectrum = np.abs(np.fft.fft2((gray - gray.mean()) / gray.std())) ** 2
    correlation = np.fft.ifft2(spectrum).real / gray.size
    n = np.minimum(np.arange(len(gray)), len(gray) - np.arange(len(gray)))
    far = np.hypot(n[:, None], n) > 20
    assert correlation[0, 0] == pytest.approx(1.0)
    assert correlation[far].max() < 0.75


@pytest.mark.parametrize("kind", sorted(WALLS))
def test_walls_keep_about_the_colour_they_were_given(kind: str) -> None:
    mean = linear_from_srgb(drawn(kind).image / 255).mean(axis=(0, 1))
    ratio = mean / np.array(COLOR)
    assert (ratio > 0.55).all()
    assert (ratio < 1.35).all()


def test_bricks_have_the_size_of_bricks_and_a_running_bond() -> None:
    """Of waves shorter than 0.4 m (longer: weathering) courses and half bricks are strongest."""
    image = drawn("brick", size_px=1024, metres=8.0).image[..., 1].astype(float)
    up, along = (np.abs(np.fft.rfft(image.mean(axis=axis)))[20:] for axis in (1, 0))
    assert 8.0 / (np.argmax(up) + 20) == pytest.approx(0.075, rel=0.02)
    assert 8.0 / (np.argmax(along) + 20) == pytest.approx(0.25 / 2, rel=0.02)


@pytest.mark.parametrize("height_m", [(0.22, 0.42), (0.075, 0.075), (1.6, 1.6)])
def test_heights_of_courses_repeat_every_rise_and_blocks_do_not(
    height_m: tuple[float, float],
) -> None:
    canvas = _Canvas(1024, 4 * RISE_M, np.random.default_rng(0))
    laid = _courses(canvas, height_m, (0.4, 1.0), bond=None)
    np.testing.assert_allclose(np.roll(laid.bed, 256), laid.bed, atol=1e-6)
    assert (
        np.abs(laid.perpend[laid.row] - np.roll(laid.perpend[laid.row], 256, axis=0)).mean() > 0.1
    )


def test_filtering_averages_light_and_not_bytes() -> None:
    checker = np.indices((8, 8)).sum(axis=0) % 2 * 255
    sheet = Sheet(np.repeat(checker[..., None], 3, axis=2).astype(np.uint8), 2.0)
    small = filtered(sheet, 2)
    assert small.metres == 2.0
    assert small.image.shape == (4, 4, 3)
    assert (small.image == 188).all()  # half the light, not half the byte


@ALL
def test_filtering_keeps_the_mean_light(kind: str) -> None:
    sheet = drawn(kind)
    mean, far = (linear_from_srgb(s.image / 255).mean() for s in (sheet, filtered(sheet, 16)))
    assert far == pytest.approx(mean, rel=0.01)


def test_bad_arguments_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="kind 'lego' is unknown; choose from \\['brick'"):
        wall_sheet("lego", COLOR, rng=rng)
    with pytest.raises(ValueError, match="power of two from 64 on, got 100 px"):
        wall_sheet("brick", COLOR, rng=rng, size_px=100)
    with pytest.raises(ValueError, match="factor 3 does not divide the sheet's 256 pixels"):
        filtered(drawn("plaster"), 3)


def test_every_kind_of_wall_may_appear() -> None:
    assert set(world.WALL_COLORS) == set(WALLS)
