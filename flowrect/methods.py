"""Every way to find how two cameras stand, under one signature and by name.

method = load_method("sift+5dof")
estimate = method(left, right, K_left, K_right, prior)    # or raises NoSolution

A method is a matcher with a solver (``MATCHER+SOLVER``), or a network that was trained for it, or
both: ``network+5dof`` starts the fit at what the network says. Methods that do not estimate t
return the prior's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Protocol

import numpy as np

from flowrect.estimate import Calibrator, load_model
from flowrect.matchers import MATCHERS, load_matcher
from flowrect.matches import Matches
from flowrect.rivals.config import RIVALS
from flowrect.sample import Image
from flowrect.solvers import SOLVERS, Solver
from flowrect.weights import SHIPPED
from simgen.errors import UserError
from simgen.geometry import Array, transform

REFINED_BY = "sift-dis"
"""the matcher of ``network+5dof``"""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose, X_right = R X_left + t, and what it cost."""

    R: Array
    """(3, 3)"""
    t: Array
    """(3,)"""
    covariance: Array | None = None
    """(5, 5) [rad²], see solvers.solution.Solution; None if the method does not know it"""
    num_matches: int | None = None
    num_inliers: int | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    """by stage"""
    notes: tuple[str, ...] = ()
    """what speaks against it"""


class Method(Protocol):
    """Images (H, W, 3) uint8 RGB without distortion, K (3, 3) [px], prior T_right_left (4, 4)."""

    def __call__(
        self, left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
    ) -> PoseEstimate: ...


class Seconds(dict[str, float]):
    """A stopwatch by stage."""

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Counts the time within."""
        start = time.perf_counter()
        yield
        self[stage] = self.get(stage, 0.0) + time.perf_counter() - start


def unrectified(
    left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
) -> PoseEstimate:
    """The prior itself."""
    return PoseEstimate(prior[:3, :3], prior[:3, 3])


@dataclass(frozen=True)
class Network:
    """A trained network alone, whichever it is; t is the prior's."""

    weights: str
    """name of shipped weights, or a file of flowrect.train"""

    def __call__(
        self, left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
    ) -> PoseEstimate:
        seconds = Seconds()
        model = _calibrator(self.weights)
        with seconds.of("network"):
            estimate = model.estimate(left, right, K_left, K_right, prior)
        return PoseEstimate(estimate.R, estimate.t, seconds=seconds, notes=estimate.notes)


def rival(name: str) -> Network:
    """A rival of the paper's tables, with its shipped weights; UserError if there are none."""
    if (SHIPPED / f"{name}.safetensors").is_file():
        return Network(name)
    raise UserError(
        f"method {name!r}: expected weights of that name in {SHIPPED}, found none. Train them "
        f"(python -m flowrect.train --model {name} --data shards --out runs/{name}) and copy "
        f"runs/{name}/best.safetensors there as {name}.safetensors, or pass that file to "
        "flowrect.methods.Network."
    )


@cache
def _calibrator(weights: str) -> Calibrator:
    return load_model(weights)


@dataclass(frozen=True)
class FromMatches:
    """A matcher, then a solver; the solver starts at the prior, or where another method ends."""

    matcher: str
    solver: Solver
    start: Method = unrectified

    def __call__(
        self, left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
    ) -> PoseEstimate:
        seconds = Seconds()
        match = load_matcher(self.matcher)
        with seconds.of("matching"):
            matches = match(left, right)
        start = self.start(left, right, K_left, K_right, prior)
        seconds.update(start.seconds)
        return self.solved(matches, K_left, K_right, start, seconds)

    def solved(
        self, matches: Matches, K_left: Array, K_right: Array, start: PoseEstimate, seconds: Seconds
    ) -> PoseEstimate:
        """From matches and a start that are there already; ``seconds`` is what they took."""
        with seconds.of("solving"):
            prior = transform(start.R, start.t)
            solution = self.solver(matches, K_left, K_right, prior)
        num_inliers = int(np.sum(solution.inliers))
        return PoseEstimate(solution.R, solution.t, solution.covariance, len(matches), num_inliers,
                            seconds, start.notes)  # fmt: skip


METHODS: dict[str, Callable[[], Method]] = {
    "unrectified": lambda: unrectified,
    "network": partial(Network, "small"),
    **{name: partial(rival, name) for name in RIVALS},
    **{
        f"network+{s}": partial(FromMatches, REFINED_BY, SOLVERS[s], Network("small"))
        for s in ("3dof", "5dof")
    },
    **{f"{m}+{s}": partial(FromMatches, m, SOLVERS[s]) for m in MATCHERS for s in SOLVERS},
}
"""made when they are asked for: some take weights"""


def load_method(name: str) -> Method:
    """The method of that name; UserError if there is none, or it lacks its weights."""
    if name not in METHODS:
        raise UserError(f"method {name!r}: expected one of {', '.join(METHODS)}.")
    return METHODS[name]()
