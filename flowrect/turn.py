"""Turning a camera after the picture was taken: a homography, exact for every depth.

A camera that turns about its own centre sees the same rays: with ``X_new = G X_old`` a pixel moves
by ``H = K_new G K⁻¹``. So a rectified real pair can be given any rotation, and a rendered pair
a fresh one every time it is seen. What rotates *into* view was never recorded; a border left empty
would show the rotation to whoever looks at the border alone. Hence the window, which must lie
within the old image for every rotation that may be drawn, and does not depend on the one that is.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import cv2
import numpy as np

from flowrect.resize import Box, Sizing, resized, window_intrinsics
from flowrect.sample import Image, Pair
from simgen.errors import UserError
from simgen.geometry import Array, project, rotation_from_vector, transform

OVERSAMPLING = 2
"""where the image has the pixels, the warp interpolates on a grid so much finer than the result,
and an area filter reduces it: neither blurred nor aliased"""
_EDGE = 64  # pixels so small that the centre of the last one is the window's edge


def draw_turn(limit_deg: float, *, rng: np.random.Generator) -> Array:
    """A turn (3, 3): rotation vector with each component uniform in ± ``limit_deg``."""
    return rotation_from_vector(np.deg2rad(rng.uniform(-limit_deg, limit_deg, 3)))


def turned(pair: Pair, turn_left: Array, turn_right: Array, box: Box, wh: tuple[int, int]) -> Pair:
    """The pair as cameras with these turns see it, through a window.

    Args:
      turn_left, turn_right: (3, 3) ``R_nominal_cam`` of the result; they replace the pair's own.
      box: the window, in pixels of ``pair``; it keeps its place in the image, not in the world.
      wh: (width, height) [px] of the result.

    Raises UserError if the window would show a place that the old images do not.
    """
    G_left, G_right = turn_left.T @ pair.turn_left, turn_right.T @ pair.turn_right
    finer = min(OVERSAMPLING, max(1, round(box.width / wh[0])))
    fine = finer * wh[0], finer * wh[1]
    source = _reduced(pair, box, fine)
    K_left, K_right = (window_intrinsics(K, box, fine) for K in (pair.K_left, pair.K_right))
    warped = replace(
        pair,
        left=_warped(source.left, source.K_left, G_left, K_left, fine, pair.name),
        right=_warped(source.right, source.K_right, G_right, K_right, fine, pair.name),
        K_left=K_left,
        K_right=K_right,
        T_right_left=_turned_pose(pair.T_right_left, G_left, G_right),
        turn_left=turn_left,
        turn_right=turn_right,
        truth=pair.truth and pair.truth.rotated(left=G_left, right=G_right),
    )
    return resized(warped, wh)


def _turned_pose(T_right_left: Array | None, G_left: Array, G_right: Array) -> Array | None:
    if T_right_left is None:
        return None
    zero = np.zeros(3)
    return transform(G_right, zero) @ T_right_left @ transform(G_left.T, zero)


def _reduced(pair: Pair, box: Box, fine: tuple[int, int]) -> Pair:
    """The pair at about the resolution of the fine grid, where it has more."""
    w, h = pair.wh
    smaller = round(w * fine[0] / box.width), round(h * fine[1] / box.height)
    return resized(pair, (min(w, smaller[0]), min(h, smaller[1])))


def _warped(
    image: Image, K: Array, G: Array, K_new: Array, wh: tuple[int, int], name: str
) -> Image:
    if not _covers((image.shape[1], image.shape[0]), K, G, K_new, wh):
        angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(G) - 1) / 2, -1, 1)))
        raise UserError(
            f"{name}: turned by {angle_deg:.2f} deg, the window of {wh[0]}x{wh[1]} shows what the "
            "image does not: an empty border would give the rotation away. Draw smaller turns, or "
            "keep less of the image (flowrect.turn.largest_keep says how much)."
        )
    H_old_new = K @ G.T @ np.linalg.inv(K_new)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    # cv2 rounds coordinates to 1/32 px, so the last pixel may ask for a hair beyond the border.
    warped: Image = cv2.warpPerspective(
        image, H_old_new, wh, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return warped


def _covers(wh_old: tuple[int, int], K: Array, G: Array, K_new: Array, wh: tuple[int, int]) -> bool:
    """Whether all new pixel centres lie among the old ones: a rectangle's corners decide it."""
    corners = np.array([[u, v, 1.0] for u in (0, wh[0] - 1) for v in (0, wh[1] - 1)])
    rays = corners @ np.linalg.inv(K_new).T @ G
    if np.any(rays[:, 2] <= 0):
        return False
    uv = project(K, rays)
    return bool(np.all(uv >= 0) and np.all(uv <= np.array(wh_old) - 1))


def largest_keep(pair: Pair, sizing: Sizing, limit_deg: float) -> float:
    """The largest ``Sizing.keep``, in hundredths, whose window no rotation leaves empty.

    Args:
      pair: gives K and the size.
      sizing: gives the window's aspect.
      limit_deg: bound of each component of old and new turn *together*: twice the limit where
        both are drawn within it, once where a rectified pair is turned.
    """
    limit = np.deg2rad(limit_deg)
    limit += limit**2 / 4  # exp(a)ᵀ exp(b) = exp(b − a − ½ a×b + …), each entry of ½ a×b ≤ limit²/4
    extremes = [rotation_from_vector(limit * np.array(s)) for s in product((-1, 1), repeat=3)]
    for hundredths in range(100, 0, -1):
        keep = hundredths / 100
        box = replace(sizing, keep=keep).box(pair.wh)
        wh = box.width * _EDGE, box.height * _EDGE
        cameras = [(K, window_intrinsics(K, box, wh)) for K in (pair.K_left, pair.K_right)]
        if all(_covers(pair.wh, K, G, K_new, wh) for K, K_new in cameras for G in extremes):
            return keep
    raise UserError(f"{pair.name}: turns of {limit_deg:g} deg leave nothing of the image in view.")
