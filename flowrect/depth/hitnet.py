"""HITNet: tiles of disparity, initialised fast, then propagated from coarse to fine.

Source: Tankovich et al., *HITNet: Hierarchical Iterative Tile Refinement Network for Real-time
Stereo Matching*, CVPR 2021. Level l has 1 / 2^l of the resolution; ``flowrect.depth.tiles`` says
what a hypothesis is. Deviations: narrower and shallower (``HitnetConfig``); the truth is points
between pixels, not a map (``hitnet_loss``); where weights start is our choice, the paper does not
say. The weights that are shipped are a beginning; ``python -m flowrect.train_depth`` trains others.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from flowrect.config import HitnetConfig
from flowrect.depth.tiles import TILE, split, tile_costs, to_finer_level, warp_costs
from flowrect.sample import Image

SLOPE = 0.2
"""of the leaky ReLUs"""
C = TypeVar("C", nn.Conv2d, nn.ConvTranspose2d)


class Init(NamedTuple):
    """What the initialisation of one level compared."""

    left: Tensor
    """(B, C, rows, columns) features of tiles"""
    right: Tensor
    """(B, C, rows, TILE · columns) features of a tile at every column"""
    costs: Tensor
    """(B, D, rows, columns), without gradient"""
    scale: int
    """full pixels per pixel of the level"""


class Stage(NamedTuple):
    """Hypotheses after one update."""

    hypothesis: Tensor
    """(B, 3 + P, rows, columns)"""
    confidence: Tensor | None
    """(B, rows, columns); None where there was nothing to choose"""
    side: int
    """of a tile [px of its level]"""
    scale: int
    """full pixels per pixel of the level"""


@dataclass(frozen=True)
class TilePrediction:
    """Everything that the loss looks at; the last stage is the answer, at tiles of one pixel."""

    inits: list[Init]
    stages: list[Stage]

    @property
    def disparity(self) -> Tensor:
        """(B, 1, H, W) [px]"""
        return self.stages[-1].hypothesis[:, :1]


class Hitnet(nn.Module):
    """Disparity of rectified pairs."""

    def __init__(self, config: HitnetConfig) -> None:
        super().__init__()
        if len(config.channels) < 3:
            raise ValueError(
                f"HITNet with channels {config.channels}: expected at least 3 resolutions, since "
                "the last refinements look at features of 1/4, 1/2 and 1/1."
            )
        self.config = config
        levels = range(len(config.channels))
        self.features = Features(config.channels)
        self.starts = nn.ModuleList(Initialisation(c, config) for c in config.channels)
        self.updates = nn.ModuleList(
            Propagation(1 if level == levels[-1] else 2, config) for level in levels
        )
        guides = config.channels[2::-1]
        self.refinements = nn.ModuleList(
            Refinement(guide, hidden, config, last=k == 2)
            for k, (guide, hidden) in enumerate(zip(guides, config.refine_hidden, strict=True))
        )

    @property
    def multiple(self) -> int:
        """What the sides of images are multiples of: whole tiles at the coarsest level."""
        return TILE * 2 ** (len(self.config.channels) - 1)

    def forward(self, left: Tensor, right: Tensor) -> TilePrediction:
        """Images (B, 3, H, W) in 0…1, sides multiples of ``multiple``."""
        maps_left, maps_right = self.features(2 * left - 1), self.features(2 * right - 1)
        inits: list[Init] = []
        stages: list[Stage] = []
        current: Tensor | None = None
        for level in reversed(range(len(maps_left))):
            h, init = self.starts[level](maps_left[level], maps_right[level], level)
            given = [h] if current is None else [h, to_finer_level(current)]
            updated = self.updates[level](maps_left[level], maps_right[level], given)
            stages += [Stage(x, w, TILE, 2**level) for x, w in updated]
            inits.append(init)
            current = surest(updated)
        assert current is not None, "there is a level"
        for refine, guide, side in zip(self.refinements, maps_left[2::-1], (4, 2, 1), strict=True):
            current = current if side == TILE else split(current, side / 2, 1.0)
            current = refine(current, guide)
            stages.append(Stage(current, None, side, 1))
        return TilePrediction(inits, stages)

    @torch.inference_mode()
    def match(self, left: Image, right: Image) -> NDArray[np.float32]:
        """Disparity (H, W) [px] of rectified images (H, W, 3) uint8 RGB; an answer everywhere."""
        h, w = left.shape[:2]
        padding = (0, -w % self.multiple, 0, -h % self.multiple)  # right and below: u stays
        planes = torch.from_numpy(np.stack([left, right])).permute(0, 3, 1, 2).float() / 255
        first, second = F.pad(planes, padding, mode="replicate").split(1)
        found: NDArray[np.float32] = self(first, second).disparity[0, 0, :h, :w].clamp(0).numpy()
        return found


class Features(nn.Module):
    """U-Net: feature maps at every level, fine to coarse."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        first, steps = channels[0], list(pairwise(channels))
        self.first = nn.Sequential(*_convolution(3, first, 3), *_convolution(first, first, 3))
        self.down = nn.ModuleList(
            nn.Sequential(
                _he(nn.Conv2d(a, b, 2, stride=2)), nn.LeakyReLU(SLOPE),
                *_convolution(b, b, 3), *_convolution(b, b, 3),
            )
            for a, b in steps
        )  # fmt: skip
        self.up = nn.ModuleList(
            nn.Sequential(_he(nn.ConvTranspose2d(b, a, 2, stride=2)), nn.LeakyReLU(SLOPE))
            for a, b in steps
        )
        self.joined = nn.ModuleList(
            nn.Sequential(*_convolution(2 * a, a, 1), *_convolution(a, a, 3)) for a, _ in steps
        )

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, channels[l], H / 2^l, W / 2^l) for each level l."""
        maps = [self.first(image)]
        for down in self.down:
            maps.append(down(maps[-1]))
        for level in reversed(range(len(self.up))):
            above = self.up[level](maps[level + 1])
            maps[level] = self.joined[level](torch.cat([above, maps[level]], dim=1))
        return maps


class Initialisation(nn.Module):
    """The best fronto-parallel tiles of a level."""

    def __init__(self, channels: int, config: HitnetConfig) -> None:
        super().__init__()
        c = config.tile_channels
        self.max_disparity = config.max_disparity
        self.tile = _he(nn.Conv2d(channels, c, TILE))
        self.mix = nn.Sequential(nn.LeakyReLU(SLOPE), *_convolution(c, c, 1))
        self.describe = nn.Sequential(*_convolution(c + 1, config.descriptor, 1))

    def forward(self, left: Tensor, right: Tensor, level: int) -> tuple[Tensor, Init]:
        """The hypotheses of a level, and what was compared for them."""
        tiles_left = self.features(left, TILE)
        tiles_right = self.features(F.pad(right, (0, TILE - 1, 0, 0)), 1)
        num = min(-(-self.max_disparity // 2**level), left.shape[-1])
        with torch.no_grad():
            costs = tile_costs(tiles_left, tiles_right, num)
            best, d = costs.min(1, keepdim=True)
        # The cost that p is made of has a gradient: it is what the choice rests on.
        column = TILE * torch.arange(d.shape[-1], device=d.device) - d
        chosen = tiles_right.gather(-1, column.expand_as(tiles_left))
        cost = (tiles_left - chosen).abs().sum(1, keepdim=True)
        p = self.describe(torch.cat([cost, tiles_left], dim=1))
        zero = torch.zeros_like(best)
        h = torch.cat([d.to(p), zero, zero, p], dim=1)
        return h, Init(tiles_left, tiles_right, costs, 2**level)

    def features(self, maps: Tensor, stride: int) -> Tensor:
        """Tiles that are ``stride`` columns apart, TILE rows: the same weights for both views."""
        found: Tensor = self.mix(
            F.conv2d(maps, self.tile.weight, self.tile.bias, stride=(TILE, stride))
        )
        return found


class Propagation(nn.Module):
    """Updates the hypotheses of a level by their neighbours and local costs.

    The last layer starts at zero, so that an untrained network returns
    what it was given; the paper does not say.
    """

    def __init__(self, num: int, config: HitnetConfig) -> None:
        super().__init__()
        self.size = 3 + config.descriptor
        self.costs = nn.Sequential(*_convolution(3 * TILE**2, 16, 1))
        self.update = _update(
            num * (self.size + 16),
            config.hidden,
            config.dilations,
            num * self.size + num * (num > 1),
        )

    def forward(
        self, left: Tensor, right: Tensor, given: list[Tensor]
    ) -> list[tuple[Tensor, Tensor | None]]:
        """Each hypothesis updated, with its confidence (B, rows, columns) if there are several."""
        known = [torch.cat([h, self.costs(warp_costs(left, right, h))], dim=1) for h in given]
        changes = self.update(torch.cat(known, dim=1))
        deltas = changes[:, : len(given) * self.size].split(self.size, dim=1)
        sure = changes[:, len(given) * self.size :].unbind(1) or [None]
        return [(h + delta, w) for h, delta, w in zip(given, deltas, sure, strict=True)]


class Refinement(nn.Module):
    """Updates hypotheses by their neighbours and the left image's features at their resolution.

    Without warping. The last one has no descriptor to pass on.
    """

    def __init__(self, guide: int, hidden: int, config: HitnetConfig, *, last: bool) -> None:
        super().__init__()
        size = 3 + config.descriptor
        self.update = _update(size + guide, hidden, config.refine_dilations, 3 if last else size)

    def forward(self, h: Tensor, guide: Tensor) -> Tensor:
        """The hypotheses, as many rows and columns as ``guide`` has."""
        delta: Tensor = self.update(torch.cat([h, guide], dim=1))
        return h[:, : delta.shape[1]] + delta


class Residual(nn.Module):
    """Two dilated convolutions, without normalisation, around a bypass."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            *_convolution(channels, channels, 3, dilation),
            _he(nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Of the shape of x."""
        return F.leaky_relu(x + self.body(x), SLOPE)


def surest(updated: list[tuple[Tensor, Tensor | None]]) -> Tensor:
    """For each tile the hypothesis of the greatest confidence; the first of equals."""
    if len(updated) == 1:
        return updated[0][0]
    hypotheses, confidences = zip(*updated, strict=True)
    best = torch.stack(confidences).argmax(0)[None, :, None]
    stacked = torch.stack(hypotheses)
    chosen: Tensor = stacked.gather(0, best.expand(1, *stacked.shape[1:]))[0]
    return chosen


def _update(inputs: int, hidden: int, dilations: tuple[int, ...], outputs: int) -> nn.Sequential:
    last = nn.Conv2d(hidden, outputs, 3, padding=1)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)  # type: ignore[arg-type]
    return nn.Sequential(
        *_convolution(inputs, hidden, 1), *(Residual(hidden, k) for k in dilations), last
    )


def _convolution(inputs: int, outputs: int, side: int, dilation: int = 1) -> list[nn.Module]:
    padding = dilation * (side // 2)
    return [
        _he(nn.Conv2d(inputs, outputs, side, padding=padding, dilation=dilation)),
        nn.LeakyReLU(SLOPE),
    ]


def _he(layer: C) -> C:
    """He's start: without normalisation, PyTorch's own shrinks features until tiles look alike."""
    nn.init.kaiming_normal_(layer.weight, SLOPE)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
