"""HITNet: its pieces against loops and planes, its losses against closed forms, its training."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from planes import along_x, planar_pair, plane_pair, turned
from safetensors.torch import load_file, save_file
from test_train import interrupt_after
from tiny_network import road_set

from flowrect import train_depth
from flowrect.augment import Augmentation
from flowrect.config import DepthOptions, HitnetConfig, HitnetLoss
from flowrect.depth import hitnet_weights, load_stereo, tiles
from flowrect.depth.hitnet import Hitnet, Init, Propagation, Stage, surest
from flowrect.depth.hitnet_loss import (
    PointTruth,
    at_points,
    fitted_slopes,
    init_loss,
    loss_terms,
    nearest_of_tile,
    robust,
    stage_losses,
)
from flowrect.depth.hitnet_weights import DepthCard, load_hitnet, save_hitnet
from flowrect.drectify import rectify
from flowrect.loading import Loading, PairLoader
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, sized
from flowrect.sample import collate
from flowrect.sources import open_source
from flowrect.train_flow import flow_at
from simgen.errors import UserError

TINY = HitnetConfig(
    channels=(4, 6, 8), max_disparity=48, tile_channels=6, descriptor=5, hidden=8, dilations=(1,),
    refine_hidden=(8, 8, 8), refine_dilations=(1,),
)  # fmt: skip
TINIEST = replace(
    TINY, channels=(2, 2, 2), max_disparity=16, tile_channels=2, hidden=4, refine_hidden=(4, 4, 2)
)
PLANE = (6.0, 0.03, -0.02)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return road_set(tmp_path_factory.mktemp("set"))


def network(seed: int = 0, *, zero_heads: bool = True) -> Hitnet:
    torch.manual_seed(seed)
    net = Hitnet(TINY)
    if not zero_heads:
        for module in (*net.updates, *net.refinements):
            torch.nn.init.normal_(module.update[-1].weight, std=0.05)
    return net


def tensors(pair) -> list[torch.Tensor]:
    """Images (1, 3, H, W) in 0…1."""
    return [torch.from_numpy(x).permute(2, 0, 1)[None] / 255 for x in (pair.left, pair.right)]


def plane_tiles(rows: int, columns: int, side: int = 4) -> torch.Tensor:
    """Hypotheses (1, 4, rows, columns) that all lie on PLANE; their p is noise."""
    a, b, c = PLANE
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    u, v = (side * (x + 0.5) - 0.5 for x in (u, v))
    d = a + b * u + c * v
    p = torch.rand(rows, columns, generator=torch.Generator().manual_seed(0))
    return torch.stack([d, torch.full_like(d, b), torch.full_like(d, c), p])[None]


def on_plane(h: int, w: int, scale: float = 1.0) -> torch.Tensor:
    """PLANE at the pixel centres of an image of ``scale`` times the resolution, in its px."""
    a, b, c = PLANE
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    u, v = ((x + 0.5) / scale - 0.5 for x in (u, v))
    return (scale * (a + b * u + c * v))[None, None]


# --- tiles -------------------------------------------------------------------------------------


def test_tiles_of_a_plane_are_the_plane():
    torch.testing.assert_close(tiles.plane(plane_tiles(3, 5)), on_plane(12, 20))


def test_tiles_of_a_finer_level_are_the_same_plane():
    finer = tiles.to_finer_level(plane_tiles(3, 5))
    torch.testing.assert_close(tiles.plane(finer), on_plane(24, 40, scale=2.0))


def test_smaller_tiles_are_the_same_plane():
    half = tiles.split(plane_tiles(3, 5), 1.0, 1.0)
    torch.testing.assert_close(tiles.plane(half, 2), on_plane(12, 20))
    pixels = tiles.split(half, 0.5, 1.0)
    torch.testing.assert_close(pixels[:, :1], on_plane(12, 20))


def test_a_descriptor_goes_to_all_four_children():
    h = plane_tiles(2, 3)
    finer = tiles.to_finer_level(h)
    for row in range(4):
        for column in range(6):
            assert finer[0, 3, row, column] == h[0, 3, row // 2, column // 2]


def test_warping_a_ramp_by_a_plane_is_exact():
    """right(u) = 3 u is linear, so linear interpolation at u − d gives 3 (u − d)."""
    disparity = on_plane(16, 64)
    u = torch.arange(64.0).expand(1, 1, 16, 64)
    inside = u >= disparity
    difference = tiles.warped(3 * u, disparity) - 3 * (u - disparity)
    assert difference[inside].abs().max() < 1e-4
    assert inside.float().mean() > 0.8


def test_warping_agrees_with_loops():
    generator = torch.Generator().manual_seed(0)
    right = torch.rand(1, 2, 3, 9, generator=generator)
    disparity = 4 * torch.rand(1, 1, 3, 9, generator=generator)
    found = tiles.warped(right, disparity)
    for v in range(3):
        for u in range(9):
            x = max(u - disparity[0, 0, v, u].item(), 0.0)
            low = min(int(x), 7)
            expected = (low + 1 - x) * right[0, :, v, low] + (x - low) * right[0, :, v, low + 1]
            torch.testing.assert_close(found[0, :, v, u], expected, rtol=0, atol=1e-5)


def test_local_costs_are_zero_at_the_true_plane_and_only_there():
    right = torch.rand(1, 3, 16, 64, generator=torch.Generator().manual_seed(0))
    h = plane_tiles(4, 16)
    left = tiles.warped(right, tiles.plane(h))
    costs = tiles.warp_costs(left, right, h).unflatten(1, (3, 16))[..., 4:]  # off the border
    assert costs[:, 1].max() < 1e-6
    assert costs[:, [0, 2]].mean() > 0.3


def test_a_local_cost_belongs_to_its_pixel():
    """Channel 16 δ + 4 i + j is pixel (i, j) of the tile."""
    right = torch.zeros(1, 1, 8, 8)
    left = torch.arange(64.0).view(1, 1, 8, 8)
    costs = tiles.warp_costs(left, right, torch.zeros(1, 4, 2, 2))
    assert costs.shape == (1, 48, 2, 2)
    for channel in range(48):
        i, j = divmod(channel % 16, 4)
        torch.testing.assert_close(costs[0, channel], left[0, 0, i::4, j::4])


# --- initialisation ----------------------------------------------------------------------------


def random_features(rows: int, columns: int, channels: int = 3) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(1)
    left = torch.rand(1, channels, rows, columns, generator=generator)
    return left, torch.rand(1, channels, rows, 4 * columns, generator=generator)


def cost_by_loops(left, right, row: int, column: int, d: int) -> float:
    if 4 * column - d < 0:
        return float("inf")
    pairs = zip(left[0, :, row, column], right[0, :, row, 4 * column - d], strict=True)
    return sum(abs(a.item() - b.item()) for a, b in pairs)


def test_tile_costs_are_those_of_loops():
    left, right = random_features(2, 5)
    costs = tiles.tile_costs(left, right, 12)
    for row in range(2):
        for column in range(5):
            expected = [cost_by_loops(left, right, row, column, d) for d in range(12)]
            np.testing.assert_allclose(costs[0, :, row, column], expected, rtol=1e-5)


def test_the_start_is_the_disparity_of_the_least_cost():
    net, level = network(), 1
    maps = [torch.randn(1, 6, 16, 32, generator=torch.Generator().manual_seed(k)) for k in (0, 1)]
    h, init = net.starts[level](*maps, level)
    num = init.costs.shape[1]
    assert num == TINY.max_disparity // 2
    for row in range(4):
        for column in range(8):
            costs = [cost_by_loops(init.left, init.right, row, column, d) for d in range(num)]
            assert costs[int(h[0, 0, row, column])] == pytest.approx(min(costs), rel=1e-5)
    assert not h[:, 1:3].any()  # fronto-parallel


def test_tiles_of_both_views_are_one_function():
    """A right tile at every column; those at multiples of 4 are the left ones of the same image."""
    start = network().starts[0]
    maps = torch.randn(1, 4, 8, 32, generator=torch.Generator().manual_seed(0))
    _, init = start(maps, maps, 0)
    torch.testing.assert_close(init.right[..., ::4], init.left)


def test_cost_between_whole_disparities_is_linear():
    left, right = random_features(2, 6)
    costs = tiles.tile_costs(left, right, 6)[..., 2:]
    for d in (0.0, 1.0, 2.25, 3.5):
        low = int(d)
        expected = (low + 1 - d) * costs[:, low] + (d - low) * costs[:, low + 1]
        found = tiles.tile_cost_at(left, right, torch.full((1, 2, 6), d))[..., 2:]
        torch.testing.assert_close(found, expected)


def test_shifted_noise_is_found_by_an_untrained_network():
    pair = planar_pair((12.0, 0, 0), wh=(96, 32), seed=0)
    with torch.no_grad():
        net = network().eval()
        found = net(*tensors(pair)).disparity
    assert (found[..., 20:-4] == 12).float().mean() > 0.95  # not at the borders


# --- propagation -------------------------------------------------------------------------------


def test_untrained_propagation_keeps_a_hypothesis_bit_for_bit():
    torch.manual_seed(0)
    config = replace(TINY, descriptor=1)
    maps = [torch.rand(1, 4, 12, 20) for _ in "lr"]
    h, other = plane_tiles(3, 5), torch.rand(1, 4, 3, 5)
    [(alone, _)] = Propagation(1, config)(*maps, [h])
    assert torch.equal(alone, h)
    updated = Propagation(2, config)(*maps, [h, other])
    assert torch.equal(updated[0][0], h)
    assert torch.equal(updated[1][0], other)


def test_the_surer_hypothesis_is_taken_for_each_tile():
    exact, wrong = plane_tiles(3, 5), torch.rand(1, 4, 3, 5)
    sure = torch.rand(1, 3, 5) > 0.5
    chosen = surest([(exact, sure.float()), (wrong, 0.5 * torch.ones(1, 3, 5))])
    assert torch.equal(chosen, torch.where(sure[:, None], exact, wrong))


def test_gradients_reach_every_parameter():
    pair = planar_pair(PLANE, wh=(64, 32), seed=0)
    net = network(zero_heads=False)
    terms = loss_terms(net(*tensors(pair)), dense_truth(pair), HitnetLoss())
    sum(terms.values()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_any_size_is_matched_and_padding_moves_no_disparity():
    pair = planar_pair((9.0, 0, 0), wh=(90, 45), seed=2)
    net = network(zero_heads=False).eval()
    found = net.match(pair.left, pair.right)
    assert (found.shape, found.dtype) == ((45, 90), np.float32)
    assert (found >= 0).all()
    padded = [np.pad(x, ((0, 3), (0, 6), (0, 0)), mode="edge") for x in (pair.left, pair.right)]
    np.testing.assert_array_equal(net.match(*padded)[:45, :90], found)


# --- losses ------------------------------------------------------------------------------------


def dense_truth(pair) -> PointTruth:
    h, w = pair.disparity.shape
    v, u = np.mgrid[:h, :w]
    uv = torch.from_numpy(np.stack([u, v], -1).reshape(1, -1, 2)).double()
    known = torch.ones(1, h * w, dtype=torch.bool)
    seen = torch.from_numpy(pair.visible.reshape(1, -1))
    return PointTruth(uv, torch.from_numpy(pair.disparity.reshape(1, -1)), known, seen, (w, h))


def scattered_truth(num: int = 3000, wh: tuple[int, int] = (64, 32)) -> PointTruth:
    """Points between pixels, on PLANE; a nearer plane in the right half of the image."""
    rng = np.random.default_rng(0)
    uv = rng.uniform(-0.5, np.array(wh) - 0.5, (1, num, 2))
    a, b, c = PLANE
    disparity = a + uv @ (b, c) + np.where(uv[..., 0] > 31.5, 10 + 0.1 * uv[..., 1], 0)
    known = torch.from_numpy(rng.random((1, num)) < 0.9)
    seen = torch.from_numpy(rng.random((1, num)) < 0.8) & known
    return PointTruth(torch.from_numpy(uv), torch.from_numpy(disparity), known, seen, wh)


@pytest.mark.parametrize("side, scale", [(4, 1), (2, 1), (1, 1), (4, 2), (4, 4)])
def test_a_tile_says_the_disparity_of_a_point_between_its_pixels(side, scale):
    truth = scattered_truth()
    w, h = truth.wh
    fine = plane_tiles(h // (side * scale), w // (side * scale), side * scale)
    fine[:, 0] /= scale
    found, slopes, confidence = at_points(Stage(fine, None, side, scale), truth)
    a, b, c = PLANE
    expected = a + truth.uv @ torch.tensor([b, c], dtype=torch.float64)
    torch.testing.assert_close(found[truth.known], expected[truth.known], rtol=0, atol=1e-5)
    assert confidence is None
    torch.testing.assert_close(slopes[0, 0], torch.tensor([b, c]))


def test_slopes_are_those_of_the_planes_and_none_across_their_edge():
    truth = scattered_truth()
    slopes, flat = fitted_slopes(truth)
    right = truth.uv[..., 0] > 31.5
    _, b, c = PLANE
    expected = torch.stack([torch.full_like(truth.disparity, b), c + 0.1 * right], -1)
    torch.testing.assert_close(slopes[flat], expected[flat], rtol=0, atol=1e-6)
    across = (truth.uv[..., 0] - 31.5).abs() < 3
    assert not flat[across].any()
    away = (truth.uv[..., 0] - 31.5).abs() > 6
    assert flat[away & truth.known].all()


def test_the_nearest_surface_of_a_tile_agrees_with_loops():
    truth = scattered_truth(200)
    found = nearest_of_tile(truth, 2)[0]
    expected = -np.ones((4, 8))
    for (u, v), d, seen in zip(truth.uv[0], truth.disparity[0], truth.visible[0], strict=True):
        if seen:
            i, j = int((v + 0.5) // 8), int((u + 0.5) // 8)
            expected[i, j] = max(expected[i, j], d)
    np.testing.assert_array_equal(found, expected)


def test_the_loss_of_the_start_agrees_with_loops():
    truth = scattered_truth(60)
    left, right = random_features(8, 16)
    left, right = 0.2 * left, 0.2 * right  # so that some wrong matches cost less than the margin
    costs = tiles.tile_costs(left, right, 40)
    nearest, losses = nearest_of_tile(truth, 1)[0], []
    for row in range(8):
        for column in range(16):
            d = nearest[row, column].item()
            if d < 0:
                continue
            match = tiles.tile_cost_at(left, right, torch.full((1, 8, 16), d))[0, row, column]
            wrong = [
                c for k, c in enumerate(costs[0, :, row, column].tolist())
                if abs(k - d) > 1.5 and np.isfinite(c)
            ]  # fmt: skip
            losses.append(match + max(1 - min(wrong, default=1.0), 0))
    found = init_loss(Init(left, right, costs, 1), truth)
    assert found.item() == pytest.approx(np.mean(losses), rel=1e-5)


def test_the_robust_loss_is_barrons_with_a_finite_gradient_at_zero():
    x = torch.tensor([0.0, 0.05, -2.0], dtype=torch.float64, requires_grad=True)
    expected = [1.1 / 0.9 * (((k / 0.1) ** 2 / 1.1 + 1) ** 0.45 - 1) for k in x.tolist()]
    torch.testing.assert_close(robust(x), torch.tensor(expected, dtype=torch.float64))
    robust(x).sum().backward()
    assert x.grad[0] == 0
    assert x.grad.isfinite().all()


def test_a_perfect_and_sure_stage_has_no_loss():
    pair = planar_pair(PLANE, wh=(64, 32), seed=0)
    truth = dense_truth(pair)
    slopes, flat = fitted_slopes(truth)
    stage = Stage(plane_tiles(8, 16), torch.ones(1, 8, 16), 4, 1)
    losses = stage_losses(stage, truth, slopes, flat)
    assert set(losses) == {"disparity", "slant", "confidence"}
    assert max(losses.values()) < 1e-5


@pytest.mark.parametrize("error, wanting", [(0.5, 0.7), (1.2, 0.0), (4.0, 0.3)])
def test_confidence_should_be_one_when_near_and_zero_when_far(error, wanting):
    truth = dense_truth(planar_pair(PLANE, wh=(64, 32), seed=0))
    h = plane_tiles(8, 16)
    h[:, 0] += error
    stage = Stage(h, torch.full((1, 8, 16), 0.3), 4, 1)
    losses = stage_losses(stage, truth, *fitted_slopes(truth))
    assert losses["confidence"].item() == pytest.approx(wanting, abs=1e-6)


def test_an_error_of_many_pixels_still_pulls_and_slopes_do_not():
    truth = dense_truth(planar_pair(PLANE, wh=(64, 32), seed=0))
    h = (plane_tiles(8, 16) + torch.tensor([30.0, 0, 0, 0])[:, None, None]).requires_grad_(True)
    losses = stage_losses(Stage(h, None, 4, 1), truth, *fitted_slopes(truth))
    losses["disparity"].backward()
    assert (h.grad[:, 0] > 0).all()
    assert losses["slant"] == 0


def test_a_few_steps_lower_the_loss_and_the_error():
    pair = planar_pair(PLANE, (20.0, -0.02, 0.03), (30, 8, 60, 24), wh=(96, 32), seed=1)
    images, truth, net = tensors(pair), dense_truth(pair), network()
    optimiser = torch.optim.Adam(net.parameters(), lr=2e-3)
    losses, errors = [], []
    for _ in range(25):
        prediction = net(*images)
        loss = sum(loss_terms(prediction, truth, HitnetLoss()).values())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        error = prediction.disparity[0, 0].detach().numpy() - pair.disparity
        losses.append(loss.item())
        errors.append(np.abs(error[pair.visible]).mean())
    assert losses[-1] < 0.8 * losses[0]
    assert errors[-1] < 0.8 * errors[0]


# --- training ----------------------------------------------------------------------------------


def options(data: Path, out: Path, **changes: object) -> DepthOptions:
    given = DepthOptions(
        data=data, out=out, model=TINIEST, loading=Loading(batch=1, workers=0), max_steps=2,
        val_pairs=1, val_every=9, warmup_steps=0, truth_points=4096,
    )  # fmt: skip
    return replace(given, **changes)


def test_disparity_of_the_truth_is_focal_length_times_baseline_over_depth(data, worst):
    pairs = open_source(data, split="train", truth_points=None)
    loading = Loading(batch=2, workers=0, shuffle=False)
    batch = next(iter(PairLoader(pairs, Sizing(METRIC_WH, keep=0.85), Augmentation(), loading)))
    _, _, found = train_depth.rectified_truly(batch, 500.0)
    rect = rectify(batch.R, batch.t, batch.K_left_metric, batch.K_right_metric, METRIC_WH)
    z = batch.truth.depth * (batch.truth.rays_left @ rect.R_left.mT)[..., 2]
    expected = rect.K_new[:, :1, 0] * batch.t.norm(dim=-1, keepdim=True) / z
    finite = found.known & (batch.truth.depth > 0)
    assert finite.sum() > 1000
    assert found.visible.sum() > 500
    worst("disparity against f b / z", (found.disparity - expected)[finite], 1e-6)
    at_infinity = found.known & (batch.truth.depth == 0)
    assert (found.disparity[at_infinity].abs() < 1e-6).all()


def test_images_and_disparity_of_the_truth_agree():
    """The right image, taken at u − disparity, looks like the left one where both see."""
    pair = plane_pair(turned(0.8, -0.5, 1.0), along_x(), np.array([0.004, 0.02, 0.08]))
    batch = collate([sized(pair, Sizing((64, 32)))])
    left, right, truth = train_depth.rectified_truly(batch, 500.0)
    shown = {}
    for shift_px in (0.0, 8.0):
        moved = truth.uv.clone()
        moved[..., 0] -= truth.disparity + shift_px
        colours = [flow_at(x, uv) for x, uv in ((left, truth.uv), (right, moved))]
        shown[shift_px] = (colours[0] - colours[1]).abs().mean(-1)[truth.visible].mean()
    assert shown[0.0] < 0.15 * shown[8.0]


def test_interrupted_and_resumed_equals_uninterrupted_bit_for_bit(data, tmp_path, monkeypatch):
    whole, parts = (options(data, tmp_path / name, max_steps=2) for name in "ab")
    scores = train_depth.train_depth(whole)
    with monkeypatch.context() as patch:
        interrupt_after(1, patch)
        train_depth.train_depth(parts)
    train_depth.train_depth(parts)
    a, b = (load_file(o.out / "last.safetensors") for o in (whole, parts))
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert set(scores) == {"end_point_px", "above_1px", "above_3px"}
    rows = [json.loads(x) for x in (whole.out / "metrics.jsonl").read_text().splitlines()]
    assert all(np.isfinite(r["loss"]) for r in rows if "loss" in r)
    _, card = load_hitnet(whole.out / "best.safetensors")
    assert (card.samples, card.data) == (2, data.name)


def test_the_command_reports_an_absent_set(tmp_path, capsys):
    assert train_depth.main(["--data", str(tmp_path / "no"), "--out", str(tmp_path / "run")]) == 2
    assert "no such folder" in capsys.readouterr().err


# --- weights -----------------------------------------------------------------------------------


def test_weights_come_back_and_match_the_same(tmp_path, monkeypatch):
    net = network(zero_heads=False).eval()
    save_hitnet(tmp_path / "x.safetensors", net, DepthCard(samples=3, data="noise"))
    found, card = load_hitnet(tmp_path / "x.safetensors")
    assert (found.config, card) == (TINY, DepthCard(3, "noise"))
    pair = planar_pair(PLANE, wh=(64, 32), seed=0)
    expected = net.match(pair.left, pair.right)
    monkeypatch.setenv("FLOWRECT_HITNET", str(tmp_path / "x.safetensors"))
    match = load_stereo("hitnet", largest_px=40)
    np.testing.assert_array_equal(match(pair.left, pair.right), expected)
    with pytest.raises(UserError, match="up to 48 px, but 60 can occur"):
        load_stereo("hitnet", largest_px=60)


def test_absent_weights_say_how_to_train_some(monkeypatch, tmp_path):
    monkeypatch.delenv("FLOWRECT_HITNET", raising=False)
    monkeypatch.setattr(hitnet_weights, "SHIPPED", tmp_path)
    with pytest.raises(UserError, match=r"python -m flowrect\.train_depth --data shards/"):
        load_stereo("hitnet", largest_px=40)
    save_hitnet(tmp_path / "hitnet.safetensors", network(), DepthCard())
    pair = planar_pair(PLANE, wh=(64, 32), seed=0)
    assert load_stereo("hitnet", largest_px=40)(pair.left, pair.right).shape == (32, 64)


def test_other_weights_are_refused(tmp_path):
    save_file({"x": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match="expected format 'flowrect-hitnet-1'"):
        load_hitnet(tmp_path / "other.safetensors")
    torch.save({"x": print}, tmp_path / "pickle.safetensors")
    for name in ("pickle", "absent"):
        with pytest.raises(UserError, match="holds no HITNet that this version builds"):
            load_hitnet(tmp_path / f"{name}.safetensors")


def test_too_few_resolutions_are_refused():
    with pytest.raises(ValueError, match="expected at least 3 resolutions"):
        Hitnet(replace(TINY, channels=(4, 6)))
