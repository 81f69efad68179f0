from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from test_config import _recipe_file

from simgen.errors import UserError
from simgen.recipe import (
    FAMILIES,
    SPECIES,
    DaylightTable,
    Recipe,
    SceneSpec,
    WeatherTable,
    checked,
    draw,
    draw_scene,
    draw_sky,
    load_presets,
    load_recipe,
    pick,
    read_toml,
    recipe_names,
    stream,
)


def _spec(name: str, index: int) -> SceneSpec:
    sky = draw_sky(load_presets("daylight", DaylightTable), load_presets("weather", WeatherTable),
                   seed=(0, index, 0))  # fmt: skip
    return draw_scene(*load_recipe(name), sky=sky, seed=(0, index, 0))


def test_the_choices_are_those_that_can_be_built():
    from simgen import vegetation, vehicles

    assert set(SPECIES) == set(vegetation.SPECIES)
    assert set(FAMILIES) == set(vehicles.FAMILIES)


# --- drawing -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", recipe_names())
def test_what_is_drawn_lies_in_the_recipe(name):
    recipe = load_recipe(name)[1]
    for index in range(50):
        spec = _spec(name, index)
        road, table = spec.road, recipe.road
        for value, (low, high) in (
            (road.lane_width_m, table.lane_width_m),
            (100 * road.gradient, table.gradient_pct),
            (road.wear, table.wear),
            (spec.moving_per_km, recipe.traffic.moving_per_km),
            (spec.skyline, recipe.background.skyline),
        ):
            assert low - 1e-9 <= value <= high + 1e-9
        if road.curvature:
            low, high = table.radius_m
            assert low * (1 - 1e-9) <= 1 / abs(road.curvature) <= high * (1 + 1e-9)
        assert table.lanes[str(road.lanes)] > 0
        assert table.junctions[road.junction] > 0


@pytest.mark.parametrize("name", recipe_names())
def test_a_spec_is_the_inverse_of_its_json(name):
    spec = _spec(name, 3)
    assert SceneSpec.from_json(spec.to_json()) == spec


def test_the_same_seed_draws_the_same_scene_and_another_does_not():
    assert _spec("urban", 1) == _spec("urban", 1)
    assert _spec("urban", 1).road != _spec("urban", 2).road


def test_streams_differ_by_every_argument():
    base = (0, 0, 0, "rig")
    others = [(1, 0, 0, "rig"), (0, 1, 0, "rig"), (0, 0, 1, "rig"), (0, 0, 0, "sensor")]
    draws = {stream(*args).integers(1 << 62) for args in [base, *others]}
    assert len(draws) == 5
    assert stream(*base).random() == stream(*base).random()


def test_pick_follows_the_shares():
    rng = np.random.default_rng(0)
    shares = {"a": 3.0, "b": 1.0, "never": 0.0}
    count = Counter(pick(shares, rng=rng) for _ in range(4000))
    assert set(count) == {"a", "b"}
    assert abs(count["a"] / 4000 - 0.75) < 4 * np.sqrt(0.75 * 0.25 / 4000)


def test_draw_of_a_point_interval_is_the_point():
    assert draw((2.5, 2.5), rng=np.random.default_rng(0)) == 2.5


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize("key, value, expected", [
    ("keep", "1.5", r"key 'buildings\.keep' = 1\.5: .*less than or equal to 1"),
    ("keep", "nan", r"key 'buildings\.keep' = nan"),
    ("keep", '"many"', r"key 'buildings\.keep' = 'many': .*valid number"),
    ("share", "-1", r"key 'share' = -1: .*greater than or equal to 0"),
    ("share", "inf", r"key 'share' = inf: .*finite"),
    ("lane_width_m", "[1.0, 3.5]", r"key 'road\.lane_width_m' = \[1\.0, 3\.5\]: expected "
                                   r"\[low, high\] with 2\.5 <= low <= high <= 4\.5"),
    ("lane_width_m", "[3.5, 3.0]", r"key 'road\.lane_width_m' .* 2\.5 <= low <= high <= 4\.5"),
    ("lane_width_m", "3.5", r"key 'road\.lane_width_m' = 3\.5: expected \[low, high\] with 2"),
    ("skyline", "[60, 12]", r"key 'background\.skyline' .* 0 <= low <= high <= 400"),
    ("skyline", "[0.5, 12]", r"key 'background\.skyline\.0' = 0\.5: .*integer"),
    ("kind", '"canal"', r"key 'road\.kind' = 'canal': .*town\|rural\|motorway"),
    ("lanes", "{ 9 = 1.0 }", r"key 'road\.lanes' .*unknown choice '9'; expected some of 1, 2, 3"),
    ("lanes", "{}", r"key 'road\.lanes' = \{\}: expected shares >= 0, of which at least one"),
    ("lanes", "{ 1 = 0.0 }", r"key 'road\.lanes' .*: expected shares >= 0, of which at least one"),
    ("lanes", "{ 1 = -1, 2 = 2 }", r"key 'road\.lanes' .*: expected shares >= 0"),
    ("lanes", "{ 1 = inf }", r"key 'road\.lanes\.1' = inf: .*finite"),
    ("species", "{ cactus = 1 }", r"key 'vegetation\.species' .*unknown choice 'cactus'; expected "
                                  r"some of broadleaf"),
    ("families", "{ tank = 1 }", r"key 'traffic\.families' .*unknown choice 'tank'"),
])  # fmt: skip
def test_values_out_of_range_name_file_key_value_and_range(tmp_path, key, value, expected):
    path = _recipe_file(tmp_path, **{key: value})
    with pytest.raises(UserError, match=rf"mine\.toml: {expected}"):
        load_recipe(str(path))


