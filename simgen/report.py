"""``simgen report``: one HTML page about a set, without any other file or the network.

What was asked for, a contact sheet, how the frames are distributed, what they cost, what failed,
and the files with their checksums.
"""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from simgen import charts, samples
from simgen.errors import UserError
from simgen.geometry import Array
from simgen.page import page, plain, section, size_text, table
from simgen.paint import Rgb
from simgen.schema import LABELS
from simgen.shards import Manifest, ShardSet, write_atomically
from simgen.survey import (
    DEPTH_EDGES_M,
    FAR_M,
    FLOW_EDGES_PX,
    Measured,
    RunLog,
    measure,
    read_log,
)

MAX_THUMBNAILS = 96
_THUMBNAIL_WIDTH = 264
_JPEG_QUALITY = 80
_NUM_BINS, _NUM_ANGLE_BINS = 50, 10
_AXES = ("x (pitch)", "y (yaw)", "z (roll)")


def write_report(folder: Path, path: Path) -> Path:
    """Measures all frames of a set and writes the page; UserError if there is nothing to tell."""
    frames = ShardSet(folder)
    if not len(frames):
        raise UserError(
            f"{folder}: no finished shard yet, so there is nothing to report on. Let "
            '"simgen render" go on, with the same command.'
        )
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    measured = [measure(frame) for frame in frames]
    sections = (
        _heading(frames, measured),
        _contact_sheet(frames, measured),
        _distributions(frames, measured),
        _strata(frames.manifest.config, measured),
        _content(measured),
        _cost(read_log(folder)),
        _failures(frames.manifest),
        _files(frames.manifest),
    )
    frames.close()
    with _writing(path):
        write_atomically(path, page(folder.resolve().name, sections).encode())
    return path


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{path}: cannot write the page ({error.strerror}). Choose another place with --out."
        ) from error


# --- heading -------------------------------------------------------------------------------------


def _heading(frames: ShardSet, measured: Sequence[Measured]) -> str:
    manifest, config = frames.manifest, frames.manifest.config
    num_pairs = len(config["rig"]["pairs"])
    per_split = Counter(split for s in manifest.shards for split in [s.split] * len(s.frames))
    splits = ", ".join(f"{n} {split}" for split, n in per_split.items())
    lead = (
        f"{len(frames)} rig frames ({splits}), {len(frames) * num_pairs} stereo pairs, "
        f"{config['size']} pixels, {size_text(sum(s.bytes for s in manifest.shards))}. "
        f"Seed {manifest.dataset_seed}, simgen {manifest.package_version}, "
        f"schema {manifest.schema_version}."
    )
    complete = escape(json.dumps(config, indent=1, ensure_ascii=False))
    return (
        f'<p class="lead">{escape(lead)}</p>'
        f'<div class="columns">{table(("asked for", ""), _asked_for(config))}'
        f"{_extremes(measured)}</div>"
        f"<details><summary>The whole configuration</summary><pre>{complete}</pre></details>"
    )


def _asked_for(config: dict[str, Any]) -> list[tuple[str, str]]:
    rig = config["rig"]
    return [
        ("rig", f"{rig['name']}: cameras at {', '.join(f'{y:g}' for y in rig['camera_y_m'])} m"),
        ("pairs", ", ".join(f"{a}-{b}" for a, b in rig["pairs"])),
        ("field of view", f"{rig['hfov_deg']:g}° across"),
        ("drawn rotation", f"within ±{rig['perturbation_deg']:g}° about each axis"),
        ("samples per pixel", samples.in_words(config)),
        ("denoised", "yes" if config["denoise"] else "no"),
        ("sensor", str(config["sensor"])),
        ("flow", "stored" if config["flow"] else "derived by the reader"),
        ("frames per scene", str(config["frames_per_scene"])),
        ("rendered with", f"{config['variant']}, compressed with {config['compression']}"),
    ]


def _extremes(measured: Sequence[Measured]) -> str:
    """Smallest, median and largest value over the frames (or their images, or pairs)."""
    quantities: dict[str, tuple[Array, str]] = {
        "nearest surface [m]": (np.array([m.depth_range_m[0] for m in measured]), ".2f"),
        "farthest surface [m]": (np.array([m.depth_range_m[1] for m in measured]), ".0f"),
        "longest flow of a pair [px]": (_stacked(measured, lambda m: m.flow_longest_px), ".1f"),
        "overlap of a pair": (_stacked(measured, lambda m: m.overlap), ".3f"),
        "mean brightness of an image": (_stacked(measured, lambda m: m.brightness), ".3f"),
        "drawn rotation [°]": (_stacked(measured, lambda m: m.perturbation_deg), "+.3f"),
        "height of the sun [°]": (np.array([m.sun_elevation_deg for m in measured]), ".1f"),
    }  # fmt: skip
    rows = [
        (name, *(format(float(v), form) for v in np.nanpercentile(values, (0, 50, 100))))
        for name, (values, form) in quantities.items()
    ]
    return table(("over the set", "min", "median", "max"), rows, numbers=True)


