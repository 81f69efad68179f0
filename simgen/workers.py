"""How many processes may render at the same time on this machine, and with how many threads.

A container or a batch system may leave a process less than the machine has: its cores and memory
are the least of what the machine, its affinity and its control groups (Linux) allow.
"""

from __future__ import annotations

import os
from pathlib import Path

import psutil

OWN_CGROUP = Path("/proc/self/cgroup")
CGROUPS = Path("/sys/fs/cgroup")
MEMORY_FIXED_GB = 1.4
MEMORY_PER_MEGAPIXEL_GB = 0.15
"""of all images of a rig frame; with the above, a little more than a worker was seen to take at
most (3.0 GiB for three images of 2560x1440)"""
PARENT_GB = 0.5
"""of the process that assembles shards"""


def memory_gb(wh: tuple[int, int], cameras: int) -> float:
    """What a worker needs for rig frames of that size [GiB]."""
    return MEMORY_FIXED_GB + MEMORY_PER_MEGAPIXEL_GB * cameras * wh[0] * wh[1] / 1e6


def num_workers(wh: tuple[int, int], cameras: int, frames: int) -> int:
    """One per core, as far as memory and frames go; at least one.

    Much of a frame is the work of one thread. With a worker per core no core waits for it: on two
    cores, a full-size frame took 47 to 51 s of the clock, and 54 by one worker with two threads.
    """
    fit = int((free_memory_gb() - PARENT_GB) / memory_gb(wh, cameras))
    return max(1, min(num_cores(), fit, frames))


def threads_of_worker(workers: int) -> int:
    """Twice its share of the cores: on few, the last frame of a run does not leave half idle.

    While all work, no more threads than cores were no faster.
    """
    cores = num_cores()
    return min(cores, max(1, 2 * cores // workers))


def num_cores() -> int:
    """Cores that this process may use."""
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    for group in _groups("cpu"):
        quotas = _numbers(group, "cpu.max") or [
            *_numbers(group, "cpu.cfs_quota_us"), *_numbers(group, "cpu.cfs_period_us")
        ]  # fmt: skip
        if len(quotas) == 2 and quotas[0] > 0:
            cores = min(cores, max(1, quotas[0] // quotas[1]))
    return cores


def free_memory_gb() -> float:
    """Memory that this process may still take [GiB]; what only caches files counts as free."""
    free = psutil.virtual_memory().available
    for group in _groups("memory"):
        limit = _numbers(group, "memory.max") or _numbers(group, "memory.limit_in_bytes")
        used = _numbers(group, "memory.current") or _numbers(group, "memory.usage_in_bytes")
        if limit and used:
            free = min(free, limit[0] - used[0] + _cached(group))
    return free / 2**30


def _cached(group: Path) -> int:
    stat = dict(line.split() for line in _lines(group / "memory.stat"))
    return int(stat.get("total_inactive_file", stat.get("inactive_file", 0)))


def _groups(controller: str) -> list[Path]:
    """Control groups of this process and those above them, of version 2 and of version 1."""
    found = []
    for line in _lines(OWN_CGROUP):
        _, controllers, path = line.split(":", 2)
        if controllers in ("", controller) or controller in controllers.split(","):
            root = CGROUPS / controllers
            own = root / path.lstrip("/")
            found += [g for g in (own, *own.parents) if g.is_relative_to(root)]
    return found


def _numbers(group: Path, name: str) -> list[int]:
    """Of the first line of a file; none where there is no limit, or no such file."""
    words = next(iter(_lines(group / name)), "max").split()
    return [] if "max" in words else [int(word) for word in words]


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []
