"""DirectionNet: each axis of the rotation as a distribution over the sphere.

Source: Chen, Snavely, Makadia, *Wide-Baseline Relative Camera Pose Estimation with Directional
Learning*, CVPR 2021.

Maps are equirectangular, (…, h, w), with pixel centres at colatitude θ from the pole −y (up) and
longitude φ from z, towards x: the direction is (sin θ sin φ, −cos θ, sin θ cos φ), of the frame
that Δ leads to (``flowrect.rivals.frame``). A map is a *density* [1/sr]: with the solid angles of
its pixels it sums to 1. Its *expectation* E is a vector in the unit ball; E / |E| is the direction,
and 1 − |E| its spread. The directions are the columns of Δ, and t's if asked for.

Deviations: DirectionNet-R only; the second network, which sees derotated images and predicts t, is
left out, since t is not what is compared (``predict_t`` gives DirectionNet-Single). Solid angles
are exact instead of sin θ. Adam instead of SGD.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import pi

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from flowrect.geometry import rotation_from_6d
from flowrect.rivals.config import DirectionNetConfig
from flowrect.rivals.frame import Frame, views

MAP_HW = (64, 64)
"""rows and columns of the maps, the paper's"""
EXPANSION = 2
"""of a bottleneck's channels"""
SLOPE = 0.3
"""of the leaky rectifiers, Keras's default"""


@dataclass(frozen=True)
class Prediction:
    """What DirectionNet says."""

    R: Tensor
    """(B, 3, 3) float64"""
    t: Tensor | None
    """(B, 3) float64, as long as the prior's; None if it is not asked for"""
    frame: Frame
    density: Tensor
    """(B, n, h, w) float64 [1/sr]"""
    expectation: Tensor
    """(B, n, 3) float64"""


# --- the sphere --------------------------------------------------------------------------------


def sphere_directions(hw: tuple[int, int]) -> Tensor:
    """Unit vectors (h, w, 3) float64 through the pixel centres of a map."""
    h, w = hw
    theta = (torch.arange(h, dtype=torch.float64) + 0.5)[:, None] * pi / h
    phi = (torch.arange(w, dtype=torch.float64) + 0.5) * 2 * pi / w - pi
    x, z = theta.sin() * phi.sin(), theta.sin() * phi.cos()
    return torch.stack([x, (-theta.cos()).expand_as(x), z], -1)


def solid_angles(hw: tuple[int, int]) -> Tensor:
    """(h, 1) float64 [sr] of a pixel in each row; all pixels together have 4π."""
    edges = torch.linspace(0, pi, hw[0] + 1, dtype=torch.float64).cos()
    return ((edges[:-1] - edges[1:]) * 2 * pi / hw[1])[:, None]


def density_of(maps: Tensor) -> Tensor:
    """Density (…, h, w) float64 [1/sr] of a network's maps, by softplus and division."""
    positive = F.softplus(maps.double())
    mass = positive * solid_angles(_hw(maps)).to(positive)
    return positive / mass.sum((-2, -1), keepdim=True)


def expectation_of(density: Tensor) -> Tensor:
    """∫ x p(x) dx, a vector (…, 3) of the unit ball, of a density (…, h, w)."""
    hw = _hw(density)
    mass = density * solid_angles(hw).to(density)
    return torch.einsum("...hw,hwc->...c", mass, sphere_directions(hw).to(density))


def von_mises_fisher(mean: Tensor, concentration: float, hw: tuple[int, int] = MAP_HW) -> Tensor:
    """Density (…, h, w) proportional to exp(κ mean · x) about unit vectors (…, 3); sums to 1."""
    cosine = torch.einsum("...c,hwc->...hw", mean, sphere_directions(hw).to(mean))
    unscaled = (concentration * (cosine - 1)).exp()
    return unscaled / (unscaled * solid_angles(hw).to(mean)).sum((-2, -1), keepdim=True)


def _hw(x: Tensor) -> tuple[int, int]:
    return x.shape[-2], x.shape[-1]


