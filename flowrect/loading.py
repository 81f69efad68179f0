"""From pairs to batches: worker processes, a position that resumes exactly, repeatable draws.

What is drawn for a pair follows from (seed, epoch, index) alone, so the same batches come out for
any number of workers. The order of an epoch follows from (seed, epoch); ``PairLoader`` counts the
batches it has *handed out* (workers prepare more than that ahead), which makes its position exact.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from flowrect.augment import Augmentation, augmented
from flowrect.resize import Sizing, sized
from flowrect.sample import Batch, Pair, Prepared, collate
from simgen.errors import UserError

Key = tuple[int, int]  # epoch, index of the pair

_ORDER, _PAIR = 0, 1  # streams of random numbers under one seed


@dataclass(frozen=True)
class Loading:
    """How batches are made."""

    batch: int = 16
    """pairs in a batch, over all processes together"""
    workers: int = 2
    """processes that read and prepare pairs; 0 does it in the training process"""
    seed: int = 0
    """of the order and of everything that is drawn for a pair"""
    shuffle: bool = True
    """a new order every epoch; else the order of the source"""
    drop_last: bool = True
    """leave out an epoch's last batch if it is not full"""


class PreparedPairs(Dataset[Prepared]):
    """Pairs at the network's size, by (epoch, index); without augmentation as they stand."""

    def __init__(
        self,
        pairs: Sequence[Pair],
        sizing: Sizing,
        augmentation: Augmentation | None = None,
        *,
        seed: int,
    ) -> None:
        self.pairs, self.sizing, self.augmentation = pairs, sizing, augmentation
        self._seed = seed

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, key: Key) -> Prepared:
        epoch, index = key
        pair = self.pairs[index]
        if self.augmentation is None:
            return sized(pair, self.sizing)
        rng = np.random.default_rng([self._seed, _PAIR, epoch, index])
        return augmented(pair, self.sizing, self.augmentation, rng=rng)


class EpochBatches(Sampler[list[Key]]):
    """The batches of an epoch that are still to come, and where in the run that is.

    Of ``num_ranks`` processes, each takes every num_ranks-th pair of every batch: together they see
    what one process would.
    """

    def __init__(
        self, num_pairs: int, options: Loading, *, rank: int = 0, num_ranks: int = 1
    ) -> None:
        if options.batch % num_ranks:
            raise UserError(
                f"a batch of {options.batch} cannot be shared by {num_ranks} processes."
            )
        self.epoch, self.done = 0, 0
        self._num_pairs, self._options = num_pairs, options
        self._rank, self._num_ranks = rank, num_ranks
        if not self.per_epoch:
            raise UserError(
                f"{num_pairs} pairs do not fill one batch of {options.batch}; take a smaller batch."
            )

    @property
    def per_epoch(self) -> int:
        """Batches in a whole epoch."""
        batch, partial = self._options.batch, not self._options.drop_last
        return self._num_pairs // batch + (partial and self._num_pairs % batch > 0)

    def __len__(self) -> int:
        return self.per_epoch - self.done

    def __iter__(self) -> Iterator[list[Key]]:
        epoch, order, size = self.epoch, self._order(), self._options.batch
        for start in range(self.done * size, self.per_epoch * size, size):
            share = order[start : start + size][self._rank :: self._num_ranks]
            yield [(epoch, int(index)) for index in share]

    def _order(self) -> np.ndarray:
        if not self._options.shuffle:
            return np.arange(self._num_pairs)
        rng = np.random.default_rng([self._options.seed, _ORDER, self.epoch])
        return rng.permutation(self._num_pairs)


class PairLoader:
    """Iterating gives the rest of the current epoch, then moves on to the next.

    loader = PairLoader(pairs, Sizing(), Augmentation(), Loading())
    for epoch in range(loader.epoch, 80):
        for batch in loader: ...
    """

    def __init__(
        self,
        pairs: Sequence[Pair],
        sizing: Sizing,
        augmentation: Augmentation | None,
        options: Loading,
        *,
        rank: int = 0,
        num_ranks: int = 1,
    ) -> None:
        self._batches = EpochBatches(len(pairs), options, rank=rank, num_ranks=num_ranks)
        self._started = False
        self._loader = DataLoader(
            PreparedPairs(pairs, sizing, augmentation, seed=options.seed),
            batch_sampler=self._batches,
            num_workers=options.workers,
            collate_fn=collate,
            worker_init_fn=_start_worker,
            persistent_workers=options.workers > 0,
            generator=torch.Generator(),  # else workers' base seed is drawn from the global one
        )

    @property
    def epoch(self) -> int:
        """The current epoch, from 0."""
        return self._batches.epoch

    def __len__(self) -> int:
        """Batches in a whole epoch."""
        return self._batches.per_epoch

    def __iter__(self) -> Iterator[Batch]:
        batches = iter(self._loader) if self._started else self._start()
        for batch in batches:
            self._batches.done += 1
            yield batch
        self._batches.epoch, self._batches.done = self._batches.epoch + 1, 0

    def _start(self) -> Iterator[Batch]:
        """The first epoch, which forks the workers."""
        self._started = True
        with _stopping_signals_held():
            return iter(self._loader)

    def state_dict(self) -> dict[str, Any]:
        """The position: the epoch, and how many of its batches were handed out."""
        return {"epoch": self._batches.epoch, "done": self._batches.done}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes to a position; the next batch is the one that would have followed it."""
        self._batches.epoch, self._batches.done = int(state["epoch"]), int(state["done"])


STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def _stopping_signals_held() -> Iterator[None]:
    """Signals that stop a training wait; workers forked meanwhile hold them from birth on."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(_: int) -> None:
    """One thread a worker: they are many, and share the processor with the training.

    Signals that stop a training reach its whole process group; workers outlive them, so that the
    training can save. They end with it.
    """
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
