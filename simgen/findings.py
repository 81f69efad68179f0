"""What ``validate`` looks for, and the form in which it says what it found.

Every finding is one number with an upper limit, so that one table can hold them all; fractions
count the pixels that *disagree*.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simgen.photometric import Estimate

BORDER_PX = 1e-3  # end points this close to the border may be called in or out of frame

# What hides a pixel may be a leaf that the other camera's rays miss, and few pixels are few draws:
# of 1306 directions of honest frames with so many occluded pixels, at 160x90 and 640x360, at most
# 0.077 of them have nothing in front; of 326 with fewer, 8 exceed 0.1 (all below 300 pixels).
OCCLUDED_MIN = 400

DECISIVE = 3  # standard errors between an estimate and its limit that decide


def _p99(values: NDArray[np.float64]) -> float:
    return float(np.percentile(values, 99))


@dataclass(frozen=True)
class Check:
    """How the values of one check become one number, and what that number may be."""

    meaning: str
    limit: float
    unit: str = ""
    summary: Callable[[Any], Any] = np.max
    num_min: int = 1
    """with fewer values than this the check does not apply"""


CHECKS: dict[str, Check] = {
    # The set and its files.
    "readable": Check("missing, truncated or foreign files", 0, "files", np.sum),
    "sha256": Check("files that differ from the manifest", 0, "files", np.sum),
    "attributes": Check("missing or foreign file attributes", 0, "", np.sum),
    "frames": Check("frames missing, doubled or not listed", 0, "frames", np.sum),
    "splits": Check("frames and scenes on the wrong side", 0, "", np.sum),
    "settings": Check("frames of other samples or versions than the set's", 0, "frames", np.sum),
    "perturbation_uniform": Check("Kolmogorov-Smirnov distance of the drawn angles from uniform "
                                  "(limit: significance 1e-3)", 0),
    # One frame.
    "schema": Check("arrays of wrong name, shape or type", 0, "arrays", np.sum),
    "finite": Check("NaN, infinite or negative values", 0, "values", np.sum),
    "intrinsics": Check("cameras whose K is no pinhole matrix", 0, "cameras", np.sum),
    "rotation": Check("poses: |RᵀR − I|, |det R − 1|, last row", 1e-9),
    "pose": Check("true pose against nominal ∘ drawn rotation", 1e-9),
    "perturbation_range": Check("drawn angle beyond the rig's maximum", 1e-12, "°"),
    "status_bits": Check("pixels without exactly one visibility bit", 0, "px", np.sum),
    "sky": Check("pixels whose depth, label and status disagree on the sky", 0, "px", np.sum),
    # One frame, from one camera to another.
    "flow": Check("stored flow against depth, K and poses", 1e-3, "px"),
    "out_of_frame": Check("how far from the border a wrong out-of-frame bit is", BORDER_PX, "px"),
    "vertical_flow": Check("vertical flow left after rectification by the poses", 1e-3, "px"),
    "cycle": Check("forward-backward error away from depth edges, 99th percentile", 0.05, "px",
                   _p99, 100),
    "visible_depth": Check("visible pixels with no such depth at the end point", 0.02, "",
                           np.mean, 100),
    "occluded_depth": Check("pixels said to be occluded with nothing in front, of all in frame",
                            0.005, "", np.mean, 100),
    "occluded_share": Check("pixels said to be occluded with nothing in front, of the occluded",
                            0.1, "", np.mean, OCCLUDED_MIN),
    "instance": Check("visible pixels whose instance is not at the end point", 0.03, "",
                      np.mean, 100),
    "semantic": Check("visible pixels whose label is not at the end point", 0.01, "",
                      np.mean, 100),
    "photometric_shift": Check("shift between the images after warping by the flow", 0.05, "px"),
    "photometric_offset": Check("offset of both images against depth and flow", 0.2, "px"),
    "photometric_match": Check("1 − correlation of the image gradients after warping", 0.5),
}  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """The outcome of one check in one place."""

    check: str
    value: float
    """the measured number, NaN where the check does not apply"""
    limit: float
    where: str
    detail: str = ""
    estimate: Estimate | None = None
    """what photometry measured, to be pooled over the set"""

    @property
    def applies(self) -> bool:
        return not np.isnan(self.value)

    @property
    def passed(self) -> bool:
        return not self.applies or self.value <= self.limit


def judge(
    name: str, values: Any, where: str, detail: str = "", *, limit: float | None = None
) -> Finding:
    """Summarises ``values`` the way the check asks for; a result that is NaN fails as infinite."""
    check, values = CHECKS[name], np.atleast_1d(values)
    if values.size < check.num_min:
        return not_applicable(name, where, f"{values.size} values, {check.num_min} needed")
    value = float(check.summary(values))
    limit = check.limit if limit is None else limit
    return Finding(name, np.inf if np.isnan(value) else value, limit, where, detail)


def not_applicable(name: str, where: str, why: str) -> Finding:
    return Finding(name, np.nan, CHECKS[name].limit, where, f"not applicable: {why}")


def judge_estimate(name: str, estimate: Estimate, where: str, limit: float) -> Finding:
    """Judges the components that are above or below the limit by ``DECISIVE`` standard errors."""
    decided = np.abs(np.abs(estimate.uv) - limit) >= DECISIVE * estimate.std_error
    if decided.any():
        length = np.linalg.norm(estimate.uv[decided])
        finding = judge(name, length, where, str(estimate), limit=limit)
    else:
        finding = not_applicable(name, where, f"too uncertain: {estimate}")
    return replace(finding, estimate=estimate)


@dataclass(frozen=True)
class Report:
    """All findings of a set."""

    findings: tuple[Finding, ...]

    @property
    def passed(self) -> bool:
        return not self.failed

    @property
    def failed(self) -> list[Finding]:
        return [f for f in self.findings if not f.passed]

    @property
    def worst(self) -> dict[str, tuple[float, float, str]]:
        """Per check: (value, limit, where) of the finding that comes closest to its limit."""
        order = sorted((f for f in self.findings if f.applies), key=lambda f: f.value - f.limit)
        return {f.check: (f.value, f.limit, f.where) for f in order}

    def table(self) -> str:
        """The worst value of every check, then every failure with its place."""
        rows = [self._row(name) for name in CHECKS]
        failures = [
            f"FAILED {f.check}: {_number(f)}, limit {f.limit:.3g}; {f.where}; {f.detail}"
            for f in self.failed
        ]
        verdict = f"{len(self.findings)} findings, {len(failures)} failed"
        return "\n".join([_HEADER, *rows, "", *failures, verdict])

    def _row(self, name: str) -> str:
        found = [f for f in self.findings if f.check == name]
        if name not in self.worst:
            why = found[0].detail if found else "not reached"
            return f"{name:<21}{'-':>10}{'-':>10}  {'':<9}{why}"
        value, limit, where = self.worst[name]
        verdict = "ok" if value <= limit else "FAILED"
        unit = CHECKS[name].unit
        row = f"{name:<21}{value:>10.3g}{limit:>10.3g}  {unit:<9}{verdict:<8}"
        return f"{row}{sum(f.applies for f in found):>7}  {where}"


_HEADER = f"{'check':<21}{'worst':>10}{'limit':>10}  {'unit':<9}{'':<8}{'places':>7}  worst in"


def _number(finding: Finding) -> str:
    return f"{finding.value:.3g} {CHECKS[finding.check].unit}".rstrip()
