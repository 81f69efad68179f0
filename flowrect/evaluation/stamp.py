"""What made a prediction: a digest of the code and the weights behind it.

A file whose stamp is another one was made by other settings, another version or other weights, and
is not taken for the present method's. Weights that a matcher finds through ``FLOWRECT_MODELS``, or
in the cache of a hub, are not part of it: use another output folder for others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from flowrect.depth import WEIGHTS
from flowrect.methods import TRAINED, network_of
from flowrect.weights import SHIPPED, find_weights

_PACKAGE = Path(__file__).parents[1]
_MATCHING = ("matches.py", "matchers", "flow_network.py", "sample.py", "resize.py", "turn.py",
             "evaluation/delivered.py")  # fmt: skip
"""matchers, and what hands them their images"""
_METHODS = (*_MATCHING, "solvers", "rivals", "methods.py", "estimate.py", "model.py", "weights.py",
            "drectify.py", "geometry.py", "least_squares.py")  # fmt: skip


@cache
def of_matcher(name: str) -> str:
    """Of everything that decides which matches a matcher finds."""
    return _digest([*_sources(_MATCHING), *weights_of(name)])


@cache
def of_method(name: str) -> str:
    """Of everything that decides what a method says; UserError if its weights are gone."""
    return _digest([*_sources(_METHODS), *weights_of(name)])


def of_stereo(name: str, weights: str = "") -> str:
    """Of everything that decides which disparity a stereo matcher finds; see ``load_stereo``."""
    files = [WEIGHTS[name](weights)] if name in WEIGHTS else []
    return _digest([*_sources(["depth"]), *files])


def weights_of(name: str) -> list[Path]:
    """The file of the network of a method or matcher that was trained here, if it is shipped."""
    if name.startswith("network"):
        return [find_weights(network_of(name)[0])]
    network = name.partition("+")[0]
    path = SHIPPED / f"{network}.safetensors"
    return [path] if network in (*TRAINED, "raft") and path.is_file() else []


def _sources(names: Iterable[str]) -> list[Path]:
    paths = [_PACKAGE / name for name in names]
    return [f for p in paths for f in (sorted(p.glob("**/*.py")) if p.is_dir() else [p])]


def _digest(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"\n".join(path.read_bytes() for path in paths)).hexdigest()[:16]
