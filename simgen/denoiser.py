"""Open Image Denoise, through the one package that wraps it. Nothing else imports that package."""

from __future__ import annotations

import sys
from typing import Any

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


def denoised(irradiance: NDArray[Any], normal: NDArray[Any]) -> NDArray[Any]:
    """Linear irradiance (H, W, 3) float32 without its noise, guided by normals (H, W, 3).

    By normals alone: with the albedo as a guide the denoiser drew its texture into the irradiance,
    which then counted twice (1.7 times the true power in the finest octave).
    """
    clean: NDArray[Any] = _PYOIDN.denoise(
        np.ascontiguousarray(irradiance),
        albedo=np.ones_like(irradiance),
        normal=np.ascontiguousarray(normal),
        hdr=True,
        clean_aux=True,
        quality="fast",
    )
    return clean
