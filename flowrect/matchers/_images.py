"""Images as networks take them, and their pixels back.

A network sees an image whose longer side has at most ``max_side_px``, perhaps padded to the right
and below. Pixels return by (u + ½) s − ½, since images begin at −½.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from flowrect.matches import Matches
from flowrect.resize import resized_image
from flowrect.sample import Image
from simgen.geometry import Array

MAX_SIDE_PX = 1024
"""as in LightGlue's own evaluation"""


def shrunk(image: Image, max_side_px: int) -> Image:
    """The image, its longer side at most so long."""
    h, w = image.shape[:2]
    scale = min(1.0, max_side_px / max(w, h))
    return resized_image(image, (max(1, round(w * scale)), max(1, round(h * scale))))


def tensor_of(image: Image) -> Tensor:
    """(1, 3, H, W) float32 in 0…1."""
    return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float() / 255


def grey_tensor(image: Image) -> Tensor:
    """(1, 1, H, W) float32 in 0…1, by ITU-R 601, as OpenCV and PIL do."""
    weights = torch.tensor([0.299, 0.587, 0.114])
    return (tensor_of(image) * weights[:, None, None]).sum(1, keepdim=True)


def same_size(images: Sequence[Tensor], multiple: int, at_least: int = 1) -> list[Tensor]:
    """Images (1, C, H, W), their last row and column repeated until all sides are multiples."""
    h, w = (max(at_least, *(x.shape[d] for x in images)) for d in (-2, -1))
    h, w = (-(-side // multiple) * multiple for side in (h, w))
    return [F.pad(x, (0, w - x.shape[-1], 0, h - x.shape[-2]), mode="replicate") for x in images]


def magnified(uv: Array, seen: Image, image: Image) -> Array:
    """Pixels (N, 2) of a shrunk image as pixels of the image."""
    old, new = (np.array(x.shape[1::-1], dtype=np.float64) for x in (seen, image))
    return (uv + 0.5) * (new / old) - 0.5


def matches_of(
    uv: Sequence[Tensor], score: Tensor, seen: Sequence[Image], images: Sequence[Image]
) -> Matches:
    """Matches of left and right pixels (N, 2) of shrunk images; those in the padding are left out.

    Args:
      uv: pixels of ``seen``, left and right.
      score: (N,).
      seen: the shrunk images, without padding.
      images: the images that they come from.
    """
    ends = [x.detach().double().numpy() for x in uv]
    kept = np.ones(len(ends[0]), dtype=bool)
    for end, image in zip(ends, seen, strict=True):
        kept &= ((end >= -0.5) & (end <= np.array(image.shape[1::-1]) - 0.5)).all(1)
    left, right = (magnified(*x) for x in zip(ends, seen, images, strict=True))
    found = Matches(left, right, score.detach().double().numpy(), seen_px=seen_px(seen, images))
    return found.subset(kept)


def seen_px(seen: Sequence[Image], images: Sequence[Image]) -> float:
    """Side of the largest pixel of shrunk images, in pixels of the images."""
    return max(max(x.shape[:2]) / max(s.shape[:2]) for s, x in zip(seen, images, strict=True))


def no_matches() -> Matches:
    """Of images that show too little."""
    return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
