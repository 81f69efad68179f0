"""flowrect: online rectification of wide-baseline stereo, trained on what simgen renders.

Names are loaded when they are first used: importing flowrect imports no torch.
"""

from importlib import import_module
from typing import Any

_HOME = {
    "Calibration": "flowrect.calibration",
    "Correspondences": "flowrect.correspondences",
    "Estimate": "flowrect.estimate",
    "NoSolution": "flowrect.solvers",
    "PoseEstimate": "flowrect.methods",
    "Rectification": "flowrect.drectify",
    "load_method": "flowrect.methods",
    "load_model": "flowrect.estimate",
    "projections": "flowrect.calibration",
    "read_calibration": "flowrect.formats",
}
__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"flowrect has no {name!r}; it has {', '.join(_HOME)}")
    return getattr(import_module(_HOME[name]), name)
