"""The network, top to bottom: two images and a prior pose in, the relative rotation out.

Notation, as in the paper: f features of the shared CNN (section 3.1), F after the transformer
(3.2), M_vol and M_match the correlation volume before and after softmax (3.4), r a rotation as 6
numbers, its x and y columns (3.5). B pairs, c channels, h × w feature pixels, N = h·w of them
flattened row by row. ``R``, ``t`` take points of the left camera to the right one.

Frames. The prior (R_init, t_init) gives rectifying rotations R_left, R_right (DRectify, 3.3) with
R_right R_init R_leftᵀ = I. The network sees features in that *rectified* frame, where the truth is
Δ_gt = R_right R_gt R_leftᵀ, the identity if the prior is right. A correction may be written in the
rectified frame (of Δ) or in the cameras' (of R, as Eq. 12 has it): ``ModelConfig.frame``. In both a
correction of 0 leaves the start, and exactly one rotation, R_gt, is right, whatever the prior.

Networks run in the precision of autocast; poses, intrinsics and the solve are float64 throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import prod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from flowrect.config import ModelConfig
from flowrect.drectify import Rectification, rectify, warp
from flowrect.geometry import (
    pixel_grid,
    resized,
    rotation_from_6d,
    sixd_from_rotation,
    unproject,
)
from flowrect.least_squares import rotation_from_matches
from simgen.errors import UserError

MIN_FEATURES = 4  # feature pixels along each side


@dataclass(frozen=True)
class Prediction:
    """What the network says, of the last pass if there are several."""

    R: Tensor
    """(B, 3, 3) float64, the predicted rotation of the pair"""
    R_start: Tensor
    """(B, 3, 3) float64, what r_correction was added to: R_init, or the closed form's rotation"""
    log_matches: Tensor
    """(B, N, N) float32, log of M_match: left feature pixels by right ones"""
    rectification: Rectification
    """of the features: K_new at their resolution"""
    feature_wh: tuple[int, int]
    matches: Matches | None
    """what the displacement decoder read; None for conv3d"""


# --- 3.1 feature extraction --------------------------------------------------------------------
# Strided kernels are even, so a feature pixel's centre is the centre of the image area that it
# stands for, and K scales like that of a resized image. Odd ones would shift it by 1.5 px at 1/4.


class ResidualBlock(nn.Module):
    """Two convolutions with instance normalisation (as GMFlow) and a shortcut."""

    def __init__(self, c_in: int, c_out: int, stride: int) -> None:
        super().__init__()
        kernel = 4 if stride == 2 else 3
        self.body = nn.Sequential(
            nn.Conv2d(c_in, c_out, kernel, stride, 1, bias=False),
            nn.InstanceNorm2d(c_out),
            nn.ReLU(),
            nn.Conv2d(c_out, c_out, 3, padding=1, bias=False),
            nn.InstanceNorm2d(c_out),
        )
        self.shortcut = nn.Sequential(nn.AvgPool2d(stride), nn.Conv2d(c_in, c_out, 1))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.shortcut(x) + self.body(x))


