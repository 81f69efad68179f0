"""Ground truth of hand-made scenes: against closed forms and float64 ray casting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import (
    Triangles,
    camera,
    inside_frame,
    parallelogram,
    pixel_rays,
    scene_of,
    seen_at,
    sphere,
)

from simgen import groundtruth as gt
from simgen.mesh import part
from simgen.schema import AT_INFINITY, GLASS, LABELS, OCCLUDED, OUT_OF_FRAME, VISIBLE

pytestmark = pytest.mark.usefixtures("mitsuba_active")

TURNS_DEG = [(0, 0, 0), (4, -7, 11), (-15, 20, -160)]
EYE = np.array([0.4, 0.3, 1.7])


def depth_of(scene, cam):
    return gt.depth(gt.look(scene, cam)).astype(np.float64)


def status_of(scene, source, target):
    return gt.flow_status(scene, gt.look(scene, source), gt.look(scene, target))


def flow_to(left, right, distance):
    """Flow (H, W, 2) of pixels whose rays end after ``distance`` times a ray of z-depth 1."""
    w, h = left.wh
    points = left.centre + pixel_rays(left) * np.reshape(distance, (-1, 1))
    uv = seen_at(right, points)[0].reshape(h, w, 2)
    return uv - np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1)


def relative(measured, true):
    return measured.ravel() / np.ravel(true) - 1


# --- depth and flow ---------------------------------------------------------------------------


@pytest.mark.parametrize("turn_deg", TURNS_DEG)
def test_inside_a_sphere_depth_and_flow_agree_with_ray_casting(turn_deg, worst):
    vertices, faces = sphere(10.0, (0.3, -0.2, 0.1), 16)
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    left = camera((1.0, 2.4, 0.5), turn_deg, off_centre_px=(5.3, -2.1))
    right = camera((1.5, 1.0, 0.2), np.add(turn_deg, (1, -2, 3)))
    true, _ = Triangles.of(vertices, faces).first(left.centre, pixel_rays(left))
    depth = gt.depth(gt.look(scene, left))
    worst("depth in a sphere, by ray casting", relative(depth, true), 1e-5, "relative")
    flow, expected = gt.flow(depth, left, right), flow_to(left, right, true)
    ahead = np.linalg.norm(expected, axis=-1) < 1000
    assert ahead.mean() > 0.5
    worst("flow in a sphere, by ray casting", (flow - expected)[ahead], 1e-3)


def test_inside_a_sphere_depth_is_the_spheres_within_its_tessellation(worst):
    centre, radius, num = np.array([0.3, -0.2, 0.1]), 10.0, 60
    vertices, faces = sphere(radius, centre, num)
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    cam = camera(centre, (10, 20, 30))
    rays = pixel_rays(cam)
    short = 1 - depth_of(scene, cam).ravel() * np.linalg.norm(rays, axis=1) / radius
    sagitta = 1 - np.cos(np.pi / (2 * num)) ** 2
    assert short.min() > -1e-6
    worst("depth in a sphere, closed form", short, 1.01 * sagitta, "relative")


@pytest.mark.parametrize("distance_m", [7.0, 1000.0])
@pytest.mark.parametrize("slant", [(0.0, 0.0), (-0.3, 0.2)])
@pytest.mark.parametrize("turn_deg", TURNS_DEG)
def test_a_wall_has_the_depth_and_flow_of_its_plane(turn_deg, slant, distance_m, worst):
    left = camera(EYE, turn_deg, off_centre_px=(3.7, 1.2))
    right = camera(EYE - [0.1, 0.8, -0.05], np.add(turn_deg, (1, -2, 0.5)))
    in_plane = left.T_world_cam[:3, :3] @ np.array([[1, 0], [0, 1], [-slant[0], -slant[1]]])
    middle = EYE + distance_m * left.T_world_cam[:3, 2]
    a, b = 8 * distance_m * in_plane.T
    scene = scene_of([parallelogram(middle - (a + b) / 2, a, b)])
    normal = np.cross(a, b)
    true = normal @ (middle - EYE) / (pixel_rays(left) @ normal)
    depth = gt.depth(gt.look(scene, left))
    worst("depth of a wall, closed form", relative(depth, true), 1e-5, "relative")
    error = gt.flow(depth, left, right) - flow_to(left, right, true)
    worst("flow of a wall, closed form", error, 1e-3)


def test_a_wall_ahead_of_a_rectified_pair_moves_by_focal_length_times_baseline_over_depth(worst):
    scene = scene_of([parallelogram((20, -90, -90), (0, 180, 0), (0, 0, 180))])
    left, right = camera((0, 0.4, 0)), camera((0, -0.4, 0))
    flow = gt.flow(gt.depth(gt.look(scene, left)), left, right)
    worst("flow -f B / Z", flow - [-48 * 0.8 / 20, 0.0], 1e-5)


@pytest.mark.parametrize("roll_deg", [0.0, 2.0])
def test_the_road_keeps_its_depth_to_a_kilometre_at_grazing_incidence(roll_deg, worst):
    scene = scene_of([parallelogram((-9, -900, 0), (2000, 0, 0), (0, 1800, 0), label="road")])
    left = camera((0.1, 0.8, 1.7), (0.3, 0.2, roll_deg), f_px=2000.0)
    right = camera((0.1, -0.8, 1.7), (0.1, -0.3, -roll_deg), f_px=2000.0)
    down = -pixel_rays(left)[:, 2]
    true = np.divide(1.7, down, where=down > 0, out=np.zeros_like(down))
    road = (true > 0) & (true < 1500)
    assert true[road].max() > 1000
    depth = gt.depth(gt.look(scene, left))
    worst("depth of the road to 1 km", relative(depth.ravel()[road], true[road]), 1e-5, "relative")
    error = gt.flow(depth, left, right) - flow_to(left, right, np.where(road, true, 1.0))
    worst("flow of the road to 1 km", error.reshape(-1, 2)[road], 1e-3)


def test_depth_is_along_the_axis_and_not_along_the_ray():
    scene = scene_of([parallelogram((5, -50, -50), (0, 100, 0), (0, 0, 100))])
    np.testing.assert_allclose(depth_of(scene, camera()), 5.0, rtol=1e-6)


def test_no_ray_slips_through_the_edges_of_a_closed_surface():
    vertices, faces = sphere(10.0, (0, 0, 0), 50)
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    rng = np.random.default_rng(0)
    a, b = vertices[faces[:, 0]], vertices[faces[:, 1]]
    for _ in range(4):
        eye = rng.uniform(-5, 5, 3)
        onto_edges = a + rng.random((len(a), 1)) * (b - a) - eye
        seen = gt.trace(scene, eye, onto_edges.astype(np.float32).T)
        assert (seen == gt.NO_FACE).sum() == 0


# --- visibility -------------------------------------------------------------------------------

NEAR_X, FAR_X = 10.0, 30.0
NEAR_Y, NEAR_Z = (-2.0, 2.5), (0.5, 2.75)


def two_planes():
    """A board before a wall."""
    (y0, y1), (z0, z1) = NEAR_Y, NEAR_Z
    board = parallelogram((NEAR_X, y0, z0), (0, y1 - y0, 0), (0, 0, z1 - z0))
    return scene_of([board, parallelogram((FAR_X, -200, -200), (0, 400, 0), (0, 0, 400))])


def through_board(centre, directions):
    q = centre + directions * ((NEAR_X - centre[0]) / directions[:, :1])
    y_inside = (NEAR_Y[0] <= q[:, 1]) & (q[:, 1] <= NEAR_Y[1])
    return y_inside & (NEAR_Z[0] <= q[:, 2]) & (q[:, 2] <= NEAR_Z[1])


def two_planes_status(source, target, shift_px):
    """Closed form of flow_status with the pixel centres moved by ``shift_px``."""
    rays = pixel_rays(source, shift_px)
    on_board = through_board(source.centre, rays)
    x = np.where(on_board, NEAR_X, FAR_X)
    points = source.centre + rays * ((x - source.centre[0]) / rays[:, 0])[:, None]
    hidden = ~on_board & through_board(target.centre, points - target.centre)
    inside = inside_frame(target, *seen_at(target, points))
    return np.where(inside, np.where(hidden, OCCLUDED, VISIBLE), OUT_OF_FRAME)


def where_settled(status_at, margin_px):
    """An oracle's status per pixel, and whether it is the same all around the pixel centre."""
    steps = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
    status = np.stack([status_at(np.multiply(s, margin_px)) for s in steps])
    return status[0], (status == status[0]).all(axis=0)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (2, -3, 8), (-4, 9, -120)])
