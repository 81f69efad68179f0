"""Freed memory is kept: the next tensor of its size costs no page of the kernel's."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from flowrect import memory

FAULTS = """
import resource, sys
import torch
from flowrect.memory import keep_freed_memory
if sys.argv[1] == "kept" and not keep_freed_memory():
    sys.exit("this C library is not glibc")
torch.set_num_threads(1)
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(40):  # it takes some until the heap has found its shape
    torch.ones(1 << 24)
before = faults()
for _ in range(10):
    torch.ones(1 << 24)
print(faults() - before)
"""


def faults(what: str) -> int:
    """Page faults of ten tensors of 64 MiB, one after the other, in a process of their own."""
    done = subprocess.run(
        [sys.executable, "-c", FAULTS, what], capture_output=True, text=True, check=False
    )
    if "not glibc" in done.stderr:
        pytest.skip(done.stderr)
    return int(done.stdout)


@pytest.mark.skipif("LD_PRELOAD" in os.environ, reason="may well be another allocator")
def test_freed_memory_is_used_again_without_a_page_fault():
    assert 3 * faults("kept") < faults("as it is")


def test_elsewhere_nothing_happens(monkeypatch):
    monkeypatch.setattr(memory.sys, "platform", "darwin")
    assert not memory.keep_freed_memory()
