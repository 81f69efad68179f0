"""The human figure: proportions and a pose → a skinned mesh whose vertices name what they show.

A figure is modelled in the frame of mesh.py (x where it faces, y left, z up). A pose says where
hands and feet are; elbows and knees follow from the lengths of the bones. Every vertex carries a
*slot* (skin, hair, top, …), so that one mesh can be seen again in other clothes.

Lengths are shares of stature after Drillis and Contini, *Body segment parameters*, 1966; profiles
of girth are metres of an average adult of 1.75 m. Pairs are (left, right).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simgen.geometry import Array, rotation_from_vector
from simgen.mesh import Faces, Part, Vertices, loft, part

SLOTS = ("skin", "hair", "features", "top", "bottom", "legs", "shoes", "soles", "headgear",
         "bag", "umbrella", "gear")  # fmt: skip
"""What a vertex shows; an outfit has a colour for each."""
ADULT_M = 1.75
SIDES = (1.0, -1.0)
"""y of the left and of the right side"""

X, Y, Z = np.eye(3)


class Detail(NamedTuple):
    """How finely a figure is made."""

    torso: int
    """corners of a section of the trunk"""
    limb: int
    rows: float
    """sections, as a share of those of a profile"""
    small: bool
    """whether faces, fingers and soles are made"""


DETAILS = (Detail(20, 12, 1.2, True), Detail(12, 7, 0.7, True), Detail(6, 4, 0.45, False))
"""By level of detail, the nearest first."""


@dataclass(frozen=True)
class Build:
    """A body's proportions."""

    stature: float
    """[m]"""
    girth: float = 1.0
    """1 = average"""
    shape: float = 0.5
    """0 = broad shoulders, 1 = broad hips"""

    @property
    def scale(self) -> float:
        """Lengths over those of the adult of the profiles."""
        return self.stature / ADULT_M

    @property
    def youth(self) -> float:
        """0 = adult, 1 = a child of a metre: shorter legs, larger head."""
        return float(np.clip((1.6 - self.stature) / 0.6, 0.0, 1.0))

    @property
    def hip(self) -> float:
        """Height of the hip joints [m]; half of the leg above the ankle is thigh."""
        return (0.53 - 0.05 * self.youth) * self.stature

    @property
    def ankle(self) -> float:
        """Height of the ankles in shoes [m]."""
        return 0.05 * self.stature

    @property
    def leg(self) -> float:
        """Hip to ankle [m]."""
        return self.hip - self.ankle

    @property
    def arm(self) -> float:
        """Shoulder to wrist [m]; 0.56 of it is upper arm."""
        return 0.332 * self.stature

    @property
    def head(self) -> float:
        """Height of the head over that of the adult of the profiles."""
        return (0.175 + 0.03 * self.stature) / (0.175 + 0.03 * ADULT_M)

    def shoulder(self, side: float) -> Array:
        """A shoulder joint (3,) from the middle of the hips, upright."""
        half = (0.17 - 0.022 * self.shape) * self.scale * self.girth**0.5
        return np.array([0.0, side * half, (0.274 + 0.03 * self.youth) * self.stature])

    def hip_joint(self, side: float) -> Array:
        """A hip joint (3,) from the middle of the hips."""
        return np.array([0.0, side * 0.085 * self.scale * self.girth**0.5, 0.0])


@dataclass(frozen=True, eq=False)
class Pose:
    """Where hands and feet are."""

    ankles: Array
    """(2, 3) from each hip joint, in lengths of the leg"""
    wrists: Array
    """(2, 3) from each shoulder in the frame of the trunk, in lengths of the arm"""
    foot_pitch: tuple[float, float] = (0.0, 0.0)
    """[rad] toes up"""
    lean: float = 0.0
    """[rad] of the trunk, forward"""
    turn: float = 0.0
    """[rad] of the shoulders, to the left"""
    gaze: float = 0.0
    """[rad] of the head, to the left"""
    nod: float = 0.0
    """[rad] of the head, down"""

    @cached_property
    def R_trunk(self) -> Array:
        """Turns directions of the trunk as modelled, upright."""
        return rotation_from_vector(self.turn * Z) @ rotation_from_vector(self.lean * Y)

    @cached_property
    def R_head(self) -> Array:
        return rotation_from_vector(self.gaze * Z) @ rotation_from_vector(self.nod * Y)


