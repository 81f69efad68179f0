"""Validation on a scene in closed form: everything passes, and each corruption fails its check."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simgen import schema
from simgen.errors import UserError
from simgen.findings import CHECKS, Finding, Report, judge_estimate
from simgen.photometric import Estimate, pool
from simgen.validate import (
    _check_angles,
    _check_settings,
    _Facts,
    _Manifest,
    _pool_photometry,
    check_frame,
    validate_folder,
)

Frame = dict[str, Any]
PAIRS = np.array([[0, 1], [1, 2], [0, 2]], np.uint8)
PHOTOMETRIC = {"photometric_shift", "photometric_offset", "photometric_match"}
SET_CHECKS = {
    "readable",
    "sha256",
    "attributes",
    "frames",
    "splits",
    "settings",
    "perturbation_uniform",
    "photometric_offset",
}
R_WORLD_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a camera looking along world x


@dataclass(frozen=True)
class Quad:
    """A textured rectangle: corner, two orthogonal edges, ids."""

    corner: tuple[float, float, float]
    edges: tuple[tuple[float, float, float], tuple[float, float, float]]
    semantic: int
    instance: int

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ray parameters (N,), infinite where missed, and positions (N, 2) on the edges [m]."""
        e = np.array(self.edges)
        normal = np.cross(*e)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((np.array(self.corner) - origin) @ normal) / (rays @ normal)
            st = (origin + t[:, None] * rays - self.corner) @ e.T
            size2 = (e**2).sum(axis=1)
            inside = (t > 1e-9) & (st >= 0).all(axis=1) & (st <= size2).all(axis=1)
        return np.where(inside, t, np.inf), st / np.sqrt(size2)


SCENE = (
    Quad((-5, -30, 0), ((60, 0, 0), (0, 60, 0)), schema.LABELS["road"], 0),
    Quad((14, 16, 0), ((8, -22, 0), (0, 0, 7)), schema.LABELS["building"], 7),  # slanted wall
    Quad((7, -2.0, 0.2), ((0, 1.9, 0), (0, 0, 1.8)), schema.LABELS["car"], 300),  # nearer
)


def texture(st: np.ndarray, seed: int) -> np.ndarray:
    """A smooth albedo: sines of several wavelengths, directions and phases."""
    rng = np.random.default_rng(seed)
    value = np.full(len(st), 0.5)
    for wavelength in np.geomspace(0.25, 3.0, 8):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        value += 0.1 * np.sin(st @ [np.cos(angle), np.sin(angle)] * 2 * np.pi / wavelength + phase)
    return value


