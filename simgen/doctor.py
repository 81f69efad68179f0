"""What this machine renders with, and what would make it faster."""

from __future__ import annotations

import platform
import shutil
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

from simgen import __version__, engine
from simgen.errors import UserError
from simgen.workers import free_memory_gb, memory_gb, num_cores, num_workers

PACKAGES = ("mitsuba", "drjit", "roadgen", "pyoidn", "numpy", "scipy", "opencv-python-headless",
            "shapely", "h5py", "zlib-ng", "hdf5plugin", "OpenEXR", "tyro", "pydantic",
            "pebble")  # fmt: skip
FULL_SIZE = ((2560, 1440), 3)
"""of the default rig's images, and their number"""


def diagnosis() -> str:
    """A page of text; loads neither Mitsuba nor LLVM."""
    lines = [f"simgen {__version__}, Python {platform.python_version()}, {platform.platform()}"]
    lines += _engine_lines()
    many = num_workers(*FULL_SIZE, frames=num_cores())
    lines.append(f"cores     {num_cores()} for this process, {many} full-size frames at a time")
    free_gb = free_memory_gb()
    total_gb = psutil.virtual_memory().total / 2**30
    lines.append(f"memory    {total_gb:.1f} GiB, {free_gb:.1f} GiB free for this process")
    disk = shutil.disk_usage(Path.cwd())
    lines.append(f"disk      {disk.free / 1e9:.1f} GB free in {Path.cwd()}")
    lines.append("packages  " + ", ".join(f"{p} {_version(p)}" for p in PACKAGES))
    advice = _advice(free_gb, disk.free / 1e9)
    lines.append("To do     " + ("\n          ".join(advice) or "nothing: all is well."))
    return "\n".join(lines)


def _engine_lines() -> list[str]:
    try:
        chosen = engine.choose("auto")
    except UserError as error:
        return [f"variant   none: {error}"]
    used = [chosen.llvm.path] if chosen.llvm else []
    others = [p for p in engine.llvm_candidates() if p.resolve() not in [u.resolve() for u in used]]
    lines = [f"LLVM      {path}: {_llvm_state(path, used=path in used)}" for path in used + others]
    return [f"variant   {chosen.variant}", *(lines or ["LLVM      none found"])]


def _llvm_state(path: Path, *, used: bool) -> str:
    llvm = engine.probe_llvm(path)
    if llvm is None:
        return "cannot be loaded"
    number = engine.version_text(llvm.version)
    if not llvm.usable:
        return f"{number}, too old (it would abort the process): never loaded"
    return f"{number}, {'in use' if used else 'usable'}"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"


def _advice(free_gb: float, disk_gb: float) -> list[str]:
    advice = []
    try:
        if engine.choose("auto").variant == "scalar_rgb":
            advice.append(f"3 to 4 times faster with a newer LLVM: {engine.install_hint()}")
    except UserError as error:
        advice.append(str(error))
    needed = memory_gb(*FULL_SIZE)
    if free_gb < needed:
        advice.append(f"less than {needed:.1f} GiB of memory: render at a smaller --size")
    if disk_gb < 20:
        advice.append("less than 20 GB free: choose another disk with --out for a large set")
    if _version("hdf5plugin") == "(not installed)":
        advice.append("pip install hdf5plugin to use --compression zstd (faster to read and write)")
    return advice
