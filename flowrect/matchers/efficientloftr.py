"""Efficient LoFTR (Wang et al., CVPR 2024): semi-dense matches without key points.

Apache-2.0; the weights are not shipped. Positions are in the frame of COLMAP, which the training
poses come from: the first pixel's centre is at ½.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import torch
from torch import Tensor, nn

from flowrect.matchers._hub import load_published, pair_tensor
from flowrect.matchers._images import matches_of, shrunk
from flowrect.matchers._weights import Published
from flowrect.matches import Matcher, Matches
from flowrect.sample import Image

WEIGHTS = Published(
    matcher="efficientloftr",
    place="https://huggingface.co/zju-community/efficientloftr",
    licence="Apache-2.0",
    files="config.json and model.safetensors",
)
MAX_SIDE_PX = 832
"""as in its training"""
MULTIPLE = 32
"""of the sides: cells of 8 px, attended to in groups of four"""


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no weights."""
    return partial(_match, net=load_published(_mended(), WEIGHTS))


@torch.inference_mode()
def _match(left: Image, right: Image, *, net: nn.Module) -> Matches:
    images = left, right
    seen = [shrunk(image, MAX_SIDE_PX) for image in images]
    pixels = pair_tensor(seen, MULTIPLE)
    found = net(pixel_values=pixels)
    [index] = torch.nonzero(found.matching_scores[0, 0], as_tuple=True)
    uv = found.keypoints[0][:, index] * torch.tensor(pixels.shape[:-3:-1]) - 0.5
    return matches_of(uv.unbind(0), found.matching_scores[0, 0, index], seen, images)


def mutual_best(scores: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
    """For each left cell its right one, (B, 2, N), −1 twice where there is none; scores alike.

    Args:
      scores: (B, N, N), of left and right cells.
      kept: (B, N, N) bool, at most one in each row.
    """
    best, partner = (scores * kept).max(2)
    found = best > 0
    left = torch.arange(scores.shape[1]).expand_as(partner)
    index = torch.where(found[:, None], torch.stack([left, partner], 1), -1)
    return index, torch.stack([best, best], 1)


def _mended() -> Any:
    """The class of ``transformers``, of which two steps are wrong in 5.23.

    It lists the left ends by right cells and the right ends by left cells, so that index k means
    two matches, which only rows of matches in equal order hide; and its first refinement gathers
    along the matches, where the places within a window are meant.
    """
    from transformers import EfficientLoFTRForKeypointMatching
    from transformers.models.efficientloftr.modeling_efficientloftr import mask_border

    class Mended(EfficientLoFTRForKeypointMatching):
        def _get_matches_from_scores(self, scores: Tensor) -> tuple[Tensor, Tensor]:
            b, h, w = scores.shape[:3]
            flat = scores.reshape(b, h * w, -1)
            kept = scores > self.config.coarse_matching_threshold
            kept = mask_border(kept, self.config.coarse_matching_border_removal, False)
            kept = kept.reshape(flat.shape)
            kept = (
                kept & (flat == flat.amax(1, keepdim=True)) & (flat == flat.amax(2, keepdim=True))
            )
            return mutual_best(flat, kept)

        def _get_first_stage_fine_matching(
            self, fine_confidence: Tensor, coarse_matched_keypoints: Tensor,
            fine_window_size: int, fine_scale: float,
        ) -> tuple[Tensor, Tensor]:  # fmt: skip
            best = fine_confidence.flatten(2).argmax(-1)  # (B, N) of window² places
            ends = torch.stack([best // fine_window_size, best % fine_window_size], 1)
            side = round(fine_window_size**0.5)
            offset = torch.stack([ends % side, ends // side], -1) - side // 2 + 0.5
            return ends[..., None], coarse_matched_keypoints + offset * fine_scale

    return Mended
