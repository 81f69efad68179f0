from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from simgen import config, recipe
from simgen.config import Job, RenderOptions, load_rig, parse_size, resolve
from simgen.errors import UserError
from simgen.recipe import (
    WeatherTable,
    draw_scene,
    draw_sky,
    load_presets,
    pick,
    scenes_dir,
    stream,
)
from simgen.rig import Rig

OPTIONS = RenderOptions(n=9)


def _job(**options: object) -> Job:
    return resolve(replace(OPTIONS, **options), "scalar_rgb")


def _recipe_file(folder: Path, *, name: str = "mine.toml", **changes: str) -> Path:
    """urban.toml with lines ``key = …`` replaced."""
    lines = (scenes_dir() / "urban.toml").read_text(encoding="utf-8").splitlines()
    for key, value in changes.items():
        (number,) = (i for i, line in enumerate(lines) if line.startswith(f"{key} = "))
        lines[number] = f"{key} = {value}"
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


# --- a job is its content ------------------------------------------------------------------------


def test_the_defaults_are_those_of_the_readme():
    job = _job()
    assert job.wh == (2560, 1440)
    assert sorted(job.recipes) == ["highway", "rural", "suburban", "urban"]
    assert sorted(job.weather) == [
        "after_rain", "clear", "fog", "overcast", "partly_cloudy", "rain"
    ]  # fmt: skip
    assert "night" in job.daylight
    assert job.rig.pairs == [(0, 1), (1, 2), (0, 2)]


def test_a_job_is_the_inverse_of_its_content():
    job = _job(
        seed=7, size="96x54", rig="truck", recipes="urban,rural", daylight="night", flow=False
    )
    assert Job.from_content(job.content()) == job
    assert Job.from_content(json.loads(json.dumps(job.content(), sort_keys=True))) == job


def test_the_content_states_the_samples_by_day_and_night():
    content = _job(spp=8).content()
    assert content["samples"] == {
        "day_spp": 8, "night_spp": 16, "features_spp": 16, "max_depth": 4
    }  # fmt: skip
    del content["samples"]  # as in sets of older versions
    assert Job.from_content(content) == _job(spp=8)


def test_each_option_that_decides_pixels_changes_the_content():
    base = _job().content()
    changes = {"seed": 1, "rig": "truck", "size": "96x54", "spp": 8, "denoise": False,
               "sensor": "ideal", "recipes": "urban", "weather": "clear", "daylight": "noon",
               "frames_per_scene": 2, "flow": False, "compression": "zstd"}  # fmt: skip
    for name, value in changes.items():
        assert _job(**{name: value}).content() != base, name
    for name, value in {
        "n": 99,
        "workers": 2,
        "recycle": 3,
        "split": "test",
        "force": True,
    }.items():
        assert _job(**{name: value}).content() == base, name


def _draws(job: Job) -> list[object]:
    """What a job's first scenes draw."""
    drawn: list[object] = []
    for scene in range(20):
        seed = (job.seed, scene, 0)
        name = pick({k: r.share for k, r in job.recipes.items()}, rng=stream(*seed, "which"))
        sky = draw_sky(job.daylight, job.weather, seed=seed)
        spec = draw_scene(name, job.recipes[name], sky=sky, seed=seed)
        drawn += [spec.to_json(), list(spec.species), list(spec.families)]
    return drawn


def test_draws_depend_on_no_order_of_names_or_keys(tmp_path):
    job = _job(recipes="urban,rural", weather="clear,overcast", daylight="noon,dawn")
    turned = _job(recipes="rural,urban", weather="overcast,clear", daylight="dawn,noon")
    stored = Job.from_content(json.loads(json.dumps(job.content(), sort_keys=True)))
    assert _draws(job) == _draws(turned) == _draws(stored)
    rules = "{ downtown = 0.5, town = 0.5 }"
    same = _recipe_file(tmp_path, name="urban.toml", rules=rules)
    assert _draws(_job(recipes="urban")) == _draws(_job(recipes=str(same)))


# --- what takes part -----------------------------------------------------------------------------


def test_only_named_presets_take_part():
    assert "night" in _job().daylight
    assert list(_job(daylight="night").daylight) == ["night"]
    assert sorted(_job(daylight="noon,night").daylight) == ["night", "noon"]


def test_named_presets_keep_their_shares():
    assert {k: t.share for k, t in _job(weather="clear, overcast").weather.items()} == {
        "clear": 0.27, "overcast": 0.18
    }  # fmt: skip


def test_presets_of_a_file_keep_their_shares_and_those_without_one_are_dropped(tmp_path):
    path = _presets_file(tmp_path, "weather", often="fog: share = 0.6", seldom="rain: share = 0.2",
                         never="clear: share = 0.0")  # fmt: skip
    assert {k: t.share for k, t in _job(weather=str(path)).weather.items()} == {
        "often": 0.6, "seldom": 0.2
    }  # fmt: skip


