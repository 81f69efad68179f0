"""Fixtures of all tests, and the table of worst errors that ends a run."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

# Tensors of tests are tiny: threads would only wait for each other, 10 times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")


LONGEST = ("test_produce", "test_world", "test_places", "test_onnx", "test_run",
           "test_flow_network", "test_evaluate", "test_crossings", "test_cli", "test_hitnet",
           "test_drectify", "test_planting", "test_report", "test_evaluate_depth")  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take longest begin first: no process is left alone with one at the end."""
    rank = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session")
def mitsuba_active() -> None:
    """Loads Mitsuba once, in the variant that SIMGEN_TEST_VARIANT names, else the fastest."""
    from simgen import engine

    engine.activate(engine.choose(os.environ.get("SIMGEN_TEST_VARIANT", "auto")))


@pytest.fixture
def worst(record_property: Callable[[str, object], None]) -> Callable[..., None]:
    """``worst(name, errors, limit, unit)``: the largest error is below the limit, and reported."""

    def check(name: str, errors: ArrayLike, limit: float, unit: str = "px") -> None:
        errors = np.asarray(errors, dtype=np.float64)
        assert errors.size, f"{name}: nothing was compared"
        value = float(np.abs(errors).max())
        record_property(name, (value, float(limit), unit))
        assert value <= limit, f"{name}: worst error {value:.3g} {unit}, allowed {limit:g}"

    return check


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Prints what ``worst`` measured, of whichever process."""
    reports = [r for kind in ("passed", "failed") for r in terminalreporter.getreports(kind)]
    measured: dict[str, tuple[float, float, str]] = {}
    for name, found in (p for r in reports if r.when == "call" for p in r.user_properties):
        measured[name] = max(measured.get(name, (0.0,)), tuple(found))
    if measured:
        terminalreporter.section("worst errors")
    for name, (value, limit, unit) in measured.items():
        terminalreporter.line(f"{value:9.2e}  of {limit:7.0e} {unit:<9} {name}")
