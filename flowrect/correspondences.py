"""Exact ground truth of a pair, carried as rays: no resizing or averaging ever touches it.

A correspondence joins the centre of a *native* left pixel to the exact end point of its flow. As
rays of the two camera frames the pair of points belongs to no resolution: any K projects it to
any image size, and a rotation of a camera (a homography of its image) only rotates its rays.

The fields are NumPy arrays (N, …) when made, and torch tensors (B, N, …) in a batch; every method
but ``collate`` and ``to`` works on either. This module imports torch only where it is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simgen.geometry import Array as Float64
from simgen.geometry import inverse
from simgen.schema import OUT_OF_FRAME, VISIBLE
from simgen.shards import Frame

if TYPE_CHECKING:
    import torch

    Array = NDArray[Any] | torch.Tensor


@dataclass(frozen=True)
class Correspondences:
    """Matching rays of a pair; leading dimensions as the rays have them."""

    rays_left: Any
    """(…, N, 3) float64 in the left camera frame, z = 1: K⁻¹ (u, v, 1)ᵀ"""
    rays_right: Any
    """(…, N, 3) float64 in the right camera frame, z = 1; (0, 0, −1) if the point is behind it"""
    visible: Any
    """(…, N) bool: seen by both cameras"""
    in_frame: Any
    """(…, N) bool: both ends lie in the native images, occluded or not"""
    depth: Any
    """(…, N) float64, z in the left camera frame [m]; 0 at infinity"""

    def rotated(self, *, left: Array | None = None, right: Array | None = None) -> Correspondences:
        """The same points after the cameras turned: ``X_new = left X_left``, same for right.

        Args:
          left, right: (…, 3, 3), of the kind of the fields (NumPy or torch). The pose of the
            turned pair is ``geometry.rotated``'s. ``in_frame`` still speaks of the native images.
        """
        rays_left, rays_right, depth = self.rays_left, self.rays_right, self.depth
        if left is not None:
            turned = _turn(rays_left, left)
            rays_left, depth = _unit_z(turned), depth * turned[..., 2]
        if right is not None:
            rays_right = _unit_z(_turn(rays_right, right))
        return Correspondences(rays_left, rays_right, self.visible, self.in_frame, depth)

    def swapped(self, R: Array, t: Array) -> Correspondences:
        """The same points with the cameras' roles exchanged; R (…, 3, 3), t (…, 3) as before it.

        The points stay those that the old left camera sees: the new left pixels are no grid.
        """
        z_right = self.depth * _turn(self.rays_left, R)[..., 2] + t[..., None, 2]
        depth = z_right * (self.depth != 0)
        return Correspondences(self.rays_right, self.rays_left, self.visible, self.in_frame, depth)

    def mirrored(self) -> Correspondences:
        """The same points in mirrored images: x of every ray changes its sign.

        After ``swapped`` this is the truth of ``geometry.mirrored_swap``'s pose.
        """
        return replace(self, rays_left=_mirror(self.rays_left), rays_right=_mirror(self.rays_right))

    def subset(self, index: Any) -> Correspondences:
        """The correspondences ``index`` (integers or booleans) along N."""
        return Correspondences(
            self.rays_left[..., index, :],
            self.rays_right[..., index, :],
            self.visible[..., index],
            self.in_frame[..., index],
            self.depth[..., index],
        )

    def to(self, device: torch.device | str) -> Correspondences:
        """Tensors on ``device``, made from arrays where need be; no batch dimension is added."""
        import torch

        values = {name: getattr(self, name) for name in _NAMES}
        return Correspondences(**{k: torch.as_tensor(x, device=device) for k, x in values.items()})


_NAMES = tuple(f.name for f in fields(Correspondences))


def collate(items: Sequence[Correspondences]) -> Correspondences:
    """Stacks single pairs (N, …) of equal N to tensors (B, N, …); a pair alone is not copied."""
    import torch

    sizes = {len(item.depth) for item in items}
    if len(sizes) != 1:
        raise ValueError(
            f"collate: pairs have {sorted(sizes)} correspondences, expected one number for all; "
            "take the same num for each."
        )
    of = {n: [torch.as_tensor(getattr(c, n)) for c in items] for n in _NAMES}
    return Correspondences(
        **{n: torch.stack(x) if len(x) > 1 else x[0][None] for n, x in of.items()}
    )


def from_frame(frame: Frame, pair: int, *, num: int | None = None) -> Correspondences:
    """Ground truth of one pair of a shard's frame, see ``from_depth``."""
    left, right = frame.pairs[pair]
    K, T = frame.read("K"), frame.read("T_world_cam")
    return from_depth(
        frame.read("depth", left),
        frame.read("flow_status", pair),
        K[left],
        inverse(T[right]) @ T[left],
        num=num,
    )


