from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from simgen import doctor, engine, export
from simgen.engine import Engine, Llvm, choose, find_llvm, probe_llvm
from simgen.errors import UserError

OLD_LLVM = Path("/usr/lib/x86_64-linux-gnu/libLLVM-14.so.1")


@pytest.fixture(autouse=True)
def without_variable(monkeypatch):
    monkeypatch.delenv(engine.LLVM_PATH_VARIABLE, raising=False)


@pytest.fixture
def libraries(monkeypatch):
    """``libraries({"a": (19, 1, 0), "b": None})``: what this system seems to have."""

    def pretend(versions: dict[str, tuple[int, ...] | None]) -> list[str]:
        probed = []

        def probe(path: Path) -> Llvm | None:
            probed.append(str(path))
            version = versions.get(str(path))
            return None if version is None else Llvm(path, version)

        monkeypatch.setattr(engine, "llvm_candidates", lambda: [Path(p) for p in versions])
        monkeypatch.setattr(engine, "probe_llvm", probe)
        return probed

    return pretend


def test_auto_takes_the_first_llvm_that_is_new_enough(libraries):
    libraries({"broken": None, "old": (16, 0, 6), "older": (0, 0, 0), "good": (19, 1, 7)})
    assert choose("auto") == Engine("llvm_ad_rgb", Llvm(Path("good"), (19, 1, 7)))


def test_auto_without_llvm_is_scalar_with_a_notice(libraries, monkeypatch):
    libraries({"old": (16, 0, 6)})
    monkeypatch.setattr(engine, "install_hint", lambda: "apt-get install libllvm19")
    chosen = choose("auto")
    assert (chosen.variant, chosen.llvm) == ("scalar_rgb", None)
    assert chosen.notice == (
        "Rendering with scalar_rgb, 3 to 4 times slower than llvm_ad_rgb: no libLLVM 17 or newer "
        "was found on this system. To speed up: apt-get install libllvm19"
    )


def test_llvm_without_llvm_is_an_error_that_says_what_to_do(libraries):
    libraries({})
    with pytest.raises(UserError, match=r"--variant llvm_ad_rgb: no libLLVM 17 or newer was found"):
        choose("llvm_ad_rgb")


@pytest.mark.parametrize("variant", ("scalar_rgb", "cuda_ad_rgb"))
def test_other_variants_look_for_no_llvm(libraries, variant):
    probed = libraries({"good": (19, 1, 7)})
    assert choose(variant) == Engine(variant, None)
    assert probed == []


def test_an_unknown_variant_names_the_known_ones():
    with pytest.raises(
        UserError, match="--variant fast: expected one of auto, llvm_ad_rgb, scalar"
    ):
        choose("fast")


def test_the_variable_comes_before_what_is_found(libraries, monkeypatch):
    probed = libraries({"good": (19, 1, 7), "named": (17, 0, 0)})
    monkeypatch.setenv(engine.LLVM_PATH_VARIABLE, "named")
    assert find_llvm() == Llvm(Path("named"), (17, 0, 0))
    assert probed == ["named"]


@pytest.mark.parametrize("version, reason", [
    (None, "cannot be loaded"), ((16, 0, 6), "is LLVM 16.0.6"), ((0, 0, 0), "is LLVM 15 or older"),
])  # fmt: skip
def test_a_variable_that_names_an_unusable_library_is_an_error(
    libraries, monkeypatch, version, reason
):
    libraries({"named": version})
    monkeypatch.setenv(engine.LLVM_PATH_VARIABLE, "named")
    expected = (
        rf"DRJIT_LIBLLVM_PATH=named {reason}; expected LLVM 17 or newer .* Unset the variable"
    )
    for variant in ("auto", "llvm_ad_rgb"):
        with pytest.raises(UserError, match=expected):
            choose(variant)


@pytest.mark.skipif(not OLD_LLVM.exists(), reason="this system has no LLVM 14")
def test_a_real_old_library_is_recognised_and_never_loaded_here(monkeypatch):
    monkeypatch.setenv(engine.LLVM_PATH_VARIABLE, str(OLD_LLVM))
    with pytest.raises(UserError, match="is LLVM 15 or older; expected LLVM 17"):
        choose("auto")
    assert "libLLVM-14" not in Path("/proc/self/maps").read_text()


@pytest.mark.parametrize("content", (None, b"", b"\x7fELF no library"))
def test_what_is_no_library_is_not_llvm(tmp_path, content):
    path = tmp_path / "libLLVM-19.so"
    if content is not None:
        path.write_bytes(content)
    assert probe_llvm(path) is None


def test_a_library_that_is_something_else_is_not_usable():
    import _ctypes

    llvm = probe_llvm(Path(_ctypes.__file__))
    assert llvm is None or not llvm.usable


