"""What flows from the data to the network: a pair as a source yields it, and a batch of tensors.

Frames and pixels as in CONVENTIONS.md. *Nominal* is what the rig's drawing says, and what a method
starts from; the pose without that word is the truth. The *turn* of a camera, ``R_nominal_cam``, is
how it stands against its nominal orientation, about its own centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flowrect import correspondences
from flowrect.correspondences import Correspondences
from simgen.errors import UserError
from simgen.geometry import Array

MAX_OFF_CENTRE = 0.2
"""of the principal point from the image's centre, over the side: beyond it, K is not the image's.
K of the image at half size is off by 0.25 along both sides"""

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Pair:
    """One stereo pair with its cameras; two pinhole images of one size, without distortion."""

    left: Image
    """(H, W, 3) RGB"""
    right: Image
    K_left: Array
    """(3, 3) [px], pixel-centre convention"""
    K_right: Array
    T_right_left: Array | None
    """(4, 4) true pose; None where nobody knows it"""
    T_right_left_nominal: Array
    turn_left: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) ``R_nominal_cam``; identity where only the relative pose is known"""
    turn_right: Array = field(default_factory=lambda: np.eye(3))
    truth: Correspondences | None = None
    name: str = ""
    scene: str = ""
    """pairs of one scene share it: the unit that is resampled for intervals"""
    weather: str = ""
    daylight: str = ""

    def __post_init__(self) -> None:
        _require_same_size(self.name, self.left, self.right)
        for side, K in (("left", self.K_left), ("right", self.K_right)):
            require_fit(f"{self.name}: K_{side}", K, self.wh)

    @property
    def wh(self) -> tuple[int, int]:
        """(width, height) [px] of both images."""
        h, w = self.left.shape[:2]
        return w, h


def _require_same_size(name: str, left: Image, right: Image) -> None:
    for side, image in (("left", left), ("right", right)):
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise UserError(
                f"{name}: the {side} image is {image.dtype} of shape {image.shape}, expected "
                "uint8 (H, W, 3) in RGB."
            )
    if left.shape != right.shape:
        (h, w), (h2, w2) = left.shape[:2], right.shape[:2]
        raise UserError(
            f"{name}: the left image is {w}x{h}, the right one {w2}x{h2}; expected one size. "
            "Resize or crop one of them, and change its K along."
        )


def require_fit(what: str, K: Array, wh: tuple[int, int]) -> None:
    """UserError unless K can be that of an image of size ``wh``; ``what`` names it."""
    K = np.asarray(K)
    if K.shape != (3, 3) or not (K[0, 0] > 0 and K[1, 1] > 0 and tuple(K[2]) == (0, 0, 1)):
        raise UserError(f"{what} is\n{K}\nexpected (3, 3): fx 0 cx / 0 fy cy / 0 0 1, in pixels.")
    centre = (np.asarray(wh) - 1) / 2
    if not np.all(np.abs(K[:2, 2] - centre) <= MAX_OFF_CENTRE * np.asarray(wh)):
        raise UserError(
            f"{what} has its principal point at ({K[0, 2]:.1f}, {K[1, 2]:.1f}), far from the "
            f"centre of an image of {wh[0]}x{wh[1]}: does it belong to another image size? Scale "
            "it by new / old size: f' = s f, c' = s (c + 0.5) - 0.5."
        )


class Prepared(NamedTuple):
    """One pair at the two sizes that training needs, cut from the same window."""

    input: Pair
    """at the network's input size"""
    metric: Pair
    """at ``metrics.METRIC_WH``"""


@dataclass
class Batch:
    """B pairs as tensors; geometry is float64."""

    left: Tensor
    """(B, 3, h, w) float32 in 0..1, at the network's input size"""
    right: Tensor
    K_left: Tensor
    """(B, 3, 3)"""
    K_right: Tensor
    left_metric: Tensor
    """(B, 3, 256, 512) of the same window"""
    right_metric: Tensor
    K_left_metric: Tensor
    K_right_metric: Tensor
    R: Tensor | None
    """(B, 3, 3) of T_right_left; None if a pair of the batch has no known pose"""
    t: Tensor | None
    """(B, 3)"""
    R_nominal: Tensor
    t_nominal: Tensor
    truth: Correspondences | None
    names: list[str]

    def __len__(self) -> int:
        return len(self.names)

    def to(self, device: torch.device | str) -> Batch:
        """The same on ``device``."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Batch(**{k: v.to(device) if hasattr(v, "to") else v for k, v in values.items()})


def collate(items: Sequence[Prepared]) -> Batch:
    """B prepared pairs as one batch."""
    inputs, metrics = [i.input for i in items], [i.metric for i in items]
    true = [i.T_right_left for i in inputs if i.T_right_left is not None]
    T = _stacked(true) if len(true) == len(items) else None
    T_nominal = _stacked([i.T_right_left_nominal for i in inputs])
    truths = [i.truth for i in inputs if i.truth is not None]
    return Batch(
        left=_images([i.left for i in inputs]),
        right=_images([i.right for i in inputs]),
        K_left=_stacked([i.K_left for i in inputs]),
        K_right=_stacked([i.K_right for i in inputs]),
        left_metric=_images([i.left for i in metrics]),
        right_metric=_images([i.right for i in metrics]),
        K_left_metric=_stacked([i.K_left for i in metrics]),
        K_right_metric=_stacked([i.K_right for i in metrics]),
        R=None if T is None else T[:, :3, :3],
        t=None if T is None else T[:, :3, 3],
        R_nominal=T_nominal[:, :3, :3],
        t_nominal=T_nominal[:, :3, 3],
        truth=correspondences.collate(truths) if len(truths) == len(items) else None,
        names=[i.name for i in inputs],
    )


def _stacked(arrays: list[Array]) -> Tensor:
    return torch.from_numpy(np.stack(arrays))


def _images(images: list[Image]) -> Tensor:
    """(B, 3, h, w) in 0..1, contiguous."""
    stacked: NDArray[Any] = np.stack([image.transpose(2, 0, 1) for image in images])
    return torch.from_numpy(stacked).float().div_(255)
