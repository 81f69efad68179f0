"""scenes/*.toml → validated recipes → drawn specs.

A recipe states ranges and shares; drawing one gives a :class:`SceneSpec`, plain data that says
what the scene is (JSON-able, stored beside every frame). Modules that build geometry take their
part of the spec and a generator from :func:`stream`, so that one module's draws never shift
another's.
"""

from __future__ import annotations

import difflib
import tomllib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    WrapValidator,
)

from simgen.errors import UserError

# --- ranges and shares -------------------------------------------------------------------------


class Table(BaseModel):
    """A TOML table: unknown keys are errors, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Interval = tuple[float, float]
"""[low, high]; a value is drawn uniformly in between"""


Bounds = TypeVar("Bounds", tuple[float, float], tuple[int, int])


def within(low: float, high: float) -> WrapValidator:
    """Requires an interval to be ordered and inside [low, high]."""
    expected = f"expected [low, high] with {low:g} <= low <= high <= {high:g}"

    def check(value: Any, parsed: Callable[[Any], Bounds]) -> Bounds:
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise ValueError(expected)
        bounds = parsed(value)
        if not low <= bounds[0] <= bounds[1] <= high:
            raise ValueError(expected)
        return bounds

    return WrapValidator(check)


def _check_shares(shares: dict[str, float]) -> dict[str, float]:
    if not shares or min(shares.values()) < 0 or sum(shares.values()) <= 0:
        raise ValueError("expected shares >= 0, of which at least one is positive")
    return dict(sorted(shares.items()))


def one_of(*allowed: str) -> AfterValidator:
    """Requires the keys of shares to be among ``allowed``."""

    def check(shares: dict[str, float]) -> dict[str, float]:
        for key in shares:
            if key not in allowed:
                raise ValueError(f"unknown choice {key!r}; expected some of {', '.join(allowed)}")
        return _check_shares(shares)

    return AfterValidator(check)


Shares = dict[str, float]
"""name → weight, need not add up to 1"""
SPECIES = ("broadleaf", "poplar", "birch", "spruce", "pine", "street")
"""trees that simgen.vegetation can grow"""
FAMILIES = ("hatchback", "saloon", "estate", "suv", "van", "box_truck", "semi_trailer", "bus",
            "motorcycle")  # fmt: skip
"""vehicles that simgen.vehicles can build"""
Probability = Annotated[float, Field(ge=0.0, le=1.0)]


def draw(interval: Interval, *, rng: np.random.Generator) -> float:
    """A uniform draw from an interval."""
    return float(rng.uniform(*interval))


def draw_log(interval: Interval, *, rng: np.random.Generator) -> float:
    """A log-uniform draw from an interval of positive numbers."""
    return float(np.exp(rng.uniform(*np.log(interval))))


def pick(shares: Mapping[str, float], *, rng: np.random.Generator) -> str:
    """A name drawn in proportion to its share, whatever the order that they are stated in."""
    names = sorted(shares)
    weights = np.array([shares[name] for name in names], dtype=np.float64)
    return str(rng.choice(names, p=weights / weights.sum()))


def stream(seed: int, index: int, attempt: int, name: str) -> np.random.Generator:
    """The generator of one purpose: a pure function of its arguments, seed 0 being a seed."""
    return np.random.default_rng(
        np.random.SeedSequence([seed, index, attempt, zlib.crc32(name.encode())])
    )


# --- the recipe, as TOML states it ---------------------------------------------------------------


class RoadTable(Table):
    """[road]: the network and its lanes."""

    kind: Annotated[str, Field(pattern="^(town|rural|motorway)$")]
    lanes: Annotated[Shares, one_of("1", "2", "3", "4")]
    """share of roads with that many driving lanes per direction"""
    lane_width_m: Annotated[Interval, within(2.5, 4.5)]
    parking: Probability
    """probability of a parking lane on each side"""
    shoulder_m: Annotated[Interval, within(0.3, 4.0)]
    """paved strip outside the edge line where there is no parking lane"""
    pavement_m: Annotated[Interval, within(0.0, 8.0)]
    """width of the pavement; [0, 0] for none"""
    radius_m: Annotated[Interval, within(60.0, 20000.0)]
    """curve radius, log-uniform"""
    straight: Probability
    """probability that the road is straight"""
    gradient_pct: Annotated[Interval, within(-12.0, 12.0)]
    junctions: Annotated[Shares, one_of("none", "tee", "cross")]
    junction_distance_m: Annotated[Interval, within(12.0, 200.0)]
    """from the rig to the next junction"""
    relief_m: Annotated[Interval, within(0.0, 40.0)]
    """height of the hills beside the road"""
    wear: Annotated[Interval, within(0.0, 1.0)]
    """0 = fresh paint and asphalt, 1 = hardly visible lines, many cracks"""


class BuildingsTable(Table):
    """[buildings]: the town beside the road."""

    rules: Annotated[Shares, one_of("none", "town", "suburban", "downtown", "industrial")]
    keep: Probability
    """probability that a lot is built on"""


class VegetationTable(Table):
    """[vegetation]"""

    street_trees_per_100m: Annotated[Interval, within(0.0, 20.0)]
    """trees in a row along the road, each side"""
    trees_per_hectare: Annotated[Interval, within(0.0, 300.0)]
    """trees on open land"""
    hedges: Probability
    """probability of a hedge along a stretch of frontage"""
    species: Annotated[Shares, one_of(*SPECIES)]


class TrafficTable(Table):
    """[traffic]"""

    moving_per_km: Annotated[Interval, within(0.0, 80.0)]
    """vehicles per lane and km"""
    parked: Annotated[Interval, within(0.0, 1.0)]
    """share of parking bays that are taken"""
    pedestrians_per_100m: Annotated[Interval, within(0.0, 60.0)]
    """people on foot, each side of the road"""
    cyclists_per_km: Annotated[Interval, within(0.0, 60.0)]
    """per lane and km"""
    families: Annotated[Shares, one_of(*FAMILIES)]


class FurnitureTable(Table):
    """[furniture]"""

    lamp_spacing_m: Annotated[Interval, within(10.0, 200.0)]
    lamps: Probability
    signs_per_100m: Annotated[Interval, within(0.0, 10.0)]
    guard_rail: Probability
    utility_poles: Probability
    small_per_100m: Annotated[Interval, within(0.0, 30.0)]
    """bins, benches, bollards, cabinets and the like, each side"""
    fences: Probability
    gantry: Probability
    overpass: Probability
    """a road or railway bridge over the road ahead"""
    footbridge: Probability
    noise_wall: Probability
    road_works: Probability
    building_site: Probability
    """a hoarding with a crane behind it"""
    trolley_wires: Probability
    """contact wires of trolley buses over the lanes"""


class BackgroundTable(Table):
    """[background]"""

    skyline: Annotated[tuple[int, int], within(0, 400)]
    """number of distant buildings"""
    relief_m: Annotated[Interval, within(0.0, 400.0)]
    """height of the far hills"""


class Recipe(Table):
    """One kind of road scene."""

    intent: Annotated[str, Field(min_length=10)]
    """one sentence: what this recipe is for"""
    share: Annotated[float, Field(ge=0.0)]
    """weight among the default recipes"""
    road: RoadTable
    buildings: BuildingsTable
    vegetation: VegetationTable
    traffic: TrafficTable
    furniture: FurnitureTable
    background: BackgroundTable
    rig_lane: Annotated[str, Field(pattern="^(right|any)$")]


class DaylightTable(Table):
    """One preset of scenes/daylight.toml."""

    share: Annotated[float, Field(ge=0.0)]
    sun_elevation_deg: Annotated[Interval, within(-18.0, 70.0)]


class WeatherTable(Table):
    """One preset of scenes/weather.toml."""

    share: Annotated[float, Field(ge=0.0)]
    cloud_cover: Annotated[Interval, within(0.0, 1.0)]
    turbidity: Annotated[Interval, within(2.0, 9.0)]
    visibility_m: Annotated[Interval, within(50.0, 100000.0)]
    """meteorological range of the haze; below 2000 m it is fog. Drawn log-uniformly"""
    rain_mm_h: Annotated[Interval, within(0.0, 50.0)] = (0.0, 0.0)
    """rate of the rain that falls"""
    wetness: Annotated[Interval, within(0.0, 1.0)] = (0.0, 0.0)
    """of the ground: 0 = dry, 1 = a film of water, and puddles"""


# --- the spec: what was drawn --------------------------------------------------------------------


@dataclass(frozen=True)
class RoadSpec:
    """A drawn road; see RoadTable."""

    kind: str
    lanes: int
    lane_width_m: float
    parking_left: bool
    parking_right: bool
    shoulder_m: float
    pavement_m: float
    curvature: float
    """signed, 1/m; 0 = straight"""
    gradient: float
    """rise per metre"""
    junction: str
    junction_distance_m: float
    relief_m: float
    wear: float


@dataclass(frozen=True)
class SkySpec:
    """Drawn sun, sky and haze."""

    daylight: str
    weather: str
    sun_elevation_deg: float
    sun_azimuth_deg: float
    """counter-clockwise from the rig's direction of travel"""
    cloud_cover: float
    turbidity: float
    visibility_m: float
    rain_mm_h: float
    wetness: float