def test_occlusion_and_frame_borders_lie_where_geometry_puts_them(turn_deg, reverse):
    pair = [
        camera((0, 0.6, 1.6), turn_deg, f_px=90.0, off_centre_px=(4, -3)),
        camera((0.2, -0.9, 1.4), np.add(turn_deg, (1, 2, -2)), f_px=80.0),
    ]
    source, target = pair[::-1] if reverse else pair
    status = status_of(two_planes(), source, target).ravel()
    expected, settled = where_settled(lambda s: two_planes_status(source, target, s), 1e-3)
    assert set(expected) == {VISIBLE, OCCLUDED, OUT_OF_FRAME}
    assert settled.mean() > 0.99
    np.testing.assert_array_equal(status[settled], expected[settled])


def brute_force_status(triangles, source, target, shift_px, tolerance):
    """flow_status by ray casting; a blocker counts if it is nearer by ``tolerance`` (relative)."""
    rays = pixel_rays(source, shift_px)
    t, own = triangles.first(source.centre, rays)
    sky = np.isinf(t)
    points = source.centre + rays * np.where(sky, 1.0, t)[:, None]
    towards = np.where(sky[:, None], rays, points - target.centre)
    inside = inside_frame(target, *seen_at(target, target.centre + towards))
    crossing = triangles.crossings(target.centre, towards)
    crossing[~sky, own[~sky]] = np.inf
    nearest = crossing.min(axis=1)
    hidden = np.where(sky, np.isfinite(nearest), nearest < 1 - tolerance)
    seen = np.where(hidden, OCCLUDED, VISIBLE)
    return np.where(inside, seen, OUT_OF_FRAME) + AT_INFINITY * sky


