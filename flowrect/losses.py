"""What training minimises: rotation, vertical flow, and the matches themselves.

Vertical flow is ``v_right − v_left`` [px] of a rectified pair; of a vertical rig it is
``u_right − u_left`` (paper, remark after Eq. 16). All losses are finite scalars.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flowrect.correspondences import Correspondences
from flowrect.drectify import Rectification, rectified_uv
from flowrect.geometry import inside, pixel_grid, project, unproject


def rotation_loss(R_gt: Tensor, R: Tensor, *, weight: float = 10.0) -> Tensor:
    """Weighted mean over pairs of the entry-wise *sum* ‖R_gt − R‖₁; (B, 3, 3) each.

    The sum, not the mean: only so do the paper's weights balance the two losses (about .35 and .8
    per degree of pitch). Source: paper, Eq. 15 and 17.
    """
    return weight * (R_gt - R).abs().sum((-2, -1)).mean()


def rectified_vertical_flow(
    rect: Rectification, truth: Correspondences, wh: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Exact vertical flow (B, N) [px], and where both ends lie in the rectified frames (B, N).

    The flow is 0 elsewhere. ``wh`` is the size of the rectified images that ``rect.K_new`` means.
    """
    uv_left = rectified_uv(truth.rays_left, rect.R_left, rect.K_new)
    uv_right = rectified_uv(truth.rays_right, rect.R_right, rect.K_new)
    counted = inside(uv_left, wh) & inside(uv_right, wh)
    across = across_epipolar_lines(uv_right - uv_left, rect.vertical)
    return torch.where(counted, across, 0.0), counted


def across_epipolar_lines(flow: Tensor, vertical: Tensor) -> Tensor:
    """The component of flow (B, …, 2) that rectification should bring to 0: dv, or du (B, …)."""
    vertical = vertical.reshape(-1, *(1,) * (flow.dim() - 2))
    return torch.where(vertical, flow[..., 0], flow[..., 1])


def vertical_flow_loss(
    rect: Rectification,
    truth: Correspondences,
    K_left: Tensor,
    K_right: Tensor,
    wh: tuple[int, int],
    *,
    weight: float = 0.1,
) -> Tensor:
    """Weighted mean |vertical flow| [px] over all correspondences that the rectified images show.

    Their ends lie in the rectified frames and in the source images, which may be windows of what
    the correspondences were taken from: elsewhere a rectified image has only a black border. 0 if
    an estimate is so far off that none is left. Source: paper, Eq. 16, with exact flow.

    Args:
      K_left, K_right: (B, 3, 3) [px] of the source images.
      wh: size of the source images, and of the rectified ones.
    """
    flow, counted = rectified_vertical_flow(rect, truth, wh)
    uv_left, uv_right = project(K_left, truth.rays_left), project(K_right, truth.rays_right)
    shown = inside(uv_left, wh) & inside(uv_right, wh)
    return weight * _masked_mean(flow.abs(), counted & shown)


def image_flow_loss(
    flow: Tensor, valid: Tensor, vertical: Tensor, *, weight: float = 0.1
) -> Tensor:
    """Weighted mean |vertical flow| [px] of what a flow network sees between rectified images.

    Args:
      flow: (B, 2, H, W) left to right [px] as (du, dv).
      valid: (B, 1, H, W): both images have content here. The paper has no such mask.
      vertical: (B,) bool, of the rectification.
    """
    across = across_epipolar_lines(flow.permute(0, 2, 3, 1), vertical)
    return weight * _masked_mean(across.abs(), valid[:, 0])


@torch.no_grad()
def correspondences_of_flow(flow: Tensor, rect: Rectification) -> Correspondences:
    """What a flow network matches between rectified images, at every left pixel, as rays.

    As such it stays the same if the rectification changes, so that the gradient of its
    ``vertical_flow_loss`` is that of the geometry alone. The value is the one of
    ``image_flow_loss``, but for what counts: matches whose ends both images show, instead of
    pixels that both fill.

    Args:
      flow: (B, 2, H, W) left to right [px] between images that ``rect`` made.
    """
    h, w = flow.shape[-2:]
    uv = pixel_grid((w, h), dtype=rect.K_new.dtype, device=flow.device)
    ends = uv + flow.flatten(2).mT
    rays_left = unproject(rect.K_new, uv.expand_as(ends)) @ rect.R_left
    rays_right = unproject(rect.K_new, ends) @ rect.R_right
    seen = torch.ones_like(ends[..., 0], dtype=torch.bool)
    unknown = torch.full_like(ends[..., 0], torch.nan)
    return Correspondences(rays_left, rays_right, seen, seen, unknown)


def matching_loss(
    log_matches: Tensor, truth: Correspondences, rect: Rectification, wh: tuple[int, int]
) -> Tensor:
    """Cross-entropy of the match distribution against exact flow [nats]; 0 if nothing is visible.

    Args:
      log_matches: (B, h·w, h·w): for each left feature, row by row, the log-probability of each
        right feature.
      truth: only what is visible in both images is used.
      rect: the rectification that the features have been warped by, with K_new [features].
      wh: (w, h) of the feature maps.
    """
    uv_left = rectified_uv(truth.rays_left, rect.R_left, rect.K_new)
    uv_right = rectified_uv(truth.rays_right, rect.R_right, rect.K_new)
    return match_cross_entropy(log_matches, uv_left, uv_right, truth.visible, wh)


def match_cross_entropy(
    log_matches: Tensor, uv_left: Tensor, uv_right: Tensor, visible: Tensor, wh: tuple[int, int]
) -> Tensor:
    """Mean cross-entropy [nats] of matches against where they should lie; 0 if none is visible.

    The flow of a correspondence is taken to hold at the feature next to its left end. The right end
    falls between four features, which share it by their bilinear weights.

    Args:
      log_matches: (B, h·w, h·w), see ``matching_loss``.
      uv_left, uv_right: (B, N, 2) ends of correspondences [features].
      visible: (B, N) bool: in both images.
      wh: (w, h) of the feature maps.
    """
    counted = visible & inside(uv_left, wh)
    cell = torch.where(counted[..., None], uv_left, 0.0).round()
    target = cell + uv_right - uv_left
    limit = target.new_tensor(wh) - 1
    counted = counted & ((target >= 0) & (target <= limit)).all(-1)
    target = torch.where(counted[..., None], target, 0.0).detach()
    log_likelihood = _bilinear_log_likelihood(log_matches, cell.long(), target, wh)
    return -_masked_mean(log_likelihood, counted)


def _bilinear_log_likelihood(
    log_matches: Tensor, cell: Tensor, target: Tensor, wh: tuple[int, int]
) -> Tensor:
    """Σ bilinear weight · log-probability (B, N) of the four right features around ``target``."""
    w, h = wh
    batch = torch.arange(len(cell), device=cell.device)[:, None]
    row = cell[..., 1] * w + cell[..., 0]
    low = target.floor()
    total = torch.zeros_like(target[..., 0])
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        node = low + low.new_tensor(corner)
        weight = (1 - (target - node).abs()).prod(-1)
        u, v = node.long().unbind(-1)
        column = v.clamp(max=h - 1) * w + u.clamp(max=w - 1)  # beyond the last: weight 0
        total = total + weight * log_matches[batch, row, column]
    return total


def _masked_mean(values: Tensor, counted: Tensor) -> Tensor:
    return torch.where(counted, values, 0.0).sum() / counted.sum().clamp(min=1)