def test_presets_named_without_a_share_get_the_same_and_those_of_a_file_keep_theirs(
    tmp_path, monkeypatch
):
    path = _presets_file(tmp_path, "weather", often="fog: share = 0.6")
    own = load_presets("weather", WeatherTable)
    own["clear"] = own["clear"].model_copy(update={"share": 0.0})
    named = {"clear": own["clear"], "rain": own["rain"]}
    monkeypatch.setattr(
        config,
        "load_presets",
        lambda kind, table, chosen: load_presets(kind, table, chosen) | named,
    )
    job = _job(weather=f"clear,rain,{path}", daylight="noon")
    assert {k: t.share for k, t in job.weather.items()} == {"clear": 1, "rain": 1, "often": 0.6}


def test_a_file_of_presets_without_any_share_is_named(tmp_path):
    path = _presets_file(tmp_path, "weather", never="fog: share = 0.0")
    with pytest.raises(UserError, match=r"--weather .*my_weather\.toml: never all have share = 0"):
        _job(weather=str(path))


def test_recipes_are_named_or_read_from_files(tmp_path):
    path = _recipe_file(tmp_path, keep="0.1")
    job = _job(recipes=f"urban,{path}")
    assert sorted(job.recipes) == ["mine", "urban"]
    assert job.recipes["mine"].buildings.keep == 0.1


def _presets_file(folder: Path, kind: str, **presets: str) -> Path:
    """A TOML file of presets, each the package's of that name with one line replaced."""
    own = (scenes_dir() / f"{kind}.toml").read_text(encoding="utf-8").split("\n[")[1:]
    tables = {table.partition("]")[0]: table.splitlines()[1:] for table in own}
    text = ""
    for name, change in presets.items():
        base, _, line = change.partition(": ")
        key = line.split(" = ")[0]
        kept = [x for x in tables[base] if not x.startswith(f"{key} = ")]
        text += "\n".join([f"[{name}]", *kept, line, ""])
    path = folder / f"my_{kind}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_presets_are_named_or_read_from_files(tmp_path):
    weather = _presets_file(tmp_path, "weather", thick="fog: visibility_m = [60.0, 90.0]")
    daylight = _presets_file(tmp_path, "daylight", low="noon: sun_elevation_deg = [1.0, 3.0]",
                             lower="dusk: sun_elevation_deg = [-1.0, 1.0]")  # fmt: skip
    job = _job(weather=f"clear,{weather}", daylight=str(daylight))
    assert {k: t.visibility_m for k, t in job.weather.items()} == {
        "clear": (25000.0, 60000.0), "thick": (60.0, 90.0)
    }  # fmt: skip
    assert {k: (t.share, t.sun_elevation_deg) for k, t in job.daylight.items()} == {
        "low": (0.18, (1.0, 3.0)), "lower": (0.15, (-1.0, 1.0))
    }  # fmt: skip
    stored = json.loads(json.dumps(job.content(), sort_keys=True))
    assert Job.from_content(stored) == job
    assert _draws(Job.from_content(stored)) == _draws(job)


def test_two_different_presets_of_one_name_are_refused(tmp_path):
    path = _presets_file(tmp_path, "weather", fog="fog: visibility_m = [60.0, 90.0]")
    expected = r"--weather: two different presets are called fog\. Rename the one in .*my_weather"
    with pytest.raises(UserError, match=expected):
        _job(weather=f"fog,{path}")
    assert _job(weather=str(path)).weather["fog"].visibility_m == (60.0, 90.0)
    same = _presets_file(tmp_path, "weather", fog="fog: share = 0.1")
    assert _job(weather=f"fog,{same}") == _job(weather="fog")


@pytest.mark.parametrize("text, expected", [
    ("", r"my\.toml: no preset in it; expected a table \[NAME\] for each"),
    ("share = 0.5", r"my\.toml: key 'share' = 0\.5 is in no preset; expected tables \[NAME\]"),
    ("[a]\nshare = 1", r"my\.toml \[a\]: key 'cloud_cover' is missing; "),
    ("[a]\nvisibility = 1", r"unknown key 'visibility' \(did you mean 'visibility_m'\?\)"),
    ("[a", r"my\.toml: not valid TOML"),
])  # fmt: skip
def test_an_impossible_file_of_presets_is_refused(tmp_path, text, expected):
    path = tmp_path / "my.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=expected):
        _job(weather=str(path))


def test_two_different_files_of_one_name_are_refused(tmp_path):
    path = _recipe_file(tmp_path, name="urban.toml", keep="0.1")
    with pytest.raises(UserError, match="two different files are called urban"):
        _job(recipes=f"urban,{path}")
    assert list(_job(recipes="urban,urban").recipes) == ["urban"]


@pytest.mark.parametrize("text, wh", [("2560x1440", (2560, 1440)), (" 96X54 ", (96, 54)),
                                      ("97×54", (97, 54))])  # fmt: skip
def test_sizes_are_width_times_height(text, wh):
    assert parse_size(text) == wh


def test_a_rig_decides_the_size_unless_one_is_given():
    assert _job(rig="truck").wh == (3848, 2168)
    assert _job(rig="truck", size="640x360").wh == (640, 360)