def _stacked(measured: Sequence[Measured], get: Callable[[Measured], Array]) -> Array:
    return np.stack([get(m) for m in measured])


# --- contact sheet -------------------------------------------------------------------------------


def _contact_sheet(frames: ShardSet, measured: Sequence[Measured]) -> str:
    chosen = np.linspace(0, len(measured) - 1, min(MAX_THUMBNAILS, len(measured)), dtype=int)
    camera = len(measured[0].brightness) // 2
    cells = []
    for m in (measured[k] for k in chosen):
        source = _data_uri(_thumbnail(frames.frame(m.index).read("image", camera)))
        near, far = m.depth_range_m
        cells.append(
            f'<figure><img loading="lazy" src="{source}" alt="frame {m.index}">'
            f"<figcaption><b>{m.index}</b> {escape(' · '.join(map(plain, m.stratum)))}"
            f"<br>{near:.1f} to {far:.0f} m, flow to {m.flow_longest_px.max():.0f} px"
            "</figcaption></figure>"
        )
    shown = "all" if len(cells) == len(measured) else f"{len(cells)} of"
    note = f"Camera {camera} of {shown} {len(measured)} frames."
    return section("Contact sheet", f'<div class="sheet">{"".join(cells)}</div>', note)


def _thumbnail(image: Rgb) -> bytes:
    height = round(_THUMBNAIL_WIDTH * image.shape[0] / image.shape[1])
    small = cv2.resize(image, (_THUMBNAIL_WIDTH, height), interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1])


