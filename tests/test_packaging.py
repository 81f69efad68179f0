"""What a wheel holds, and what the base install can do without."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from simgen import recipe

ROOT = Path(__file__).parents[1]
_WITHOUT_TORCH = """
import sys

class NoTorch:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, NoTorch)
import simgen.produce
from simgen.__main__ import main
try:
    main(["render", "--help"])
except SystemExit as stop:
    assert stop.code == 0
"""


def test_torch_is_asked_for_by_an_extra_only():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert not [d for d in project["dependencies"] if d.startswith("torch")]
    assert [d for d in project["optional-dependencies"]["flowrect"] if d.startswith("torch")]


def test_rendering_needs_no_torch():
    child = subprocess.run([sys.executable, "-c", _WITHOUT_TORCH], cwd=ROOT, text=True,
                           capture_output=True)  # fmt: skip
    assert child.returncode == 0, child.stderr
    assert "--frames-per-scene" in child.stdout


def test_the_wheel_carries_the_scenes_to_where_they_are_looked_for(tmp_path, monkeypatch):
    """As an installed package has them, with no checkout around it."""
    tables = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]
    wheel = tables["targets"]["wheel"]
    assert wheel["packages"] == ["simgen", "flowrect"]
    assert list(wheel["force-include"]) == ["scenes"]
    shutil.copytree(ROOT / "scenes", tmp_path / wheel["force-include"]["scenes"])
    monkeypatch.setattr(recipe, "__file__", str(tmp_path / "simgen" / "recipe.py"))
    assert recipe.scenes_dir() == tmp_path / "simgen" / "_scenes"
    assert "urban" in recipe.recipe_names()


@pytest.mark.slow
def test_a_built_wheel_holds_the_code_the_scenes_and_the_weights(tmp_path):
    """Of every folder all that the checkout has; pip fetches the builder."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", tmp_path, ROOT]
    subprocess.run(command, check=True)
    (wheel,) = tmp_path.glob("flowrect-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        found = set(archive.namelist())
    places = {"simgen": "simgen", "flowrect": "flowrect", "scenes": "simgen/_scenes"}
    expected = {
        f"{place}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, place in places.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"simgen/_scenes/urban.toml", "simgen/_scenes/weather.toml",
            "simgen/_scenes/rigs/default.toml", "simgen/_scenes/maps/station_street.xodr",
            "flowrect/weights_data/small.safetensors"} <= expected  # fmt: skip
    assert {name for name in found if ".dist-info/" not in name} == expected
