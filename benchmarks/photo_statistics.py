"""Image statistics of a set against those of four real stereo photographs.

    simgen render --n 300 --sensor ideal --weather clear,partly_cloudy --out set
    python benchmarks/photo_statistics.py set [--csv frames.csv]

Every image of one camera is scaled to 640 pixels wide (area filter); medians over the frames are
compared with the span of the photographs. ``simgen/statistics.py`` defines each number. Any other
picture can be measured by giving its path in place of a set's: the left and right image of the
motorcycle that scikit-image distributes come out at slope −2.45 and −2.43, 8,040 and 8,010 key
points, flat .14 and .16, contrast .22 and .22, saturation .32 and .33, kurtosis 12.9 and 13.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from _table import markdown, write_csv
from numpy.typing import NDArray

from simgen.shards import ShardSet
from simgen.statistics import photo_statistics

WIDTH = 640
PHOTOGRAPHS = {
    "slope": (-2.79, -2.86, -2.47, -3.21),
    "keypoints": (9366.0, 3836.0, 7750.0, 3996.0),
    "flat": (0.18, 0.28, 0.14, 0.26),
    "contrast": (0.31, 0.25, 0.22, 0.25),
    "saturation": (0.28, 0.27, 0.33, 0.38),
    "kurtosis": (16.0, 45.0, 13.0, 22.0),
}
"""a driving scene, a room, a motorcycle (Middlebury 2014) and a table"""


@dataclass(frozen=True)
class Options:
    """Image statistics of a set against those of four real stereo photographs."""

    paths: Annotated[list[Path], tyro.conf.Positional]
    """folders of sets, or image files"""
    camera: int = 0
    csv: Path | None = None
    """writes the numbers of every image to this file"""


def main(options: Options) -> None:
    """Prints the table."""
    labels, measured = [], []
    for label, image in _images(options):
        labels.append(label)
        measured.append(asdict(photo_statistics(_scaled(image))))
    medians = {name: float(np.median([m[name] for m in measured])) for name in PHOTOGRAPHS}
    spread = {name: np.percentile([m[name] for m in measured], (10, 90)) for name in PHOTOGRAPHS}
    rows = [
        (name, *PHOTOGRAPHS[name], median, "{:.3g} … {:.3g}".format(*spread[name]), verdict)
        for (name, median), verdict in zip(medians.items(), _verdicts(medians), strict=True)
    ]
    header = ("", "driving", "room", "motorcycle", "table", "median", "10–90 %", "in the span")
    print(f"{len(measured)} images, {WIDTH} pixels wide\n\n{markdown(header, rows)}")
    if options.csv:
        frames = [(k, *m.values()) for k, m in zip(labels, measured, strict=True)]
        write_csv(options.csv, ("image", *PHOTOGRAPHS), frames)


def _images(options: Options) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    for path in options.paths:
        if path.is_dir():
            for frame in ShardSet(path):
                name = f"{int(frame.frame_index)} {frame.spec['recipe']}"
                yield name, frame.read("image", options.camera)
        else:
            yield path.name, cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)


def _scaled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = round(WIDTH * image.shape[0] / image.shape[1])
    return np.asarray(cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA))


def _verdicts(medians: Mapping[str, float]) -> Iterator[str]:
    """Whether each median is within the photographs' span, or how far beyond which end."""
    for name, value in medians.items():
        low, high = min(PHOTOGRAPHS[name]), max(PHOTOGRAPHS[name])
        if low <= value <= high:
            yield "yes"
        else:
            end = low if value < low else high
            yield f"{100 * abs(value / end - 1):.0f} % {'below' if value < low else 'above'}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
