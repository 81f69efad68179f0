"""The second pass as a whole: which pairs, what looks at them, in how many processes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

from pebble import ProcessExpired, ProcessPool

from flowrect.evaluation.delivered import Delivery, Translation, evenly
from flowrect.evaluation.offsets import Look, Memory, Offsets, VerticalFlow
from flowrect.evaluation.predict import OnProgress, fork_server, share_cores, stop_if_interrupted
from flowrect.evaluation.predictions import predictions_of
from flowrect.evaluation.scores import Score, scored
from flowrect.matchers import MATCHERS, load_matcher
from simgen.errors import UserError

OFFSETS = ("sift-paper", "aliked", "superglue")
"""measured if nothing is asked for, where they can be; aliked as what needs no weights from
elsewhere, beside the paper's SuperGlue"""


MOST_SCORERS = 4
"""unless more are asked for: each takes one to two GB where networks look at images"""
PAIRS_A_SCORER = 16
"""at least: a small set stays in one process"""


def scorers(num_pairs: int) -> int:
    """Processes that score if nobody says how many: a pair hardly keeps two cores busy."""
    return max(1, min(os.cpu_count() or 1, MOST_SCORERS, num_pairs // PAIRS_A_SCORER))


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
        """All that measure what is left, and why some of ``OFFSETS`` cannot, by name.

        Raises:
          UserError: something that was asked for cannot be loaded, or two would share a column.
        """
        _require_columns(self.offsets)
        found: list[Look] = []
        lacking: dict[str, str] = {}
        if not self.matched_pairs:
            return found, lacking
        folder = self.out / "offsets"
        for name in self.offsets:
            try:
                match = load_matcher(name)
            except Exception as error:  # a broken package as well: it costs that column only
                if self.offsets != OFFSETS:
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

    def __call__(self, i: int) -> list[Score]:
        """All methods on pair ``i``."""
        looks = self._looks if i in self._matched else ()
        return scored(self._pairs, self._rows, self._translations, i, looks)


def scores_of(scoring: Scoring, looks: Sequence[Look], report: OnProgress) -> list[Score]:
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
    names = tuple(x.name for x in looks if isinstance(x, Offsets))
    known = replace(scoring, offsets=tuple(n for n in scoring.offsets if _column(n) in names))
    with ExitStack() as stack:
        pool = stack.enter_context(ProcessPool(
            scoring.jobs, context=fork_server(), initializer=share_cores, initargs=[scoring.jobs]
        ))  # fmt: skip
        stack.push(partial(stop_if_interrupted, pool))
        tasks = [pool.schedule(_score, args=[known, i]) for i in range(num_pairs)]
        for i, task in enumerate(tasks):
            try:
                yield task.result()
            except (ProcessExpired, BrokenProcessPool) as error:
                raise UserError(
                    f"a process that scored pair {i} died ({error}); too little memory? The same "
                    "command goes on with what was measured; take fewer --jobs than "
                    f"{scoring.jobs}."
                ) from error


def _require_columns(offsets: Sequence[str]) -> None:
    unknown = [name for name in offsets if name not in MATCHERS]
    if unknown:
        raise UserError(f"--offsets {unknown[0]}: expected some of {', '.join(MATCHERS)}.")
    if len({_column(name) for name in offsets}) < len(offsets):
        raise UserError(
            f"--offsets {' '.join(offsets)}: settings of one matcher share a column; ask for one."
        )


def _column(matcher: str) -> str:
    return matcher.removesuffix("-paper")


# --- in the process ------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _scorer(scoring: Scoring) -> Scorer:
    looks, lacking = scoring.looks()
    if lacking:  # the command could load them: another column would be without this pair
        raise UserError(f"a scoring process could not load {lacking}; take fewer --jobs.")
    return Scorer(scoring, looks)


def _score(scoring: Scoring, i: int) -> list[Score]:
    return _scorer(scoring)(i)
