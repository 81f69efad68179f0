"""Training: ``python -m flowrect.train --data shards/``, or ``torchrun -m flowrect.train …``.

One flat loop. Everything that is decided before it lies in ``flowrect.config.TrainOptions``;
``--preset`` chooses the defaults of all the others.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from accelerate import Accelerator
from safetensors.torch import save_file
from torch import Tensor

from flowrect import checkpoint
from flowrect.config import MODELS, TRAINING, TrainOptions
from flowrect.drectify import rectify
from flowrect.geometry import angles_per_axis_rad
from flowrect.loading import Loading, PairLoader
from flowrect.losses import matching_loss, rotation_loss, vertical_flow_loss
from flowrect.metrics import METRIC_WH, angles_deg, exact_vertical_flow, geodesic_deg
from flowrect.model import Prediction, Rectifier
from flowrect.resize import Sizing
from flowrect.runlog import RunLog
from flowrect.sample import Batch
from flowrect.sources import Pairs, open_source
from flowrect.turn import largest_keep
from flowrect.weights import Card, find_weights, load_weights, save_weights
from simgen.errors import UserError
from simgen.shards import MANIFEST

CHECKPOINT = "checkpoint.pt"
OVERFIT_BAR_DEG = 0.02


# --- what is minimised, and what is measured ---------------------------------------------------


def prior_translation(batch: Batch, options: TrainOptions) -> Tensor:
    """t (B, 3) of the prior."""
    if options.translation == "nominal":
        return batch.t_nominal
    assert batch.t is not None, "checked by require_truth"
    return batch.t


def predict(network: torch.nn.Module, batch: Batch, options: TrainOptions) -> Prediction:
    """One pass, with the nominal rotation as R_init."""
    prediction: Prediction = network(
        batch.left, batch.right, batch.K_left, batch.K_right, batch.R_nominal,
        prior_translation(batch, options),
    )  # fmt: skip
    return prediction


def loss_terms(prediction: Prediction, batch: Batch, options: TrainOptions) -> dict[str, Tensor]:
    """The weighted terms of the loss (Eq. 15); their sum is minimised."""
    weights, truth = options.loss, batch.truth
    assert batch.R is not None, "checked by require_truth"
    terms = {"rotation": rotation_loss(batch.R, prediction.R, weight=weights.rotation)}
    if options.teacher == "exact" and truth is not None:
        rect = rectify(
            prediction.R, prior_translation(batch, options), batch.K_left_metric,
            batch.K_right_metric, METRIC_WH,
        )  # fmt: skip
        terms["flow"] = vertical_flow_loss(rect, truth, METRIC_WH, weight=weights.flow)
    if weights.matching and truth is not None:
        terms["matching"] = weights.matching * matching_loss(
            prediction.log_matches, truth, prediction.rectification, prediction.feature_wh
        )
    return terms


@torch.inference_mode()
def validate(network: Rectifier, loader: PairLoader, options: TrainOptions) -> dict[str, float]:
    """Mean |angle| per axis and geodesic [°], and vertical flow [px], over the loader's pairs."""
    device = next(network.parameters()).device
    rows = []
    for batch in loader:
        batch = batch.to(device)
        R, t = predict(network, batch, options).R, prior_translation(batch, options)
        assert batch.R is not None, "checked by require_truth"
        columns = [angles_deg(batch.R, R).abs(), geodesic_deg(batch.R, R)[:, None]]
        if batch.truth is not None:
            rect = rectify(R, t, batch.K_left_metric, batch.K_right_metric, METRIC_WH)
            columns.append(exact_vertical_flow(rect, batch.truth)[:, None])
        rows.append(torch.cat(columns, 1))
    names = ("pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg", "vertical_flow_px")
    return dict(zip(names, torch.cat(rows).mean(0).tolist(), strict=False))


def require_truth(batch: Batch, options: TrainOptions) -> None:
    """Raises where the data lack what the losses need."""
    if batch.R is None:
        raise UserError(
            f"{options.data}: {batch.names[0]} has no true pose to train on; for a folder whose "
            "calibration is the truth, see flowrect.sources."
        )
    if batch.truth is None and (options.teacher == "exact" or options.loss.matching):
        raise UserError(
            f"{options.data}: {batch.names[0]} has no depth, so there is no exact flow; train with "
            "--teacher none --loss.matching 0."
        )


# --- the run -----------------------------------------------------------------------------------


