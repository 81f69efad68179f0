"""Arrays in files that are complete or absent; whatever is damaged is found anew."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simgen.shards import write_atomically


def write_arrays(path: Path, **arrays: Any) -> None:
    """Writes them by name, compressed, and the folder that is needed."""
    memory = io.BytesIO()
    np.savez_compressed(memory, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, memory.getvalue())


def read_arrays(path: Path, *names: str) -> list[NDArray[Any]] | None:
    """Those of these names; None if there is no such file, or one that lacks any of them."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            return [file[name] for name in names]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
