"""What matches, or a flow network, say is left of a rectified pair; measured once, and kept.

Such a figure is a function of two images and of what looks at them. OUT/offsets/NAME.jsonl holds
one line for each pair of images that was looked at, known by their digest: an interrupted or
repeated scoring measures what is new alone, and images that two rows share, such as the truth's for
both t, once.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flowrect.evaluation import stamp
from flowrect.losses import across_epipolar_lines
from flowrect.matches import Matcher
from flowrect.sample import Image
from simgen.geometry import Array

FLOW, FLOW_VALID = "raft_flow_px", "raft_flow_valid_px"
"""mean |vertical flow| by a flow network: of all pixels, and of those that both images fill"""


class Look(Protocol):
    """Figures [px] of rectified images (H, W, 3), both filled where ``valid`` (H, W)."""

    def figures(
        self, left: Image, right: Image, valid: NDArray[np.bool_], *, vertical: bool
    ) -> Mapping[str, float]: ...


@dataclass(frozen=True)
class Memory:
    """Figures by key, in a file."""

    path: Path
    _known: dict[str, dict[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path.exists():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                self._remember(line)

    def of(self, key: str, measure: Callable[[], dict[str, float]]) -> dict[str, float]:
        """What is known of the key, or is measured now."""
        if key not in self._known:
            self._known[key] = measure()
            self._append({"key": key, **self._known[key]})
        return self._known[key]

    def tried(self, key: str, measure: Callable[[], dict[str, float]]) -> dict[str, float] | None:
        """The same, but None where measuring raises: that is said, and the next run tries again.

        Hours of other pairs are not lost by one. What raises is OSError alone: the disk is full, or
        a file is gone.
        """
        try:
            return self.of(key, measure)
        except OSError:
            raise
        except Exception as error:
            what = f"{self.path.stem} of rectified images: {type(error).__name__}: {error}"
            warnings.warn(what, stacklevel=3)
            return None

    def _remember(self, line: str) -> None:
        try:
            row = json.loads(line)
            self._known[row.pop("key")] = row
        except (ValueError, KeyError, TypeError, AttributeError):
            return  # cut off by a crash: it is measured again

    def _append(self, row: dict[str, object]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps(row))  # begins a line, whatever the last one lacks


@dataclass(frozen=True)
class Offsets:
    """|dy| of all matches, |dx| of a vertical rig: mean, as the paper has it, and median.

    NaN without any match, or where the matcher raises.
    """

    name: str
    """of the columns"""
    match: Matcher
    memory: Memory

    def figures(
        self, left: Image, right: Image, valid: NDArray[np.bool_], *, vertical: bool
    ) -> Mapping[str, float]:
        """As Look; the black of what is not filled has no matches."""
        key = digest(stamp.of_matcher(self.name).encode(), bytes([vertical]), left, right)
        known = self.memory.tried(key, lambda: self._measured(left, right, vertical))
        return self._figures(np.empty(0)) if known is None else known

    def _measured(self, left: Image, right: Image, vertical: bool) -> dict[str, float]:
        matches = self.match(left, right)
        return self._figures(np.abs((matches.uv_right - matches.uv_left)[:, 0 if vertical else 1]))

    def _figures(self, across: Array) -> dict[str, float]:
        known = len(across) > 0
        return {
            f"{self.name}_offset_px": float(across.mean()) if known else np.nan,
            f"{self.name}_offset_median_px": float(np.median(across)) if known else np.nan,
        }


Flow = Callable[[Tensor, Tensor], Tensor]
"""images (B, 3, H, W) in 0…1 to flow (B, 2, H, W) [px] from left to right"""


@dataclass(frozen=True)
class VerticalFlow:
    """Mean |vertical flow| by a network, |horizontal flow| of a vertical rig; NaN if it raises.

    In half precision: of 12 pairs all figures of ``benchmarks/flow_metric.py`` stay within 0.001
    px of those in single precision, for two thirds of the time.
    """

    flow: Flow
    stamp: str
    """of the code and of the weights"""
    memory: Memory

    @staticmethod
    def by(name: str, path: Path) -> VerticalFlow:
        """By the network of ``load_flow``; UserError if there is none of that name."""
        from flowrect.flow_network import load_flow  # needs torchvision, 2 s of every start

        network = load_flow(name)
        weights = (x.numpy() for x in network.state_dict().values())
        by = f"{stamp.of_flow()} {network.magnify} {network.updates} bf16"
        return VerticalFlow(network.flow, digest(by.encode(), *weights), Memory(path))

    def figures(
        self, left: Image, right: Image, valid: NDArray[np.bool_], *, vertical: bool
    ) -> Mapping[str, float]:
        """As Look."""
        key = digest(self.stamp.encode(), bytes([vertical]), left, right, valid)
        known = self.memory.tried(key, lambda: self._measured(left, right, valid, vertical))
        return dict.fromkeys((FLOW, FLOW_VALID), np.nan) if known is None else known

    @torch.inference_mode()
    def _measured(
        self, left: Image, right: Image, valid: NDArray[np.bool_], vertical: bool
    ) -> dict[str, float]:
        first, second = (torch.from_numpy(x).permute(2, 0, 1)[None] / 255 for x in (left, right))
        with torch.autocast("cpu", torch.bfloat16):
            flow = self.flow(first, second).float().permute(0, 2, 3, 1)
        across = across_epipolar_lines(flow, torch.tensor([vertical]))[0].abs()
        return {
            FLOW: across.mean().item(),
            FLOW_VALID: across[torch.from_numpy(valid)].mean().item(),
        }


def digest(*parts: bytes | NDArray[np.generic]) -> str:
    """Of bytes and arrays, one after the other."""
    whole = hashlib.sha256()
    for part in parts:
        whole.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return whole.hexdigest()[:24]
