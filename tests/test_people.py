"""People have human proportions, stand on their soles, and cyclists touch what they ride."""

from __future__ import annotations

import numpy as np
import pytest

from simgen import bicycle, people
from simgen import figure as fig
from simgen.figure import SIDES, Build, Pose, Skeleton
from simgen.mesh import Model
from simgen.schema import LABELS

HANGING = np.array([[0.05, 0.1, -0.95], [0.05, -0.1, -0.95]])
STRAIGHT = Pose(np.array([[0.0, 0.02, -0.99], [0.0, -0.02, -0.99]]), HANGING)


def vertices(model: Model) -> np.ndarray:
    return np.concatenate([p.vertices for p in model])


def body(build: Build, pose: Pose, lod: int = 0) -> fig.Figure:
    skeleton = Skeleton(build, pose)
    rng = np.random.default_rng(0)
    return fig.figure(people.clothed(skeleton, fig.DETAILS[lod], rng=rng))


@pytest.mark.parametrize("stature", [1.0, 1.3, 1.6, 1.95])
def test_someone_is_as_tall_as_stated_at_every_level_of_detail(stature: float) -> None:
    for lod in range(3):
        height = np.ptp(body(Build(stature), STRAIGHT, lod).vertices[:, 2])
        assert height == pytest.approx(stature, abs=0.06)  # soles and hair included


def test_a_childs_head_is_larger_in_proportion() -> None:
    assert Build(1.0).head / 1.0 > 1.3 * Build(1.8).head / 1.8


@pytest.mark.parametrize("activity", people.ACTIVITIES)
@pytest.mark.parametrize("lod", [0, 1, 2])
def test_the_lowest_sole_is_on_the_ground(activity: str, lod: int) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        person = people.person(activity, rng=rng, lod=lod, umbrella=seed == 1)
        assert vertices(person.model(rng=rng))[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_bones_keep_their_lengths() -> None:
    build = Build(1.7)
    for phase in np.linspace(0, 1, 7):
        skeleton = Skeleton(build, people.gait(float(phase)))
        for limbs, length, upper in ((skeleton.legs, build.leg, 0.5),
                                     (skeleton.arms, build.arm, 0.56)):  # fmt: skip
            for limb in limbs:
                bones = [np.linalg.norm(limb.middle - limb.root),
                         np.linalg.norm(limb.end - limb.middle)]  # fmt: skip
                assert bones == pytest.approx([upper * length, (1 - upper) * length], rel=1e-9)


def test_knees_bend_forward_and_elbows_backward() -> None:
    for phase in np.linspace(0, 1, 7):
        skeleton = Skeleton(Build(1.7), people.gait(float(phase)))
        for leg in skeleton.legs:
            assert leg.middle[0] >= (leg.root[0] + leg.end[0]) / 2
        for arm in skeleton.arms:
            assert arm.middle[0] <= (arm.root[0] + arm.end[0]) / 2


def test_a_step_later_left_and_right_have_changed_places() -> None:
    now, later = people.gait(0.2), people.gait(0.7)
    mirror = [1.0, -1.0, 1.0]
    np.testing.assert_allclose(now.ankles, later.ankles[::-1] * mirror, atol=1e-12)
    np.testing.assert_allclose(now.wrists, later.wrists[::-1] * mirror, atol=1e-12)


def test_an_arm_swings_with_the_opposite_leg() -> None:
    pose = people.gait(0.0)
    assert pose.ankles[0, 0] > pose.ankles[1, 0]
    assert pose.wrists[0, 0] < pose.wrists[1, 0]


def test_what_is_far_away_has_few_triangles() -> None:
    rng = np.random.default_rng(3)
    for lod, limit in enumerate((6000, 2600, 800)):
        for activity in people.ACTIVITIES:
            assert len(people.person(activity, rng=rng, lod=lod).figure.faces) < limit
    for lod, limit in enumerate((11000, 5000, 2000)):
        assert sum(len(p.faces) for p in bicycle.cyclist(rng=rng, lod=lod)) < limit


def test_a_body_can_be_dressed_again() -> None:
    rng = np.random.default_rng(0)
    person = people.person("waiting", rng=rng)
    (one,), (other,) = (person.model(rng=rng) for _ in range(2))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    assert not np.array_equal(one.color, other.color)
    assert 0.0 < other.color.min() < other.color.max() < 0.9


def test_an_unknown_activity_is_refused() -> None:
    with pytest.raises(ValueError, match=r"activity 'flying' is unknown; expected one of \('walk"):
        people.person("flying", rng=np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(4))
def test_a_cyclist_holds_the_grips_and_treads_the_pedals(seed: int) -> None:
    rng = np.random.default_rng(seed)
    build = Build(float(rng.uniform(1.56, 1.92)))
    fit = bicycle._fitted(build.stature, rng)
    skeleton, hips = bicycle._seated(build, fit, 0.4)
    for k in range(len(SIDES)):
        wrist, ankle = skeleton.arms[k].end + hips, skeleton.legs[k].end + hips
        assert np.linalg.norm(wrist - fit.grips[k]) < 0.16
        pedal = bicycle._pedals(fit)[k]
        assert np.linalg.norm(ankle - pedal - [-0.1, 0.0, build.ankle]) < 0.06


def test_wheels_touch_the_ground_and_rider_and_bicycle_have_their_classes() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        riding, parked = bicycle.cyclist(rng=rng), bicycle.bicycle(rng=rng)
        for model in (riding, parked):
            assert vertices(model)[:, 2].min() == pytest.approx(0.0, abs=2e-3)
        assert {p.semantic for p in riding} == {LABELS["rider"], LABELS["bicycle"]}
        assert {p.semantic for p in parked} == {LABELS["bicycle"]}


def test_windings_face_outwards() -> None:
    """The volume that the faces of a body enclose is that of a human, and positive."""
    figure = body(Build(1.75), STRAIGHT)
    a, b, c = (figure.vertices[figure.faces[:, k]] for k in range(3))
    volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6
    assert 0.06 < volume < 0.16
