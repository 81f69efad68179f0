"""LoFTR (Sun et al., CVPR 2021) by kornia: semi-dense matches without key points.

Apache-2.0; the weights are not shipped. Positions are in the frame of COLMAP, which the training
poses come from: the first pixel's centre is at ½.
"""

from __future__ import annotations

from functools import cache, partial

import torch
from torch import nn

from flowrect.matchers._images import grey_tensor, matches_of, same_size, shrunk
from flowrect.matchers._weights import Published, cached_file, filled, read_state
from flowrect.matches import Matcher, Matches
from flowrect.sample import Image

WEIGHTS = Published(
    matcher="loftr",
    place="https://huggingface.co/kornia/loftr, file loftr_outdoor.ckpt",
    licence="Apache-2.0",
    files="one .ckpt, .pth or .safetensors",
)
MAX_SIDE_PX = 832
"""about as in its training"""
MULTIPLE = 8


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no weights."""
    from kornia.feature import LoFTR

    path = WEIGHTS.file(".ckpt", ".pth", ".safetensors") or cached_file("loftr_outdoor.ckpt")
    if path is None:
        raise WEIGHTS.absent("there is no such folder, and nothing in the cache of torch.hub")
    state = read_state(path)
    state = {k.removeprefix("matcher."): v for k, v in state.get("state_dict", state).items()}
    return partial(_match, net=filled(LoFTR(pretrained=None), state))


@torch.inference_mode()
def _match(left: Image, right: Image, *, net: nn.Module) -> Matches:
    images = left, right
    seen = [shrunk(image, MAX_SIDE_PX) for image in images]
    first, second = same_size([grey_tensor(x) for x in seen], MULTIPLE)
    found = net({"image0": first, "image1": second})
    uv = [found[f"keypoints{i}"] - 0.5 for i in (0, 1)]
    return matches_of(uv, found["confidence"], seen, images)
