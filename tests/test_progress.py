"""The time left is told however long a step takes."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from simgen.progress import bar
from simgen.rendering import _Display
from simgen.run import FrameResult


class Clock:
    """Stands still until it is told."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def terminal() -> Console:
    return Console(file=io.StringIO(), force_terminal=True, width=120)


@pytest.mark.parametrize("seconds", (1, 40, 900))
def test_the_time_left_is_known_after_two_steps_of_any_length(seconds):
    shown, clock = bar(console=terminal()), Clock()
    shown.get_time = clock
    task = shown.add_task("frames", total=5)
    for done in (1, 2):
        clock.now += seconds
        shown.update(task, completed=done)
    assert shown.tasks[0].time_remaining == 3 * seconds


def test_rendering_shows_the_time_left_of_slow_frames():
    display, clock = _Display(terminal(), pairs_per_frame=3), Clock()
    display.bar.get_time = clock
    display.hooks.started(0, 5)
    for index in (0, 1):
        clock.now += 60
        display.hooks.frame_done(FrameResult(index, 0, {}, 0, 1))
    assert display.bar.tasks[0].time_remaining == 180
