"""What a run leaves to look at: a progress bar, TensorBoard, and ``metrics.jsonl``.

``metrics.jsonl`` has one object a line: ``{"step": …, "loss": …, "lr": …}`` for every step, and
``{"step": …, "validation": {…}}``. Lines after the checkpoint that a run goes on from are dropped.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

TIMED_STEPS = 20  # after the first, which warms up
TENSORBOARD_EVERY = 10


class RunLog:
    """Writes while a run goes on; does nothing in processes that are not ``active``."""

    def __init__(self, out: Path, step: int, last_step: int, *, active: bool) -> None:
        self._active, self._first, self._last = active, step, last_step
        self._path, self._board_dir = out / "metrics.jsonl", out / "tensorboard"

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
        self._say_speed(step - self._first, epoch_steps)

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

    def _say_speed(self, done: int, epoch_steps: int) -> None:
        """Prints hours per epoch once it can be known."""
        if done == 1:
            self._started = time.monotonic()
        if done == 1 + TIMED_STEPS:
            seconds = (time.monotonic() - self._started) / TIMED_STEPS
            hours = seconds * epoch_steps / 3600
            self._console.print(f"{seconds:.2f} s per step, {hours:.2f} h per epoch")


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
