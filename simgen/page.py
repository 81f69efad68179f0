"""Pieces of a self-contained HTML page: sections, tables and one calm style sheet."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape


def page(title: str, sections: Iterable[str]) -> str:
    """The whole document."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{_CSS}</style></head>\n"
        f"<body><main><h1>{escape(title)}</h1>{''.join(sections)}</main></body></html>\n"
    )


def section(title: str, body: str, note: str = "") -> str:
    """A part of the page; ``body`` is HTML, title and note are text."""
    below = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"\n<section><h2>{escape(title)}</h2>{below}{body}</section>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = False) -> str:
    """A table of texts; ``numbers`` aligns all columns but the first to the right.

    The last cell of a row that is shorter than the head is a text that spans what is left.
    """
    cells = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join(f"<tr>{_cells(row, len(head))}</tr>" for row in rows)
    style = ' class="numbers"' if numbers else ""
    return f"<table{style}><tr>{cells}</tr>{body}</table>"


def _cells(row: Sequence[str], columns: int) -> str:
    *cells, last = map(escape, row)
    span = f' colspan="{columns - len(cells)}"' if len(row) < columns else ""
    return "".join(f"<td>{cell}</td>" for cell in cells) + f"<td{span}>{last}</td>"


def plain(name: str) -> str:
    """A name of the configuration as words."""
    return name.replace("_", " ")


def size_text(count: float) -> str:
    """Bytes in a unit that fits."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.4g} GB"


_CSS = """
:root { color: #2a2f36; background: #f7f8f9; font: 15px/1.5 system-ui, sans-serif; }
body { margin: 0; }
main { max-width: 1180px; margin: 0 auto; padding: 2.5rem 1.5rem 4rem; }
h1 { font-size: 1.9rem; margin: 0 0 .3rem; }
h2 { font-size: 1.25rem; margin: 0 0 .4rem; }
h3 { font-size: .95rem; margin: 0 0 .3rem; }
section { margin-top: 2.6rem; }
.lead { font-size: 1.05rem; margin: 0 0 1.4rem; max-width: 60rem; }
.note { color: #68707a; margin: 0 0 .8rem; }
.columns { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; }
.columns > table { flex: 1 1 20rem; }
table { border-collapse: collapse; background: #fff; border: 1px solid #e3e6ea; font-size: .87rem; }
th, td { padding: .3rem .7rem; text-align: left; border-bottom: 1px solid #eef0f2; }
th { font-weight: 600; color: #68707a; }
.numbers :is(td, th):not(:first-child), .strata td { text-align: right; }
.numbers td:not([colspan]) { white-space: pre; }
.numbers td[colspan]:not(:first-child) { text-align: left; }
.numbers, .strata td { font-variant-numeric: tabular-nums; }
.strata { margin-bottom: 1rem; }
.strata th { text-align: center; font-size: .78rem; padding: .25rem .45rem; }
.strata td { border-left: 1px solid #eef0f2; }
.scroll { overflow-x: auto; }
.files td:last-child { font: .76rem ui-monospace, monospace; }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(210px, 1fr)); gap: .8rem; }
.rows { display: grid; grid-template-columns: repeat(var(--columns), minmax(210px, 1fr));
  gap: .8rem; }
:is(.sheet, .rows) img { width: 100%; display: block; }
figure { margin: 0; background: #fff; border: 1px solid #e3e6ea; }
figcaption { padding: .35rem .55rem; font-size: .76rem; color: #68707a; line-height: 1.4; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(440px, 1fr)); gap: 1rem; }
:is(.scroll, p) + .charts { margin-top: 1rem; }
.charts figure, .wide figure { padding: .9rem 1rem .5rem; margin-bottom: 0; }
.wide { display: grid; gap: 1rem; }
svg { width: 100%; height: auto; display: block; }
details { margin-top: 1rem; }
summary { cursor: pointer; color: #3f72af; }
pre { background: #fff; border: 1px solid #e3e6ea; padding: 1rem; font-size: .78rem;
  overflow-x: auto; }
"""
