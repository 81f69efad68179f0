"""Surfaces that are seen show places of their sheets that no other one shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from test_ground import make_spec

from simgen import groundtruth, scene, world
from simgen.facades import (
    drawn_openings,
    drawn_style,
    joints,
    panelled,
    plain_surface,
    wall_surface,
    walls_of,
)
from simgen.ground import Optics
from simgen.massing import KINDS, Massing
from simgen.places import CELL_M, CELLS, Places, _box_sums, cells_of
from simgen.rig import Camera
from simgen.roads import Surface
from simgen.sheets import RISE_M, WALL_M
from simgen.solids import upright

Array = NDArray[np.float64]
WH = (320, 180)
APART_M = 3.0
SPOT_M = 0.2
FACING = upright((12.0, 0.0, 0.0), (-1.0, 0.0))


def deal(seed: int = 0) -> Places:
    return Places(np.zeros((1, 2)), rng=np.random.default_rng(seed))


def test_sums_over_boxes_go_on_around_the_borders() -> None:
    cells = np.random.default_rng(0).random((2, 6, 6))
    for h, w in ((1, 1), (2, 5), (6, 6), (6, 1)):
        tiled = np.tile(cells, (1, 2, 2))
        expected = [[[tiled[k, i : i + h, j : j + w].sum() for j in range(6)] for i in range(6)]
                    for k in range(2)]  # fmt: skip
        np.testing.assert_allclose(_box_sums(cells, (h, w)), expected)


def test_no_spot_of_a_sheet_is_shown_twice_before_all_of_it_is_shown() -> None:
    places, shown = deal(), np.zeros((2, CELLS, CELLS), int)
    side = 8.0
    for _ in range(2 * int(WALL_M / side) ** 2):
        place = places.take("wall_0", FACING, (0.0, 0.0, side, side))
        xy = np.stack(np.meshgrid(*[(np.arange(10) + 0.5) * CELL_M] * 2), axis=-1)
        u, v = (np.floor(place.uv(xy) / CELL_M).astype(int) % CELLS).transpose(2, 0, 1)
        shown[int(place.mirrored), v, u] += 1
    assert shown.max() == 1  # squares of a quarter pave it if they are laid edge to edge


def test_a_place_holds_its_whole_rectangle_wherever_that_begins() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        places = deal(int(rng.integers(1000)))
        low, size = rng.uniform(-3, 3, 2), rng.uniform(1, 12, 2)
        place = places.take("wall_0", FACING, [*low, *(low + size)], phase=int(rng.integers(4)))
        uv = place.uv(low + rng.random((500, 2)) * size) / CELL_M
        u, v = np.floor(uv - 1e-9).astype(int).T % CELLS
        assert (places._taken["wall_0"][int(place.mirrored), v, u] > 0).all()


@pytest.mark.parametrize("kind", ["office", "warehouse", "apartments"])
def test_courses_go_on_from_panel_to_panel_and_round_corners(kind: str) -> None:
    footprint = np.array([[0.0, 0], [70, 0], [70, 20], [0, 20]])
    block = Massing(footprint, 0.0, 45.0, "flat", 0.0, 0.0, kind, 0)
    style = drawn_style(KINDS[kind], ["wall_0"], rng=np.random.default_rng(0))
    walls = [panelled(w, style, deal()) for w in walls_of(block, KINDS[kind], 0.5)]
    assert len(walls[0].panels.x) > 5
    assert len(walls[0].panels.y) > (3 if kind != "warehouse" else 1)
    v = np.array([p.v for w in walls for row in w.panels.places for p in row])
    steps = (v - v[0]) / RISE_M
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    starts = [p.u for row in walls[0].panels.places for p in row]
    assert len(set(starts)) > len(starts) / 2


def test_cutting_a_wall_changes_neither_its_area_nor_its_plane() -> None:
    rng = np.random.default_rng(4)
    block = Massing(np.array([[0.0, 0], [60, 0], [60, 15], [0, 15]]), 0.0, 40.0, "flat", 0.0, 0.0,
                    "office", 0)  # fmt: skip
    style = drawn_style(KINDS["office"], ["wall_0"], rng=rng)
    for wall in walls_of(block, KINDS["office"], 0.5):
        openings = drawn_openings(wall, KINDS["office"], style, rng=rng)
        cut = panelled(wall, style, deal())
        assert joints(cut, style)
        for whole, parts in (
            (wall_surface(wall, style, openings), wall_surface(cut, style, openings)),
            (plain_surface(wall, style), plain_surface(cut, style)),
        ):
            assert len(parts.faces) >= len(whole.faces)
            areas = [_areas(p.vertices[p.faces]).sum() for p in (whole, parts)]
            assert areas[1] == pytest.approx(areas[0])
            z = (parts.vertices - wall.frame.origin) @ wall.frame.axes[2]
            assert np.abs(z).max() < 1e-9


def _areas(triangles: Array) -> Array:
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


# --- whole scenes -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Seen:
    """What the middle of a rig sees of a scene."""

    parts: list[tuple[str, Surface, NDArray[np.int64], Array]]
    """of each surface in view its slot, itself, and faces (N,) and points (N, 3) of its pixels"""


@cache
def look_at(recipe: str, number: int) -> Seen:
    """Built once, for both tests."""
    spec = make_spec(recipe, number)
    drive = world.drive(spec, 0)
    built = world.build(spec, drive, Optics(focal_px=160.0, hfov_rad=np.pi / 2, nearest_m=2.5))
    w, h = WH
    K = np.array([[160.0, 0, (w - 1) / 2], [0, 160.0, (h - 1) / 2], [0, 0, 1]])
    T = drive.T_world_vehicle @ [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]]
    view = groundtruth.look(scene.load(built, num_lamps=0), Camera(K, T, WH))
    v, u = np.mgrid[:h, :w]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    points = (rays * groundtruth.depth(view)[..., None]) @ T[:3, :3].T + T[:3, 3]
    first, parts = 0, []
    for slot in scene._slots(built):
        for p in slot.parts or [scene._EMPTY]:
            here = (view.face >= first) & (view.face < first + len(p.faces))
            if here.any():
                parts.append((slot.name, p, view.face[here] - first, points[here]))
            first += len(p.faces)
    return Seen(parts)


def repeated_share(recipe: str, number: int, slots: tuple[str, ...]) -> tuple[int, float]:
    """Pixels of some surfaces, and the share of them that show what others do as well.

    Both show the same 20 cm of the same sheet, the same way round, over 3 m apart.
    """
    seen: dict[str, list[tuple[Array, Array]]] = {}
    for name, p, faces, points in look_at(recipe, number).parts:
        if name.startswith(slots):
            uv, side = _on_sheet(p, faces, points)
            for s in (-1, 1):
                seen.setdefault(f"{p.material} {s}", []).append((uv[side == s], points[side == s]))
    total = again = 0
    for pairs in seen.values():
        uv, xyz = (np.concatenate(x) for x in zip(*pairs, strict=True))
        if len(uv):
            total += len(uv)
            again += int(_elsewhere(uv, xyz, cells_of(slots[0]) * CELL_M).sum())
    return total, again / max(total, 1)


def _on_sheet(p, face: NDArray[np.int64], points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Sheet coordinates (N, 2) of points on faces, and 1 or −1 for the way round."""
    a, b, c = np.moveaxis(p.vertices[p.faces[face]], 1, 0)
    ta, tb, tc = np.moveaxis(p.uv[p.faces[face]].astype(np.float64), 1, 0)
    edges = np.stack([b - a, c - a], axis=2)
    share = np.einsum("nij,nj->ni", np.linalg.pinv(edges), points - a)
    x, y = tb - ta, tc - ta
    side = np.sign(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).astype(int)
    return ta + share[:, :1] * x + share[:, 1:] * y, side


