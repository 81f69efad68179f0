"""Vehicles stand on the ground, have the size they claim, and nothing in them z-fights."""

from __future__ import annotations

import numpy as np
import pytest

from simgen.bodyshell import Arch, Outline, Shell, joined, lathe, quad_grid, shell
from simgen.materials import MATERIALS
from simgen.vehicles import FAMILIES, Vehicle, build, draw_family

CARS = ("hatchback", "saloon", "estate", "suv", "van")
EXPECTED_LABELS = {family: {26} for family in CARS} | {
    "box_truck": {27}, "semi_trailer": {27, 30}, "bus": {28}, "motorcycle": {32},
}  # fmt: skip
MOTORCYCLES = [build("motorcycle", rng=np.random.default_rng(s), ridden=True) for s in range(8)]


@pytest.fixture(scope="module", params=[(f, seed) for f in FAMILIES for seed in (0, 1, 2)], ids=str)
def vehicle(request: pytest.FixtureRequest) -> Vehicle:
    family, seed = request.param
    return build(family, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def body() -> Shell:
    """A plain car of 4 m."""
    x = [-2.0, -1.98, -1.7, -1.2, 0.0, 0.7, 1.2, 1.96, 2.0]
    z = [0.7, 1.0, 1.1, 1.4, 1.45, 1.4, 1.0, 0.8, 0.6]
    outline = Outline(
        top=np.stack([x, z], axis=1),
        bottom=np.array([[-2.0, 0.2], [2.0, 0.2]]),
        belt=np.array([[-2.0, 0.9], [2.0, 0.85]]),
        width=1.8,
        arches=(Arch(-1.3, 0.32, 0.37), Arch(1.3, 0.32, 0.37)),
    )
    return shell(outline)


def _vertices(vehicle: Vehicle) -> np.ndarray:
    return np.concatenate([p.vertices for p in vehicle.model])


def test_wheels_touch_the_ground_and_nothing_is_below(vehicle: Vehicle) -> None:
    assert _vertices(vehicle)[:, 2].min() == pytest.approx(0.0, abs=1e-6)


def test_the_bounding_box_is_the_stated_size_plus_mirrors(vehicle: Vehicle) -> None:
    low, high = _vertices(vehicle).min(axis=0), _vertices(vehicle).max(axis=0)
    length, width, height = high - low
    assert length == pytest.approx(vehicle.length, abs=0.06)
    assert height == pytest.approx(vehicle.height, abs=0.08)
    assert vehicle.width - 0.02 < width < vehicle.width + 0.65
    assert low[:2] + high[:2] == pytest.approx([0, 0], abs=0.06)  # the origin is in the middle


def test_the_size_is_in_the_range_of_the_family(vehicle: Vehicle) -> None:
    family = FAMILIES[vehicle.family]
    for value, limits in (
        (vehicle.length, family.length_m),
        (vehicle.width, family.width_m),
        (vehicle.height, family.height_m),
    ):
        assert limits[0] <= value <= limits[1]


def test_triangles_stay_in_the_budget(vehicle: Vehicle) -> None:
    small = vehicle.family in CARS or vehicle.family == "motorcycle"
    assert sum(len(p.faces) for p in vehicle.model) <= (3400 if small else 5000)


def test_parts_have_known_materials_plausible_albedos_and_valid_faces(vehicle: Vehicle) -> None:
    for part in vehicle.model:
        assert MATERIALS[part.material].color_by == "vertex"
        assert part.color is not None
        assert part.color.shape == part.vertices.shape
        assert part.color.min() >= 0.005
        assert part.color.max() <= 0.8
        assert part.faces.min() >= 0
        assert part.faces.max() < len(part.vertices)
        assert np.isfinite(part.vertices).all()


def test_every_part_has_the_label_of_its_kind(vehicle: Vehicle) -> None:
    assert {p.semantic for p in vehicle.model} == EXPECTED_LABELS[vehicle.family]


# A motorcycle leans on its stand.
@pytest.mark.parametrize("family", sorted(FAMILIES.keys() - {"motorcycle"}))
def test_painted_surfaces_are_symmetric(family: str) -> None:
    model = build(family, rng=np.random.default_rng(3)).model
    paint = np.concatenate([p.vertices for p in model if p.material == "paint"])
    points = {tuple(p) for p in paint.round(6) + 0.0}
    assert points == {tuple(p) for p in (paint * [1, -1, 1]).round(6) + 0.0}


@pytest.mark.parametrize("ridden", MOTORCYCLES, ids=range(8))
def test_a_ridden_motorcycle_is_upright_under_its_rider(ridden: Vehicle) -> None:
    *machine, rider = ridden.model
    assert ({p.semantic for p in machine}, rider.semantic) == ({32}, 25)
    vertices = _vertices(ridden)
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert vertices[:, 2].max() == pytest.approx(ridden.height)
    assert sum(len(p.faces) for p in ridden.model) <= 5000
    paint = np.concatenate([p.vertices for p in machine if p.material == "paint"])
    points = {tuple(p) for p in paint.round(6) + 0.0}
    assert points == {tuple(p) for p in (paint * [1, -1, 1]).round(6) + 0.0}


@pytest.mark.parametrize("ridden", MOTORCYCLES, ids=range(8))
def test_a_rider_sits_with_feet_on_the_pegs_and_hands_on_the_grips(ridden: Vehicle) -> None:
    *machine, rider = ridden.model
    things = np.concatenate([p.vertices for p in machine])
    body = rider.vertices
    hands = body[(np.abs(body[:, 1]) > 0.28) & (body[:, 0] > 0.05)]
    for side in (1, -1):
        grip = things[np.argmax(side * things[:, 1])]
        hand = hands[np.sign(hands[:, 1]) == side]
        assert np.linalg.norm(hand - grip, axis=1).min() < 0.12
    feet = body[body[:, 2] < 0.4]
    assert 0.3 < feet[:, 2].min() < 0.35
    assert np.abs(feet[:, 1]).min() > 0.1, "beside the engine, not in it"
    assert (body[np.abs(body[:, 1]) < 0.05, 2] > 0.7).all(), "nothing below the saddle"


def test_nothing_rides_what_has_no_saddle() -> None:
    plain, ridden = (build("bus", rng=np.random.default_rng(0), ridden=r) for r in (False, True))
    for a, b in zip(plain.model, ridden.model, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_the_same_seed_gives_the_same_vehicle_and_another_seed_another() -> None:
    first, again, other = (build("suv", rng=np.random.default_rng(s)) for s in (5, 5, 6))
    for a, b in zip(first.model, again.model, strict=True):
        assert a.vertices.tobytes() == b.vertices.tobytes()
        assert np.array_equal(a.color, b.color)
    assert first.length != other.length


def test_a_shell_faces_outwards_and_encloses_the_volume_of_a_car(body: Shell) -> None:
    vertices, faces = joined([body.painted, body.cladding, body.underside])
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert 0.5 * 4.0 * 1.8 * 1.25 < volume < 0.9 * 4.0 * 1.8 * 1.25


def test_wheel_arches_are_cut_out_of_the_sides(body: Shell) -> None:
    skin = np.concatenate([body.painted[0], body.cladding[0]])
    for arch in body.outline.arches:
        distance = np.hypot(skin[:, 0] - arch.x, skin[:, 2] - arch.z)
        assert distance.min() > arch.radius - 0.02  # the bow of the nose moves them a little


@pytest.mark.parametrize(
    "direction, corners, outward",
    [
        ("front", [(-0.7, 0.35), (0.7, 0.35), (0.7, 0.6), (-0.7, 0.6)], [1, 0, 0]),
        ("front", [(-0.7, 1.05), (0.7, 1.05), (0.5, 1.33), (-0.5, 1.33)], [1, 0, 0]),
        ("rear", [(-0.6, 0.4), (0.6, 0.4), (0.5, 0.75), (-0.5, 0.75)], [-1, 0, 0]),
        ("left", [(-0.8, 0.4), (0.8, 0.4), (0.5, 1.2), (-1.0, 1.2)], [0, 1, 0]),
    ],
)
def test_draped_faces_look_outwards_and_stand_off_the_shell(
    body: Shell, direction: str, corners: list[tuple[float, float]], outward: list[int]
) -> None:
    vertices, faces = body.draped(direction, quad_grid(corners, 4, 8))
    triangles = vertices[faces]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (normal @ outward > 0).all()
    kept = [0, 2] if direction == "left" else [1, 2]
    for middle in triangles.mean(axis=1):
        below, _ = body.draped(direction, middle[kept].reshape(1, 1, 2), lift=0.0)
        assert (middle - below[0]) @ outward > 0.004


def test_draping_beside_the_shell_is_an_error(body: Shell) -> None:
    with pytest.raises(ValueError, match=r"no skin that faces -x at \[0. 3.\]"):
        body.draped("rear", np.array([[[0.0, 3.0]]]))


def test_a_lathe_turns_its_profile_outwards() -> None:
    vertices, faces = lathe([(0.0, 1.0), (2.0, 1.0)], sides=64)
    normal = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(4 * np.pi, rel=1e-2)
    assert (np.einsum("ij,ij->i", normal, vertices[faces].mean(axis=1) * [1, 0, 1]) > 0).all()


def test_families_are_drawn_with_the_weights_of_the_mix() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_family(rng=rng, mix={"bus": 3.0, "van": 1.0, "suv": 0.0}) for _ in range(2000)]
    assert drawn.count("bus") / 2000 == pytest.approx(0.75, abs=5 * np.sqrt(0.75 * 0.25 / 2000))
    assert set(drawn) == {"bus", "van"}


def test_shares_of_traffic_sum_to_one() -> None:
    assert sum(f.share for f in FAMILIES.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "mix, message",
    [
        ({"tank": 1.0}, r"unknown families \['tank'\]"),
        ({"bus": 0.0}, "must be >= 0 and not all 0"),
        ({"bus": 2.0, "van": -1.0}, "must be >= 0 and not all 0"),
    ],
)
def test_a_bad_mix_is_an_error(mix: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw_family(rng=np.random.default_rng(0), mix=mix)


def test_an_unknown_family_is_an_error_that_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'tank' is unknown; expected one of \['hatchback'"):
        build("tank", rng=np.random.default_rng(0))


@pytest.mark.parametrize(
    ("family", "ridden"), [*((f, False) for f in FAMILIES), ("motorcycle", True)]
)
def test_repainting_changes_the_paint_and_nothing_else(family: str, ridden: bool):
    design = build(family, rng=np.random.default_rng(1), ridden=ridden)
    copy = design.repainted(rng=np.random.default_rng(2))
    assert not set(copy.paints) & set(design.paints)
    for before, after in zip(design.model, copy.model, strict=True):
        assert before.vertices is after.vertices
        painted = (before.color[:, None] == np.array(design.paints, np.float32)).all(2).any(1)
        changed = (before.color != after.color).any(axis=1)
        np.testing.assert_array_equal(changed, painted)
        assert changed.all() or before.material != "paint"