@pytest.mark.parametrize("section, old, new, expected", [
    ("", "rig_lane", "rig_lain", r"unknown key 'rig_lain' \(did you mean 'rig_lane'\?\)"),
    ("road", "lane_width_m", "lane_widht_m",
     r"unknown key 'road\.lane_widht_m' \(did you mean 'lane_width_m'\?\)"),
    ("traffic", "parked", "zzz", r"unknown key 'traffic\.zzz' \(known: moving_per_km, parked, "),
])  # fmt: skip
def test_a_misspelt_key_is_named_with_a_suggestion(tmp_path, section, old, new, expected):
    path = _recipe_file(tmp_path)
    path.write_text(path.read_text("utf-8").replace(f"\n{old} = ", f"\n{new} = "), "utf-8")
    with pytest.raises(UserError) as error:
        load_recipe(str(path))
    missing = f"key '{section}.{old}' is missing" if section else f"key '{old}' is missing"
    assert error.match(rf"mine\.toml: .*{expected}")
    assert missing in str(error.value)


def test_all_mistakes_are_told_at_once(tmp_path):
    path = _recipe_file(tmp_path, keep="2", wear="[0, 9]")
    with pytest.raises(UserError, match=r"road\.wear.*; key 'buildings\.keep' = 2: "):
        load_recipe(str(path))


@pytest.mark.parametrize("content, expected", [
    (b"intent = ", r"mine\.toml: not valid TOML"), (b"\xff", r"mine\.toml: cannot be read"),
    (b"", r"mine\.toml: key 'intent' is missing; key 'share' is missing"),
])  # fmt: skip
def test_a_file_that_is_no_recipe_is_refused(tmp_path, content, expected):
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    with pytest.raises(UserError, match=expected):
        load_recipe(str(path))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"Recipe '.*none\.toml' is not known"):
        load_recipe(str(tmp_path / "none.toml"))
    with pytest.raises(UserError, match=r"none\.toml: cannot be read"):
        read_toml(tmp_path / "none.toml")


@pytest.mark.parametrize("table, data, expected", [
    (DaylightTable, {"share": 1, "sun_elevation_deg": [10, 95]}, r"-18 <= low <= high <= 70"),
    (DaylightTable, {"share": 1, "sun_elevation_deg": [20, 10]}, r"-18 <= low <= high <= 70"),
    (DaylightTable, {"share": -1, "sun_elevation_deg": [1, 2]}, r"greater than or equal to 0"),
    (WeatherTable, {"share": 1, "cloud_cover": [0, 2], "turbidity": [2, 3],
                    "visibility_m": [1e4, 2e4]}, r"'cloud_cover' .* 0 <= low <= high <= 1"),
    (WeatherTable, {"share": 1, "cloud_cover": [0, 1], "turbidity": [1, 3],
                    "visibility_m": [1e4, 2e4]}, r"'turbidity' .* 2 <= low <= high <= 9"),
    (WeatherTable, {"share": 1, "cloud_cover": [0, 1], "turbidity": [2, 3],
                    "visibility_m": [5, 2e4]}, r"'visibility_m' .* 50 <= low <= high <= 100000"),
])  # fmt: skip
def test_impossible_presets_are_refused(table, data, expected):
    with pytest.raises(UserError, match=rf"weather\.toml \[x\]: .*{expected}"):
        checked(table, data, "weather.toml [x]")


def test_shares_come_in_one_order_however_they_are_stated(tmp_path):
    path = _recipe_file(tmp_path, junctions="{ cross = 0.5, none = 0.2, tee = 0.3 }")
    stated = load_recipe(str(path))[1]
    assert isinstance(stated, Recipe)
    assert list(stated.road.junctions) == list(load_recipe("urban")[1].road.junctions)
