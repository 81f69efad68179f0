"""The camera rig: a nominal layout from scenes/rigs/*.toml, and the cameras as they really are.

Rig frame: the vehicle's (x forward, y left, z up), origin on the ground below the middle of the
rig. Cameras stand on a bar across the vehicle, numbered from left to right, and nominally look
along +x. Each is then turned by a drawn rotation vector about its own centre (design: no
translation): ``T_world_cam = T_world_cam_nominal · [exp([a]×) | 0]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from simgen.geometry import (
    R_CAM_VEHICLE,
    Array,
    intrinsics,
    inverse,
    rotation_from_vector,
    transform,
)
from simgen.recipe import Interval, Table, draw, within

FRAME_STEP_M = 3.0
"""How far the rig drives between two frames of a scene."""


def drive_length(num_frames: int) -> float:
    """From the first frame of a scene to the last [m]."""
    return FRAME_STEP_M * (num_frames - 1)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole in the world."""

    K: Array
    """(3, 3) [px], pixel-centre convention"""
    T_world_cam: Array
    """(4, 4)"""
    wh: tuple[int, int]

    @property
    def T_cam_world(self) -> Array:
        """(4, 4)"""
        return inverse(self.T_world_cam)

    @property
    def centre(self) -> Array:
        """(3,) in the world [m]"""
        return self.T_world_cam[:3, 3]


class Rig(Table):
    """A nominal rig, as scenes/rigs/*.toml states it."""

    intent: str
    camera_y_m: Annotated[
        list[Annotated[float, Field(ge=-10, le=10)]], Field(min_length=2, max_length=16)
    ]
    """positions across the vehicle, left is positive, from left to right"""
    height_m: Annotated[Interval, within(0.3, 6.0)]
    """drawn per frame: height of the bar over the ground"""
    pairs: Annotated[list[tuple[int, int]], Field(min_length=1)]
    """camera indices (left, right)"""
    size: tuple[Annotated[int, Field(ge=16)], Annotated[int, Field(ge=16)]]
    """native image size (width, height) [px]"""
    hfov_deg: Annotated[float, Field(ge=10.0, le=140.0)]
    """horizontal field of view"""
    perturbation_deg: Annotated[float, Field(ge=0.0, le=10.0)]
    """each component of a camera's rotation vector is uniform within ± this"""
    vehicle: Annotated[str, Field(pattern="^(car|truck)$")]
    """what carries the rig; a note for readers of the set"""

    @model_validator(mode="after")
    def _check_layout(self) -> Rig:
        num = len(self.camera_y_m)
        if any(b >= a for a, b in zip(self.camera_y_m, self.camera_y_m[1:], strict=False)):
            raise ValueError("camera_y_m must fall from left (+) to right (−), no two equal")
        if len(set(self.pairs)) != len(self.pairs):
            raise ValueError("pairs names the same pair twice")
        for left, right in self.pairs:
            if not 0 <= left < right < num:
                raise ValueError(
                    f"pairs holds [{left}, {right}]; expected left < right, both in 0…{num - 1}"
                )
        return self


@dataclass(frozen=True, eq=False)
class PosedRig:
    """A rig in the world: what was drawn for one frame."""

    cameras: list[Camera]
    """true cameras"""
    T_world_cam_nominal: Array
    """(C, 4, 4)"""
    perturbation_deg: Array
    """(C, 3) rotation vectors in the axes of the nominal cameras"""
    height_m: float


def pose(
    rig: Rig, T_world_vehicle: Array, wh: tuple[int, int], *, rng: np.random.Generator
) -> PosedRig:
    """Draws height and rotations, and puts the rig into the world at image size ``wh``."""
    height_m = draw(rig.height_m, rng=rng)
    limit = rig.perturbation_deg
    perturbation_deg = rng.uniform(-limit, limit, size=(len(rig.camera_y_m), 3))
    nominal = nominal_poses(rig, T_world_vehicle, height_m)
    K = intrinsics(wh, rig.hfov_deg)
    true = perturbed(nominal, perturbation_deg)
    return PosedRig([Camera(K, T, wh) for T in true], nominal, perturbation_deg, height_m)


def nominal_poses(rig: Rig, T_world_vehicle: Array, height_m: float) -> Array:
    """``T_world_cam_nominal`` (C, 4, 4)."""
    R_vehicle_cam = R_CAM_VEHICLE.T
    return np.stack(
        [
            T_world_vehicle @ transform(R_vehicle_cam, np.array([0.0, y, height_m]))
            for y in rig.camera_y_m
        ]
    )


def perturbed(T_world_cam_nominal: Array, perturbation_deg: NDArray[np.float64]) -> Array:
    """True poses (C, 4, 4) from nominal ones and rotation vectors (C, 3) in degrees."""
    turned = [transform(rotation_from_vector(np.deg2rad(a)), np.zeros(3)) for a in perturbation_deg]
    return T_world_cam_nominal @ np.stack(turned)