def test_the_likely_newest_library_is_tried_first(tmp_path, monkeypatch):
    for name in ("libLLVM-9.so", "libLLVM.so.19.1", "libLLVM-17.so.1", "libLLVM-14.so.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to(tmp_path / "libLLVM.so.19.1")
    monkeypatch.setattr(engine, "_SEARCH", (f"{tmp_path}/libLLVM*.so*",))
    majors = [engine._version_in_name(p)[0] for p in engine.llvm_candidates()]
    assert majors == [19, 17, 14, 9]


_ACTIVATE_SCALAR = """
from simgen import engine
engine.activate(engine.Engine("scalar_rgb", None), threads=1)
import mitsuba as mi
import os
with open("/proc/self/maps") as maps:
    print(mi.variant(), "libLLVM" in maps.read(), os.environ[engine.LLVM_PATH_VARIABLE][-4:])
"""


@pytest.mark.skipif(not OLD_LLVM.exists(), reason="this system has no LLVM 14")
def test_scalar_loads_no_llvm_whatever_the_variable_names():
    child = subprocess.run(
        [sys.executable, "-c", _ACTIVATE_SCALAR], capture_output=True, text=True,
        cwd=Path(engine.__file__).parents[1],
        env={**os.environ, engine.LLVM_PATH_VARIABLE: str(OLD_LLVM)},
    )  # fmt: skip
    assert (child.stdout, child.stderr) == ("scalar_rgb False so.1\n", "")


# --- installing ----------------------------------------------------------------------------------

_LISTING = """\
libllvm14 - Modular compiler and toolchain technologies, runtime library
libllvm16t64 - Modular compiler and toolchain technologies, runtime library
libllvm17 - Modular compiler and toolchain technologies, runtime library
libllvm19 - Modular compiler and toolchain technologies, runtime library
libllvm20 - Modular compiler and toolchain technologies, runtime library
"""


@pytest.mark.parametrize("missing, package", [
    ((), "libllvm19"),
    (("19",), "libllvm20"),
    (("19", "20"), "libllvm17"),
    (("17", "19", "20"), None),
])  # fmt: skip
def test_apt_package_is_19_else_the_newest_usable(monkeypatch, missing, package):
    lines = [x for x in _LISTING.splitlines() if not any(f"libllvm{m}" in x for m in missing)]
    answer = subprocess.CompletedProcess([], 0, "\n".join(lines), "")
    monkeypatch.setattr(engine.subprocess, "run", lambda *args, **kwargs: answer)
    assert engine.apt_package() == package


def test_install_llvm_installs_nothing_where_one_is_found(libraries):
    libraries({"good": (19, 1, 7)})
    assert engine.install_llvm() == "LLVM 19.1.7 found: good"


def test_install_llvm_prints_the_command_for_those_who_are_not_root(libraries, monkeypatch):
    libraries({})
    monkeypatch.setattr(engine.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(engine.shutil, "which", lambda name: "/usr/bin/apt-get")
    monkeypatch.setattr(engine, "apt_package", lambda: "libllvm19")
    assert engine.install_llvm() == (
        "No LLVM 17 or newer. For 3 to 4 times the speed, run: apt-get install libllvm19"
    )


# --- what is said of it --------------------------------------------------------------------------


def _llvm_lines() -> list[str]:
    return [line for line in doctor.diagnosis().splitlines() if line.startswith("LLVM ")]


def test_the_diagnosis_lists_every_library_and_marks_the_one_in_use(libraries):
    libraries({"broken": None, "old": (0, 0, 0), "good": (19, 1, 7), "other": (18, 1, 0)})
    assert "variant   llvm_ad_rgb\n" in doctor.diagnosis()
    assert _llvm_lines() == [
        "LLVM      good: 19.1.7, in use",
        "LLVM      broken: cannot be loaded",
        "LLVM      old: 15 or older, too old (it would abort the process): never loaded",
        "LLVM      other: 18.1.0, usable",
    ]


def test_the_library_that_the_variable_names_is_listed_once(libraries, monkeypatch, tmp_path):
    file, link = tmp_path / "libLLVM.so.19.1", tmp_path / "libLLVM-19.so"
    file.touch()
    link.symlink_to(file)
    libraries({str(file): (19, 1, 0), str(link): (19, 1, 0)})
    monkeypatch.setattr(engine, "llvm_candidates", lambda: [file])
    monkeypatch.setenv(engine.LLVM_PATH_VARIABLE, str(link))
    assert _llvm_lines() == [f"LLVM      {link}: 19.1.0, in use"]


def test_a_library_elsewhere_that_the_variable_names_is_in_use(libraries, monkeypatch):
    libraries({"named": (19, 1, 0)})
    monkeypatch.setattr(engine, "llvm_candidates", list)
    monkeypatch.setenv(engine.LLVM_PATH_VARIABLE, "named")
    assert _llvm_lines() == ["LLVM      named: 19.1.0, in use"]


def test_the_diagnosis_without_llvm_says_what_would_help(libraries, monkeypatch):
    libraries({})
    monkeypatch.setattr(engine, "install_hint", lambda: "apt-get install libllvm19")
    said = doctor.diagnosis()
    assert "variant   scalar_rgb\nLLVM      none found\n" in said
    assert "To do     3 to 4 times faster with a newer LLVM: apt-get install libllvm19" in said


def test_the_diagnosis_tells_of_a_variable_that_cannot_be_followed(libraries, monkeypatch):
    libraries({"named": None})
    monkeypatch.setenv(engine.LLVM_PATH_VARIABLE, "named")
    assert "variant   none: DRJIT_LIBLLVM_PATH=named cannot be loaded" in doctor.diagnosis()


def test_export_without_llvm_names_no_option_that_it_lacks(libraries, monkeypatch):
    libraries({})
    monkeypatch.setattr(engine, "install_hint", lambda: "apt-get install libllvm19")
    with pytest.raises(UserError) as error:
        export._engine_of("llvm_ad_rgb")
    assert "--variant" not in str(error.value)
    assert str(error.value).endswith('Run "apt-get install libllvm19", or set DRJIT_LIBLLVM_PATH.')
    assert export._engine_of("scalar_rgb") == Engine("scalar_rgb", None)