@dataclass(frozen=True)
class SceneSpec:
    """Everything that was drawn for a scene; geometry follows from it and ``seed``."""

    recipe: str
    seed: tuple[int, int, int]
    """(dataset seed, scene index, attempt)"""
    road: RoadSpec
    sky: SkySpec
    building_rules: str
    building_keep: float
    street_trees_per_100m: float
    trees_per_hectare: float
    hedges: float
    species: dict[str, float]
    moving_per_km: float
    parked: float
    pedestrians_per_100m: float
    cyclists_per_km: float
    families: dict[str, float]
    lamps: bool
    lamp_spacing_m: float
    signs_per_100m: float
    guard_rail: bool
    utility_poles: bool
    small_per_100m: float
    fences: float
    gantry: bool
    overpass: bool
    footbridge: bool
    noise_wall: bool
    road_works: bool
    building_site: bool
    trolley_wires: bool
    skyline: int
    far_relief_m: float
    rig_lane: str

    def stream(self, name: str) -> np.random.Generator:
        """The generator of one module of this scene."""
        return stream(*self.seed, name)

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SceneSpec:
        """The inverse of :meth:`to_json`."""
        nested = {"road": RoadSpec(**data["road"]), "sky": SkySpec(**data["sky"])}
        return cls(**{**data, **nested, "seed": tuple(data["seed"])})


