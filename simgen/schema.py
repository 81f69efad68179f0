"""The fields of a shard, their shapes and types: schema 1. CONVENTIONS.md explains each.

Symbols in shapes: n frames, C cameras, P pairs, H × W pixels. Imports neither Mitsuba nor h5py.
"""

from __future__ import annotations

from dataclasses import dataclass

SCHEMA_VERSION = 1

# flow_status: exactly one of the first three, plus the surface bits.
VISIBLE, OCCLUDED, OUT_OF_FRAME = 1, 2, 4
AT_INFINITY, GLASS = 8, 16


@dataclass(frozen=True)
class Field:
    """One dataset of a shard."""

    name: str
    shape: tuple[str | int, ...]
    """per frame; letters are the symbols above"""
    dtype: str
    """NumPy type, or "json" for utf-8 text"""
    meaning: str

    def resolved(self, sizes: dict[str, int]) -> tuple[int, ...]:
        """The shape of one frame with numbers for the symbols, e.g. {"C": 3, "H": 1440, …}."""
        return tuple(s if isinstance(s, int) else sizes[s] for s in self.shape)


FIELDS: dict[str, Field] = {
    f.name: f
    for f in (
        Field("image", ("C", "H", "W", 3), "uint8", "display-referred RGB"),
        Field("depth", ("C", "H", "W"), "float32", "z in the camera frame [m], 0 = no surface"),
        Field("semantic", ("C", "H", "W"), "uint8", "Cityscapes label id"),
        Field("instance", ("C", "H", "W"), "uint16", "0 = none; same id in all cameras"),
        Field("flow", ("P", "H", "W", 2), "float32", "left to right (du, dv) [px]"),
        Field("flow_status", ("P", "H", "W"), "uint8", "left pixels: visibility and surface bits"),
        Field("flow_status_reverse", ("P", "H", "W"), "uint8", "the same for the right pixels"),
        Field("K", ("C", 3, 3), "float64", "intrinsics [px], pixel-centre convention"),
        Field("T_world_cam", ("C", 4, 4), "float64", "true pose, camera to world"),
        Field("T_world_cam_nominal", ("C", 4, 4), "float64", "pose before the drawn rotation"),
        Field("perturbation_deg", ("C", 3), "float64", "drawn rotation vector, nominal axes"),
        Field("frame_index", (), "int64", "i of the frame in the set"),
        Field("scene_index", (), "int64", "frames of one scene share it"),
        Field("spec", (), "json", "everything needed to render the frame again"),
    )
}
PER_PIXEL = ("image", "depth", "semantic", "instance", "flow", "flow_status", "flow_status_reverse")

# Cityscapes label ids (https://github.com/mcordts/cityscapesScripts, helpers/labels.py).
LABELS: dict[str, int] = {
    "unlabeled": 0, "static": 4, "dynamic": 5, "ground": 6, "road": 7, "sidewalk": 8,
    "parking": 9, "rail track": 10, "building": 11, "wall": 12, "fence": 13, "guard rail": 14,
    "bridge": 15, "tunnel": 16, "pole": 17, "polegroup": 18, "traffic light": 19,
    "traffic sign": 20, "vegetation": 21, "terrain": 22, "sky": 23, "person": 24, "rider": 25,
    "car": 26, "truck": 27, "bus": 28, "caravan": 29, "trailer": 30, "train": 31,
    "motorcycle": 32, "bicycle": 33,
}  # fmt: skip
LABEL_COLORS: dict[int, tuple[int, int, int]] = {
    0: (0, 0, 0), 4: (0, 0, 0), 5: (111, 74, 0), 6: (81, 0, 81), 7: (128, 64, 128),
    8: (244, 35, 232), 9: (250, 170, 160), 10: (230, 150, 140), 11: (70, 70, 70),
    12: (102, 102, 156), 13: (190, 153, 153), 14: (180, 165, 180), 15: (150, 100, 100),
    16: (150, 120, 90), 17: (153, 153, 153), 18: (153, 153, 153), 19: (250, 170, 30),
    20: (220, 220, 0), 21: (107, 142, 35), 22: (152, 251, 152), 23: (70, 130, 180),
    24: (220, 20, 60), 25: (255, 0, 0), 26: (0, 0, 142), 27: (0, 0, 70), 28: (0, 60, 100),
    29: (0, 0, 90), 30: (0, 0, 110), 31: (0, 80, 100), 32: (0, 0, 230), 33: (119, 11, 32),
}  # fmt: skip
