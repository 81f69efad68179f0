"""Slanted tiles: small planes of disparity that HITNet passes around.

A *hypothesis* h (B, 3 + P, rows, columns) holds for each tile the disparity d at its centre [px],
its slopes dx and dy [px/px], and a descriptor p of P numbers. The pixels of a tile of side s have

    d(u, v) = d + (u − u_c) dx + (v − v_c) dy,    u − u_c in {−(s−1)/2, …, (s−1)/2}.

Lengths are pixels of the resolution that the tile belongs to. Source: HITNet (Tankovich et al.,
CVPR 2021).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

TILE = 4
"""side of a tile [px]"""


def plane(h: Tensor, side: int = TILE) -> Tensor:
    """Disparity (B, 1, side · rows, side · columns) [px] of every pixel of the tiles."""
    d, dx, dy = (x[:, :, None, :, None] for x in h[:, :3].unbind(1))
    offset = torch.arange(side, dtype=h.dtype, device=h.device) - (side - 1) / 2
    pixels = d + offset * dx + offset[:, None, None] * dy
    return pixels.flatten(3, 4).flatten(1, 2)[:, None]


def split(h: Tensor, offset: float, scale: float) -> Tensor:
    """Each tile as 2 × 2 tiles of the same plane, twice as many rows and columns.

    Args:
      offset: of the new centres from the old one, along each axis [px, old].
      scale: new pixels per old pixel. Slopes have none.
    """
    rows, columns = (_signs(n, like=h) * offset for n in h.shape[-2:])
    doubled = h.repeat_interleave(2, -1).repeat_interleave(2, -2)
    d, dx, dy, p = doubled[:, :1], doubled[:, 1:2], doubled[:, 2:3], doubled[:, 3:]
    return torch.cat([scale * (d + columns * dx + rows[:, None] * dy), dx, dy, p], dim=1)


def to_finer_level(h: Tensor) -> Tensor:
    """Tiles as those of twice the resolution: of the same side in pixels."""
    return split(h, TILE / 4, 2.0)


def warped(right: Tensor, disparity: Tensor) -> Tensor:
    """Right maps (B, C, H, W) as the left view shows them, at (u − disparity, v), linearly.

    Args:
      disparity: (B, 1, H, W) [px]. Beyond the image its border goes on.
    """
    h, w = right.shape[-2:]
    v, u = torch.meshgrid(*(torch.arange(n, device=right.device) for n in (h, w)), indexing="ij")
    x = (2 * (u - disparity[:, 0]) + 1) / w - 1
    y = ((2 * v + 1) / h - 1).to(x).expand_as(x)
    grid = torch.stack([x, y], dim=-1)
    return F.grid_sample(right, grid, padding_mode="border", align_corners=False)


def warp_costs(left: Tensor, right: Tensor, h: Tensor) -> Tensor:
    """Local cost volume (B, 3 · TILE², rows, columns): Σ|left − warped right| over the channels.

    For planes moved by −1, 0 and +1 px, one number a pixel of the tile.
    """
    disparity = plane(h)
    costs = [
        (left - warped(right, disparity + delta)).abs().sum(1, keepdim=True)
        for delta in (-1.0, 0.0, 1.0)
    ]
    return F.pixel_unshuffle(torch.cat(costs, dim=1), TILE)


# --- initialisation ----------------------------------------------------------------------------


def tile_costs(left: Tensor, right: Tensor, num: int) -> Tensor:
    """Matching costs (B, num, rows, columns) of fronto-parallel tiles at disparities 0 … num − 1.

    ϱ(x, y, d) = Σ|left(x, y) − right(TILE x − d, y)|, infinite left of the image.

    Args:
      left: (B, C, rows, columns) features of tiles.
      right: (B, C, rows, TILE · columns) features of a tile at every column of pixels.
    """
    outside = F.pad(right, (num - 1, 0), value=float("inf"))  # views of it, no copies
    costs = [
        (left - outside[..., num - 1 - d :: TILE][..., : left.shape[-1]]).abs().sum(1)
        for d in range(num)
    ]
    return torch.stack(costs, dim=1)


def tile_cost_at(left: Tensor, right: Tensor, d: Tensor) -> Tensor:
    """Cost (B, rows, columns) at disparities d (B, rows, columns), linear between whole ones.

    Border goes on left of the image. ψ in the paper.
    """
    lower = d.floor()
    share = d - lower
    u = TILE * torch.arange(left.shape[-1], device=left.device)
    at = [_gathered(right, (u - lower - k).long().clamp(0, right.shape[-1] - 1)) for k in (0, 1)]
    near, far = ((left - x).abs().sum(1) for x in at)
    return (1 - share) * near + share * far


def _gathered(right: Tensor, column: Tensor) -> Tensor:
    index = column[:, None].expand(-1, right.shape[1], -1, -1)
    return right.gather(-1, index)


def _signs(n: int, *, like: Tensor) -> Tensor:
    """−1, +1, −1, … (2 n,)"""
    return torch.tensor([-1.0, 1.0], dtype=like.dtype, device=like.device).repeat(n)
