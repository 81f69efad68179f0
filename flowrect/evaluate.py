"""Which method rectifies best, and on what: ``python -m flowrect.evaluate --data shards/``.

Two passes. Every method predicts every pair, and its predictions go to a file; then the files are
scored. The same pairs, size, intrinsics and prior for all. What is there already is not made
again, so the same command goes on after an interruption, and other ``--methods`` join those that
are in the folder.

OUT/predictions/METHOD.T.h5 holds the predictions, OUT/matches and OUT/offsets what was matched for
them and after them, ``scores.csv`` the figures of every pair,
``summary.csv`` their means, medians and intervals, ``tables.md`` the paper's Table 2, the same by
weather and daylight, and its Table 3 (seconds), ``report.html`` pictures of all of it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from flowrect.evaluation import one_page, tables
from flowrect.evaluation.delivered import Delivery, Translation, wh_of
from flowrect.evaluation.predict import FAULT, OnProgress, Run, predict
from flowrect.evaluation.predictions import predictions_of
from flowrect.evaluation.report import report
from flowrect.evaluation.scores import TRUTH, UNRECTIFIED, Score
from flowrect.evaluation.scoring import OFFSETS, Scoring, scorers, scores_of
from flowrect.files import make_folder, read_json
from flowrect.memory import keep_freed_memory
from flowrect.methods import METHODS, TABLE, training_of
from simgen.errors import UserError
from simgen.shards import write_atomically


@dataclass(frozen=True)
class EvaluateOptions:
    """Scores methods on a set: angles, exact vertical flow, offsets of matches, image error."""

    data: Path
    """a set of simgen, or rectified real pairs with --turn-deg: a folder with left/, right/ and
    calib.yaml, KITTI raw, or a list"""
    methods: tuple[str, ...] = TABLE
    """names, or network=FILE for a network of flowrect.train, be it ours, an ablation of it or a
    rival. Without this all rows of the paper's tables, and ours: hours for a few hundred pairs"""
    translations: tuple[Translation, ...] = ("gt", "nominal")
    """t that methods are given: gt as in the paper, though it leaks rotation, or the nominal one,
    which is what a user has. With gt all are scored with the true t, else with their own"""
    split: Literal["test", "train", "all"] = "test"
    """frames of a rendered set"""
    size: str = "1024x512"
    """of the images that methods get: cut to 2:1 and shrunk; never enlarged"""
    limit: int = 0
    """pairs at most, evenly chosen; 0: all"""
    turn_deg: float = 0.0
    """turns the cameras of rectified real pairs by known rotations, each component within ± this"""
    offsets: tuple[str, ...] = OFFSETS
    """matchers that measure what is left between rectified images; aliked is there for whoever
    lacks the weights of the paper's SuperGlue. Of the default, what cannot run is left out"""
    flow_network: str = "raft"
    """RAFT that measures vertical flow between rectified images, as in the paper: shipped weights,
    some of flowrect.train_flow, torchvision or torchvision-large; "" for none"""
    matched_pairs: int = 86
    """pairs, evenly chosen, for these two, which take seconds a row; 0: they are not measured"""
    time_limit_s: float = 120.0
    """that a method may take for a pair; then it is stopped, which counts as a failure"""
    jobs: int = 0
    """processes that predict, and that score, each of which takes whole pairs and one to two GB; 0:
    one predicts, with all cores, and up to four score, each with its own"""
    root: Path | None = None
    """folder that the paths of a list are relative to"""
    out: Path = Path("results")


def evaluate(options: EvaluateOptions, console: Console) -> list[Score]:
    """Predicts what is missing, scores everything, and writes the files."""
    _require_sensible(options)
    make_folder(options.out)
    delivery = Delivery(options.data, options.split, wh_of(options.size), options.limit,
                        options.turn_deg, root=options.root)  # fmt: skip
    scoring = Scoring(delivery, options.translations, options.out, options.offsets,
                      options.flow_network, options.matched_pairs,
                      options.jobs or scorers(len(delivery.open())))  # fmt: skip
    looks, blind = scoring.looks()
    for matcher, reason in blind.items():
        _left_out(console, f"offsets by {matcher}", reason)
    predictions_of(options.out, delivery.open().fingerprint)  # raises now if some are stale
    run = Run(delivery, options.methods, options.translations, options.out,
              options.time_limit_s, options.jobs or 1)  # fmt: skip
    with _Progress(console, "predicting") as progress:
        left_out = predict(run, progress)
    for method, reason in left_out.items():
        _left_out(console, method, reason)
    rows = predictions_of(options.out, delivery.open().fingerprint)
    unavailable = _kept(options.out / "unavailable.json", left_out, {m for m, _ in rows})
    with _Progress(console, "scoring") as progress:
        scores = scores_of(scoring, looks, progress)
    trained = {m: training_of(m) for m, _ in rows}
    _write(options, scores, unavailable, trained)
    sections = report(scores, rows, delivery.open(), unavailable, trained)
    sources = one_page.Sources.of(delivery.open().fingerprint, (method for method, _ in rows))
    one_page.put(options.out, one_page.FIRST, sections, sources)
    own = [rows.get((m, t), {}) for m in options.methods for t in options.translations]
    if faults := sum(r.failure.startswith(FAULT) for of in own for r in of.values()):
        console.print(
            f"[yellow]{faults} predictions stand among the failures by a {FAULT}[/yellow], such as "
            "too little memory: the same command tries them again.",
            soft_wrap=True,
        )
    return scores