def _data_uri(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()


# --- distributions -------------------------------------------------------------------------------


def _distributions(frames: ShardSet, measured: Sequence[Measured]) -> str:
    rig = frames.manifest.config["rig"]
    pairs = [f"pair {a}-{b}" for a, b in rig["pairs"]]
    cameras = [f"camera {c}" for c in range(len(rig["camera_y_m"]))]
    shares = np.linspace(0, 1, _NUM_BINS + 1)
    overlap = _stacked(measured, lambda m: m.overlap)
    brightness = _stacked(measured, lambda m: m.brightness)
    flow = np.sum([m.flow_counts for m in measured], axis=0)
    labels = np.sum([m.label_counts for m in measured], axis=0)
    figures = {
        "Depth": charts.histogram(
            DEPTH_EDGES_M, {"": np.sum([m.depth_counts for m in measured], axis=0)},
            x="depth [m], without the sky", y="share of pixels", log=True),
        "Length of the flow": charts.histogram(
            FLOW_EDGES_PX, dict(zip(pairs, flow, strict=True)),
            x="length [px]", y="share of left pixels", log=True),
        "Overlap": charts.histogram(
            shares, _binned(pairs, overlap.T, shares),
            x="share of left pixels visible in the right image", y="share of frames"),
        "Brightness": charts.histogram(
            shares, _binned(cameras, brightness.T, shares),
            x="mean of an image, 1 = white", y="share of images"),
        "Drawn rotations": _angles(measured, rig["perturbation_deg"]),
        "Classes": charts.class_shares(labels),
    }  # fmt: skip
    return section("Distributions", f'<div class="charts">{_charts(figures)}</div>')


def _angles(measured: Sequence[Measured], limit_deg: float) -> Figure:
    """Histograms of the drawn angles; a rig without a perturbation has them all at 0."""
    edges = np.linspace(-1, 1, _NUM_ANGLE_BINS + 1) * (limit_deg or 1.0)
    drawn = _stacked(measured, lambda m: m.perturbation_deg).reshape(-1, 3)
    return charts.histogram(
        edges, _binned(_AXES, drawn.T, edges), x="angle about an axis of the camera [°]",
        y="share of cameras", expected=1 / (len(edges) - 1) if limit_deg else None,
    )  # fmt: skip


def _binned(names: Sequence[str], rows: Array, edges: Array) -> dict[str, Array]:
    return {name: np.histogram(row, edges)[0] for name, row in zip(names, rows, strict=True)}


def _charts(figures: dict[str, Figure]) -> str:
    return "".join(
        f"<figure><h3>{escape(name)}</h3>{charts.to_svg(figure, name)}</figure>"
        for name, figure in figures.items()
    )


# --- strata --------------------------------------------------------------------------------------


def _strata(config: dict[str, Any], measured: Sequence[Measured]) -> str:
    """A table of recipe by daylight and weather, and the shares that were asked for."""
    counts = Counter(m.stratum for m in measured)
    daylights, weathers = list(config["daylight"]), list(config["weather"])
    head = "".join(f'<th colspan="{len(weathers)}">{_name(d)}</th>' for d in daylights)
    below = "".join(f"<th>{_name(w)}</th>" for _ in daylights for w in weathers)
    body = "".join(
        f"<tr><th>{_name(r)}</th>"
        + "".join(_count(counts[r, d, w], len(measured)) for d in daylights for w in weathers)
        + "</tr>"
        for r in config["recipes"]
    )
    grid = (
        f'<table class="strata"><tr><th rowspan="2">frames</th>{head}</tr><tr>{below}</tr>{body}'
        "</table>"
    )
    asked = "".join(
        table((title, "asked", "frames", "found"), _asked_and_found(config[key], Counter(found)),
               numbers=True)
        for title, key, found in (
            ("recipe", "recipes", (m.recipe for m in measured)),
            ("daylight", "daylight", (m.daylight for m in measured)),
            ("weather", "weather", (m.weather for m in measured)),
        )
    )  # fmt: skip
    return section("Strata", f'<div class="scroll">{grid}</div><div class="columns">{asked}</div>')


def _count(count: int, total: int) -> str:
    shade = f' style="background:rgba(63,114,175,{min(0.6, 4 * count / total):.2f})"'
    return f"<td{shade if count else ''}>{count or '·'}</td>"


def _name(text: str) -> str:
    return escape(plain(text))


def _asked_and_found(asked: dict[str, Any], found: Counter[str]) -> list[tuple[str, ...]]:
    weight = sum(a["share"] for a in asked.values())
    total = found.total()
    return [
        (plain(name), f"{100 * a['share'] / weight:.0f} %", str(found[name]),
         f"{100 * found[name] / total:.0f} %")
        for name, a in asked.items()
    ]  # fmt: skip


# --- content -------------------------------------------------------------------------------------


def _content(measured: Sequence[Measured]) -> str:
    """What is in view, as means over the frames of each recipe, then over all."""
    recipes = sorted({m.recipe for m in measured})
    groups = {plain(r): [m for m in measured if m.recipe == r] for r in recipes}
    head = ("mean per frame", "frames", "classes", "instances", "sky",
            *(f"beyond {far:g} m" for far in FAR_M))  # fmt: skip
    rows = [(name, *_means(group)) for name, group in {**groups, "all": measured}.items()]
    note = "In view of any camera of the rig; shares are of all pixels."
    return section("Content", table(head, rows, numbers=True), note)


def _means(group: Sequence[Measured]) -> Iterator[str]:
    yield str(len(group))
    yield f"{np.mean([m.num_classes for m in group]):.1f}"
    yield f"{np.mean([m.num_instances for m in group]):.1f}"
    labels = np.sum([m.label_counts for m in group], axis=0)
    for share in (labels[LABELS["sky"]] / labels.sum(), *np.mean([m.far_shares for m in group], 0)):
        yield f"{100 * share:.1f} %"


# --- cost and failures ---------------------------------------------------------------------------


def _cost(log: RunLog) -> str:
    if not log.finished:
        return section("Cost", "<p>The set has no render.jsonl, so nothing is known.</p>")
    figures = {
        "Seconds per stage": charts.stage_seconds(log.stage_seconds()),
        "Memory of the process": charts.memory(_memory(log)),
    }
    note = f"From the log of {len(log.finished)} frames."
    if log.num_unreadable:
        note += f" {log.num_unreadable} lines of the log are not readable and were left out."
    return section("Cost", f'<div class="wide">{_charts(figures)}</div>', note)


def _memory(log: RunLog) -> list[list[tuple[int, float]]]:
    """(place in time, GB) of each process's frames."""
    points: dict[tuple[str, int], list[tuple[int, float]]] = {}
    for place, record in enumerate(log.finished, start=1):
        process = points.setdefault((record["host"], record["pid"]), [])
        process.append((place, record["rss_bytes"] / 1e9))
    return list(points.values())


def _failures(manifest: Manifest) -> str:
    if not manifest.redrawn and not manifest.failures:
        return section("Redrawn and failed", "<p>None.</p>")
    rows = [
        (str(r["frame_index"]), str(r["attempt"]), what, "; ".join(r["reasons"]))
        for what, records in (("failed", manifest.failures), ("drawn again", manifest.redrawn))
        for r in records
    ]
    note = f"{len(manifest.failures)} frames failed, {len(manifest.redrawn)} draws were replaced."
    return section("Redrawn and failed", table(("frame", "attempt", "what", "reasons"), rows), note)


def _files(manifest: Manifest) -> str:
    rows = [
        (s.name, s.split, str(len(s.frames)), size_text(s.bytes), s.sha256) for s in manifest.shards
    ]
    listing = table(("file", "split", "frames", "size", "sha256"), rows)
    return section("Files", f'<div class="files scroll">{listing}</div>')
