"""What a set is made of: the options of ``simgen render``, resolved and checked."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from simgen import samples
from simgen.errors import UserError
from simgen.given_map import load as load_map
from simgen.given_map import road_kind
from simgen.metering import SENSORS
from simgen.recipe import (
    DaylightTable,
    Recipe,
    SceneSpec,
    WeatherTable,
    checked,
    draw_scene,
    draw_sky,
    load_presets,
    load_recipe,
    pick,
    read_toml,
    recipe_names,
    scenes_dir,
    stream,
)
from simgen.rig import Rig, drive_length
from simgen.workers import num_cores

MIN_SIZE, MAX_SIZE = (96, 54), (16384, 16384)
MAX_PAIRS = 10_000_000
MAX_FRAMES_PER_SCENE = 21
"""A drive of 60 m; all that is near to it has full detail, and is part of each of its frames."""

T = TypeVar("T", Recipe, DaylightTable, WeatherTable)


@dataclass(frozen=True)
class RenderOptions:
    """Renders a set of stereo pairs with exact ground truth.

    What is rendered follows from these options and the seed alone. The same command again resumes;
    a larger --n continues the set, a smaller one takes nothing away. --split, --workers, --recycle
    and --force may change from run to run; any other difference, also of the
    versions of packages that decide pixels, needs another folder.
    """

    n: int
    """number of stereo pairs; rounded up to whole rig frames (3 pairs each with the default rig)"""
    out: Path = Path("shards")
    """folder of the set"""
    seed: int = 0
    """dataset seed; 0 is a seed like any other"""
    rig: str = "default"
    """a rig of scenes/rigs/ (default, truck) or the path of a TOML file"""
    size: str = ""
    """image size WIDTHxHEIGHT [px]; the rig's native size if not given (default rig: 2560x1440)"""
    spp: int = 2
    """path-traced samples per pixel, a power of two; more is slower and less noisy. Where lamps
    burn, twice as many are taken"""
    denoise: bool = True
    """whether Open Image Denoise cleans the irradiance"""
    sensor: Literal["camera", "ideal"] = "camera"
    """camera: lens, noise, white balance, sharpening; ideal: exposure and tone curve only"""
    recipes: str = ""
    """comma-separated names (urban,suburban,highway,rural) or TOML paths; all if not given, or
    those for the kind of road that an OpenDRIVE map states"""
    weather: str = ""
    """comma-separated presets (clear,partly_cloudy,overcast,fog,rain,after_rain) or paths of TOML
    files like scenes/weather.toml; by shares"""
    daylight: str = ""
    """comma-separated presets (dawn,morning,noon,afternoon,dusk,night) or paths of TOML files like
    scenes/daylight.toml; by shares"""
    opendrive: Path | None = None
    """an OpenDRIVE file (.xodr) to drive through instead of roads of our own: each scene starts
    somewhere else on its driving lanes; lines, zebras, lights and signs are the file's, all else
    is the recipe's. The set keeps a copy of the file"""
    split: Literal["all", "train", "test"] = "all"
    """render one side only; a scene is a test scene if its number is divisible by 10"""
    frames_per_scene: int = 1
    """frames of one drive, 3 m apart, through the same scene, in which the others stand still;
    at most 21"""
    frames_per_shard: int = 16
    """rig frames per HDF5 file"""
    workers: int | None = None
    """processes that render at the same time and share the cores; one per core if not given, as
    far as memory goes"""
    recycle: int = 50
    """frames after which a worker process is replaced by a fresh one"""
    variant: str = "auto"
    """Mitsuba variant: auto, llvm_ad_rgb, scalar_rgb, cuda_ad_rgb (untested)"""
    flow: bool = True
    """store flow; without it the reader derives the same values from depth and cameras"""
    compression: Literal["gzip", "zstd"] = "gzip"
    """gzip is read by every HDF5 reader; zstd is faster and needs hdf5plugin"""
    force: bool = False
    """start even if the disk looks too small"""


