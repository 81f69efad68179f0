"""The rivals: their geometry against brute force, their losses at the truth, training and files."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from math import pi, tanh
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.spatial.transform import Rotation
from tiny_network import network, pairs, road_set, rotations

from flowrect import export_onnx, halve_weights, methods, train
from flowrect.config import RIVAL_TRAINING
from flowrect.estimate import load_model
from flowrect.geometry import geodesic_rad
from flowrect.loading import Loading
from flowrect.matches import Matches
from flowrect.methods import FromMatches, PoseEstimate, Seconds, load_method
from flowrect.resize import Sizing, sized
from flowrect.rivals import build
from flowrect.rivals.config import RIVALS, DirectionNetConfig, RPNetConfig, ViTPoseConfig
from flowrect.rivals.directionnet import (
    density_of,
    expectation_of,
    padded_on_sphere,
    rotation_of_columns,
    solid_angles,
    sphere_directions,
    von_mises_fisher,
)
from flowrect.rivals.frame import views
from flowrect.rivals.rpnet import relative_pose
from flowrect.rivals.vitpose import (
    BORDER,
    STRIDE,
    EssentialModule,
    WideLinear,
    monomials,
    mutual_attention,
    quadratic_form,
    token_grid,
)
from flowrect.sample import Pair, collate
from flowrect.solvers import NoSolution
from flowrect.weights import Card, load_weights, save_weights
from simgen.errors import UserError
from simgen.geometry import intrinsics, transform

WH = (128, 64)
SMALL = {"input_wh": WH, "network_wh": (64, 64)}
TINY = {
    "rpnet": RPNetConfig(**SMALL, hidden=32),
    "directionnet": DirectionNetConfig(**SMALL),
    "directionnet-6d-t": DirectionNetConfig(**SMALL, directions="6d", predict_t=True),
    "vitpose": ViTPoseConfig(**SMALL, channels=24, depth=2, hidden=32),
    "vitpose-cross": ViTPoseConfig(**SMALL, channels=24, depth=2, hidden=32, cross_features=True),
}
each = pytest.mark.parametrize("name", TINY)
starts = pytest.mark.parametrize("start", ["prior", "none"])


def rival(name, **changes):
    torch.manual_seed(0)
    return build(replace(TINY[name], **changes))


def truth_of(given):
    """A pose up to 2° and some centimetres from the prior."""
    generator = torch.Generator().manual_seed(7)
    vectors, aside = 2 * torch.rand(2, *given["t_init"].shape, generator=generator).double() - 1
    return rotations(2 * vectors) @ given["R_init"], given["t_init"] + 0.05 * aside


def total(net, given, R, t):
    terms = net.losses(net(**given), R, t)
    return torch.stack(list(terms.values())).sum()


def directions(n, seed=0):
    x = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return x / x.norm(dim=-1, keepdim=True)


# --- what they see and what they mean ----------------------------------------------------------


@starts
def test_the_pose_of_a_residual_is_the_pose(start, worst):
    given = pairs(4, seed=0, wh=WH)
    frame = views(*given.values(), RPNetConfig(**SMALL, start=start)).frame
    R, t = truth_of(given)
    R_back, t_back = frame.pose(*frame.residual(R, t))
    worst("R of its residual", R_back - R, 1e-13, "-")
    worst("t of its residual", t_back - t, 1e-13, "m")


def test_a_prior_that_is_right_leaves_nothing(worst):
    given = pairs(4, seed=0, wh=WH)
    frame = views(*given.values(), TINY["rpnet"]).frame
    Delta, shift = frame.residual(given["R_init"], given["t_init"])
    worst("what a right prior leaves", torch.cat([Delta - torch.eye(3), shift[:, None]], 1), 1e-13)


def test_squeezed_views_keep_rays_where_the_prior_turns_nothing(worst):
    """A ramp along u, squeezed 128 to 64 px and rectified by an ideal rig, still tells its ray."""
    K = torch.from_numpy(intrinsics(WH, 90.0))[None]
    ramp = torch.linspace(0, 1, WH[0]).expand(1, 3, WH[1], WH[0])
    t = torch.tensor([[-1.0, 0, 0]]).double()
    seen = views(ramp, ramp, K, K, torch.eye(3).double()[None], t, TINY["rpnet"])
    grey = seen.images[0, 0] * 0.229 + 0.485
    u = torch.arange(64, dtype=torch.float64)
    x = (u - seen.K[0, 0, 2]) / seen.K[0, 0, 0]
    expected = (K[0, 0, 0] * x + K[0, 0, 2]) / (WH[0] - 1)
    inner = slice(4, -4)
    worst("grey of a ray after squeezing", grey[32, inner] - expected[inner], 1e-3, "-")
    assert expected[0] < 0.02  # the whole width is seen: yaw shows in the corners alone
    assert expected[-1] > 0.98


@each
@starts
def test_whatever_is_seen_the_answer_is_a_rotation(name, start, worst):
    R = rival(name, start=start).eval()(**pairs(2, seed=1, wh=WH)).R.detach()
    assert R.dtype == torch.float64
    worst("R Rᵀ - I", R @ R.mT - torch.eye(3), 1e-12, "-")
    worst("det R - 1", torch.linalg.det(R) - 1, 1e-12, "-")


@pytest.mark.parametrize("name", ["rpnet", "vitpose"])
def test_untrained_it_says_the_prior(name, worst):
    given = pairs(3, seed=2, wh=WH, limit_deg=5.0)
    prediction = rival(name).eval()(**given)
    away = geodesic_rad(prediction.R, given["R_init"]).rad2deg().detach()
    worst("untrained against the prior", away, 0.5, "deg")
    worst("t untrained against the prior", (prediction.t - given["t_init"]).detach(), 0.02, "m")


@pytest.mark.parametrize("name", RIVALS)
def test_as_published_the_prior_is_not_looked_at(name):
    net = rival(name, start="none").eval()
    given = pairs(2, seed=3, wh=WH)
    other = {**given, "R_init": given["R_init"].mT.contiguous()}
    assert torch.equal(net(**given).R, net(**other).R)
    assert not torch.equal(rival(name).eval()(**given).R, rival(name).eval()(**other).R)


# --- RPNet -------------------------------------------------------------------------------------


def test_the_relative_pose_takes_points_from_the_left_camera_to_the_right(worst):
    """Cameras at c with X_cam = R(q) (X − c), in SciPy."""
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(2, 5, 7))
    points = rng.normal(size=(5, 3))
    left, right = (
        Rotation.from_quat(p[:, :4]).apply(points - p[:, 4:]) for p in poses
    )  # SciPy scales q itself
    Delta, shift = relative_pose(*torch.from_numpy(poses))
    moved = (Delta @ torch.from_numpy(left)[..., None])[..., 0] + shift
    worst("points by the relative pose", moved - torch.from_numpy(right), 1e-12, "m")


def test_auxiliary_heads_speak_in_training_alone_and_count_less():
    net, given = rival("rpnet"), pairs(2, seed=4, wh=WH)
    R, t = truth_of(given)
    prediction = net.train()(**given)
    assert len(prediction.heads) == 3
    one = prediction.heads[:1]
    alone = net.losses(replace(prediction, heads=one), R, t)["rotation"]
    thrice = net.losses(replace(prediction, heads=one * 3), R, t)["rotation"]
    torch.testing.assert_close(thrice, alone * (1 + 2 * 0.3))
    assert len(net.eval()(**given).heads) == 1


# --- DirectionNet ------------------------------------------------------------------------------


def test_solid_angles_sum_to_the_sphere():
    assert float(solid_angles((64, 48)).sum() * 48) == pytest.approx(4 * pi, rel=1e-14)


def test_pixels_look_up_at_the_top_and_forward_in_the_middle():
    x = sphere_directions((64, 64))
    torch.testing.assert_close(x.norm(dim=-1), torch.ones(64, 64, dtype=torch.float64))
    assert (x[0, :, 1] < -0.999).all()
    assert (x[-1, :, 1] > 0.999).all()
    assert float(x[31:33, 31:33].mean((0, 1))[2]) > 0.99
    assert float(x[32, 48, 0]) > 0.99


@pytest.mark.parametrize("pixel", [(0, 0), (17, 40), (63, 5)])
def test_the_expectation_of_a_single_pixel_is_its_direction(pixel):
    density = torch.zeros(64, 64, dtype=torch.float64)
    density[pixel] = 1 / solid_angles((64, 64))[pixel[0], 0]
    torch.testing.assert_close(expectation_of(density), sphere_directions((64, 64))[pixel])


def test_von_mises_fisher_sums_to_one_and_points_at_its_mean(worst):
    mean = torch.cat([directions(20), torch.eye(3).double()])
    density = von_mises_fisher(mean, 10.0)
    worst("mass of the density", (density * solid_angles((64, 64))).sum((1, 2)) - 1, 1e-13, "-")
    expectation = expectation_of(density)
    length = expectation.norm(dim=-1, keepdim=True)
    worst("length of its expectation", length - (1 / tanh(10.0) - 1 / 10.0), 2e-3, "-")
    angle = torch.linalg.cross(expectation / length, mean).norm(dim=-1).rad2deg()
    worst("direction of its expectation", angle, 0.02, "deg")


def test_a_density_sums_to_one_whatever_the_map():
    maps = 30 * torch.randn(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    mass = (density_of(maps) * solid_angles((64, 64))).sum((-2, -1))
    torch.testing.assert_close(mass, torch.ones_like(mass))


def test_a_padded_sphere_has_no_seam():
    """Neighbours in the padded map of directions are no farther apart than inside."""
    x = sphere_directions((16, 32)).movedim(-1, 0)
    padded = padded_on_sphere(x)
    for axis, shape in ((1, (3, 17, 34)), (2, (3, 18, 33))):
        inside, around = x.diff(dim=axis).norm(dim=0), padded.diff(dim=axis).norm(dim=0)
        assert padded.diff(dim=axis).shape == shape
        assert around.max() <= inside.max() + 1e-12
    torch.testing.assert_close(padded[:, 1:-1, 1:-1], x)


def test_columns_of_a_rotation_give_it_back(worst):
    R = rotations(180 * directions(10))
    for n in (2, 3):
        worst("R of its columns", rotation_of_columns(R.mT[:, :n]) - R, 1e-12, "-")


def test_three_directions_give_the_closest_rotation():
    columns = directions(6).reshape(2, 3, 3)  # of which one is left-handed, or made so
    columns[0] *= -torch.linalg.det(columns[0]).sign()
    R = rotation_of_columns(columns)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(2, dtype=torch.float64))
    others = rotations(180 * directions(2000, seed=1))
    for k in range(2):
        away = (others - columns[k].mT).norm(dim=(1, 2)).min()
        assert (R[k] - columns[k].mT).norm() <= away
        nearby = R[k] @ rotations(0.5 * directions(50))
        assert ((R[k] - columns[k].mT).norm() <= (nearby - columns[k].mT).norm(dim=(1, 2))).all()


@pytest.mark.parametrize("name", ["directionnet", "directionnet-6d-t"])
def test_direction_losses_are_least_at_the_truth(name):
    net, given = rival(name).eval(), pairs(2, seed=5, wh=WH)
    R, t = truth_of(given)
    prediction = net(**given)
    Delta, _ = prediction.frame.residual(R, t)
    target = [*Delta.mT.unbind(1)][: net.num_columns]
    if net.config.predict_t:
        t_rect = (prediction.frame.R_right @ t[..., None])[..., 0]
        target.append(t_rect / t_rect.norm(dim=-1, keepdim=True))
    density = von_mises_fisher(torch.stack(target, 1), 10.0)
    at_truth = replace(prediction, density=density, expectation=expectation_of(density))
    terms = net.losses(at_truth, R, t)
    assert float(terms["direction"]) == pytest.approx(-1, abs=1e-6)
    assert float(terms["distribution"]) == pytest.approx(0, abs=1e-20)
    elsewhere = net.losses(at_truth, rotations(torch.eye(3)[:2].double()) @ R, t)
    assert float(elsewhere["direction"]) > float(terms["direction"]) + 1e-5
    assert float(elsewhere["distribution"]) > 1e-3
    whole = net.losses(replace(at_truth, expectation=density.new_tensor([0, 0, 1.0])), R, t)
    assert float(whole["spread"]) == pytest.approx(0, abs=1e-12)


# --- ViTPose -----------------------------------------------------------------------------------


def test_the_paper_s_sizes_follow():
    net = build(ViTPoseConfig())
    assert token_grid((224, 224)) == (24, 24)
    assert net.position.shape == (1, 24 * 24, 192)
    assert net.pose[0].in_features == 26_880


def test_mutual_attention_is_the_product_of_both_softmaxes():
    q, k = torch.randn(2, 2, 5, 4, generator=torch.Generator().manual_seed(0)).double().unbind(0)
    A = mutual_attention(q, k)
    e = [[[float(q[b, i] @ k[b, j]) / 2.0 for j in range(5)] for i in range(5)] for b in range(2)]
    e = np.exp(e)
    for b, i, j in product(range(2), range(5), range(5)):
        expected = e[b, i, j] / e[b, i].sum() * e[b, i, j] / e[b, :, j].sum()
        assert float(A[b, i, j]) == pytest.approx(expected, rel=1e-12)
    assert (A.sum(-1) <= 1).all()
    assert (A.sum(-2) <= 1).all()


def test_distinct_tokens_attend_to_their_like_alone():
    permutation = torch.tensor([2, 0, 3, 1])
    tokens = 20 * torch.eye(4).double()
    A = mutual_attention(tokens, tokens[permutation])
    torch.testing.assert_close(A, torch.eye(4).double()[:, permutation])


def test_the_quadratic_form_is_the_sum_over_all_pairs():
    generator = torch.Generator().manual_seed(0)
    V, W = (torch.randn(2, 5, 3, generator=generator).double() for _ in range(2))
    A = torch.rand(2, 5, 5, generator=generator).double()
    expected = torch.zeros(2, 3, 3).double()
    for b, i, j in product(range(2), range(5), range(5)):
        expected[b] += A[b, i, j] * torch.outer(V[b, i], W[b, j])
    torch.testing.assert_close(quadratic_form(V, A, W), expected)


def test_monomials_of_perfect_matches_are_the_moments_of_the_rays():
    """With A = I the last 6 × 6 block is Σ φ φᵀ; its last row sums the monomials themselves."""
    K = torch.from_numpy(intrinsics((64, 64), 90.0))[None]
    phi = monomials(K, (64, 64))[0]
    moments = quadratic_form(phi, torch.eye(16).double(), phi)
    torch.testing.assert_close(moments[-1], phi.sum(0))
    y, x = ((STRIDE * (i + BORDER) - 31.5) / 32 for i in (1, 3))  # token of row 1, column 3
    expected = [y * y, x * x, x * y, y, x, 1]
    torch.testing.assert_close(phi[1 * 4 + 3], torch.tensor(expected).double())


def test_a_token_stands_in_the_middle_of_what_it_sees():
    net = rival("vitpose").eval()
    net.cnn[3] = torch.nn.AvgPool2d(3, 2, 1)  # the same window; a maximum sees one pixel of it
    for parameter in net.cnn.parameters():
        parameter.data.abs_()
    image = torch.rand(1, 3, 192, 256, generator=torch.Generator().manual_seed(0))
    image.requires_grad_(True)
    row, column = 9, 13
    net.cnn(image)[0, :, row, column].sum().backward()
    seen = image.grad[0].abs().sum(0).nonzero()
    middle = (seen.amin(0) + seen.amax(0)) / 2
    assert seen.amin() > 0
    assert middle.tolist() == [STRIDE * (row + BORDER), STRIDE * (column + BORDER)]


@pytest.mark.parametrize("name", ["vitpose", "vitpose-cross"])
def test_exchanged_views_exchange_the_halves(name):
    torch.manual_seed(0)
    module = EssentialModule(TINY[name]).double()
    f, phi = torch.randn(4, 16, 24).double(), torch.randn(4, 16, 6).double()
    exchange = [2, 3, 0, 1]
    torch.testing.assert_close(module(f[exchange], phi[exchange]), module(f, phi)[exchange])


def test_a_step_of_adam_leaves_the_many_inputs_of_the_mlp_nearly_what_they_were(worst):
    """As published it moves hidden units by more than they vary, and all of them may die."""
    torch.manual_seed(0)
    layer, x = WideLinear(26_880, 16), torch.randn(8, 26_880)
    before = layer(x)
    assert before.std().item() == pytest.approx(3**-0.5, rel=0.1)  # as nn.Linear starts
    before.sum().backward()
    torch.optim.Adam(layer.parameters(), 2e-4).step()
    worst("change of a hidden unit by a step", (layer(x) - before).detach(), 0.1, "-")


# --- losses and gradients ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rpnet", "vitpose"])
def test_losses_vanish_at_the_truth_alone_with_finite_gradients(name):
    net, given = rival(name), pairs(2, seed=6, wh=WH)
    R, t = truth_of(given)
    prediction = net(**given)
    Delta, shift = (x.requires_grad_(True) for x in prediction.frame.residual(R, t))
    changes = {"heads": [(Delta, shift)]} if name == "rpnet" else {"Delta": Delta, "shift": shift}
    terms = net.losses(replace(prediction, **changes), R, t)
    assert all(x.item() == pytest.approx(0, abs=1e-7) for x in terms.values())
    for x in torch.autograd.grad(sum(terms.values()), (Delta, shift)):
        assert torch.isfinite(x).all()
    turned = net.losses(prediction, R, t)
    assert all(x.item() > 1e-3 for x in turned.values())


@each
def test_a_gradient_reaches_every_parameter(name):
    net, given = rival(name).train(), pairs(2, seed=8, wh=WH)
    total(net, given, *truth_of(given)).backward()
    unreached = [
        n for n, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0
    ]
    assert not unreached


@pytest.mark.parametrize(
    "name, lr, share",
    [("rpnet", 1e-4, 0.8), ("directionnet", 1e-3, 0.98), ("vitpose", 1e-3, 0.8)],
)
def test_a_few_steps_on_two_pairs_reduce_the_loss(name, lr, share):
    """DirectionNet has far to go: its maps start anywhere, the others' answers at the prior."""
    net, given = rival(name).train(), pairs(2, seed=9, wh=WH)
    truth = truth_of(given)
    optimiser = torch.optim.Adam(net.parameters(), lr=lr)
    history = []
    for _ in range(6):
        optimiser.zero_grad()
        loss = total(net, given, *truth)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        history.append(loss.item())
    assert min(history[-3:]) < share * history[0]


