"""Methods that behave badly on one pair, made in whichever process runs them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import torch

from flowrect.methods import Method, PoseEstimate, unrectified
from flowrect.sample import Image
from flowrect.solvers import NoSolution
from simgen.geometry import Array


def _raises() -> PoseEstimate:
    raise ZeroDivisionError("no baseline")


def _says_nothing() -> PoseEstimate:
    raise NoSolution("")


def _no_pose() -> PoseEstimate:
    return PoseEstimate(np.full((3, 3), np.nan), np.ones(3))


def _mirrored() -> PoseEstimate:
    return PoseEstimate(np.diag([1.0, 1.0, -1.0]), np.ones(3))


def _too_large() -> PoseEstimate:
    torch.empty(2**50)
    raise AssertionError("a petabyte of memory")


def _disk_is_full() -> PoseEstimate:
    raise OSError("no space left")


def _sleeps() -> PoseEstimate:
    time.sleep(600)
    raise AssertionError("nobody stopped it")


_DEEDS: dict[str, Callable[[], PoseEstimate]] = {
    "raises": _raises,
    "says-nothing": _says_nothing,
    "no-pose": _no_pose,
    "mirrored": _mirrored,
    "too-large": _too_large,
    "too-large-for-opencv": lambda: cv2.resize(np.zeros((1, 1), np.uint8), (2**30, 2**30)),
    "disk-is-full": _disk_is_full,
    "dies": lambda: os._exit(3),
    "sleeps": _sleeps,
}
SAID = {
    "raises": "^ZeroDivisionError: no baseline",
    "says-nothing": "^NoSolution$",
    "no-pose": "^its answer is no pose",
    "mirrored": "^its answer is no pose",
    "too-large": "^fault of the machine: RuntimeError: .*allocate memory",
    "too-large-for-opencv": "^fault of the machine: error: .*Insufficient memory",
    "disk-is-full": "^fault of the machine: OSError: no space left",
    "dies": "^fault of the machine: its process died",
    "sleeps": "^took longer than 2 s and was stopped",
}
"""what is recorded of the pair"""


def load_odd(name: str) -> Method:
    """The method of that name; "broken" cannot be loaded."""
    if name == "broken":
        raise ImportError("no such")
    return partial(_odd, _DEEDS[name])


def _odd(
    deed: Callable[[], PoseEstimate], left: Image, right: Image, K_left: Array, K_right: Array,
    prior: Array,
) -> PoseEstimate:  # fmt: skip
    """The prior; a black left image brings out the deed."""
    return unrectified(left, right, K_left, K_right, prior) if left.any() else deed()


def kill_oneself(*_: object) -> None:
    """The process is gone, as if there were no memory left for it."""
    os._exit(3)
