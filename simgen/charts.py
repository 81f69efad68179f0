"""Charts of the report, as SVG text to be put into a page: the same data give the same text."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from simgen.geometry import Array
from simgen.schema import LABEL_COLORS, LABELS

SIZE, WIDE = (5.6, 2.7), (11.2, 2.2)  # inches of 72 px
_INK, _FAINT = "#444b54", "#d9dde2"
SERIES = ("#3f72af", "#d1793a", "#4a9b7f", "#8b6fb0", "#b8a13a", "#777f88")
_STAGES = ("#274c77", "#4f7cac", "#86a8c9", "#bcd0e2", "#2f7d6b", "#5fae97", "#a6d3c4",
           "#c8763c", "#e2a878", "#8b6fb0", "#bda9d6", "#777f88", "#aab1b8")  # fmt: skip
_AS_PERCENT = FuncFormatter(lambda value, _: f"{100 * value:.3g} %")


def to_svg(figure: Figure, name: str) -> str:
    """The figure as an <svg> element; ``name`` keeps its ids apart from other charts'."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def histogram(
    edges: Array,
    series: Mapping[str, ArrayLike],
    *,
    x: str,
    y: str,
    log: bool = False,
    expected: float | None = None,
) -> Figure:
    """Outlines of histograms with the same bins, each scaled to a sum of 100 %.

    Args:
      series: counts (bins,) by name.
      expected: the share of each bin if the values were uniform; drawn with the band that holds
        95 % of the bins of such values.
    """
    figure, axes = empty(SIZE)
    for (name, counts), color in zip(series.items(), _cycle(SERIES, len(series)), strict=True):
        axes.stairs(_shares(counts), edges, label=name, color=color, linewidth=1.6)
        if len(series) == 1:
            axes.stairs(_shares(counts), edges, fill=True, color=color, alpha=0.3, linewidth=0)
    if expected is not None:
        _draw_uniform(axes, expected, min(int(np.sum(counts)) for counts in series.values()))
    if log:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(*_occupied(edges, series))
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(_AS_PERCENT)
    label(axes, x, y)
    if len(series) > 1 or expected is not None:
        legend_above(axes, len(series) + 1)
    return figure


def _draw_uniform(axes: Axes, expected: float, num_values: int) -> None:
    spread = 1.96 * np.sqrt(expected * (1 - expected) / max(1, num_values))
    low = max(0.0, expected - spread)
    axes.axhspan(low, expected + spread, color=_FAINT, alpha=0.6, linewidth=0, zorder=0.5)
    axes.axhline(expected, color=_INK, linewidth=1, linestyle=":", label="uniform")


def class_shares(counts: NDArray[np.int64]) -> Figure:
    """Bars of the share of pixels by label id, the largest on top, in Cityscapes' colours."""
    share = _shares(counts)
    present = [i for i in np.argsort(share, kind="stable") if share[i] > 0]
    names = {label: name for name, label in LABELS.items()}
    figure, axes = empty((SIZE[0], 0.6 + 0.24 * len(present)))
    rows = np.arange(len(present))
    colors = [np.array(LABEL_COLORS.get(int(i), (0, 0, 0))) / 255 for i in present]
    axes.barh(rows, share[present], color=colors, height=0.72)
    for row, i in zip(rows, present, strict=True):
        axes.annotate(_percent(share[i]), (share[i], row), (4, 0), textcoords="offset points",
                      va="center", size=9, color=_INK)  # fmt: skip
    axes.set_yticks(rows, [names.get(int(i), f"id {i}") for i in present])
    axes.set_xlim(0, 1.15 * share.max())
    axes.xaxis.set_major_formatter(_AS_PERCENT)
    axes.grid(False, axis="y")
    axes.grid(True, axis="x", color=_FAINT, linewidth=0.6)
    label(axes, "share of pixels", "")
    return figure


def stage_seconds(stages: Mapping[str, Array]) -> Figure:
    """Two bars, cut into the stages of a frame: means, and medians."""
    figure, axes = empty(WIDE)
    left = np.zeros(2)
    for (stage, seconds), color in zip(stages.items(), _cycle(_STAGES, len(stages)), strict=True):
        width = np.array([np.median(seconds), np.mean(seconds)])
        axes.barh([0, 1], width, left=left, color=color, height=0.62,
                  label=f"{stage} {np.mean(seconds):.2g} s")  # fmt: skip
        left += width
    axes.set_yticks([0, 1], [f"medians\nsum {left[0]:.1f} s", f"means\nsum {left[1]:.1f} s"])
    axes.set_xlim(0, left.max())
    axes.grid(False, axis="y")
    label(axes, "seconds per rig frame", "")
    legend_above(axes, 6)
    return figure


def memory(processes: Sequence[Sequence[tuple[int, float]]]) -> Figure:
    """Resident memory of each process over the frames of the set, in the order of time.

    Args:
      processes: for each, (place of a frame in time, GB).
    """
    figure, axes = empty(WIDE)
    for points, color in zip(processes, _cycle(SERIES, len(processes)), strict=True):
        place, gigabytes = np.array(points).T
        axes.plot(place, gigabytes, "o-", markersize=2.5, linewidth=1.2, color=color)
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    label(axes, "frames finished", "resident memory [GB]")
    return figure


# --- parts ---------------------------------------------------------------------------------------


def empty(size: tuple[float, float]) -> tuple[Figure, Axes]:
    """A figure of the page's style, of so many inches."""
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_FAINT)
    axes.tick_params(colors=_INK, labelsize=9, length=3, which="both")
    axes.grid(True, axis="y", color=_FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def label(axes: Axes, x: str, y: str) -> None:
    """Names both axes."""
    axes.set_xlabel(x, size=9.5, color=_INK)
    axes.set_ylabel(y, size=9.5, color=_INK)


def legend_above(axes: Axes, num_columns: int) -> None:
    """A legend that takes no room from the data."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0, 1.0), ncols=num_columns, frameon=False, fontsize=9,
        labelcolor=_INK, handlelength=1.2, handletextpad=0.5, columnspacing=1.4, borderpad=0.2,
    )  # fmt: skip


def legend_beside(axes: Axes) -> None:
    """A legend of many names, to the right of the data."""
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.0, 1.02), frameon=False, fontsize=8.5,
        labelcolor=_INK, handlelength=1.2, handletextpad=0.5, labelspacing=0.3, borderpad=0.2,
    )  # fmt: skip


def _shares(counts: ArrayLike) -> Array:
    values = np.asarray(counts, dtype=np.float64)
    return values / max(1.0, float(values.sum()))


def _occupied(edges: Array, series: Mapping[str, ArrayLike]) -> tuple[float, float]:
    """The part of the axis that holds counts."""
    used = np.flatnonzero(np.sum([np.asarray(c) for c in series.values()], axis=0))
    if not used.size:
        return float(edges[0]), float(edges[-1])
    return float(edges[used[0]]), float(edges[used[-1] + 1])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else "< 0.1 %"


def _cycle(colors: Sequence[str], num: int) -> list[str]:
    return [colors[k % len(colors)] for k in range(num)]