class Limb(NamedTuple):
    """Three joints (3,) of an arm or leg, and where it comes from: collar bone or hip."""

    origin: Array
    root: Array
    middle: Array
    end: Array

    @property
    def hinge(self) -> Array:
        """The axis (3,) that the middle joint bends about."""
        axis = np.cross(self.middle - self.root, self.end - self.middle)
        return axis / np.linalg.norm(axis)


def bent(
    origin: Array, root: Array, end: Array, upper: float, lower: float, towards: ArrayLike
) -> Limb:
    """Two bones from ``root`` to ``end`` whose joint points ``towards``; ``end`` kept in reach."""
    reach = end - root
    along = reach / np.linalg.norm(reach)
    d = min(float(np.linalg.norm(reach)), 0.998 * (upper + lower))
    a = (d * d + upper * upper - lower * lower) / (2 * d)
    pole = np.asarray(towards, dtype=np.float64)
    pole = pole - (pole @ along) * along
    height = np.sqrt(max(upper * upper - a * a, 0.0))
    middle = root + a * along + height * pole / np.linalg.norm(pole)
    return Limb(origin, root, middle, root + d * along)


@dataclass(eq=False)
class Skeleton:
    """Joints of a build in a pose; the origin is the middle of the hips."""

    build: Build
    pose: Pose
    legs: list[Limb] = field(init=False)
    arms: list[Limb] = field(init=False)

    def __post_init__(self) -> None:
        b, half, R = self.build, self.build.leg / 2, self.pose.R_trunk
        self.legs, self.arms = [], []
        for side, ankle, wrist in zip(SIDES, self.pose.ankles, self.pose.wrists, strict=True):
            hip, shoulder = b.hip_joint(side), R @ b.shoulder(side)
            collar = R @ (b.shoulder(side) * [1.0, 0.45, 1.0] + 0.035 * b.scale * Z)
            knee, elbow = np.array([1.0, 0.12 * side, 0.0]), R @ np.array([-0.8, 0.45 * side, -0.5])
            foot, hand = hip + b.leg * ankle, shoulder + b.arm * (R @ wrist)
            self.legs.append(bent(hip + b.scale * Z, hip, foot, half, half, knee))
            self.arms.append(bent(collar, shoulder, hand, 0.56 * b.arm, 0.44 * b.arm, elbow))

    def settled(self, upright: Vertices) -> Vertices:
        """Points of the trunk (N, 3) as modelled, upright, bent about the hips as the pose is."""
        share = np.clip(upright[:, 2] / (0.12 * self.build.stature), 0.0, 1.0)
        lean, turn = share * self.pose.lean, share * self.pose.turn
        x = upright[:, 0] * np.cos(lean) + upright[:, 2] * np.sin(lean)
        z = -upright[:, 0] * np.sin(lean) + upright[:, 2] * np.cos(lean)
        y = upright[:, 1]
        return np.stack(
            [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z], axis=1
        )

    @cached_property
    def head(self) -> Array:
        """The middle (3,) of the head."""
        top = np.array([0.0, 0.0, self.build.stature - self.build.hip - 0.16 * self.build.head])
        return self.pose.R_trunk @ top + [0.01, 0.0, 0.045 * self.build.head]


def seated(build: Build, hips: Array, soles: Array, grips: Array, lean: float) -> Skeleton:
    """A body astride, in a frame of its own about ``hips``.

    Args:
        hips: (3,) their middle.
        soles: (2, 3) under the balls of the feet.
        grips: (2, 3) what the hands hold.
        lean: of the trunk, forward [rad].
    """
    k = build.scale
    ankles = soles + np.array([-0.11 * k, 0.0, build.ankle])
    joints = hips + np.array([build.hip_joint(side) for side in SIDES])
    wrists = grips + np.array([-0.06, 0.0, 0.035]) - hips
    shoulders = np.array([build.shoulder(side) for side in SIDES])
    R = rotation_from_vector(lean * Y)
    pose = Pose((ankles - joints) / build.leg, (wrists @ R - shoulders) / build.arm,
                lean=lean, nod=0.1)  # fmt: skip
    return Skeleton(build, pose)


Mesh = tuple[Vertices, Faces]


class Skin(NamedTuple):
    """A mesh that shows one slot."""

    mesh: Mesh
    slot: str


