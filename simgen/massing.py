"""What a building is before it has any detail: its block, and what its kind implies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simgen.roofs import RoofForm

Array = NDArray[np.float64]
Range = tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """What buildings of one kind have in common: ranges that a style is drawn from."""

    storey_m: float
    """height that the storeys come close to"""
    pitch_m: Range
    """width of a bay"""
    window_share: Range
    """window width over bay width"""
    window_height_m: Range
    sill_m: Range
    """height of the sill above its floor"""
    ground: Literal["door", "shop", "gate"] = "door"
    """what the ground floor opens with"""
    ground_m: float = 0.0
    """height of the ground floor where it differs from the others, else 0"""
    side_share: float = 0.5
    """share of bays with windows on walls that do not face the street, nor away from it"""
    balcony_share: float = 0.0
    """chance that a bay of the front or the back has balconies"""
    garage_share: float = 0.0
    """chance of a garage in the ground floor"""
    door_m: tuple[float, float] = (1.0, 2.1)
    """width and height"""


KINDS: dict[str, Kind] = {
    "house": Kind(2.75, (2.9, 4.2), (0.34, 0.5), (1.1, 1.4), (0.85, 1.0), garage_share=0.4),
    "terrace": Kind(2.9, (2.0, 3.0), (0.4, 0.55), (1.4, 1.8), (0.6, 0.85), side_share=0.0),
    "apartments": Kind(2.95, (2.7, 3.7), (0.4, 0.6), (1.35, 1.7), (0.8, 0.95),
                       balcony_share=0.4, door_m=(1.7, 2.3)),
    "retail": Kind(3.1, (2.8, 4.0), (0.35, 0.6), (1.4, 1.9), (0.6, 0.9),
                   ground="shop", ground_m=3.9, side_share=0.3, door_m=(1.2, 2.4)),
    "commercial": Kind(3.7, (2.4, 3.8), (0.5, 0.88), (1.8, 2.3), (0.5, 0.9),
                       ground="shop", ground_m=4.2, side_share=0.8, door_m=(1.8, 2.5)),
    "office": Kind(3.6, (2.0, 3.6), (0.55, 0.94), (1.8, 2.5), (0.4, 0.9),
                   side_share=1.0, door_m=(2.4, 2.5)),
    "industrial": Kind(12.0, (4.5, 6.5), (0.5, 0.85), (0.8, 1.3), (3.3, 4.2), ground="gate"),
    "warehouse": Kind(12.0, (5.0, 7.5), (0.3, 0.6), (0.6, 1.0), (3.3, 4.2),
                      ground="gate", side_share=0.3),
    "shed": Kind(6.0, (2.5, 4.0), (0.25, 0.4), (0.6, 0.8), (1.2, 1.4), side_share=0.3),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Massing:
    """One block of a building before it has any detail."""

    footprint: Array
    """(N, 2) simple counter-clockwise ring in the world [m]"""
    base_z: float
    """height of the ground floor [m]"""
    wall_height: float
    """from the base to the eaves [m]"""
    roof: RoofForm
    roof_height: float
    """from the eaves to the ridge [m]"""
    ridge_rad: float
    """direction of the ridge, counter-clockwise from +x; a skillion roof rises this way"""
    kind: str
    """a key of KINDS"""
    front: int
    """wall i runs from vertex i to vertex i + 1; this one faces the street"""
    on_ground: bool = True
    """False for a part that stands on another one: no doors, no shops, no plinth"""

    def __post_init__(self) -> None:
        ring = np.asarray(self.footprint, dtype=np.float64)
        if ring.ndim != 2 or ring.shape[1:] != (2,) or len(ring) < 3:
            raise ValueError(f"Massing: footprint has shape {ring.shape}, expected (N >= 3, 2)")
        x, y = ring.T
        if (area := float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2) <= 0:
            raise ValueError(f"Massing: footprint has area {area:g} m², expected counter-clockwise")
        if self.kind not in KINDS:
            raise ValueError(f"Massing: kind {self.kind!r} is unknown; choose from {sorted(KINDS)}")
        if not 0 <= self.front < len(ring):
            raise ValueError(f"Massing: front is wall {self.front}, the footprint has {len(ring)}")
        object.__setattr__(self, "footprint", ring)