@dataclass(frozen=True)
class Job:
    """Everything that decides the content of a frame."""

    seed: int
    rig_name: str
    rig: Rig
    wh: tuple[int, int]
    spp: int
    denoise: bool
    sensor: str
    recipes: dict[str, Recipe]
    daylight: dict[str, DaylightTable]
    weather: dict[str, WeatherTable]
    frames_per_scene: int
    flow: bool
    compression: str
    variant: str
    opendrive: bytes = b""
    """the map to drive through, as its file has it; empty for roads of our own"""

    @property
    def opendrive_sha256(self) -> str:
        """Of the map; empty if there is none."""
        return hashlib.sha256(self.opendrive).hexdigest() if self.opendrive else ""

    @property
    def samples(self) -> dict[str, int]:
        """Per pixel, by day and by night; see simgen/samples.py."""
        return samples.rule(self.spp)

    def content(self) -> dict[str, Any]:
        """Plain data, to be stored with the set and compared when it is continued."""
        tables = {
            name: {k: v.model_dump(mode="json") for k, v in getattr(self, name).items()}
            for name in ("recipes", "daylight", "weather")
        }
        return {
            "seed": self.seed,
            "rig": {"name": self.rig_name, **self.rig.model_dump(mode="json")},
            "size": f"{self.wh[0]}x{self.wh[1]}",
            "spp": self.spp,
            "samples": self.samples,
            "denoise": self.denoise,
            "sensor": self.sensor,
            **tables,
            "frames_per_scene": self.frames_per_scene,
            "flow": self.flow,
            "compression": self.compression,
            "variant": self.variant,
            "opendrive": self.opendrive_sha256,
        }

    @classmethod
    def from_content(cls, data: dict[str, Any], opendrive: bytes = b"") -> Job:
        """The inverse of :meth:`content`, which names a map by its hash only.

        Samples follow from ``spp`` by this version's rule, whichever the stored one is: a frame's
        own spec tells whether it had them.
        """
        rig = {k: v for k, v in data["rig"].items() if k != "name"}
        return cls(
            seed=data["seed"],
            rig_name=data["rig"]["name"],
            rig=checked(Rig, rig, "stored rig"),
            wh=parse_size(data["size"]),
            spp=data["spp"],
            denoise=data["denoise"],
            sensor=data["sensor"],
            recipes={k: checked(Recipe, v, k) for k, v in data["recipes"].items()},
            daylight={k: checked(DaylightTable, v, k) for k, v in data["daylight"].items()},
            weather={k: checked(WeatherTable, v, k) for k, v in data["weather"].items()},
            frames_per_scene=data["frames_per_scene"],
            flow=data["flow"],
            compression=data["compression"],
            variant=data["variant"],
            opendrive=opendrive,
        )


def draw_spec(job: Job, scene_index: int, attempt: int) -> SceneSpec:
    """The drawn scene, from (dataset seed, scene, attempt)."""
    seed = (job.seed, scene_index, attempt)
    name = pick({k: r.share for k, r in job.recipes.items()}, rng=stream(*seed, "which recipe"))
    sky = draw_sky(job.daylight, job.weather, seed=seed)
    return draw_scene(name, job.recipes[name], sky=sky, seed=seed)


def resolve(options: RenderOptions, variant: str) -> Job:
    """Reads the rig, recipes and presets that the options name.

    Raises UserError for anything that cannot be.
    """
    _check_numbers(options)
    rig_name, rig = load_rig(options.rig)
    recipes, daylight, weather = (_names(getattr(options, kind))
                                  for kind in ("recipes", "daylight", "weather"))  # fmt: skip
    if options.compression == "zstd":
        from simgen.shards import load_zstd  # h5py is not needed before

        load_zstd("--compression zstd")
    w, h = rig.size
    drive_m = drive_length(options.frames_per_scene)
    opendrive = load_map(options.opendrive, drive_m) if options.opendrive else b""
    return Job(
        seed=options.seed,
        rig_name=rig_name,
        rig=rig,
        wh=parse_size(options.size or f"{w}x{h}"),
        spp=options.spp,
        denoise=options.denoise,
        sensor=options.sensor,
        recipes=_recipes(recipes, opendrive),
        daylight=_presets("daylight", DaylightTable, daylight),
        weather=_presets("weather", WeatherTable, weather),
        frames_per_scene=options.frames_per_scene,
        flow=options.flow,
        compression=options.compression,
        variant=variant,
        opendrive=opendrive,
    )