def draw_scene(
    name: str,
    recipe: Recipe,
    *,
    sky: SkySpec,
    seed: tuple[int, int, int],
) -> SceneSpec:
    """Draws one scene of a recipe."""
    rng = stream(*seed, "recipe")
    vegetation, furniture = recipe.vegetation, recipe.furniture
    return SceneSpec(
        recipe=name,
        seed=seed,
        road=_draw_road(recipe.road, rng=rng),
        sky=sky,
        building_rules=pick(recipe.buildings.rules, rng=rng),
        building_keep=recipe.buildings.keep,
        street_trees_per_100m=draw(vegetation.street_trees_per_100m, rng=rng),
        trees_per_hectare=draw(vegetation.trees_per_hectare, rng=rng),
        hedges=vegetation.hedges,
        species=vegetation.species,
        moving_per_km=draw(recipe.traffic.moving_per_km, rng=rng),
        parked=draw(recipe.traffic.parked, rng=rng),
        pedestrians_per_100m=draw(recipe.traffic.pedestrians_per_100m, rng=rng),
        cyclists_per_km=draw(recipe.traffic.cyclists_per_km, rng=rng),
        families=recipe.traffic.families,
        lamps=bool(rng.random() < furniture.lamps),
        lamp_spacing_m=draw(furniture.lamp_spacing_m, rng=rng),
        signs_per_100m=draw(furniture.signs_per_100m, rng=rng),
        guard_rail=bool(rng.random() < furniture.guard_rail),
        utility_poles=bool(rng.random() < furniture.utility_poles),
        small_per_100m=draw(furniture.small_per_100m, rng=rng),
        fences=furniture.fences,
        gantry=bool(rng.random() < furniture.gantry),
        overpass=bool(rng.random() < furniture.overpass),
        footbridge=bool(rng.random() < furniture.footbridge),
        noise_wall=bool(rng.random() < furniture.noise_wall),
        road_works=bool(rng.random() < furniture.road_works),
        building_site=bool(rng.random() < furniture.building_site),
        trolley_wires=bool(rng.random() < furniture.trolley_wires),
        skyline=int(rng.integers(recipe.background.skyline[0], recipe.background.skyline[1] + 1)),
        far_relief_m=draw(recipe.background.relief_m, rng=rng),
        rig_lane=recipe.rig_lane,
    )


def _draw_road(table: RoadTable, *, rng: np.random.Generator) -> RoadSpec:
    curvature = float(rng.choice([-1.0, 1.0])) / draw_log(table.radius_m, rng=rng)
    return RoadSpec(
        kind=table.kind,
        lanes=int(pick(table.lanes, rng=rng)),
        lane_width_m=draw(table.lane_width_m, rng=rng),
        parking_left=bool(rng.random() < table.parking),
        parking_right=bool(rng.random() < table.parking),
        shoulder_m=draw(table.shoulder_m, rng=rng),
        pavement_m=draw(table.pavement_m, rng=rng),
        curvature=0.0 if rng.random() < table.straight else curvature,
        gradient=draw(table.gradient_pct, rng=rng) / 100,
        junction=pick(table.junctions, rng=rng),
        junction_distance_m=draw(table.junction_distance_m, rng=rng),
        relief_m=draw(table.relief_m, rng=rng),
        wear=draw(table.wear, rng=rng),
    )


