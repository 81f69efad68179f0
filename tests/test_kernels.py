"""Scenes of one structure use the same kernels: a process compiles at its first scene only."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import numpy as np
import pytest
from small_scenes import parallelogram, scene_of

from simgen.config import RenderOptions, resolve
from simgen.produce import make_frame
from simgen.scene import aligned

ARRAYS = ("vertex_positions", "vertex_normals", "vertex_texcoords", "vertex_color", "faces")
WALL = parallelogram((5, -2, -2), (0, 4, 0), (0, 0, 4))


@pytest.mark.parametrize("offset", range(0, 64, 4))
def test_an_aligned_copy_holds_the_same_numbers_wherever_they_begin(offset):
    values = np.frombuffer(bytes(range(200)), np.uint32, 30, offset).reshape(10, 3)
    copy = aligned(values)
    assert copy.ctypes.data % 64 == 0
    np.testing.assert_array_equal(copy, values.ravel())


def test_meshes_are_handed_over_aligned(mitsuba_active):
    """Dr.Jit would compile another kernel for each alignment."""
    import mitsuba as mi

    if str(mi.variant()).startswith("scalar"):
        pytest.skip("scalar variants compile nothing")
    for shape in scene_of([WALL]).shapes:
        params = mi.traverse(shape)
        arrays = [params[name].numpy() for name in ARRAYS if name in params]
        assert not any(a.ctypes.data % 64 for a in arrays if len(a))


@pytest.fixture
def kernel_history() -> Iterator[None]:
    """Dr.Jit keeps a record of what it runs."""
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    yield
    dr.set_flag(dr.JitFlag.KernelHistory, False)


def _kernels_of(recipe: str, daylight: str, weather: str) -> set[str]:
    """The hashes of what a frame ran."""
    import mitsuba as mi

    options = RenderOptions(
        n=1, size="96x54", spp=1, recipes=recipe, daylight=daylight, weather=weather
    )
    dr.kernel_history()
    make_frame(resolve(options, mi.variant()), 0, attempt=0)
    return {k["hash"] for k in dr.kernel_history() if "hash" in k}


@pytest.mark.slow
@pytest.mark.parametrize("daylight", ["noon", "night"])
@pytest.mark.parametrize("weather", ["clear", "rain"])
def test_a_second_scene_uses_the_kernels_of_the_first(
    daylight, weather, mitsuba_active, kernel_history
):
    """Counted by what they are: what another process compiled before is not compiled again."""
    town = _kernels_of("urban", daylight, weather)
    country = _kernels_of("rural", daylight, weather)
    assert len(town) > 10
    assert country - town == set()
