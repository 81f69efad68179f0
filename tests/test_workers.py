"""How many workers: one per core, as far as memory and frames go, whoever sets the limits."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from simgen import doctor, workers
from simgen.workers import (
    free_memory_gb,
    memory_gb,
    num_cores,
    num_workers,
    threads_of_worker,
)

FULL = (2560, 1440)


@pytest.fixture
def machine(monkeypatch, tmp_path: Path):
    """A machine of so many cores and GiB, and the folder of its control groups."""

    def of(cores: int, free_gb: float) -> Path:
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)), raising=False)
        memory = SimpleNamespace(available=free_gb * 2**30, total=64 * 2**30)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
        monkeypatch.setattr(workers, "OWN_CGROUP", tmp_path / "own")
        monkeypatch.setattr(workers, "CGROUPS", tmp_path / "groups")
        return tmp_path / "groups"

    return of


def write(folder: Path, **files: str) -> None:
    """Files of a control group; the names have a _ for the dot."""
    folder.mkdir(parents=True)
    for name, text in files.items():
        (folder / name.replace("_", ".", 1)).write_text(text)


@pytest.mark.parametrize(
    "cores, free_gb, frames, expected",
    [
        (1, 64, 100, 1),
        (2, 64, 100, 2),
        (2, 64, 1, 1),  # one frame: all threads are its own
        (16, 64, 100, 16),
        (16, 16, 100, 5),
        (8, 1, 100, 1),  # as little as it is, somebody has to try
        (2, 64, 0, 1),
    ],
)
def test_workers_of_a_machine(machine, cores, free_gb, frames, expected):
    machine(cores, free_gb)
    assert num_workers(FULL, 3, frames) == expected


def test_limits_of_control_groups_count_wherever_they_are_set(machine):
    groups = machine(16, 64)
    (groups.parent / "own").write_text("0::/job/step\n")
    write(groups, cpu_max="max 100000", memory_max="max")
    write(groups / "job", cpu_max="400000 100000", memory_max="max", memory_current="7")
    write(groups / "job" / "step", memory_max=str(12 * 2**30), memory_current=str(5 * 2**30),
          memory_stat=f"anon 77\ninactive_file {2**30}\nactive_file 3")  # fmt: skip
    assert num_cores() == 4
    assert free_memory_gb() == pytest.approx(8)
    assert num_workers(FULL, 3, 100) == 2
    (groups / "job" / "cpu.max").write_text("50000 100000")
    assert num_cores() == 1


def test_limits_of_version_1_count_too(machine):
    """In a container the path may be the host's; its own limits are at the root."""
    groups = machine(16, 64)
    own = "9:name=systemd:/x\n7:cpu,cpuacct:/docker/7f\n3:memory:/docker/7f\n0::/\n"
    (groups.parent / "own").write_text(own)
    write(groups / "cpu,cpuacct", cpu_cfs_quota_us="300000", cpu_cfs_period_us="100000")
    write(groups / "memory", memory_limit_in_bytes=str(6 * 2**30),
          memory_usage_in_bytes=str(2**30), memory_stat="total_inactive_file 0")  # fmt: skip
    assert (num_cores(), free_memory_gb()) == (3, pytest.approx(5))
    (groups / "cpu,cpuacct" / "cpu.cfs_quota_us").write_text("-1")
    (groups / "memory" / "memory.limit_in_bytes").write_text("9223372036854771712")
    assert (num_cores(), free_memory_gb()) == (16, pytest.approx(64))


@pytest.mark.parametrize("own", ["0::/../..\n", "0::/\n", "", "3:memory:/\n"])
def test_groups_without_limits_limit_nothing(machine, own):
    groups = machine(3, 9)
    (groups.parent / "own").write_text(own)
    assert (num_cores(), free_memory_gb()) == (3, pytest.approx(9))


def test_without_control_groups_the_machine_is_the_limit(machine):
    machine(3, 9)
    assert (num_cores(), free_memory_gb()) == (3, pytest.approx(9))


def test_what_this_machine_allows_is_something():
    assert 1 <= num_cores() <= (os.cpu_count() or 1)
    assert 0 < free_memory_gb() <= psutil.virtual_memory().total / 2**30


def test_small_images_need_less_and_large_ones_more():
    assert memory_gb((640, 360), 3) < memory_gb(FULL, 3) < memory_gb((3848, 2168), 4)
    assert 3 < memory_gb(FULL, 3) < 3.2  # 3.0 GiB were seen there


@pytest.mark.parametrize(
    "cores, workers, expected", [(2, 1, 2), (2, 2, 2), (2, 8, 1), (16, 16, 2), (16, 5, 6)]
)
def test_threads_of_a_worker(machine, cores, workers, expected):
    machine(cores, 64)
    assert threads_of_worker(workers) == expected


def test_the_doctor_says_what_is_left_to_a_process(machine):
    groups = machine(4, 32)
    assert "cores     4 for this process, 4 full-size frames at a time\n" in doctor.diagnosis()
    (groups.parent / "own").write_text("0::/\n")
    write(groups, memory_max=str(2 * 2**30), memory_current="0")
    said = doctor.diagnosis()
    assert "memory    64.0 GiB, 2.0 GiB free for this process\n" in said
    assert "less than 3.1 GiB of memory: render at a smaller --size" in said