def _check_numbers(options: RenderOptions) -> None:
    positive = ("n", "frames_per_scene", "frames_per_shard", "workers", "recycle", "spp")
    for name in positive:
        value = getattr(options, name)
        if value is not None and value < 1:
            flag = "--" + name.replace("_", "-")
            raise UserError(f"{flag} {value}: expected a whole number from 1 on.")
    if options.frames_per_scene > MAX_FRAMES_PER_SCENE:
        raise UserError(
            f"--frames-per-scene {options.frames_per_scene}: expected at most "
            f"{MAX_FRAMES_PER_SCENE}; a longer drive would leave its scene."
        )
    if options.n > MAX_PAIRS:
        raise UserError(f"--n {options.n}: expected at most {MAX_PAIRS} pairs.")
    if not 0 <= options.seed < 1 << 63:
        raise UserError(f"--seed {options.seed}: expected a whole number from 0 to 2^63 - 1.")
    if options.spp & (options.spp - 1) or options.spp > 4096:
        raise UserError(
            f"--spp {options.spp}: expected a power of two up to 4096 (1, 2, 4, 8, …); other "
            "counts would recompile the renderer's kernels."
        )
    if options.sensor not in SENSORS:
        raise UserError(f"--sensor {options.sensor}: expected one of {', '.join(SENSORS)}.")
    cores = num_cores()
    if options.workers is not None and options.workers > 4 * cores:
        raise UserError(f"--workers {options.workers}: this machine has {cores} cores.")


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if text and not names:
        raise UserError(f"{text!r} names nothing: expected names with commas in between.")
    return names


def _load_recipes(names: Sequence[str]) -> dict[str, Recipe]:
    recipes: dict[str, Recipe] = {}
    for name in names:
        stem, recipe = load_recipe(name)
        if recipes.setdefault(stem, recipe) != recipe:
            raise UserError(
                f"--recipes: two different files are called {stem}. Rename one of them."
            )
    return recipes


def _fitting(opendrive: bytes) -> dict[str, Recipe]:
    """All recipes, or those for the kind of road that a map states."""
    recipes = _load_recipes(recipe_names())
    kind = road_kind(opendrive) if opendrive else ""
    return {k: r for k, r in recipes.items() if not kind or r.road.kind == kind}


def _recipes(names: Sequence[str], opendrive: bytes) -> dict[str, Recipe]:
    """Those that are named, also by the path of a file, which holds one; or all that fit."""
    if names:
        recipes = _load_recipes(names)
        return _taking_part(recipes, f"--recipes {','.join(names)}", named=list(recipes))
    return _taking_part(_fitting(opendrive), str(scenes_dir() / "*.toml"), named=())


def _presets(kind: str, table: type[T], chosen: tuple[str, ...]) -> dict[str, T]:
    """Those that are named, and those of the files that are; or all."""
    presets = load_presets(kind, table, chosen)
    where = f"--{kind} {','.join(chosen)}" if chosen else str(scenes_dir() / f"{kind}.toml")
    return _taking_part(presets, where, named=[name for name in chosen if name in presets])


def _taking_part(tables: dict[str, T], where: str, *, named: Sequence[str]) -> dict[str, T]:
    """Drops what has no share, unless it was named: then all that were named get the same."""
    if any(tables[name].share == 0 for name in named):
        equal = {name: tables[name].model_copy(update={"share": 1.0}) for name in named}
        tables = {**tables, **equal}
    taking_part = {k: t for k, t in tables.items() if t.share > 0}
    if not taking_part:
        raise UserError(
            f"{where}: {', '.join(tables)} all have share = 0, so nothing can be drawn. Give one "
            "of them a share above 0, or name those that are to be drawn."
        )
    return taking_part


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) from "2560x1440"; UserError if malformed or out of range."""
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip().lower())
    if match is None:
        raise UserError(f"--size {text!r}: expected WIDTHxHEIGHT in pixels, like 2560x1440.")
    w, h = int(match[1]), int(match[2])
    if not (MIN_SIZE[0] <= w <= MAX_SIZE[0] and MIN_SIZE[1] <= h <= MAX_SIZE[1]):
        raise UserError(
            f"--size {text}: expected from {MIN_SIZE[0]}x{MIN_SIZE[1]} to "
            f"{MAX_SIZE[0]}x{MAX_SIZE[1]} pixels."
        )
    return w, h


def load_rig(name_or_path: str) -> tuple[str, Rig]:
    """A rig by name (scenes/rigs/NAME.toml) or by the path of a TOML file."""
    folder = scenes_dir() / "rigs"
    path = Path(name_or_path) if name_or_path.endswith(".toml") else folder / f"{name_or_path}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise UserError(
            f"--rig {name_or_path}: expected one of {known}, or the path of a TOML file like those "
            "in scenes/rigs/."
        )
    return path.stem, checked(Rig, read_toml(path), str(path))
