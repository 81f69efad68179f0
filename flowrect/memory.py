"""Memory that a tensor leaves is kept for the next one, rather than handed back to the kernel.

By default the C library maps every tensor of more than 128 kB (later: 32 MB) anew, and the kernel
clears its pages before it hands them out: on a CPU that was a tenth to a sixth of a training step,
and about a fifth of ALIKED and RAFT (``benchmarks/kept_memory.py``). The price is memory: a command
keeps all that it has ever had, and what lies between tensors of unlike sizes.
"""

from __future__ import annotations

import ctypes
import sys

TRIM_THRESHOLD, TOP_PAD, MMAP_MAX = -1, -2, -4
"""as malloc.h of glibc numbers them"""
PAD_BYTES = 64 << 20
"""that are asked for at once"""


def keep_freed_memory() -> bool:
    """For the whole process, from now on; False where the C library is another one than glibc."""
    if sys.platform != "linux":
        return False
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return False
    wanted = ((MMAP_MAX, 0), (TRIM_THRESHOLD, -1), (TOP_PAD, PAD_BYTES))
    return all(libc.mallopt(option, value) for option, value in wanted)