@dataclass(frozen=True, eq=False)
class Figure:
    """A mesh with a slot per vertex, standing on z = 0."""

    vertices: Vertices
    faces: Faces
    slots: NDArray[np.int64]

    def dressed(self, palette: Array, semantic: int) -> Part:
        """The figure in the colours (len(SLOTS), 3) of an outfit."""
        return part(self.vertices, self.faces, "matte", semantic, color=palette[self.slots])


def figure(skins: Sequence[Skin], *, ground: float | None = None) -> Figure:
    """One mesh of all skins, lowered so that it stands on ``ground``, by default its lowest."""
    vertices = np.concatenate([s.mesh[0] for s in skins])
    counts = [len(s.mesh[0]) for s in skins]
    offsets = np.cumsum([0, *counts[:-1]])
    faces = np.concatenate([s.mesh[1] + o for s, o in zip(skins, offsets, strict=True)])
    lowest = float(vertices[:, 2].min()) if ground is None else ground
    slots = np.repeat([SLOTS.index(s.slot) for s in skins], counts)
    return Figure(vertices - lowest * Z, faces, slots)


# --- solids --------------------------------------------------------------------------------------


def rows(profile: ArrayLike, share: float) -> Array:
    """A profile (N, K) with about ``share`` · N rows, interpolated; at least 3."""
    table = np.asarray(profile, dtype=np.float64)
    at = np.linspace(0, len(table) - 1, max(3, round(share * len(table))))
    return np.stack([np.interp(at, np.arange(len(table)), c) for c in table.T], axis=1)


@lru_cache
def oval(corners: int, squareness: float = 2.0) -> Array:
    """A superellipse (M, 2) of half axes 1, counter-clockwise."""
    a = (np.arange(corners) + 0.5) * 2 * np.pi / corners
    xy = np.stack([np.cos(a), np.sin(a)], axis=1)
    return np.sign(xy) * np.abs(xy) ** (2 / squareness)


def stack(table: Array, corners: int, squareness: float = 2.0) -> Mesh:
    """A solid of level sections; rows of z, half width (y), half depth (x), x of the middle."""
    ring = oval(corners, squareness)
    z, width, depth, middle = table.T[:, :, None]
    x, y = middle + depth * ring[:, 0], width * ring[:, 1]
    return loft(np.stack([x, y, np.broadcast_to(z, x.shape)], axis=2))


