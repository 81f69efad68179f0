"""Does denoising eat texture, does aliasing add any, and do both views still show the same?

    python benchmarks/consistency.py [--frames 4] [--recipes urban,rural] [--images folder]

Renders the left and right camera of frames as a set would (few samples, denoised), and a
reference: the mean of runs without the denoiser, 256 samples in all, in two independent halves.
Where lamps burn, both take twice as many samples.

*Octaves* of the linear luminance, from the finest on: power over the reference's own, the kept
amplitude of the true texture, and the added power (``simgen/statistics.py`` defines them). The bar
is a power of 0.8 to 1.2.

*Residual*: mean absolute difference in grey levels between the left image and the right one looked
up along the exact flow, where the left pixel is visible in the right image and textured; denoised
over reference. The bar is 1.3.

A second table tells the same of every class: where power is missing, or in excess.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from _table import markdown, write_csv
from numpy.typing import NDArray

from simgen import engine, groundtruth, produce, sensor
from simgen.color import luminance
from simgen.config import Job, RenderOptions, resolve
from simgen.geometry import Array
from simgen.metering import expose, meter
from simgen.schema import LABELS, VISIBLE
from simgen.statistics import FLAT, Octave, compare_octaves, gradient, octave_bands, warped
from simgen.tone import WHITE

RUN_SPP, NUM_RUNS = 16, 16
"""of the reference: runs of their own seeds, since the first-hit features are sampled per run"""
NUM_OCTAVES = 5
MIN_SHARE = 0.005
"""classes that fill less of a frame are left out"""
SPREAD_PX = 6.0
INVISIBLE = 1e-4
"""power, in exposed light squared, of a texture that hardly shows"""

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Options:
    """Texture and agreement of denoised views against a reference of many samples."""

    frames: int = 4
    size: str = "640x360"
    recipes: str = ""
    """comma-separated names; all if not given"""
    weather: str = "clear,partly_cloudy"
    seed: int = 0
    spp: int = RenderOptions(n=1).spp
    images: Path | None = None
    """folder for pictures of what is missing (blue) and in excess (red) in the finest octave"""
    csv: Path | None = None


@dataclass(frozen=True, eq=False)
class Views:
    """The first pair of a frame: radiance, as (left, right), and what is in it."""

    recipe: str
    rendered: list[Image]
    halves: tuple[list[Image], list[Image]]
    flow: NDArray[np.float32]
    visible: NDArray[np.bool_]
    semantic: NDArray[np.uint8]

    @property
    def reference(self) -> list[Image]:
        """The mean of both halves."""
        return [(a + b) / 2 for a, b in zip(*self.halves, strict=True)]


def main(options: Options) -> None:
    """Prints the tables."""
    chosen = engine.choose()
    engine.activate(chosen)
    job = resolve(
        RenderOptions(n=1, size=options.size, recipes=options.recipes, weather=options.weather,
                      seed=options.seed, spp=options.spp, sensor="ideal"),
        chosen.variant,
    )  # fmt: skip
    octaves, residuals = [], []
    for index in range(options.frames):
        views = _render(job, index)
        label = f"{index} {views.recipe}"
        octaves += [(label, *row) for row in _octave_rows(views)]
        residuals.append((label, *_residuals(views)))
        if options.images:
            _save_picture(options.images / f"octave-{index}.png", views)
    header = ("frame", "surface", "share", "quantity", *_octave_names())
    print(f"{options.size}, {options.spp} spp, reference {RUN_SPP * NUM_RUNS} spp\n")
    print(markdown(header, [row for row in octaves if row[1] == "all"]), end="\n\n")
    print(markdown(header, [row for row in octaves if row[1] != "all"]), end="\n\n")
    print(markdown(("frame", "denoised [grey levels]", "reference", "ratio"), residuals))
    if options.csv:
        write_csv(options.csv, header, octaves)


# --- rendering -----------------------------------------------------------------------------------


def _render(job: Job, index: int) -> Views:
    plan = produce.plan_frame(job, index, attempt=0)
    pair = replace(plan.posed, cameras=plan.posed.cameras[:2])
    plan, watch = replace(plan, posed=pair), produce.Stopwatch()
    loaded, sky = produce.load(plan, job, watch)

    def radiance(job: Job) -> list[Image]:
        return produce.radiance(plan, job, loaded, sky, watch)

    runs = [
        replace(job, seed=job.seed + 1 + k, spp=RUN_SPP, denoise=False) for k in range(NUM_RUNS)
    ]
    left, right = (groundtruth.look(loaded, camera) for camera in pair.cameras)
    return Views(
        recipe=plan.spec.recipe,
        rendered=radiance(job),
        halves=(_mean(map(radiance, runs[::2])), _mean(map(radiance, runs[1::2]))),
        flow=groundtruth.flow(groundtruth.depth(left), *pair.cameras),
        visible=(groundtruth.flow_status(loaded, left, right) & VISIBLE) > 0,
        semantic=groundtruth.semantic(left, loaded.faces),
    )


def _mean(runs: Iterator[list[Image]]) -> list[Image]:
    return [np.mean(views, axis=0) for views in zip(*runs, strict=True)]


# --- octaves -------------------------------------------------------------------------------------


def _octave_rows(views: Views) -> Iterator[tuple[object, ...]]:
    """(surface, share, quantity, octaves…) of the whole left image, then of its classes."""
    x, a, b = _bands(views)
    names = {label: name for name, label in LABELS.items()}
    masks = {"all": np.ones(views.semantic.shape, dtype=bool)}
    masks |= {names[i]: views.semantic == i for i in np.unique(views.semantic)}
    for name, where in masks.items():
        if where.mean() >= MIN_SHARE:
            found = np.array([astuple(o) for o in compare_octaves(x, a, b, where)])
            for quantity, values in zip(Octave.__annotations__, found.T, strict=True):
                yield name, float(where.mean()), quantity, *map(float, values)


def _bands(views: Views) -> list[Array]:
    exposure = meter(views.reference)
    half_a, half_b = views.halves
    return [
        octave_bands(np.clip(luminance(v) * exposure, 0, WHITE), NUM_OCTAVES)
        for v in (views.rendered[0], half_a[0], half_b[0])
    ]


def _octave_names() -> list[str]:
    return [f"{2 ** (k + 1)} to {2 ** (k + 2)} px" for k in range(NUM_OCTAVES)]


def _save_picture(path: Path, views: Views) -> None:
    """Power of the finest octave around each pixel: in excess red, missing blue, up to 4 times."""
    x, a, b = (bands[0] for bands in _bands(views))
    power, truth = (cv2.GaussianBlur(p, (0, 0), SPREAD_PX) for p in (x * x, a * b))
    change = np.log2((power + INVISIBLE) / (np.maximum(truth, 0) + INVISIBLE)) / 2
    change = np.clip(change, -1, 1)
    grey = _developed(views, views.rendered)[0].mean(axis=-1)
    tint = np.stack([grey * (1 - np.maximum(change, 0)), grey * (1 - np.abs(change)),
                     grey * (1 - np.maximum(-change, 0))], axis=-1)  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), tint.astype(np.uint8))


# --- residual ------------------------------------------------------------------------------------


def _residuals(views: Views) -> tuple[float, float, float]:
    """Mean absolute residual of the rendered pair, of the reference, and their ratio."""
    rendered = _greys(views, views.rendered)
    reference = _greys(views, views.reference)
    use = views.visible & (np.hypot(*gradient(reference[0])) >= FLAT)
    values = [
        float(np.abs(left - warped(right, views.flow))[use].mean())
        for left, right in (rendered, reference)
    ]
    return values[0], values[1], values[0] / values[1]


def _greys(views: Views, radiances: list[Image]) -> list[Image]:
    developed = _developed(views, radiances)
    return [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY).astype(np.float32) for i in developed]


def _developed(views: Views, radiances: list[Image]) -> list[NDArray[np.uint8]]:
    """8-bit images, all exposed for the reference."""
    rng = np.random.default_rng(0)
    exposures = expose("ideal", views.reference, rng=rng)
    return [sensor.develop(r, e, rng=rng) for r, e in zip(radiances, exposures, strict=True)]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
