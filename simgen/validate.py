"""Checks a finished set from its files alone: manifest, shards, every frame, and the set.

Reads with h5py and judges with ``checks``; nothing that wrote the files is used to read them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from simgen import schema
from simgen.checks import check_frame, is_night, max_angle_deg
from simgen.errors import RESTORE, UserError
from simgen.findings import Finding, Report, judge, judge_estimate, not_applicable
from simgen.photometric import pool

with contextlib.suppress(ImportError):
    import hdf5plugin  # noqa: F401  (registers the filters of sets compressed with zstd)

__all__ = ["Finding", "Report", "check_frame", "validate_folder"]

SIGNIFICANCE = 1e-3  # of the test for uniform angles, over the three axes together
NUM_ANGLES_MIN = 30  # per axis, for that test
NUM_POOLED_MIN = 10  # pairs whose photometry is worth pooling
TEST_EVERY = 10  # a scene is a test scene if this divides its index
ATTRIBUTES = (
    "schema_version", "units", "conventions", "dataset_seed", "config", "package_version",
)  # fmt: skip


@dataclass(frozen=True)
class _Entry:
    """One shard as the manifest lists it."""

    name: str
    split: str
    frames: list[int]
    sha256: str


@dataclass(frozen=True)
class _Manifest:
    """What manifest.json says of the set."""

    entries: list[_Entry]
    failed_frames: set[int]
    """that failed for good"""
    num_asked: dict[str, int]
    """frames asked for on each side, counted over both: of 30, the test side has those of every
    tenth scene"""
    versions: dict[str, str]
    """of this package and of those that decide pixels; older versions do not tell of those"""
    samples: dict[str, str]
    """the rule for samples per pixel; of older versions, what is known of it by day"""


@dataclass(frozen=True, eq=False)
class _Facts:
    """What the checks over the set need of one frame."""

    frame: int
    scene: int
    split: str
    angles: NDArray[np.float64]
    """(C, 3), as fractions of the rig's maximum"""
    night: bool = False
    """whether lamps burn"""
    samples: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    """both empty if the spec does not say"""


@dataclass
class _Set:
    """What has been read so far."""

    findings: list[Finding]
    facts: list[_Facts]
    frames_per_scene: int = 1


def validate_folder(
    path: Path | str, *, progress: Callable[[int, int], None] | None = None
) -> Report:
    """Checks the set in a folder, every pixel of it.

    Args:
      path: folder with ``manifest.json``.
      progress: called with (frames done, frames in all) after each frame.

    Raises:
      UserError: there is no manifest, it is not one of ours, or a filter to read it is missing.
    """
    path = Path(path)
    manifest = _read_manifest(path / "manifest.json")
    num_frames = sum(len(e.frames) for e in manifest.entries)
    read = _Set([], [])
    for entry in manifest.entries:
        for _ in _check_shard(path / entry.name, entry, read):
            if progress is not None:
                progress(len(read.facts), num_frames)
    read.findings += [
        _check_frames(manifest, read),
        _check_splits(read.facts),
        _check_settings(manifest, read.facts),
        *_check_angles(read.facts),
        *_pool_photometry(read.findings),
    ]
    return Report(tuple(read.findings))


