"""How many workers: one per core, as far as memory and frames go."""

from __future__ import annotations

import os
from types import SimpleNamespace

import psutil
import pytest

from simgen.workers import memory_gb, num_workers, threads_of_worker

FULL = (2560, 1440)


@pytest.mark.parametrize(
    "cores, free_gb, frames, expected",
    [
        (1, 64, 100, 1),
        (2, 64, 100, 2),
        (2, 64, 1, 1),  # one frame: all threads are its own
        (16, 64, 100, 16),
        (16, 16, 100, 5),
        (8, 1, 100, 1),  # as little as it is, somebody has to try
        (None, 64, 100, 1),
        (2, 64, 0, 1),
    ],
)
def test_workers_of_a_machine(monkeypatch, cores, free_gb, frames, expected):
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    memory = SimpleNamespace(available=free_gb * 2**30)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    assert num_workers(FULL, 3, frames) == expected


def test_small_images_need_less_and_large_ones_more():
    assert memory_gb((640, 360), 3) < memory_gb(FULL, 3) < memory_gb((3848, 2168), 4)
    assert 2.6 < memory_gb(FULL, 3) < 3  # 2.6 GiB were seen there


@pytest.mark.parametrize(
    "cores, workers, expected", [(2, 1, 2), (2, 2, 2), (2, 8, 1), (16, 16, 2), (16, 5, 6)]
)
def test_threads_of_a_worker(monkeypatch, cores, workers, expected):
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert threads_of_worker(workers) == expected
