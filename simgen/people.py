"""People: who they are, what they do, wear and carry. Frame and units: see mesh.py.

Colours are linear albedos of cloth (dark blues, greys and blacks are common), hair and skin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgen import figure as fig
from simgen.figure import DETAILS, SIDES, Build, Detail, Figure, Mesh, Pose, Skeleton, Skin, X, Y, Z
from simgen.geometry import Array, rotation_from_vector
from simgen.mesh import Model, box, loft, tube
from simgen.schema import LABELS

Rng = np.random.Generator
Rgb = tuple[float, float, float]

ACTIVITIES = ("walking", "waiting", "phone", "talking")


@dataclass(frozen=True)
class Person:
    """Someone as a mesh that can be dressed in any colours."""

    figure: Figure
    activity: str

    def model(self, *, rng: Rng, semantic: int = LABELS["person"]) -> Model:
        """The person, in clothes, skin and hair drawn anew."""
        return [self.figure.dressed(palette(rng=rng), semantic)]


def draw_build(*, rng: Rng, adult: bool = False) -> Build:
    """Someone's size: mostly adults, now and then a child."""
    if not adult and rng.random() < 0.1:
        return Build(float(rng.uniform(1.0, 1.5)), float(rng.uniform(0.85, 1.0)), 0.5)
    shape = float(rng.uniform())
    stature = float(np.clip(1.78 - 0.13 * shape + rng.normal(0, 0.055), 1.5, 1.95))
    return Build(stature, float(np.clip(rng.normal(1.04, 0.09), 0.86, 1.3)), shape)


def person(activity: str, *, rng: Rng, lod: int = 0, umbrella: bool = False,
           build: Build | None = None) -> Person:  # fmt: skip
    """Someone who does one of ACTIVITIES.

    Raises:
        ValueError: no such activity.
    """
    if activity not in ACTIVITIES:
        raise ValueError(f"activity {activity!r} is unknown; expected one of {ACTIVITIES}")
    pose = _POSES[activity](rng)
    if umbrella:
        pose = _holding_up(pose, rng)
    s = Skeleton(build or draw_build(rng=rng), pose)
    detail = DETAILS[lod]
    skins = [*clothed(s, detail, rng=rng), *_accessories(s, detail, activity, umbrella, rng)]
    return Person(fig.figure(skins, ground=_sole(skins)), activity)


def _sole(skins: Sequence[Skin]) -> float:
    """Height of the lowest point of the shoes."""
    return min(float(s.mesh[0][:, 2].min()) for s in skins if s.slot in ("shoes", "soles"))


# --- poses ---------------------------------------------------------------------------------------

# Hip and knee flexion and foot pitch [deg] over a stride from heel strike, by tenths, rounded from
# the curves of natural cadence in Winter, "The Biomechanics and Motor Control of Human Gait", 1991.
_HIP = (28, 24, 16, 7, -3, -10, -4, 12, 26, 30)
_KNEE = (5, 16, 15, 8, 6, 13, 38, 60, 42, 12)
_FOOT = (20, 2, 0, 0, -4, -20, -58, -50, -12, 18)


def gait(phase: float, vigour: float = 1.0) -> Pose:
    """Walking at a phase [0, 1) of the stride, 0 = the left heel strikes."""
    phases = np.array([phase, phase + 0.5]) % 1.0 * 10
    hip, knee, foot = (np.deg2rad(vigour * np.interp(phases, range(11), [*c, c[0]]))
                       for c in (_HIP, _KNEE, _FOOT))  # fmt: skip
    shank = hip - knee
    ankles = np.stack([(np.sin(hip) + np.sin(shank)) / 2, [-0.02, 0.02],
                       -(np.cos(hip) + np.cos(shank)) / 2], axis=1)  # fmt: skip
    swing = 0.42 * vigour * np.cos(2 * np.pi * phases / 10)
    elbow = 0.35 + 0.3 * np.maximum(-swing, 0.0)
    wrists = np.array([_hanging(-a, e, y) for a, e, y in zip(swing, elbow, SIDES, strict=True)])
    turn = -0.1 * vigour * float(np.cos(2 * np.pi * phase))
    return Pose(ankles, wrists, (float(foot[0]), float(foot[1])), lean=0.05, turn=turn)


def _hanging(forward: float, elbow: float, side: float) -> Array:
    """The wrist (3,) of an arm that hangs, swung ``forward`` and bent at the elbow [rad]."""
    fore = forward + elbow
    x = 0.56 * np.sin(forward) + 0.44 * np.sin(fore)
    z = -0.56 * np.cos(forward) - 0.44 * np.cos(fore)
    return np.array([x, 0.1 * side, z])


