"""Laws of the sign atlas and of the sheets cut from it."""

from __future__ import annotations

from collections import Counter
from itertools import combinations
from typing import get_args

import numpy as np
import pytest

from simgen.mesh import Part
from simgen.schema import LABELS
from simgen.signs import _OUTLINES, LIMITS, STANDARDS, Shape, SignAtlas, face, sign_atlas

SHAPES = get_args(Shape)
ATLAS = sign_atlas(rng=np.random.default_rng(0))
RED, WHITE = (1, 0, 0), (1, 1, 1)


def cell(name: str, atlas: SignAtlas = ATLAS) -> np.ndarray:
    u0, v0, u1, v1 = (round(2048 * c) for c in atlas.rects[name])
    return atlas.image[v0:v1, u0:u1].astype(int)


def channels_lit(image: np.ndarray, threshold: int = 110) -> np.ndarray:
    """Which of red, green, blue are bright: (1, 1, 1) is white, (1, 0, 0) red."""
    return (image > threshold).astype(int)


def is_white(name: str) -> np.ndarray:
    return (cell(name) > 150).all(axis=2)


def normals(part: Part) -> np.ndarray:
    a, b, c = part.vertices[part.faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def test_every_promised_cell_is_there() -> None:
    series = {"street": 8, "board": 6, "shop": 16, "billboard": 6, "km": 4}
    assert {f"{name}_{i}" for name, num in series.items() for i in range(num)} <= set(ATLAS.rects)
    assert set(STANDARDS) <= set(ATLAS.rects)
    assert {f"limit_{v}" for v in range(30, 130, 10)} <= set(STANDARDS)


def test_cells_lie_on_the_sheet_and_do_not_overlap() -> None:
    rects = np.array(list(ATLAS.rects.values()))
    assert rects.min() > 0
    assert rects.max() < 1
    for a, b in combinations(rects, 2):
        assert (np.maximum(a[:2], b[:2]) >= np.minimum(a[2:], b[2:])).any()


def test_an_equal_generator_prints_the_same_sheet_and_another_does_not() -> None:
    again, other = (sign_atlas(rng=np.random.default_rng(seed)) for seed in (0, 1))
    assert again.image.tobytes() == ATLAS.image.tobytes()
    assert other.rects == ATLAS.rects
    assert (other.image != ATLAS.image).mean() > 0.3


def test_cells_are_printed_in_the_proportions_of_their_signs() -> None:
    for name, kind in STANDARDS.items():
        height, width = cell(name).shape[:2]
        if kind.shape == "rect":
            assert width / height == pytest.approx(kind.width_m / kind.height_m, rel=0.03)
        else:
            assert width == height


def test_weather_fades_colours_but_never_brightens_them() -> None:
    assert ATLAS.image.max() <= 226
    assert 160 < np.median(cell("limit_50")[is_white("limit_50")]) < 226


@pytest.mark.parametrize("name", [f"limit_{v}" for v in LIMITS])
def test_limit_is_a_red_ring_around_a_pale_field(name: str) -> None:
    size = len(cell(name))
    angle = np.linspace(0, 2 * np.pi, 40)
    ring = np.stack([np.sin(angle), np.cos(angle)]) * 0.47 * size + size / 2
    rows, columns = ring.astype(int)
    assert (channels_lit(cell(name)[rows, columns]) == RED).all()
    assert is_white(name)[size // 2, [round(0.15 * size), round(0.85 * size)]].all()


def test_no_two_limits_look_the_same() -> None:
    for a, b in combinations(LIMITS, 2):
        differs = is_white(f"limit_{a}") != is_white(f"limit_{b}")
        assert differs.mean() > 0.01


def test_priority_road_shows_a_yellow_diamond_in_a_white_one() -> None:
    image = cell("priority")
    assert (channels_lit(image[100, [100, 40, 160]]) == (1, 1, 0)).all()
    assert (channels_lit(image[100, [12, 188]]) == WHITE).all()


def test_arrows_point_where_they_should() -> None:
    rows, columns = np.indices(is_white("ahead_only").shape)
    inside = np.hypot(rows - 100, columns - 100) < 88
    for name, toward in (("ahead_only", 100 - rows), ("keep_right", rows + columns - 200)):
        arrow = is_white(name) & inside
        assert toward[arrow].mean() > 4  # the head is heavier than the tail
    black = (cell("curve_left") < 60).all(axis=2)
    assert columns[black & (rows < 110)].mean() < columns[black & (rows > 150)].mean() - 10


def test_names_keep_clear_of_the_edges_of_their_plates() -> None:
    for i in range(8):
        image = cell(f"street_{i}")
        for margin in (image[25:100, 12:20], image[25:100, -20:-12]):
            assert margin.std(axis=(0, 1)).max() < 12
        assert image[25:100, 20:-20].std() > 25


@pytest.mark.parametrize("shape", SHAPES)
def test_face_has_the_size_asked_for_and_looks_ahead(shape: Shape) -> None:
    front, back = face((0.0, 0.0, 1.0, 1.0), 0.8, 0.6, shape)
    np.testing.assert_allclose(np.ptp(front.vertices, axis=0), [0, 0.8, 0.6], atol=0.01)
    assert (normals(front)[:, 0] > 0).all()
    assert (front.material, front.semantic) == ("sign", LABELS["traffic sign"])
    assert (back.material, back.semantic) == ("metal", LABELS["traffic sign"])
    assert back.vertices[:, 0].max() <= 0


@pytest.mark.parametrize("shape", SHAPES)
def test_front_and_back_enclose_the_sheet(shape: Shape) -> None:
    """Every edge is passed once in each direction, so there is no hole and no flipped face."""
    edges: Counter[tuple[bytes, bytes]] = Counter()
    for part in face((0.0, 0.0, 1.0, 1.0), 0.8, 0.6, shape):
        keys = [(v + 0.0).round(6).tobytes() for v in part.vertices]  # + 0.0: −0 is 0
        edges.update((keys[f[i]], keys[f[i - 1]]) for f in part.faces for i in range(3))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)


@pytest.mark.parametrize("shape", SHAPES)
def test_print_reads_from_left_to_right_and_top_to_bottom(shape: Shape) -> None:
    """Someone in front of the sign has +y on the right; v grows down the image."""
    u0, v0, u1, v1 = rect = (0.25, 0.5, 0.5, 0.75)
    front, _ = face(rect, 2.0, 1.0, shape)
    _, y, z = front.vertices.T
    expected = np.stack([u0 + (u1 - u0) * (y + 1) / 2, v1 - (v1 - v0) * (z + 0.5)], axis=1)
    np.testing.assert_allclose(front.uv, expected, atol=1e-6)


def test_outlines_wind_counter_clockwise_and_fit_the_cell() -> None:
    for outline in _OUTLINES.values():
        ahead = np.roll(outline, -1, axis=0)
        assert (outline[:, 0] * ahead[:, 1] - outline[:, 1] * ahead[:, 0]).sum() > 0
        assert np.abs(outline).max() < 1.0001
