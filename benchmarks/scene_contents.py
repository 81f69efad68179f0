"""What is in the frames of a set: weather, daylight and recipes, labels, instances, distances.

    simgen render --n 192 --size 640x360 --seed 51 --out set
    python benchmarks/scene_contents.py set

Label ids (sky and road included) and instances are counted per image, and averaged over the images
of a recipe; distances are shares of all pixels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from _table import markdown

from simgen.shards import Frame, ShardSet

FAR_M = (100.0, 300.0)


@dataclass(frozen=True)
class Options:
    """What is in the frames of a set."""

    folder: Annotated[Path, tyro.conf.Positional]


@dataclass(frozen=True)
class Contents:
    """Of one frame."""

    recipe: str
    weather: str
    daylight: str
    labels: float
    """different ids in an image, mean of its cameras"""
    instances: float
    sky: float
    """share of pixels without a surface"""
    far: tuple[float, ...]
    """shares of pixels beyond each of ``FAR_M``"""


def main(options: Options) -> None:
    """Prints the tables."""
    found = [contents(frame) for frame in ShardSet(options.folder)]
    for name in ("weather", "daylight", "recipe"):
        shares = Counter(getattr(c, name) for c in found)
        rows = [(key, num, num / len(found)) for key, num in shares.most_common()]
        print(markdown((name, "frames", "share"), rows), end="\n\n")
    header = ("recipe", "frames", "label ids in an image", "instances in an image")
    print(markdown(header, list(_by_recipe(found))), end="\n\n")
    sky, far = np.mean([c.sky for c in found]), np.mean([c.far for c in found], axis=0)
    beyond = ", ".join(f"{s:.1%} beyond {m:g} m" for s, m in zip(far, FAR_M, strict=True))
    print(f"{len(found)} frames; of the pixels {beyond}, {sky:.0%} sky")


def contents(frame: Frame) -> Contents:
    """Counted in the frame's arrays."""
    spec, depth = frame.spec, frame.depth
    return Contents(
        spec["recipe"],
        spec["weather"]["name"],
        spec["daylight"]["name"],
        labels=float(np.mean([len(np.unique(x)) for x in frame.semantic])),
        instances=float(np.mean([len(np.unique(x[x > 0])) for x in frame.instance])),
        sky=float(np.mean(depth == 0)),
        far=tuple(float(np.mean(depth > m)) for m in FAR_M),
    )


def _by_recipe(found: list[Contents]) -> Iterable[tuple[str, int, float, float]]:
    for recipe in sorted({c.recipe for c in found}):
        own = [c for c in found if c.recipe == recipe]
        yield (
            recipe,
            len(own),
            *(float(np.mean([getattr(c, name) for c in own])) for name in ("labels", "instances")),
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