def _standing(rng: Rng) -> Pose:
    """At rest, the weight a little on one leg."""
    shift, apart = float(rng.uniform(-0.04, 0.04)), float(rng.uniform(0.02, 0.07))
    step = float(rng.uniform(-0.06, 0.06))
    ankles = np.array([[step, apart + shift, -0.985], [-step, shift - apart, -0.985]])
    wrists = np.array([_hanging(rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.3), y) for y in SIDES])
    return Pose(ankles, wrists, turn=float(rng.normal(0, 0.08)), gaze=float(rng.normal(0, 0.35)),
                nod=float(rng.normal(0.05, 0.06)))  # fmt: skip


def _with_wrist(pose: Pose, side: int, wrist: Sequence[float]) -> Pose:
    """The pose with one hand (0 = left) elsewhere; ``wrist`` is given for the left side."""
    wrists = pose.wrists.copy()
    wrists[side] = np.asarray(wrist) * [1.0, SIDES[side], 1.0]
    return replace(pose, wrists=wrists)


def _waiting(rng: Rng) -> Pose:
    """Standing: arms down, hands in pockets, folded arms, or hands behind the back."""
    pose = _standing(rng)
    choice = rng.random()
    both = [0.14, 0.06, -0.8] if choice < 0.3 else [0.42, -0.35, -0.36] if choice < 0.45 else None
    if both is None:
        return pose
    return _with_wrist(_with_wrist(pose, 0, both), 1, both)


def _phone(rng: Rng) -> Pose:
    """Standing with a telephone in the right hand, the eyes on it."""
    pose = replace(_standing(rng), nod=float(rng.uniform(0.35, 0.6)), gaze=-0.1)
    return _with_wrist(pose, 1, [0.62, -0.25, -0.3])


def _talking(rng: Rng) -> Pose:
    """Standing, a hand raised in talk more often than not."""
    pose = replace(_standing(rng), gaze=float(rng.normal(0, 0.25)))
    if rng.random() < 0.35:
        return pose
    lifted = [float(rng.uniform(0.45, 0.65)), float(rng.uniform(-0.2, 0.3)),
              float(rng.uniform(-0.5, -0.1))]  # fmt: skip
    return _with_wrist(pose, int(rng.integers(2)), lifted)


def _walking(rng: Rng) -> Pose:
    pose = gait(float(rng.random()), float(rng.uniform(0.8, 1.1)))
    return replace(pose, gaze=float(rng.normal(0, 0.2)), nod=float(rng.normal(0.08, 0.08)))


_POSES = {"walking": _walking, "waiting": _waiting, "phone": _phone, "talking": _talking}


def _holding_up(pose: Pose, rng: Rng) -> Pose:
    """The left hand before the chest, around the stick of an umbrella."""
    return _with_wrist(pose, 0, [0.5, -0.15, -0.22 + float(rng.uniform(-0.05, 0.05))])


# --- clothes -------------------------------------------------------------------------------------


def clothed(s: Skeleton, d: Detail, *, rng: Rng, riding: bool = False) -> list[Skin]:
    """A body in clothes: head to shoes, without anything carried."""
    jacket = float(rng.uniform(0.006, 0.03))
    short_sleeves = rng.random() < 0.3
    skins = [*fig.head(s, d), *_hair(s, d, rng), *fig.shoes(s, d), *fig.hands(s, d)]
    if short_sleeves:
        skins += [*fig.arms(s, d, "top", end=0.62, loose=0.012), *fig.arms(s, d, "skin", start=0.4)]
    else:
        skins += fig.arms(s, d, "top", loose=0.5 * jacket + 0.004)
    lower = "trousers" if riding else _LOWER[rng.choice(len(_LOWER), p=_lower_shares(s.build))]
    long_coat = not riding and lower != "shorts" and not short_sleeves and rng.random() < 0.15
    if long_coat:
        skins.append(fig.skirt(s, d, "top", float(rng.uniform(0.55, 1.1)), 0.5, 0.02))
    skins.append(fig.torso(s, d, "top", 0.004 + jacket * (not short_sleeves),
                           hem=float(rng.uniform(0.0, 0.05))))  # fmt: skip
    if not long_coat:
        skins.append(fig.pelvis(s, d, "bottom"))
    return [*skins, *_LEGWEAR[lower](s, d, rng)]


def _lower_shares(build: Build) -> list[float]:
    skirts = 0.35 * max(build.shape - 0.4, 0.0) / 0.6
    return [0.55 - skirts / 2, 0.33 - skirts / 2, 0.12, skirts]


