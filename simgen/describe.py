"""``simgen describe``: a set in words, enough to read it without any other document."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from simgen.schema import FIELDS
from simgen.shards import SPLITS, Manifest, ShardSet, open_shard

_EXAMPLE = """\
from simgen.shards import ShardSet
frames = ShardSet({folder!r}, split={split!r})
frame = frames[0]                       # nothing is read yet
left, right = frame.pairs[0]
image = frame.read("image", left)       # (H, W, 3) uint8
flow = frame.flow(0)                    # (H, W, 2) float32: uv_right = uv_left + flow"""


def describe(folder: Path) -> str:
    """The text; UserError if there is no set."""
    frames = ShardSet(folder)
    manifest = frames.manifest
    sections = [_summary(folder, manifest)]
    if len(frames):
        with open_shard(folder / manifest.shards[0].name) as shard:
            sections += [_fields(shard), _conventions(shard)]
        specs = [frame.spec for frame in frames]
        sections += [_strata(specs), _versions(specs)]
    frames.close()
    sections += [_config(manifest.config), _faults(manifest)]
    if len(frames):
        sections.append(_titled("Reading it", [_EXAMPLE.format(
            folder=str(folder), split=manifest.shards[0].split)]))  # fmt: skip
    return "\n\n".join(sections)


def _summary(folder: Path, manifest: Manifest) -> str:
    num_pairs = len(manifest.config["rig"]["pairs"])
    per_split: Counter[str] = Counter()
    for shard in manifest.shards:
        per_split[shard.split] += len(shard.frames)
    lines = [
        f"{split}: {n} rig frames, {n * num_pairs} pairs" for split, n in per_split.items()
    ] or ["no finished shard yet"]
    size = sum(shard.bytes for shard in manifest.shards)
    lines.append(
        f"{manifest.config['size']} pixels, {len(manifest.shards)} files, {size / 1e6:.1f} MB; "
        f"asked for: {_asked(manifest)}, seed {manifest.dataset_seed}"
    )
    return _titled(str(folder), lines)


def _asked(manifest: Manifest) -> str:
    """Pairs of the whole set, or what was asked of each side of the split."""
    sides = manifest.pairs_asked
    if set(sides.values()) == {manifest.num_pairs_asked} and len(sides) == len(SPLITS):
        sides = {}
    each = [f"--n {num} --split {side}" for side, num in sides.items()]
    return ", ".join(each) or f"{manifest.num_pairs_asked} pairs"


def _fields(shard: Any) -> str:
    """The datasets of a shard, as they are in the file."""
    rows = [
        (name, f"n,{','.join(map(str, shard[name].shape[1:]))}".rstrip(","), field.dtype,
         field.meaning)
        for name, field in FIELDS.items()
        if name in shard
    ]  # fmt: skip
    rows.append(("pairs", ",".join(map(str, shard["pairs"].shape)), "uint8",
                 "camera indices (left, right)"))  # fmt: skip
    return _titled("Fields (n frames, then one number per axis)", _aligned(rows))


def _conventions(shard: Any) -> str:
    sentences = str(shard.attrs["conventions"]).replace(". ", ".\n").splitlines()
    return _titled("Conventions", [f"Units: {shard.attrs['units']}.", *sentences])


def _strata(specs: Sequence[dict[str, Any]]) -> str:
    counts = Counter((s["recipe"], s["daylight"]["name"], s["weather"]["name"]) for s in specs)
    rows = [(*stratum, str(count)) for stratum, count in sorted(counts.items())]
    return _titled("Frames by recipe, daylight, weather", _aligned(rows))


def _versions(specs: Sequence[dict[str, Any]]) -> str:
    """Of each package; where frames differ, of how many of them."""
    packages = sorted({name for spec in specs for name in spec["versions"]})
    rows = []
    for name in packages:
        counts = Counter(spec["versions"].get(name, "unknown") for spec in specs)
        each = [f"{v} ({n} frames)" for v, n in sorted(counts.items())]
        rows.append((name, ", ".join(each) if len(counts) > 1 else next(iter(counts))))
    return _titled("Made with", _aligned(rows))


def _config(config: dict[str, Any]) -> str:
    """Plain values as they are; of the tables of recipes, daylight and weather the shares.

    The rig's own size is left out: it is a default, and the set's size stands beside it.
    """
    rows: list[tuple[str, str]] = []
    for name, value in config.items():
        if name in ("recipes", "daylight", "weather"):
            rows.append((name, ", ".join(f"{k} {v['share']:g}" for k, v in value.items())))
        elif name in ("rig", "samples"):
            rows += [(f"{name}.{k}", _plain(v)) for k, v in value.items() if k != "size"]
        else:
            rows.append((name, _plain(value)))
    return _titled("Configuration (in full in manifest.json)", _aligned(rows))


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _faults(manifest: Manifest) -> str:
    lines = [
        f"frame {r['frame_index']}, attempt {r['attempt']}, {what}: {'; '.join(r['reasons'])}"
        for what, records in (("failed", manifest.failures), ("drawn again", manifest.redrawn))
        for r in records
    ]
    return _titled("Failed and redrawn frames", lines or ["none"])


def _titled(title: str, lines: Iterable[str]) -> str:
    return "\n".join([title, *(f"  {line}" for text in lines for line in text.splitlines())])


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
