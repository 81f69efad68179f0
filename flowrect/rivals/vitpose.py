"""ViTPose: a transformer whose last block computes what the eight-point algorithm does.

Source: Rockwell, Johnson, Fouhey, *The 8-Point Algorithm as an Inductive Bias for Relative Pose
Prediction by ViTs*, 3DV 2022.

ResNet-18 to its second stage and a residual block give *tokens* of c channels, 24 × 24 of
224 × 224 pixels. Self-attention blocks see one image at a time. In the last block, the *essential
matrix module*, A = softmax over rows ⊙ softmax over columns of Q Kᵀ is large for mutual matches
alone, V has the monomials φ = (y², x², xy, y, x, 1) of a token's ray appended, and Vᵀ A V then
holds sums over matches of products of φ, as the normal equations of the eight-point algorithm do.
Both directions, left to right and back, go through an MLP to a quaternion and t (Δ, δ of
``flowrect.rivals.frame``).

Deviations: the ResNet starts at random; the paper's knows ImageNet. Rays are those of the tokens'
centres with the K of their image; the release spreads them over the whole image and exchanges rows
and columns. Seven numbers are predicted, not twice seven of which one half is unused. No weight
decay, and the rate decays exponentially instead of by one cycle. Units of the MLP leak, and its
first layer is a :class:`WideLinear`: with ReLU all of them died in training, first those that see
26,880 inputs, which a step of Adam turns at once, then, with these divided, those of the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torchvision.models import resnet18

from flowrect.geometry import geodesic_rad, pixel_grid, rotation_from_quaternion, unproject
from flowrect.rivals.config import ViTPoseConfig
from flowrect.rivals.frame import Frame, answers, unit_quaternion, views

STRIDE = 8
"""pixels of the image per token; the ResNet's kernels are odd, so feature (0, 0) is at pixel 0"""
BORDER = 2
"""features that the first convolution after the ResNet cuts on every side"""
NUM_MONOMIALS = 6
MLP_RATIO = 4
LEAK = 0.1
"""slope of the MLP's units below 0"""
WIDE = 64.0
"""a power of 2, so that nothing is rounded by it"""


@dataclass(frozen=True)
class Prediction:
    """What ViTPose says."""

    R: Tensor
    """(B, 3, 3) float64"""
    t: Tensor
    """(B, 3) float64"""
    frame: Frame
    Delta: Tensor
    """(B, 3, 3) float64"""
    shift: Tensor
    """(B, 3) float64, δ"""


# --- the essential matrix module ---------------------------------------------------------------


def token_grid(wh: tuple[int, int]) -> tuple[int, int]:
    """Columns and rows of tokens of images of a size."""
    columns, rows = ((n + STRIDE - 1) // STRIDE - 2 * BORDER for n in wh)
    return columns, rows


def monomials(K: Tensor, wh: tuple[int, int]) -> Tensor:
    """φ (B, N, 6) float64 of the rays of the tokens, row by row, of images of size ``wh``."""
    grid = pixel_grid(token_grid(wh), dtype=K.dtype, device=K.device)
    uv = STRIDE * (grid + BORDER)
    x, y, one = unproject(K, uv.expand(len(K), -1, -1)).unbind(-1)
    return torch.stack([y * y, x * x, x * y, y, x, one], -1)


def mutual_attention(query: Tensor, key: Tensor) -> Tensor:
    """A (…, N, N) of queries and keys (…, N, d): large only where each is the other's best."""
    scores = query @ key.mT / query.shape[-1] ** 0.5
    return scores.softmax(-1) * scores.softmax(-2)


def quadratic_form(V_row: Tensor, A: Tensor, V_column: Tensor) -> Tensor:
    """Vᵀ A V (…, d, d): Σ over i, j of A_ij times the outer product of V_row[i], V_column[j]."""
    return V_row.mT @ A @ V_column


class EssentialModule(nn.Module):
    """Tokens (2B, N, c), the left views first, to (2B, d + 6, c), with d = c / heads.

    The first half belongs to A of right queries and left keys, the second to the opposite.
    """

    def __init__(self, config: ViTPoseConfig) -> None:
        super().__init__()
        c = config.channels
        self.heads, self.cross_features = config.heads, config.cross_features
        self.norm_attention, self.norm_mlp = nn.LayerNorm(c), nn.LayerNorm(c)
        self.to_qkv = nn.Linear(c, 3 * c)
        self.merge = nn.Linear(c + config.heads * NUM_MONOMIALS, c)
        self.mlp = _mlp(c)

    def forward(self, f: Tensor, phi: Tensor) -> Tensor:
        q, k, v = _split_heads(self.to_qkv(self.norm_attention(f)), self.heads)
        phi = phi[:, None].expand(-1, self.heads, -1, -1).to(v.dtype)
        V = torch.cat([v, phi], -1)
        A = mutual_attention(_exchanged(q), k)
        form = quadratic_form(_exchanged(V) if self.cross_features else V, A, V)
        f = self.merge(form.flatten(1, 2).mT)
        merged: Tensor = f + self.mlp(self.norm_mlp(f))
        return merged


# --- the other layers --------------------------------------------------------------------------


class SelfAttentionBlock(nn.Module):
    """A block of ViT: attention and MLP, each after a normalisation."""

    def __init__(self, config: ViTPoseConfig) -> None:
        super().__init__()
        c = config.channels
        self.heads = config.heads
        self.norm_attention, self.norm_mlp = nn.LayerNorm(c), nn.LayerNorm(c)
        self.to_qkv, self.merge = nn.Linear(c, 3 * c), nn.Linear(c, c)
        self.mlp = _mlp(c)

    def forward(self, f: Tensor) -> Tensor:
        q, k, v = _split_heads(self.to_qkv(self.norm_attention(f)), self.heads)
        seen = F.scaled_dot_product_attention(q, k, v)
        f = f + self.merge(seen.transpose(1, 2).flatten(2))
        attended: Tensor = f + self.mlp(self.norm_mlp(f))
        return attended


class CutBlock(nn.Module):
    """Two convolutions with a shortcut; the first one cuts ``BORDER`` features on every side."""

    def __init__(self, c_in: int, c: int) -> None:
        super().__init__()
        size = 2 * BORDER + 1
        self.body = nn.Sequential(
            nn.Conv2d(c_in, c, size, bias=False), nn.BatchNorm2d(c), nn.ReLU(),
            nn.Conv2d(c, c, 3, padding=1, bias=False), nn.BatchNorm2d(c), nn.ReLU(),
        )  # fmt: skip
        self.shortcut = nn.Sequential(nn.Conv2d(c_in, c, size, bias=False), nn.BatchNorm2d(c))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.body(x) + self.shortcut(x))


