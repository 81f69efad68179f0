"""Using a trained network: two images, their intrinsics and a prior in, a calibration out.

model = load_model("small")
estimate = model.estimate(left, right, K_left, K_right, T_right_left)   # uint8 RGB, (4, 4)
estimate.R, estimate.R1, estimate.P1, estimate.Q                         # as cv2.stereoRectify
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from flowrect.calibration import Projections, projections
from flowrect.geometry import angles_per_axis_rad
from flowrect.model import Prediction
from flowrect.resize import Sizing, sized
from flowrect.sample import Image, Pair, collate
from flowrect.weights import Card, find_weights, load_weights
from simgen.errors import UserError
from simgen.geometry import Array, transform

if TYPE_CHECKING:
    from flowrect.rivals import PosePrediction
    from flowrect.weights import PoseNetwork

MIN_CONTRAST = 2.0
"""standard deviation of an image's grey levels (of 255) below which there is nothing to match"""


@dataclass(frozen=True, eq=False)
class Estimate(Projections):
    """A calibration of the pair, float64 NumPy: its pose, and the rectification that follows."""

    R: Array
    """(3, 3) X_right = R X_left + t"""
    t: Array
    """(3,) that of the prior, or in the direction that a rival predicts and as long"""
    correction_deg: Array
    """(3,) of R against the prior, about the right camera's x, y, z"""
    match_probability: float | None
    """mean over the left image of the most probable match's probability, in 0..1; None for a
    network without matches"""
    notes: tuple[str, ...]
    """why the estimate should not be trusted; empty if nothing speaks against it"""

    @property
    def valid(self) -> bool:
        """Whether nothing speaks against the estimate."""
        return not self.notes


@dataclass(frozen=True)
class Calibrator:
    """A network with what is known of its training."""

    network: PoseNetwork
    card: Card

    def estimate(
        self, left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
    ) -> Estimate:
        """Predicts the rotation of a pair, starting from a prior.

        Args:
          left, right: (H, W, 3) uint8 RGB, unrectified, without lens distortion.
          K_left, K_right: (3, 3) [px] of these images.
          prior: (4, 4) T_right_left, the nominal or last known pose.

        Raises:
          UserError: what was given cannot be a stereo pair.

        Warns of everything that it lists in ``Estimate.notes``.
        """
        pair = Pair(left, right, K_left, K_right, None, _checked_pose(prior), name="estimate")
        if np.array_equal(left, right):
            raise UserError("the two images are identical; expected a left and a right view.")
        sizing = Sizing(self.network.config.input_wh, self.card.fit, self.card.keep)
        batch = collate([sized(pair, sizing)])
        with torch.inference_mode():
            prediction = self.network(
                batch.left, batch.right, batch.K_left, batch.K_right, batch.R_nominal,
                batch.t_nominal,
            )  # fmt: skip
        correction = angles_per_axis_rad(prediction.R, batch.R_nominal)[0].rad2deg().numpy()
        probability = _match_probability(prediction)
        notes = (*_texture_notes(batch.left, batch.right), *self._range_notes(correction),
                 *self.match_notes(probability))  # fmt: skip
        for note in notes:
            warnings.warn(note, stacklevel=2)
        R, t = prediction.R[0].numpy(), _translation(prediction, pair.T_right_left_nominal[:3, 3])
        return Estimate(
            **vars(projections(transform(R, t), pair.K_left, pair.K_right, pair.wh)),
            R=R,
            t=t,
            correction_deg=correction,
            match_probability=probability,
            notes=notes,
        )

    def match_notes(self, probability: float | None) -> list[str]:
        """Whether a pair matches so little that its rotation is a guess; empty if it does not."""
        least = self.card.least_match_probability
        if probability is None or probability >= least:
            return []
        return [
            f"the images hardly match: the most probable matches have {probability:.3f} on "
            f"average, expected at least {least:g}. Do both show the same scene?"
        ]

    def _range_notes(self, correction_deg: Array) -> list[str]:
        limit = np.asarray(self.card.prior_range_deg)
        if (np.abs(correction_deg) <= limit).all():
            return []
        return [
            f"the estimate is {_angles(correction_deg)} (x, y, z) away from the prior, and the "
            f"network was trained for priors within {_angles(limit)}; expect it to be wrong, and "
            "give a better prior or weights trained for a wider range."
        ]


def load_model(name_or_path: str | Path) -> Calibrator:
    """The network of shipped weights (``small``) or of a file of flowrect.train."""
    return Calibrator(*load_weights(find_weights(name_or_path)))


def _translation(prediction: Prediction | PosePrediction, prior: Array) -> Array:
    """t (3,) as long as the prior's: no image shows how long it is."""
    if isinstance(prediction, Prediction) or prediction.t is None:
        return prior
    t: Array = prediction.t[0].numpy()
    return t * (np.linalg.norm(prior) / np.linalg.norm(t))


def _match_probability(prediction: Prediction | PosePrediction) -> float | None:
    if not isinstance(prediction, Prediction):
        return None
    return float(prediction.log_matches.amax(-1).exp().mean())


def _checked_pose(T: Array) -> Array:
    T = np.asarray(T, dtype=np.float64)
    good = T.shape == (4, 4) and np.allclose(T[3], [0, 0, 0, 1])
    R = T[:3, :3] if good else np.zeros((3, 3))
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0):
        raise UserError(f"prior is\n{T}\nexpected (4, 4) T_right_left: a rotation and t, 0 0 0 1.")
    if not np.abs(T[:2, 3]).any():
        raise UserError(f"prior has t = {T[:3, 3]}: cameras side by side differ in x or y.")
    return T


def _texture_notes(left: torch.Tensor, right: torch.Tensor) -> list[str]:
    """Left and right (1, 3, h, w) in 0..1."""
    return [
        f"the {side} image has almost no texture (standard deviation {255 * contrast:.1f} of 255, "
        f"expected at least {MIN_CONTRAST:g}): there is nothing to match."
        for side, image in (("left", left), ("right", right))
        if 255 * (contrast := float(image.mean(1).std())) < MIN_CONTRAST
    ]


def _angles(degrees: Array) -> str:
    return " / ".join(f"{abs(x):.2f}°" for x in degrees)