def soup():
    """A few hundred triangles that pierce each other, and sky between them."""
    rng = np.random.default_rng(3)
    middle = rng.uniform([4, -9, -7], [20, 9, 7], (300, 1, 3))
    corners = middle + rng.normal(scale=0.8, size=(300, 3, 3))
    return corners.reshape(-1, 3), np.arange(900).reshape(-1, 3)


def hills():
    """Rolling ground, seen at grazing incidence."""
    x, y = np.meshgrid(np.linspace(1, 100, 40), np.linspace(-30, 30, 9), indexing="ij")
    z = 1.2 * np.sin(x / 4) * np.cos(y / 9)
    i, j = np.meshgrid(np.arange(39) * 9, np.arange(8), indexing="ij")
    k = (i + j).ravel()
    faces = np.concatenate([np.c_[k, k + 9, k + 10], np.c_[k, k + 10, k + 1]])
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), faces


@pytest.mark.parametrize("mesh", [soup, hills])
@pytest.mark.parametrize("reverse", [False, True])
def test_visibility_agrees_with_ray_casting_but_at_edges(mesh, reverse):
    vertices, faces = mesh()
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    pair = [
        camera((0, 2.0, 1.7), (1, 2, 3), wh=(24, 18), f_px=18.0),
        camera((2, -4.0, 1.7), (-2, 1, 5), wh=(24, 18), f_px=19.0),
    ]
    source, target = pair[::-1] if reverse else pair
    triangles = Triangles.of(vertices, faces)
    strict, lenient = (
        where_settled(lambda s, t=t: brute_force_status(triangles, source, target, s, t), 1e-4)
        for t in (1e-7, 1.1 * gt.SAME_SURFACE_REL)
    )
    settled = strict[1] & lenient[1] & (strict[0] == lenient[0])
    status = status_of(scene, source, target).ravel()
    assert settled.mean() > 0.98
    np.testing.assert_array_equal(status[settled], strict[0][settled])
    assert {VISIBLE, OCCLUDED} <= set(status & 7)


