"""What one frame of a shard must satisfy, measured from its arrays alone.

This is the second, independent piece of arithmetic: it shares no formula with ``geometry`` and
``groundtruth``, so that an error in one of them shows. Where those work with points and depths,
everything here is written in *inverse depth* w = 1/z, which has no special case for the sky
(w = 0) and is an affine function of the pixel on every plane.

Notation: a is the source camera of a direction, b its target. A pixel x of a with ray
r = K_a⁻¹ (u, v, 1) and inverse depth w lies, up to scale, at p = R_b_a r + w t_b_a in b: it ends
on the pixel K_b p / p_z, with inverse depth w / p_z. A *patch* is the 3×3 neighbourhood of the
target pixel nearest to that end point.

Every finding is a number with an upper limit; fractions count the pixels that disagree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from simgen import photometric, schema

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Arrays = Mapping[str, Any]

BORDER_PX = 1e-3  # end points this close to the border may be called in or out of frame
FLOAT32_PX = 4096.0  # beyond this, float32 cannot hold flow to 1e-3 px: errors count relative
SAME_SURFACE = 0.02  # inverse depths closer than this fraction belong to one surface
NEARER = 1.001  # ratio of inverse depths from which something lies in front
AFFINE = 1e-3  # relative second difference of inverse depth up to which a patch is one plane
SAMPLE_PIXELS = 60_000  # per direction, when a check is not thorough
BLOCK_PIXELS = 200_000  # evaluated at a time: bounds the memory
PHOTOMETRIC_PIXELS = 400_000  # per direction, before those without texture are left out
TEXTURED_MIN = 500  # fewer textured pixels say nothing about a shift
FULL_ACCURACY_WIDTH = 320  # narrower images get a proportionally wider photometric limit


def _p99(values: Array) -> float:
    return float(np.percentile(values, 99))


@dataclass(frozen=True)
class Check:
    """How the values of one check become one number, and what that number may be."""

    meaning: str
    limit: float
    unit: str = ""
    summary: Callable[[Any], Any] = np.max
    num_min: int = 1
    """with fewer values than this the check does not apply"""


CHECKS: dict[str, Check] = {
    "schema": Check("arrays of wrong name, shape or type", 0, "arrays", np.sum),
    "finite": Check("NaN, infinite or negative values", 0, "values", np.sum),
    "intrinsics": Check("cameras whose K is no pinhole matrix", 0, "cameras", np.sum),
    "rotation": Check("|RᵀR − I| and |det R − 1| of the poses", 1e-9),
    "pose": Check("true pose against nominal ∘ drawn rotation", 1e-9),
    "perturbation_range": Check("largest drawn angle over the rig's maximum", 1 + 1e-12),
    "status_bits": Check("pixels without exactly one visibility bit", 0, "px", np.sum),
    "sky": Check("pixels whose depth, label and status disagree on the sky", 0, "px", np.sum),
    "flow": Check("stored flow against depth, K and poses", 1e-3, "px"),
    "out_of_frame": Check("how far inside or outside a wrong out-of-frame bit is", BORDER_PX, "px"),
    "vertical_flow": Check("vertical flow left after rectification by the poses", 1e-3, "px"),
    "cycle": Check("forward-backward error away from depth edges, 99th percentile", 0.05, "px",
                   _p99, 100),
    "visible_depth": Check("visible pixels with no such depth at the end point", 0.03, "", np.mean,
                           100),
    "occluded_depth": Check("occluded pixels with nothing in front", 0.10, "", np.mean, 100),
    "instance": Check("visible pixels whose instance is not at the end point", 0.03, "", np.mean,
                      100),
    "semantic": Check("visible pixels whose label is not at the end point", 0.03, "", np.mean, 100),
    "photometric_shift": Check("global shift between the images after warping by the flow", 0.05,
                               "px"),
    "photometric_match": Check("1 − correlation of the image gradients after warping", 0.5),
}  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """The outcome of one check in one place."""

    check: str
    value: float
    """the measured number, NaN where the check does not apply"""
    limit: float
    where: str
    detail: str = ""

    @property
    def applies(self) -> bool:
        return not np.isnan(self.value)

    @property
    def passed(self) -> bool:
        return not self.applies or self.value <= self.limit


def judge(name: str, values: Any, where: str, detail: str = "") -> Finding:
    """Summarises ``values`` the way the check asks for; what cannot be measured fails."""
    check, values = CHECKS[name], np.atleast_1d(values)
    if values.size < check.num_min:
        return not_applicable(name, where, f"only {values.size} pixels to measure")
    value = float(check.summary(values))
    return Finding(name, np.inf if np.isnan(value) else value, check.limit, where, detail)


def not_applicable(name: str, where: str, why: str) -> Finding:
    return Finding(name, np.nan, CHECKS[name].limit, where, f"not applicable: {why}")


def check_frame(arrays: Arrays, pairs: NDArray[np.uint8], *, thorough: bool) -> list[Finding]:
    """Checks one frame.

    Args:
      arrays: the fields of ``schema.FIELDS``, one frame of each; ``spec`` is a dict, ``flow`` may
        be left out.
      pairs: camera indices (P, 2) as (left, right).
      thorough: every pixel, and the images too. Otherwise a fixed grid of pixels where geometry
        is concerned, every pixel where comparing is enough: under a second and a half for three
        cameras at 2560×1440.

    Returns:
      Findings in the order of ``CHECKS``. Where an array is malformed or not finite, the checks
      that build on it are left out: the frame has failed already.
    """
    findings = [_check_schema(arrays, pairs)]
    if not findings[0].passed:
        return findings
    findings += _check_values(arrays)
    if not all(f.passed for f in findings):
        return findings
    findings += _check_poses(arrays) + _check_status(arrays, pairs)
    for direction in _directions(arrays, pairs):
        findings += _check_direction(direction, thorough=thorough)
    if "flow" not in arrays:
        findings.append(not_applicable("flow", _place(arrays), "not stored"))
    if thorough:
        findings += [f for d in _directions(arrays, pairs, reverse=False) for f in _images(d)]
    return findings


def _place(arrays: Arrays) -> str:
    return f"frame {int(arrays['frame_index'])}"


# --- shapes, types, values, poses ---------------------------------------------------------------


def _check_schema(arrays: Arrays, pairs: NDArray[np.uint8]) -> Finding:
    faults = schema_faults(arrays, pairs)
    where = _place(arrays) if "frame_index" in arrays else ""
    return judge("schema", float(len(faults)), where, "; ".join(faults))


def schema_faults(arrays: Arrays, pairs: NDArray[np.uint8]) -> list[str]:
    """What differs from ``schema.FIELDS``, one sentence each."""
    image = np.shape(arrays.get("image"))
    if len(image) != 4:
        return [f"'image' has shape {image}, expected (C, H, W, 3)"]
    sizes = {"C": image[0], "H": image[1], "W": image[2], "P": len(pairs)}
    faults = [_field_fault(f, arrays.get(f.name), sizes) for f in schema.FIELDS.values()]
    if np.shape(pairs) != (len(pairs), 2) or np.max(pairs, initial=0) >= image[0]:
        faults.append(f"'pairs' is {np.asarray(pairs).tolist()}, expected indices of two cameras")
    return [fault for fault in faults if fault]


def _field_fault(field: schema.Field, value: Any, sizes: dict[str, int]) -> str:
    if value is None:
        return "" if field.name == "flow" else f"'{field.name}' is missing"
    if field.dtype == "json":
        return "" if isinstance(value, Mapping) else f"'{field.name}' is no JSON object"
    array, shape = np.asarray(value), field.resolved(sizes)
    if array.shape == shape and array.dtype == field.dtype:
        return ""
    return f"'{field.name}' is {array.dtype} {array.shape}, expected {field.dtype} {shape}"


def _check_values(arrays: Arrays) -> list[Finding]:
    floats = [f.name for f in schema.FIELDS.values() if f.dtype.startswith("float")]
    bad = {n: _num_not_finite(arrays[n]) for n in floats if n in arrays}
    bad["depth"] += int(np.count_nonzero(arrays["depth"] < 0))
    detail = ", ".join(f"{name}: {count}" for name, count in bad.items() if count)
    no_pinhole = [not _is_pinhole(K) for K in arrays["K"]]
    return [
        judge("finite", list(bad.values()), _place(arrays), detail),
        judge("intrinsics", no_pinhole, _place(arrays)),
    ]


def _num_not_finite(values: Any) -> int:
    return values.size - int(np.count_nonzero(np.isfinite(values)))


def _is_pinhole(K: Array) -> bool:
    return bool(K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and (K[2] == (0, 0, 1)).all())


def _check_poses(arrays: Arrays) -> list[Finding]:
    true, nominal = arrays["T_world_cam"], arrays["T_world_cam_nominal"]
    drawn = nominal.copy()
    turns = Rotation.from_rotvec(arrays["perturbation_deg"], degrees=True).as_matrix()
    drawn[:, :3, :3] = nominal[:, :3, :3] @ turns
    where, max_deg = _place(arrays), max_angle_deg(arrays["spec"])
    largest = np.abs(arrays["perturbation_deg"]).max()
    return [
        judge("rotation", _rotation_error(np.concatenate([true, nominal])), where),
        judge("pose", np.abs(true - drawn), where),
        judge("perturbation_range", largest / max_deg if max_deg else largest + 1, where,
              f"{largest:.6f}° of {max_deg}°"),
    ]  # fmt: skip


def _rotation_error(T: Array) -> Array:
    R, last_row = T[:, :3, :3], T[:, 3]
    gram = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max()
    return np.array(
        [gram, np.abs(np.linalg.det(R) - 1).max(), np.abs(last_row - np.eye(4)[3]).max()]
    )


def max_angle_deg(spec: Mapping[str, Any]) -> float:
    """The rig's largest angle per axis, 1° where the spec does not say."""
    return float(spec.get("rig", {}).get("perturbation_deg", 1.0))