def test_a_network_that_sees_too_little_is_refused():
    with pytest.raises(UserError, match=r"network_wh \(64, 32\): expected at least 64 px"):
        ViTPoseConfig(network_wh=(64, 32))


# --- files and use -----------------------------------------------------------------------------

CARD = Card(preset="custom", prior_range_deg=(180.0, 180.0, 180.0), keep=0.6)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_weights(tmp_path / "vitpose.safetensors", rival("vitpose"), CARD)
    return tmp_path / "vitpose.safetensors"


@each
def test_what_is_loaded_predicts_what_was_saved(name, tmp_path):
    net, given = rival(name).eval(), pairs(2, seed=1, wh=WH)
    save_weights(tmp_path / "w.safetensors", net, CARD)
    loaded, card = load_weights(tmp_path / "w.safetensors", expected=TINY[name])
    assert (type(loaded), loaded.config, card) == (type(net), net.config, CARD)
    assert torch.equal(loaded(**given).R, net(**given).R)


@each
def test_halved_weights_are_half_as_large_and_rounded(name, tmp_path, capsys, worst):
    net = rival(name)
    whole, half = tmp_path / "w.safetensors", tmp_path / "half.safetensors"
    save_weights(whole, net, CARD)
    assert halve_weights.main([str(whole), str(half)]) == 0
    assert "MB -> " in capsys.readouterr().out
    assert half.stat().st_size < 0.6 * whole.stat().st_size
    loaded, card = load_weights(half, expected=TINY[name])
    assert card == CARD
    before, after = net.state_dict(), loaded.state_dict()
    assert {x.dtype for x in loaded.parameters()} == {torch.float32}
    assert any(not torch.equal(before[n], after[n]) for n in before)
    errors = [(after[n] - x).abs().max() - x.abs().max() / 2048 for n, x in before.items()]
    worst("rounding of weights beyond a 2048th", torch.stack(errors).clamp(min=0), 1e-7, "-")
    assert all(torch.equal(after[n], x) for n, x in before.items() if x.ndim < 2)


