"""Batches depend on seed and position alone: not on workers, interruptions or ranks."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from painted import painted_pair
from small_set import make_frame, write_set

from flowrect import loading
from flowrect.augment import Augmentation
from flowrect.cache import cached
from flowrect.loading import EpochBatches, Loading, PairLoader
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, resized, sized
from flowrect.sample import Batch, Pair, collate
from flowrect.sources import Pairs, open_source
from simgen.errors import UserError
from simgen.geometry import project

SIZING = Sizing((64, 32), keep=0.85)
FAST = Loading(batch=2, workers=0, seed=3)
COLOUR = Augmentation(turn_deg=0)  # drawn as everything else is, and quicker


def _painted(seed: int) -> Pair:
    return painted_pair(seed)


@pytest.fixture(scope="module")
def pairs() -> Pairs[int]:
    return Pairs(range(7), _painted, layout="painted", fingerprint="")


def _equal(a: Batch, b: Batch) -> bool:
    tensors = [f.name for f in fields(Batch) if isinstance(getattr(a, f.name), torch.Tensor)]
    return a.names == b.names and all(torch.equal(getattr(a, n), getattr(b, n)) for n in tensors)


def _epochs(loader: PairLoader, number: int) -> list[Batch]:
    return [batch for _ in range(number) for batch in loader]


def test_batches_do_not_depend_on_the_number_of_workers(pairs: Pairs[int]) -> None:
    loaders = [
        PairLoader(pairs, SIZING, Augmentation(), replace(FAST, workers=n)) for n in (0, 1, 2)
    ]
    here, one, two = (_epochs(loader, 2) for loader in loaders)
    assert len(here) == 6
    assert all(_equal(a, b) and _equal(a, c) for a, b, c in zip(here, one, two, strict=True))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_outlive_a_signal_to_the_process_group(
    pairs: Pairs[int], number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch system stops all processes of a training, which has to save first.

    The second worker is still starting when the first one's batch is there and the signal comes.
    """
    start = loading._start_worker
    monkeypatch.setattr(loading, "_start_worker", lambda n: (time.sleep(n), start(n)))
    loader = PairLoader(pairs, SIZING, None, Loading(batch=1, workers=2))
    seen = 0
    for batch in loader:
        if not seen:
            workers = multiprocessing.active_children()
            assert len(workers) == 2
            for worker in workers:
                assert worker.pid is not None
                os.kill(worker.pid, number)
        seen += len(batch)
    assert seen == len(pairs)
    del loader
    assert not multiprocessing.active_children()


@pytest.fixture(scope="module")
def whole(pairs: Pairs[int]) -> list[Batch]:
    """Two epochs without an interruption, which do not depend on the number of workers."""
    return _epochs(PairLoader(pairs, SIZING, COLOUR, FAST), 2)


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("stop", [1, 3, 4])
def test_resumed_order_is_the_uninterrupted_one(
    pairs: Pairs[int], whole: list[Batch], workers: int, stop: int
) -> None:
    options = replace(FAST, workers=workers)
    first = PairLoader(pairs, SIZING, COLOUR, options)
    seen, state = [], {}
    while len(seen) < stop:
        for batch in first:
            seen.append(batch)
            state = first.state_dict()
            if len(seen) == stop:
                break
    second = PairLoader(pairs, SIZING, COLOUR, options)
    second.load_state_dict(state)
    while second.epoch < 2:
        seen.extend(second)
    assert [b.names for b in seen] == [b.names for b in whole]
    assert all(_equal(a, b) for a, b in zip(seen, whole, strict=True))


def test_ranks_share_what_one_process_sees(pairs: Pairs[int]) -> None:
    options = Loading(batch=4, drop_last=False)
    one = list(EpochBatches(len(pairs), options))
    ranks = [list(EpochBatches(len(pairs), options, rank=r, num_ranks=2)) for r in (0, 1)]
    for whole, a, b in zip(one, *ranks, strict=True):
        assert sorted(whole) == sorted(a + b)
    with pytest.raises(UserError, match="a batch of 4 cannot be shared by 3 processes"):
        EpochBatches(7, options, num_ranks=3)


def test_epoch_sees_every_pair_once_and_the_next_in_another_order(pairs: Pairs[int]) -> None:
    batches = EpochBatches(40, Loading(batch=16, drop_last=False))
    first = [index for batch in batches for _, index in batch]
    batches.epoch = 1
    second = [index for batch in batches for _, index in batch]
    assert sorted(first) == sorted(second) == list(range(40))
    assert first != second != list(range(40))
    assert len(EpochBatches(40, Loading(batch=16))) == 2


def test_source_order_is_kept_without_shuffling(pairs: Pairs[int]) -> None:
    batches = EpochBatches(5, Loading(batch=2, shuffle=False, drop_last=False))
    assert [[i for _, i in batch] for batch in batches] == [[0, 1], [2, 3], [4]]


def test_pair_is_turned_afresh_in_every_epoch(pairs: Pairs[int]) -> None:
    options = replace(FAST, shuffle=False)
    first, second = (
        list(epoch) for epoch in [PairLoader(pairs, SIZING, Augmentation(), options)] * 2
    )
    assert first[0].names == second[0].names
    assert first[0].R is not None
    assert second[0].R is not None
    assert not torch.allclose(first[0].R, second[0].R)


