"""Table 3: what the predictions took, by their own clocks.

Matches are found once per pair and matcher; each method that uses them counts their seconds. The
clocks ran on the machine of the run, beside its other jobs and whatever else was there:
``benchmarks/method_time.py`` times methods alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from flowrect.evaluation.scores import TRUTH, UNRECTIFIED, Score

HEAD = ("method", "median / 95 % [s]", "stages", "pairs", "not timed", "where")
NOTE = (
    "Of the predictions themselves, failures included, for all t together; matches that several "
    "methods share count for each. Batch 1, on the machine of the run, beside its other jobs and "
    "whatever else ran there. Not timed: methods that raised, or were stopped."
)


def rows(scores: Iterable[Score]) -> list[list[str]]:
    """Median and 95th percentile of each method, and of its stages."""
    by_method: dict[str, list[Score]] = {}
    for score in scores:
        if score.method not in (UNRECTIFIED, TRUTH):
            by_method.setdefault(score.method, []).append(score)
    return [_row(method, of) for method, of in by_method.items()]


def _row(method: str, scores: Sequence[Score]) -> list[str]:
    timed = [s.seconds for s in scores if s.seconds]
    whole = [sum(stages.values()) for stages in timed]
    where = "; ".join(dict.fromkeys(s.made_on for s in scores if s.made_on))
    return [method, spread(whole), by_stage(timed), str(len(timed)),
            str(len(scores) - len(timed)), where]  # fmt: skip


def by_stage(timed: Sequence[Mapping[str, float]]) -> str:
    """Seconds of each stage, from those of several pairs; 0 where a pair had no such stage."""
    names = dict.fromkeys(name for stages in timed for name in stages)
    return ", ".join(f"{n} {spread([t.get(n, 0.0) for t in timed])}" for n in names) or "–"


def spread(seconds: Sequence[float]) -> str:
    """Median / 95th percentile."""
    if not seconds:
        return "–"
    median, high = np.percentile(seconds, [50, 95])
    return f"{median:.3f} / {high:.3f}"
