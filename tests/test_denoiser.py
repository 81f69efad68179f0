"""Open Image Denoise as simgen calls it: noise goes, and neither tiles nor threads change a bit."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pyoidn
import pytest

from simgen.denoiser import denoised

WH = (640, 360)


@pytest.fixture(scope="module")
def noisy() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A ramp of light on two walls, the ramp under noise, and the normals of the walls."""
    rng = np.random.default_rng(0)
    clean = np.broadcast_to(np.linspace(0.2, 2.0, WH[0])[None, :, None], (*WH[::-1], 3))
    normal = np.zeros((*WH[::-1], 3), np.float32)
    normal[:, : WH[0] // 2, 0] = normal[:, WH[0] // 2 :, 2] = 1
    noise = rng.gamma(2.0, 0.5, clean.shape)
    return clean.astype(np.float32), (clean * noise).astype(np.float32), normal


def ones() -> np.ndarray:
    """All of the albedo was divided out."""
    return np.ones((*WH[::-1], 3), np.float32)


def test_noise_goes_and_light_stays(noisy):
    clean, grainy, normal = noisy
    found = denoised(grainy, ones(), normal)
    assert found.dtype == np.float32
    assert np.abs(found - clean).mean() < 0.1 * np.abs(grainy - clean).mean()
    assert found.mean() == pytest.approx(clean.mean(), rel=0.05)


def test_panes_stay_apart_from_paint_by_the_albedo_that_is_left():
    """Stripes of 8 pixels, a third darker, under noise: normals alone do not tell them apart."""
    rng = np.random.default_rng(1)
    left = np.where(np.arange(WH[0]) // 8 % 2, 0.67, 1.0).astype(np.float32)
    left = np.ascontiguousarray(np.broadcast_to(left[None, :, None], (*WH[::-1], 3)))
    grainy = left * rng.gamma(1.0, 1.0, (*WH[::-1], 1)).astype(np.float32)
    normal = np.zeros_like(left)
    normal[..., 2] = 1
    told, untold = (np.abs(denoised(grainy, a, normal) - left).mean() for a in (left, ones()))
    assert told < 0.5 * untold


def test_tiles_change_no_bit(noisy):
    _, grainy, normal = noisy
    few, many = (denoised(grainy, ones(), normal, memory_mb=m) for m in (16, 4000))
    np.testing.assert_array_equal(few, many)


def test_threads_change_no_bit(noisy, monkeypatch):
    _, grainy, normal = noisy
    found = []
    for threads in (1, 2):
        monkeypatch.setattr(dr, "thread_count", lambda n=threads: n)
        found.append(denoised(grainy, ones(), normal))
    np.testing.assert_array_equal(*found)


def test_it_is_what_the_package_s_own_call_gives(noisy):
    _, grainy, normal = noisy
    theirs = pyoidn.denoise(grainy, albedo=ones(), normal=normal, hdr=True,
                            clean_aux=True, quality="fast")  # fmt: skip
    np.testing.assert_array_equal(denoised(grainy, ones(), normal), theirs)


def test_inputs_stay_as_they_are_in_any_layout(noisy):
    _, grainy, normal = noisy
    before = grainy.copy()
    backwards = np.ascontiguousarray(grainy[::-1])[::-1]
    found = denoised(backwards, ones(), normal)
    np.testing.assert_array_equal(found, denoised(grainy, ones(), normal))
    np.testing.assert_array_equal(grainy, before)


def test_images_that_do_not_fit_are_refused():
    """The library would read beyond the smaller one."""
    large, small, grey = (np.zeros(s, np.float32) for s in ((8, 8, 3), (4, 4, 3), (8, 8)))
    with pytest.raises(ValueError, match=r"albedo \(8, 8, 3\) and normal \(4, 4, 3\)"):
        denoised(large, large, small)
    with pytest.raises(ValueError, match=r"albedo \(4, 4, 3\) and normal \(8, 8, 3\)"):
        denoised(large, small, large)
    with pytest.raises(ValueError, match=r"irradiance \(8, 8\)"):
        denoised(grey, grey, grey)


def test_what_the_library_refuses_is_said(noisy, monkeypatch):
    class Forgetful(pyoidn.Filter):
        def set_image(self, name: str, *args: object) -> None:
            if name != "output":
                super().set_image(name, *args)

    monkeypatch.setattr(pyoidn, "Filter", Forgetful)
    with pytest.raises(OSError, match="Open Image Denoise: output image not specified"):
        denoised(noisy[1], ones(), noisy[2])