def _mlp(c: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(c, MLP_RATIO * c), nn.GELU(), nn.Linear(MLP_RATIO * c, c))


def _split_heads(qkv: Tensor, heads: int) -> Tensor:
    """(B, N, 3c) to (3, B, heads, N, c / heads)."""
    return qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)


def _exchanged(x: Tensor) -> Tensor:
    """Right views first."""
    return torch.cat(x.chunk(2)[::-1])


class WideLinear(nn.Linear):
    """Of very many inputs: they are divided by ``WIDE``, and weights start as much larger.

    The same function as ``nn.Linear`` to begin with, and a ``WIDE``-th of the change by a step of
    Adam, which turns every weight by about the rate.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)
        with torch.no_grad():
            self.weight.mul_(WIDE)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x / WIDE)


# --- the whole ---------------------------------------------------------------------------------


class ViTPose(nn.Module):
    """ResNet, transformer, essential matrix module, MLP."""

    def __init__(self, config: ViTPoseConfig) -> None:
        super().__init__()
        self.config = config
        c, (columns, rows) = config.channels, token_grid(config.network_wh)
        resnet = resnet18(weights=None)
        self.cnn = nn.Sequential(
            resnet.conv1, resnet.bn1, resnet.relu, resnet.maxpool, resnet.layer1, resnet.layer2,
            CutBlock(128, c),
        )  # fmt: skip
        self.position = nn.Parameter(nn.init.xavier_uniform_(torch.empty(1, rows * columns, c)))
        self.blocks = nn.Sequential(*(SelfAttentionBlock(config) for _ in range(config.depth - 1)))
        self.essential = EssentialModule(config)
        self.norm = nn.LayerNorm(c)
        inputs = 2 * c * (c // config.heads + NUM_MONOMIALS)  # 26,880
        last = nn.Linear(config.hidden, 7)
        answers(last, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
        self.pose = nn.Sequential(
            WideLinear(inputs, config.hidden), nn.LeakyReLU(LEAK),
            nn.Linear(config.hidden, config.hidden), nn.LeakyReLU(LEAK), last,
        )  # fmt: skip

    def forward(
        self, left: Tensor, right: Tensor, K_left: Tensor, K_right: Tensor, R_init: Tensor,
        t_init: Tensor,
    ) -> Prediction:  # fmt: skip
        """Arguments as ``Rectifier.forward``."""
        seen = views(left, right, K_left, K_right, R_init, t_init, self.config)
        f = self.cnn(seen.images).flatten(2).mT + self.position
        f = self.essential(self.blocks(f), monomials(seen.K, self.config.network_wh))
        f_left, f_right = self.norm(f).flatten(1).chunk(2)
        pose = self.pose(torch.cat([f_left, f_right], 1)).double()
        Delta, shift = rotation_from_quaternion(unit_quaternion(pose[:, :4])), pose[:, 4:]
        return Prediction(*seen.frame.pose(Delta, shift), seen.frame, Delta, shift)

    def losses(self, prediction: Prediction, R: Tensor, t: Tensor) -> dict[str, Tensor]:
        """Geodesic error, and that of t; R (B, 3, 3), t (B, 3) the truth."""
        Delta, shift = prediction.frame.residual(R, t)
        away = torch.linalg.vector_norm(prediction.shift - shift, dim=-1)
        return {
            "rotation": self.config.rotation * geodesic_rad(Delta, prediction.Delta).mean(),
            "translation": self.config.translation * away.mean(),
        }