def _trousers(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    return fig.legs(s, d, "bottom", end=1.97, loose=float(rng.uniform(0.008, 0.014)), flare=0.022)


def _slim(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    return fig.legs(s, d, "bottom", end=1.93, loose=float(rng.uniform(0.002, 0.006)))


def _shorts(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    end = float(rng.uniform(0.7, 1.05))
    return [*fig.legs(s, d, "bottom", end=end, loose=0.014, flare=0.02),
            *fig.legs(s, d, "skin", start=0.5)]  # fmt: skip


def _skirt(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    end = float(rng.uniform(0.6, 1.6))
    return [
        fig.skirt(s, d, "bottom", end, float(rng.uniform(0.2, 0.7))),
        *fig.legs(s, d, "legs", start=0.6 * end),
    ]


_LEGWEAR = {"trousers": _trousers, "slim": _slim, "shorts": _shorts, "skirt": _skirt}
_LOWER = tuple(_LEGWEAR)

_CROWN = rotation_from_vector(-0.38 * Y)
"""Hair grows from the forehead to the nape: a cap tilted backwards."""


def _hair(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    """Hair, short or long, or a hat, hood or scarf."""
    corners = d.limb + 2
    crown = fig.ball((-0.002, 0, 0.022), (0.108, 0.085, 0.112), corners, 0.46, _CROWN)
    long = rng.random() < 0.15 + 0.7 * s.build.shape
    skins = [fig.on_head(s, crown, "hair")]
    if long:
        vertices, faces = _tresses(corners, float(rng.uniform(0.1, 0.27)))
        falling = vertices @ rotation_from_vector(s.pose.nod * Y)  # upright whatever the nod
        skins.append(fig.on_head(s, (falling, faces), "hair"))
    if rng.random() < 0.25:
        skins += _HATS[rng.integers(len(_HATS))](s, corners)
    return skins


def _tresses(corners: int, length: float) -> Mesh:
    """Hair that falls behind the ears."""
    table = np.array([(-length, 0.05, 0.02, -0.1), (-0.6 * length, 0.08, 0.034, -0.09),
                      (-0.02, 0.082, 0.06, -0.05), (0.05, 0.08, 0.065, -0.04)])  # fmt: skip
    return fig.stack(table, corners, 2.4)


def _cap(s: Skeleton, corners: int) -> list[Skin]:
    vertices, faces = fig.stack(
        np.array([(0.0, 0.05, 0.04, 0.02), (0.012, 0.05, 0.04, 0.02)]), corners, 2.6
    )
    peak = (vertices @ rotation_from_vector(0.15 * Y).T + [0.115, 0.0, 0.045], faces)
    dome = fig.ball((0, 0, 0.035), (0.106, 0.088, 0.1), corners, 0.5)
    return [fig.on_head(s, m, "headgear") for m in (dome, peak)]


def _woolly_hat(s: Skeleton, corners: int) -> list[Skin]:
    tilt = rotation_from_vector(-0.2 * Y)
    dome = fig.ball((-0.006, 0, 0.03), (0.108, 0.09, 0.118), corners, 0.53, tilt)
    return [fig.on_head(s, dome, "headgear")]


def helmet(s: Skeleton, d: Detail) -> list[Skin]:
    """A cyclist's helmet with its strap left out."""
    dome = fig.ball((0.0, 0, 0.03), (0.122, 0.095, 0.116), d.limb + 2, 0.5,
                    rotation_from_vector(-0.1 * Y))  # fmt: skip
    return [fig.on_head(s, dome, "headgear")]


def crash_helmet(s: Skeleton, d: Detail) -> list[Skin]:
    """A motorcyclist's helmet with its dark visor."""
    shell = fig.ball((-0.005, 0, 0.005), (0.135, 0.112, 0.138), d.limb + 4)
    visor = fig.ball((0.03, 0, 0.015), (0.108, 0.098, 0.055), d.limb + 4)
    return [fig.on_head(s, shell, "headgear"), fig.on_head(s, visor, "gear")]


_HATS = (_cap, _woolly_hat)

# --- what is carried -----------------------------------------------------------------------------


def _accessories(s: Skeleton, d: Detail, activity: str, umbrella: bool, rng: Rng) -> list[Skin]:
    """Umbrella, telephone, and now and then a bag."""
    skins = _umbrella(s, d, rng) if umbrella else []
    if activity == "phone" and d.small:
        skins.append(_telephone(s))
    chance = rng.random()
    if chance < 0.22:
        skins.append(backpack(s, d, rng=rng))
    elif chance < 0.45 and activity in ("walking", "waiting"):
        skins += _shopping(s, d, rng)
    elif chance < 0.58:
        skins += _shoulder_bag(s, d)
    return skins


def _grip(s: Skeleton, side: int) -> Array:
    """The middle (3,) of a fist."""
    arm = s.arms[side]
    out = (arm.end - arm.middle) / np.linalg.norm(arm.end - arm.middle)
    return arm.end + 0.08 * s.build.scale * out


def _umbrella(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    """An open umbrella over the head, its stick in the left hand."""
    hand, over = _grip(s, 0), s.head + 0.36 * Z + 0.05 * X
    radius = float(rng.uniform(0.46, 0.58))
    ribs = 8 if d.limb <= 8 else 16
    tilt = rotation_from_vector(float(rng.uniform(0.0, 0.25)) * Y)
    polar = np.linspace(0.95, 0.02, 5 if d.small else 3)
    ring = fig.oval(ribs)
    sag = np.where(np.arange(ribs) % 2 == 0, 1.0, 0.94) if d.small else np.ones(ribs)
    r = radius * np.sin(polar) / np.sin(0.95)
    z = radius * 0.75 * (np.cos(polar) - 1.0)
    canopy, faces = loft(
        np.stack([r[:, None] * ring[:, 0] * sag, r[:, None] * ring[:, 1] * sag,
                  np.broadcast_to(z[:, None], (len(z), ribs))], axis=2), caps=False)  # fmt: skip
    stick = tube([hand - 0.08 * Z, hand, over + 0.03 * Z], 0.007, 5)
    return [Skin((canopy @ tilt.T + over, faces), "umbrella"), Skin(stick, "gear")]


def _telephone(s: Skeleton) -> Skin:
    vertices, faces = box((0.012, 0.075, 0.15))
    R = rotation_from_vector(-0.7 * Y)
    return Skin((vertices @ R.T + _grip(s, 1) + [0.02, 0.02, 0.05], faces), "gear")


def backpack(s: Skeleton, d: Detail, *, rng: Rng) -> Skin:
    """A rucksack on the back."""
    k = float(rng.uniform(0.85, 1.15))
    table = np.array([(0.1, 0.1, 0.03, -0.14), (0.12, 0.14, 0.065, -0.165),
                      (0.25, 0.15, 0.08, -0.185), (0.38, 0.14, 0.07, -0.18),
                      (0.46, 0.11, 0.05, -0.155), (0.48, 0.06, 0.02, -0.14)])  # fmt: skip
    table[:, 1:3] *= k
    table[:, 3] += -0.08 * (k - 1) - 0.1 * (s.build.girth - 1)
    return fig.on_trunk(s, fig.stack(fig.rows(table, max(0.7, d.rows)), d.torso, 3.5), "bag")


def _shopping(s: Skeleton, d: Detail, rng: Rng) -> list[Skin]:
    """A bag that hangs from the right hand."""
    grip = _grip(s, 1)
    height, width = float(rng.uniform(0.26, 0.4)), float(rng.uniform(0.12, 0.19))
    top = -0.14 * s.build.scale
    height = min(height, float(grip[2]) + s.build.hip + top - 0.06)
    table = np.array([(top - height, 0.05, 0.8 * width, 0.0), (top - 0.5 * height, 0.07, width, 0),
                      (top, 0.03, width, 0.0)])  # fmt: skip
    vertices, faces = fig.stack(table, d.limb, 4.0)
    handle = tube([(-0.6 * width, 0.0, top), (0.0, 0.0, 0.0), (0.6 * width, 0.0, top)], 0.006, 4)
    return [Skin((v + grip, f), "bag") for v, f in ((vertices, faces), handle)]


def _shoulder_bag(s: Skeleton, d: Detail) -> list[Skin]:
    """A handbag at the hip, its strap across the chest."""
    k = s.build.girth**0.5
    table = np.array([(-0.13, 0.03, 0.13, 0.02), (-0.03, 0.045, 0.15, 0.02),
                      (0.06, 0.035, 0.14, 0.02)])  # fmt: skip
    vertices, faces = fig.stack(table, d.limb, 3.5)
    side = 0.235 * k
    bag = fig.on_trunk(s, (np.add(vertices, [0.0, side, 0.0]), faces), "bag")
    if not d.small:
        return [bag]
    strap = np.array([(0.02, side, 0.05), (0.1, 0.17 * k, 0.12), (0.142, 0.08, 0.25),
                      (0.142, -0.02, 0.36), (0.1, -0.09, 0.47), (0.0, -0.1, 0.53),
                      (-0.1, -0.08, 0.47), (-0.135, 0.02, 0.34), (-0.125, 0.1, 0.22),
                      (-0.09, 0.18 * k, 0.12), (0.0, side, 0.05)])  # fmt: skip
    strap[:, 0] *= s.build.girth
    return [bag, fig.on_trunk(s, tube(strap, 0.013, 5), "bag")]


# --- colours -------------------------------------------------------------------------------------

_SKINS: tuple[Rgb, ...] = (
    (0.56, 0.34, 0.24),
    (0.50, 0.29, 0.19),
    (0.42, 0.23, 0.14),
    (0.30, 0.15, 0.085),
    (0.16, 0.075, 0.042),
    (0.085, 0.042, 0.026),
)
_HAIRS: tuple[Rgb, ...] = ((0.012, 0.010, 0.009), (0.03, 0.017, 0.010), (0.07, 0.038, 0.020),
                           (0.20, 0.12, 0.05), (0.33, 0.24, 0.13), (0.13, 0.045, 0.018),
                           (0.28, 0.27, 0.26), (0.50, 0.49, 0.47))  # fmt: skip
_CLOTHS: tuple[Rgb, ...] = (
    (0.018, 0.018, 0.020), (0.018, 0.018, 0.020), (0.018, 0.018, 0.020),  # black
    (0.06, 0.062, 0.066), (0.16, 0.16, 0.16), (0.34, 0.34, 0.33),  # greys
    (0.015, 0.022, 0.06), (0.015, 0.022, 0.06), (0.04, 0.08, 0.22), (0.16, 0.27, 0.42),  # blues
    (0.62, 0.61, 0.58), (0.62, 0.61, 0.58), (0.45, 0.38, 0.28),  # white, cream
    (0.26, 0.18, 0.10), (0.09, 0.05, 0.028),  # beige, brown
    (0.05, 0.06, 0.028), (0.02, 0.09, 0.05), (0.07, 0.14, 0.05),  # olive, greens
    (0.38, 0.025, 0.03), (0.12, 0.012, 0.022), (0.50, 0.10, 0.02), (0.60, 0.40, 0.04),  # warm
    (0.45, 0.14, 0.20), (0.11, 0.04, 0.14),  # pink, purple
)  # fmt: skip
_LOWERS: tuple[Rgb, ...] = (
    (0.018, 0.018, 0.020), (0.018, 0.018, 0.020), (0.022, 0.035, 0.08), (0.045, 0.075, 0.15),
    (0.11, 0.16, 0.24), (0.05, 0.05, 0.052), (0.12, 0.12, 0.12), (0.28, 0.21, 0.13),
    (0.09, 0.06, 0.035), (0.05, 0.055, 0.03), (0.015, 0.02, 0.05), (0.42, 0.40, 0.36),
)  # fmt: skip
_SHOES: tuple[Rgb, ...] = ((0.016, 0.016, 0.016), (0.016, 0.016, 0.016), (0.06, 0.03, 0.016),
                           (0.13, 0.07, 0.035), (0.60, 0.60, 0.58), (0.12, 0.12, 0.13),
                           (0.03, 0.05, 0.14))  # fmt: skip


def _of(colors: Sequence[Rgb], rng: Rng) -> Array:
    """One of the colours, a little varied."""
    color = np.array(colors[int(rng.integers(len(colors)))])
    return color * rng.uniform(0.75, 1.2) * rng.uniform(0.93, 1.07, 3)


def palette(*, rng: Rng) -> Array:
    """A colour (3,) for each of SLOTS."""
    skin, bottom = _of(_SKINS, rng), _of(_LOWERS, rng)
    colors = {
        "skin": skin,
        "hair": _of(_HAIRS[:3] if skin[0] < 0.25 else _HAIRS, rng),
        "features": 0.22 * skin,
        "top": _of(_CLOTHS, rng),
        "bottom": bottom,
        "legs": 0.9 * skin if rng.random() < 0.5 else np.array([0.02, 0.018, 0.018]),
        "shoes": _of(_SHOES, rng),
        "soles": _of(((0.6, 0.6, 0.57), (0.02, 0.02, 0.02)), rng),
        "headgear": _of(_CLOTHS, rng),
        "bag": _of(_CLOTHS, rng),
        "umbrella": _of(_CLOTHS, rng),
        "gear": np.array([0.02, 0.02, 0.022]),
    }
    return np.array([colors[name] for name in fig.SLOTS])
