"""The arithmetic of the benchmarks, on what is known in closed form."""

from __future__ import annotations

import flow_metric
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_network import road_set

from flowrect.correspondences import Correspondences
from flowrect.geometry import pixel_grid, project, unproject
from flowrect.loading import Loading, PairLoader
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing
from flowrect.sample import Batch
from flowrect.sources import open_source
from flowrect.train_flow import Views, error_sizes

WH = (48, 32)


# --- flow_metric: points at infinity, whose flow is a homography ---------------------------------


def views_at_infinity(vertical: bool) -> tuple[Views, torch.Tensor]:
    """Two turned cameras that see the sky, and the exact flow (1, 2, H, W) of every left pixel.

    Half of the pixels are occluded. Valid is a window inside which all flow ends in the image.
    """
    w, h = WH
    K = torch.tensor([[[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]], dtype=torch.float64)
    R = torch.from_numpy(
        Rotation.from_rotvec([2.0, -3.0, 4.0], degrees=True).as_matrix()
    )[None]  # fmt: skip
    uv = pixel_grid(WH, dtype=torch.float64, device="cpu")[None]
    rays = unproject(K, uv)
    towards = rays @ R.mT
    occluded = torch.arange(w * h) % w < w // 2
    truth = Correspondences(
        rays, towards / towards[..., 2:], ~occluded[None], ~occluded[None], torch.zeros(1, w * h)
    )
    flow = (project(K, towards) - uv).mT.unflatten(-1, (h, w))
    valid = torch.zeros(1, 1, h, w, dtype=torch.bool)
    valid[..., 6:-6, 6:-6] = True
    image = torch.zeros(1, 3, h, w)
    batch = Batch(image, image, K, K, image, image, K, K, None, None, R, R[..., 0], truth, [""])
    return Views(batch, valid, torch.tensor([vertical])), flow.float()


@pytest.mark.parametrize("vertical", [False, True])
def test_exact_flow_has_no_error_and_the_exact_vertical_flow(vertical):
    seen, flow = views_at_infinity(vertical)
    by_network, exact = flow_metric.vertical_flows(flow, seen)[0].tolist()
    inner = flow[0, 0 if vertical else 1, 6:-6, 6:-6]
    expected = inner.abs().mean().item()
    assert by_network == pytest.approx(expected, rel=1e-5)
    assert exact == pytest.approx(expected, rel=1e-5)  # occluded pixels count, too
    assert error_sizes(flow, seen).max() < 1e-4


def test_pixels_that_one_image_lacks_have_no_say():
    seen, flow = views_at_infinity(False)
    expected = flow_metric.vertical_flows(flow, seen)
    outside = torch.where(seen.valid, flow, 99.0)
    torch.testing.assert_close(flow_metric.vertical_flows(outside, seen), expected)


class Still:
    """A network that sees no motion."""

    def flow(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(left[:, :2])


def test_the_vertical_error_of_seeing_nothing_is_the_vertical_flow(tmp_path):
    pairs = open_source(road_set(tmp_path, 2), split="train", truth_points=None)
    loader = PairLoader(pairs, Sizing(METRIC_WH), None, Loading(1, 0, shuffle=False))
    rows = {row[0]: np.array(row[1:7]) for row in flow_metric.measured(Still(), loader)}
    assert rows["rectified by the truth"][2:] == pytest.approx(0, abs=1e-6)
    unrectified, wrong = rows["as they stand"], rows["rectified, up to 1° off"]
    assert wrong[4] == unrectified[4] == 0  # by the network
    assert 0.5 < wrong[5] < 12
    # over what both cameras see, against all: of the same size
    assert unrectified[2] == pytest.approx(unrectified[5], rel=0.3)
