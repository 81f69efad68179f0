"""Open Image Denoise, through the one package that wraps it. Nothing else imports that package."""

from __future__ import annotations

import sys
from functools import cache
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray


def _import_pyoidn() -> Any:
    """pyoidn loads PyTorch where it is installed: 0.3 GiB in every worker, for nothing here."""
    has_torch = "torch" in sys.modules
    if not has_torch:
        sys.modules["torch"] = None  # type: ignore[assignment]  # "not installed"
    try:
        import pyoidn
    finally:
        if not has_torch:
            del sys.modules["torch"]
    return pyoidn


_PYOIDN = _import_pyoidn()
MEMORY_MB = 700
"""working memory of the denoiser, which takes larger images in tiles: the same bits (tested), 0.5
GiB less at 2560x1440"""


@cache
def _device(threads: int) -> Any:
    """The CPU, with its threads free to move: pinned ones would meet those of other workers."""
    device = _PYOIDN.Device(_PYOIDN.OIDN_DEVICE_TYPE_CPU)
    device.set_int("numThreads", threads)
    device.set_bool("setAffinity", False)
    device.commit()
    _check(device)
    return device


def denoised(
    irradiance: NDArray[Any],
    albedo: NDArray[Any],
    normal: NDArray[Any],
    *,
    memory_mb: int = MEMORY_MB,
) -> NDArray[Any]:
    """Linear irradiance (H, W, 3) float32 without its noise, guided by two images like it.

    Args:
      albedo: what is left of it in the irradiance, 1 where that was divided by all of it. The
        whole albedo as a guide was drawn into the irradiance, and then counted twice (1.7 times
        the true power in the finest octave).
      normal: of the surfaces.

    Raises ValueError for other shapes, OSError with what the library says: that is the machine's
    fault, not the frame's.
    """
    if not irradiance.shape == albedo.shape == normal.shape == (*irradiance.shape[:2], 3):
        raise ValueError(
            f"denoised: expected three images (H, W, 3), came irradiance {irradiance.shape}, "
            f"albedo {albedo.shape} and normal {normal.shape}"
        )
    images = {
        "color": np.ascontiguousarray(irradiance, np.float32),
        "albedo": np.ascontiguousarray(albedo, np.float32),
        "normal": np.ascontiguousarray(normal, np.float32),
        "output": np.empty(irradiance.shape, np.float32),
    }
    device = _device(dr.thread_count())
    denoising = _PYOIDN.Filter(device, _PYOIDN.OIDN_FILTER_TYPE_RT)
    try:  # as a context manager, it would swallow errors
        for name, image in images.items():
            denoising.set_image(name, image, _PYOIDN.OIDN_FORMAT_FLOAT3)
        denoising.set_bool("hdr", True)
        denoising.set_bool("cleanAux", True)
        denoising.set_quality(_PYOIDN.OIDN_QUALITY_FAST)
        denoising.set_int("maxMemoryMB", memory_mb)
        denoising.commit()
        denoising.execute()
        _check(device)
    finally:
        denoising.release()
    return images["output"]


def _check(device: Any) -> None:
    if message := device.get_error():
        raise OSError(f"Open Image Denoise: {message}")
