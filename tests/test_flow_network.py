"""RAFT: what it is taught is exact, it learns, it teaches without learning, files are safe."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from test_train import interrupt_after
from tiny_network import network, road_set, training
from torch.nn import functional as F
from torchvision.models.optical_flow import Raft_Large_Weights, Raft_Small_Weights

from flowrect import flow_network, train, train_flow
from flowrect.augment import Augmentation
from flowrect.config import FlowOptions, LossWeights
from flowrect.correspondences import Correspondences
from flowrect.drectify import rectify
from flowrect.flow_network import FlowCard, FlowNetwork, Flows, load_flow, read_card, save_flow
from flowrect.geometry import pixel_grid, rotation_from_vector, unproject
from flowrect.loading import Loading, PairLoader
from flowrect.metrics import METRIC_WH, exact_vertical_flow
from flowrect.resize import Sizing
from flowrect.sample import Batch
from flowrect.sources import open_source
from simgen.errors import UserError
from simgen.flowfield import flow_from_depth
from simgen.shards import ShardSet


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return road_set(tmp_path_factory.mktemp("set"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    save_flow(path, FlowNetwork(), FlowCard(samples=3, data="noise"))
    return path


@pytest.fixture
def two_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """RAFT refines its flow twice instead of 12 times, where how well it sees is of no account."""
    start = FlowNetwork.__init__

    def started(raft: FlowNetwork, *args: object) -> None:
        start(raft, *args)
        raft.updates = 2

    monkeypatch.setattr(FlowNetwork, "__init__", started)


def batch_of(data: Path, augmentation: Augmentation | None, num: int = 2) -> Batch:
    loading = Loading(batch=num, workers=0, shuffle=False)
    pairs = open_source(data, split="train", truth_points=None)
    return next(iter(PairLoader(pairs, Sizing(METRIC_WH, keep=0.85), augmentation, loading)))


def affine_field(wh: tuple[int, int]) -> torch.Tensor:
    """(1, 2, H, W): du = 2 + u/10 − v/20, dv = −1 + v/5."""
    v, u = torch.meshgrid(torch.arange(wh[1]), torch.arange(wh[0]), indexing="ij")
    return torch.stack([2 + u / 10 - v / 20, -1 + v / 5])[None].float()


def test_interpolation_is_exact_on_an_affine_field():
    uv = 3 + torch.rand(1, 50, 2, dtype=torch.float64) * 20
    found = train_flow.flow_at(affine_field((32, 28)), uv)
    u, v = uv.unbind(-1)
    expected = torch.stack([2 + u / 10 - v / 20, -1 + v / 5], -1)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-5)


def test_exact_flow_is_the_stored_flow(data):
    """Two routes to one number: rays of the truth, and the flow that a shard holds."""
    pair = open_source(data, split="train", truth_points=None)[0]
    frame = ShardSet(data, split="train")[0]
    truth, K = pair.truth.to("cpu"), torch.from_numpy(pair.K_left)
    _, flow, counted = train_flow.exact_flow(
        truth, K, torch.from_numpy(pair.K_right), pair.wh
    )  # fmt: skip
    depth, stored_K = frame.read("depth"), frame.read("K")
    T = frame.read("T_world_cam")
    stored = flow_from_depth(
        depth[0], stored_K[0], stored_K[1], np.linalg.inv(T[1]) @ T[0]
    ).reshape(-1, 2)  # fmt: skip
    assert counted.sum() > 1000
    error = np.abs(flow.numpy() - stored)[counted.numpy()]
    assert error.max() < 1e-4


def test_a_right_pose_leaves_no_vertical_flow_and_a_wrong_one_does(data):
    batch = batch_of(data, Augmentation())
    rng = torch.Generator().manual_seed(0)
    for error_deg, low, high in ((0.0, 0.0, 1e-6), (1.0, 0.5, 12.0)):
        wrong = train_flow.rectified_wrongly(batch, error_deg, rng=rng).batch
        _, flow, counted = train_flow.exact_flow(
            wrong.truth, wrong.K_left_metric, wrong.K_right_metric, METRIC_WH
        )
        vertical = flow[..., 1].abs()[counted].mean()
        assert low <= vertical <= high


def test_wrongly_rectified_truth_agrees_with_the_metric(data):
    """The mean |dv| of its correspondences is what metrics.exact_vertical_flow says of the pose."""
    batch = batch_of(data, None, num=1)
    rng = torch.Generator().manual_seed(5)
    wrong = train_flow.rectified_wrongly(batch, 1.0, rng=rng).batch
    unit = 2 * torch.rand(1, 3, generator=rng.manual_seed(5), dtype=torch.float64) - 1
    R = train_flow.rotation_from_vector(torch.deg2rad(unit)) @ batch.R
    rect = rectify(R, batch.t, batch.K_left_metric, batch.K_right_metric, METRIC_WH)
    truth = replace(wrong.truth, visible=torch.ones_like(wrong.truth.visible))
    _, flow, counted = train_flow.exact_flow(
        truth, wrong.K_left_metric, wrong.K_right_metric, METRIC_WH
    )
    mine = flow[..., 1].abs()[counted].mean()
    torch.testing.assert_close(mine, exact_vertical_flow(rect, batch.truth)[0], rtol=0, atol=1e-9)


def test_pixels_are_valid_where_both_images_are_white(data):
    """White images stay white where no black is mixed in, of either camera."""
    batch = batch_of(data, Augmentation())
    white = replace(
        batch,
        left_metric=torch.ones_like(batch.left_metric),
        right_metric=torch.ones_like(batch.right_metric),
    )
    wrong = train_flow.rectified_wrongly(white, 1.0, rng=torch.Generator().manual_seed(0))
    left, right = (
        (x[:, :1] > 1 - 1e-3) for x in (wrong.batch.left_metric, wrong.batch.right_metric)
    )
    assert (left & ~right).any()
    assert (right & ~left).any()
    differ = wrong.valid != (left & right)
    assert differ.float().mean() < 1e-3  # the fade begins at the last centre, within a thousandth
    assert train_flow.as_they_stand(white).valid.all()


@pytest.mark.parametrize("vertical", [False, True])
def test_vertical_errors_lie_across_the_epipolar_lines(vertical, data):
    batch = batch_of(data, None, num=1)
    seen = train_flow.as_they_stand(batch)
    assert not seen.vertical.any()
    turned = seen._replace(vertical=torch.tensor([vertical]))
    error, counted = train_flow.flow_errors(affine_field(METRIC_WH), batch)
    end_point, across = train_flow.error_sizes(affine_field(METRIC_WH), turned).unbind(-1)
    torch.testing.assert_close(end_point, error[counted].norm(dim=-1))
    torch.testing.assert_close(across, error[counted][:, 0 if vertical else 1].abs())


@pytest.mark.parametrize(("weight", "expected"), [(1.0, [5.0, 5.0]), (3.0, [9.0, 11.0])])
def test_the_loss_weighs_the_error_across_the_epipolar_lines(weight, expected):
    """Of du = -3 and dv = 2: |dv| of a horizontal rig, |du| of a vertical one."""
    error = torch.tensor([-3.0, 2.0]).repeat(2, 1, 1)
    sizes = train_flow.weighted_l1(error, torch.tensor([False, True]), weight)
    assert sizes[:, 0].tolist() == expected


def test_a_rig_of_cameras_above_each_other_is_vertical(data):
    batch = batch_of(data, None, num=1)
    below = replace(batch, t=batch.t.new_tensor([[0.0, -0.8, 0.0]]))
    assert train_flow.as_they_stand(below).vertical.all()
    rng = torch.Generator().manual_seed(0)
    assert train_flow.rectified_wrongly(below, 1.0, rng=rng).vertical.all()


def test_a_crop_keeps_the_flow(data):
    batch = batch_of(data, None, num=1)
    small = train_flow.cropped(batch, (256, 128), rng=torch.Generator().manual_seed(1))
    assert small.left_metric.shape[-2:] == (128, 256)
    whole, part = (
        train_flow.exact_flow(
            b.truth, b.K_left_metric, b.K_right_metric, (b.left_metric.shape[-1],) * 2
        )
        for b in (batch, small)
    )
    torch.testing.assert_close(whole[1], part[1], rtol=0, atol=1e-9)
    u, v = (whole[0] - part[0])[0, 0].round().long().tolist()
    assert torch.equal(small.left_metric, batch.left_metric[..., v : v + 128, u : u + 256])


def test_a_crop_that_raft_cannot_take_is_refused(data, tmp_path):
    with pytest.raises(UserError, match=r"--crop-wh \(100, 128\): expected multiples of 8"):
        train_flow.train_flow(flow_options(data, tmp_path, crop_wh=(100, 128)))


def flow_options(data: Path, out: Path, **changes: object) -> FlowOptions:
    options = FlowOptions(
        data=data, out=out, loading=Loading(batch=1, workers=0), updates=2, max_steps=2,
        crop_wh=(256, 128),
        val_pairs=1, val_every=9, warmup_steps=0,
    )  # fmt: skip
    return replace(options, **changes)


@pytest.mark.slow  # RAFT takes half a minute; the loop is the one of test_train, which is not
def test_interrupted_and_resumed_equals_uninterrupted_bit_for_bit(data, tmp_path, monkeypatch):
    whole, parts = (flow_options(data, tmp_path / name, updates=1, max_steps=3) for name in "ab")
    train_flow.train_flow(whole)
    with monkeypatch.context() as patch:
        interrupt_after(1, patch)
        train_flow.train_flow(parts)
    train_flow.train_flow(parts)
    a, b = (load_file(o.out / "last.safetensors") for o in (whole, parts))
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_a_finished_training_says_its_scores(data, tmp_path, two_updates):
    whole = flow_options(data, tmp_path / "whole")
    scores = train_flow.train_flow(whole)
    assert set(scores) == {
        "end_point_px", "vertical_median_px", "matching_nats", "rectified_end_point_px",
        "rectified_vertical_median_px", "rectified_matching_nats",
    }  # fmt: skip
    rows = [json.loads(x) for x in (whole.out / "metrics.jsonl").read_text().splitlines()]
    assert all(np.isfinite(r["loss"]) for r in rows if "loss" in r)
    card = read_card(whole.out / "last.safetensors")
    assert (card.samples, card.data) == (2, data.name)
    assert train_flow.train_flow(whole) == scores  # it was finished


def test_a_step_towards_the_truth_lowers_the_error(data):
    torch.manual_seed(0)
    whole, raft = batch_of(data, None, num=1), FlowNetwork().train()
    batch = train_flow.cropped(whole, (256, 128), rng=torch.Generator().manual_seed(0))
    optimiser = torch.optim.Adam(raft.parameters(), lr=1e-3)

    def error() -> torch.Tensor:
        flow = raft(batch.left_metric, batch.right_metric, 2).refined[-1]
        errors, counted = train_flow.flow_errors(flow, batch)
        return errors.abs().sum() / counted.sum()

    first = error()
    for _ in range(4):
        optimiser.zero_grad()
        loss = error()
        loss.backward()
        optimiser.step()
    assert error() < 0.9 * first


def test_matches_are_the_features_correlation(weights):
    raft = load_flow(str(weights))
    images = torch.rand(2, 1, 3, 128, 136, generator=torch.Generator().manual_seed(0))
    correlation = raft(*images, 1).correlation
    left, right = (raft.raft.feature_encoder(2 * x - 1)[0].flatten(1) for x in images)
    expected = left.T @ right / left.shape[0] ** 0.5
    torch.testing.assert_close(correlation[0], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("hw", [(16, 24), (19, 25)])
def test_averaged_features_correlate_as_averaged_correlations_do(hw):
    from torchvision.models.optical_flow.raft import CorrBlock

    ours, theirs = flow_network._Correlation(radius=3), CorrBlock(radius=3)
    features = torch.randn(2, 2, 32, *hw, generator=torch.Generator().manual_seed(0))
    ours.build_pyramid(*features)
    theirs.build_pyramid(*features)
    for found, expected in zip(ours.corr_pyramid, theirs.corr_pyramid, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_correlation_is_taught_where_the_right_end_lies(data):
    """Matches at the true feature, by the stored flow, cost least; if none is known, log(h·w)."""
    batch = batch_of(data, None, num=1)
    h, w = (s // 8 for s in batch.left_metric.shape[-2:])

    def loss_of(correlation: torch.Tensor) -> torch.Tensor:
        return train_flow.correlation_loss(Flows([], correlation, (w, h)), batch)

    loss = loss_of(torch.zeros(1, h * w, h * w))
    assert loss.item() == pytest.approx(np.log(h * w), abs=1e-6)

    uv, flow, counted = train_flow.exact_flow(
        batch.truth, batch.K_left_metric, batch.K_right_metric, METRIC_WH
    )
    u, v = (uv[0] / 8).round().long()[counted[0]].T
    u_right, v_right = ((uv + flow)[0] / 8).round().long()[counted[0]].T
    known = ((u < w) & (v < h) & (u_right < w) & (v_right < h)).nonzero()[:, 0]
    scores = torch.zeros(1, h * w, h * w)
    scores[0, (v * w + u)[known], (v_right * w + u_right)[known]] = 5
    assert loss_of(scores) < 0.7 * loss
    assert loss_of(scores.flip(-1)) > loss


def test_the_matching_term_is_weighted(data, tmp_path):
    task = train_flow.FlowTask(flow_options(data, tmp_path, matching=2.0, rectified=0.0))
    batch = batch_of(data, None, num=1)
    terms = task.terms(task.model, batch)
    flows = task.model(batch.left_metric, batch.right_metric, 1)
    assert set(terms) == {"flow", "matching"}
    assert terms["matching"].item() == pytest.approx(
        2 * train_flow.correlation_loss(flows, batch).item(), rel=0.3
    )  # of another window


def test_without_refinements_only_features_learn(data, tmp_path, weights):
    options = flow_options(data, tmp_path, updates=0, matching=1.0, init=str(weights), max_steps=1)
    scores = train_flow.train_flow(options)
    assert set(scores) == {"matching_nats", "rectified_matching_nats"}
    before, after = load_file(weights), load_file(tmp_path / "last.safetensors")
    learnt = {k.split(".")[0] for k in before if not torch.equal(before[k], after[k])}
    assert learnt == {"feature_encoder"}


def test_no_flow_to_learn_is_refused(data, tmp_path):
    with pytest.raises(UserError, match="nothing to minimise: --updates and --matching are 0"):
        train_flow.train_flow(flow_options(data, tmp_path, updates=0))


@pytest.mark.parametrize("magnify", [1.5, 2.0, 1.3])
def test_a_magnified_image_is_seen_and_flow_is_of_the_image_itself(weights, magnify):
    """What magnified images move by, divided by how much they were magnified."""
    images = torch.rand(2, 1, 3, 128, 160, generator=torch.Generator().manual_seed(0))
    images = F.avg_pool2d(images.flatten(0, 1), 5, 1, 2).reshape(images.shape)
    w, h = round(160 * magnify / 8) * 8, round(128 * magnify / 8) * 8
    large = [cv2.resize(x[0].permute(1, 2, 0).numpy(), (w, h), interpolation=cv2.INTER_CUBIC)
             for x in images]  # fmt: skip
    seen = [torch.from_numpy(x.clip(0, 1)).permute(2, 0, 1)[None] for x in large]
    expected = load_flow(str(weights)).flow(*seen)[0].permute(1, 2, 0).numpy()
    expected = cv2.resize(expected, (160, 128)) * [160 / w, 128 / h]
    flows = load_flow(str(weights), magnify)(*images)
    assert flows.feature_wh == (w // 8, h // 8)
    assert flows.correlation.shape == (1, w * h // 64, w * h // 64)
    found = flows.refined[-1][0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


def test_weights_know_how_often_their_flow_is_refined(tmp_path, weights):
    network = load_flow(str(weights))
    save_flow(tmp_path / "three.safetensors", network, replace(FlowCard(), updates=3))
    images = torch.rand(2, 1, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    three = load_flow(str(tmp_path / "three.safetensors"))
    assert len(network(*images).refined) == 12
    assert len(three(*images).refined) == 3
    assert torch.equal(three.flow(*images), network(*images, 3).refined[-1])


def test_how_often_flow_is_refined_goes_from_weights_to_weights(data, tmp_path, weights):
    options = flow_options(data, tmp_path / "a", updates=1, max_steps=1, refine=2)
    train_flow.train_flow(options)
    last = tmp_path / "a" / "last.safetensors"
    assert read_card(last).updates == 2
    on = flow_options(data, tmp_path / "b", init=str(last))
    assert train_flow.FlowTask(on).model.updates == 2
    assert train_flow.FlowTask(replace(on, refine=5)).model.updates == 5
    with pytest.raises(UserError, match=r"refine was 2, now 12"):  # as it would go on
        train_flow.train_flow(replace(options, refine=None))
    with pytest.raises(UserError, match=r"--refine 0: expected at least 1"):
        train_flow.FlowTask(replace(on, refine=0))


@pytest.mark.usefixtures("two_updates")
def test_weights_know_how_much_they_magnify(data, tmp_path, weights):
    options = flow_options(data, tmp_path / "a", magnify=1.5, init=str(weights), matching=1.0)
    train_flow.train_flow(options)
    path = tmp_path / "a" / "last.safetensors"
    assert read_card(path).magnify == load_flow(str(path)).magnify == 1.5
    assert load_flow(str(weights)).magnify == 1
    on = train_flow.as_initial(flow_options(data, tmp_path / "a", init=str(path)))
    assert train_flow.FlowTask(on).model.magnify == on.magnify == 1.5
    assert read_card(path).samples > read_card(weights).samples
    with pytest.raises(UserError, match=r"magnify was 1\.5, now 1\.0"):  # as it would go on
        train_flow.train_flow(replace(options, magnify=None, init=""))


def test_reduced_images_are_refused(data, tmp_path):
    with pytest.raises(UserError, match=r"--magnify 0\.5: expected 1 to 4"):
        train_flow.FlowTask(flow_options(data, tmp_path, magnify=0.5))


def test_weights_come_back(weights):
    raft = load_flow(str(weights))
    assert not any(p.requires_grad for p in raft.parameters())
    saved = load_file(weights)
    assert all(torch.equal(x, saved[k]) for k, x in raft.raft.state_dict().items())


def random_state(size: str) -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    return FlowNetwork(size).raft.state_dict()


@pytest.mark.parametrize("size", ["small", "large"])
def test_weights_say_which_network_they_are_of(size, tmp_path):
    state, path = random_state(size), tmp_path / f"raft_{size}.pth"
    torch.save(state, path)
    loaded = load_flow(str(path)).raft.state_dict()
    assert state.keys() == loaded.keys()
    assert all(torch.equal(x, loaded[k]) for k, x in state.items())


@pytest.mark.parametrize(
    "name, enum, size",
    [
        ("torchvision", Raft_Small_Weights, "small"),
        ("torchvision-large", Raft_Large_Weights, "large"),
    ],
)
def test_torchvisions_own_are_fetched_with_their_hash_checked(name, enum, size, monkeypatch):
    state, asked = random_state(size), []

    def get_state_dict(weights, **options):
        asked.append((weights, options["check_hash"]))
        return state

    monkeypatch.setattr(enum, "get_state_dict", get_state_dict)
    loaded = load_flow(name).raft.state_dict()
    assert all(torch.equal(x, loaded[k]) for k, x in state.items())
    assert asked == [(flow_network.TORCHVISION[name], True)]


def test_weights_that_cannot_be_fetched_say_where_they_are(monkeypatch):
    def get_state_dict(weights, **options):
        raise OSError("no route")

    monkeypatch.setattr(Raft_Large_Weights, "get_state_dict", get_state_dict)
    with pytest.raises(UserError, match=r"raft_large_C_T_SKHT_K_V1-4a6a5039\.pth \(no route\)"):
        load_flow("torchvision-large")


def test_the_hash_in_a_name_is_that_of_the_content(tmp_path):
    torch.save(random_state("small"), tmp_path / "raft.pth")
    content = (tmp_path / "raft.pth").read_bytes()
    whole = tmp_path / f"raft_small-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    whole.write_bytes(content)
    load_flow(str(whole))
    whole.write_bytes(content[:-1])
    with pytest.raises(UserError, match="its name says that its sha256 begins with"):
        load_flow(str(whole))


@pytest.mark.parametrize("teacher", ["raft", "raft-matches"])
def test_the_network_learns_from_the_teacher_alone(data, tmp_path, weights, teacher, two_updates):
    """The paper's self-supervision: neither rotation nor depth, only what the teacher sees."""
    options = training(
        data, tmp_path, teacher=teacher, teacher_device="cpu", flow_weights=str(weights),
        max_steps=1, loss=LossWeights(rotation=0, matching=0), loading=Loading(batch=1, workers=0),
    )  # fmt: skip
    train.train(options)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    [row] = [r for r in map(json.loads, lines) if "loss" in r]
    assert row["loss"] == row["flow"] > 0
    fresh = network(options.model, seed=options.loading.seed).state_dict()
    trained = load_file(tmp_path / "last.safetensors")
    assert any(not torch.equal(fresh[k], trained[k]) for k in fresh)


