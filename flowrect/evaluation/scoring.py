"""The second pass as a whole: which pairs, what looks at them, in how many processes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from pebble import ProcessExpired, ProcessPool

from flowrect.evaluation.delivered import Delivery, Translation, evenly
from flowrect.evaluation.offsets import Look, Memory, Offsets, VerticalFlow
from flowrect.evaluation.predict import Report, fork_server, stop_if_interrupted
from flowrect.evaluation.predictions import predictions_of
from flowrect.evaluation.scores import Score, scored
from flowrect.matchers import MATCHERS, load_matcher
from simgen.errors import UserError


@dataclass(frozen=True)
class Scoring:
    """What is scored, by what."""

    delivery: Delivery
    translations: tuple[Translation, ...]
    out: Path
    """holds the predictions, and keeps what was measured of rectified images"""
    offsets: tuple[str, ...] = ()
    """matchers that measure what is left between rectified images"""
    flow_network: str = ""
    """RAFT that does, or none"""
    matched_pairs: int = 0
    """for how many pairs, evenly chosen, they do"""
    jobs: int = 1
    """processes"""

    def looks(self) -> tuple[list[Look], dict[str, str]]:
        """All that measure what is left, and why others cannot, by name.

        Raises:
          UserError: there is no such matcher or network, or two matchers would share a column.
        """
        found: list[Look] = []
        lacking: dict[str, str] = {}
        if not self.matched_pairs:
            return found, lacking
        _require_columns(self.offsets)
        folder = self.out / "offsets"
        for name in self.offsets:
            try:
                match = load_matcher(name)
            except UserError as error:
                if name not in MATCHERS:
                    raise
                lacking[name] = str(error)
            else:
                found.append(Offsets(_column(name), match, Memory(folder / f"{name}.jsonl")))
        if self.flow_network:
            found.append(VerticalFlow.by(self.flow_network, folder / "flow.jsonl"))
        return found, lacking


class Scorer:
    """Scores pairs by their indices."""

    def __init__(self, scoring: Scoring, looks: Sequence[Look]) -> None:
        self._pairs = scoring.delivery.open(truth_points=None)
        self._rows = predictions_of(scoring.out, scoring.delivery.open().fingerprint)
        self._looks = looks
        self._matched = set(evenly(scoring.matched_pairs, len(self._pairs)))
        self._translations = scoring.translations

    def __len__(self) -> int:
        """Pairs."""
        return len(self._pairs)

    def __call__(self, i: int) -> list[Score]:
        """All methods on pair ``i``."""
        looks = self._looks if i in self._matched else ()
        return scored(self._pairs, self._rows, self._translations, i, looks)


def scores_of(scoring: Scoring, looks: Sequence[Look], report: Report) -> list[Score]:
    """Scores of all methods, pair by pair; ``report`` is told how many pairs are done, of all.

    ``looks`` are those of ``scoring``; other processes load their own.
    """
    found: list[Score] = []
    of = len(scoring.delivery.open())
    for done, of_pair in enumerate(_by_pair(scoring, looks, of), 1):
        found += of_pair
        report(done, of)
    return found


def _by_pair(scoring: Scoring, looks: Sequence[Look], num_pairs: int) -> Iterator[list[Score]]:
    if scoring.jobs == 1:
        yield from map(Scorer(scoring, looks), range(num_pairs))
        return
    with ExitStack() as stack:
        pool = stack.enter_context(
            ProcessPool(scoring.jobs, context=fork_server(), initializer=_start, initargs=[scoring])
        )
        stack.push(partial(stop_if_interrupted, pool))
        tasks = [pool.schedule(_score, args=[i]) for i in range(num_pairs)]
        for i, task in enumerate(tasks):
            try:
                yield task.result()
            except ProcessExpired as error:
                raise UserError(
                    f"the process that scored pair {i} died ({error}); too little memory? The same "
                    "command goes on with what was measured; take fewer --jobs."
                ) from error


def _require_columns(offsets: Sequence[str]) -> None:
    if len({_column(name) for name in offsets}) < len(offsets):
        raise UserError(
            f"--offsets {' '.join(offsets)}: settings of one matcher share a column; ask for one."
        )


def _column(matcher: str) -> str:
    return matcher.removesuffix("-paper")


# --- in the process ------------------------------------------------------------------------------

_scorers: list[Scorer] = []
"""that of this process"""


def _start(scoring: Scoring) -> None:
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // scoring.jobs))
    _scorers[:] = [Scorer(scoring, scoring.looks()[0])]


def _score(i: int) -> list[Score]:
    return _scorers[0](i)
