"""What made a prediction: a digest of the code and the weights behind it.

A file whose stamp is another one was made by other settings, another version or other weights, and
is not taken for the present method's. Weights that a matcher finds through ``FLOWRECT_MODELS`` are
not part of it: use another output folder for others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from flowrect.methods import network_of
from flowrect.weights import find_weights

_PACKAGE = Path(__file__).parents[1]
_MATCHING = ("matches.py", "matchers")
_METHODS = (*_MATCHING, "solvers", "rivals", "methods.py", "estimate.py", "model.py", "weights.py",
            "resize.py", "drectify.py", "geometry.py", "least_squares.py")  # fmt: skip


@cache
def of_matchers() -> str:
    """Of everything that decides which matches are found."""
    return _digest(_sources(_MATCHING))


@cache
def of_method(name: str) -> str:
    """Of everything that decides what a method says; the weights of a network included."""
    with_network = name.startswith("network")
    weights = [find_weights(network_of(name)[0])] if with_network else []
    return _digest([*_sources(_METHODS), *weights])


def _sources(names: Iterable[str]) -> list[Path]:
    paths = [_PACKAGE / name for name in names]
    return [f for p in paths for f in (sorted(p.glob("**/*.py")) if p.is_dir() else [p])]


def _digest(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"\n".join(path.read_bytes() for path in paths)).hexdigest()[:16]
