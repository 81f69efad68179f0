"""Material names, and how each is coloured and reflects; scene.py makes them Mitsuba BSDFs.

Every scene holds exactly these materials, each on one merged mesh, whether or not it is used:
the renderer compiles one kernel per *structure*, so a constant structure compiles once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Material:
    """How a surface is coloured and how it reflects."""

    color_by: Literal["vertex", "metres", "atlas", "ground"]
    """vertex: Part.color; metres: Part.uv on a repeating sheet; atlas: Part.uv in [0, 1]²;
    ground: the ortho maps of ground.py"""
    reflects: Literal["diffuse", "paint", "glass", "metal"] = "diffuse"
    curved: bool = False
    """whether Part.normals count"""


FAR_SHEET_M = 60.0
"""A part that the rig comes no nearer than this takes the filtered copy of its sheet [m]."""
FAR_SHEET_FACTOR = 4

MATERIALS: dict[str, Material] = {
    "ground": Material("ground"),
    "wall_0": Material("metres"),  # four wall sheets of the scene: brick, plaster, concrete, stone
    "wall_1": Material("metres"),
    "wall_2": Material("metres"),
    "wall_3": Material("metres"),
    "roof": Material("metres"),
    "bark": Material("metres"),
    "turf": Material("metres", curved=True),  # rough grass on banks of earth
    "matte": Material("vertex", curved=True),
    "leaf": Material("vertex"),
    "paint": Material("vertex", "paint", curved=True),
    "metal": Material("vertex", "metal", curved=True),
    "glass": Material(
        "vertex", "glass", curved=True
    ),  # opaque and mirror-like; flagged in flow_status
    "sign": Material("atlas"),
    "lamp": Material("vertex", curved=True),  # emits at night
}
