"""Normals: round things are shaded round, sharp edges stay sharp, and no vertex moves."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import sphere

from simgen.mesh import Part, box, flat, merged, part, placed, smooth, tube
from simgen.schema import LABELS

BUILDING = LABELS["building"]


def grey(vertices: np.ndarray, faces: np.ndarray) -> Part:
    return part(vertices, faces, "matte", BUILDING, color=(0.5, 0.5, 0.5))


def corners(p: Part) -> np.ndarray:
    return p.vertices[p.faces]


def face_normals(p: Part) -> np.ndarray:
    a, b, c = corners(p).swapaxes(0, 1)
    n = np.cross(b - a, c - a)
    return n / np.linalg.norm(n, axis=1, keepdims=True)


@pytest.fixture(params=["box", "ball", "tube"])
def solid(request: pytest.FixtureRequest) -> Part:
    meshes = {
        "box": lambda: box((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
        "ball": lambda: sphere(2.0, (1.0, 0.0, 0.0), 12),
        "tube": lambda: tube([(0, 0, 0), (1, 1, 3), (1, 2, 5)], (0.5, 0.4, 0.3), sides=12),
    }
    return grey(*meshes[request.param]())


@pytest.mark.parametrize("shade", [smooth, flat])
def test_normals_move_no_corner(shade, solid: Part):
    np.testing.assert_array_equal(corners(shade(solid)), corners(solid))


@pytest.mark.parametrize("shade", [smooth, flat])
def test_normals_are_unit_vectors_on_the_outer_side(shade, solid: Part):
    shaded = shade(solid)
    assert np.linalg.norm(shaded.normals, axis=1) == pytest.approx(1.0, abs=1e-6)
    outward = np.einsum("fk,fck->fc", face_normals(shaded), shaded.normals[shaded.faces])
    assert outward.min() > np.cos(np.deg2rad(50.0))


def test_a_ball_is_shaded_round():
    ball = smooth(grey(*sphere(2.0, (1.0, 0.0, 0.0), 24)))
    radial = (ball.vertices - [1.0, 0.0, 0.0]) / 2.0
    assert np.einsum("ij,ij->i", ball.normals, radial).min() > np.cos(np.deg2rad(3.0))


def test_a_box_keeps_its_edges():
    shaded = smooth(grey(*box((1.0, 2.0, 3.0))))
    expected = np.repeat(face_normals(shaded)[:, None], 3, axis=1)
    np.testing.assert_allclose(shaded.normals[shaded.faces], expected, atol=1e-6)


@pytest.mark.parametrize("fold_deg, shared", [(40.0, True), (60.0, False)])
def test_an_edge_is_a_crease_from_the_stated_angle_on(fold_deg: float, shared: bool):
    """Two square leaves that do not share vertices, only places."""
    c, s = np.cos(np.deg2rad(fold_deg)), np.sin(np.deg2rad(fold_deg))
    flap = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    folded = [(0, 0, 0), (0, 1, 0), (-c, 1, -s), (-c, 0, -s)]
    faces = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
    shaded = smooth(grey(np.array(flap + folded, float), np.array(faces)), crease_deg=50.0)
    hinge = shaded.normals[np.linalg.norm(shaded.vertices, axis=1) < 1e-9]
    assert (np.ptp(hinge, axis=0).max() < 1e-3) == shared


def test_placing_turns_normals_as_it_turns_faces(solid: Part):
    (turned,) = placed([flat(solid)], xyz=(3, 4, 5), heading_rad=0.7, scale=(1, 2, 0.5),
                       normal=(0.2, 0.1, 1.0))  # fmt: skip
    np.testing.assert_allclose(turned.normals[::3], face_normals(turned), atol=1e-6)


def test_merging_gives_flat_normals_to_parts_without():
    ball, cube = smooth(grey(*sphere(1.0, (0, 0, 0), 8))), grey(*box((1, 1, 1)))
    both = merged([ball, cube])
    assert both.normals.shape == both.vertices.shape == both.color.shape
    np.testing.assert_allclose(
        both.normals[both.faces[-12:, 0]], face_normals(both)[-12:], atol=1e-6
    )
