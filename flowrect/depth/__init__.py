"""Stereo matchers by name: one file each, all with one signature, loaded when they are asked for.

match = load_stereo("sgbm", largest_px=frame.largest_disparity(nearest_m=2))
disparity = match(left, right)     # rectified (H, W, 3) uint8 RGB each
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrect.depth import sgbm
from flowrect.depth.external import files_of, find_onnx, onnx_matcher
from flowrect.depth.hitnet_weights import find_hitnet, hitnet_matcher
from flowrect.sample import Image
from simgen.errors import UserError

StereoMatcher = Callable[[Image, Image], NDArray[np.float32]]
"""rectified left and right images (H, W, 3) uint8 RGB to u_left − u_right ≥ 0 on left pixels,
(H, W) [px], NaN where unknown"""

STEREO: dict[str, Callable[[float, str], StereoMatcher]] = {
    "sgbm": lambda largest_px, _: partial(sgbm.disparity, largest_px=largest_px),
    "hitnet": lambda largest_px, weights: hitnet_matcher(weights, largest_px),
    "onnx": lambda _, weights: onnx_matcher(weights),
}
"""made of the largest disparity that can occur [px], and of weights where there are any"""
WEIGHTS: dict[str, Callable[[str], list[Path]]] = {
    "hitnet": lambda weights: [find_hitnet(weights)],
    "onnx": lambda weights: files_of(find_onnx(weights)),
}
"""the files that a matcher takes its weights from, of those that have any"""


def load_stereo(name: str, *, largest_px: float, weights: str = "") -> StereoMatcher:
    """The matcher of that name; UserError if there is none, or it lacks its weights.

    Args:
      largest_px: the largest disparity that can occur, see DepthFrame.largest_disparity.
      weights: a file for those that are trained; each says what it looks for if not given.
    """
    if name not in STEREO:
        raise UserError(f"stereo matcher {name!r}: expected one of {', '.join(STEREO)}.")
    return STEREO[name](largest_px, weights)
