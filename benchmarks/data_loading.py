"""How many pairs per second reach the network, from sets of the sizes given?

    python benchmarks/data_loading.py SET [SET ...] [--workers 2] [--batch 8] [--cache FOLDER]

For each rendered set, a mean over the time given after one batch of warm-up:

*read* decodes both images and makes the ground truth, in this process.
*as it stands* and *augmented* are whole batches for the ``small`` preset from a PairLoader with its
workers: crop and area filter alone, or everything that training draws.
*copy* is *augmented* from a reduced copy (``flowrect/cache.py``), *making it* the pairs per second
while the copy was made. The loop takes batches as fast as they come: no training runs beside it.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Annotated, Any

import tyro
from _table import markdown, write_csv

from flowrect.augment import Augmentation
from flowrect.cache import cached
from flowrect.config import TRAINING
from flowrect.loading import Loading, PairLoader
from flowrect.resize import Sizing
from flowrect.sample import Pair
from flowrect.sources import Pairs, open_source
from flowrect.turn import largest_keep

HEADER = ("set", "size", "read", "as it stands", "augmented", "making the copy", "copy")


@dataclass(frozen=True)
class Options:
    """What to measure."""

    sets: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """folders of rendered sets"""
    workers: int = 2
    """processes of the loader"""
    batch: int = TRAINING["small"].loading.batch
    """pairs in a batch; what ``small`` trains with"""
    seconds: float = 15.0
    """to measure each column for"""
    cache: Path | None = None
    """where copies go; a temporary folder if left out"""
    copy_width: int = 640
    """width of the copy [px]; larger than the 512 of the losses"""
    csv: Path | None = None
    """write the table here, too"""


def main(options: Options) -> None:
    """Prints the table."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.cache or Path(temporary)
        rows = [_measure(open_source(s), s.name, folder, options) for s in options.sets]
    print(f"pairs per second, {options.workers} workers, {os.cpu_count()} cores")
    print(markdown(HEADER, rows))
    if options.csv:
        write_csv(options.csv, HEADER, rows)


def _measure(pairs: Pairs[Any], name: str, folder: Path, options: Options) -> list[object]:
    first = pairs[0]
    w, h = first.wh
    width = min(w, options.copy_width)
    start, num_before = time.perf_counter(), len(list(folder.glob("*")))
    copy = cached(pairs, folder, (width, width * h // w), workers=options.workers)
    made = len(list(folder.glob("*"))) > num_before
    making = len(pairs) / (time.perf_counter() - start) if made else "made before"
    return [
        name,
        f"{w}x{h}",
        _rate((1 for _ in chain.from_iterable(repeat(pairs))), options.seconds),
        _rate(_batches(pairs, first, None, options), options.seconds),
        _rate(_batches(pairs, first, Augmentation(), options), options.seconds),
        making,
        _rate(_batches(copy, first, Augmentation(), options), options.seconds),
    ]


def _batches(
    pairs: Pairs[Any], first: Pair, augmentation: Augmentation | None, options: Options
) -> Iterable[int]:
    """Sizes of endless batches."""
    sizing = Sizing(keep=largest_keep(first, Sizing(), 2 * Augmentation().turn_deg) - 0.01)
    batch = min(options.batch, len(pairs))
    loader = PairLoader(pairs, sizing, augmentation, Loading(batch, options.workers))
    return (len(b) for b in chain.from_iterable(repeat(loader)))


def _rate(counts: Iterable[int], seconds: float) -> float:
    """Sum of the counts per second, after the first."""
    iterator = iter(counts)
    sum(islice(iterator, 1))
    start, total = time.perf_counter(), 0
    for count in iterator:
        total += count
        if (passed := time.perf_counter() - start) > seconds:
            break
    return total / passed


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