def _read_manifest(path: Path) -> _Manifest:
    if not path.is_file():
        raise UserError(
            f"{path}: no manifest here, so this is no finished set. Name the folder that "
            '"simgen render --out" wrote to, and let it finish at least one shard.'
        )
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        version = manifest["schema_version"]
        entries = [
            _Entry(s["name"], s["split"], list(map(int, s["frames"])), s["sha256"])
            for s in manifest["shards"]
        ]
        failed_frames = {int(failure["frame_index"]) for failure in manifest["failures"]}
        config = manifest["config"]
        num_pairs = len(config["rig"]["pairs"])
        of_both = dict.fromkeys(("train", "test"), int(manifest["num_pairs_asked"]))
        asked = manifest.get("pairs_asked") or of_both
        num_asked = {side: -(-int(num) // num_pairs) for side, num in asked.items()}
        versions = _texts(manifest.get("versions", {}))
        if "package_version" in manifest:
            versions["simgen"] = str(manifest["package_version"])
        known = {"day_spp": config["spp"]} if "spp" in config else {}
        samples = _texts(config.get("samples", known))
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read ({error.strerror}). Mend its permissions."
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: not a manifest of simgen ({type(error).__name__}: {error}). Restore the "
            "file, or render the set again into an empty folder."
        ) from error
    if version != schema.SCHEMA_VERSION:
        raise UserError(f"{path}: {_other_schema(version)}")
    if not entries:
        raise UserError(f'{path}: lists no shard yet. Let "simgen render" finish at least one.')
    return _Manifest(entries, failed_frames, num_asked, versions, samples)


def _texts(values: Mapping[str, Any]) -> dict[str, str]:
    return {str(k): str(v) for k, v in values.items()}


def _other_schema(version: Any) -> str:
    return (
        f"schema version {version}, expected {schema.SCHEMA_VERSION}: written by another version "
        "of simgen. Validate it with that one, or render the set again."
    )


# --- one shard ----------------------------------------------------------------------------------


def _check_shard(path: Path, entry: _Entry, read: _Set) -> Iterator[None]:
    """Adds what a shard holds to ``read``, and yields after each of its frames."""
    if not path.is_file():
        read.findings.append(judge("readable", 1, entry.name, "the file is missing"))
        return
    try:
        read.findings.append(_check_hash(path, entry))
        with h5py.File(path) as shard:
            yield from _check_contents(shard, entry, read)
    except OSError as error:
        why = f"truncated, damaged or no HDF5 file: {error}; {RESTORE}"
        read.findings.append(judge("readable", 1, entry.name, why))
    else:
        read.findings.append(judge("readable", 0, entry.name))


def _check_hash(path: Path, entry: _Entry) -> Finding:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    detail = f"is {digest[:12]}…, the manifest says {entry.sha256[:12]}…; {RESTORE}"
    return judge("sha256", digest != entry.sha256, entry.name, detail)


def _check_contents(shard: h5py.File, entry: _Entry, read: _Set) -> Iterator[None]:
    faults = list(_attribute_faults(shard))
    read.findings.append(judge("attributes", len(faults), entry.name, "; ".join(faults)))
    faults = [*faults, *_dataset_faults(shard, len(entry.frames))]
    if faults:
        read.findings.append(judge("schema", len(faults), entry.name, "; ".join(faults)))
        return
    _require_filters(shard)
    read.frames_per_scene = int(json.loads(shard.attrs["config"]).get("frames_per_scene", 1))
    for i in range(len(entry.frames)):
        arrays = _frame(shard, i)
        findings = check_frame(arrays, shard["pairs"][:], thorough=True)
        read.findings += [replace(f, where=f"{entry.name}, {f.where}") for f in findings]
        if findings[0].passed:  # the schema: only then do the facts mean anything
            read.facts.append(_facts(arrays, entry.split))
        yield


def _attribute_faults(shard: h5py.File) -> Iterator[str]:
    missing = [name for name in ATTRIBUTES if name not in shard.attrs]
    if missing:
        yield f"attributes missing: {', '.join(missing)}; not written by simgen?"
        return
    if shard.attrs["schema_version"] != schema.SCHEMA_VERSION:
        yield _other_schema(shard.attrs["schema_version"])
    try:
        config = json.loads(shard.attrs["config"])
    except ValueError as error:
        config = error
    if not isinstance(config, dict):
        yield f"attribute 'config' is no JSON object: {config}"


def _dataset_faults(shard: h5py.File, num_frames: int) -> Iterator[str]:
    """Datasets that are missing or do not hold one entry per frame."""
    for name in schema.FIELDS:
        shape = getattr(shard.get(name), "shape", None)
        if shape is None and name != "flow":
            yield f"'{name}' is missing"
        elif shape is not None and shape[:1] != (num_frames,):
            yield f"'{name}' has shape {shape}, the manifest lists {num_frames} frames"
    if getattr(shard.get("pairs"), "ndim", 0) != 2:
        yield "'pairs' is missing, or not (P, 2)"


def _require_filters(shard: h5py.File) -> None:
    for name in schema.FIELDS:
        if name not in shard:
            continue
        plist = shard[name].id.get_create_plist()
        for k in range(plist.get_nfilters()):
            code, _, _, label = plist.get_filter(k)
            if not h5py.h5z.filter_avail(code):
                raise UserError(
                    f"{shard.filename}: '{name}' is compressed with {label.decode()!r} (filter "
                    f"{code}), which this h5py cannot read. Run: pip install hdf5plugin"
                )


def _frame(shard: h5py.File, i: int) -> dict[str, Any]:
    arrays = {name: shard[name][i] for name in schema.FIELDS if name in shard}
    with contextlib.suppress(ValueError):  # no JSON stays text, which the schema check reports
        arrays["spec"] = json.loads(arrays["spec"])
    return arrays


def _facts(arrays: Mapping[str, Any], split: str) -> _Facts:
    spec = arrays["spec"]
    angles = arrays["perturbation_deg"] / (max_angle_deg(spec) or np.nan)
    samples, versions = (_texts(spec.get(key, {})) for key in ("samples", "versions"))
    return _Facts(int(arrays["frame_index"]), int(arrays["scene_index"]), split, angles,
                  is_night(spec), samples, versions)  # fmt: skip


# --- the set ------------------------------------------------------------------------------------


def _check_frames(manifest: _Manifest, read: _Set) -> Finding:
    """Every index once, none left out but recorded failures and the side that is not there.

    Frames that were asked for and are not there yet are missing, too.
    """
    entries, num_asked = manifest.entries, manifest.num_asked
    listed = [i for e in entries for i in e.frames]
    found = [f.frame for f in read.facts]
    expected = {
        i
        for side in {e.split for e in entries}
        for i in range(max([num_asked.get(side, 0), *(1 + i for e in entries for i in e.frames
                                                      if e.split == side)]))
        if _split_of(i // read.frames_per_scene) == side
    }  # fmt: skip
    faults = {
        "missing": expected - set(listed) - manifest.failed_frames,
        "twice": {i for i, n in Counter(listed).items() if n > 1},
        "listed but not found": set(listed) - set(found),
        "found but not listed": set(found) - set(listed),
    }
    detail = "; ".join(f"{what}: {_listed(frames)}" for what, frames in faults.items() if frames)
    return judge("frames", [len(frames) for frames in faults.values()], "set", detail)


def _listed(frames: set[int], most: int = 12) -> str:
    """``[1, 2, 3]``, or the first of many and their number."""
    if len(frames) <= most:
        return str(sorted(frames))
    return f"{len(frames)} frames, first {sorted(frames)[:most]}"


def _split_of(scene: int) -> str:
    return "test" if scene % TEST_EVERY == 0 else "train"


def _check_splits(facts: Sequence[_Facts]) -> Finding:
    wrong = sorted({f.frame for f in facts if f.split != _split_of(f.scene)})
    sides = {f.scene: set[str]() for f in facts}
    for f in facts:
        sides[f.scene].add(f.split)
    both = sorted(scene for scene, splits in sides.items() if len(splits) > 1)
    detail = f"frames on the wrong side: {wrong}; scenes on both: {both}" if wrong else ""
    return judge("splits", len(wrong) + len(both), "set", detail)


def _check_settings(manifest: _Manifest, facts: Sequence[_Facts]) -> Finding:
    """One rule for samples and one set of versions: the manifest's, or that of most frames.

    Sets of older versions tell of them in the specs of their frames only.
    """
    wrong: dict[str, set[int]] = {}
    for night, spp in ((False, "day_spp"), (True, "night_spp")):
        other = "day_spp" if night else "night_spp"
        known = {"spp" if k == spp else k: v for k, v in manifest.samples.items() if k != other}
        found = {f.frame: f.samples for f in facts if f.night == night}
        _unlike("samples", found, known, wrong)
    _unlike("versions", {f.frame: f.versions for f in facts}, manifest.versions, wrong)
    detail = "; ".join(f"{what}: {_listed(frames)}" for what, frames in wrong.items())
    return judge("settings", len(set().union(*wrong.values())), "set", detail)


def _unlike(
    name: str,
    found: Mapping[int, Mapping[str, str]],
    known: Mapping[str, str],
    wrong: dict[str, set[int]],
) -> None:
    """Adds the frames whose values differ from the known ones, or else from those of most."""
    for key in sorted({*known, *(k for values in found.values() for k in values)}):
        counts = Counter(values.get(key) for values in found.values())
        right = known[key] if key in known else counts.most_common(1)[0][0]
        for frame, values in found.items():
            if (value := values.get(key)) != right:
                said = f"{name}.{key} {value or 'missing'}, expected {right or 'none'}"
                wrong.setdefault(said, set()).add(frame)


def _check_angles(facts: Sequence[_Facts]) -> Iterator[Finding]:
    """Uniformity per axis: Kolmogorov-Smirnov, with Bonferroni's correction over the axes."""
    angles = np.concatenate([np.empty((0, 3)), *(f.angles for f in facts)])
    angles = angles[np.isfinite(angles).all(axis=1)]
    num = len(angles)
    for axis, values in zip("xyz", angles.T, strict=True):
        name, where = "perturbation_uniform", f"set, axis {axis}"
        if num < NUM_ANGLES_MIN:
            yield not_applicable(name, where, f"{num} angles, {NUM_ANGLES_MIN} needed")
            continue
        distance = stats.kstest(values, stats.uniform(-1, 2).cdf).statistic
        limit = float(stats.kstwo.isf(SIGNIFICANCE / 3, num))
        yield judge(name, distance, where, f"{num} angles", limit=limit)


def _pool_photometry(findings: Sequence[Finding]) -> Iterator[Finding]:
    """What all pairs of the set say together: a wrong convention is the same in each of them."""
    for name in ("photometric_shift", "photometric_offset"):
        found = [(f.estimate, f.limit) for f in findings if f.check == name]
        measured = [(e, limit) for e, limit in found if e and np.isfinite(e.std_error).all()]
        estimates = [e for e, _ in measured]
        if len(estimates) < NUM_POOLED_MIN:
            why = f"{len(estimates)} pairs with texture, {NUM_POOLED_MIN} needed"
            yield not_applicable(name, "set", why)
        else:
            limit = max(limit for _, limit in measured)
            where = f"set, {len(estimates)} pairs"
            yield judge_estimate(name, pool(estimates), where, limit)
