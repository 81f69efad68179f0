"""What the rivals of the paper's tables are made of and what they minimise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from simgen.errors import UserError

MIN_SIDE = 64
"""[px] of ``network_wh``: an eighth of it, less the border that ViTPose cuts, is still a map"""


@dataclass(frozen=True)
class SharedConfig:
    """What all rivals have in common: what they see, and what their answer is added to."""

    input_wh: tuple[int, int] = (448, 224)
    """width and height that images are fitted to"""
    network_wh: tuple[int, int] = (224, 224)
    """that they are squeezed to within, with K; the papers' size. 256x128 takes half of the time
    and keeps pixels square"""
    start: Literal["prior", "none"] = "prior"
    """prior: images are rectified by the prior, and what it leaves is predicted. none, as
    published: images as they are, the pose itself, t in metres"""

    def __post_init__(self) -> None:
        if min(self.network_wh) < MIN_SIDE:
            raise UserError(
                f"network_wh {self.network_wh}: expected at least {MIN_SIDE} px along each side."
            )


@dataclass(frozen=True)
class RPNetConfig(SharedConfig):
    """RPNet, see flowrect.rivals.rpnet."""

    hidden: int = 2048
    """width of the fully connected layer before the pose, as in PoseNet"""
    dropout: float = 0.0
    """before the heads; the release trains without"""
    rotation: float = 10.0
    """weight of the quaternion's error, beta; the paper balances it by hand, its release has 1 to
    100"""
    translation: float = 1.0
    """weight of the error of t over the baseline, or in metres (``start``)"""
    auxiliary: float = 0.3
    """weight of each of the two auxiliary heads"""


@dataclass(frozen=True)
class DirectionNetConfig(SharedConfig):
    """DirectionNet, see flowrect.rivals.directionnet."""

    input_wh: tuple[int, int] = (512, 256)
    network_wh: tuple[int, int] = (256, 256)
    directions: Literal["6d", "9d"] = "9d"
    """6d: the x and y columns of the rotation, and Gram-Schmidt; 9d: all, and the SVD"""
    predict_t: bool = False
    """one more map, of t's direction (the paper's DirectionNet-Single). False: DirectionNet-R"""
    concentration: float = 10.0
    """kappa of the von Mises-Fisher density that a map should have"""
    distribution: float = 94.0
    """weight of the squared error of the density, integrated over the sphere [sr]. 94 is the
    paper's 8e7 in its units: the mean over 64x64 pixels of the square of probability per pixel"""
    spread: float = 0.1
    """weight of 1 - |expectation|"""


@dataclass(frozen=True)
class ViTPoseConfig(SharedConfig):
    """ViTPose, see flowrect.rivals.vitpose."""

    channels: int = 192
    """of a token: ViT-Tiny"""
    heads: int = 3
    depth: int = 6
    """blocks; the last one is the essential matrix module"""
    hidden: int = 512
    """width of the two layers that lead to the pose"""
    cross_features: bool = False
    """V of the other image on the left of the product; the release's option for narrow turns"""
    rotation: float = 10.0
    """weight of the geodesic error [1/rad]"""
    translation: float = 10.0
    """weight of the error of t over the baseline, or in metres (``start``)"""


RivalConfig = RPNetConfig | DirectionNetConfig | ViTPoseConfig

RIVALS: dict[str, RivalConfig] = {
    "rpnet": RPNetConfig(),
    "directionnet": DirectionNetConfig(),
    "vitpose": ViTPoseConfig(),
}
