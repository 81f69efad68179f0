"""Tables of the benchmarks: Markdown on the terminal, CSV in a file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

Row = Sequence[object]


def markdown(header: Sequence[str], rows: Sequence[Row]) -> str:
    """A Markdown table; numbers with three significant digits."""
    lines = [header, ["---"] * len(header), *([_text(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Row]) -> None:
    """The same table with all digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])


def _text(cell: object) -> str:
    if not isinstance(cell, float):
        return str(cell)
    return f"{cell:,.0f}" if abs(cell) >= 100 else f"{cell:.3g}"
