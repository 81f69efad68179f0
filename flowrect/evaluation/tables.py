"""Scores as files to work on and to read: CSV, and Markdown in the layout of Tables 2 and 3."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from flowrect.evaluation import seconds
from flowrect.evaluation.offsets import FLOW, FLOW_VALID
from flowrect.evaluation.scores import Score
from flowrect.metrics import Summary, summarise

COLUMNS = ("method", "translation", "index", "name", "scene", "weather", "daylight", "failure",
           "notes", "num_matches", "seconds")  # fmt: skip
"""of scores.csv, before the figures"""
Group = tuple[str, str]
"""method, translation"""


def grouped(scores: Iterable[Score]) -> dict[Group, list[Score]]:
    """Scores by method and translation, in their order."""
    groups: dict[Group, list[Score]] = {}
    for score in scores:
        groups.setdefault((score.method, score.translation), []).append(score)
    return groups


def figure_names(scores: Sequence[Score]) -> list[str]:
    """All figures that any score has."""
    return list(dict.fromkeys(name for s in scores for name in s.figures))


def summary(scores: Sequence[Score], figure: str, *, signed: bool = False) -> Summary | None:
    """Over the pairs that have the figure, of its size unless ``signed``; None if none has."""
    known = [s for s in scores if np.isfinite(s.figures.get(figure, np.nan))]
    if not known:
        return None
    values = [s.figures[figure] if signed else abs(s.figures[figure]) for s in known]
    return summarise(values, [s.scene for s in known], rng=np.random.default_rng(0))


def pairs_of(scores: Iterable[Score]) -> set[int]:
    """Indices of the pairs that have a score."""
    return {s.index for s in scores}


def groups_of(scores: Sequence[Score], translation: str) -> dict[str, list[Score]]:
    """Scores by method, of one translation; the name of a method says if it lacks pairs."""
    of = [s for s in scores if s.translation == translation]
    num = len(pairs_of(of))
    return {
        method + (f" ({len(group)} of {num} pairs)" if len(group) < num else ""): group
        for (method, _), group in grouped(of).items()
    }


def failures(scores: Sequence[Score]) -> int:
    """Pairs without an estimate."""
    return sum(bool(s.failure) for s in scores)


# --- CSV ---------------------------------------------------------------------------------------


def write_scores(path: Path, scores: Sequence[Score]) -> None:
    """One line a pair, method and translation."""
    names = figure_names(scores)
    rows = []
    for score in scores:
        whole = sum(score.seconds.values()) if score.seconds else np.nan
        flat = asdict(score) | {"seconds": whole}
        rows.append([flat[c] for c in COLUMNS] + [score.figures.get(n, np.nan) for n in names])
    path.write_text(_csv([*COLUMNS, *names], rows), encoding="utf-8")


def write_summary(path: Path, scores: Sequence[Score]) -> None:
    """One line a method, translation and figure."""
    rows = []
    for (method, translation), group in grouped(scores).items():
        for figure in figure_names(scores):
            if (s := summary(group, figure, signed=True)) is not None:
                low, high = s.interval
                rows.append([method, translation, figure, s.mean, s.median, s.p95, low, high,
                             s.num, failures(group)])  # fmt: skip
    head = ["method", "translation", "figure", "mean", "median", "p95", "low", "high", "pairs",
            "failures"]  # fmt: skip
    path.write_text(_csv(head, rows), encoding="utf-8")


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return text.getvalue()


# --- Markdown ----------------------------------------------------------------------------------

Cell = Callable[[Sequence[Score]], str]


def _counted(figures: Sequence[str], say: Callable[[Sequence[Summary]], str]) -> Cell:
    """What is said of figures, and how many pairs lack what others have; "–" if all do."""

    def cell(scores: Sequence[Score]) -> str:
        known = [s for f in figures if (s := summary(scores, f)) is not None]
        if len(known) < len(figures):
            return "–"
        without = sum(any(np.isnan(s.figures.get(f, 0.0)) for f in figures) for s in scores)
        return say(known) + f" ({without} without)" * (without > 0)

    return cell


def _mean(figure: str, digits: int = 3) -> Cell:
    return _counted([figure], lambda s: f"{s[0].mean:.{digits}f}")


def _mean_and_interval(figure: str, digits: int = 3) -> Cell:
    def say(known: Sequence[Summary]) -> str:
        mean, (low, high) = known[0].mean, known[0].interval
        interval = "" if np.isnan(low) else f" [{low:.{digits}f}, {high:.{digits}f}]"
        return f"{mean:.{digits}f}{interval}"

    return _counted([figure], say)


def _median(figure: str, digits: int = 3) -> Cell:
    return _counted([figure], lambda s: f"{s[0].median:.{digits}f}")


def _mean_and_median(figure: str) -> Cell:
    return _counted([figure], lambda s: f"{s[0].mean:.3f} / {s[0].median:.3f}")


def _failures(scores: Sequence[Score]) -> str:
    return str(failures(scores))


def _noted(scores: Sequence[Score]) -> str:
    return str(sum(bool(s.notes) for s in scores))


def columns(names: Sequence[str]) -> dict[str, Cell]:
    """The columns that these figures fill: those of the paper's Table 2 among ours."""
    offsets = [n.removesuffix("_offset_px") for n in names if n.endswith("_offset_px")]
    of_matchers = {
        f"{m} offset [px], mean / median": _both(f"{m}_offset_px", f"{m}_offset_median_px")
        for m in offsets
    }
    by_network = {"vertical flow by RAFT [px], all / filled": _both(FLOW, FLOW_VALID)}
    return {
        **of_matchers,
        **(by_network if FLOW in names else {}),
        "vertical flow [px]": _mean_and_interval("vertical_flow_px"),
        "median": _median("vertical_flow_px"),
        "MAE, paper": _mean("mae_paper"),
        "MAE, valid": _mean("mae_valid"),
        "pitch [°], mean / median": _mean_and_median("pitch_deg"),
        "yaw [°], mean / median": _mean_and_median("yaw_deg"),
        "roll [°], mean / median": _mean_and_median("roll_deg"),
        "geodesic [°]": _mean_and_interval("geodesic_deg"),
        "median [°]": _median("geodesic_deg"),
        "|disparity bias| [px]": _mean("disparity_bias_px"),
        "failures": _failures,
        "noted": _noted,
    }