def test_gradients_reach_the_pose_through_teacher_and_warp(data, weights, two_updates):
    batch = batch_of(data, None, num=1)
    options = training(data, Path(), teacher="raft", loss=LossWeights(rotation=0))
    model = network(options.model).train()
    prediction = train.predict(model, batch, options)
    prediction.R.retain_grad()
    teacher = load_flow(str(weights))
    terms = train.loss_terms(prediction, batch, options, teacher)
    terms["flow"].backward()
    assert prediction.R.grad.abs().max() > 0
    assert all(p.grad is None for p in teacher.parameters())


class Exact:
    """A teacher that sees the exact flow of points at infinity between rectified images."""

    def __init__(self, batch: Batch, R: torch.Tensor) -> None:
        rect = rectify(R.detach(), batch.t, batch.K_left_metric, batch.K_right_metric, METRIC_WH)
        turn = rect.R_right @ batch.R @ rect.R_left.mT
        self._homography = rect.K_new @ turn @ torch.linalg.inv(rect.K_new)

    def parameters(self):
        yield torch.zeros(1)

    def flow(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        u, v = torch.meshgrid(*map(torch.arange, METRIC_WH), indexing="xy")
        uv1 = torch.stack([u, v, torch.ones_like(u)]).double()
        ends = torch.einsum("bij,jhw->bihw", self._homography, uv1)
        return (ends[:, :2] / ends[:, 2:] - uv1[:2]).float()


class LeftFirst:
    """A teacher that knows only scenes that move to the left: dv is the left image's red."""

    def parameters(self):
        yield torch.zeros(1)

    def flow(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        u = torch.arange(left.shape[-1]).expand_as(left[:, 0])
        return torch.stack([-1.0 - u, left[:, 0]], dim=1)


def test_a_pair_whose_right_camera_comes_first_is_mirrored_for_the_teacher():
    left, right = torch.rand(2, 2, 3, 4, 6)
    usual, mirrored = train._flow_of(LeftFirst(), left, right, torch.tensor([False, True]))
    torch.testing.assert_close(usual[1], left[0, 0])
    torch.testing.assert_close(mirrored[1], left[1, 0])  # at the same pixels
    assert usual[0, 0].tolist() == [-1, -2, -3, -4, -5, -6]
    assert mirrored[0, 0].tolist() == [6, 5, 4, 3, 2, 1]


def test_which_camera_comes_first_is_told_by_the_baseline():
    K = torch.tensor([[[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]], dtype=torch.float64)
    t = torch.tensor([[-0.8, 0.1, 0], [0.8, 0.1, 0], [0, 0.8, 0], [0.1, -0.8, 0]]).double()
    R = rotation_from_vector(0.03 * torch.rand(4, 3, dtype=torch.float64))
    rect = rectify(R, t, K.expand(4, 3, 3), K.expand(4, 3, 3), (48, 32))
    assert train._right_first(rect, t).tolist() == [False, True, False, False]


def test_matches_of_a_teacher_teach_as_exact_flow_does(data, worst):
    """Value and gradient are those of exact flow between the same points, here at infinity."""
    batch = batch_of(data, None, num=1)
    options = training(data, Path(), teacher="raft-matches", loss=LossWeights(rotation=0, flow=1.0))
    prediction = train.predict(network(options.model), batch, options)

    def value_and_gradient(teacher: str, seen: Batch) -> tuple[float, torch.Tensor]:
        R = prediction.R.detach().requires_grad_()
        predicted = replace(prediction, R=R)
        taught = replace(options, teacher=teacher)
        loss = train.loss_terms(
            predicted, seen, taught, Exact(batch, R) if teacher != "exact" else None
        )
        [gradient] = torch.autograd.grad(loss["flow"], R)
        return loss["flow"].item(), gradient

    w, h = METRIC_WH
    rect = rectify(
        prediction.R.detach(), batch.t, batch.K_left_metric, batch.K_right_metric, METRIC_WH
    )
    rays = (
        unproject(rect.K_new, pixel_grid(METRIC_WH, dtype=torch.float64, device="cpu"))
        @ rect.R_left
    )
    yes = torch.ones(1, w * h, dtype=torch.bool)
    distant = Correspondences(rays, rays @ batch.R.mT, yes, yes, torch.zeros(1, w * h))
    found, gradient = value_and_gradient("raft-matches", batch)
    expected, exact = value_and_gradient("exact", Batch(**{**vars(batch), "truth": distant}))
    assert expected > 0.5
    worst("vertical flow of matches", abs(found - expected), 1e-4, "px")
    worst("its gradient", (gradient - exact).abs().max() / exact.abs().max(), 1e-3)


@pytest.mark.parametrize(
    "teacher, loss", [("none", LossWeights(0, matching=0)), ("raft", LossWeights(0, flow=0))]
)
def test_nothing_to_minimise_is_refused(data, tmp_path, teacher, loss):
    options = training(data, tmp_path, teacher=teacher, loss=loss)
    with pytest.raises(UserError, match="nothing to minimise"):
        train.train(options)


def test_a_pickle_that_runs_code_is_refused(tmp_path):
    path = tmp_path / "raft.pth"
    torch.save({"x": print}, path)
    with pytest.raises(UserError, match="which holds tensors only"):
        load_flow(str(path))


def test_a_list_of_tensors_is_refused(tmp_path):
    torch.save([torch.zeros(1)], tmp_path / "raft.pth")
    with pytest.raises(UserError, match="holds one list"):
        load_flow(str(tmp_path / "raft.pth"))


def test_other_weights_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="expected format 'flowrect-flow-1'"):
        load_flow(str(path))
    torch.save({"x": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(UserError, match="does not hold weights of raft_small"):
        load_flow(str(tmp_path / "other.pth"))


def test_absent_weights_say_where_to_get_some():
    with pytest.raises(UserError, match=r"python -m flowrect\.train_flow"):
        load_flow("nothing")


def test_images_that_raft_cannot_match_are_refused():
    with pytest.raises(UserError, match="images of 64x64 px cannot be matched"):
        FlowNetwork().flow(torch.zeros(1, 3, 64, 64), torch.zeros(1, 3, 64, 64))


def test_the_command_reports_an_absent_set(tmp_path, capsys):
    assert train_flow.main(["--data", str(tmp_path / "no"), "--out", str(tmp_path / "run")]) == 2
    assert "no such folder" in capsys.readouterr().err
