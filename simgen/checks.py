"""What one frame of a shard must satisfy, judged from its arrays alone.

Values, poses and labels here; what needs two cameras is measured in ``twoview``, what needs
their images in ``photometric``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from simgen import photometric, schema, twoview
from simgen.findings import CHECKS, Finding, judge, judge_estimate, not_applicable
from simgen.samples import LAMPS_BELOW_DEG

Array = NDArray[np.float64]
Pairs = NDArray[np.uint8]
Arrays = Mapping[str, Any]

NUM_TEXTURED_MIN = 500  # fewer textured pixels say nothing about a shift
NEED_FLOW = ("flow", "vertical_flow")
NEED_TEXTURE = ("photometric_shift", "photometric_offset", "photometric_match")
SPEC_OBJECTS = ("rig", "daylight", "samples", "versions")  # parts of a spec that are looked into
FULL_ACCURACY_WIDTH = 320  # narrower images get proportionally wider photometric limits


def check_frame(arrays: Arrays, pairs: Pairs, *, thorough: bool) -> list[Finding]:
    """Checks one frame.

    Args:
      arrays: the fields of ``schema.FIELDS``, one frame of each; ``spec`` is a dict, ``flow`` may
        be left out.
      pairs: camera indices (P, 2) as (left, right).
      thorough: every pixel, and the images too. Otherwise a fixed grid of pixels where geometry
        is concerned, and every pixel where comparing is enough.

    Returns:
      Findings. Where an array is malformed or not finite, or a pose no rigid motion, the checks
      that build on it are left out: the frame has failed already.
    """
    findings = [_check_schema(arrays, pairs)]
    if findings[0].passed:
        findings += _check_values(arrays)
    if not all(f.passed for f in findings):
        return findings
    findings += [*_check_poses(arrays), _check_sky(arrays)]
    if not all(f.passed for f in findings if f.check == "rotation"):
        return findings

    def of_pair(p: int) -> list[Finding]:
        return _check_pair(arrays, p, *pairs[p].tolist(), thorough=thorough)

    with ThreadPoolExecutor(max_workers=2) as pool:
        return findings + [f for found in pool.map(of_pair, range(len(pairs))) for f in found]


def _check_pair(arrays: Arrays, p: int, left: int, right: int, *, thorough: bool) -> list[Finding]:
    """Both directions of one pair."""
    flow = arrays["flow"][p] if "flow" in arrays else None
    forward = _direction(arrays, left, right, arrays["flow_status"][p], flow)
    backward = _direction(arrays, right, left, arrays["flow_status_reverse"][p], None)
    findings = [
        finding
        for d in (forward, backward)
        for finding in _check_status(d) + _check_geometry(d, thorough=thorough)
    ]
    if flow is None:
        findings += [not_applicable(n, forward.where, "no flow stored") for n in NEED_FLOW]
    if thorough:
        findings += _check_images(forward, arrays["spec"])
    return findings


def _place(arrays: Arrays) -> str:
    return f"frame {int(arrays['frame_index'])}"


def _direction(
    arrays: Arrays, a: int, b: int, status: NDArray[np.uint8], flow: NDArray[np.float32] | None
) -> twoview.Direction:
    where = f"{_place(arrays)}, camera {a} to {b}"
    return twoview.Direction(_camera(arrays, a), _camera(arrays, b), status, flow, where)


def _camera(arrays: Arrays, c: int) -> twoview.Camera:
    pixels = {name: arrays[name][c] for name in ("image", "depth", "semantic", "instance")}
    return twoview.Camera(arrays["K"][c], arrays["T_world_cam"][c], **pixels)


# --- one frame ----------------------------------------------------------------------------------


def _check_schema(arrays: Arrays, pairs: Pairs) -> Finding:
    faults = list(_schema_faults(arrays, pairs))
    where = _place(arrays) if np.shape(arrays.get("frame_index", [])) == () else ""
    return judge("schema", len(faults), where, "; ".join(faults))


def _schema_faults(arrays: Arrays, pairs: Pairs) -> Iterator[str]:
    image = np.shape(arrays.get("image", ()))
    if len(image) != 4:
        yield f"'image' has shape {image}, expected (C, H, W, 3)"
        return
    sizes = dict(zip("CHW", image, strict=False)) | {"P": len(pairs)}
    for field in schema.FIELDS.values():
        if field.name in arrays:
            yield from _field_faults(field, arrays[field.name], sizes)
        elif field.name != "flow":
            yield f"'{field.name}' is missing"
    if pairs.shape != (len(pairs), 2) or pairs.max(initial=0) >= sizes["C"]:
        yield f"'pairs' is {pairs.tolist()}, expected (left, right) below {sizes['C']}"


def _field_faults(field: schema.Field, value: Any, sizes: dict[str, int]) -> Iterator[str]:
    if field.dtype == "json":
        if not isinstance(value, Mapping):
            yield f"'{field.name}' is no JSON object"
            return
        for part in SPEC_OBJECTS:
            if not isinstance(value.get(part, {}), Mapping):
                yield f"'{field.name}.{part}' is no JSON object"
        return
    array, shape = np.asarray(value), field.resolved(sizes)
    if array.shape != shape or array.dtype != field.dtype:
        yield f"'{field.name}' is {array.dtype} {array.shape}, expected {field.dtype} {shape}"


def _check_values(arrays: Arrays) -> list[Finding]:
    floats = [f.name for f in schema.FIELDS.values() if f.dtype.startswith("float")]
    bad = {n: _num_not_finite(arrays[n]) for n in floats if n in arrays}
    bad["negative depth"] = int(np.count_nonzero(arrays["depth"] < 0))
    detail = ", ".join(f"{name}: {count}" for name, count in bad.items() if count)
    no_pinhole = [not _is_pinhole(K) for K in arrays["K"]]
    return [
        judge("finite", list(bad.values()), _place(arrays), detail),
        judge("intrinsics", no_pinhole, _place(arrays)),
    ]


def _num_not_finite(values: NDArray[Any]) -> int:
    return values.size - int(np.count_nonzero(np.isfinite(values)))


def _is_pinhole(K: Array) -> bool:
    return bool(K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and (K[2] == (0, 0, 1)).all())


def _check_poses(arrays: Arrays) -> list[Finding]:
    true, nominal = arrays["T_world_cam"], arrays["T_world_cam_nominal"]
    angles_deg, where = arrays["perturbation_deg"], _place(arrays)
    expected = nominal.copy()
    expected[:, :3, :3] @= Rotation.from_rotvec(angles_deg, degrees=True).as_matrix()
    beyond = np.abs(angles_deg) - max_angle_deg(arrays["spec"])
    return [
        judge("rotation", _rigidity_error(np.concatenate([true, nominal])), where),
        judge("pose", np.abs(true - expected), where),
        judge("perturbation_range", np.maximum(beyond, 0), where),
    ]


def _rigidity_error(T: Array) -> Array:
    R = T[:, :3, :3]
    gram = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3))
    last_row = np.abs(T[:, 3] - (0, 0, 0, 1))
    return np.concatenate([gram.ravel(), last_row.ravel(), np.abs(np.linalg.det(R) - 1)])


def max_angle_deg(spec: Mapping[str, Any]) -> float:
    """The rig's largest angle per axis; 1° where the spec does not say."""
    return float(spec.get("rig", {}).get("perturbation_deg", 1.0))


