"""SuperPoint key points (DeTone et al., 2018) with SuperGlue (Sarlin et al., CVPR 2020).

The weights are Magic Leap's, for non-commercial research only, and are not shipped. Key points are
whole pixels.
"""

from __future__ import annotations

from functools import cache, partial

import torch
from torch import nn

from flowrect.matchers._hub import load_published, pair_tensor
from flowrect.matchers._images import MAX_SIDE_PX, matches_of, shrunk
from flowrect.matchers._weights import Published
from flowrect.matches import Matcher, Matches
from flowrect.sample import Image

WEIGHTS = Published(
    matcher="superglue",
    place="https://huggingface.co/magic-leap-community/superglue_outdoor",
    licence="Magic Leap's licence, non-commercial research only",
    files="config.json and model.safetensors",
)
CELL_PX = 8


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no weights."""
    from transformers import SuperGlueForKeypointMatching

    return partial(_match, net=load_published(SuperGlueForKeypointMatching, WEIGHTS))


@torch.inference_mode()
def _match(left: Image, right: Image, *, net: nn.Module) -> Matches:
    images = left, right
    seen = [shrunk(image, MAX_SIDE_PX) for image in images]
    pixels = pair_tensor(seen, CELL_PX)
    found = net(pixel_values=pixels)
    uv = found.keypoints[0] * torch.tensor(pixels.shape[:-3:-1])  # they come as u / W, v / H
    partner, score = found.matches[0, 0], found.matching_scores[0, 0]
    [index] = torch.nonzero((partner >= 0) & (found.mask[0, 0] > 0), as_tuple=True)
    return matches_of((uv[0, index], uv[1, partner[index]]), score[index], seen, images)
