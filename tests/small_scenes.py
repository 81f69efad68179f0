"""Scenes of few hand-made triangles, cameras anywhere, and float64 ray casting as the oracle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from simgen.materials import MATERIALS
from simgen.mesh import Faces, Part, Vertices, part
from simgen.rig import Camera
from simgen.scene import GroundRing, Scene, World, load
from simgen.schema import LABELS
from simgen.sheets import Sheet

R_WORLD_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Camera to world of a camera that looks along world x, with world z up."""
GREY = np.full((64, 64, 3), 128, np.uint8)


def scene_of(
    parts: Sequence[Part],
    ground: Sequence[Part] = (),
    *,
    roughness: NDArray[np.uint8] | None = None,
) -> Scene:
    """The parts under a uniform sky; the ground shines if it has a map of ``roughness``."""
    metres = [name for name, m in MATERIALS.items() if m.color_by == "metres"]
    world = World(
        parts=list(parts),
        ground=[GroundRing([p], GREY, roughness) for p in ground],
        sheets={name: Sheet(GREY, 1.0) for name in metres},
        sign_atlas=GREY,
        sky=np.ones((16, 32, 3), np.float32),
    )
    return load(world, num_lamps=0)


def camera(
    centre: ArrayLike = (0.0, 0.0, 0.0),
    turn_deg: ArrayLike = (0.0, 0.0, 0.0),
    *,
    wh: tuple[int, int] = (96, 64),
    f_px: float = 48.0,
    off_centre_px: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """A camera that looks along world x but for a rotation vector in its own axes."""
    T = np.eye(4)
    T[:3, :3] = R_WORLD_FORWARD @ Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T[:3, 3] = centre
    cx, cy = (wh[0] - 1) / 2 + off_centre_px[0], (wh[1] - 1) / 2 + off_centre_px[1]
    return Camera(np.array([[f_px, 0, cx], [0, f_px, cy], [0, 0, 1.0]]), T, wh)


def parallelogram(
    corner: ArrayLike,
    edge_a: ArrayLike,
    edge_b: ArrayLike,
    *,
    label: str = "wall",
    material: str = "matte",
    color: ArrayLike = (0.5, 0.5, 0.5),
) -> Part:
    """Two triangles."""
    corner, a, b = (np.asarray(x, dtype=np.float64) for x in (corner, edge_a, edge_b))
    vertices = np.stack([corner, corner + a, corner + a + b, corner + b])
    return part(vertices, [[0, 1, 2], [0, 2, 3]], material, LABELS[label], color=color)


def sphere(radius: float, centre: ArrayLike, num: int) -> tuple[Vertices, Faces]:
    """A sphere of about 4·num² triangles, none of them degenerate."""
    polar = np.linspace(0, np.pi, num + 1)[1:-1]
    around = np.linspace(0, 2 * np.pi, 2 * num, endpoint=False)
    p, a = np.meshgrid(polar, around, indexing="ij")
    rings = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, 1.0], [0, 0, -1.0]]])
    i, j = np.meshgrid(np.arange(num - 2), np.arange(2 * num), indexing="ij")
    k = (j + 1) % (2 * num)
    upper = np.stack([i * 2 * num + j, (i + 1) * 2 * num + j, (i + 1) * 2 * num + k], axis=-1)
    lower = np.stack([i * 2 * num + j, (i + 1) * 2 * num + k, i * 2 * num + k], axis=-1)
    j, k, last = j[0], k[0], (num - 2) * 2 * num
    top = np.stack([np.full_like(j, len(vertices) - 2), j, k], axis=-1)
    bottom = np.stack([np.full_like(j, len(vertices) - 1), last + k, last + j], axis=-1)
    faces = np.concatenate([f.reshape(-1, 3) for f in (upper, lower, top, bottom)])
    return radius * vertices + np.asarray(centre), faces


# --- the oracle -------------------------------------------------------------------------------


def pixel_rays(cam: Camera, shift_px: ArrayLike = (0.0, 0.0)) -> np.ndarray:
    """World directions (H·W, 3) of z-depth 1 through the pixel centres."""
    w, h = cam.wh
    v, u = np.mgrid[:h, :w].astype(np.float64)
    x = (u + shift_px[0] - cam.K[0, 2]) / cam.K[0, 0]
    y = (v + shift_px[1] - cam.K[1, 2]) / cam.K[1, 1]
    R = cam.T_world_cam[:3, :3]
    return (x[..., None] * R[:, 0] + y[..., None] * R[:, 1] + R[:, 2]).reshape(-1, 3)


def seen_at(cam: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (N, 2) and z-depths (N,) of world points."""
    p = (points - cam.T_world_cam[:3, 3]) @ cam.T_world_cam[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = cam.K[0, 0] * p[:, 0] / p[:, 2] + cam.K[0, 2]
        v = cam.K[1, 1] * p[:, 1] / p[:, 2] + cam.K[1, 2]
    return np.stack([u, v], axis=1), p[:, 2]


def inside_frame(cam: Camera, uv: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether points have an image: in front, and from −½ to W − ½ (H − ½)."""
    w, h = cam.wh
    u, v = uv.T
    return (z > 0) & (u >= -0.5) & (u < w - 0.5) & (v >= -0.5) & (v < h - 0.5)


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles as the renderer holds them (float32), intersected in float64."""

    corners: np.ndarray
    """(F, 3, 3)"""

    @classmethod
    def of(cls, vertices: Vertices, faces: Faces) -> Triangles:
        """From a mesh."""
        return cls(vertices.astype(np.float32).astype(np.float64)[faces])

    def crossings(self, origin: ArrayLike, directions: np.ndarray) -> np.ndarray:
        """Ray parameters (N, F), infinite where a ray misses (Möller and Trumbore, 1997)."""
        a, b, c = self.corners.swapaxes(0, 1)
        ab, ac, s = b - a, c - a, np.asarray(origin, dtype=np.float64) - a
        p = np.cross(directions[:, None], ac)
        q = np.cross(s, ab)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / np.einsum("nfk,fk->nf", p, ab)
            beta = np.einsum("nfk,fk->nf", p, s) * scale
            gamma = (directions @ q.T) * scale
            t = np.einsum("fk,fk->f", ac, q) * scale
            hit = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1) & (t > 0)
        return np.where(hit, t, np.inf)

    def first(self, origin: ArrayLike, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest ray parameter (N,), infinite where none, and its triangle (N,)."""
        blocks = np.array_split(directions, max(1, len(directions) * len(self.corners) // 10**6))
        t, face = [], []
        for block in blocks:
            crossing = self.crossings(origin, block)
            face.append(np.argmin(crossing, axis=1))
            t.append(crossing.min(axis=1))
        return np.concatenate(t), np.concatenate(face)