def train(options: TrainOptions) -> dict[str, float]:
    """Trains until the epochs, steps or minutes are over; returns the last validation."""
    started = time.monotonic()
    accelerator = Accelerator(mixed_precision=options.precision)
    options.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.loading.seed)
    model = initial_model(options)
    pairs = open_pairs(options)
    options = replace(options, keep=options.keep or largest_safe_keep(pairs, options))
    loader, val_loader = make_loaders(pairs, options, accelerator)
    network, optimiser = accelerator.prepare(
        model, torch.optim.Adam(model.parameters(), lr=options.lr)
    )
    run = Run(options, accelerator, accelerator.unwrap_model(network), optimiser, loader)
    run.resume()
    epoch_steps = max(1, len(loader) // options.accumulate)
    last_step = options.max_steps or options.epochs * epoch_steps

    with RunLog(options.out, run.step, last_step, active=accelerator.is_main_process) as log, \
         stop_on_interrupt() as interrupted:  # fmt: skip
        for count, batch in enumerate(endless(loader, until=lambda: run.step >= last_step), 1):
            require_truth(batch, options)
            batch = batch.to(accelerator.device)
            terms = loss_terms(predict(network, batch, options), batch, options)
            total = torch.stack(list(terms.values())).sum()
            stop_if_not_finite(total, batch, options.out)
            accelerator.backward(total / options.accumulate)
            run.note_prior_range(batch)
            if count % options.accumulate:
                continue

            accelerator.clip_grad_norm_(network.parameters(), options.clip)
            lr = learning_rate(run.step, last_step, options)
            for group in optimiser.param_groups:
                group["lr"] = lr
            optimiser.step()
            optimiser.zero_grad()
            run.step += 1

            late = options.minutes and time.monotonic() - started > 60 * options.minutes
            means, stopping = over_processes(terms, bool(interrupted() or late), accelerator)
            log.step(run.step, {**means, "lr": lr}, epoch_steps)
            if run.step % options.val_every and not stopping and run.step < last_step:
                continue
            if accelerator.is_main_process:
                run.scores = validate(run.model, val_loader, options)
                log.validation(run.step, run.scores)
            run.save()
            if stopping:
                break
    return run.scores


@dataclass
class Run:
    """What a checkpoint holds, and where it goes."""

    options: TrainOptions
    accelerator: Accelerator
    model: Rectifier
    optimiser: torch.optim.Optimizer
    loader: PairLoader
    step: int = 0
    """optimiser steps done"""
    best: float = float("inf")
    """mean geodesic error of the best validation [°]"""
    scores: dict[str, float] = field(default_factory=dict)
    """of the last validation; main process only"""
    prior_range_deg: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """(3,) largest |angle| between prior and truth per axis, of this process's pairs"""

    def note_prior_range(self, batch: Batch) -> None:
        """Widens the range by the priors of a batch."""
        assert batch.R is not None, "checked by require_truth"
        seen = angles_per_axis_rad(batch.R, batch.R_nominal).abs().amax(0).rad2deg().cpu()
        self.prior_range_deg = torch.maximum(self.prior_range_deg, seen)

    def save(self) -> None:
        """Checkpoint and last weights, and the best ones if the last scores are."""
        shared = self.accelerator.gather(self.prior_range_deg[None].to(self.accelerator.device))
        self.prior_range_deg = shared.amax(0).cpu()
        if not self.accelerator.is_main_process:
            return
        out, card = self.options.out, self._card()
        if self.scores["geodesic_deg"] < self.best:
            self.best = self.scores["geodesic_deg"]
            save_weights(out / "best.safetensors", self.model, card)
        save_weights(out / "last.safetensors", self.model, card)
        checkpoint.save(out / CHECKPOINT, self._state())

    def resume(self) -> None:
        """Goes on from the checkpoint of the run's folder, if there is one."""
        path = self.options.out / CHECKPOINT
        if not path.is_file():
            return
        state = checkpoint.load(path, plain(self.options))
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.loader.load_state_dict(state["loader"])
        if self.accelerator.scaler is not None:
            self.accelerator.scaler.load_state_dict(state["scaler"])
        self.step, self.best, self.scores = state["step"], state["best"], state["scores"]
        self.prior_range_deg = state["prior_range_deg"]
        checkpoint.restore_random_state(state["random"])

    def _state(self) -> dict[str, Any]:
        scaler = self.accelerator.scaler
        return {
            "options": plain(self.options),
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "loader": self.loader.state_dict(),
            "scaler": scaler.state_dict() if scaler else None,
            "step": self.step,
            "best": self.best,
            "scores": self.scores,
            "prior_range_deg": self.prior_range_deg,
            "random": checkpoint.random_state(),
        }

    def _card(self) -> Card:
        o, (x, y, z) = self.options, self.prior_range_deg.tolist()
        return Card(
            preset=next((n for n, model in MODELS.items() if model == o.model), "custom"),
            prior_range_deg=(x, y, z),
            samples=self.step * o.accumulate * o.loading.batch,
            data=str(o.data.name),
            translation=o.translation,
            fit=o.fit,
            keep=o.keep,
        )


# --- before the loop ---------------------------------------------------------------------------


def initial_model(options: TrainOptions) -> Rectifier:
    """A fresh network, or the one of ``--init``."""
    if not options.init:
        return Rectifier(options.model)
    return load_weights(find_weights(options.init), expected=options.model)[0].train()


def open_pairs(options: TrainOptions) -> Pairs[Any]:
    """All pairs that training may see."""
    split = "train" if (options.data / MANIFEST).is_file() else None
    return open_source(options.data, split=split)


def largest_safe_keep(pairs: Pairs[Any], options: TrainOptions) -> float:
    """Share of the window that stays filled when both the old and the new turn are at the limit."""
    if options.overfit or not options.augmentation.turn_deg:
        return 1.0
    sizing = Sizing(options.model.input_wh, options.fit)
    return largest_keep(pairs[0], sizing, 2 * options.augmentation.turn_deg)


def make_loaders(
    pairs: Pairs[Any], options: TrainOptions, accelerator: Accelerator
) -> tuple[PairLoader, PairLoader]:
    """Training batches of this process, and validation pairs as they stand."""
    train_pairs, val_pairs = divided(pairs, options)
    sizing = Sizing(options.model.input_wh, options.fit, options.keep)
    loading, augmentation = options.loading, None if options.overfit else options.augmentation
    if options.overfit:
        loading = replace(loading, batch=min(loading.batch, options.overfit))
    val_loading = Loading(loading.batch, workers=0, shuffle=False, drop_last=False)
    share = {"rank": accelerator.process_index, "num_ranks": accelerator.num_processes}
    return (
        PairLoader(train_pairs, sizing, augmentation, loading, **share),
        PairLoader(val_pairs, sizing, None, val_loading),
    )


def divided(pairs: Pairs[Any], options: TrainOptions) -> tuple[Pairs[Any], Pairs[Any]]:
    """Pairs to train on and to validate on."""
    if options.overfit:
        return pairs[: options.overfit], pairs[: options.overfit]
    if len(pairs) <= options.val_pairs:
        raise UserError(
            f"{options.data}: {len(pairs)} pairs, of which the last {options.val_pairs} are for "
            "validation; expected more. Take more data or a smaller --val-pairs."
        )
    return pairs[: -options.val_pairs], pairs[-options.val_pairs :]


# --- in the loop -------------------------------------------------------------------------------


def endless(loader: PairLoader, *, until: Callable[[], bool]) -> Iterator[Batch]:
    """Epoch after epoch."""
    while not until():
        for batch in loader:
            if until():
                return
            yield batch


def learning_rate(step: int, last_step: int, options: TrainOptions) -> float:
    """Of the step after ``step``: linear warm-up times exponential decay."""
    warmup = min(1.0, (step + 1) / max(1, options.warmup_steps))
    return options.lr * warmup * float(options.lr_final ** (step / last_step))


def over_processes(
    terms: dict[str, Tensor], stop: bool, accelerator: Accelerator
) -> tuple[dict[str, float], bool]:
    """Mean of each term over all processes, their sum, and whether any wants to stop."""
    values = [*(x.detach().double() for x in terms.values())]
    vector = torch.stack([*values, values[0].new_tensor(float(stop))])
    *means, stopping = accelerator.reduce(vector, "mean").tolist()
    return {"loss": sum(means), **dict(zip(terms, means, strict=True))}, stopping > 0


def stop_if_not_finite(total: Tensor, batch: Batch, out: Path) -> None:
    """Raises, with the batch on disk, if the loss is NaN or infinite."""
    if torch.isfinite(total):
        return
    path = out / "bad_batch.safetensors"
    tensors = {k: v.cpu().contiguous() for k, v in vars(batch).items() if isinstance(v, Tensor)}
    save_file(tensors, path, {"names": json.dumps(batch.names)})
    raise UserError(
        f"the loss is {total.item()}, expected a finite number. Its batch is in {path}; the last "
        "checkpoint is untouched. A smaller --lr, or --precision no, are what usually helps."
    )


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether Ctrl-C or SIGTERM came; a second Ctrl-C stops at once."""
    came: list[int] = []

    def note(number: int, _: object) -> None:
        came.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    former = {n: signal.signal(n, note) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def plain(options: TrainOptions) -> dict[str, Any]:
    """The options as values that JSON and a checkpoint hold."""
    values: dict[str, Any] = json.loads(json.dumps(asdict(options), default=str))
    return values


# --- the command -------------------------------------------------------------------------------


def choose_preset(arguments: Sequence[str]) -> tuple[str, str]:
    """The preset that the defaults come from, and why."""
    for flag, value in zip([*arguments, ""], [*arguments[1:], "", ""], strict=True):
        name, _, joined = flag.partition("=")
        if name == "--preset":
            return joined or value, "as asked"
    if torch.cuda.is_available():
        return "paper", "there is a GPU"
    return "small", "there is no GPU; paper needs one"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something, 1 if an overfit check fails."""
    arguments = sys.argv[1:] if arguments is None else arguments
    preset, why = choose_preset(arguments)
    default = TRAINING.get(preset, TRAINING["small"])  # a misspelt name is for tyro to refuse
    options = tyro.cli(TrainOptions, default=default, args=arguments, prog="flowrect.train")
    print(f"preset {options.preset}: {why}")
    try:
        scores = train(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(", ".join(f"{name} {value:.3f}" for name, value in scores.items()))
    return int(bool(options.overfit) and scores["geodesic_deg"] >= OVERFIT_BAR_DEG)


if __name__ == "__main__":
    sys.exit(main())
