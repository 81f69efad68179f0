"""Table 3: what the predictions took, by their own clocks.

Matches are found once per pair and matcher; each method that uses them counts their seconds. The
clocks ran on the machine of the run, beside its other jobs and whatever else was there:
``benchmarks/method_time.py`` times methods alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from flowrect.evaluation.scores import TRUTH, UNRECTIFIED, Score

HEAD = ("method", "median [s]", "95 % [s]", "stages, median [s]", "pairs", "not timed", "where")
NOTE = (
    "Of the predictions themselves, failures included, for all t together; matches that several "
    "methods share count for each. Batch 1, on the machine of the run, beside its other jobs and "
    "whatever else ran there. Not timed: methods that raised, or were stopped."
)


def rows(scores: Iterable[Score]) -> list[list[str]]:
    """Median and 95th percentile of each method, and medians of its stages."""
    by_method: dict[str, list[Score]] = {}
    for score in scores:
        if score.method not in (UNRECTIFIED, TRUTH):
            by_method.setdefault(score.method, []).append(score)
    return [_row(method, of) for method, of in by_method.items()]


def _row(method: str, scores: Sequence[Score]) -> list[str]:
    timed = [s.seconds for s in scores if s.seconds]
    whole = [sum(stages.values()) for stages in timed]
    figures = [f"{np.percentile(whole, q):.3f}" for q in (50, 95)] if whole else ["–", "–"]
    names = dict.fromkeys(name for stages in timed for name in stages)
    parts = (f"{n} {np.median([stages.get(n, 0.0) for stages in timed]):.3f}" for n in names)
    where = "; ".join(dict.fromkeys(s.made_on for s in scores if s.made_on))
    return [method, *figures, ", ".join(parts) or "–", str(len(timed)),
            str(len(scores) - len(timed)), where]  # fmt: skip
