"""The learned rivals of the paper's tables: one file each, one signature, that of ``Rectifier``.

network = build(RPNetConfig())
prediction = network(left, right, K_left, K_right, R_init, t_init)
prediction.R, prediction.t                        # (B, 3, 3), (B, 3) float64
network.losses(prediction, R_gt, t_gt)            # weighted terms by name, as its paper has them
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from flowrect.rivals.config import DirectionNetConfig, RivalConfig, RPNetConfig

if TYPE_CHECKING:
    from flowrect.rivals.directionnet import DirectionNet
    from flowrect.rivals.rpnet import RPNet
    from flowrect.rivals.vitpose import ViTPose

    Rival = RPNet | DirectionNet | ViTPose


class PosePrediction(Protocol):
    """What every rival says of a pair."""

    @property
    def R(self) -> Tensor:
        """(B, 3, 3) float64"""

    @property
    def t(self) -> Tensor | None:
        """(B, 3) float64, of any length; None if t is not predicted"""


def build(config: RivalConfig) -> Rival:
    """The network of a config, untrained. What it needs of torchvision is loaded only here."""
    if isinstance(config, RPNetConfig):
        from flowrect.rivals.rpnet import RPNet

        return RPNet(config)
    if isinstance(config, DirectionNetConfig):
        from flowrect.rivals.directionnet import DirectionNet

        return DirectionNet(config)
    from flowrect.rivals.vitpose import ViTPose

    return ViTPose(config)