def feature_network(channels: int, strides: tuple[int, int, int, int]) -> nn.Sequential:
    """The shared CNN: a first convolution, 3 residual blocks, a projection to ``channels``."""
    half, three_quarters = channels // 2, channels * 3 // 4
    kernel = 6 if strides[0] == 2 else 7
    return nn.Sequential(
        nn.Conv2d(3, half, kernel, strides[0], (kernel - 1) // 2, bias=False),
        nn.InstanceNorm2d(half),
        nn.ReLU(),
        ResidualBlock(half, half, strides[1]),
        ResidualBlock(half, three_quarters, strides[2]),
        ResidualBlock(three_quarters, channels, strides[3]),
        nn.Conv2d(channels, channels, 1),
    )


# --- 3.2 positional encoding and transformer ---------------------------------------------------


def sine_encoding(channels: int, hw: tuple[int, int], device: torch.device) -> Tensor:
    """(c, h, w): DETR's encoding of the row (first c/2 channels) and the column (the others).

    Channel 2k and 2k + 1 of each half are sin and cos of pos / C^(2k/d), with C = 10000,
    d = c/2, and positions counted from 1, as in DETR. Source: paper, Eq. 1.
    """
    d = channels // 2
    k = torch.arange(d // 2, dtype=torch.float64, device=device)
    frequency = 10000.0 ** (-2 * k / d)

    def of(n: int) -> Tensor:
        angle = torch.arange(1, n + 1, dtype=torch.float64, device=device) * frequency[:, None]
        return torch.stack([angle.sin(), angle.cos()], 1).flatten(0, 1).float()

    h, w = hw
    rows, columns = of(h)[:, :, None].expand(-1, h, w), of(w)[:, None, :].expand(-1, h, w)
    return torch.cat([rows, columns])


class Attention(nn.Module):
    """Attention over the full map: queries from one sequence (B, N, c), keys, values from another.

    Keys and values are means over squares of ``pool_keys`` feature pixels.
    """

    def __init__(self, channels: int, heads: int, pool_keys: int) -> None:
        super().__init__()
        self.heads, self.pool_keys = heads, pool_keys
        self.to_query = nn.Linear(channels, channels, bias=False)
        self.to_key_value = nn.Linear(channels, 2 * channels, bias=False)
        self.merge = nn.Linear(channels, channels, bias=False)

    def forward(self, x: Tensor, source: Tensor, hw: tuple[int, int]) -> Tensor:
        if self.pool_keys > 1:
            maps = source.mT.unflatten(2, hw)
            source = F.avg_pool2d(maps, self.pool_keys, ceil_mode=True).flatten(2).mT
        key, value = self.to_key_value(source).chunk(2, -1)
        q, k, v = (y.unflatten(-1, (self.heads, -1)).transpose(1, 2)
                   for y in (self.to_query(x), key, value))  # fmt: skip
        return self.merge(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class TransformerBlock(nn.Module):
    """Self-attention, cross-attention, feed-forward; each normalised before it, added after it.

    Normalising before rather than after, as [54] does, needs no warm-up of the learning rate.
    """

    def __init__(self, channels: int, heads: int, pool_keys: int, expansion: int) -> None:
        super().__init__()
        self.norm_self, self.norm_cross, self.norm_forward = (
            nn.LayerNorm(channels) for _ in range(3)
        )
        self.self_attention = Attention(channels, heads, pool_keys)
        self.cross_attention = Attention(channels, heads, pool_keys)
        self.feed_forward = nn.Sequential(
            nn.Linear(channels, expansion * channels),
            nn.GELU(),
            nn.Linear(expansion * channels, channels),
        )

    def forward(self, f: Tensor, hw: tuple[int, int]) -> Tensor:
        """f (2B, N, c): the left views, then the right ones.

        Eq. 3 and 4 name an output by its keys; it lies at the pixels of its queries, by which it is
        named here. The other reading transposes M_vol.
        """
        x = self.norm_self(f)
        f = f + self.self_attention(x, x, hw)
        x = self.norm_cross(f)
        f = f + self.cross_attention(x, torch.cat(x.chunk(2)[::-1]), hw)
        return f + self.feed_forward(self.norm_forward(f))


# --- 3.4 correlation volume --------------------------------------------------------------------


def log_match_distribution(F_left: Tensor, F_right: Tensor) -> Tensor:
    """log M_match (B, N, N) of features (B, N, c): softmax over all right pixels (Eq. 6, 7)."""
    M_vol = F_left @ F_right.mT / F_left.shape[-1] ** 0.5
    return M_vol.float().log_softmax(-1)


# --- 3.5 decoders ------------------------------------------------------------------------------


class ConvDecoder(nn.Module):
    """Six 3D convolutions with average pooling: M_match to M_flatten (B, head_h · head_w).

    Rows of the left image are the channels; the volume is (left column, right row, right column).
    Pooling halves the left columns between the convolutions, and what remains is averaged.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        channels = (config.decoder_rows, *config.decoder_channels, 1)
        self.rows, self.head_hw = config.decoder_rows, config.head_hw
        self.convolutions = nn.ModuleList(
            nn.Conv3d(a, b, 3, padding=1) for a, b in pairwise(channels)
        )

    def forward(self, log_matches: Tensor, hw: tuple[int, int]) -> Tensor:
        h, w = hw
        # In units of a uniform distribution: probabilities themselves start at 1e-4, below the
        # biases of the first convolution.
        ratio = log_matches.exp() * (h * w)
        x = ratio.unflatten(1, hw).flatten(2)
        x = x if h == self.rows else F.adaptive_avg_pool2d(x, (self.rows, x.shape[-1]))
        x = x.unflatten(2, (w, h, w))
        for convolution in self.convolutions[:-1]:
            x = F.relu(convolution(x))
            x = F.avg_pool3d(x, (min(2, x.shape[2]), 1, 1), ceil_mode=True)
        M_reduced = self.convolutions[-1](x).mean(2)
        return F.adaptive_avg_pool2d(M_reduced, self.head_hw).flatten(1)


@dataclass(frozen=True)
class Matches:
    """The best match of every left feature pixel, in units of feature pixels."""

    uv_right: Tensor
    """(B, N, 2) expected position near the most probable one"""
    spread: Tensor
    """(B, N) standard deviation of the position, both axes together"""
    peak: Tensor
    """(B, N) probability of the window"""


def expected_matches(log_matches: Tensor, hw: tuple[int, int], window: int) -> Matches:
    """Soft-argmax of M_match (B, N, N) over a window around each row's largest entry."""
    h, w = hw
    best = log_matches.argmax(-1)
    step = pixel_grid((2 * window + 1,) * 2, dtype=torch.long, device=best.device) - window
    u, v = (best % w)[..., None] + step[:, 0], (best // w)[..., None] + step[:, 1]
    within = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    index = v.clamp(0, h - 1) * w + u.clamp(0, w - 1)
    p = log_matches.gather(2, index).exp() * within
    peak = p.sum(-1)
    p = (p / peak[..., None])[..., None]
    uv = torch.stack([u, v], -1).to(p.dtype)
    mean = (p * uv).sum(2)
    variance = (p * (uv - mean[:, :, None]) ** 2).sum((2, 3))
    return Matches(mean, (variance + 1e-4).sqrt(), peak)


class DisplacementDecoder(nn.Module):
    """Beyond the paper: a rotation in closed form, and what it leaves over for the linear layer."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.head_hw, self.window = config.head_hw, config.window
        self.prior_sigma_rad = torch.pi / 180 * config.prior_sigma_deg
        self.confidence = nn.Linear(2, 1)
        with torch.no_grad():  # the weight starts as peak² / spread²
            self.confidence.weight.copy_(torch.tensor([[2.0, -2.0]]))
            self.confidence.bias.zero_()

    def forward(
        self, log_matches: Tensor, seen: Tensor, rect: Rectification, hw: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Matches]:
        """Start Δ (B, 3, 3), M_flatten (B, 3 · head_h · head_w), and the matches.

        Args:
          seen: (B, N) whether a left feature pixel shows image at all.
        """
        matches = expected_matches(log_matches, hw, self.window)
        logs = torch.stack([matches.peak, matches.spread], -1).clamp_min(1e-6).log()
        weight = self.confidence(logs)[..., 0].clamp(-20, 10).exp() * seen
        K, uv_right = rect.K_new, matches.uv_right.double()
        uv_left = pixel_grid(hw[::-1], dtype=torch.float64, device=K.device)
        rays = unproject(K, uv_left.expand_as(uv_right))
        Delta = rotation_from_matches(
            rays[..., :2], unproject(K, uv_right)[..., :2], weight.double(), rect.vertical,
            focal_px=K[:, 0, 0], prior_sigma_rad=self.prior_sigma_rad,
        )  # fmt: skip
        turned = (rays @ Delta.mT) @ K.mT
        residual = (uv_right - turned[..., :2] / turned[..., 2:]).float()
        return Delta, self._pooled(residual, weight.float(), hw), matches

    def _pooled(self, residual: Tensor, weight: Tensor, hw: tuple[int, int]) -> Tensor:
        """Weighted mean of the residual, and log of the mean weight, of each cell of the head."""
        weighted = torch.cat([residual * weight[..., None], weight[..., None]], -1)
        cells = F.adaptive_avg_pool2d(weighted.mT.unflatten(2, hw), self.head_hw)
        total = cells[:, 2:]
        mean = cells[:, :2] / (total + 1e-3)
        return torch.cat([mean, (total + 1e-3).log()], 1).flatten(1)


# --- the whole ---------------------------------------------------------------------------------


class Rectifier(nn.Module):
    """The paper's model (Fig. 2 a to c)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        c, cells = config.channels, config.head_hw[0] * config.head_hw[1]
        self.cnn = feature_network(c, config.strides)
        self.transformer = nn.ModuleList(
            TransformerBlock(c, config.heads, config.pool_keys, config.expansion)
            for _ in range(config.blocks)
        )
        self.norm = nn.LayerNorm(c)
        self.decoder: nn.Module
        if config.decoder == "conv3d":
            self.decoder, inputs = ConvDecoder(config), cells
        else:
            self.decoder, inputs = DisplacementDecoder(config), 3 * cells
        self.passes = config.passes
        self.linear = nn.Linear(inputs, 6)
        if config.zero_head:
            nn.init.zeros_(self.linear.weight)
            nn.init.zeros_(self.linear.bias)

    @property
    def stride(self) -> int:
        """Image pixels per feature pixel."""
        return prod(self.config.strides)

    def forward(
        self, left: Tensor, right: Tensor, K_left: Tensor, K_right: Tensor, R_init: Tensor,
        t_init: Tensor,
    ) -> Prediction:  # fmt: skip
        """Predicts the rotation of each pair.

        Args:
          left, right: (B, 3, H, W) in [0, 1], unrectified, of any size.
          K_left, K_right: (B, 3, 3) of images of that size [px].
          R_init, t_init: (B, 3, 3), (B, 3) the prior; of t_init only the direction matters.

        Raises:
          UserError: the images are too small, or too large for the correlation volume.
        """
        self._check_size(left)
        K_left, K_right, R_init, t_init = (x.double() for x in (K_left, K_right, R_init, t_init))
        f = self.cnn(torch.cat([left, right]) - 0.5)  # a. features
        K_left, K_right = (resized(K, 1 / self.stride) for K in (K_left, K_right))
        prediction = self._from_prior(f, K_left, K_right, R_init, t_init)
        for _ in range(0 if self.training else self.passes - 1):
            prediction = self._from_prior(f, K_left, K_right, prediction.R, t_init)
        return prediction

    def _from_prior(
        self, f: Tensor, K_left: Tensor, K_right: Tensor, R_init: Tensor, t_init: Tensor
    ) -> Prediction:
        """b. and c. of features f (2B, c, h, w), the left views first, with K of their size."""
        h, w = f.shape[-2:]
        rect = rectify(R_init, t_init, K_left, K_right, (w, h))
        f, seen = self._rectified_features(f, K_left, K_right, rect)
        f = f.flatten(2).mT
        for block in self.transformer:  # b. their enhancement
            f = block(f, (h, w))
        F_left, F_right = self.norm(f).chunk(2)
        log_matches = log_match_distribution(F_left, F_right)  # c. correlation volume, decoder
        matches = None
        if isinstance(self.decoder, ConvDecoder):
            R_start, M_flatten = R_init, self.decoder(log_matches, (h, w))
        else:
            Delta, M_flatten, matches = self.decoder(log_matches, seen, rect, (h, w))
            R_start = rect.R_right.mT @ Delta @ rect.R_left
        r_correction = self.config.correction_limit * torch.tanh(self.linear(M_flatten)).double()
        R = self.corrected(R_start, r_correction, rect)
        return Prediction(R, R_start, log_matches, rect, (w, h), matches)

    def corrected(self, R_start: Tensor, r_correction: Tensor, rect: Rectification) -> Tensor:
        """R_pred (B, 3, 3) = GramSchmidt(r_start + r_correction), in the frame of the config.

        Source: Eq. 12 and 13 in the cameras' frame.
        """
        if self.config.frame == "camera":
            return rotation_from_6d(sixd_from_rotation(R_start) + r_correction)
        Delta = rect.R_right @ R_start @ rect.R_left.mT
        Delta = rotation_from_6d(sixd_from_rotation(Delta) + r_correction)
        return rect.R_right.mT @ Delta @ rect.R_left

    def _rectified_features(
        self, f: Tensor, K_left: Tensor, K_right: Tensor, rect: Rectification
    ) -> tuple[Tensor, Tensor]:
        """Features (2B, c, h, w) with their positions, rectified by the prior, and ``seen``.

        Source: Eq. 2 and 5.
        """
        wh = (f.shape[-1], f.shape[-2])
        encoding = sine_encoding(f.shape[1], wh[::-1], f.device)
        if self.config.encode == "before":
            f = f + encoding
        K, R = torch.cat([K_left, K_right]), torch.cat([rect.R_left, rect.R_right])
        f, seen = warp(f.float(), K, R, torch.cat([rect.K_new, rect.K_new]), wh)
        if self.config.encode == "after":
            f = f + encoding
        return f, seen[: len(K_left)].flatten(1)

    def _check_size(self, left: Tensor) -> None:
        H, W = left.shape[-2:]
        h, w = H // self.stride, W // self.stride
        if min(h, w) < MIN_FEATURES:
            raise UserError(
                f"images of {W}x{H} px are too small: expected at least "
                f"{MIN_FEATURES * self.stride} px along each side; use larger ones."
            )
        if h * w > self.config.max_tokens:
            gib = (h * w) ** 2 * 4 / 2**30
            raise UserError(
                f"images of {W}x{H} px have {h * w} feature pixels, expected at most "
                f"{self.config.max_tokens} (max_tokens): the correlation volume of one pair would "
                f"take {gib:.1f} GiB. Shrink the images, or raise max_tokens if there is memory."
            )