def _both(first: str, second: str) -> Cell:
    """Means of two figures."""
    return _counted([first, second], lambda s: f"{s[0].mean:.2f} / {s[1].mean:.2f}")


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def main_rows(
    scores: Sequence[Score],
    translation: str,
    unavailable: Mapping[str, str],
    trained: Mapping[str, str],
    figures: Sequence[str] = (),
) -> tuple[list[str], list[list[str]]]:
    """Head and rows: all methods of one translation; those that could not run say why, once.

    ``figures`` have a column even if none of these scores has them.
    """
    cells = columns(figures or figure_names(scores))
    rows = [[m, trained.get(g[0].method, "–"), *(cell(g) for cell in cells.values())]
            for m, g in groups_of(scores, translation).items()]  # fmt: skip
    rows += [[m, why, *[""] * len(cells)] for m, why in _reasons(unavailable).items()]
    return ["method", "trained", *cells], rows


def _reasons(unavailable: Mapping[str, str]) -> dict[str, str]:
    """Why each method could not run, in one line; those that share a reason name the first."""
    first: dict[str, str] = {}
    for method, why in unavailable.items():
        first.setdefault(why, method)
    return {m: _reason(why, "" if first[why] == m else f"as {first[why]}")
            for m, why in unavailable.items()}  # fmt: skip


def _reason(why: str, instead: str = "") -> str:
    line = " ".join(why.split())
    if line.startswith("it cannot"):  # whatever cannot be loaded says so itself
        return instead or line
    return f"no weights: {instead or line}"


def main_table(
    scores: Sequence[Score],
    translation: str,
    unavailable: Mapping[str, str],
    trained: Mapping[str, str],
    figures: Sequence[str] = (),
) -> str:
    """``main_rows`` in Markdown."""
    head, rows = main_rows(scores, translation, unavailable, trained, figures)
    escaped = ([c.replace("|", "\\|") for c in line] for line in [head, *rows])
    return markdown(next(escaped), escaped)


