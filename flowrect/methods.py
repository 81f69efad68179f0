"""Every way to find how two cameras stand, under one signature and by name.

method = load_method("sift+5dof")
estimate = method(left, right, K_left, K_right, prior)    # or raises NoSolution

A method is a matcher with a solver (``MATCHER+SOLVER``), or a network that was trained for it, or
both: ``network+5dof`` starts the fit at what the network says, and ends there if matches do not
suffice. Methods that do not estimate t return the prior's.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Protocol

import numpy as np

from flowrect.calibration import projections
from flowrect.estimate import Calibrator, load_model
from flowrect.matchers import LEARNED, MATCHERS, PARTS, WHOLE_PIXELS, load_matcher
from flowrect.matches import Matches
from flowrect.rivals.config import RIVALS, SharedConfig
from flowrect.sample import Image
from flowrect.solvers import COARSE, SOLVERS, NoSolution, Solver
from flowrect.solvers.fit import require_nearness
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

    @property
    def T_right_left(self) -> Array:
        """(4, 4)"""
        return transform(self.R, self.t)


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
        try:
            yield
        finally:
            self[stage] = self.get(stage, 0.0) + time.perf_counter() - start


def unrectified(
    left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
) -> PoseEstimate:
    """The prior itself."""
    return PoseEstimate(prior[:3, :3], prior[:3, 3])


@dataclass(frozen=True)
class Network:
    """A trained network alone, whichever it is; t is the prior's unless it predicts one.

    It has an answer to any two images. Where its own matches say that these hardly show one scene,
    that is no solution: a vehicle is better off with the calibration that it has.
    """

    model: Calibrator

    def __call__(
        self, left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
    ) -> PoseEstimate:
        seconds = Seconds()
        with seconds.of("network"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are in the notes
            estimate = self.model.estimate(left, right, K_left, K_right, prior)
        if doubts := self.model.match_notes(estimate.match_probability):
            raise NoSolution(doubts[0], seconds=seconds)
        return PoseEstimate(estimate.R, estimate.t, seconds=seconds, notes=estimate.notes)


TRAINED = {
    **{name: f"--model {name}" for name in RIVALS},
    "small-without-flow": "--preset small --teacher none",
}
"""networks that are rows of the tables under the name of their shipped weights, and how
flowrect.train makes them: the rivals, and ours without the flow loss (the paper's "w/o OF")"""


def trained(name: str) -> Network:
    """A network of ``TRAINED``, with its shipped weights; UserError if there are none."""
    if (SHIPPED / f"{name}.safetensors").is_file():
        return Network(_load_model(name))
    raise UserError(
        f"method {name!r}: no weights of it are shipped. Train them (python -m flowrect.train "
        f"{TRAINED[name]} --data shards --out runs/{name}) and ask for "
        f"network=runs/{name}/best.safetensors."
    )


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
        return self.of_matches(matches, seconds, left, right, K_left, K_right, prior)

    def of_matches(
        self, matches: Matches, seconds: Seconds, left: Image, right: Image, K_left: Array,
        K_right: Array, prior: Array,
    ) -> PoseEstimate:  # fmt: skip
        """From matches that are there already; ``seconds`` is what they took."""
        try:
            start, stands = self._start(left, right, K_left, K_right, prior)
            seconds.update(start.seconds)
            return self._solved(matches, K_left, K_right, start, prior, seconds, stands)
        except NoSolution as error:
            spent = {**seconds, **error.seconds}
            raise NoSolution(str(error), num_matches=len(matches), seconds=spent) from error

    def _start(
        self, left: Image, right: Image, K_left: Array, K_right: Array, prior: Array
    ) -> tuple[PoseEstimate, bool]:
        """Where the solver starts, and whether that stands where matches do not suffice."""
        given = left, right, K_left, K_right, prior
        if self.start is unrectified:
            return unrectified(*given), False
        try:
            return self.start(*given), True
        except NoSolution as error:
            h, w = left.shape[:2]
            if not projections(prior, K_left, K_right, (w, h)).vertical:
                raise
            note = f"the network, which knows horizontal rigs only, is left out: {error}"
            return replace(unrectified(*given), seconds=error.seconds, notes=(note,)), False

    def _solved(
        self, matches: Matches, K_left: Array, K_right: Array, start: PoseEstimate, prior: Array,
        seconds: Seconds, stands: bool,
    ) -> PoseEstimate:  # fmt: skip
        """Where matches do not suffice, the start may stand, and that is noted."""
        begin = transform(start.R, prior[:3, 3])  # a t that a network predicts is no calibration
        try:
            with seconds.of("solving"):
                solution = self.solver(*matches.as_seen(K_left, K_right), begin)
            if self.start is not unrectified:  # else the solver has looked, if it is one that does
                require_nearness(solution, prior)
        except NoSolution as error:
            if not stands:
                raise
            note = f"not refined by matches: {error}"
            return replace(start, num_matches=len(matches), notes=(*start.notes, note),
                           seconds=seconds)  # fmt: skip
        num_inliers = int(np.sum(solution.inliers))
        return PoseEstimate(solution.R, solution.t, solution.covariance, len(matches), num_inliers,
                            seconds, start.notes)  # fmt: skip


_load_model = cache(load_model)


def network_of(name: str) -> tuple[str, str]:
    """Weights and solver ("": none) of ``network[=WEIGHTS][+SOLVER]``; a path may have a +.

    UserError if what follows the last + is no solver, and not the end of a file's name either.
    """
    head, _, tail = name.rpartition("+")
    solver = tail if head and tail in SOLVERS else ""
    network = head if solver else name
    weights = network.partition("=")[2] or "small"
    if head and not solver and not Path(weights).is_file():
        raise UserError(
            f"method {name!r}: {tail!r} is no solver, and {weights!r} no file; solvers are "
            f"{', '.join(SOLVERS)}."
        )
    return weights, solver


def _with_network(name: str) -> Method:
    weights, solver = network_of(name)
    start = Network(_load_model(weights))
    return FromMatches(REFINED_BY, SOLVERS[solver], start) if solver else start


METHODS: dict[str, Callable[[], Method]] = {
    "unrectified": lambda: unrectified,
    **{name: partial(_with_network, name) for name in ("network", "network+3dof", "network+5dof")},
    **{name: partial(trained, name) for name in TRAINED},
    **{f"{m}+{s}": partial(FromMatches, m, solve) for m in MATCHERS
       for s, solve in (SOLVERS | (COARSE if m in WHOLE_PIXELS else {})).items()},
}  # fmt: skip
"""made when they are asked for: some take weights"""

_POINTS = tuple(m for m in LEARNED if m != "raft")
_ROBUST = ("loransac-paper", "magsac-paper", "loransac", "magsac", "5dof")
TABLE = (
    *(f"sift-paper+{s}-paper" for s in ("loransac", "usac", "magsac")),
    "sift-paper+loransac",  # what the settings of the matcher alone, and
    "sift+loransac-paper",  # those of the solver alone, explain
    *(f"sift+{s}" for s in ("loransac", "usac", "magsac", "3dof", "5dof")),
    f"{REFINED_BY}+5dof",  # network+5dof without its network
    *(f"{m}+{s}" for m in _POINTS for s in _ROBUST),
    *(f"{m}+{s}" for m in ("dis", "raft") for s in ("3dof", "5dof")),
    *TRAINED,
    "network",
    "network+5dof",
)
"""the rows of the paper's tables, and ours"""


def load_method(name: str) -> Method:
    """The method of that name; ``network=FILE`` and ``network=FILE+SOLVER`` are names, too.

    UserError if there is none, or it lacks its weights.
    """
    if name.startswith("network="):
        return _with_network(name)
    if name not in METHODS:
        raise UserError(f"method {name!r}: expected one of {', '.join(METHODS)}, or network=FILE.")
    return METHODS[name]()


def training_of(name: str) -> str:
    """What the networks that were trained here for a method see, and their hours; "–": none."""
    method = load_method(name)
    trained_here = []
    network = method.start if isinstance(method, FromMatches) else method
    if isinstance(network, Network):
        config, hours = network.model.network.config, network.model.card.hours
        w, h = config.network_wh if isinstance(config, SharedConfig) else config.input_wh
        trained_here.append(f"{w}×{h}" + (f", {hours:.1f} h" if hours else ""))
    if isinstance(method, FromMatches) and "raft" in PARTS.get(method.matcher, (method.matcher,)):
        from flowrect.flow_network import card_of  # needs torchvision, 2 s of every start
        from flowrect.matchers.raft import weights

        hours = card_of(weights()).hours
        trained_here.append(f"as delivered{f', {hours:.1f} h' if hours else ''}")
    return "; ".join(trained_here) or "–"
