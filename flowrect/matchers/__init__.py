"""Matchers by name: one file each, all with one signature, loaded when they are asked for.

match = load_matcher("sift")
matches = match(left, right)     # (H, W, 3) uint8 RGB each
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from flowrect.matchers import dis, sift
from flowrect.matches import Matcher, Matches
from flowrect.sample import Image
from simgen.errors import UserError


def together(left: Image, right: Image, matchers: Sequence[Matcher]) -> Matches:
    """The matches of several matchers, one after the other."""
    found = [match(left, right) for match in matchers]
    uv_left, uv_right, score = (
        np.concatenate([getattr(m, name) for m in found])
        for name in ("uv_left", "uv_right", "score")
    )
    return Matches(uv_left, uv_right, score)


MATCHERS: dict[str, Callable[[], Matcher]] = {
    "sift": lambda: sift.match,
    "sift-paper": lambda: partial(sift.match, options=sift.PAPER),
    "dis": lambda: dis.match,
    "sift-dis": lambda: partial(together, matchers=(sift.match, dis.match)),
}


def load_matcher(name: str) -> Matcher:
    """The matcher of that name; UserError if there is none, or it lacks its weights."""
    if name not in MATCHERS:
        raise UserError(f"matcher {name!r}: expected one of {', '.join(MATCHERS)}.")
    return MATCHERS[name]()