def offset_notes(scores: Sequence[Score]) -> list[str]:
    """Which pairs the offsets of each matcher, and the flow of a network, are of."""
    total, notes = len(pairs_of(scores)), []
    for name in figure_names(scores):
        matched = sorted(pairs_of(s for s in scores if name in s.figures))
        which = "" if len(matched) == total else f": {', '.join(map(str, matched))}"
        of = f"of {len(matched)} of the {total} pairs{which}."
        if name.endswith("_offset_px"):
            notes.append(
                f"{name.removesuffix('_offset_px')} offsets are {of} A pair without any match "
                "after rectification is in no mean; how many there are stands in brackets."
            )
        if name == FLOW:
            notes.append(
                f"Vertical flow by RAFT is {of} All pixels of the rectified images are those of "
                "the paper, black borders included; filled are those that both images fill."
            )
    return notes


STRATA: dict[str, Callable[[Score], str]] = {
    "weather": lambda s: s.weather,
    "daylight": lambda s: s.daylight,
}


ALONE: dict[str, Callable[[Score], bool]] = {
    "fog": lambda s: s.weather == "fog",
    "rain": lambda s: s.weather == "rain",
    "night": lambda s: s.daylight == "night",
    "clear and not night": lambda s: s.weather == "clear" and s.daylight != "night",
}
"""strata that have the whole table of their own: the hard ones, and the easy one"""


def stratum_table(scores: Sequence[Score], translation: str, by: str) -> str:
    """Median vertical flow [px] / median geodesic error [°] (failures) of each stratum."""
    key = STRATA[by]
    names = sorted({key(s) for s in scores if key(s)})
    num = {n: len(pairs_of(s for s in scores if key(s) == n)) for n in names}
    rows = []
    for method, group in groups_of(scores, translation).items():
        row = [method]
        for name in names:
            part = [s for s in group if key(s) == name]
            failed = f" ({failures(part)})" if failures(part) else ""
            flow, angle = _median("vertical_flow_px")(part), _median("geodesic_deg")(part)
            row.append(f"{flow} / {angle}{failed}")
        rows.append(row)
    return markdown(["method", *(f"{n} ({num[n]})" for n in names)], rows)


def document(
    scores: Sequence[Score],
    unavailable: dict[str, str],
    trained: Mapping[str, str],
    title: str,
    translations: Sequence[str],
) -> str:
    """The whole of tables.md."""
    pairs, scenes = len(pairs_of(scores)), len({s.scene for s in scores})
    parts = [
        f"# {title}\n",
        f"{pairs} pairs of {scenes} scenes. Means, with 95 % bootstrap intervals over scenes. A "
        "pair for which a method failed is scored with the prior, and counted under failures; a "
        "pose whose rectified images have nothing in common, or whose baseline lies across that of "
        "the rig, is a failure that keeps its angles; "
        "under noted those that the method itself doubts, or where matches did not suffice to "
        "refine what a network said. "
        "Figures in pixels are of 512x256 images. Networks see the pair at the size they were "
        "trained at; the hours are those of their training, where they are known.\n",
        *(f"{line}\n" for line in offset_notes(scores)),
    ]
    for translation in translations:
        what = (
            "the true t for all" if translation == "gt" else "each method's own t, or the nominal"
        )
        parts += [
            f"## t = {translation} ({what})\n",
            main_table(scores, translation, unavailable, trained),
        ]
        for by in STRATA:
            parts += [
                f"### by {by}: median vertical flow [px] / median geodesic error [°] (failures)\n",
                stratum_table(scores, translation, by),
            ]
        for name, belongs in ALONE.items():
            if part := [s for s in scores if belongs(s)]:
                alone = main_table(part, translation, {}, trained, figure_names(scores))
                parts += [f"### {name} alone, {len(pairs_of(part))} pairs\n", alone]
    parts += ["## Seconds\n", f"{seconds.NOTE}\n", markdown(seconds.HEAD, seconds.rows(scores))]
    return "\n".join(parts)