def _check_status(arrays: Arrays, pairs: NDArray[np.uint8]) -> list[Finding]:
    codes = np.arange(256)
    one_of_three = np.isin(codes & 7, (schema.VISIBLE, schema.OCCLUDED, schema.OUT_OF_FRAME))
    illegal = ~one_of_three | (codes >= 2 * schema.GLASS)
    sky = arrays["depth"] == 0
    findings = [
        judge("sky", np.count_nonzero(sky != (arrays["semantic"] == schema.LABELS["sky"])),
              _place(arrays), "depth 0 against label"),
    ]  # fmt: skip
    for d in _directions(arrays, pairs):
        at_infinity = (d.status & schema.AT_INFINITY) != 0
        findings += [
            judge("status_bits", np.count_nonzero(illegal[d.status]), d.where),
            judge("sky", np.count_nonzero(at_infinity != (d.source.depth == 0)), d.where,
                  "depth 0 against status"),
        ]  # fmt: skip
    return findings


# --- geometry, one direction at a time ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Camera:
    """What the checks need of one camera; K [px], pose to the world."""

    K: Array
    R_world: Array
    center_world: Array
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class Direction:
    """The pixels of ``source`` looked up in ``target``."""

    source: Camera
    target: Camera
    status: NDArray[np.uint8]
    flow: NDArray[np.float32] | None
    where: str
    spec: Mapping[str, Any]


