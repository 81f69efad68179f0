"""What a stereo matcher said of rectified images, kept in files: an interrupted run goes on.

Disparity is a function of two images and of what looks at them. OUT/disparity/STEREO/DIGEST.npz
holds it in half precision, known by their digest: a relative error of at most 2⁻¹¹, 2 cm at 40 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrect.depth import StereoMatcher
from flowrect.evaluation.kept import read_arrays, write_arrays
from flowrect.evaluation.offsets import digest
from flowrect.sample import Image


@dataclass(frozen=True)
class KeptDisparity:
    """A stereo matcher that looks at no pair twice."""

    match: StereoMatcher
    stamp: str
    """of its code, its weights and its settings"""
    folder: Path

    def __call__(self, left: Image, right: Image) -> NDArray[np.float32]:
        """As StereoMatcher, to half precision, whether it is known or found."""
        path = self.folder / f"{digest(self.stamp.encode(), left, right)}.npz"
        if (kept := read_arrays(path, "disparity")) is not None:
            return kept[0].astype(np.float32)
        found = self.match(left, right).astype(np.float16)
        write_arrays(path, disparity=found)
        return found.astype(np.float32)