def test_what_cannot_be_halved_is_said(tmp_path, capsys):
    net = rival("vitpose")
    with torch.no_grad():
        net.pose[0].weight[0, 0] = 7e4
    save_weights(tmp_path / "w.safetensors", net, CARD)
    target = tmp_path / "half.safetensors"
    assert halve_weights.main([str(tmp_path / "w.safetensors"), str(target)]) == 2
    assert "'pose.0.weight' reaches 7e+04, beyond the 65,504" in capsys.readouterr().err
    (tmp_path / "x.txt").write_text("no weights")
    for absent in ("x.txt", "absent.safetensors"):
        assert halve_weights.main([str(tmp_path / absent), str(target)]) == 2
        assert "is no safetensors file" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir() if "half" in p.name] == []


def test_weights_of_another_network_are_refused(path):
    with pytest.raises(UserError, match=r"another network: a ViTPoseConfig, expected a RPNetConf"):
        load_weights(path, expected=TINY["rpnet"])
    with pytest.raises(UserError, match=r"another network: depth is 2, expected 3"):
        load_weights(path, expected=replace(TINY["vitpose"], depth=3))


def test_a_rival_is_used_like_the_network(path, tmp_path):
    left, right = np.random.default_rng(0).integers(0, 256, (2, 64, 128, 3), dtype=np.uint8)
    K, prior = intrinsics((128, 64), 90.0), transform(np.eye(3), np.array([-0.8, 0.0, 0.0]))
    estimate = load_model(path).estimate(left, right, K, K, prior)
    assert estimate.match_probability is None
    found = load_method(f"network={path}")(left, right, K, K, prior)
    np.testing.assert_array_equal(found.R, estimate.R)
    np.testing.assert_array_equal(found.t, estimate.t)
    ours = tmp_path / "ours.safetensors"
    save_weights(ours, network(), CARD)
    assert 0 < load_model(ours).estimate(left, right, K, K, prior).match_probability <= 1