def test_a_wall_does_not_hide_itself_where_its_triangles_meet():
    """Pixel centres of both cameras lie exactly on edges and corners of the wall's triangles."""
    y, z = np.meshgrid(np.arange(-30.0, 31), np.arange(-20.0, 21), indexing="ij")
    i, j = np.meshgrid(np.arange(60) * 41, np.arange(40), indexing="ij")
    k = (i + j).ravel()
    faces = np.concatenate([np.c_[k, k + 41, k + 42], np.c_[k, k + 42, k + 1]])
    vertices = np.stack([np.full_like(y, 16.0), y, z], axis=-1)
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    left, right = camera((0, 1, 0), wh=(65, 49)), camera((0, -1, 0), wh=(65, 49))
    expected = np.where(np.arange(65) < 2 * 48 / 16, OUT_OF_FRAME, VISIBLE)
    np.testing.assert_array_equal(status_of(scene, left, right), np.tile(expected, (49, 1)))


def test_one_centre_hides_nothing():
    vertices, faces = soup()
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    left, right = camera(EYE, (3, 1, 2)), camera(EYE, (-8, 15, 40))
    status = status_of(scene, left, right)
    assert set(np.unique(status & 7)) == {VISIBLE, OUT_OF_FRAME}


def test_pure_rotation_flow_is_the_infinite_homography_whatever_the_depth(worst):
    vertices, faces = soup()
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    left, right = camera(EYE, (3, 1, 2)), camera(EYE, (-8, 5, 4), off_centre_px=(3, 4))
    flow = gt.flow(gt.depth(gt.look(scene, left)), left, right)
    worst("flow of a pure rotation", flow - flow_to(left, right, 1.0), 1e-3)


def test_a_camera_sees_all_of_its_own_view():
    vertices, faces = hills()
    scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
    cam = camera((0, 0, 1.7), (1, 2, 3))
    assert set(np.unique(status_of(scene, cam, cam))) == {VISIBLE, VISIBLE | AT_INFINITY}


@pytest.mark.parametrize(
    "shift_px, first_in, last_in", [(-2.5, 2, 95), (-2.25, 2, 95), (2.5, 0, 92), (2.25, 0, 93)]
)
def test_the_frame_includes_its_left_edge_and_excludes_its_right_edge(shift_px, first_in, last_in):
    """Two cameras in one place, whose principal points differ by a binary fraction: exact."""
    scene = scene_of([])
    across, down = camera(f_px=64.0, off_centre_px=(shift_px, 0)), (0, shift_px)
    (row, *_) = status_of(scene, camera(f_px=64.0), across)
    inside = np.flatnonzero(row == VISIBLE | AT_INFINITY)
    assert (inside[0], inside[-1]) == (first_in, last_in)
    status = status_of(scene, camera(f_px=64.0), camera(f_px=64.0, off_centre_px=down))
    inside = np.flatnonzero(status[:, 0] == VISIBLE | AT_INFINITY)
    assert (inside[0], inside[-1]) == (first_in, last_in - 96 + 64)


@pytest.mark.parametrize(
    "scene_parts", [[], [parallelogram((9, -50, -50), (0, 99, 0), (0, 0, 99))]]
)
def test_views_that_share_nothing_are_out_of_frame(scene_parts):
    """No ray is cast at all: an empty batch is not an error."""
    status = status_of(scene_of(scene_parts), camera(), camera(turn_deg=(0, 180, 0)))
    assert (status & 7 == OUT_OF_FRAME).all()


# --- sky, glass, ids --------------------------------------------------------------------------


def test_the_sky_has_no_depth_its_own_label_and_the_flow_of_infinity(worst):
    scene = scene_of([])
    left, right = camera((0, 0.8, 1.6), (1, 2, 3)), camera((0, -0.8, 1.6), (-2, 1, 0))
    view = gt.look(scene, left)
    depth = gt.depth(view)
    assert (depth == 0).all()
    assert (gt.semantic(view, scene.faces) == LABELS["sky"]).all()
    assert (gt.instance(view, scene.faces) == 0).all()
    assert set(np.unique(status_of(scene, left, right))) == {
        VISIBLE | AT_INFINITY, OUT_OF_FRAME | AT_INFINITY,
    }  # fmt: skip
    far = flow_to(left, right, 1e13)
    worst("flow of the sky, as a point at 1e13 m", gt.flow(depth, left, right) - far, 1e-3)


