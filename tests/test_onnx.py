"""An exported network says what torch says."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from tiny_network import TINY, TINY_PAPER, network, pairs, predict

from flowrect.export_onnx import INPUTS, OUTPUTS, export, main
from flowrect.weights import Card, save_weights

CARD = Card(preset="custom", prior_range_deg=(2.0, 2.0, 2.0), keep=0.9)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(replace(TINY, passes=1), id="displacement"),
        pytest.param(TINY, id="displacement, two passes", marks=pytest.mark.slow),
        pytest.param(TINY_PAPER, id="conv3d", marks=pytest.mark.slow),
    ],
)
def exported(request, tmp_path_factory):
    """A network with a head that says something, and the session that runs its file."""
    net = network(replace(request.param, zero_head=False))
    path = tmp_path_factory.mktemp("onnx") / "tiny.onnx"
    export(net, CARD, path)
    return net, path, onnxruntime.InferenceSession(path)


def test_an_exported_network_says_what_torch_says(exported, worst):
    net, _, session = exported
    for seed in range(3):
        given = pairs(1, seed=seed)
        expected = predict(net, given)
        R, match_probability = session.run(None, {name: given[name].numpy() for name in INPUTS})
        worst("R by ONNX against torch", R - expected.R.numpy(), 1e-6, "-")
        likely = expected.log_matches.amax(-1).exp().mean(-1)
        np.testing.assert_allclose(match_probability, likely.numpy(), rtol=1e-4)
        assert np.abs(R - given["R_init"].numpy()).max() > 1e-3  # it says something


def test_the_file_is_whole_and_carries_the_card(exported):
    _, path, session = exported
    assert [x.name for x in session.get_inputs()] == list(INPUTS)
    assert [x.name for x in session.get_outputs()] == list(OUTPUTS)
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no data beside it
    metadata = {p.key: p.value for p in onnx.load(path).metadata_props}
    assert json.loads(metadata["flowrect_card"]) == json.loads(json.dumps(asdict(CARD)))


@pytest.mark.parametrize(
    "weights, out, message",
    [
        ("tiny.safetensors", "there.onnx", "there.onnx exists. Choose another name"),
        ("tiny.safetensors", "no/where.onnx", "no such folder to write where.onnx to"),
        ("absent", "x.onnx", "expected a file or one of the shipped"),
        ("model.pt", "x.onnx", "Pickles (.pt, .pth, .ckpt) are refused"),
    ],
)
def test_what_cannot_be_exported_is_said(weights, out, message, tmp_path: Path, capsys):
    save_weights(tmp_path / "tiny.safetensors", network(), CARD)
    torch.save({}, tmp_path / "model.pt")
    (tmp_path / "there.onnx").touch()
    weights = str(tmp_path / weights) if "." in weights else weights
    assert main([weights, str(tmp_path / out)]) == 2
    assert message in capsys.readouterr().err
