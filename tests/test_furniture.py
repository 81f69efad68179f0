"""Street furniture: sizes, orientation and classes, and the laws of what follows a path."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from simgen import barriers, furniture, pavement, terraces, works
from simgen.mesh import Model, Part, placed
from simgen.schema import LABELS
from simgen.signs import STANDARDS
from simgen.street_solids import bars, turned

_BOARDS = [f"{prefix}_{i}" for prefix in ("board", "billboard", "shop") for i in range(6)]
RECTS = dict.fromkeys([*STANDARDS, *_BOARDS], (0.0, 0.0, 0.5, 0.25))
STRAIGHT = np.array([[0.0, 0.0, 0.0], [48.0, 0.0, 0.0]])
BEND = np.array([[30 * np.sin(a), 30 - 30 * np.cos(a), 0.0] for a in np.linspace(0, 1.5, 60)])


def generator() -> np.random.Generator:
    return np.random.default_rng(5)


SPOTS: dict[str, tuple[int, Callable[[], Model]]] = {
    **{
        f"lamp {name}": (300, lambda name=name: furniture.street_lamp(name, rng=generator()))
        for name in furniture.LAMPS
    },
    **{
        name: (500, lambda build=build: build(rng=generator()))
        for name, build in pavement.CLUTTER.items()
    },
    **{
        name: (900, lambda build=build: build(rng=generator()))
        for name, build in terraces.TERRACE.items()
    },
    "market stall": (2500, lambda: terraces.market_stall(RECTS, rng=generator())),
    "shop board": (200, lambda: terraces.shop_board(RECTS, rng=generator())),
    "barrier board": (300, lambda: works.barrier_board(rng=generator())),
    "excavator": (500, lambda: works.excavator(rng=generator())),
    "soil heap": (300, lambda: works.soil_heap(rng=generator())),
    "signal": (500, lambda: furniture.traffic_signal("red", rng=generator())),
    "signal on arm": (500, lambda: furniture.traffic_signal("red", rng=generator(), reach_m=5)),
    "sign": (500, lambda: furniture.traffic_sign(RECTS, "stop", "street_1", rng=generator())),
    "name post": (500, lambda: furniture.street_name_post(RECTS, rng=generator())),
    "gantry": (1000, lambda: furniture.gantry(RECTS, 14.0, rng=generator())),
    "billboard": (500, lambda: furniture.billboard(RECTS, rng=generator())),
    "delineator": (500, lambda: furniture.delineator(rng=generator())),
    "kilometre post": (500, lambda: furniture.kilometre_post(RECTS, rng=generator())),
    "shelter": (500, lambda: furniture.bus_shelter(RECTS, rng=generator())),
    "column": (500, lambda: furniture.advertising_column(RECTS, rng=generator())),
    "utility pole": (500, lambda: furniture.utility_pole(rng=generator())),
}
LINES: dict[str, Callable[[np.ndarray], Part]] = {
    "guard rail": lambda path: barriers.guard_rail(path, rng=generator()),
    "barrier": lambda path: barriers.concrete_barrier(path, rng=generator()),
    "hoarding": lambda path: barriers.hoarding(path, rng=generator()),
    "noise wall": lambda path: barriers.noise_wall(path, rng=generator()),
    **{
        kind: lambda path, kind=kind: barriers.fence(kind, path, rng=generator())
        for kind in barriers.FENCES
    },
}


@pytest.mark.parametrize("name", SPOTS)
def test_model_keeps_to_its_budget_and_stands_on_the_ground(name: str) -> None:
    budget, build = SPOTS[name]
    model = build()
    assert sum(len(p.faces) for p in model) <= budget
    lowest = min(p.vertices[:, 2].min() for p in model)
    assert -0.4 < lowest <= 0.01


@pytest.mark.parametrize("name", SPOTS)
def test_equal_generators_build_equal_models(name: str) -> None:
    first, second = SPOTS[name][1](), SPOTS[name][1]()
    for p, q in zip(first, second, strict=True):
        np.testing.assert_array_equal(p.vertices, q.vertices)
        np.testing.assert_array_equal(p.color if p.uv is None else p.uv,
                                      q.color if q.uv is None else q.uv)  # fmt: skip


@pytest.mark.parametrize("name", [*SPOTS, *LINES])
def test_albedos_are_physical_and_faces_index_vertices(name: str) -> None:
    model = SPOTS[name][1]() if name in SPOTS else [LINES[name](BEND)]
    for p in model:
        assert 0 <= p.faces.min() <= p.faces.max() < len(p.vertices)
        if p.color is not None:
            assert p.color.shape == p.vertices.shape
            assert 0.0 <= p.color.min() <= p.color.max() <= 0.85


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_turned_solid_winds_outwards_and_has_the_volume_of_a_cone() -> None:
    cone = turned([(1.0, 0.0), (1e-9, 3.0)], (0.5, 0.5, 0.5), sides=200)
    assert _volume(cone.vertices, cone.faces) == pytest.approx(np.pi, rel=1e-3)


def test_bars_face_away_from_their_axes_in_any_direction() -> None:
    rng = generator()
    start, end = rng.normal(size=(2, 40, 3))
    start[0], end[0] = (0, 0, 0), (0, 0, 1)
    vertices, faces = bars(start, end, 0.01)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    bar = faces[:, 0] // 6
    along = (end - start)[bar]
    from_axis = (a + b + c) / 3 - start[bar]
    from_axis -= along * (
        (from_axis * along).sum(1, keepdims=True) / (along**2).sum(1, keepdims=True)
    )
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), from_axis) > 0).all()


# --- lamps, signals, signs -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("design", "num"), [("curved", 1), ("straight", 1), ("double", 2), ("globe", 1)]
)
def test_lamp_heads_move_with_the_lamp(design: str, num: int) -> None:
    lamp = furniture.street_lamp(design, rng=generator())
    heads = furniture.lamp_heads(lamp)
    assert heads.shape == (num, 3)
    assert (heads[:, 2] > 3.0).all()
    moved = furniture.lamp_heads(placed(lamp, xyz=(5, -3, 2), heading_rad=np.pi / 2))
    expected = heads[:, [1, 0, 2]] * (-1, 1, 1) + (5, -3, 2)
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_arm_of_a_lamp_reaches_over_x_and_its_panel_faces_down() -> None:
    for design in ("curved", "straight"):
        lamp = furniture.street_lamp(design, rng=generator())
        (panel,) = (p for p in lamp if p.material == "lamp")
        assert furniture.lamp_heads(lamp)[0, 0] > 1.0
        a, b, c = panel.vertices[panel.faces].transpose(1, 0, 2)
        assert (np.cross(b - a, c - a)[:, 2] < 0).all()


def test_a_signal_is_no_street_lamp() -> None:
    assert furniture.lamp_heads(furniture.traffic_signal("red", rng=generator())).shape == (0, 3)


@pytest.mark.parametrize("reach_m", [0.0, 6.0])
@pytest.mark.parametrize("state", furniture.LENSES)
def test_every_head_of_a_signal_shows_its_state_and_nothing_else(
    state: str, reach_m: float
) -> None:
    signal = furniture.traffic_signal(state, rng=generator(), reach_m=reach_m)
    lit = [
        p for p in signal if p.material == "lamp" and p.color is not None and p.color.max() > 0.3
    ]
    assert len(lit) == (1 if reach_m == 0 else 2)
    for lens in lit:
        np.testing.assert_allclose(lens.color[0], furniture.LENSES[state], rtol=1e-5)


def test_red_is_above_amber_above_green() -> None:
    def height(state: str) -> float:
        signal = furniture.traffic_signal(state, rng=generator())
        (lens,) = (p for p in signal if p.material == "lamp" and p.color.max() > 0.3)
        return float(lens.vertices[:, 2].mean())

    assert height("red") > height("amber") > height("green") > 2.2


def test_signs_hang_above_each_other_in_the_given_order() -> None:
    rects = {"stop": (0.0, 0.0, 0.1, 0.1), "street_0": (0.5, 0.5, 0.9, 0.6)}
    model = furniture.traffic_sign(rects, "stop", "street_0", rng=generator())
    (faces,) = (p for p in model if p.material == "sign")
    is_stop = faces.uv[:, 0] < 0.2
    assert faces.vertices[is_stop, 2].min() > faces.vertices[~is_stop, 2].max() > 1.9
    assert {p.semantic for p in model} == {LABELS["traffic sign"], LABELS["pole"]}


def test_gantry_clears_the_road_that_it_spans() -> None:
    model = furniture.gantry(RECTS, 15.0, rng=generator())
    v = np.concatenate([p.vertices for p in model])
    over_road = np.abs(v[:, 1]) < 7.4
    assert v[over_road, 2].min() > 5.3
    assert np.ptp(v[:, 1]) == pytest.approx(15.8)


def test_advertisements_are_not_traffic_signs() -> None:
    for build in (furniture.billboard, furniture.bus_shelter, furniture.advertising_column):
        assert all(p.semantic != LABELS["traffic sign"] for p in build(RECTS, rng=generator()))


# --- along a path --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "semantic", "per_metre"),
    [("guard rail", 14, 40), ("barrier", 12, 40), ("noise wall", 12, 40), ("mesh", 13, 160),
     ("picket", 13, 160), ("railing", 13, 160)],
)  # fmt: skip
def test_line_has_its_class_and_budget(name: str, semantic: int, per_metre: int) -> None:
    line = LINES[name](STRAIGHT)
    assert line.semantic == semantic
    assert len(line.faces) / 48 <= per_metre


@pytest.mark.parametrize("name", LINES)
def test_line_does_not_depend_on_how_densely_the_path_is_sampled(name: str) -> None:
    dense = np.linspace(STRAIGHT[0], STRAIGHT[1], 301)
    np.testing.assert_allclose(
        LINES[name](dense).vertices, LINES[name](STRAIGHT).vertices, atol=1e-9
    )


@pytest.mark.parametrize("name", LINES)
def test_line_stays_beside_its_path(name: str) -> None:
    v = LINES[name](BEND).vertices
    radius = np.hypot(v[:, 0], v[:, 1] - 30)
    assert np.abs(radius - 30).max() < 0.4


@pytest.mark.parametrize("name", ["barrier", "picket", "mesh", "railing", "noise wall"])
def test_on_a_slope_a_line_is_sheared_and_uprights_stay_upright(name: str) -> None:
    flat = LINES[name](STRAIGHT).vertices
    slope = 0.08
    run = 48.0 * np.cos(np.arctan(slope))  # stations count along the slope: same number of spans
    path = np.array([[0.0, 0.0, 0.0], [run, 0.0, run * slope]])
    steep = LINES[name](path).vertices
    np.testing.assert_allclose(steep[:, 1], flat[:, 1], atol=1e-9)
    offset = steep[:, 2] - slope * steep[:, 0] - flat[:, 2]
    assert np.abs(offset).max() < 0.02
    assert np.abs(steep[:, 0] - flat[:, 0] * run / 48.0).max() < 0.01


def test_beam_of_a_guard_rail_is_on_the_left_of_its_posts() -> None:
    rail = barriers.guard_rail(STRAIGHT, rng=generator())
    beam = rail.vertices[: 25 * len(barriers.W_BEAM)]
    posts = rail.vertices[25 * len(barriers.W_BEAM) :]
    assert beam[:, 1].min() >= 0.0 > posts[:, 1].mean()
    assert beam[:, 2].max() == pytest.approx(0.75)


def test_both_ends_of_a_guard_rail_dip_into_the_ground() -> None:
    v = barriers.guard_rail(STRAIGHT, rng=generator()).vertices
    for end in (0.0, 48.0):
        assert v[np.abs(v[:, 0] - end) < 0.2, 2].max() < 0.1


def test_wire_meets_its_poles_and_sags_by_the_given_share() -> None:
    tops = np.array([[0.0, 0.0, 8.0], [40.0, 0.0, 8.0], [70.0, 30.0, 9.0]])
    v = furniture.wires(tops, sag=0.03).vertices
    for top in tops:
        assert np.linalg.norm(v - top, axis=1).min() < 0.02
    first = v[v[:, 0] < 40.0 - 1e-6]
    assert first[:, 2].min() == pytest.approx(8.0 - 0.03 * 40 - furniture.WIRE_RADIUS_M, abs=2e-3)


def test_wires_of_a_utility_line_hang_on_its_insulators() -> None:
    bases = np.array([[0.0, 0.0, 0.0], [0.0, 40.0, 1.0], [0.0, 80.0, 1.0]])
    line = furniture.utility_line(bases, rng=generator())
    wires = np.concatenate([p.vertices for p in line if p.material == "metal"])
    for base in bases:  # the line runs along +y, so the frame of a pole is turned by 90°
        spots = base + furniture.WIRE_SPOTS[:, [1, 0, 2]] * (-1, 1, 1)
        for spot in spots:
            assert np.linalg.norm(wires - spot, axis=1).min() < 0.02


# --- bad input -----------------------------------------------------------------------------------


def test_unknown_names_are_refused_with_the_choices() -> None:
    with pytest.raises(ValueError, match=r"street_lamp: unknown design 'gas'; choose from curved"):
        furniture.street_lamp("gas", rng=generator())
    with pytest.raises(ValueError, match=r"fence: unknown kind 'laser'; choose from picket"):
        barriers.fence("laser", STRAIGHT, rng=generator())
    with pytest.raises(ValueError, match=r"traffic_signal: unknown state 'blue'; choose from red"):
        furniture.traffic_signal("blue", rng=generator())


def test_path_of_one_point_or_in_the_plane_is_refused() -> None:
    with pytest.raises(ValueError, match=r"path has shape \(1, 3\), expected \(N, 3\)"):
        barriers.guard_rail([[0, 0, 0]], rng=generator())
    with pytest.raises(ValueError, match=r"path has shape \(2, 2\), expected \(N, 3\)"):
        barriers.noise_wall([[0, 0], [1, 0]], rng=generator())
