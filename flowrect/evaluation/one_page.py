"""The one page of a results folder, report.html, to which several commands contribute.

OUT/sections/NAME.html holds what a command wrote last; the page is all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flowrect.files import make_folder
from simgen.page import page
from simgen.shards import write_atomically

FIRST = "rectification"
"""the name of what ``flowrect.evaluate`` writes; what others write follows by name"""


def put(results: Path, name: str, sections: Sequence[str]) -> Path:
    """Puts sections (HTML) in place of those of that name; returns the page's path."""
    folder = results / "sections"
    make_folder(folder)
    write_atomically(folder / f"{name}.html", "".join(sections).encode())
    parts = sorted(folder.glob("*.html"), key=lambda p: (p.stem != FIRST, p.stem))
    path = results / "report.html"
    text = page("Rectification", [part.read_text(encoding="utf-8") for part in parts])
    write_atomically(path, text.encode())
    return path