def trace(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest ray parameter (N,), index of the surface (N,), −1 for the sky, and albedo (N,)."""
    hits = [q.hit(origin, rays) for q in SCENE]
    t = np.stack([h[0] for h in hits])
    which = np.where(np.isinf(t).all(axis=0), -1, t.argmin(axis=0))
    albedo = np.full(len(rays), 0.85)
    for k, (_, st) in enumerate(hits):
        albedo[which == k] = texture(st[which == k], seed=k)
    return t.min(axis=0), which, albedo


def rays_of(K: np.ndarray, T: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """World rays whose parameter is z-depth."""
    return np.column_stack([(uv - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(uv))]) @ T[:3, :3].T


def pixels(hw: tuple[int, int], du: float = 0.0, dv: float = 0.0) -> np.ndarray:
    v, u = np.mgrid[: hw[0], : hw[1]]
    return np.column_stack([u.ravel() + du, v.ravel() + dv])


def photograph(frame: Frame, camera: int, du: float = 0.0, dv: float = 0.0) -> np.ndarray:
    """An image (H, W, 3), averaged over each pixel; (du, dv) moves the pixel centres."""
    K, T, hw = frame["K"][camera], frame["T_world_cam"][camera], frame["depth"].shape[1:]
    thirds = (-1 / 3, 0, 1 / 3)
    samples = [
        trace(T[:3, 3], rays_of(K, T, pixels(hw, du + a, dv + b)))[2]
        for a, b in itertools.product(thirds, thirds)
    ]
    grey = (np.mean(samples, axis=0) * 255).clip(0, 255).round().astype(np.uint8)
    return np.repeat(grey.reshape(*hw, 1), 3, axis=2)


def ends(frame: Frame, a: int, b: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vectors from camera b to what camera a sees, their pixels (N, 2) and z in b (N,)."""
    rays = rays_of(frame["K"][a], frame["T_world_cam"][a], pixels(frame["depth"].shape[1:]))
    depth = frame["depth"][a].reshape(-1, 1).astype(np.float64)
    T_a, T_b = frame["T_world_cam"][a], frame["T_world_cam"][b]
    to_point = np.where(depth > 0, T_a[:3, 3] + depth * rays - T_b[:3, 3], rays)
    uvw = to_point @ T_b[:3, :3] @ frame["K"][b].T
    return to_point, uvw[:, :2] / uvw[:, 2:], uvw[:, 2]


def add_flow(frame: Frame) -> Frame:
    """Flow that belongs to the frame's own depth, K and poses, right or wrong."""
    hw = frame["depth"].shape[1:]
    flows = [ends(frame, a, b)[1] - pixels(hw) for a, b in PAIRS]
    return frame | {"flow": np.stack(flows).reshape(-1, *hw, 2).astype(np.float32)}


def status_of(frame: Frame, a: int, b: int) -> np.ndarray:
    """Status (H, W) of camera a's pixels in camera b, by tracing back from b."""
    hw = frame["depth"].shape[1:]
    to_point, end, z = ends(frame, a, b)
    is_sky = frame["depth"][a].ravel() == 0
    reach = np.where(is_sky, np.inf, 1 - 1e-6)
    blocked = trace(frame["T_world_cam"][b, :3, 3], to_point)[0] < reach
    inside = ((end >= -0.5) & (end < np.array(hw[::-1]) - 0.5)).all(axis=1) & (z > 0)
    status = np.select([~inside, blocked], [schema.OUT_OF_FRAME, schema.OCCLUDED], schema.VISIBLE)
    return (status + schema.AT_INFINITY * is_sky).reshape(hw).astype(np.uint8)


def add_status(frame: Frame) -> Frame:
    return frame | {
        "flow_status": np.stack([status_of(frame, a, b) for a, b in PAIRS]),
        "flow_status_reverse": np.stack([status_of(frame, b, a) for a, b in PAIRS]),
    }


def make_frame(hw: tuple[int, int]) -> Frame:
    """Three turned cameras on a yawed rig, 0.8 m apart, 1.6 m above the road."""
    rng = np.random.default_rng(5)
    f = hw[1] / 2
    K = np.array([[f, 0, (hw[1] - 1) / 2], [0, f, (hw[0] - 1) / 2], [0, 0, 1]])
    R_yaw = Rotation.from_euler("z", 6, degrees=True).as_matrix()
    nominal = np.tile(np.eye(4), (3, 1, 1))
    nominal[:, :3, :3] = R_yaw @ R_WORLD_FORWARD
    nominal[:, :3, 3] = [R_yaw @ [0, 0.8 - 0.8 * c, 1.6] for c in range(3)]
    drawn = rng.uniform(-1, 1, (3, 3))
    true = nominal.copy()
    true[:, :3, :3] = nominal[:, :3, :3] @ Rotation.from_rotvec(drawn, degrees=True).as_matrix()
    frame: Frame = {
        "K": np.tile(K, (3, 1, 1)),
        "T_world_cam": true,
        "T_world_cam_nominal": nominal,
        "perturbation_deg": drawn,
        "frame_index": np.int64(1),
        "scene_index": np.int64(1),
        "spec": {"rig": {"perturbation_deg": 1.0}, "daylight": {"name": "noon"}},
    }
    return add_status(add_flow(add_images(add_surfaces(frame, hw))))


def add_surfaces(frame: Frame, hw: tuple[int, int]) -> Frame:
    hits = [
        trace(T[:3, 3], rays_of(K, T, pixels(hw)))
        for K, T in zip(frame["K"], frame["T_world_cam"], strict=True)
    ]
    which = np.stack([h[1] for h in hits]).reshape(-1, *hw)
    depth = np.stack([h[0] for h in hits]).reshape(-1, *hw)
    frame["depth"] = np.where(which < 0, 0, depth).astype(np.float32)
    labels = np.array([q.semantic for q in SCENE] + [schema.LABELS["sky"]], np.uint8)
    frame["semantic"] = labels[which]
    frame["instance"] = np.array([q.instance for q in SCENE] + [0], np.uint16)[which]
    return frame


def add_images(frame: Frame) -> Frame:
    return frame | {"image": np.stack([photograph(frame, c) for c in range(3)])}


def copy(frame: Frame) -> Frame:
    return {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in frame.items()}


def failed(frame: Frame, *, thorough: bool = False) -> set[str]:
    """Names of the checks that a frame fails."""
    return {f.check for f in check(frame, thorough=thorough) if not f.passed}


def check(frame: Frame, *, thorough: bool) -> list[Finding]:
    return check_frame(frame, PAIRS[: len(frame["flow_status"])], thorough=thorough)


def worst(frame: Frame) -> dict[str, float]:
    return {n: w[0] for n, w in Report(tuple(check(frame, thorough=True))).worst.items()}


@pytest.fixture(scope="module")
def clean() -> Frame:
    return make_frame((90, 160))


@pytest.fixture(scope="module")
def clean_pair() -> Frame:
    """Wide enough for the strict limit on photometry; only cameras 0 and 1 are compared."""
    frame = make_frame((120, 320))
    return frame | {n: frame[n][:1] for n in ("flow", "flow_status", "flow_status_reverse")}


@pytest.fixture
def pair(clean_pair: Frame) -> Frame:
    return copy(clean_pair)


@pytest.fixture
def frame(clean: Frame) -> Frame:
    """A copy to spoil."""
    return copy(clean)


# --- a correct frame ----------------------------------------------------------------------------


def test_a_correct_frame_passes_every_check(clean: Frame) -> None:
    findings = check(clean, thorough=True)
    assert [f for f in findings if not f.passed] == []
    assert {f.check for f in findings if f.applies} == set(CHECKS) - SET_CHECKS


def test_a_correct_frame_stays_far_below_the_limits(clean: Frame, clean_pair: Frame) -> None:
    values = worst(clean)
    assert values["flow"] < 1e-5
    assert values["cycle"] < 1e-4
    assert values["vertical_flow"] < 1e-5
    assert worst(clean_pair)["photometric_shift"] < 5e-3


def test_the_quick_check_looks_at_a_grid_and_leaves_photometry_out(clean: Frame) -> None:
    quick = check(clean, thorough=False)
    assert all(f.passed for f in quick)
    assert {f.check for f in quick} == set(CHECKS) - SET_CHECKS - PHOTOMETRIC


def test_image_noise_does_not_bias_the_shift(pair: Frame) -> None:
    noise = np.random.default_rng(0).normal(0, 4, pair["image"].shape)
    pair["image"] = (pair["image"] + noise).clip(0, 255).astype(np.uint8)
    assert worst(pair)["photometric_shift"] < 0.01


def test_exposure_of_each_camera_is_free(pair: Frame) -> None:
    gain = np.array([0.8, 0.6, 0.95]).reshape(3, 1, 1, 1)
    pair["image"] = (pair["image"] * gain + 5).astype(np.uint8)
    assert worst(pair)["photometric_shift"] < 0.01


def test_haze_does_not_pass_for_a_shift(pair: Frame) -> None:
    """Koschmieder at a visibility of 30 m, over faint texture: what shows is distance."""
    for c in (0, 1):
        hw = pair["depth"].shape[1:]
        length = np.linalg.norm(rays_of(pair["K"][c], np.eye(4), pixels(hw)), axis=1).reshape(hw)
        distance = np.where(pair["depth"][c] > 0, pair["depth"][c] * length, np.inf)
        kept = np.exp(-3.912 / 30 * distance)[..., None]
        faint = 60 + 0.2 * (pair["image"][c] - 128.0)
        pair["image"][c] = np.rint(kept * faint + (1 - kept) * 240).astype(np.uint8)
    (finding,) = [f for f in check(pair, thorough=True) if f.check == "photometric_shift"]
    assert np.abs(finding.estimate.uv).max() < 0.02


TOO_FEW_OCCLUDED = {"occluded_share": "not applicable: 217 values, 400 needed"}
"""what these small frames are exempt from anyway"""


def test_flow_may_be_left_out(frame: Frame) -> None:
    del frame["flow"]
    findings = check(frame, thorough=False)
    assert all(f.passed for f in findings)
    exempt = {f.check for f in findings if not f.applies}
    assert exempt == {"flow", "vertical_flow", *TOO_FEW_OCCLUDED}


def test_night_is_exempt_from_photometry_and_says_so(frame: Frame) -> None:
    frame["spec"] = frame["spec"] | {"daylight": {"sun_elevation_deg": -0.5}}
    exempt = {f.check: f.detail for f in check(frame, thorough=True) if not f.applies}
    reason = "not applicable: the sun is below the horizon"
    assert exempt == dict.fromkeys(PHOTOMETRIC, reason) | TOO_FEW_OCCLUDED


def test_images_without_texture_are_exempt_from_photometry_and_say_so(frame: Frame) -> None:
    frame["image"][:] = 128
    exempt = {f.check: f.detail for f in check(frame, thorough=True) if not f.applies}
    reason = "not applicable: 0 textured pixels, 500 needed"
    assert exempt == dict.fromkeys(PHOTOMETRIC, reason) | TOO_FEW_OCCLUDED


# --- one corruption each ------------------------------------------------------------------------


def test_flow_of_the_wrong_sign_fails(frame: Frame) -> None:
    frame["flow"] *= -1
    assert "flow" in failed(frame)


def test_flow_off_by_two_thousandths_of_a_pixel_fails(frame: Frame) -> None:
    frame["flow"][1, ..., 1] += 0.002
    assert failed(frame) == {"flow", "vertical_flow"}


def test_sky_flow_that_is_not_the_homography_fails(frame: Frame) -> None:
    frame["flow"][0][frame["depth"][0] == 0] += 0.01
    assert "flow" in failed(frame)


def test_half_a_pixel_in_one_principal_point_fails(pair: Frame) -> None:
    pair["K"][1, 0, 2] += 0.5
    assert "flow" in failed(pair)
    assert "photometric_shift" in failed(pair | {"flow": add_flow(pair)["flow"][:1]}, thorough=True)


def offset(frame: Frame) -> Estimate:
    (finding,) = [f for f in check(frame, thorough=True) if f.check == "photometric_offset"]
    return finding.estimate


@pytest.mark.parametrize("half", [-0.5, 0.5])
def test_half_a_pixel_between_images_and_geometry_fails(pair: Frame, half: float) -> None:
    """Ground truth at pixel corners: both images agree, and only the slope of the road tells."""
    assert offset(pair).uv[1] == pytest.approx(0, abs=0.02)
    for c in (0, 1):
        pair["image"][c] = photograph(pair, c, half, half)
    measured = offset(pair)
    assert measured.uv[1] == pytest.approx(half, abs=0.02)
    finding = judge_estimate("photometric_offset", measured, "set", limit=0.2)
    assert finding.applies
    assert not finding.passed


def test_an_image_shift_is_measured_to_a_hundredth_of_a_pixel(pair: Frame) -> None:
    pair["image"][1] = photograph(pair, 1, 0.16, -0.12)
    assert failed(pair, thorough=True) == {"photometric_shift"}
    assert worst(pair)["photometric_shift"] == pytest.approx(0.2, abs=0.01)


def test_images_of_another_place_fail(pair: Frame) -> None:
    pair["image"][1] = pair["image"][1, ::-1, ::-1]
    assert "photometric_match" in failed(pair, thorough=True)


def test_depth_scaled_by_a_hundredth_fails(pair: Frame) -> None:
    """Once flow follows the wrong depth, only the pixels know."""
    pair["depth"] *= np.float32(1.01)
    assert "flow" in failed(pair)
    consistent = pair | {"flow": add_flow(pair)["flow"][:1]}
    assert "photometric_shift" in failed(consistent, thorough=True)


def test_depth_of_one_camera_scaled_by_a_hundredth_breaks_the_cycle(frame: Frame) -> None:
    frame["depth"][2] *= np.float32(1.01)
    assert "cycle" in failed(add_flow(frame))


def test_distance_instead_of_depth_fails(frame: Frame) -> None:
    hw = frame["depth"].shape[1:]
    length = np.linalg.norm(rays_of(frame["K"][0], np.eye(4), pixels(hw)), axis=1)
    frame["depth"] *= length.reshape(hw).astype(np.float32)
    assert "flow" in failed(frame)
    assert "cycle" in failed(add_flow(frame))


def turn(frame: Frame, camera: int, deg: float) -> Frame:
    R = Rotation.from_euler("x", deg, degrees=True).as_matrix()
    frame["T_world_cam"][camera, :3, :3] @= R
    return frame


def test_a_pose_turned_by_a_hundredth_of_a_degree_fails(frame: Frame) -> None:
    assert {"pose", "flow", "vertical_flow"} <= failed(turn(frame, 1, 0.01))


def test_images_rendered_with_another_pose_fail(pair: Frame) -> None:
    """All numbers agree with each other; only the pixels know."""
    pair["image"][1] = photograph(turn(copy(pair), 1, 0.05), 1)
    assert failed(pair, thorough=True) == {"photometric_shift"}


def test_a_moved_camera_fails(frame: Frame) -> None:
    frame["T_world_cam"][0, 0, 3] += 1e-6
    assert "pose" in failed(frame)


def test_a_rotation_that_is_none_fails(frame: Frame) -> None:
    frame["T_world_cam_nominal"][0, :3, 0] *= 1 + 1e-8
    assert "rotation" in failed(frame)


@pytest.mark.parametrize("scale", [(-1, 1, 1), (0, 0, 0), (1, 1, 2)])
@pytest.mark.parametrize("thorough", [False, True])
def test_a_mirrored_or_zero_rotation_fails_and_ends_the_checks(
    frame: Frame, scale: tuple[float, ...], thorough: bool
) -> None:
    frame["T_world_cam"][1, :3, :3] *= scale
    assert failed(frame, thorough=thorough) == {"rotation", "pose"}


def test_a_reflection_is_no_rotation(frame: Frame) -> None:
    frame["T_world_cam"][:, :3, 0] *= -1
    assert "rotation" in failed(frame)


def test_an_angle_beyond_the_rigs_maximum_fails(frame: Frame) -> None:
    frame["spec"] = {"rig": {"perturbation_deg": 0.5}}
    assert failed(frame) == {"perturbation_range"}


def test_degrees_taken_for_radians_fail(frame: Frame) -> None:
    frame["perturbation_deg"] = np.deg2rad(frame["perturbation_deg"])
    assert failed(frame) == {"pose"}


def test_swapped_status_fails(frame: Frame) -> None:
    forward, backward = frame["flow_status"], frame["flow_status_reverse"]
    frame["flow_status"], frame["flow_status_reverse"] = backward, forward
    assert {"out_of_frame", "sky"} <= failed(frame)


def test_two_visibility_bits_fail(frame: Frame) -> None:
    frame["flow_status"][0, 45, 80] |= 7
    assert "status_bits" in failed(frame)


def test_an_unknown_status_bit_fails(frame: Frame) -> None:
    frame["flow_status_reverse"][0, 45, 80] |= 32
    assert failed(frame) == {"status_bits"}


def swap_status(frame: Frame, old: int, new: int) -> Frame:
    for name in ("flow_status", "flow_status_reverse"):
        status = frame[name]
        status[(status & old) != 0] ^= np.uint8(old | new)
    return frame


def test_occluded_pixels_called_visible_fail(frame: Frame) -> None:
    """Where they are few beside the visible ones, only cameras 1.6 m apart show them."""
    assert "visible_depth" in failed(swap_status(frame, schema.OCCLUDED, schema.VISIBLE))


def test_visible_pixels_called_occluded_fail(frame: Frame) -> None:
    assert "occluded_depth" in failed(swap_status(frame, schema.VISIBLE, schema.OCCLUDED))


@pytest.mark.parametrize("name", ["flow_status", "flow_status_reverse"])
def test_one_false_occlusion_to_five_true_ones_fails(frame: Frame, name: str) -> None:
    """Also on the road, whose next row is nearer, and however few they are of all pixels."""
    status = frame[name][2]
    visible = np.flatnonzero(status & schema.VISIBLE)
    num = np.count_nonzero(status & schema.OCCLUDED) // 5
    chosen = np.random.default_rng(0).choice(visible, num, replace=False)
    status.flat[chosen] ^= schema.VISIBLE | schema.OCCLUDED
    assert "occluded_share" in failed(frame)


def test_in_frame_ends_on_the_outer_edge_of_the_last_pixel(frame: Frame) -> None:
    """The convention is −½ ≤ u < W − ½; a status made with 0 ≤ u < W fails."""
    hw = frame["depth"].shape[1:]
    for p, (a, b) in enumerate(PAIRS):
        end = ends(frame, a, b)[1].reshape(*hw, 2)
        fresh = ((end >= -0.5) & (end < 0)).any(axis=-1) & (frame["flow_status"][p] & 4 == 0)
        frame["flow_status"][p][fresh] = schema.OUT_OF_FRAME
    assert "out_of_frame" in failed(frame, thorough=True)


def test_sky_must_be_the_same_in_depth_label_and_status(frame: Frame) -> None:
    frame["semantic"][0, 0, 0] = schema.LABELS["building"]
    assert failed(frame) == {"sky"}


def test_permuted_instances_fail(frame: Frame) -> None:
    ids = frame["instance"][1]
    frame["instance"][1] = np.where(ids == 7, 300, np.where(ids == 300, 7, ids))
    assert failed(frame) == {"instance"}


def test_labels_that_differ_between_cameras_fail(frame: Frame) -> None:
    labels = frame["semantic"][2]
    labels[labels == schema.LABELS["road"]] = schema.LABELS["sidewalk"]
    assert failed(frame) == {"semantic"}


@pytest.mark.parametrize("name", ["depth", "flow", "K", "T_world_cam", "perturbation_deg"])
def test_a_nan_fails_and_ends_the_checks(frame: Frame, name: str) -> None:
    frame[name].flat[-1] = np.nan
    assert "finite" in failed(frame)
    detail = next(f.detail for f in check(frame, thorough=True) if not f.passed)
    assert detail == f"{name}: 1"


def test_negative_depth_fails(frame: Frame) -> None:
    frame["depth"][0, 0, 0] = -1
    assert failed(frame) == {"finite"}


def test_a_negative_focal_length_fails(frame: Frame) -> None:
    frame["K"][0, 0, 0] *= -1
    assert failed(frame) == {"intrinsics"}


def test_wrong_type_and_shape_are_named(frame: Frame) -> None:
    frame["depth"] = frame["depth"].astype(np.float64)
    frame["K"] = frame["K"][:2]
    del frame["instance"]
    (finding,) = check(frame, thorough=True)
    assert "'depth' is float64 (3, 90, 160), expected float32 (3, 90, 160)" in finding.detail
    assert "'K' is float64 (2, 3, 3), expected float64 (3, 3, 3)" in finding.detail
    assert "'instance' is missing" in finding.detail


def test_pairs_must_name_cameras_that_exist(frame: Frame) -> None:
    (finding,) = check_frame(frame, PAIRS + np.uint8(1), thorough=False)
    assert "'pairs' is [[1, 2], [2, 3], [1, 3]], expected (left, right) below 3" in finding.detail


# --- a set --------------------------------------------------------------------------------------


ATTRIBUTES = {
    "schema_version": schema.SCHEMA_VERSION,
    "units": "metres, pixels, degrees",
    "conventions": "OpenCV camera axes",
    "dataset_seed": 0,
    "config": json.dumps({"frames_per_scene": 1}),
    "package_version": "0.1.0",
}


def write_shard(path: Path, frames: list[Frame], **attributes: Any) -> None:
    with h5py.File(path, "w") as shard:
        shard.attrs.update(ATTRIBUTES | attributes)
        shard["pairs"] = PAIRS
        for name, field in schema.FIELDS.items():
            if field.dtype == "json":
                shard.create_dataset(
                    name, data=[json.dumps(f[name]) for f in frames], dtype=h5py.string_dtype()
                )
            else:
                shard[name] = np.stack([f[name] for f in frames])


def write_manifest(folder: Path, shards: dict[str, list[int]], **changes: Any) -> None:
    """A manifest of the shards as they now lie in the folder."""
    entries = [
        {
            "name": name,
            "split": name.split("-")[0],
            "frames": frames,
            "bytes": (folder / name).stat().st_size,
            "sha256": hashlib.sha256((folder / name).read_bytes()).hexdigest(),
        }
        for name, frames in shards.items()
    ]
    manifest = {
        "schema_version": 1, "shards": entries, "failures": [], "num_pairs_asked": 3,
        "config": {"rig": {"pairs": [[0, 1], [1, 2], [0, 2]]}},
    } | changes  # fmt: skip
    (folder / "manifest.json").write_text(json.dumps(manifest))


def numbered(frame: Frame, index: int, scene: int | None = None) -> Frame:
    scene = index if scene is None else scene
    return frame | {"frame_index": np.int64(index), "scene_index": np.int64(scene)}


@pytest.fixture(scope="module")
def tiny() -> Frame:
    return make_frame((54, 96))


@pytest.fixture
def folder(tiny: Frame, tmp_path: Path) -> Path:
    write_shard(tmp_path / "test-00000.h5", [numbered(tiny, 0)])
    write_shard(tmp_path / "train-00000.h5", [numbered(tiny, 1), numbered(tiny, 2)])
    write_manifest(tmp_path, {"test-00000.h5": [0], "train-00000.h5": [1, 2]})
    return tmp_path


def failures(folder: Path) -> dict[str, str]:
    """Failed checks with their details."""
    return {f.check: f.detail for f in validate_folder(folder).failed}


def test_a_correct_set_passes_and_reports_progress(folder: Path) -> None:
    seen: list[tuple[int, int]] = []
    report = validate_folder(folder, progress=lambda done, total: seen.append((done, total)))
    assert report.passed, report.table()
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_the_table_names_every_check_and_every_failure(folder: Path) -> None:
    (folder / "test-00000.h5").unlink()
    table = validate_folder(folder).table()
    assert all(name in table for name in CHECKS)
    assert "FAILED readable: 1 files, limit 0; test-00000.h5; the file is missing" in table


def test_worst_holds_the_largest_value_and_its_place(folder: Path, tiny: Frame) -> None:
    frame = copy(numbered(tiny, 2))
    frame["flow"][2] += 0.5
    write_shard(folder / "train-00000.h5", [numbered(tiny, 1), frame])
    value, limit, where = validate_folder(folder).worst["flow"]
    assert (value, limit) == (pytest.approx(0.5, abs=1e-3), 1e-3)
    assert where == "train-00000.h5, frame 2, camera 0 to 2"


def test_a_changed_byte_is_found(folder: Path) -> None:
    with h5py.File(folder / "train-00000.h5", "r+") as shard:
        shard["image"][0, 0, 0, 0, 0] ^= 1
    found = failures(folder)
    assert set(found) == {"sha256"}
    assert found["sha256"].endswith(
        "; move the file away and run the same render command again with the same versions "
        "installed, or put a copy of it back"
    )


@pytest.mark.parametrize("part", ["samples", "versions", "rig", "daylight"])
@pytest.mark.parametrize("value", [None, 2, "2.0", [4]])
def test_a_part_of_a_spec_that_is_no_object_is_a_finding(
    folder: Path, tiny: Frame, part: str, value: Any
) -> None:
    spec = tiny["spec"] | {part: value}
    write_shard(folder / "test-00000.h5", [numbered(tiny, 0) | {"spec": spec}])
    assert failures(folder)["schema"] == f"'spec.{part}' is no JSON object"


RULE = {"day_spp": 2, "night_spp": 4, "features_spp": 8, "max_depth": 4}


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("change, expected", [
    ({}, None),
    ({"samples": {"spp": 4, "features_spp": 8}}, "samples.spp 4, expected 2: [2]"),
    ({"samples": {"spp": 2, "features_spp": 16}}, "samples.features_spp 16, expected 8: [2]"),
    ({"versions": {"numpy": "9.9"}}, "versions.numpy 9.9, expected 2.0: [2]"),
    ({"versions": {}}, "versions.numpy missing, expected 2.0: [2]"),
])  # fmt: skip
def test_frames_of_other_samples_or_versions_are_found(
    folder: Path, tiny: Frame, stated: bool, change: dict[str, Any], expected: str | None
) -> None:
    """Against the manifest, or, where that is of an older version, against most frames."""
    made = {"samples": {"spp": 2, "features_spp": 8}, "versions": {"numpy": "2.0"}}
    specs = [tiny["spec"] | made, tiny["spec"] | made | change]
    write_shard(folder / "test-00000.h5", [numbered(tiny, 0) | {"spec": specs[0]}])
    train = [numbered(tiny, 1 + i) | {"spec": spec} for i, spec in enumerate(specs)]
    write_shard(folder / "train-00000.h5", train)
    rule = {"samples": {k: RULE[k] for k in ("day_spp", "night_spp", "features_spp")}}
    config = {"rig": {"pairs": PAIRS.tolist()}, "spp": 2, **(rule if stated else {})}
    write_manifest(folder, {"test-00000.h5": [0], "train-00000.h5": [1, 2]}, config=config,
                   versions={"numpy": "2.0"} if stated else {})  # fmt: skip
    assert failures(folder) == ({} if expected is None else {"settings": expected})


@pytest.mark.parametrize("stated", [True, False])
def test_nights_are_held_to_their_own_rule(stated: bool) -> None:
    """Which older sets do not state: then nights are alike."""
    known = {k: str(v) for k, v in RULE.items() if stated or k != "night_spp"}
    manifest = _Manifest([], set(), {}, {}, known)

    def found(*night_spp: int) -> str:
        each = [(False, 2), *((True, spp) for spp in night_spp)]
        facts = [
            _Facts(i, i, "train", np.zeros((3, 3)), night,
                   {"spp": str(spp), "features_spp": "8", "max_depth": "4"}, {})
            for i, (night, spp) in enumerate(each)
        ]  # fmt: skip
        return _check_settings(manifest, facts).detail

    assert found(4, 4) == ""
    assert found(2, 2) == ("samples.spp 2, expected 4: [1, 2]" if stated else "")
    assert found(4, 4, 2) == "samples.spp 2, expected 4: [3]"


def test_a_truncated_shard_is_found(folder: Path) -> None:
    path = folder / "train-00000.h5"
    path.write_bytes(path.read_bytes()[:5000])
    found = failures(folder)
    assert set(found) == {"sha256", "readable", "frames"}
    assert "truncated, damaged or no HDF5 file" in found["readable"]
    assert found["frames"] == "listed but not found: [1, 2]"


@pytest.fixture
def unreadable(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """``unreadable("manifest.json")``: opening files of this name fails, as on a broken disk."""
    open_file = Path.open

    def refuse(name: str) -> None:
        def opened(path: Path, *args: Any, **kwargs: Any) -> Any:
            if path.name == name:
                raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
            return open_file(path, *args, **kwargs)

        monkeypatch.setattr(Path, "open", opened)

    return refuse


def test_a_shard_that_cannot_be_read_is_found_and_the_others_are_checked(
    folder: Path, unreadable: Callable[[str], None]
) -> None:
    unreadable("train-00000.h5")
    found = failures(folder)
    assert set(found) == {"readable", "frames"}
    assert "Input/output error" in found["readable"]
    assert found["frames"] == "listed but not found: [1, 2]"


def test_a_manifest_that_cannot_be_read_is_an_error(
    folder: Path, unreadable: Callable[[str], None]
) -> None:
    unreadable("manifest.json")
    with pytest.raises(UserError, match=r"manifest\.json: cannot be read \(Input/output error\)"):
        validate_folder(folder)


def test_a_foreign_hdf5_file_is_found(folder: Path) -> None:
    with h5py.File(folder / "train-00000.h5", "w") as file:
        file["data"] = np.zeros(3)
    found = failures(folder)
    assert "attributes missing: schema_version, units" in found["attributes"]
    assert "'image' is missing" in found["schema"]


def test_a_shard_of_another_schema_is_found(folder: Path, tiny: Frame) -> None:
    write_shard(folder / "test-00000.h5", [numbered(tiny, 0)], schema_version=0)
    assert "schema version 0, expected 1: written by another" in failures(folder)["attributes"]


def test_a_shard_with_other_frames_than_listed_is_found(folder: Path, tiny: Frame) -> None:
    write_shard(folder / "test-00000.h5", [numbered(tiny, 10)])
    write_manifest(folder, {"test-00000.h5": [0], "train-00000.h5": [1, 2]})
    assert failures(folder) == {"frames": "listed but not found: [0]; found but not listed: [10]"}


def test_frames_that_were_asked_for_and_are_not_there_are_missing(folder: Path) -> None:
    shards = {"test-00000.h5": [0], "train-00000.h5": [1, 2]}
    write_manifest(folder, shards, num_pairs_asked=10)
    assert failures(folder) == {"frames": "missing: [3]"}
    write_manifest(folder, shards, num_pairs_asked=300)
    assert failures(folder)["frames"].startswith("missing: 97 frames, first [3, 4,")


def test_a_set_may_grow_on_one_side_only(folder: Path) -> None:
    shards = {"test-00000.h5": [0], "train-00000.h5": [1, 2]}
    write_manifest(folder, shards, num_pairs_asked=300, pairs_asked={"train": 9, "test": 30})
    assert validate_folder(folder).passed
    write_manifest(folder, shards, num_pairs_asked=300, pairs_asked={"train": 9, "test": 33})
    assert failures(folder) == {"frames": "missing: [10]"}


def test_a_gap_is_found_unless_it_is_a_recorded_failure(folder: Path, tiny: Frame) -> None:
    write_shard(folder / "train-00000.h5", [numbered(tiny, 1), numbered(tiny, 3)])
    shards = {"test-00000.h5": [0], "train-00000.h5": [1, 3]}
    write_manifest(folder, shards)
    assert failures(folder) == {"frames": "missing: [2]"}
    write_manifest(folder, shards, failures=[{"frame_index": 2}])
    assert validate_folder(folder).passed


def test_a_set_of_one_split_is_complete_without_the_other(folder: Path, tiny: Frame) -> None:
    write_manifest(folder, {"train-00000.h5": [1, 2]})
    assert validate_folder(folder).passed


def test_a_test_scene_among_the_training_shards_is_found(folder: Path, tiny: Frame) -> None:
    write_shard(folder / "train-00000.h5", [numbered(tiny, 1), numbered(tiny, 2, scene=0)])
    write_manifest(folder, {"test-00000.h5": [0], "train-00000.h5": [1, 2]})
    assert failures(folder)["splits"] == "frames on the wrong side: [2]; scenes on both: [0]"


def test_spec_that_is_no_json_is_found(folder: Path) -> None:
    with h5py.File(folder / "test-00000.h5", "r+") as shard:
        shard["spec"][0] = "{"
    assert "'spec' is no JSON object" in failures(folder)["schema"]


def test_no_manifest_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no manifest here.*simgen render --out"):
        validate_folder(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", '{"schema_version": 1}'])
def test_a_foreign_manifest_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(UserError, match="not a manifest of simgen"):
        validate_folder(tmp_path)


def test_a_manifest_of_another_schema_is_an_error(tmp_path: Path) -> None:
    write_manifest(tmp_path, {}, schema_version=2)
    with pytest.raises(UserError, match="schema version 2, expected 1"):
        validate_folder(tmp_path)


def test_an_empty_manifest_is_an_error(tmp_path: Path) -> None:
    write_manifest(tmp_path, {})
    with pytest.raises(UserError, match="lists no shard yet"):
        validate_folder(tmp_path)


def test_a_missing_filter_is_an_error_that_names_the_package(
    folder: Path, tiny: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(folder / "test-00000.h5", "r+") as shard:
        del shard["depth"]
        shard.create_dataset("depth", data=tiny["depth"][None], compression="gzip")
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    with pytest.raises(UserError, match=r"'depth' is compressed with .* pip install hdf5plugin"):
        validate_folder(folder)


# --- the distribution of the angles -------------------------------------------------------------


def angle_findings(angles: np.ndarray) -> list[Finding]:
    facts = [_Facts(i, i, "train", a) for i, a in enumerate(angles)]
    return list(_check_angles(facts))


def test_uniform_angles_pass_and_others_fail() -> None:
    rng = np.random.default_rng(1)
    uniform = rng.uniform(-1, 1, (100, 3, 3))
    assert all(f.applies and f.passed for f in angle_findings(uniform))
    assert not any(f.passed for f in angle_findings(uniform**3))
    only_positive_yaw = np.where([False, True, False], np.abs(uniform), uniform)
    assert [f.passed for f in angle_findings(only_positive_yaw)] == [True, False, True]


def test_the_limit_on_uniformity_is_the_quantile_of_kolmogorov() -> None:
    """For many angles it is √(ln(2/α) / 2n), with α shared by three axes."""
    num = 3000
    limit = angle_findings(np.zeros((num, 1, 3)))[0].limit
    assert limit == pytest.approx(np.sqrt(np.log(2 / (1e-3 / 3)) / (2 * num)), rel=0.01)


def test_few_angles_are_not_judged() -> None:
    assert not any(f.applies for f in angle_findings(np.zeros((9, 3, 3))))


# --- photometry of the set ----------------------------------------------------------------------


def estimate_finding(du: float, dv: float, std_error: float) -> Finding:
    estimate = Estimate(np.array([du, dv]), np.full(2, std_error))
    return judge_estimate("photometric_shift", estimate, "a pair", 0.05)


def test_a_pooled_estimate_is_more_certain_than_its_parts() -> None:
    rng = np.random.default_rng(3)
    noisy = [estimate_finding(0.01 + a, 0.09 + b, 0.04) for a, b in rng.normal(0, 0.04, (400, 2))]
    shift, offset = _pool_photometry(noisy)
    assert shift.estimate.uv == pytest.approx([0.01, 0.09], abs=0.008)
    assert shift.estimate.std_error == pytest.approx(0.002, rel=0.2)
    assert (shift.applies, shift.passed, shift.where) == (True, False, "set, 400 pairs")
    assert not offset.applies


def test_components_that_could_lie_on_either_side_of_the_limit_are_not_judged() -> None:
    assert estimate_finding(0.07, 0.01, 0.01).value == pytest.approx(0.01)
    undecided = estimate_finding(0.07, 0.03, 0.01)
    assert not undecided.applies
    assert undecided.detail == (
        "not applicable: too uncertain: +0.0700 ± 0.0100, +0.0300 ± 0.0100 px"
    )


def test_a_large_shift_fails_even_where_it_is_uncertain() -> None:
    assert not estimate_finding(-0.4, 0.0, 0.1).passed


def test_pooling_weighs_by_certainty() -> None:
    sure, unsure = (Estimate(np.full(2, v), np.full(2, e)) for v, e in ((0.0, 0.1), (1.0, 0.2)))
    assert pool([sure, unsure]).uv == pytest.approx([0.2, 0.2])