def ball(
    centre: ArrayLike,
    radii: ArrayLike,
    corners: int = 8,
    cut: float = 0.0,
    R: Array | None = None,
) -> Mesh:
    """An ellipsoid (radii along x, y, z), or its part above ``cut`` of the polar angle [0, 1]."""
    polar = np.linspace(np.pi * (1 - cut) - 0.02, 0.02, max(4, corners // 2 + 1))
    ring = oval(corners)
    unit = np.concatenate(
        [np.sin(polar)[:, None, None] * ring, np.broadcast_to(
            np.cos(polar)[:, None, None], (len(polar), corners, 1))], axis=2)  # fmt: skip
    vertices, faces = loft(unit * np.asarray(radii))
    turned = vertices if R is None else vertices @ R.T
    return turned + np.asarray(centre), faces


def along(limb: Limb, t: Array) -> Array:
    """Points (N, 3) along a limb, −1 = origin, 0 = root, 1 = middle joint, 2 = end, rounded."""
    joints = np.stack(limb)
    s = (t + 1.0)[:, None] + [-0.14, 0.0, 0.14]
    k = np.clip(np.floor(s), 0, 2).astype(int)
    return (joints[k] + (s - k)[..., None] * (joints[k + 1] - joints[k])).mean(axis=1)


def sleeve(limb: Limb, table: Array, corners: int, across: Array) -> Mesh:
    """A limb's skin; rows of place along it (see ``along``), half width ``across``, half depth."""
    path = along(limb, table[:, 0])
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    wide = across - (tangent @ across)[:, None] * tangent
    wide /= np.linalg.norm(wide, axis=1, keepdims=True)
    deep = np.cross(wide, tangent)
    half = table[:, None, 1:3] * oval(corners)[:, ::-1]
    return loft(path[:, None] + half[..., :1] * wide[:, None] + half[..., 1:] * deep[:, None])


# --- the body ------------------------------------------------------------------------------------

_LEG = [(-0.04, 0.06, 0.07), (0.08, 0.084, 0.094), (0.3, 0.083, 0.09), (0.6, 0.07, 0.074),
        (0.88, 0.056, 0.06), (1.0, 0.052, 0.058), (1.15, 0.048, 0.054), (1.35, 0.052, 0.06),
        (1.6, 0.042, 0.048), (1.85, 0.032, 0.036), (2.02, 0.03, 0.036)]  # fmt: skip
_ARM = [(-0.5, 0.02, 0.03), (-0.2, 0.04, 0.046), (0.02, 0.05, 0.056), (0.15, 0.053, 0.057),
        (0.4, 0.047, 0.052),
        (0.8, 0.041, 0.044), (1.0, 0.04, 0.041), (1.2, 0.042, 0.042), (1.6, 0.034, 0.032),
        (1.95, 0.027, 0.022)]  # fmt: skip
_PELVIS = [(-0.14, 0.05, 0.05, 0.0), (-0.1, 0.12, 0.09, -0.005), (-0.05, 0.166, 0.11, -0.012),
           (0.0, 0.176, 0.12, -0.016), (0.06, 0.163, 0.106, -0.008),
           (0.14, 0.138, 0.088, 0.0)]  # fmt: skip
_TORSO = [(0.0, 0.178, 0.123, -0.012), (0.05, 0.172, 0.116, -0.006), (0.15, 0.153, 0.103, 0.004),
          (0.26, 0.16, 0.112, 0.008), (0.35, 0.172, 0.118, 0.012), (0.42, 0.183, 0.11, 0.004),
          (0.455, 0.18, 0.1, -0.002), (0.485, 0.16, 0.088, -0.008), (0.51, 0.112, 0.074, -0.014),
          (0.528, 0.07, 0.062, -0.014)]  # fmt: skip
_SHOULDER_M = 0.46
_HEAD = [(-0.122, 0.018, 0.018, 0.062), (-0.113, 0.036, 0.034, 0.05), (-0.09, 0.05, 0.062, 0.028),
         (-0.06, 0.06, 0.078, 0.015), (-0.02, 0.068, 0.09, 0.005), (0.02, 0.074, 0.096, 0.0),
         (0.06, 0.073, 0.094, -0.004), (0.09, 0.062, 0.08, -0.008), (0.11, 0.042, 0.056, -0.01),
         (0.12, 0.012, 0.016, -0.01)]  # fmt: skip
# along x from the heel: half width, top above the ankle, both of an ankle 0.0875 m high
_SHOE = [(-0.078, 0.016, -0.03), (-0.066, 0.03, 0.002), (-0.03, 0.037, 0.022),
         (0.02, 0.039, 0.012), (0.07, 0.043, -0.022), (0.12, 0.049, -0.038),
         (0.165, 0.044, -0.046), (0.19, 0.03, -0.056), (0.2, 0.01, -0.068)]  # fmt: skip


def _thick(profile: ArrayLike, share: float, thickness: float, extra: float) -> Array:
    """A limb's rows, half widths times ``thickness`` and wider by ``extra`` [m]."""
    table = rows(profile, share)
    table[:, 1:3] = table[:, 1:3] * thickness + extra
    return table


def legs(s: Skeleton, d: Detail, slot: str, *, start: float = -0.04, end: float = 2.02,
         loose: float = 0.0, flare: float = 0.0) -> list[Skin]:  # fmt: skip
    """Bare or clothed legs between two places along them; ``flare`` widens what is below."""
    table = _thick(_LEG, d.rows, s.build.scale * s.build.girth, loose)
    t = np.linspace(start, end, max(3, round(len(table) * (end - start) / 2.06)))
    girth = np.stack([np.interp(t, table[:, 0], table[:, k]) for k in (1, 2)], axis=1)
    below = np.clip((t - 0.5) / 1.5, 0.0, 1.0)[:, None]
    table = np.column_stack([t, girth + flare * below])
    return [Skin(sleeve(leg, table, d.limb, leg.hinge), slot) for leg in s.legs]


def arms(s: Skeleton, d: Detail, slot: str, *, start: float = -0.5, end: float = 1.95,
         loose: float = 0.0) -> list[Skin]:  # fmt: skip
    """Bare or clothed arms between two places along them."""
    table = _thick(_ARM, d.rows, s.build.scale * s.build.girth**0.8, loose)
    t = np.linspace(start, end, max(3, round(len(table) * (end - start) / 2.45)))
    girth = [np.interp(t, table[:, 0], table[:, k]) for k in (1, 2)]
    table = np.column_stack([t, *girth])
    return [Skin(sleeve(arm, table, d.limb, arm.hinge), slot) for arm in s.arms]


def _trunk_mesh(s: Skeleton, profile: ArrayLike, d: Detail, loose: float, hem: float = 0.0) -> Mesh:
    """Rows of the trunk at the build's size, bent as the pose is; ``hem`` lengthens it [m]."""
    b = s.build
    table = rows(profile, d.rows)
    hips = np.clip(1 - table[:, 0] / 0.3, 0.0, 1.0)
    shape = 1 + (b.shape - 0.5) * (0.14 * hips - 0.12 * (1 - hips))
    height = b.shoulder(1.0)[2] / _SHOULDER_M
    belly = max(b.girth - 1.0, 0.0) * np.exp(-(((table[:, 0] - 0.16) / 0.12) ** 2))
    table[:, 1:3] = table[:, 1:3] * b.scale * (b.girth * shape)[:, None] + loose
    table[:, 2] += 0.06 * belly
    table[:, 3] = table[:, 3] * b.scale + 0.06 * belly
    table[:, 0] *= height
    table[0, 0] -= hem
    vertices, faces = stack(table, d.torso, 2.3)
    return s.settled(vertices), faces


def pelvis(s: Skeleton, d: Detail, slot: str, loose: float = 0.004) -> Skin:
    return Skin(_trunk_mesh(s, _PELVIS, d, loose), slot)


def torso(s: Skeleton, d: Detail, slot: str, loose: float = 0.008, hem: float = 0.0) -> Skin:
    """A shirt or jacket from the hips to the neck."""
    return Skin(_trunk_mesh(s, _TORSO, d, loose, hem), slot)


def skirt(s: Skeleton, d: Detail, slot: str, end: float, flare: float,
          loose: float = 0.0) -> Skin:  # fmt: skip
    """Cloth around both legs from the waist to ``end`` along them (1 = the knees)."""
    k = s.build.scale * s.build.girth
    ring = oval(d.torso, 2.2)
    t = np.linspace(end, 0.02, max(3, round(6 * d.rows)))
    left, right = (along(leg, t) for leg in s.legs)
    middle, spread = (left + right) / 2, np.abs(left - right) / 2
    wider = 1.0 + flare * (t / end)
    level = [(z, y + 0.1 * k * f, 0.9 * x + 0.085 * k * f, m)
             for z, m, x, y, f in zip(middle[:, 2], middle[:, 0], *spread[:, :2].T, wider,
                                      strict=True)]  # fmt: skip
    level += [(0.01, 0.184 * k, 0.128 * k, -0.012), (0.14 * k, 0.145 * k, 0.094 * k, 0.0)]
    z, width, depth, x = np.array(level).T[:, :, None]
    x, y = x + (depth + loose) * ring[:, 0], (width + loose) * ring[:, 1]
    return Skin(loft(np.stack([x, y, np.broadcast_to(z, x.shape)], axis=2)), slot)


def shoes(s: Skeleton, d: Detail) -> list[Skin]:
    """Shoes; near ones with soles of another colour."""
    k, height = s.build.scale, s.build.ankle
    x, width, top = rows(_SHOE, d.rows).T
    upper = _shoe(x * k, width * k, np.full(len(x), -height), top * k, d.limb)
    sole = _shoe(1.03 * x * k, width * k + 0.004, np.full(len(x), -height - 0.004),
                 np.full(len(x), 0.022 * k - height), d.limb)  # fmt: skip
    skins = []
    for leg, pitch in zip(s.legs, s.pose.foot_pitch, strict=True):
        R = rotation_from_vector(-pitch * Y)
        for (vertices, faces), slot in ((upper, "shoes"), (sole, "soles"))[: 2 if d.small else 1]:
            skins.append(Skin((vertices @ R.T + leg.end, faces), slot))
    return skins


def _shoe(x: Array, width: Array, low: Array, high: Array, corners: int) -> Mesh:
    """Upright sections along x, flat below."""
    ring = oval(corners, 2.6)
    z = ((low + high) / 2)[:, None] + ((high - low) / 2)[:, None] * np.maximum(ring[:, 1], -1)
    y = width[:, None] * ring[:, 0]
    return loft(np.stack([np.broadcast_to(x[:, None], y.shape), y, z], axis=2))


def hands(s: Skeleton, d: Detail) -> list[Skin]:
    """Hands that go on from the forearms, fingers a little bent, thumbs forward."""
    k = s.build.scale
    skins = []
    for side, arm in zip(SIDES, s.arms, strict=True):
        out = (arm.end - arm.middle) / np.linalg.norm(arm.end - arm.middle)
        inward = -side * (s.pose.R_trunk @ Y)
        inward = inward - (inward @ out) * out
        inward /= np.linalg.norm(inward)
        forward = np.cross(inward, out) * -side
        knuckles = arm.end + 0.085 * k * out + 0.006 * k * inward
        tips = knuckles + k * (0.07 * out + 0.035 * inward)
        table = rows([(0.0, 0.024, 0.018), (0.5, 0.036, 0.017), (1.0, 0.04, 0.016),
                      (1.6, 0.034, 0.013), (2.0, 0.02, 0.008)], d.rows)  # fmt: skip
        table[:, 1:] *= k
        skins.append(
            Skin(sleeve(Limb(arm.middle, arm.end, knuckles, tips), table, d.limb, forward), "skin")
        )
        if d.small:
            base = arm.end + k * (0.025 * out + 0.018 * forward)
            ball_of_thumb = base + k * (0.03 * out + 0.02 * forward + 0.012 * inward)
            thumb = Limb(
                arm.end, base, ball_of_thumb, ball_of_thumb + k * (0.035 * out + 0.015 * inward)
            )
            table = np.array([(0.0, 0.014, 0.014), (1.0, 0.011, 0.011), (2.0, 0.006, 0.006)])
            skins.append(Skin(sleeve(thumb, table * [1, k, k], 6, forward), "skin"))
    return skins


def head(s: Skeleton, d: Detail) -> list[Skin]:
    """Head and neck; near ones with a face."""
    k = s.build.head
    vertices, faces = stack(rows(_HEAD, d.rows) * k, d.limb + 2)
    top = s.pose.R_trunk @ np.array([0.0, 0.0, s.build.shoulder(1.0)[2] + 0.03 * s.build.scale])
    base = s.head + s.pose.R_head @ np.array([-0.012, 0.0, -0.04]) * k
    neck = Limb(top - Z, top, (top + base) / 2, base)
    width = 0.054 * s.build.scale * s.build.girth**0.5
    table = np.array([(0.0, 1.12, 1.12), (1.0, 1.0, 1.0), (2.0, 0.98, 0.98)]) * [1, width, width]
    skins = [(vertices, faces)]
    if d.small:
        skins.append(ball((0.094 * k, 0, -0.026 * k), np.array([0.018, 0.012, 0.024]) * k, 6))
        skins += [ball((-0.004 * k, 0.073 * k * y, -0.02 * k),
                       np.array([0.018, 0.01, 0.03]) * k, 6) for y in SIDES]  # fmt: skip
    dark = [_feature(k, x, y, z, size) for x, y, z, size in _FACE] if d.small else []
    placed = [Skin((v @ s.pose.R_head.T + s.head, f), "skin") for v, f in skins]
    placed += [Skin((v @ s.pose.R_head.T + s.head, f), "features") for v, f in dark]
    return [*placed, Skin(sleeve(neck, table, d.limb, Y), "skin")]


# eyes, brows, mouth: where, and the half size [m]
_FACE = [(0.083, 0.031 * y, 0.012, (0.008, 0.013, 0.006)) for y in SIDES]
_FACE += [(0.087, 0.032 * y, 0.031, (0.006, 0.018, 0.004)) for y in SIDES]
_FACE += [(0.084, 0.0, -0.068, (0.008, 0.022, 0.004))]


def _feature(k: float, x: float, y: float, z: float, size: tuple[float, float, float]) -> Mesh:
    return ball(k * np.array([x, y, z]), k * np.array(size), 6)


def on_head(s: Skeleton, mesh: Mesh, slot: str) -> Skin:
    """Something modelled about the middle of an adult's head, worn."""
    vertices, faces = mesh
    return Skin((vertices * s.build.head @ s.pose.R_head.T + s.head, faces), slot)


def on_trunk(s: Skeleton, mesh: Mesh, slot: str) -> Skin:
    """Something modelled against an adult's upright trunk, from the hips, worn."""
    vertices, faces = mesh
    return Skin((s.settled(vertices * s.build.scale), faces), slot)
