"""Trains the rectifier: ``python -m flowrect.train --data shards/``, or ``torchrun -m …``.

What is minimised and measured is here, the loop in ``flowrect.loop``. Everything that is decided
before it lies in ``flowrect.config.TrainOptions``; ``--preset`` chooses the defaults of all others.
``--model rpnet`` and the like train a rival of the paper's tables, by ``RivalOptions``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import tyro
from torch import Tensor

from flowrect import loop
from flowrect.config import (
    MODELS,
    OVERFIT,
    RIVAL_TRAINING,
    TRAINING,
    PoseOptions,
    RivalOptions,
    TrainOptions,
)
from flowrect.drectify import Rectification, rectify, warp
from flowrect.loading import PairLoader
from flowrect.losses import (
    correspondences_of_flow,
    image_flow_loss,
    matching_loss,
    rotation_loss,
    vertical_flow_loss,
)
from flowrect.metrics import METRIC_WH, angles_deg, exact_vertical_flow, geodesic_deg
from flowrect.model import Prediction
from flowrect.rivals.config import RIVALS
from flowrect.sample import Batch
from flowrect.weights import Card, find_weights, load_weights, save_weights, untrained
from simgen.errors import UserError

if TYPE_CHECKING:
    from flowrect.flow_network import FlowNetwork

OVERFIT_BAR_DEG = 0.02
AnyOptions = TrainOptions | RivalOptions


# --- what is minimised, and what is measured ---------------------------------------------------


def prior_translation(batch: Batch, options: PoseOptions) -> Tensor:
    """t (B, 3) of the prior."""
    if options.translation == "nominal":
        return batch.t_nominal
    assert batch.t is not None, "checked by Task.require"
    return batch.t


def predict(network: torch.nn.Module, batch: Batch, options: PoseOptions) -> Any:
    """One pass, with the nominal rotation as R_init: a Prediction of that network."""
    return network(
        batch.left, batch.right, batch.K_left, batch.K_right, batch.R_nominal,
        prior_translation(batch, options),
    )  # fmt: skip


def loss_terms(
    prediction: Prediction, batch: Batch, options: TrainOptions, teacher: FlowNetwork | None = None
) -> dict[str, Tensor]:
    """The weighted terms of the loss (Eq. 15); their sum is minimised."""
    weights, truth = options.loss, batch.truth
    terms = {}
    if weights.rotation:
        assert batch.R is not None, "checked by RectifierTask.require"
        terms["rotation"] = rotation_loss(batch.R, prediction.R, weight=weights.rotation)
    if teaches(options):
        terms["flow"] = flow_term(prediction, batch, options, teacher)
    if weights.matching and truth is not None:
        terms["matching"] = weights.matching * matching_loss(
            prediction.log_matches, truth, prediction.rectification, prediction.feature_wh
        )
    return terms


def teaches(options: TrainOptions) -> bool:
    """Whether vertical flow is minimised."""
    return options.teacher != "none" and options.loss.flow > 0


def flow_term(
    prediction: Prediction, batch: Batch, options: TrainOptions, teacher: FlowNetwork | None
) -> Tensor:
    """The vertical flow that the teacher sees in pairs as the prediction rectifies them."""
    weight = options.loss.flow
    K_left, K_right = batch.K_left_metric, batch.K_right_metric
    t = prior_translation(batch, options)
    rect = rectify(prediction.R, t, K_left, K_right, METRIC_WH)
    if teacher is None:
        assert batch.truth is not None, "checked by RectifierTask.require"
        return vertical_flow_loss(rect, batch.truth, K_left, K_right, METRIC_WH, weight=weight)
    through = options.teacher == "raft"
    with torch.set_grad_enabled(through and torch.is_grad_enabled()):
        left, valid_left = warp(batch.left_metric, K_left, rect.R_left, rect.K_new, METRIC_WH)
        right, valid_right = warp(batch.right_metric, K_right, rect.R_right, rect.K_new, METRIC_WH)
        flow = _flow_of(teacher, left, right, _right_first(rect, t))
    if through:
        return image_flow_loss(flow, valid_left & valid_right, rect.vertical, weight=weight)
    matches = correspondences_of_flow(flow, rect)
    return vertical_flow_loss(rect, matches, K_left, K_right, METRIC_WH, weight=weight)


def _raft(weights: str) -> FlowNetwork:
    """The teacher. What it needs of torchvision, 2 s of every start, is loaded only here."""
    from flowrect.flow_network import load_flow

    return load_flow(weights)


def _right_first(rect: Rectification, t: Tensor) -> Tensor:
    """Whether the first camera is the right one of a rig (B,), as with ``both_directions``."""
    baseline = (rect.R_right @ t[..., None])[..., 0]
    return ~rect.vertical & (baseline[..., 0] > 0)


def _flow_of(teacher: FlowNetwork, left: Tensor, right: Tensor, mirror: Tensor) -> Tensor:
    """The teacher's flow, wherever it runs, where the images are.

    It knows rigs whose left camera comes first, in which points move to the left. Others (B,) are
    mirrored for it.
    """
    device, mirror = next(teacher.parameters()).device, mirror[:, None, None, None]
    left, right = (torch.where(mirror, x.flip(-1), x) for x in (left, right))
    flow = teacher.flow(left.to(device), right.to(device)).to(left.device)
    mirrored_back = flow.flip(-1) * flow.new_tensor([-1.0, 1.0])[:, None, None]
    return torch.where(mirror, mirrored_back, flow)


@torch.inference_mode()
def validate(
    network: torch.nn.Module, loader: PairLoader, options: PoseOptions
) -> dict[str, float]:
    """Mean |angle| per axis and geodesic [°], and vertical flow [px], over the loader's pairs."""
    device = next(network.parameters()).device
    rows = []
    network.eval()
    for batch in loader:
        batch = batch.to(device)
        R, t = predict(network, batch, options).R, prior_translation(batch, options)
        assert batch.R is not None, "checked by Task.require"
        columns = [angles_deg(batch.R, R).abs(), geodesic_deg(batch.R, R)[:, None]]
        if batch.truth is not None:
            rect = rectify(R, t, batch.K_left_metric, batch.K_right_metric, METRIC_WH)
            columns.append(exact_vertical_flow(rect, batch.truth)[:, None])
        rows.append(torch.cat(columns, 1))
    network.train()
    names = ("pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg", "vertical_flow_px")
    return dict(zip(names, torch.cat(rows).mean(0).tolist(), strict=False))