def test_sky_that_a_near_object_hides_from_the_other_camera_is_occluded():
    post = parallelogram((4, -0.9, -9), (0, 0.2, 0), (0, 0, 18), label="pole")
    left, right = camera((0, 0.8, 0)), camera((0, -0.8, 0))
    status = status_of(scene_of([post]), left, right)
    u = np.arange(96)
    angle = (47.5 - u) / 48  # tangent to the left, in both cameras for the sky
    y = 4 * angle  # of the ray where the post stands, from each camera
    hidden = (y > -0.9 + 0.8) & (y < -0.7 + 0.8)
    on_post = (y > -0.9 - 0.8) & (y < -0.7 - 0.8)
    expected = np.where(hidden, OCCLUDED | AT_INFINITY, VISIBLE | AT_INFINITY)
    expected[on_post] = VISIBLE
    assert hidden.any()
    np.testing.assert_array_equal(status, np.broadcast_to(expected, status.shape))


def test_glass_is_flagged_whether_or_not_it_is_seen():
    pane = parallelogram((6, -1, -9), (0, 9, 0), (0, 0, 18), material="glass")
    wall = parallelogram((9, -90, -90), (0, 180, 0), (0, 0, 180))
    source = camera((0, 0.8, 0))
    target = camera((0, -0.8, 0), wh=(40, 40))
    scene = scene_of([pane, wall])
    status = status_of(scene, source, target)
    is_pane = gt.depth(gt.look(scene, source)) < 7
    np.testing.assert_array_equal(status & GLASS != 0, is_pane)
    assert set(np.unique(status[is_pane])) == {VISIBLE | GLASS, OUT_OF_FRAME | GLASS}


def board(material, distance, y, z, size, label, instance):
    """A rectangle across the view: ``y, z, size`` as tangents of angles from the origin."""
    (width, height) = size
    corners = [(1, y, z), (1, y + width, z), (1, y + width, z + height), (1, y, z + height)]
    vertices, faces = distance * np.array(corners), [[0, 1, 2], [0, 2, 3]]
    uv, color = np.zeros((4, 2)), (0.5, 0.5, 0.5)
    return replace(part(vertices, faces, material, label, color=color, uv=uv), instance=instance)


def test_every_material_keeps_its_ids_and_depth_through_the_merge():
    """20 boards side by side, near and far, each of its own label and id; two ground maps below."""
    materials = [
        "matte",
        "leaf",
        "paint",
        "metal",
        "glass",
        "lamp",
        "sign",
        "bark",
        "roof",
        "wall_0",
    ]
    labels = np.array(sorted(set(LABELS.values()))[1:21])
    distances = np.array([5.0 + i for i in range(10)] + [80.0 + i for i in range(10)])
    boards = [
        board(material, distances[i], 0.1 * i - 1, 0.0, (0.1, 0.5), labels[i], i + 1)
        for i, material in enumerate(materials * 2)
    ]
    ground = [
        board("ground", 50.0, -1.0, -0.5, (1.0, 0.5), LABELS["road"], 0),
        board("ground", 50.0, 0.0, -0.5, (1.0, 0.5), LABELS["sidewalk"], 0),
    ]
    scene = scene_of(boards, ground)
    view = gt.look(scene, camera())
    v, u = np.mgrid[:64, :96]
    y, z = (47.5 - u) / 48, (31.5 - v) / 48
    i = np.floor(10 * (y + 1)).astype(int)
    on_board, on_ground = (z > 0) & (z < 0.5), (z < 0) & (z > -0.5)
    ground_label = np.where(y < 0, LABELS["road"], LABELS["sidewalk"])
    label = np.where(on_board, labels[i], np.where(on_ground, ground_label, LABELS["sky"]))
    np.testing.assert_array_equal(gt.instance(view, scene.faces), np.where(on_board, i + 1, 0))
    np.testing.assert_array_equal(gt.semantic(view, scene.faces), label)
    depth = np.where(on_board, distances[i], np.where(on_ground, 50.0, 0.0))
    np.testing.assert_allclose(gt.depth(view), depth, rtol=1e-6)


def test_the_same_scene_gives_the_same_bytes():
    vertices, faces = soup()
    both = []
    for _ in range(2):
        scene = scene_of([part(vertices, faces, "matte", LABELS["wall"], color=(0.5, 0.5, 0.5))])
        view = gt.look(scene, camera(EYE, (3, 1, 2)))
        both.append((gt.depth(view).tobytes(), view.face.tobytes()))
    assert both[0] == both[1]
