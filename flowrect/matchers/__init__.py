"""Matchers by name: one file each, all with one signature, loaded when they are asked for.

match = load_matcher("sift")
matches = match(left, right)     # (H, W, 3) uint8 RGB each

========================  ============================  ==================================
sift, sift-paper, dis     nothing is learned            OpenCV
aliked, disk, xfeat       key points and LightGlue      weights in installed packages
superglue                 key points and SuperGlue      weights to be copied, non-commercial
loftr, efficientloftr     semi-dense                    weights to be copied
raft                      dense flow, checked           shipped, or to be copied
========================  ============================  ==================================

Weights to be copied lie in one folder each, below the one that the environment variable
``FLOWRECT_MODELS`` names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module

import numpy as np

from flowrect.matchers import dis, sift
from flowrect.matches import Matcher, Matches
from flowrect.sample import Image
from simgen.errors import UserError


def together(left: Image, right: Image, matchers: Sequence[Matcher]) -> Matches:
    """The matches of several matchers, one after the other."""
    return joined([match(left, right) for match in matchers])


def joined(found: Sequence[Matches]) -> Matches:
    """All matches of several lists."""
    names = ("uv_left", "uv_right", "score", "weight")
    arrays = (np.concatenate([getattr(m, name) for m in found]) for name in names)
    return Matches(*arrays, seen_px=max(m.seen_px for m in found))


def learned(name: str) -> Matcher:
    """The matcher of the module of that name, which is imported now."""
    try:
        matcher: Matcher = import_module(f"flowrect.matchers.{name}").load()
    except ModuleNotFoundError as error:
        extra = "hub" if error.name == "transformers" else "matchers"
        raise UserError(
            f"matcher {name!r} needs the package {error.name}, which is not installed: "
            f"pip install 'flowrect[{extra}]'."
        ) from error
    return matcher


LEARNED = ("aliked", "disk", "xfeat", "superglue", "loftr", "efficientloftr", "raft")
WHOLE_PIXELS = ("disk", "xfeat", "superglue")
"""whose key points are whole pixels; those of others lie between them"""
MATCHERS: dict[str, Callable[[], Matcher]] = {
    "sift": lambda: sift.match,
    "sift-paper": lambda: partial(sift.match, options=sift.PAPER),
    "dis": lambda: dis.match,
    "sift-dis": lambda: partial(together, matchers=(sift.match, dis.match)),
    **{name: partial(learned, name) for name in LEARNED},
}
PARTS = {"sift-dis": ("sift", "dis")}
"""matchers whose matches are those of others together"""


def load_matcher(name: str) -> Matcher:
    """The matcher of that name; UserError if there is none, or it lacks its weights."""
    if name not in MATCHERS:
        raise UserError(f"matcher {name!r}: expected one of {', '.join(MATCHERS)}.")
    return MATCHERS[name]()
