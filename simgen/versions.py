"""Versions of the packages that decide pixels, without loading any of them."""

from __future__ import annotations

from importlib.metadata import version

PACKAGES = ("mitsuba", "drjit", "roadgen", "pyoidn", "numpy", "opencv-python-headless")


def versions() -> dict[str, str]:
    """Of each such package, as installed here."""
    return {package: version(package) for package in PACKAGES}
