"""Dense optical flow by RAFT (Teed and Deng, ECCV 2020).

A point counts as matched if the flow back from where it went returns to it. The weights are those
that the user brought, of ``flowrect.train_flow`` or torchvision's (BSD-3-Clause), else the shipped
ones.
"""

from __future__ import annotations

from functools import cache, partial

import torch

from flowrect.flow_network import MIN_SIDE, FlowNetwork, load_flow
from flowrect.matchers._images import (
    MAX_SIDE_PX,
    magnified,
    no_matches,
    same_size,
    seen_px,
    shrunk,
    tensor_of,
)
from flowrect.matchers._weights import Published
from flowrect.matchers.dis import TUNED, consistent, worth
from flowrect.matches import Matcher, Matches
from flowrect.sample import Image

BROUGHT = Published(
    matcher="raft",
    place="https://download.pytorch.org/models/raft_small_C_T_V2-01064c6d.pth",
    licence="BSD-3-Clause",
    files="one .safetensors of flowrect.train_flow, or torchvision's .pth",
)
STEP = 6
"""pixels between the points that are kept"""
CYCLE_PX = 1.0
"""largest distance of a point from where forward and backward flow take it"""


WORTH = TUNED.worth


def weights() -> str:
    """What ``load_flow`` is asked for; UserError if what was brought is not one file of weights."""
    return str(BROUGHT.file(".safetensors", ".pth") or "raft")


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no such weights."""
    return partial(_match, net=load_flow(weights()))


@torch.inference_mode()
def _match(left: Image, right: Image, *, net: FlowNetwork) -> Matches:
    if left.shape != right.shape:
        raise ValueError(f"raft: images are {left.shape} and {right.shape}; expected one size")
    seen = [shrunk(image, MAX_SIDE_PX) for image in (left, right)]
    h, w = seen[0].shape[:2]
    if min(h, w) <= STEP:
        return no_matches()
    first, second = same_size([tensor_of(x) for x in seen], multiple=8, at_least=MIN_SIDE)
    magnify = min(net.magnify, max(1.0, MAX_SIDE_PX / max(w, h)))  # memory is bounded, too
    flow = net.flow(torch.cat([first, second]), torch.cat([second, first]), magnify)
    forth, back = flow[:, :, :h, :w].permute(0, 2, 3, 1).contiguous().numpy()
    found = consistent(forth, back, step=STEP, cycle_px=CYCLE_PX)
    uv_left, uv_right = (magnified(x, seen[0], left) for x in (found.uv_left, found.uv_right))
    size = seen_px(seen, (left, right))
    return worth(Matches(uv_left, uv_right, found.score, seen_px=size), WORTH)
