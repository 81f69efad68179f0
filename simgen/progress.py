"""The progress bar of long commands."""

from __future__ import annotations

from rich.console import Console
from rich.progress import Progress, ProgressColumn

PACE_OVER_S = 3600.0
"""Steps of so many seconds back tell the pace; of rich's own 30 s, slow frames leave none."""


def bar(*columns: ProgressColumn, console: Console, transient: bool = False) -> Progress:
    """A bar with ``columns`` (rich's own if none) on a terminal, nothing elsewhere."""
    return Progress(*columns, console=console, transient=transient,
                    disable=not console.is_terminal,
                    speed_estimate_period=PACE_OVER_S)  # fmt: skip