def from_depth(
    depth: NDArray[np.float32],
    flow_status: NDArray[np.uint8],
    K_left: Float64,
    T_right_left: Float64,
    *,
    num: int | None = None,
) -> Correspondences:
    """Correspondences (N, …) of a regular sub-grid of the left pixels, in float64 from depth.

    The same points as ``from_flow`` finds, without its rounding to float32 and without decoding
    the flow. Arguments as there; T_right_left (4, 4).
    """
    rows, columns = _sub_grid(depth.shape, num)
    z = depth[rows, columns].astype(np.float64)
    status = flow_status[rows, columns].reshape(-1)
    to_left = np.linalg.inv(K_left)
    rays_left = _map_of_grid(to_left, depth.shape, rows, columns)
    towards = _map_of_grid(T_right_left[:3, :3] @ to_left, depth.shape, rows, columns)
    inverse_z = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
    for coordinate, t in zip(towards, T_right_left[:3, 3], strict=True):
        coordinate += inverse_z * t
    towards[:, towards[2] <= 0] = [[0.0], [0.0], [-1.0]]
    towards /= abs(towards[2])
    return Correspondences(
        rays_left=rays_left.reshape(3, -1).T,
        rays_right=towards.reshape(3, -1).T,
        visible=(status & VISIBLE) != 0,
        in_frame=(status & OUT_OF_FRAME) == 0,
        depth=z.reshape(-1),
    )


def from_flow(
    flow: NDArray[np.float32],
    flow_status: NDArray[np.uint8],
    depth: NDArray[np.float32],
    K_left: Float64,
    K_right: Float64,
    *,
    num: int | None = None,
) -> Correspondences:
    """Correspondences (N, …) of a regular sub-grid of the left pixels.

    Args:
      flow: (H, W, 2) left to right [px], exact also where occluded, out of frame, or at infinity.
      flow_status: (H, W) bits of simgen.schema.
      depth: (H, W) z in the left camera [m], 0 at infinity.
      K_left, K_right: (3, 3) [px] of the native images, as large as ``flow``.
      num: about how many to keep, the same number for images of the same size; None: all pixels.
    """
    rows, columns = _sub_grid(flow.shape[:2], num)
    uv_left = _pixels(flow.shape[:2], rows, columns)
    moved = flow[rows, columns].reshape(-1, 2).astype(np.float64)
    status = flow_status[rows, columns].reshape(-1)
    out_of_frame = (status & OUT_OF_FRAME) != 0
    rays_right = _rays(K_right, uv_left + moved)
    # Flow is stored as 0 behind the right camera; elsewhere a flow of 0 ends in the frame.
    rays_right[out_of_frame & (moved == 0).all(-1)] = (0.0, 0.0, -1.0)
    return Correspondences(
        rays_left=_rays(K_left, uv_left),
        rays_right=rays_right,
        visible=(status & VISIBLE) != 0,
        in_frame=~out_of_frame,
        depth=depth[rows, columns].reshape(-1).astype(np.float64),
    )


def _sub_grid(hw: tuple[int, ...], num: int | None) -> tuple[slice, slice]:
    """Slices of a square grid with about ``num`` nodes, centred in the image."""
    h, w = hw
    step = 1 if num is None else max(1, round((h * w / num) ** 0.5))
    return slice((h - 1) % step // 2, None, step), slice((w - 1) % step // 2, None, step)


def _pixels(hw: tuple[int, ...], rows: slice, columns: slice) -> Float64:
    """Pixel centres (N, 2) of the sub-grid as (u, v), row by row."""
    u, v = np.meshgrid(np.arange(hw[1])[columns], np.arange(hw[0])[rows])
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)


def _map_of_grid(A: NDArray[Any], hw: tuple[int, ...], rows: slice, columns: slice) -> Float64:
    """A (u, v, 1)ᵀ (3, h, w) of the pixel centres of the sub-grid, for A (3, 3).

    By outer sums: a matrix product of all pixels takes from_depth twice the time.
    """
    of_u, of_v, constant = A.T[..., None, None]
    u, v = np.arange(hw[1])[columns], np.arange(hw[0])[rows]
    mapped: Float64 = of_u * u + (of_v * v[:, None] + constant)
    return mapped


def _rays(K: Float64, uv: Float64) -> Float64:
    return np.concatenate([uv, np.ones_like(uv[:, :1])], axis=1) @ np.linalg.inv(K).T


def _turn(rays: Any, R: Any) -> Any:
    return rays @ R.swapaxes(-1, -2)


def _unit_z(rays: Any) -> Any:
    return rays / abs(rays[..., 2:])


def _mirror(rays: Any) -> Any:
    rays = rays * 1  # a copy, of either kind
    rays[..., 0] *= -1
    return rays