class RectifierTask:
    """The paper's network and losses, as ``flowrect.loop`` trains them."""

    score = "geodesic_deg"

    def __init__(self, options: TrainOptions) -> None:
        if not any((options.loss.rotation, options.loss.matching, teaches(options))):
            raise UserError(
                "nothing to minimise: --loss.rotation and --loss.matching are 0, and --loss.flow "
                "is, or --teacher is none. Take one of them."
            )
        self.options = options
        self.model, self._before = initial_model(options)
        if options.overfit:  # it asks what training reaches, which knows the first pass only
            self.model.passes = 1
        self.input_wh = options.model.input_wh
        by_raft = "raft" in options.teacher and teaches(options)
        self._teacher = _raft(options.flow_weights) if by_raft else None

    def require(self, batch: Batch) -> None:
        """Raises where the data lack what the losses need."""
        options = self.options
        require_pose(batch, options)
        exact = options.teacher == "exact" and teaches(options)
        if batch.truth is None and (exact or options.loss.matching):
            raise UserError(
                f"{options.data}: {batch.names[0]} has no depth, so there is no exact flow; train "
                "with --teacher raft, raft-matches or none, and --loss.matching 0."
            )

    def terms(self, network: torch.nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The weighted terms of the loss."""
        if self._teacher is not None:
            self._teacher.to(self.options.teacher_device or batch.left.device)
        return loss_terms(predict(network, batch, self.options), batch, self.options, self._teacher)

    def validate(self, loader: PairLoader) -> dict[str, float]:
        """Angles and vertical flow."""
        return validate(self.model, loader, self.options)

    def save(self, path: Path, seen: loop.Seen) -> None:
        """Writes the weights with their card."""
        save_weights(path, self.model, make_card(self.options, seen, self._before))


class RivalTask:
    """A rival and the losses of its own paper, as ``flowrect.loop`` trains them."""

    score = "geodesic_deg"

    def __init__(self, options: RivalOptions) -> None:
        self.options = options
        model, self._before = initial_model(options)
        self.model = model.to(memory_format=torch.channels_last)  # up to a third faster
        self.input_wh = options.model.input_wh

    def require(self, batch: Batch) -> None:
        """Raises where there is no true pose."""
        require_pose(batch, self.options)

    def terms(self, network: torch.nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The weighted terms of the loss."""
        assert batch.R is not None, "checked by Task.require"
        assert batch.t is not None, "checked by Task.require"
        prediction = predict(network, batch, self.options)
        terms: dict[str, Tensor] = self.model.losses(prediction, batch.R, batch.t)
        return terms

    def validate(self, loader: PairLoader) -> dict[str, float]:
        """Angles and vertical flow."""
        return validate(self.model, loader, self.options)

    def save(self, path: Path, seen: loop.Seen) -> None:
        """Writes the weights with their card."""
        save_weights(path, self.model, make_card(self.options, seen, self._before))


def require_pose(batch: Batch, options: PoseOptions) -> None:
    """Raises where there is no true pose to train on."""
    if batch.R is None:
        raise UserError(
            f"{options.data}: {batch.names[0]} has no true pose to train on; if the calibration "
            "of the folder is the truth, say --trusted."
        )


def make_card(options: AnyOptions, seen: loop.Seen, before: Card | None) -> Card:
    """What is known of the weights now; ``before`` is the card of what training began with."""
    presets = {**MODELS, **RIVALS}
    return Card(
        preset=next((n for n, model in presets.items() if model == options.model), "custom"),
        prior_range_deg=seen.prior_range_deg,
        samples=seen.samples + (before.samples if before else 0),
        hours=round(seen.hours + (before.hours if before else 0.0), 2),
        data=str(options.data.name),
        translation=options.translation,
        fit=options.fit,
        keep=seen.keep,
    )


def initial_model(options: AnyOptions) -> tuple[Any, Card | None]:
    """A fresh network, or the one of ``--init`` and its card."""
    if not options.init:
        return untrained(options.model), None
    network, card = load_weights(find_weights(options.init), expected=options.model)
    return network.train(), card


def as_initial(options: AnyOptions) -> AnyOptions:
    """The options with the window that the weights of ``--init`` were trained on."""
    if not options.init:
        return options
    card = load_weights(find_weights(options.init), expected=options.model)[1]
    if card.fit != options.fit or options.keep not in (0.0, card.keep):
        raise UserError(
            f"{options.init} was trained with --fit {card.fit} --keep {card.keep:g}, not --fit "
            f"{options.fit} --keep {options.keep:g}: give the same, or train from the start."
        )
    return replace(options, keep=card.keep)


def train(options: AnyOptions) -> dict[str, float]:
    """Trains until the epochs, steps or minutes are over; returns the last validation."""
    options = as_initial(options)
    return loop.train(lambda: make_task(options), options)


def make_task(options: AnyOptions) -> loop.Task:
    """The paper's network, or a rival."""
    return RivalTask(options) if isinstance(options, RivalOptions) else RectifierTask(options)


# --- the command -------------------------------------------------------------------------------


def presets_for_models(arguments: Sequence[str]) -> list[str]:
    """The arguments with ``--preset NAME`` wherever ``--model NAME`` says the same."""
    return [
        "--preset" + a.removeprefix("--model") if a.partition("=")[0] == "--model" else a
        for a in arguments
    ]


def choose_preset(arguments: Sequence[str]) -> tuple[str, str]:
    """The preset that the defaults come from, and why."""
    for flag, value in zip(arguments, [*arguments[1:], ""], strict=False):
        name, _, joined = flag.partition("=")
        if name == "--preset":
            return joined or value, "as asked"
    if torch.cuda.is_available():
        return "paper", "there is a GPU"
    return "small", "there is no GPU; paper needs one"


def parsed(arguments: Sequence[str], preset: str) -> AnyOptions:
    """The options, with the preset's defaults, and with --overfit those of its schedule."""
    presets: dict[str, AnyOptions] = {**TRAINING, **RIVAL_TRAINING}
    default = presets.get(preset, TRAINING["small"])
    options = _parsed(arguments, default)
    return _parsed(arguments, replace(default, **OVERFIT)) if options.overfit else options


def _parsed(arguments: Sequence[str], default: AnyOptions) -> AnyOptions:
    """A misspelt name is for tyro to refuse."""
    command: dict[str, Any] = {"args": arguments, "prog": "flowrect.train"}
    if isinstance(default, RivalOptions):
        command["config"] = (tyro.conf.AvoidSubcommands,)  # the preset says which rival it is
    return tyro.cli(type(default), default=default, **command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something, 1 if an overfit check fails."""
    arguments = presets_for_models(sys.argv[1:] if arguments is None else arguments)
    preset, why = choose_preset(arguments)
    options = parsed(arguments, preset)
    print(f"preset {options.preset}: {why}")
    try:
        if options.preset != preset:
            raise UserError(f"both {preset} and {options.preset} are asked for; expected one.")
        scores = train(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(", ".join(f"{name} {value:.3f}" for name, value in scores.items()))
    if not options.overfit or not scores:  # only the main process has scores
        return 0
    return int(scores["geodesic_deg"] >= OVERFIT_BAR_DEG)


if __name__ == "__main__":
    sys.exit(main())