@each
def test_t_points_where_a_rival_says_and_is_as_long_as_the_prior_s(name, tmp_path, worst):
    left, right = np.random.default_rng(0).integers(0, 256, (2, 64, 128, 3), dtype=np.uint8)
    K, prior = intrinsics((128, 64), 90.0), transform(np.eye(3), np.array([-0.8, 0.0, 0.0]))
    net = rival(name).eval()
    save_weights(tmp_path / "w.safetensors", net, CARD)
    found = load_model(tmp_path / "w.safetensors").estimate(left, right, K, K, prior).t
    sizing = Sizing(net.config.input_wh, CARD.fit, CARD.keep)
    batch = collate([sized(Pair(left, right, K, K, None, prior, name="x"), sizing)])
    t = net(batch.left, batch.right, batch.K_left, batch.K_right, batch.R_nominal,
            batch.t_nominal).t  # fmt: skip
    if t is None:
        np.testing.assert_array_equal(found, prior[:3, 3])
        return
    t = t[0].detach().numpy()
    assert not np.array_equal(t, prior[:3, 3])
    worst("t as a rival says, 0.8 m long", found - 0.8 * t / np.linalg.norm(t), 1e-12, "m")


def test_a_fit_starts_at_a_rival_s_rotation_and_at_the_calibration_s_t():
    """What it is given as its prior holds t in place."""
    turned = Rotation.from_rotvec([1, -2, 0.5], degrees=True).as_matrix()
    said = PoseEstimate(turned, np.array([-0.5, 0.5, 0.3]))
    K = intrinsics((128, 64), 90.0)
    prior = transform(np.eye(3), np.array([-0.8, 0.0, 0.0]))
    given = []

    def solve(matches, K_left, K_right, start):
        given.append(start)
        raise NoSolution("nothing")

    method = FromMatches("sift", solve, lambda *_: said)
    found = method.of_matches(Matches(*np.zeros((2, 9, 2))), Seconds(), None, None, K, K, prior)
    np.testing.assert_array_equal(given, [transform(said.R, prior[:3, 3])])
    np.testing.assert_array_equal(found.t, said.t)