def _elsewhere(uv: Array, xyz: Array, side_m: float) -> NDArray[np.bool_]:
    """(N,) whether the spot of the sheet at a point is also at one far from it."""
    spot = np.floor((uv % side_m) / SPOT_M).astype(int) @ [1, 1000]
    _, group = np.unique(spot, return_inverse=True)
    low = np.full((group.max() + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, group, xyz)
    np.maximum.at(high, group, xyz)
    return np.asarray((np.linalg.norm(high - low, axis=1) > APART_M)[group])


def test_hardly_any_spot_of_a_sheet_is_seen_twice_in_a_scene(mitsuba_active, worst) -> None:
    shares = []
    for recipe, number in (("urban", 8), ("suburban", 3)):
        total, share = repeated_share(recipe, number, ("wall", "roof"))
        assert total > 500
        shares.append(share)
    worst("pixels of walls that show a place of their sheet again", np.mean(shares), 0.04, "")


def test_hardly_any_spot_of_bark_is_seen_twice_in_a_scene(mitsuba_active, worst) -> None:
    shares = []
    for recipe, number in (("rural", 1), ("suburban", 3), ("urban", 8)):
        total, share = repeated_share(recipe, number, ("bark",))
        assert total > 100
        shares.append(share)
    worst("pixels of bark that show a place of their sheet again", np.mean(shares), 0.1, "")
