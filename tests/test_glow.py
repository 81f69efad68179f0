"""What burns is seen where it is, through the air, and not through walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import camera, parallelogram, scene_of

from simgen import night
from simgen.atmosphere import transmittance
from simgen.glow import emitted
from simgen.mesh import box, part
from simgen.produce import NIGHT_LAMPS
from simgen.scene import Lamp, _lamp_dicts
from simgen.schema import LABELS

pytestmark = pytest.mark.usefixtures("mitsuba_active")

CLEAR_M = 1e9
LAMP = np.array([3.0, 2.0, 1.0])
PIXEL = (31, 47)
"""row and column whose centre looks at the lamp's middle, within half a pixel"""


def _lamp(distance_m: float, half_m: float = 0.6):
    """A square that faces the camera, and its radiance."""
    corner = (distance_m, half_m, -half_m)
    plain = parallelogram(corner, (0, -2 * half_m, 0), (0, 0, 2 * half_m), material="lamp")
    return replace(plain, emission=np.tile(LAMP, (2, 1)).astype(np.float32))


def _light(parts, visibility_m=CLEAR_M):
    return emitted(scene_of(parts), camera(), visibility_m)


@pytest.mark.parametrize("num", [4, 16, 60])
def test_one_light_slot_stays_dark_however_many_lamps_there_are(num):
    """With all slots lit Mitsuba would compile another kernel."""
    lamp = Lamp(np.zeros(3), np.array([0.0, 0, -1]), LAMP, 60.0, 50.0)
    weights = [d["sampling_weight"] for d in _lamp_dicts([lamp] * num, NIGHT_LAMPS)]
    assert weights == [1.0] * min(num, 16) + [0.0] * (17 - min(num, 16))


def test_a_lamp_that_fills_a_pixel_gives_it_its_radiance():
    light = _light([_lamp(10.0)])[PIXEL]
    np.testing.assert_array_less(LAMP, light + 1e-5)
    np.testing.assert_array_less(light, LAMP + 1e-5)


def test_nothing_that_burns_gives_no_light():
    dark = replace(_lamp(10.0), emission=None)
    assert not _light([dark]).any()


def test_a_lamp_behind_a_wall_is_not_seen():
    wall = parallelogram((5.0, 8.0, -8.0), (0, -16.0, 0), (0, 0, 16.0))
    assert not _light([_lamp(10.0), wall]).any()


def test_fog_dims_a_lamp_by_its_transmittance():
    near, far = (_light([_lamp(10.0)], v)[PIXEL] for v in (CLEAR_M, 40.0))
    np.testing.assert_allclose(far / near, transmittance(np.float32(10.0), 40.0), rtol=5e-3)


def test_all_light_of_a_small_lamp_is_kept():
    """Solid angle by geometry: (2 h f / z)² pixels of the radiance."""
    half, z, f = 0.5, 12.0, 48.0
    light = _light([_lamp(z, half)])[..., 0].sum()
    assert light == pytest.approx((2 * half * f / z) ** 2 * LAMP[0], rel=0.15)


def test_red_and_white_burn_on_vehicles_and_amber_does_not():
    vertices, faces = box((0.1, 0.1, 0.1))
    colors = {"tail": (0.5, 0.01, 0.01), "head": (0.8, 0.8, 0.8), "blinker": (0.7, 0.3, 0.02)}
    burns = {
        name: night.glowing(
            [part(vertices, faces, "lamp", LABELS["car"], color=rgb)],
            rng=np.random.default_rng(0),
        )[0].emission.any()
        for name, rgb in colors.items()
    }
    assert burns == {"tail": True, "head": True, "blinker": False}


def test_some_windows_are_lit_and_both_halves_of_a_pane_alike():
    panes = [parallelogram((0, 2.0 * k, 0), (0, 1, 0), (0, 0, 1), label="building",
                           material="glass") for k in range(400)]  # fmt: skip
    vertices = np.concatenate([p.vertices for p in panes])
    faces = np.concatenate([p.faces + 4 * k for k, p in enumerate(panes)])
    wall = part(vertices, faces, "glass", LABELS["building"], color=(0.1, 0.1, 0.1))
    emission = night.glowing([wall], rng=np.random.default_rng(0))[0].emission.reshape(400, 2, 3)
    np.testing.assert_array_equal(emission[:, 0], emission[:, 1])
    lit = emission.any(axis=(1, 2)).mean()
    assert lit == pytest.approx(night.LIT_SHARE, abs=0.07)