def padded_on_sphere(x: Tensor) -> Tensor:
    """One more pixel on every side of maps (…, h, w): across a pole lies the opposite meridian."""
    across = x.roll(x.shape[-1] // 2, -1)
    x = torch.cat([across[..., :1, :], x, across[..., -1:, :]], -2)
    return torch.cat([x[..., -1:], x, x[..., :1]], -1)


# --- layers ------------------------------------------------------------------------------------


class Bottleneck(nn.Module):
    """1 × 1, 3 × 3, 1 × 1 convolutions after their activations, and a shortcut.

    Its zero padding is what tells one pixel of the sphere from the next; all else treats them
    alike.
    """

    def __init__(self, c_in: int, c: int, stride: int = 1) -> None:
        super().__init__()
        c_out = EXPANSION * c
        self.body = nn.Sequential(
            *_activation(c_in), nn.Conv2d(c_in, c, 1, bias=False),
            *_activation(c), nn.Conv2d(c, c, 3, stride, 1, bias=False),
            *_activation(c), nn.Conv2d(c, c_out, 1, bias=False),
        )  # fmt: skip
        same = stride == 1 and c_in == c_out
        self.shortcut = nn.Identity() if same else nn.Conv2d(c_in, c_out, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        summed: Tensor = self.body(x) + self.shortcut(x)
        return summed


class Upsampling(nn.Module):
    """Maps of c_in channels to maps of 2c channels, twice as large."""

    def __init__(self, c_in: int, c: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(c_in, EXPANSION * c, 3, bias=False), *_two_blocks(EXPANSION * c, c),
            *_activation(EXPANSION * c),
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        x = F.interpolate(padded_on_sphere(x), scale_factor=2, mode="bilinear")
        larger: Tensor = self.body(x)[..., 1:-1, 1:-1]
        return larger


def _activation(channels: int) -> tuple[nn.Module, nn.Module]:
    return nn.BatchNorm2d(channels), nn.LeakyReLU(SLOPE)


def _two_blocks(c_in: int, c: int, stride: int = 1) -> tuple[nn.Module, nn.Module]:
    return Bottleneck(c_in, c, stride), Bottleneck(EXPANSION * c, c)


# --- the whole ---------------------------------------------------------------------------------


class DirectionNet(nn.Module):
    """Siamese encoder to one vector, decoder to one map a direction."""

    def __init__(self, config: DirectionNetConfig) -> None:
        super().__init__()
        self.config = config
        self.num_columns = 3 if config.directions == "9d" else 2
        self.siamese = nn.Sequential(
            nn.Conv2d(3, 64, 7, 2, 3, bias=False),
            *_two_blocks(64, 128, 2), *_two_blocks(256, 128, 2), *_two_blocks(256, 256, 2),
        )  # fmt: skip
        self.merged = nn.Sequential(
            *_two_blocks(1024, 256, 2), *_two_blocks(512, 256, 2), *_activation(512),
            nn.AdaptiveAvgPool2d(1),
        )  # fmt: skip
        channels = (512, 256, 128, 64, 32, 16, 8)
        self.decoder = nn.Sequential(
            *(Upsampling(a, b // EXPANSION) for a, b in pairwise(channels)),
            nn.Conv2d(channels[-1], self.num_columns + config.predict_t, 1),
        )

    def forward(
        self, left: Tensor, right: Tensor, K_left: Tensor, K_right: Tensor, R_init: Tensor,
        t_init: Tensor,
    ) -> Prediction:  # fmt: skip
        """Arguments as ``Rectifier.forward``."""
        seen = views(left, right, K_left, K_right, R_init, t_init, self.config)
        both = torch.cat(self.siamese(seen.images).chunk(2), 1)
        density = density_of(self.decoder(self.merged(both)))
        expectation = expectation_of(density)
        directions = F.normalize(expectation, dim=-1)
        Delta = rotation_of_columns(directions[:, : self.num_columns])
        R, _ = seen.frame.pose(Delta, torch.zeros_like(t_init.double()))
        t = None
        if self.config.predict_t:
            baseline = torch.linalg.vector_norm(t_init.double(), dim=-1, keepdim=True)
            t = baseline * (seen.frame.R_right.mT @ directions[:, -1, :, None])[..., 0]
        return Prediction(R, t, seen.frame, density, expectation)

    def losses(self, prediction: Prediction, R: Tensor, t: Tensor) -> dict[str, Tensor]:
        """Of directions, distributions and spread; R (B, 3, 3), t (B, 3) the truth."""
        config, frame = self.config, prediction.frame
        Delta, _ = frame.residual(R, t)
        truth = Delta.mT[:, : self.num_columns]
        if config.predict_t:
            t = (frame.R_right @ t[..., None])[..., 0]
            truth = torch.cat([truth, F.normalize(t, dim=-1)[:, None]], 1)
        directions = F.normalize(prediction.expectation, dim=-1)
        density = prediction.density
        error = density - von_mises_fisher(truth, config.concentration)
        squared = (error**2 * solid_angles(MAP_HW).to(error)).sum((-2, -1))
        length = torch.linalg.vector_norm(prediction.expectation, dim=-1)
        return {
            "direction": -(directions * truth).sum(-1).mean(),
            "distribution": config.distribution * squared.mean(),
            "spread": config.spread * (1 - length).mean(),
        }


def rotation_of_columns(columns: Tensor) -> Tensor:
    """R (B, 3, 3) of its first two columns (B, 2, 3), or the closest to three (B, 3, 3)."""
    if columns.shape[1] == 2:
        return rotation_from_6d(columns.flatten(1))
    U, _, Vh = torch.linalg.svd(columns.mT)
    sign = torch.ones_like(columns[:, 0])
    sign[:, 2] = torch.linalg.det(U @ Vh)
    return (U * sign[:, None]) @ Vh