def _left_out(console: Console, what: str, reason: str) -> None:
    console.print(f"[yellow]{escape(what)} left out:[/yellow] {escape(reason)}", soft_wrap=True)


def _kept(path: Path, left_out: dict[str, str], there: Collection[str]) -> dict[str, str]:
    """Methods that could not run, with those of earlier calls, but for any that can now."""
    known = (read_json(path) if path.exists() else {}) | left_out
    kept = {method: why for method, why in known.items() if method not in there}
    write_atomically(path, json.dumps(kept, indent=1).encode())
    return kept


def _write(
    options: EvaluateOptions,
    scores: Sequence[Score],
    unavailable: dict[str, str],
    trained: dict[str, str],
) -> None:
    out = options.out
    tables.write_scores(out / "scores.csv", scores)
    tables.write_summary(out / "summary.csv", scores)
    raft = options.flow_network and options.matched_pairs
    by = f", RAFT by {options.flow_network}" if raft else ""
    title = f"Rectification at {options.size}{by}"
    text = tables.document(scores, unavailable, trained, title, options.translations)
    (out / "tables.md").write_text(text, encoding="utf-8")


def _require_sensible(options: EvaluateOptions) -> None:
    for name, value, least in (
        ("--limit", options.limit, 0),
        ("--matched-pairs", options.matched_pairs, 0),
        ("--jobs", options.jobs, 0),
        ("--time-limit-s", options.time_limit_s, 1),
        ("--turn-deg", options.turn_deg, 0),
    ):
        if not value >= least:
            raise UserError(f"{name} {value:g}: expected at least {least}.")
    asked = options.translations
    if not asked or len(set(asked)) < len(asked):
        raise UserError(f"--translations {' '.join(asked)}: expected gt, nominal or both.")
    _require_known(options.methods)


def _require_known(methods: Sequence[str]) -> None:
    known = [m for m in METHODS if m not in (UNRECTIFIED, TRUTH)]
    unknown = [m for m in methods if m not in known and not m.startswith("network=")]
    if unknown:
        raise UserError(
            f"method {unknown[0]!r}: expected some of {', '.join(known)}, or network=FILE."
        )


class _Progress(AbstractContextManager[OnProgress]):
    """A progress bar, as a function of done and of all."""

    def __init__(self, console: Console, what: str) -> None:
        self._bar = Progress(TextColumn(what), BarColumn(), MofNCompleteColumn(),
                             TimeRemainingColumn(), console=console)  # fmt: skip
        self._task = self._bar.add_task(what)

    def __enter__(self) -> OnProgress:
        self._bar.start()
        return lambda done, of: self._bar.update(self._task, completed=done, total=of)

    def __exit__(self, *error: object) -> None:
        self._bar.stop()


def shown(scores: Sequence[Score], translation: str) -> Table:
    """Mean / median of the main figures, for the terminal."""
    figures = ("pitch_deg", "yaw_deg", "roll_deg", "geodesic_deg", "vertical_flow_px")
    heads = ("pitch [°]", "yaw [°]", "roll [°]", "geodesic [°]", "vertical flow [px]", "failures")
    table = Table("", *map(escape, heads), title=f"t = {translation}: mean / median")
    for method, group in tables.groups_of(scores, translation).items():
        found = (tables.summary(group, f) for f in figures)
        cells = ["–" if s is None else f"{s.mean:.3f} / {s.median:.3f}" for s in found]
        table.add_row(escape(method), *cells, str(tables.failures(group)))
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 2 if the user has to mend something, 130 after Ctrl-C."""
    options = tyro.cli(EvaluateOptions, args=arguments, prog="flowrect.evaluate")
    keep_freed_memory()
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 140)
    try:
        scores = evaluate(options, console)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        console.print(
            f"interrupted: the same command goes on from {options.out}.",
            soft_wrap=True,
            markup=False,
        )
        return 130
    for translation in options.translations:
        console.print(shown(scores, translation))
    console.print(
        f"written: {options.out}/report.html, tables.md, summary.csv, scores.csv",
        soft_wrap=True, markup=False,
    )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