@pytest.mark.parametrize("name", [*RIVALS, "small-without-flow"])
def test_a_row_without_weights_says_how_to_train_it(name, tmp_path, monkeypatch):
    monkeypatch.setattr(methods, "SHIPPED", tmp_path)
    asked = f"--model {name}" if name in RIVALS else "--preset small --teacher none"
    with pytest.raises(UserError, match=rf"python -m flowrect\.train {asked} --data"):
        load_method(name)


def test_a_rival_is_not_exported(path, tmp_path, capsys):
    assert export_onnx.main([str(path), str(tmp_path / "out.onnx")]) == 2
    assert "holds a ViTPose; expected weights of the paper's network" in capsys.readouterr().err


# --- training ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return road_set(tmp_path_factory.mktemp("set"))


def options(name: str, data: Path, out: Path, **changes: object):
    default = RIVAL_TRAINING[name]
    return replace(
        default, data=data, out=out, model=TINY[name], max_steps=3, val_every=9, val_pairs=3,
        loading=Loading(batch=2, workers=0), **changes,
    )  # fmt: skip


def rows(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def test_a_rival_interrupted_and_resumed_equals_uninterrupted_bit_for_bit(data, tmp_path):
    whole, parts = (options("vitpose", data, tmp_path / n) for n in "ab")
    scores = train.train(whole)
    train.train(replace(parts, minutes=1e-6))
    assert [row["step"] for row in rows(parts.out) if "loss" in row] == [1]
    assert train.train(parts) == scores
    a, b = (load_file(o.out / "last.safetensors") for o in (whole, parts))
    for name, tensor in a.items():
        assert torch.equal(tensor, b[name]), name
    assert {"pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg", "vertical_flow_px"} == set(scores)


def test_the_command_trains_a_rival_and_goes_on(data, tmp_path, capsys):
    command = ["--model", "vitpose", "--data", str(data), "--out", str(tmp_path),
               "--val-pairs", "3", "--loading.batch", "2", "--loading.workers", "0",
               "--model.input-wh", "128", "64", "--model.network-wh", "64", "64",
               "--model.channels", "24", "--model.depth", "2", "--model.hidden", "32"]  # fmt: skip
    for minutes, steps in (("1e-6", [1]), ("0", [1, 2])):
        assert train.main([*command, "--max-steps", "2", "--minutes", minutes]) == 0
        assert [row["step"] for row in rows(tmp_path) if "loss" in row] == steps
    assert "preset vitpose: as asked" in capsys.readouterr().out
    assert {"rotation", "translation"} <= set(rows(tmp_path)[-2])
    loaded, card = load_weights(tmp_path / "best.safetensors")
    assert loaded.config == TINY["vitpose"]
    assert card.translation == "gt"


def test_two_networks_at_once_are_refused(capsys):
    assert train.main(["--model", "rpnet", "--preset", "small", "--data", "x"]) == 2
    assert "both rpnet and small are asked for; expected one" in capsys.readouterr().err


@pytest.mark.parametrize("name, weight", [("rpnet", "rotation"), ("directionnet", "spread")])
def test_a_rival_s_loss_that_is_not_finite_stops(name, weight, data, tmp_path):
    run = options(name, data, tmp_path)
    broken = replace(run, model=replace(run.model, **{weight: float("nan")}))
    with pytest.raises(UserError, match=r"loss is nan, expected a finite number. Its batch is in"):
        train.train(broken)


def test_a_rival_starts_from_given_weights(path, data, tmp_path):
    run = options("vitpose", data, tmp_path / "run", init=str(path), lr=1e-12)
    train.train(replace(run, max_steps=1))
    given, trained = (load_file(p) for p in (path, run.out / "last.safetensors"))
    for name in given:
        if "running" not in name and "num_batches" not in name:
            torch.testing.assert_close(trained[name], given[name], rtol=0, atol=1e-9)
    assert load_weights(run.out / "last.safetensors")[1].samples == 2


def test_each_rival_has_its_own_training():
    assert {name: o.model for name, o in RIVAL_TRAINING.items()} == RIVALS
    assert {name: o.preset for name, o in RIVAL_TRAINING.items()} == {n: n for n in RIVALS}


def test_a_model_s_name_is_a_preset_and_its_fields_are_not():
    given = ["--model", "rpnet", "--model.hidden", "8", "--model=vitpose", "--data", "--x"]
    expected = ["--preset", "rpnet", "--model.hidden", "8", "--preset=vitpose", "--data", "--x"]
    assert train.presets_for_models(given) == expected