def test_loading_leaves_global_generators_alone(pairs: Pairs[int]) -> None:
    np_state, torch_state = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    _epochs(PairLoader(pairs, SIZING, COLOUR, replace(FAST, workers=1)), 1)
    assert torch.equal(torch_state, torch.get_rng_state())
    np.testing.assert_array_equal(np_state, np.random.get_state()[1])  # noqa: NPY002


def test_too_few_pairs_for_a_batch_are_refused() -> None:
    with pytest.raises(UserError, match="3 pairs do not fill one batch of 16"):
        EpochBatches(3, Loading())


def test_batch_has_the_stated_shapes_and_scales(pairs: Pairs[int]) -> None:
    batch = next(iter(PairLoader(pairs, SIZING, Augmentation(), FAST)))
    assert batch.left.shape == (2, 3, 32, 64)
    assert batch.right_metric.shape == (2, 3, *METRIC_WH[::-1])
    assert batch.left.dtype == torch.float32
    assert 0.5 < batch.left.max() <= 1
    ratio = batch.K_left_metric[:, 0, 0] / batch.K_left[:, 0, 0]
    assert torch.allclose(ratio, torch.tensor(512 / 64, dtype=torch.float64))
    assert batch.truth is not None
    assert batch.truth.rays_left.shape == (2, len(painted_pair().truth.depth), 3)


def test_batch_with_an_unknown_pose_has_none(pairs: Pairs[int]) -> None:
    known = painted_pair()
    unknown = replace(known, T_right_left=None, truth=None)
    batch = collate([sized(known, SIZING), sized(unknown, SIZING)])
    assert batch.R is None
    assert batch.t is None
    assert batch.truth is None
    assert batch.R_nominal.shape == (2, 3, 3)


def test_shards_feed_batches_whose_rays_obey_their_pose(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", [make_frame(i, limit_deg=1.0) for i in (1, 2, 3)])
    loader = PairLoader(
        open_source(folder, split="train"), replace(SIZING, keep=0.8), Augmentation(), FAST
    )
    for batch in _epochs(loader, 1):
        truth = batch.truth
        assert truth is not None
        points = truth.depth[..., None] * truth.rays_left
        seen = points @ batch.R.mT + batch.t[:, None]
        near = truth.depth > 0
        torch.testing.assert_close(
            (seen / seen[..., 2:])[near], truth.rays_right[near], atol=1e-12, rtol=0
        )


# --- cache -------------------------------------------------------------------------------------


def test_cached_pairs_equal_resized_ones(tmp_path: Path) -> None:
    pairs = open_source(write_set(tmp_path / "set", [make_frame(i) for i in (1, 2)]))
    done: list[tuple[int, int]] = []
    small = cached(pairs, tmp_path / "cache", (48, 27), workers=1, report=lambda *n: done.append(n))
    assert done == [(i + 1, 6) for i in range(6)]
    for original, copy in zip(pairs, small, strict=True):
        expected = resized(original, (48, 27))
        for name in (f.name for f in fields(Pair) if f.name != "truth"):
            np.testing.assert_array_equal(getattr(copy, name), getattr(expected, name))
        for name in ("rays_left", "rays_right", "visible", "depth"):
            np.testing.assert_array_equal(getattr(copy.truth, name), getattr(expected.truth, name))


def test_cache_is_made_once_and_anew_for_other_content(tmp_path: Path) -> None:
    folder, cache = tmp_path / "set", tmp_path / "cache"
    calls: list[int] = []

    def report(done: int, _: int) -> None:
        calls.append(done)

    pairs = open_source(write_set(folder, [make_frame(1)]))
    for _ in range(2):
        cached(pairs, cache, (48, 27), workers=0, report=report)
    assert len(calls) == 3
    other = open_source(write_set(tmp_path / "other", [make_frame(2)]))
    cached(other, cache, (48, 27), workers=0, report=report)
    assert len(calls) == 6
    assert len(list(cache.iterdir())) == 2


def test_cache_keeps_pairs_without_truth(tmp_path: Path) -> None:
    pairs = Pairs(range(2), _without_truth, layout="painted", fingerprint="x")
    copy = cached(pairs, tmp_path, (320, 180), workers=0)[1]
    assert copy.truth is None
    assert copy.T_right_left is None
    assert copy.name == "painted 1"
    np.testing.assert_allclose(
        project(copy.K_left, np.array([0.0, 0, 1])), (painted_pair().K_left[:2, 2] + 0.5) / 2 - 0.5
    )


def _without_truth(seed: int) -> Pair:
    return replace(painted_pair(seed), truth=None, T_right_left=None)


def test_interrupted_cache_leaves_nothing_behind(tmp_path: Path) -> None:
    pairs = open_source(write_set(tmp_path / "set", [make_frame(1)]))

    def stop(done: int, _: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cached(pairs, tmp_path / "cache", (48, 27), workers=0, report=stop)
    assert not list((tmp_path / "cache").iterdir())


def test_cache_larger_than_its_source_is_refused(tmp_path: Path) -> None:
    pairs = open_source(write_set(tmp_path / "set", [make_frame(1)]))
    with pytest.raises(UserError, match=r"96x54 is smaller than the copy of 640x360"):
        cached(pairs, tmp_path / "cache", (640, 360), workers=0)