def draw_sky(
    daylight: Mapping[str, DaylightTable],
    weather: Mapping[str, WeatherTable],
    *,
    seed: tuple[int, int, int],
) -> SkySpec:
    """Draws daylight and weather from presets."""
    rng = stream(*seed, "sky")
    day = pick({k: v.share for k, v in daylight.items()}, rng=rng)
    kind = pick({k: v.share for k, v in weather.items()}, rng=rng)
    table = weather[kind]
    return SkySpec(
        daylight=day,
        weather=kind,
        sun_elevation_deg=draw(daylight[day].sun_elevation_deg, rng=rng),
        sun_azimuth_deg=float(rng.uniform(-180.0, 180.0)),
        cloud_cover=draw(table.cloud_cover, rng=rng),
        turbidity=draw(table.turbidity, rng=rng),
        visibility_m=draw_log(table.visibility_m, rng=rng),
        rain_mm_h=draw(table.rain_mm_h, rng=rng),
        wetness=draw(table.wetness, rng=rng),
    )


# --- reading TOML --------------------------------------------------------------------------------

T = TypeVar("T", bound=Table)


def scenes_dir() -> Path:
    """Where the recipes lie: inside the wheel, or beside the package in a checkout."""
    package = Path(__file__).resolve().parent
    inside = package / "_scenes"
    return inside if inside.is_dir() else package.parent / "scenes"


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as plain data; UserError if it is missing or malformed."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error}).") from error
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {error}.") from error


def checked(table: type[T], data: Mapping[str, Any], where: str) -> T:
    """Validates plain data; the error names file, key, value and what is allowed."""
    try:
        return table.model_validate(data)
    except ValidationError as error:
        raise UserError(_explained(error, table, where)) from error


def _explained(error: ValidationError, table: type[Table], where: str) -> str:
    lines = []
    for problem in error.errors():
        key = ".".join(str(x) for x in problem["loc"]) or "(the whole file)"
        if problem["type"] == "extra_forbidden":
            lines.append(f"unknown key '{key}'{_suggestion(problem['loc'], table)}")
        elif problem["type"] == "missing":
            lines.append(f"key '{key}' is missing")
        else:
            message = problem["msg"].removeprefix("Value error, ")
            lines.append(f"key '{key}' = {problem['input']!r}: {message}")
    return f"{where}: " + "; ".join(lines) + "."


def _suggestion(loc: tuple[int | str, ...], table: type[Table]) -> str:
    owner: Any = table
    for name in loc[:-1]:
        owner = owner.model_fields[name].annotation
    known = list(owner.model_fields)
    close = difflib.get_close_matches(str(loc[-1]), known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {', '.join(known)})"


def load_recipe(name_or_path: str) -> tuple[str, Recipe]:
    """A recipe by name (scenes/NAME.toml) or by the path of a TOML file."""
    named = scenes_dir() / f"{name_or_path}.toml"
    path = Path(name_or_path) if name_or_path.endswith(".toml") else named
    if not path.is_file():
        raise UserError(
            f"Recipe {name_or_path!r} is not known. Expected one of {', '.join(recipe_names())}, "
            "or the path of a TOML file like those in scenes/."
        )
    return path.stem, checked(Recipe, read_toml(path), str(path))


def recipe_names() -> list[str]:
    """Names of the recipes that come with the package."""
    presets = {"daylight", "weather"}
    return sorted(p.stem for p in scenes_dir().glob("*.toml") if p.stem not in presets)


def load_presets(kind: str, table: type[T], chosen: tuple[str, ...] = ()) -> dict[str, T]:
    """Presets of daylight or weather.

    Those of scenes/{kind}.toml; only the ``chosen`` ones if any are named, and all of each TOML
    file whose path is among these.
    """
    own = _presets_of(scenes_dir() / f"{kind}.toml", table)
    paths = [name for name in chosen if name.endswith(".toml")]
    for name in chosen:
        if name not in own and not (name in paths and Path(name).is_file()):
            what = "no such file" if name in paths else "unknown"
            raise UserError(
                f"--{kind} {name}: {what}; expected some of {', '.join(own)} (separated by "
                f"commas), or the path of a TOML file like scenes/{kind}.toml."
            )
    presets = {k: v for k, v in own.items() if not chosen or k in chosen}
    for path in paths:
        for name, preset in _presets_of(Path(path), table).items():
            if presets.setdefault(name, preset) != preset:
                raise UserError(
                    f"--{kind}: two different presets are called {name}. Rename the one in {path}."
                )
    return presets


def _presets_of(path: Path, table: type[T]) -> dict[str, T]:
    data = read_toml(path)
    if not data:
        raise UserError(f"{path}: no preset in it; expected a table [NAME] for each.")
    for name, value in data.items():
        if not isinstance(value, dict):
            raise UserError(
                f"{path}: key '{name}' = {value!r} is in no preset; expected tables [NAME] only."
            )
    return {name: checked(table, value, f"{path} [{name}]") for name, value in data.items()}
