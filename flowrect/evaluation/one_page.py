"""The one page of a results folder, report.html, to which several commands contribute.

OUT/sections/NAME.html holds what a command wrote last, below a line that says of which predictions;
the page is all of them that are of the same pairs and methods as the newest.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from flowrect.evaluation import stamp
from flowrect.files import make_folder
from simgen.page import page
from simgen.shards import write_atomically

FIRST = "rectification"
"""the name of what ``flowrect.evaluate`` writes; what others write follows by name"""


@dataclass(frozen=True)
class Sources:
    """What sections were made of."""

    data: str
    """fingerprint of the pairs"""
    methods: dict[str, str]
    """their stamps by name"""

    @staticmethod
    def of(data: str, methods: Iterable[str]) -> Sources:
        """With the present stamps."""
        return Sources(data, {name: stamp.of_method(name) for name in sorted(set(methods))})

    def agree(self, others: Sources) -> bool:
        """Whether both are of the same pairs, and the methods of both have not changed."""
        both = self.methods.keys() & others.methods.keys()
        same = all(self.methods[m] == others.methods[m] for m in both)
        return self.data == others.data and same


def put(results: Path, name: str, sections: Sequence[str], sources: Sources) -> Path:
    """Puts sections (HTML) in place of those of that name; returns the page's path.

    Sections of other names that do not agree with these are deleted: they are of another time.
    """
    folder = results / "sections"
    make_folder(folder)
    text = f"<!-- {json.dumps(asdict(sources))} -->\n" + "".join(sections)
    write_atomically(folder / f"{name}.html", text.encode())
    parts = []
    for part in sorted(folder.glob("*.html"), key=lambda p: (p.stem != FIRST, p.stem)):
        text = part.read_text(encoding="utf-8")
        if sources.agree(_sources_of(text)):
            parts.append(text)
        else:
            part.unlink()
    path = results / "report.html"
    write_atomically(path, page("Rectification", parts).encode())
    return path


def _sources_of(text: str) -> Sources:
    first = text.partition("\n")[0].removeprefix("<!-- ").removesuffix(" -->")
    return Sources(**json.loads(first))