def test_a_rig_is_read_from_a_file(tmp_path):
    text = (scenes_dir() / "rigs" / "default.toml").read_text(encoding="utf-8")
    path = tmp_path / "wide.toml"
    path.write_text(text.replace("hfov_deg = 90", "hfov_deg = 120"), encoding="utf-8")
    name, rig = load_rig(str(path))
    assert (name, rig.hfov_deg) == ("wide", 120.0)


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize("change, expected", [
    ({"n": 0}, r"--n 0: expected a whole number from 1 on\."),
    ({"n": -3}, r"--n -3: expected a whole number from 1 on\."),
    ({"n": 10**12}, r"--n 1000000000000: expected at most 10000000 pairs\."),
    ({"spp": 0}, r"--spp 0: expected a whole number from 1 on\."),
    ({"spp": 3}, r"--spp 3: expected a power of two up to 4096"),
    ({"spp": 8192}, r"--spp 8192: expected a power of two up to 4096"),
    ({"seed": -1}, r"--seed -1: expected a whole number from 0 to 2\^63 - 1"),
    ({"seed": 1 << 63}, r"--seed 9223372036854775808: expected a whole number from 0"),
    ({"workers": 0}, r"--workers 0: expected a whole number from 1 on\."),
    ({"workers": 10**6}, r"--workers 1000000: this machine has \d+ cores"),
    ({"frames_per_shard": 0}, r"--frames-per-shard 0: expected a whole number from 1 on\."),
    ({"frames_per_scene": 0}, r"--frames-per-scene 0: expected a whole number from 1 on\."),
    ({"frames_per_scene": 22}, r"--frames-per-scene 22: expected at most 21; a longer drive would"),
    ({"sensor": "film"}, r"--sensor film: expected one of ideal, camera"),
    ({"size": "640"}, r"--size '640': expected WIDTHxHEIGHT in pixels, like 2560x1440"),
    ({"size": "640x"}, r"--size '640x': expected WIDTHxHEIGHT"),
    ({"size": "-640x360"}, r"--size '-640x360': expected WIDTHxHEIGHT"),
    ({"size": "8x8"}, r"--size 8x8: expected from 96x54 to 16384x16384 pixels"),
    ({"size": "99999x360"}, r"--size 99999x360: expected from 96x54 to 16384x16384 pixels"),
    ({"rig": "bike"}, r"--rig bike: expected one of default, truck, or the path of a TOML file"),
    ({"recipes": "moon"}, r"Recipe 'moon' is not known\. Expected one of highway, rural, suburban, "
                          r"urban, or the path"),
    ({"weather": "clear,hail"}, r"--weather hail: unknown; expected some of clear, partly_cloudy"),
    ({"weather": "my/hail.toml"}, r"--weather my/hail\.toml: no such file; expected some of clear, "
                                  r".*, or the path of a TOML file like scenes/weather\.toml"),
    ({"daylight": "tea"}, r"--daylight tea: unknown; expected some of dawn, morning, noon"),
])  # fmt: skip
def test_impossible_options_are_refused(change, expected):
    with pytest.raises(UserError, match=expected):
        _job(**change)


@pytest.mark.parametrize("change, expected", [
    ('camera_y_m = [0.8, 0.0, 0.4]', "camera_y_m must fall from left"),
    ('hfov_deg = 190.0', r"key 'hfov_deg' = 190\.0: .*less than or equal to 140"),
    ('size = [4, 4]', r"key 'size\.0' = 4: "),
    ('camera_y_m = [0.8, nan, -0.8]', r"key 'camera_y_m\.1' = nan"),
])  # fmt: skip
def test_an_impossible_rig_is_refused(tmp_path, change, expected):
    key = change.split(" = ")[0]
    text = (scenes_dir() / "rigs" / "default.toml").read_text(encoding="utf-8")
    lines = [change if line.startswith(f"{key} = ") else line for line in text.splitlines()]
    assert change in lines
    path = tmp_path / "mine.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(UserError, match=expected):
        _job(rig=str(path))


@pytest.mark.parametrize("share, expected", [
    (None, r"daylight\.toml: no preset in it; expected a table \[NAME\] for each"),
    ("0", r"daylight\.toml: dawn, .* all have share = 0, so nothing can be drawn\. Give one"),
])  # fmt: skip
def test_presets_of_which_nothing_can_be_drawn_are_refused(tmp_path, monkeypatch, share, expected):
    text = (scenes_dir() / "daylight.toml").read_text(encoding="utf-8")
    path = tmp_path / "daylight.toml"
    path.write_text(re.sub(r"share = [\d.]+", f"share = {share}", text) if share else "", "utf-8")
    path.with_name("weather.toml").write_bytes((scenes_dir() / "weather.toml").read_bytes())
    job = partial(_job, recipes=str(scenes_dir() / "urban.toml"))
    for module in (config, recipe):
        monkeypatch.setattr(module, "scenes_dir", lambda: tmp_path)
    monkeypatch.setattr(config, "load_rig", lambda name: (name, Rig.model_construct(size=(96, 54))))
    with pytest.raises(UserError, match=expected):
        job()


def test_every_int64_seed_draws():
    assert np.isfinite(stream((1 << 63) - 1, 0, 0, "x").random())
