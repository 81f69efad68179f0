"""What a run leaves to look at: a progress bar, TensorBoard, and ``metrics.jsonl``.

``metrics.jsonl`` has one object a line: ``{"step": …, "loss": …, "lr": …, "step_s": …, "wait_s":
…}`` for every step, and ``{"step": …, "validation": {…}}``. ``step_s`` [s] is without validations;
for ``wait_s`` of it the step waited for data. Lines after the checkpoint that a run goes on from
are dropped.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

TIMED_STEPS = 20  # after the first, which warms up
TENSORBOARD_EVERY = 10

T = TypeVar("T")


class Stopwatch:
    """How long steps take, and how much of that they wait for data."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """A step begins now."""
        self._began, self._waited_s = time.monotonic(), 0.0

    def waiting_for(self, batches: Iterable[T]) -> Iterator[T]:
        """The batches; the time until each is there counts as waiting."""
        iterator = iter(batches)
        while True:
            asked = time.monotonic()
            try:
                batch = next(iterator)
            except StopIteration:
                return
            self._waited_s += time.monotonic() - asked
            yield batch

    def lap(self) -> dict[str, float]:
        """Seconds of the step that ends now; the next one begins."""
        seconds = {"step_s": time.monotonic() - self._began, "wait_s": self._waited_s}
        self.restart()
        return seconds


class RunLog:
    """Writes while a run goes on; does nothing in processes that are not ``active``."""

    def __init__(self, out: Path, step: int, last_step: int, *, active: bool) -> None:
        self._active, self._first, self._last = active, step, last_step
        self._path, self._board_dir = out / "metrics.jsonl", out / "tensorboard"
        self._step_s = self._wait_s = 0.0

    def __enter__(self) -> RunLog:
        if self._active:
            keep_lines_until(self._path, self._first)
            self._file = self._path.open("a", encoding="utf-8")
            self._board = SummaryWriter(self._board_dir, purge_step=self._first + 1)
            self._console = Console()
            self._bar = Progress(
                TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                TimeRemainingColumn(), console=self._console,
            )  # fmt: skip
            self._task = self._bar.add_task("", total=self._last, completed=self._first)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        if self._active:
            self._bar.stop()
            self._board.close()
            self._file.close()

    def step(self, step: int, values: dict[str, float], epoch_steps: int) -> None:
        """Values of one optimiser step."""
        if not self._active:
            return
        self._write({"step": step, **values})
        if step % TENSORBOARD_EVERY == 0:
            for name, value in values.items():
                self._board.add_scalar(f"train/{name}", value, step)
        self._bar.update(self._task, completed=step, description=f"loss {values['loss']:.3f}")
        if 1 < step - self._first <= 1 + TIMED_STEPS:
            self._step_s += values["step_s"]
            self._wait_s += values["wait_s"]
        if step - self._first == 1 + TIMED_STEPS:
            self._say_speed(epoch_steps)

    def validation(self, step: int, scores: dict[str, float]) -> None:
        """Scores of one validation."""
        if not self._active:
            return
        self._write({"step": step, "validation": scores})
        for name, value in scores.items():
            self._board.add_scalar(f"validation/{name}", value, step)
        text = ", ".join(f"{name} {value:.3f}" for name, value in scores.items())
        self._console.print(f"step {step}: {text}")

    def _write(self, row: dict[str, Any]) -> None:
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()

    def _say_speed(self, epoch_steps: int) -> None:
        seconds, share = self._step_s / TIMED_STEPS, self._wait_s / self._step_s
        hours = seconds * epoch_steps / 3600
        self._console.print(
            f"{seconds:.2f} s per step, {share:.1%} of it waiting for data; {hours:.2f} h per epoch"
        )


def keep_lines_until(path: Path, step: int) -> None:
    """Drops the lines of later steps, and a last line that was cut short."""
    if not path.is_file():
        return
    kept = [line for line in path.read_text(encoding="utf-8").splitlines() if _step(line) <= step]
    partial = path.with_name(path.name + ".partial")
    partial.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
    os.replace(partial, path)


def _step(line: str) -> float:
    try:
        return float(json.loads(line)["step"])
    except json.JSONDecodeError:
        return float("inf")
