"""The standing self-check: ``small`` learns four rendered pairs by heart."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from flowrect import train

RENDER = [sys.executable, "-m", "simgen", "render", "--size", "512x288", "--seed", "1"]


@pytest.mark.slow
def test_four_pairs_are_known_to_the_bar(tmp_path: Path) -> None:
    """The command's own bar, ``OVERFIT_BAR_DEG``, decides: 1 if it is missed."""
    data = tmp_path / "set"
    subprocess.run(
        [*RENDER, "--n", "9", "--split", "train", "--weather", "clear", "--out", str(data)],
        check=True,
    )
    check = ["--data", str(data), "--out", str(tmp_path / "run"), "--preset", "small",
             "--overfit", "4", "--loading.workers", "0"]  # fmt: skip
    assert train.main(check) == 0
