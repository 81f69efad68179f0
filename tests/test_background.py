"""Laws of the far background: it joins the modelled ground, and no horizon is empty."""

import numpy as np
import pytest

from simgen.background import (
    BUILDINGS,
    TREE_TRIANGLES,
    _gable,
    _windows,
    countryside,
    skyline,
    square_border,
    terrain_ring,
    tree_line,
)
from simgen.night import LIT_SHARE, glowing

INNER_M, OUTER_M = 250.0, 3000.0


def bumpy(xy):
    return 3 * np.sin(xy[:, 0] / 90) + 2 * np.cos(xy[:, 1] / 70)


def land(seed: int = 0, relief_m: float = 40.0):
    rng = np.random.default_rng(seed)
    return countryside(INNER_M, OUTER_M, bumpy, relief_m=relief_m, rng=rng)


def normals(part):
    a, b, c = part.vertices[part.faces].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def elevation_deg(vertices, eye):
    offset = vertices - eye
    return np.rad2deg(np.arctan2(offset[:, 2], np.linalg.norm(offset[:, :2], axis=1)))


def test_border_runs_once_around_the_square_in_steps_of_ten_metres():
    border = square_border(INNER_M)
    steps = np.linalg.norm(np.diff(border, axis=0, append=border[:1]), axis=1)
    np.testing.assert_allclose(np.abs(border).max(axis=1), INNER_M)
    np.testing.assert_allclose(steps, 10.0)


def test_ring_starts_at_the_height_of_the_modelled_ground():
    part = terrain_ring(land())
    border = square_border(INNER_M)
    first = part.vertices[: len(border)]
    np.testing.assert_allclose(first[:, :2], border)
    np.testing.assert_allclose(first[:, 2], bumpy(border), atol=1e-9)


def test_ring_leaves_the_border_without_a_step():
    part = terrain_ring(land())
    n = len(square_border(INNER_M))
    rise = part.vertices[n : 2 * n, 2] - part.vertices[:n, 2]
    assert np.abs(rise).max() < 2.0


def test_ring_covers_the_world_once_and_faces_up():
    part = terrain_ring(land())
    upward = normals(part)[:, 2] / 2
    assert (upward[upward != 0] > 0).all()
    assert upward.sum() == pytest.approx(4 * (OUTER_M**2 - INNER_M**2))


def test_ring_mesh_follows_the_height_function_between_its_vertices():
    country = land(relief_m=60.0)
    part = terrain_ring(country)
    flat = normals(part)[:, 2] > 0
    middle = part.vertices[part.faces[flat]].mean(axis=1)
    assert np.abs(country.height(middle[:, :2]) - middle[:, 2]).max() < 2.0


def test_hills_grow_with_relief():
    low, high = (terrain_ring(land(relief_m=r)).vertices[:, 2] for r in (20.0, 100.0))
    assert 0.2 * 100 < high.max() < 2 * 100
    assert high.max() > 2 * low.max()


@pytest.mark.parametrize("seed", range(3))
def test_no_horizon_is_empty(seed):
    country = land(seed)
    vertices = tree_line(country, rng=np.random.default_rng(seed)).vertices
    eye = np.array([0.0, 0.0, bumpy(np.zeros((1, 2)))[0] + 1.6])
    azimuth = np.rad2deg(np.arctan2(vertices[:, 1], vertices[:, 0])) % 360
    visible = elevation_deg(vertices, eye) > 0
    assert (np.bincount(azimuth[visible].astype(int) // 2, minlength=180) > 0).all()


def test_far_trees_keep_to_their_budget_and_place():
    country = land()
    part = tree_line(country, rng=np.random.default_rng(0))
    reach = np.abs(part.vertices[:, :2]).max(axis=1)
    assert 0.8 * TREE_TRIANGLES < len(part.faces) <= TREE_TRIANGLES
    assert reach.min() > INNER_M
    above = part.vertices[:, 2] - country.height(part.vertices[:, :2])
    assert np.percentile(above, 0.5) > -10
    assert np.percentile(above, 99.5) < 40


@pytest.mark.parametrize("kind", BUILDINGS)
def test_buildings_stand_on_the_ground_and_look_like_their_size(kind):
    for seed in range(5):
        model = BUILDINGS[kind][0](np.random.default_rng(seed))
        z = np.concatenate([p.vertices[:, 2] for p in model])
        assert z.min() == pytest.approx(0, abs=1e-9)
        assert 5 < z.max() < 170


def test_skyline_is_walls_and_panes_between_near_and_far():
    country = land()
    blocks = skyline(
        rng=np.random.default_rng(0),
        num=12,
        near_m=400.0,
        far_m=2000.0,
        ground_height=country.height,
    )
    middle = np.array([walls.vertices.mean(axis=0) for walls, *_ in blocks])
    distance = np.linalg.norm(middle[:, :2], axis=1)
    foot = np.array([walls.vertices[:, 2].min() for walls, *_ in blocks])
    assert len(blocks) == 12
    assert 350 < distance.min() < distance.max() < 2050
    assert (foot < country.height(middle[:, :2]) + 3).all()
    assert {len(block) for block in blocks} <= {1, 2}
    kinds = {(p.semantic, p.material) for block in blocks for p in block}
    assert kinds == {(11, "matte"), (11, "glass")}


def test_a_share_of_the_skylines_windows_is_lit_at_night():
    rng = np.random.default_rng(0)
    blocks = skyline(rng=rng, num=12, near_m=400.0, far_m=2000.0, ground_height=land().height)
    panes = [p for block in blocks for p in glowing(block, rng=rng) if p.emission is not None]
    lit = np.concatenate([p.emission.any(axis=1) for p in panes])
    assert {p.material for p in panes} == {"glass"}
    assert 0.5 * LIT_SHARE < lit.mean() < 1.5 * LIT_SHARE


def test_gable_roof_is_a_closed_solid_of_the_right_volume():
    part = _gable(np.array([20.0, 10.0, 6.0]), 0.5, np.full(3, 0.2))
    a, b, c = part.vertices[part.faces].swapaxes(0, 1)
    volume = (a * np.cross(b, c)).sum() / 6
    length, width = 20 * 1.03, 10 * 1.08
    assert volume == pytest.approx(length * width * (0.5 * width / 2) / 2)


def test_windows_face_outwards_in_front_of_their_wall():
    size = np.array([20.0, 12.0, 9.0])
    for axis, sign, part in zip(
        (0, 0, 1, 1),
        (1, -1, 1, -1),
        _windows(size, 3.0, 3.0, np.random.default_rng(0)),
        strict=True,
    ):
        assert (sign * normals(part)[:, axis] > 0).all()
        assert (sign * part.vertices[:, axis] > size[axis] / 2).all()
        assert (np.abs(part.vertices[:, 1 - axis]) < size[1 - axis] / 2).all()


def test_an_equal_generator_draws_the_same_country_and_another_does_not():
    first, again, other = (
        tree_line(land(s), rng=np.random.default_rng(s)).vertices for s in (0, 0, 1)
    )
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


def test_albedos_are_physical():
    country = land()
    parts = [terrain_ring(country), tree_line(country, rng=np.random.default_rng(0))]
    for part in parts:
        assert 0.005 < part.color.min() < part.color.max() < 0.6