def is_night(spec: Mapping[str, Any]) -> bool:
    """Whether lamps burn; by day where the spec does not say."""
    return bool(spec.get("daylight", {}).get("sun_elevation_deg", 90.0) < LAMPS_BELOW_DEG)


def _check_sky(arrays: Arrays) -> Finding:
    labelled = arrays["semantic"] == schema.LABELS["sky"]
    return judge("sky", np.count_nonzero(labelled != (arrays["depth"] == 0)), _place(arrays),
                 "depth 0 against label")  # fmt: skip


# --- one direction ------------------------------------------------------------------------------


def _legal_status() -> NDArray[np.bool_]:
    """Per code 0…255 whether it says exactly one of visible, occluded and out of frame."""
    codes = np.arange(256)
    one = np.isin(codes & 7, (schema.VISIBLE, schema.OCCLUDED, schema.OUT_OF_FRAME))
    return one & (codes < 2 * schema.GLASS)


def _check_status(d: twoview.Direction) -> list[Finding]:
    illegal = ~_legal_status()[d.status]
    at_infinity = (d.status & schema.AT_INFINITY) != 0
    contradicts = at_infinity != (d.source.depth == 0)
    return [
        judge("status_bits", np.count_nonzero(illegal), d.where),
        judge("sky", np.count_nonzero(contradicts), d.where, "depth 0 against status"),
    ]


def _check_geometry(d: twoview.Direction, *, thorough: bool) -> list[Finding]:
    values = twoview.measure(d, thorough=thorough)
    wrong = values.pop("out_of_frame")
    findings = [judge("out_of_frame", wrong.max(initial=0), d.where, f"{wrong.size} pixels")]
    return findings + [judge(n, v, d.where, _spread(v)) for n, v in values.items()]


def _spread(values: NDArray[Any]) -> str:
    if values.dtype == bool or not values.size:
        return f"of {values.size} pixels"
    return f"median {np.median(values):.2g}, max {values.max():.2g}, of {values.size} pixels"


def _check_images(d: twoview.Direction, spec: Mapping[str, Any]) -> list[Finding]:
    """Whether the flow explains the right image by the left one, in daylight and on texture."""
    if is_night(spec):
        why = "the sun is below the horizon"
        return [not_applicable(name, d.where, why) for name in NEED_TEXTURE]
    found = photometric.align(d.source.image, d.target.image, *twoview.clean_matches(d))
    if found.num < NUM_TEXTURED_MIN:
        why = f"{found.num} textured pixels, {NUM_TEXTURED_MIN} needed"
        return [not_applicable(name, d.where, why) for name in NEED_TEXTURE]
    scale = max(1.0, FULL_ACCURACY_WIDTH / d.status.shape[1])
    limits = [scale * CHECKS[name].limit for name in NEED_TEXTURE]
    offset = not_applicable("photometric_offset", d.where, f"pooled over the set: {found.offset}")
    return [
        judge_estimate("photometric_shift", found.shift, d.where, limits[0]),
        replace(offset, estimate=found.offset, limit=limits[1]),
        judge("photometric_match", 1 - found.correlation, d.where, f"of {found.num} pixels"),
    ]
