"""Which Mitsuba variant renders, and which LLVM library it may load.

The ``llvm`` variants load a system libLLVM. Versions 14 to 16 abort the whole process when they
compile a sky (``Cannot select: fminimum``), which no ``except`` can catch. So every candidate is
asked for its version in a child process before Dr.Jit may load it.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from simgen.errors import UserError

MIN_LLVM = 17
LLVM_PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
VARIANTS = ("llvm_ad_rgb", "scalar_rgb", "cuda_ad_rgb")

_SEARCH = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)

# LLVMGetVersion exists since LLVM 16; a library without it is older than that.
_PROBE = """
import ctypes, sys
lib = ctypes.CDLL(sys.argv[1])
v = [ctypes.c_uint() for _ in range(3)]
lib.LLVMGetVersion(*map(ctypes.byref, v)) if hasattr(lib, "LLVMGetVersion") else None
print(".".join(str(x.value) for x in v))
"""


@dataclass(frozen=True)
class Llvm:
    """A libLLVM and its version; (0, 0, 0) means older than 16."""

    path: Path
    version: tuple[int, ...]

    @property
    def usable(self) -> bool:
        """Whether Mitsuba may load it."""
        return self.version >= (MIN_LLVM,)


@dataclass(frozen=True)
class Engine:
    """The variant that was chosen, and why."""

    variant: str
    llvm: Llvm | None
    notice: str = ""
    """what the user should know about the choice, empty if nothing"""


def probe_llvm(path: Path) -> Llvm | None:
    """Asks a library for its version in a child process; None if it cannot be loaded there."""
    child = subprocess.run(
        [sys.executable, "-c", _PROBE, str(path)], capture_output=True, text=True, timeout=60
    )
    if child.returncode != 0:
        return None
    return Llvm(path, tuple(int(x) for x in child.stdout.split(".")))


def llvm_candidates() -> list[Path]:
    """Libraries that look like LLVM, one path per file, the likely newest first."""
    found = {p.resolve(): p for pattern in _SEARCH for p in Path("/").glob(pattern[1:])}
    return sorted(found, key=_version_in_name, reverse=True)


def _version_in_name(path: Path) -> tuple[int, ...]:
    return tuple(int(x) for x in re.findall(r"\d+", path.name)) or (0,)


def find_llvm() -> Llvm | None:
    """The LLVM to use: the one that DRJIT_LIBLLVM_PATH names, else the newest usable one found.

    Raises UserError when the variable names a library that would abort the process.
    """
    named = os.environ.get(LLVM_PATH_VARIABLE)
    if named:
        llvm = probe_llvm(Path(named))
        if llvm is None or not llvm.usable:
            what = "cannot be loaded" if llvm is None else f"is LLVM {version_text(llvm.version)}"
            raise UserError(
                f"{LLVM_PATH_VARIABLE}={named} {what}; expected LLVM {MIN_LLVM} or newer (older "
                "ones abort the whole process). Unset the variable, or point it to a newer "
                "library."
            )
        return llvm
    for path in llvm_candidates():
        llvm = probe_llvm(path)
        if llvm is not None and llvm.usable:
            return llvm
    return None


def version_text(version: tuple[int, ...]) -> str:
    """A version for people."""
    return ".".join(map(str, version)) if any(version) else "15 or older"


def install_hint() -> str:
    """The command that installs a usable LLVM on this system."""
    if shutil.which("apt-get"):
        return f"apt-get install {apt_package() or 'libllvm19'}"
    return f"install libLLVM {MIN_LLVM} or newer with the system's package manager"


def apt_package() -> str | None:
    """The libllvm package that apt offers: 19 if it is there (the version we test with)."""
    listing = subprocess.run(
        ["apt-cache", "search", "--names-only", "^libllvm[0-9]+(t64)?$"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout
    names = re.findall(r"^(libllvm(\d+)\w*)", listing, flags=re.MULTILINE)
    usable = sorted((int(v) != 19, -int(v), name) for name, v in names if int(v) >= MIN_LLVM)
    return usable[0][2] if usable else None


def install_llvm() -> str:
    """Makes sure of a usable LLVM, through apt where the user is root; returns what happened."""
    llvm = find_llvm()
    if llvm is not None:
        return f"LLVM {version_text(llvm.version)} found: {llvm.path}"
    if not shutil.which("apt-get") or os.geteuid() != 0:
        return f"No LLVM {MIN_LLVM} or newer. For 3 to 4 times the speed, run: {install_hint()}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run(["apt-get", "update"], check=False, **quiet)  # type: ignore[call-overload]
    package = apt_package()
    if package is None:
        return f"apt offers no libLLVM {MIN_LLVM} or newer; rendering falls back to scalar_rgb."
    done = subprocess.run(["apt-get", "install", "-y", "--no-install-recommends", package],
                          check=False, capture_output=True, text=True)  # fmt: skip
    llvm = find_llvm()
    if llvm is None:
        reason = done.stderr.strip().splitlines()[-1:] or ["no message"]
        return f"apt-get install {package} did not help ({reason[0]}); falling back to scalar_rgb."
    return f"LLVM {version_text(llvm.version)} installed: {llvm.path}"


def choose(variant: str = "auto") -> Engine:
    """Resolves "auto" to the fastest CPU variant that is safe here; loads nothing.

    Raises UserError for an unknown variant, or an llvm one without a usable LLVM.
    """
    if variant not in ("auto", *VARIANTS):
        raise UserError(f"--variant {variant}: expected one of auto, {', '.join(VARIANTS)}.")
    if variant in ("scalar_rgb", "cuda_ad_rgb"):
        return Engine(variant, None)
    llvm = find_llvm()
    if llvm is not None:
        return Engine("llvm_ad_rgb", llvm)
    lack = f"no libLLVM {MIN_LLVM} or newer was found on this system"
    if variant == "llvm_ad_rgb":
        raise UserError(
            f"--variant llvm_ad_rgb: {lack} (older ones abort the process). Run "
            f'"{install_hint()}", set {LLVM_PATH_VARIABLE}, or use --variant scalar_rgb '
            "(3 to 4 times slower)."
        )
    notice = (
        f"Rendering with scalar_rgb, 3 to 4 times slower than llvm_ad_rgb: {lack}. "
        f"To speed up: {install_hint()}"
    )
    return Engine("scalar_rgb", None, notice)


def activate(engine: Engine, threads: int | None = None) -> None:
    """Loads Mitsuba with the engine's variant; once per process, before anything is rendered."""
    if engine.llvm is not None:
        os.environ[LLVM_PATH_VARIABLE] = str(engine.llvm.path)
    else:
        _import_without_llvm()
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(engine.variant)
    mi.set_log_level(mi.LogLevel.Error)
    if threads is not None:
        dr.set_thread_count(threads)


def _import_without_llvm() -> None:
    """Dr.Jit loads any libLLVM, for every variant, and prints if it finds none: neither here."""
    named = os.environ.get(LLVM_PATH_VARIABLE)
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.environ[LLVM_PATH_VARIABLE] = os.devnull
    os.dup2(null, 2)
    try:
        import drjit  # noqa: F401
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)
        os.environ.pop(LLVM_PATH_VARIABLE)
        if named is not None:
            os.environ[LLVM_PATH_VARIABLE] = named
