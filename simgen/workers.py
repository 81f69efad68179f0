"""How many processes may render at the same time on this machine."""

from __future__ import annotations

import os

import psutil

MEMORY_FIXED_GB = 1.4
MEMORY_PER_MEGAPIXEL_GB = 0.12
"""of all images of a rig frame; with the above, what a worker was seen to take at most, rounded up
(2.6 GiB for three images of 2560x1440)"""


def memory_gb(wh: tuple[int, int], cameras: int) -> float:
    """What a worker needs for rig frames of that size [GiB]."""
    return MEMORY_FIXED_GB + MEMORY_PER_MEGAPIXEL_GB * cameras * wh[0] * wh[1] / 1e6


def num_workers(wh: tuple[int, int], cameras: int, frames: int) -> int:
    """One per core, as far as memory and frames go; at least one.

    Much of a frame is the work of one thread. With a worker per core no core waits for it: on two
    cores, full-size frames came a quarter faster than from one worker with two threads.
    """
    fit = int(psutil.virtual_memory().available / 2**30 / memory_gb(wh, cameras))
    return max(1, min(os.cpu_count() or 1, fit, frames))


def threads_of_worker(workers: int) -> int:
    """Twice its share of the cores: the last frames of a run have them to themselves.

    While all work, as many threads as cores were no faster.
    """
    cores = os.cpu_count() or 1
    return min(cores, max(1, 2 * cores // workers))
