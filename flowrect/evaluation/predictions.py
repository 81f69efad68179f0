"""Predictions of one method in one HDF5 file: written once, scored as often as wanted.

One row a pair. A row whose ``failure`` is not empty has no pose: the method raised, found no
solution, or took too long, and the text says which.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from flowrect.evaluation.stamp import of_method
from flowrect.methods import PoseEstimate
from simgen.errors import UserError
from simgen.geometry import Array
from simgen.shards import write_atomically

FORMAT = "flowrect-predictions-2"


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a method said of one pair."""

    index: int
    """of the pair among those delivered"""
    name: str
    estimate: PoseEstimate | None
    failure: str = ""
    """why there is no estimate"""
    num_matches: int | None = None
    """of a failure, where it is known; else the estimate says"""
    seconds: dict[str, float] = field(default_factory=dict)
    """of a failure, as num_matches"""
    made_on: str = ""
    """machine and threads"""

    @property
    def known(self) -> PoseEstimate:
        """The estimate; of a failure one without a pose."""
        nothing = np.full((3, 3), np.nan)
        return self.estimate or PoseEstimate(
            nothing, nothing[0], num_matches=self.num_matches, seconds=self.seconds
        )


@dataclass(frozen=True)
class Origin:
    """What predictions are of."""

    method: str
    translation: str
    data: str
    """fingerprint of the delivered pairs"""
    stamp: str
    """see evaluation/stamp.py"""


def file_name(name: str) -> str:
    """What files of a NAME or NAME=PATH are named by: a path has any length, and slashes."""
    head, _, path = name.partition("=")
    return f"{head}-{hashlib.sha256(path.encode()).hexdigest()[:8]}" if path else name


def write(path: Path, rows: Iterable[Prediction], origin: Origin) -> None:
    """Writes all rows atomically."""
    rows = sorted(rows, key=lambda r: r.index)
    estimates = [r.known for r in rows]
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        file.attrs.update(format=FORMAT, **asdict(origin))
        file["index"] = np.array([r.index for r in rows], dtype=np.int64)
        file["R"] = np.array([e.R for e in estimates]).reshape(-1, 3, 3)
        file["t"] = np.array([e.t for e in estimates]).reshape(-1, 3)
        file["covariance"] = np.array([_or_nan(e.covariance) for e in estimates]).reshape(-1, 5, 5)
        for name in ("num_matches", "num_inliers"):
            counts = [getattr(e, name) for e in estimates]
            file[name] = np.array([-1 if n is None else n for n in counts], dtype=np.int64)
        texts = {
            "name": [r.name for r in rows],
            "failure": [r.failure for r in rows],
            "made_on": [r.made_on for r in rows],
            "seconds": [json.dumps(e.seconds) for e in estimates],
            "notes": [json.dumps(e.notes) for e in estimates],
        }
        for name, values in texts.items():
            file.create_dataset(name, data=values, dtype=h5py.string_dtype("utf-8"),
                                shape=(len(values),))  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, memory.getvalue())


def _or_nan(covariance: Array | None) -> Array:
    return np.full((5, 5), np.nan) if covariance is None else covariance


def read(path: Path, origin: Origin) -> list[Prediction]:
    """The rows of a file; UserError if they are of another origin, or it is no such file."""
    found = origin_of(path)
    if found != origin:
        a, b = asdict(found), asdict(origin)
        different = ", ".join(_WORDS[key] for key in a if a[key] != b[key])
        raise UserError(
            f"{path}: predictions of {different} than asked for now. Choose another --out, or "
            "delete the file: its predictions are made anew."
        )
    with h5py.File(path, "r") as file:
        arrays = {k: file[k][:] for k in ("index", "R", "t", "covariance", "num_matches",
                                          "num_inliers")}  # fmt: skip
        texts = {k: file[k].asstr()[:] for k in (*_TEXTS, "seconds", "notes")}
    return [_row(i, arrays, texts) for i in range(len(arrays["index"]))]


_WORDS = {"method": "another method", "translation": "another t", "data": "other pairs or sizes",
          "stamp": "other settings, weights (FLOWRECT_MODELS, too) or another version"}  # fmt: skip


def origin_of(path: Path) -> Origin:
    """What a file says that it is of; UserError if it is no such file."""
    try:
        with h5py.File(path, "r") as file:
            attributes = dict(file.attrs)
        if attributes.pop("format") != FORMAT:
            raise ValueError("another format")
        return Origin(**attributes)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise UserError(
            f"{path}: no predictions of flowrect.evaluate ({error}). Delete it: they are made anew."
        ) from error


_TEXTS = "name", "failure", "made_on"


def _row(i: int, arrays: dict[str, Array], texts: dict[str, list[str]]) -> Prediction:
    name, failure, made_on = (str(texts[k][i]) for k in _TEXTS)
    seconds, covariance = json.loads(texts["seconds"][i]), arrays["covariance"][i]
    num_matches, num_inliers = (
        n if (n := int(arrays[k][i])) >= 0 else None for k in ("num_matches", "num_inliers")
    )
    row = partial(Prediction, int(arrays["index"][i]), name, made_on=made_on)
    if failure:
        return row(None, failure, num_matches=num_matches, seconds=seconds)
    estimate = PoseEstimate(
        arrays["R"][i],
        arrays["t"][i],
        None if np.isnan(covariance).any() else covariance,
        num_matches,
        num_inliers,
        seconds=seconds,
        notes=tuple(json.loads(texts["notes"][i])),
    )
    return row(estimate)


def _present_stamp(path: Path, origin: Origin) -> str:
    try:
        return of_method(origin.method)
    except UserError as error:
        raise UserError(
            f"{path}: predictions of {origin.method}, whose weights are gone ({error}) Put them "
            "back, or delete this file: its row leaves the tables."
        ) from error


def predictions_of(folder: Path, data: str) -> dict[tuple[str, str], dict[int, Prediction]]:
    """All predictions in a results folder that are of these pairs: by method and t, by pair.

    UserError if some are stale: tables would mix versions.
    """
    files = sorted((folder / "predictions").glob("*.h5"))
    origins = {path: origin_of(path) for path in files}
    return {
        (origin.method, origin.translation): {
            r.index: r for r in read(path, replace(origin, stamp=_present_stamp(path, origin)))
        }
        for path, origin in origins.items()
        if origin.data == data
    }
