"""Haze at the edges of things."""

from __future__ import annotations

import numpy as np
import pytest

from simgen.atmosphere import transmittance

pytestmark = pytest.mark.usefixtures("mitsuba_active")
VISIBILITY_M = 100.0


def lit_through(distance_m: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    from simgen.render import Features, mean_transmittance

    none = np.zeros((*distance_m.shape, 3), np.float32)
    features = Features(none, none, distance_m, coverage, none)
    return mean_transmittance(features, VISIBILITY_M)


def test_at_an_edge_the_transmittances_are_averaged_not_the_distances():
    near, far, share = 10.0, 90.0, np.array([1.0, 1.0, 0.4, 0.0, 0.0], np.float32)
    distance = np.tile(share * near + (1 - share) * far, (3, 1)).astype(np.float32)
    seen = lit_through(distance, np.ones_like(distance))[1]
    through = transmittance(np.array([near, far]), VISIBILITY_M)
    np.testing.assert_allclose(seen, share * through[0] + (1 - share) * through[1], rtol=1e-4)
    of_mean = transmittance(distance[1, 2], VISIBILITY_M)
    assert abs(of_mean - seen[2]) > 0.1, "the case shows nothing"


def test_the_sky_beside_a_surface_does_not_bring_it_nearer():
    distance = np.full((3, 5), 80.0, np.float32)
    distance[:, 3:] = 0
    seen = lit_through(distance, (distance > 0).astype(np.float32))
    np.testing.assert_allclose(seen[:, :3], transmittance(np.float32(80), VISIBILITY_M), rtol=1e-5)
    assert np.isfinite(seen).all()
