from __future__ import annotations

import numpy as np
import pytest

from simgen.color import linear_from_srgb, luminance, srgb_from_linear


def test_decoding_inverts_encoding() -> None:
    linear = np.linspace(-0.1, 1.5, 1601)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(linear)), linear, atol=2e-8)


def test_encoding_is_monotonic_and_continuous_at_the_knee() -> None:
    around = np.linspace(0.0031, 0.0032, 1000)
    steps = np.diff(srgb_from_linear(around))
    assert steps.min() > 0
    assert steps.max() < 2e-6


@pytest.mark.parametrize(
    ("byte", "linear"), [(0, 0.0), (10, 0.003035), (128, 0.215861), (188, 0.502886), (255, 1.0)]
)
def test_bytes_decode_to_the_published_values(byte: int, linear: float) -> None:
    np.testing.assert_allclose(linear_from_srgb(byte / 255), linear, atol=1e-6)


def test_white_has_luminance_one_and_green_outweighs_red_outweighs_blue() -> None:
    white, red, green, blue = luminance(np.array([[1.0, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]]))
    assert white == pytest.approx(1.0)
    assert green > red > blue > 0


def test_float32_stays_float32() -> None:
    x = np.full((2, 3), 0.2, dtype=np.float32)
    assert srgb_from_linear(x).dtype == linear_from_srgb(x).dtype == luminance(x).dtype == x.dtype


def test_integers_are_refused() -> None:
    with pytest.raises(TypeError, match="must be floats in \\[0, 1\\], got uint8; divide by 255"):
        linear_from_srgb(np.zeros(3, dtype=np.uint8))
