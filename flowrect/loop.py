"""The training loop: one for every network, exact when it resumes.

What is trained is a :class:`Task`; how, a :class:`flowrect.config.LoopOptions`. Nothing else
differs between ``flowrect.train`` and ``flowrect.train_flow``.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from accelerate import Accelerator
from safetensors.torch import save_file
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from flowrect import checkpoint
from flowrect.config import LoopOptions
from flowrect.files import make_folder
from flowrect.geometry import angles_per_axis_rad
from flowrect.loading import Loading, PairLoader
from flowrect.memory import keep_freed_memory
from flowrect.resize import Sizing
from flowrect.runlog import RunLog, Stopwatch
from flowrect.sample import Batch
from flowrect.sources import Pairs, open_source
from flowrect.turn import largest_keep
from simgen.errors import UserError
from simgen.shards import MANIFEST

CHECKPOINT = "checkpoint.pt"


@dataclass(frozen=True)
class Seen:
    """What a network has been trained with, for the card of its weights."""

    samples: int
    """pairs, over all processes"""
    prior_range_deg: tuple[float, float, float]
    """largest |angle| between prior and truth about x, y, z"""
    keep: float
    """share of the window's sides that was kept"""
    hours: float
    """that training took, with validations, in all its runs"""


class Task(Protocol):
    """A network and what it is trained for."""

    input_wh: tuple[int, int]
    """of ``Batch.left``"""
    score: str
    """name of the validation's figure that chooses the best weights: the lower the better"""

    @property
    def model(self) -> torch.nn.Module:
        """The network."""

    def require(self, batch: Batch) -> None:
        """Raises UserError where the data lack what the losses need."""

    def terms(self, network: torch.nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The weighted terms of the loss; ``network`` is the model, wrapped for its device."""

    def validate(self, loader: PairLoader) -> dict[str, float]:
        """Figures over the loader's pairs."""

    def save(self, path: Path, seen: Seen) -> None:
        """Writes the model's weights."""


def train(make_task: Callable[[], Task], options: LoopOptions) -> dict[str, float]:
    """Trains until the epochs, steps or minutes are over; returns the last validation.

    ``make_task`` is called once the random numbers are seeded.
    """
    _require_sensible(options)
    started = time.monotonic()
    keep_freed_memory()
    accelerator = make_accelerator(options)
    make_folder(options.out)
    torch.manual_seed(options.loading.seed)
    task = make_task()
    pairs = open_pairs(options)
    keep = options.keep or largest_safe_keep(pairs, task.input_wh, options)
    options = replace(options, keep=keep)
    loader, val_loader = make_loaders(pairs, task.input_wh, options, accelerator)
    model = task.model
    network, optimiser = accelerator.prepare(
        model, torch.optim.Adam(model.parameters(), lr=options.lr)
    )
    run = Run(options, accelerator, task, optimiser, loader, pairs.fingerprint, started)
    run.resume()
    epoch_steps = max(1, len(loader) // options.accumulate)
    last_step = options.max_steps or options.epochs * epoch_steps

    with RunLog(options.out, run.step, last_step, active=accelerator.is_main_process) as log, \
         stop_on_interrupt() as interrupted:  # fmt: skip
        summed: dict[str, Tensor] = {}
        watch = Stopwatch()
        batches = endless(loader, until=lambda: run.step >= last_step or run.spent)
        for count, batch in enumerate(watch.waiting_for(batches), 1):
            task.require(batch)
            batch = batch.to(accelerator.device)
            terms = task.terms(network, batch)
            total = torch.stack(list(terms.values())).sum()
            stop_if_not_finite("loss", total, batch, options.out)
            accelerator.backward(total / options.accumulate)
            run.note_prior_range(batch)
            share = {k: x.detach() / options.accumulate for k, x in terms.items()}
            summed = {k: x + summed.get(k, 0.0) for k, x in share.items()}
            if count % options.accumulate:
                continue

            norm = accelerator.clip_grad_norm_(network.parameters(), options.clip)
            if norm is not None and accelerator.scaler is None:  # a scaler skips such a step
                stop_if_not_finite("gradient", norm, batch, options.out)
            lr = learning_rate(run.step, last_step, options)
            run.update(lr)
            means, stopping = over_processes(summed, interrupted() or run.late, accelerator)
            summed = {}
            log.step(run.step, {**means, "lr": lr, **watch.lap()}, epoch_steps)
            if run.step % options.val_every and not stopping and run.step < last_step:
                continue
            run.validate(val_loader, log)
            run.save()
            if stopping:
                break
            watch.restart()
    return run.scores


@dataclass
class Run:
    """What a checkpoint holds, and where it goes."""

    options: LoopOptions
    accelerator: Accelerator
    task: Task
    optimiser: torch.optim.Optimizer
    loader: PairLoader
    fingerprint: str
    """of the pairs"""
    started: float
    """time.monotonic() [s]"""
    step: int = 0
    """optimiser steps done"""
    best: float = float("inf")
    """the task's score in the best validation"""
    scores: dict[str, float] = field(default_factory=dict)
    """of the last validation; main process only"""
    prior_range_deg: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """(3,) largest |angle| between prior and truth per axis, of this process's pairs"""
    hours_before: float = 0.0
    """of the runs that this one goes on from"""

    def __post_init__(self) -> None:
        self._average = average_of(self.task.model, self.options.average)

    def update(self, lr: float) -> None:
        """Takes a step along the gradients that were gathered."""
        for group in self.optimiser.param_groups:
            group["lr"] = lr
        self.optimiser.step()
        self.optimiser.zero_grad()
        if self._average is not None:
            self._average.update_parameters(self.task.model)
        self.step += 1

    @contextmanager
    def averaged_weights(self) -> Iterator[None]:
        """The model has its averaged weights meanwhile, if they are averaged."""
        if self._average is None:
            yield
            return
        model = self.task.model
        own = {name: x.clone() for name, x in model.state_dict().items()}
        model.load_state_dict(self._average.module.state_dict())
        try:
            yield
        finally:
            model.load_state_dict(own)

    def note_prior_range(self, batch: Batch) -> None:
        """Widens the range by the priors of a batch."""
        assert batch.R is not None, "checked by Task.require"
        seen = angles_per_axis_rad(batch.R, batch.R_nominal).abs().amax(0).rad2deg().cpu()
        self.prior_range_deg = torch.maximum(self.prior_range_deg, seen)

    def validate(self, loader: PairLoader, log: RunLog) -> None:
        """Scores the averaged weights, if they are averaged, and saves them."""
        with self.averaged_weights():
            if self.accelerator.is_main_process:
                self.scores = self.task.validate(loader)
                log.validation(self.step, self.scores)
            self.save_weights()

    def save_weights(self) -> None:
        """The last weights, and the best ones if the last scores are."""
        shared = self.accelerator.gather(self.prior_range_deg[None].to(self.accelerator.device))
        self.prior_range_deg = shared.amax(0).cpu()
        if not self.accelerator.is_main_process:
            return
        out, seen = self.options.out, self._seen()
        if self.scores[self.task.score] < self.best:
            self.best = self.scores[self.task.score]
            self.task.save(out / "best.safetensors", seen)
        self.task.save(out / "last.safetensors", seen)

    def save(self) -> None:
        """The checkpoint, which goes with the weights that were saved before it."""
        if self.accelerator.is_main_process:
            checkpoint.save(self.options.out / CHECKPOINT, self._state())

    def resume(self) -> None:
        """Goes on from the checkpoint of the run's folder, if there is one."""
        path = self.options.out / CHECKPOINT
        if not path.is_file():
            return
        state = checkpoint.load(path, plain(self.options), self.fingerprint)
        self.task.model.load_state_dict(state["model"])
        if self._average is not None:
            self._average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.loader.load_state_dict(state["loader"])
        if self.accelerator.scaler is not None:
            self.accelerator.scaler.load_state_dict(state["scaler"])
        self.step, self.best, self.scores = state["step"], state["best"], state["scores"]
        self.prior_range_deg = state["prior_range_deg"]
        self.hours_before = state["hours"]
        checkpoint.restore_random_state(state["random"])

    def _state(self) -> dict[str, Any]:
        scaler = self.accelerator.scaler
        return {
            "options": plain(self.options),
            "fingerprint": self.fingerprint,
            "model": self.task.model.state_dict(),
            "average": self._average.state_dict() if self._average else None,
            "optimiser": self.optimiser.state_dict(),
            "loader": self.loader.state_dict(),
            "scaler": scaler.state_dict() if scaler else None,
            "step": self.step,
            "best": self.best,
            "scores": self.scores,
            "prior_range_deg": self.prior_range_deg,
            "hours": self.hours,
            "random": checkpoint.random_state(),
        }

    def _seen(self) -> Seen:
        o, (x, y, z) = self.options, self.prior_range_deg.tolist()
        return Seen(self.step * o.accumulate * o.loading.batch, (x, y, z), o.keep, self.hours)

    @property
    def hours(self) -> float:
        """Of training so far."""
        return self.hours_before + (time.monotonic() - self.started) / 3600

    @property
    def late(self) -> bool:
        """Whether the time is up, by the clock of this process."""
        return 0 < self.options.minutes <= 60 * self.hours

    @property
    def spent(self) -> bool:
        """Whether the time was up before this run began; all processes agree."""
        return 0 < self.options.minutes <= 60 * self.hours_before


# --- before the loop ---------------------------------------------------------------------------


def average_of(model: torch.nn.Module, decay: float) -> AveragedModel | None:
    """A moving average of the model's weights, buffers included; none if the decay is 0."""
    if not decay:
        return None
    return AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(decay), use_buffers=True)


def make_accelerator(options: LoopOptions) -> Accelerator:
    """Told ``cpu=True``, or several processes on a CPU would not find each other: one copy each."""
    return Accelerator(mixed_precision=options.precision, cpu=not torch.cuda.is_available())


def open_pairs(options: LoopOptions) -> Pairs[Any]:
    """All pairs that training may see."""
    split = "train" if (options.data / MANIFEST).is_file() else None
    return open_source(
        options.data,
        split=split,
        root=options.root,
        truth_points=options.truth_points,
        trusted=options.trusted,
    )


def _require_sensible(options: LoopOptions) -> None:
    for name, value in (
        ("--val-pairs", options.val_pairs),
        ("--val-every", options.val_every),
        ("--accumulate", options.accumulate),
        ("--loading.batch", options.loading.batch),
    ):
        if value < 1:
            raise UserError(f"{name} {value}: expected at least 1.")
    if not 0 <= options.average < 1:
        raise UserError(f"--average {options.average:g}: expected 0 or more, below 1.")
    if options.precision == "fp16" and not torch.cuda.is_available():
        raise UserError("--precision fp16 needs a GPU, and there is none; take bf16 or no.")


def largest_safe_keep(pairs: Pairs[Any], input_wh: tuple[int, int], options: LoopOptions) -> float:
    """Share of the window that stays filled when both the old and the new turn are at the limit."""
    if options.overfit or not options.augmentation.turn_deg:
        return 1.0
    sizing = Sizing(input_wh, options.fit)
    limit_deg = options.augmentation.turn_deg + pairs.largest_turn_deg
    return min(largest_keep(pair, sizing, limit_deg) for pair in pairs.one_of_each_rig())


def make_loaders(
    pairs: Pairs[Any], input_wh: tuple[int, int], options: LoopOptions, accelerator: Accelerator
) -> tuple[PairLoader, PairLoader]:
    """Training batches of this process, and validation pairs as they stand."""
    train_pairs, val_pairs = divided(pairs, options)
    sizing = Sizing(input_wh, options.fit, options.keep)
    loading, augmentation = options.loading, None if options.overfit else options.augmentation
    if options.overfit:
        loading = replace(loading, batch=min(loading.batch, options.overfit))
    val_loading = Loading(loading.batch, workers=0, shuffle=False, drop_last=False)
    share = {"rank": accelerator.process_index, "num_ranks": accelerator.num_processes}
    return (
        PairLoader(train_pairs, sizing, augmentation, loading, **share),
        PairLoader(val_pairs, sizing, None, val_loading),
    )


def divided(pairs: Pairs[Any], options: LoopOptions) -> tuple[Pairs[Any], Pairs[Any]]:
    """Pairs to train on, and pairs of other scenes, left to right, to validate on."""
    if options.overfit:
        return pairs[: options.overfit], pairs[: options.overfit]
    start = pairs.start_of_last(options.val_pairs)
    if not start:
        raise UserError(
            f"{options.data}: {len(pairs)} pairs, of which the last {len(pairs)} are for "
            f"validation: --val-pairs {options.val_pairs}, in whole scenes. Take more data or a "
            "smaller --val-pairs."
        )
    train_pairs = pairs[:start]
    return (
        train_pairs.in_both_directions() if options.both_directions else train_pairs,
        pairs[start:],
    )


# --- in the loop -------------------------------------------------------------------------------


def endless(loader: PairLoader, *, until: Callable[[], bool]) -> Iterator[Batch]:
    """Epoch after epoch."""
    while not until():
        for batch in loader:
            if until():
                return
            yield batch


def learning_rate(step: int, last_step: int, options: LoopOptions) -> float:
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


def stop_if_not_finite(what: str, value: Tensor, batch: Batch, out: Path) -> None:
    """Raises, with the batch and its truth on disk, if loss or gradient is NaN or infinite."""
    if torch.isfinite(value):
        return
    path = out / "bad_batch.safetensors"
    truth = {f"truth.{k}": v for k, v in vars(batch.truth).items()} if batch.truth else {}
    tensors = {
        k: v.cpu().contiguous()
        for k, v in {**vars(batch), **truth}.items()
        if isinstance(v, Tensor)
    }
    save_file(tensors, path, {"names": json.dumps(batch.names)})
    raise UserError(
        f"the {what} is {value.item()}, expected a finite number. Its batch is in {path}; the last "
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


def plain(options: LoopOptions) -> dict[str, Any]:
    """The options as values that JSON and a checkpoint hold."""
    values: dict[str, Any] = json.loads(json.dumps(asdict(options), default=str))
    return values
