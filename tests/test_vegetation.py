"""Laws of the plants: budgets, densities, sizes, colours."""

import cv2
import numpy as np
import pytest

from simgen.mesh import Model, Part
from simgen.vegetation import (
    HEDGE_TRIANGLES_PER_M2,
    NEAR_HEDGE_TRIANGLES,
    NEAR_SHRUB_TRIANGLES,
    NEAR_TREE_TRIANGLES,
    SHRUB_TRIANGLES,
    SPECIES,
    TREE_TRIANGLES,
    _tubes,
    grass_tufts,
    hedge,
    shrub,
    tree,
)

HEIGHT_M = 12.0
PX_PER_M = 20


def grown(species: str, lod: int = 0, seed: int = 0) -> Model:
    return tree(species, height_m=HEIGHT_M, lod=lod, rng=np.random.default_rng(seed))


EYES = np.array([[-9.0, 3.0, 1.7]])


def near(species: str, seed: int = 0) -> Model:
    return tree(species, height_m=HEIGHT_M, lod=0, rng=np.random.default_rng(seed), eyes=EYES)


def longest_edges(part: Part) -> np.ndarray:
    a, b, c = corners(part).swapaxes(0, 1)
    return np.max([np.linalg.norm(e, axis=1) for e in (b - a, c - b, a - c)], axis=0)


def num_triangles(model: Model) -> int:
    return sum(len(p.faces) for p in model)


def corners(part: Part) -> np.ndarray:
    return part.vertices[part.faces]


def area(part: Part) -> float:
    a, b, c = corners(part).swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def side_view(part: Part) -> np.ndarray:
    """Silhouette seen along y, as a mask of 20 px per metre."""
    image = np.zeros((16 * PX_PER_M, 20 * PX_PER_M), np.uint8)
    xz = (corners(part)[:, :, [0, 2]] + [10.0, 1.0]) * PX_PER_M
    for triangle in xz.round().astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 1)
    return image.astype(bool)


@pytest.mark.parametrize("species", SPECIES)
@pytest.mark.parametrize("lod", [0, 1, 2])
def test_trees_fill_their_triangle_budget_and_no_more(species, lod):
    assert num_triangles(grown(species, lod)) == TREE_TRIANGLES[lod]


@pytest.mark.parametrize("species", SPECIES)
def test_a_near_tree_has_the_leaves_of_its_kind_and_the_outline_of_a_far_one(species):
    model, far = near(species), grown(species)
    assert num_triangles(model) <= NEAR_TREE_TRIANGLES
    assert np.median(longest_edges(model[-1])) < 0.8 * np.median(longest_edges(far[-1]))
    spread = [np.percentile(m[-1].vertices, [0, 100], axis=0) for m in (model, far)]
    np.testing.assert_allclose(*spread, atol=0.06 * HEIGHT_M)
    assert 0.7 < side_view(model[-1]).sum() / side_view(far[-1]).sum() < 1.25


def test_near_shrubs_and_hedges_keep_to_their_triangles():
    rng = np.random.default_rng(0)
    assert num_triangles(shrub(rng=rng, lod=0, eyes=EYES)) <= NEAR_SHRUB_TRIANGLES
    (part,) = hedge(14.0, 1.8, 0.8, rng=rng, lod=0, eyes=np.array([[2.0, -4.0, 1.7]]))
    far = HEDGE_TRIANGLES_PER_M2[0] * (2 * 14.8 * 1.8 + 14 * 0.8)
    assert len(part.faces) < 1.1 * NEAR_HEDGE_TRIANGLES + far


def test_leaves_of_a_hedge_are_smallest_where_it_is_nearest():
    eyes = np.array([[-10.0, -3.0, 1.7]])
    (part,) = hedge(24.0, 1.5, 0.7, rng=np.random.default_rng(0), lod=0, eyes=eyes)
    middle = corners(part).mean(axis=1)
    seen = middle[:, 1] < -0.1
    near, far = (seen & (np.abs(middle[:, 0] - x) < 2) for x in (-10.0, 10.0))
    assert np.median(longest_edges(part)[near]) < 0.8 * np.median(longest_edges(part)[far])


@pytest.mark.parametrize("species", SPECIES)
def test_height_is_the_height_asked_for(species):
    for seed in range(4):
        top = max(p.vertices[:, 2].max() for p in grown(species, seed=seed))
        assert top == pytest.approx(HEIGHT_M, rel=0.1)


@pytest.mark.parametrize("species", SPECIES)
def test_trunk_is_rooted_below_the_origin_and_clear_of_leaves(species):
    model = grown(species)
    foot = model[0].vertices[model[0].vertices[:, 2] < 0.2]
    assert foot[:, 2].min() < -0.1
    assert np.linalg.norm(foot[:, :2].mean(axis=0)) < 0.05
    assert model[-1].vertices[:, 2].min() > 0