def _directions(
    arrays: Arrays, pairs: NDArray[np.uint8], *, reverse: bool = True
) -> Iterator[Direction]:
    """Every pair from left to right and, with ``reverse``, from right to left."""
    for p, (left, right) in enumerate(np.asarray(pairs).tolist()):
        ways = [(left, right, "flow_status")]
        ways += [(right, left, "flow_status_reverse")] if reverse else []
        for a, b, status in ways:
            flow = arrays["flow"][p] if "flow" in arrays and status == "flow_status" else None
            where = f"{_place(arrays)}, camera {a} to {b}"
            yield Direction(_camera(arrays, a), _camera(arrays, b), arrays[status][p], flow, where,
                            arrays["spec"])  # fmt: skip


def _camera(arrays: Arrays, c: int) -> Camera:
    T = arrays["T_world_cam"][c]
    pixels = {n: arrays[n][c] for n in ("image", "depth", "semantic", "instance")}
    return Camera(K=arrays["K"][c], R_world=T[:3, :3], center_world=T[:3, 3], **pixels)


def _check_direction(d: Direction, *, thorough: bool) -> list[Finding]:
    blocks = [_measure(d, *ij) for ij in _pixel_blocks(d.status.shape, thorough=thorough)]
    values = {name: np.concatenate([b[name] for b in blocks]) for name in blocks[0]}
    wrong = values.pop("out_of_frame")
    findings = [judge("out_of_frame", np.append(wrong, 0.0), d.where, f"{wrong.size} pixels")]
    return findings + [judge(n, v, d.where, _spread(n, v)) for n, v in values.items()]


def _spread(name: str, values: Array) -> str:
    if name != "cycle" or not values.size:
        return ""
    return f"median {np.median(values):.2g}, max {values.max():.2g} px, {values.size} pixels"


