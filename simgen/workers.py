"""How many processes may render at the same time on this machine, and with how many threads.

A container or a batch system may leave a process less than the machine has: its cores and memory
are the least of what the machine, its affinity and its control groups (Linux, version 2) allow.
"""

from __future__ import annotations

import os
from pathlib import Path

import psutil

OWN_CGROUP = Path("/proc/self/cgroup")
CGROUPS = Path("/sys/fs/cgroup")
MEMORY_FIXED_GB = 1.4
MEMORY_PER_MEGAPIXEL_GB = 0.14
"""of all images of a rig frame; with the above, what a worker was seen to take at most (2.8
to 3.0 GiB for three images of 2560x1440)"""


def memory_gb(wh: tuple[int, int], cameras: int) -> float:
    """What a worker needs for rig frames of that size [GiB]."""
    return MEMORY_FIXED_GB + MEMORY_PER_MEGAPIXEL_GB * cameras * wh[0] * wh[1] / 1e6


def num_workers(wh: tuple[int, int], cameras: int, frames: int) -> int:
    """One per core, as far as memory and frames go; at least one.

    Much of a frame is the work of one thread. With a worker per core no core waits for it: on two
    cores, full-size frames came a sixth faster than from one worker with two threads.
    """
    fit = int(free_memory_gb() / memory_gb(wh, cameras))
    return max(1, min(num_cores(), fit, frames))


def threads_of_worker(workers: int) -> int:
    """Twice its share of the cores: the last frames of a run have them to themselves.

    While all work, as many threads as cores were no faster.
    """
    cores = num_cores()
    return min(cores, max(1, 2 * cores // workers))


def num_cores() -> int:
    """Cores that this process may use."""
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    for group in _cgroups():
        quota, period = [*_words(group / "cpu.max"), "max", "1"][:2]
        if quota != "max":
            cores = min(cores, max(1, int(quota) // int(period)))
    return cores


def free_memory_gb() -> float:
    """Memory that this process may still take [GiB]; what only caches files counts as free."""
    free = psutil.virtual_memory().available
    for group in _cgroups():
        limit, used = _words(group / "memory.max"), _words(group / "memory.current")
        if limit and used and limit[0] != "max":
            stat = _words(group / "memory.stat")
            cached = dict(zip(stat[::2], stat[1::2], strict=False)).get("inactive_file", "0")
            free = min(free, int(limit[0]) - int(used[0]) + int(cached))
    return free / 2**30


def _cgroups() -> list[Path]:
    """The control group of this process and those above it."""
    lines = OWN_CGROUP.read_text().splitlines() if OWN_CGROUP.exists() else []
    own = [CGROUPS / line[3:].lstrip("/") for line in lines if line.startswith("0::")]
    return [g for group in own for g in (group, *group.parents) if g.is_relative_to(CGROUPS)]


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []
