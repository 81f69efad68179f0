"""Key points of two images, matched by LightGlue (Lindenberger et al., ICCV 2023)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from flowrect.matchers._images import MAX_SIDE_PX, matches_of, no_matches, shrunk, tensor_of
from flowrect.matchers._weights import filled
from flowrect.matches import Matches
from flowrect.sample import Image

MIN_SIDE_PX = 32
"""the coarsest cell of all detectors: a smaller image has no key points"""


@dataclass(frozen=True, eq=False)
class Features:
    """N key points of one image."""

    uv: Tensor
    """(N, 2) [px]"""
    descriptors: Tensor
    """(N, D)"""


Detector = Callable[[Tensor], Features]
"""of an image (1, 3, H, W) in 0…1"""


@torch.inference_mode()
def match_features(
    left: Image, right: Image, *, detect: Detector, glue: nn.Module, max_side_px: int = MAX_SIDE_PX
) -> Matches:
    """The key points that LightGlue takes for one; score is its probability."""
    images = left, right
    seen = [shrunk(image, max_side_px) for image in images]
    if min(side for image in seen for side in image.shape[:2]) < MIN_SIDE_PX:
        return no_matches()
    features = [detect(tensor_of(image)) for image in seen]
    if not all(len(x.uv) for x in features):
        return no_matches()
    first, second = (_input(x, image) for x, image in zip(features, seen, strict=True))
    found = glue({"image0": first, "image1": second})
    uv = [x.uv[index] for x, index in zip(features, found["matches"][0].T, strict=True)]
    return matches_of(uv, found["scores"][0], seen, images)


def _input(features: Features, image: Image) -> dict[str, Tensor]:
    """What LightGlue takes: a batch of one, and the size of its image."""
    wh = torch.tensor([image.shape[1::-1]], dtype=torch.float32)
    uv, descriptors = features.uv[None].float(), features.descriptors[None]
    return {"keypoints": uv, "descriptors": descriptors, "image_size": wh}


def lightglue(features: str, state: dict[str, Tensor]) -> nn.Module:
    """LightGlue for the features of that name, from weights in the key layout of any of its files.

    "disk" names its blocks the old way; "xfeat" holds the detector too, whose tensors are left.
    """
    from kornia.feature import LightGlue

    config = {k: v for k, v in LightGlue.features[features].items() if k != "weights"}
    net = LightGlue(None, **config)
    state = {k.removeprefix("matcher."): v for k, v in state.items()}
    for part in ("self_attn", "cross_attn"):
        for i in range(net.conf.n_layers):
            new = f"transformers.{i}.{part}."
            state = {
                new + k.removeprefix(f"{part}.{i}.") if k.startswith(f"{part}.{i}.") else k: v
                for k, v in state.items()
            }
    return filled(net, state, derived=("confidence_thresholds",))