def _pixel_blocks(hw: Sequence[int], *, thorough: bool) -> Iterator[tuple[Indices, Indices]]:
    num = hw[0] * hw[1] if thorough else SAMPLE_PIXELS
    stride = max(1, int(np.ceil(np.sqrt(hw[0] * hw[1] / num))))
    rows, cols = (np.arange(stride // 2, n, stride) for n in hw)
    for part in np.array_split(rows, -(-rows.size * cols.size // BLOCK_PIXELS)):
        i, j = np.meshgrid(part, cols, indexing="ij")
        yield i.ravel(), j.ravel()


def _measure(d: Direction, i: Indices, j: Indices) -> dict[str, Array]:
    """The values of every check of a direction at the source pixels (i, j)."""
    uv = np.stack([j, i], axis=-1).astype(np.float64)
    end, w_end = reproject(d.source, d.target, uv, _inverse(d.source.depth[i, j]))
    status, margin = d.status[i, j], _margin(end, w_end, d.status.shape)
    says_out = (status & schema.OUT_OF_FRAME) != 0
    wrong = (says_out != (margin < 0)) & ~(np.abs(margin) <= BORDER_PX)
    values: dict[str, Array] = {"out_of_frame": np.abs(margin[wrong])}
    inside = margin >= 0
    stored_end = end
    if d.flow is not None:
        stored_end = uv + d.flow[i, j]
        values["flow"] = _flow_error(stored_end - end, end - uv)[margin > -np.inf]
    values["vertical_flow"] = np.abs(_vertical_flow(d, uv[inside], stored_end[inside]))
    return values | _measure_patches(
        d, uv[inside], i[inside], j[inside], end[inside], w_end[inside], status[inside]
    )


def reproject(a: Camera, b: Camera, uv: Array, w: Array) -> tuple[Array, Array]:
    """End points (N, 2) [px] in ``b`` of the pixels ``uv`` of ``a``, and their inverse depths.

    An inverse depth of NaN marks points that are not in front of ``b``.
    """
    rays = np.linalg.solve(a.K, np.vstack([uv.T, np.ones(len(uv))]))
    R_b_a = b.R_world.T @ a.R_world
    t_b_a = b.R_world.T @ (a.center_world - b.center_world)
    p = R_b_a @ rays + t_b_a[:, None] * w
    p[:, p[2] <= 0] = np.nan
    return ((b.K @ p)[:2] / p[2]).T, w / p[2]


def _inverse(depth: Any) -> Array:
    z = depth.astype(np.float64)
    return np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)


def _margin(end: Array, w_end: Array, hw: Sequence[int]) -> Array:
    """Distance [px] from the border of the image, negative outside, −inf behind the camera."""
    to_edge = np.minimum(end + 0.5, np.array([hw[1], hw[0]]) - 0.5 - end).min(axis=-1)
    return np.where(np.isnan(w_end), -np.inf, to_edge)


def _flow_error(error: Array, flow: Array) -> Array:
    scale = np.maximum(1.0, np.abs(flow).max(axis=-1) / FLOAT32_PX)
    return np.abs(error).max(axis=-1) / scale


def _vertical_flow(d: Direction, uv_a: Array, uv_b: Array) -> Array:
    """v_b − v_a [px] after rectification.

    Each camera takes half of the rotation between the two; both then turn the baseline onto x.
    Source: Bouguet's algorithm, as in ``cv2.stereoRectify`` (Loop & Zhang 1999, section 3).
    """
    R_b_a = Rotation.from_matrix(d.target.R_world.T @ d.source.R_world)
    half = Rotation.from_rotvec(R_b_a.as_rotvec() / 2)
    baseline = half.inv().apply(
        d.target.R_world.T @ (d.source.center_world - d.target.center_world)
    )
    x = np.array([np.copysign(1.0, baseline[0]), 0.0, 0.0])
    axis = np.cross(baseline, x)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, baseline @ x)
    onto_x = Rotation.from_rotvec(axis * (angle / sine if sine else 0.0))
    v_a, v_b = (
        _rectified_v(K, onto_x * turn, uv)
        for K, turn, uv in ((d.source.K, half, uv_a), (d.target.K, half.inv(), uv_b))
    )
    return (v_b - v_a) * d.source.K[1, 1]


def _rectified_v(K: Array, R_rect: Rotation, uv: Array) -> Array:
    p = R_rect.as_matrix() @ np.linalg.solve(K, np.vstack([uv.T, np.ones(len(uv))]))
    return p[1] / p[2]


# --- the neighbourhood of the end point ---------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Patch:
    """Inverse depth around end points."""

    w: Array
    """(N, 3, 3)"""
    is_plane: NDArray[np.bool_]
    """(N,) whether the patch is affine: no depth edge, no crease, no image border"""
    w_end: Array
    """(N,) interpolated at the end points; exact on a plane"""


def _neighbours(end: Array, hw: Sequence[int]) -> Indices:
    """Flat indices (N, 3, 3) of the pixels around end points, repeated at the border."""
    center = np.rint(end).astype(np.intp)
    i = np.clip(center[:, 1, None] + (-1, 0, 1), 0, hw[0] - 1)
    j = np.clip(center[:, 0, None] + (-1, 0, 1), 0, hw[1] - 1)
    return i[:, :, None] * hw[1] + j[:, None, :]


def _patch(depth: NDArray[np.float32], end: Array, near: Indices) -> Patch:
    w = _inverse(depth.ravel()[near])
    middle = w[:, 1, 1]
    across = [w[:, 1, 0] + w[:, 1, 2], w[:, 0, 1] + w[:, 2, 1],
              w[:, 0, 0] + w[:, 2, 2], w[:, 0, 2] + w[:, 2, 0]]  # fmt: skip
    bend = np.max([np.abs(s - 2 * middle) for s in across], axis=0)
    du, dv = (end - np.rint(end)).T
    slope_u, slope_v = (w[:, 1, 2] - w[:, 1, 0]) / 2, (w[:, 2, 1] - w[:, 0, 1]) / 2
    return Patch(w, bend <= AFFINE * middle, middle + du * slope_u + dv * slope_v)


def _measure_patches(
    d: Direction, uv: Array, i: Indices, j: Indices, end: Array, w_end: Array, status: Any
) -> dict[str, Array]:
    """The checks that compare a pixel with what the target camera saw around its end point."""
    near = _neighbours(end, d.status.shape)
    patch = _patch(d.target.depth, end, near)
    visible, occluded = (status & schema.VISIBLE) != 0, (status & schema.OCCLUDED) != 0
    same = patch.is_plane & _close(patch.w_end, w_end)
    found = _close(patch.w, w_end[:, None, None]).any(axis=(1, 2)) | same
    in_front = patch.w.max(axis=(1, 2)) > NEARER * w_end
    instance, semantic = d.source.instance[i, j], d.source.semantic[i, j]
    keeps_instance = _contains(d.target.instance, near, instance)
    keeps_label = _contains(d.target.semantic, near, semantic)
    exact = visible & same
    back, _ = reproject(d.target, d.source, end[exact], patch.w_end[exact])
    return {
        "cycle": np.linalg.norm(back - uv[exact], axis=-1),
        "visible_depth": ~found[visible],
        "occluded_depth": ~in_front[occluded],
        "instance": ~keeps_instance[visible & (instance != 0)],
        "semantic": ~keeps_label[visible],
    }


def _close(w: Array, w_expected: Array) -> NDArray[np.bool_]:
    return np.abs(w - w_expected) <= SAME_SURFACE * w_expected


def _contains(ids: Any, near: Indices, wanted: Any) -> NDArray[np.bool_]:
    return (ids.ravel()[near] == wanted[:, None, None]).any(axis=(1, 2))


# --- the images ---------------------------------------------------------------------------------


def _images(d: Direction) -> list[Finding]:
    """Whether the flow explains the right image by the left one."""
    names = ("photometric_shift", "photometric_match")
    if d.spec.get("daylight", {}).get("name") == "night":
        return [not_applicable(name, d.where, "night") for name in names]
    shift = photometric.estimate_shift(d.source.image, d.target.image, *_clean_matches(d))
    limit = CHECKS["photometric_shift"].limit * max(1.0, FULL_ACCURACY_WIDTH / d.status.shape[1])
    if shift.num < TEXTURED_MIN or shift.std_error > limit / 3:
        why = f"{shift.num} textured pixels, standard error {shift.std_error:.2g} px"
        return [not_applicable(name, d.where, why) for name in names]
    du, dv = shift.uv
    detail = f"({du:+.4f}, {dv:+.4f}) ± {shift.std_error:.4f} px from {shift.num} pixels"
    return [
        replace(judge(names[0], np.hypot(du, dv), d.where, detail), limit=limit),
        judge(names[1], 1 - shift.correlation, d.where, detail),
    ]


def _clean_matches(d: Direction) -> tuple[Array, Array]:
    """Visible pixels with their end points, both on plane patches of one opaque surface."""
    hw = d.status.shape
    stride = int(np.ceil(np.sqrt(hw[0] * hw[1] / PHOTOMETRIC_PIXELS)))
    i, j = np.nonzero((d.status & (schema.VISIBLE | schema.GLASS)) == schema.VISIBLE)
    on_grid = (i % stride == 0) & (j % stride == 0)
    i, j = i[on_grid], j[on_grid]
    uv = np.stack([j, i], axis=-1).astype(np.float64)
    end, w_end = reproject(d.source, d.target, uv, _inverse(d.source.depth[i, j]))
    here = _patch(d.source.depth, uv, _neighbours(uv, hw))
    there = _patch(d.target.depth, end, _neighbours(end, hw))
    clean = here.is_plane & there.is_plane & _close(there.w_end, w_end)
    return uv[clean], end[clean]