@pytest.mark.parametrize("species", SPECIES)
def test_levels_of_detail_share_leaf_area_and_outline(species):
    leaves = [grown(species, lod)[-1] for lod in range(3)]
    spread = [np.percentile(p.vertices, [2, 98], axis=0) for p in leaves]
    for coarse in (1, 2):
        assert area(leaves[coarse]) == pytest.approx(area(leaves[0]), rel=0.1)
        np.testing.assert_allclose(spread[coarse], spread[0], atol=0.05 * HEIGHT_M)
        seen = side_view(leaves[coarse]).sum() / side_view(leaves[0]).sum()
        assert 0.8 < seen < 1.25


@pytest.mark.parametrize("species", SPECIES)
def test_sky_shows_through_the_crown_but_does_not_dissolve_it(species):
    crown = side_view(grown(species)[-1])
    hull = np.zeros(crown.shape, np.uint8)
    points = np.argwhere(crown)[:, ::-1].astype(np.int32)
    cv2.fillConvexPoly(hull, cv2.convexHull(points), 1)
    assert 0.3 < crown.sum() / hull.sum() < 0.93


@pytest.mark.parametrize("species", SPECIES)
def test_leaves_are_green_and_vary(species):
    red, green, blue = grown(species)[-1].color.T
    assert 0.03 < np.median(red) < 0.13
    assert 0.07 < np.median(green) < 0.2
    assert 0.015 < np.median(blue) < 0.07
    assert (green > blue).all()
    assert green.std() / green.mean() > 0.15


def test_an_equal_generator_grows_the_same_tree_and_another_does_not():
    first, again, other = grown("birch"), grown("birch"), grown("birch", seed=1)
    for a, b in zip(first, again, strict=True):
        assert a.vertices.tobytes() == b.vertices.tobytes()
    assert not np.allclose(first[-1].vertices, other[-1].vertices)


def test_unknown_species_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"unknown species 'palm'; choose from broadleaf, poplar"):
        tree("palm", height_m=5.0, lod=0, rng=np.random.default_rng(0))


def test_bark_winds_outwards_and_is_measured_in_metres():
    path = np.array([[[0, 0, 0], [0, 0, 1.0], [0, 0, 3.0]]])
    vertices, faces, uv = _tubes(path, np.full((1, 3), 0.2), 32)
    a, b, c = vertices[faces].swapaxes(0, 1)
    outward = ((a + b + c) / 3 * [1, 1, 0] * np.cross(b - a, c - a)).sum(axis=1)
    assert (outward > 0).all()
    assert uv[:, 1].max() == pytest.approx(3.0)
    assert uv[:, 0].max() == pytest.approx(2 * np.pi * 0.2)


@pytest.mark.parametrize("lod", [0, 1, 2])
def test_shrubs_stand_on_the_ground_within_budget(lod):
    for seed in range(5):
        model = shrub(rng=np.random.default_rng(seed), lod=lod)
        bottom, top = model[0].vertices[:, 2].min(), model[0].vertices[:, 2].max()
        assert num_triangles(model) == SHRUB_TRIANGLES[lod]
        assert bottom < 0.25
        assert 0.5 < top < 3.0


@pytest.mark.parametrize("lod", [0, 1, 2])
def test_hedge_keeps_its_box_and_its_leaf_density(lod):
    size = np.array([10.0, 1.0, 1.6])
    (part,) = hedge(size[0], size[2], size[1], rng=np.random.default_rng(0), lod=lod)
    low, high = np.percentile(part.vertices, [1, 99], axis=0)
    slack = (0.25, 0.35, 0.6)[lod]
    np.testing.assert_allclose(low, [-5.0, -0.5, 0.0], atol=slack)
    np.testing.assert_allclose(high, [5.0, 0.5, 1.6], atol=slack)
    faces_m2 = 2 * 11 * 1.6 + 10
    assert (len(part.faces) - 12) / faces_m2 == pytest.approx(HEDGE_TRIANGLES_PER_M2[lod], rel=0.05)


def test_grass_grows_from_where_it_was_sown():
    rng = np.random.default_rng(0)
    xy, z = rng.uniform(-20, 20, (50, 2)), rng.uniform(-1, 1, 50)
    part = grass_tufts(xy, z, rng=rng)
    tufts = part.vertices.reshape(50, -1, 3)
    assert len(part.faces) <= 12 * 50
    assert np.abs(tufts[..., :2] - xy[:, None]).max() < 0.5
    np.testing.assert_allclose(tufts[..., 2].min(axis=1), z - 0.01)
    assert (tufts[..., 2].max(axis=1) - z < 0.4).all()


def test_no_grass_is_an_empty_part():
    assert len(grass_tufts(np.empty((0, 2)), np.empty(0), rng=np.random.default_rng(0)).faces) == 0


def test_plants_are_vegetation_and_grass_is_terrain():
    rng = np.random.default_rng(0)
    plants = [*grown("birch"), *shrub(rng=rng, lod=0), *hedge(3, 1, 1, rng=rng, lod=0)]
    assert {p.semantic for p in plants} == {21}
    assert grass_tufts([[0, 0]], [0], rng=rng).semantic == 22
