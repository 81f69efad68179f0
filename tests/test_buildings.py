from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from simgen import fittings
from simgen.buildings import MAX_FAR_TRIANGLES, WALL_MATERIALS, Massing, build
from simgen.facades import drawn_openings, drawn_style, wall_surface, walls_of
from simgen.massing import KINDS
from simgen.materials import MATERIALS
from simgen.mesh import Model, Part
from simgen.night import LIT_SHARE, glowing
from simgen.places import Places
from simgen.roofs import convex_pieces, roof_surface
from simgen.solids import boxes, inside_out

Array = NDArray[np.float64]
PITCHED = ("gabled", "hipped", "pyramidal", "skillion")
L_SHAPE = np.array([[0, 0], [14, 0], [14, 6], [6, 6], [6, 12], [0, 12]], dtype=float)


def turned(ring: Array, angle_rad: float, shift: tuple[float, float] = (0.0, 0.0)) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return ring @ np.array([[c, s], [-s, c]]) + shift


def rectangle(width: float, depth: float) -> Array:
    return np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])


def massing(kind: str = "house", roof: str = "gabled", **changes: object) -> Massing:
    heights = {"apartments": 12.0, "office": 30.0, "commercial": 22.0, "retail": 7.0}
    fields: dict[str, object] = {
        "footprint": turned(rectangle(13, 10), 0.4, (30.0, -12.0)),
        "base_z": 1.5,
        "wall_height": heights.get(kind, 5.6),
        "roof": roof,
        "roof_height": 0.0 if roof == "flat" else 2.5,
        "ridge_rad": 0.4,
        "kind": kind,
        "front": 0,
    }
    return Massing(**(fields | changes))  # type: ignore[arg-type]


def built(m: Massing, lod: int, seed: int = 0) -> Model:
    places = Places(np.zeros((1, 2)), rng=np.random.default_rng(0))
    rng = np.random.default_rng(seed)
    return build(m, rng=rng, lod=lod, places=places)  # type: ignore[arg-type]


def triangles(p: Part) -> Array:
    return p.vertices[p.faces]


def normals(p: Part) -> Array:
    """(F, 3), as long as twice the areas."""
    a, b, c = np.moveaxis(triangles(p), 1, 0)
    return np.cross(b - a, c - a)


def num_triangles(model: Model) -> int:
    return sum(len(p.faces) for p in model)


def area(ring: Array) -> float:
    x, y = ring.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


@pytest.mark.parametrize("lod", [0, 1, 2])
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_is_made_of_valid_parts_one_per_material(kind: str, lod: int) -> None:
    model = built(massing(kind, "flat" if kind in ("office", "retail") else "hipped"), lod)
    assert len({p.material for p in model}) == len(model)
    for p in model:
        assert p.semantic == 11
        assert np.isfinite(p.vertices).all()
        assert p.faces.max() < len(p.vertices)
        if MATERIALS[p.material].color_by == "vertex":
            assert p.color is not None
            assert 0 < p.color.min() <= p.color.max() <= 0.8
        else:
            assert p.uv is not None
            assert p.uv.shape == (len(p.vertices), 2)


@pytest.mark.parametrize("lod", [0, 1])
def test_windows_have_blinds_and_some_of_them_are_lit_at_night(
    lod: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    hung: list[Part] = []
    covers = fittings._covers

    def recorded(*args: Any, **kwargs: Any) -> Model:
        hung.extend(model := covers(*args, **kwargs))
        return model

    monkeypatch.setattr(fittings, "_covers", recorded)
    blocks = [built(massing("apartments"), lod, seed) for seed in range(4)]
    panes = [p for block in blocks for p in block if p.material == "glass"]
    num_panes = sum(len(p.faces) for p in panes) // 2
    num_fabrics = sum(len(p.faces) for p in hung) // 2
    assert 0.1 * num_panes < num_fabrics < 2 * num_panes
    shown = np.concatenate([p.vertices for block in blocks for p in block])
    fabric = np.concatenate([p.vertices for p in hung])
    assert {tuple(v) for v in fabric.astype(np.float32)} <= {
        tuple(v) for v in shown.astype(np.float32)
    }
    lit = np.concatenate([
        p.emission.any(axis=1) for p in glowing(panes, rng=np.random.default_rng(0))
    ])  # fmt: skip
    assert lit.mean() == pytest.approx(LIT_SHARE, abs=0.1)


def test_the_same_generator_state_gives_the_same_building() -> None:
    a, b, c = (built(massing(), 0, seed) for seed in (3, 3, 4))
    assert all(np.array_equal(p.vertices, q.vertices) for p, q in zip(a, b, strict=True))
    assert num_triangles(a) != num_triangles(c)


@pytest.mark.parametrize("seed", range(6))
def test_triangle_budgets_hold(seed: int) -> None:
    four_storeys = massing("apartments", "flat", footprint=rectangle(13, 16))
    assert num_triangles(built(massing(), 0, seed)) <= 2500
    assert num_triangles(built(four_storeys, 0, seed)) <= 6000
    tower = massing("office", "flat", wall_height=140.0)
    for m in (massing(), tower, massing(footprint=L_SHAPE), massing(roof="hipped")):
        assert num_triangles(built(m, 2, seed)) <= MAX_FAR_TRIANGLES


@pytest.mark.parametrize("lod", [0, 1, 2])
def test_walls_go_a_metre_into_the_ground_and_up_to_the_ridge(lod: int) -> None:
    wall = [p for p in built(massing("industrial"), lod) if p.material in WALL_MATERIALS]
    z = np.concatenate([p.vertices[:, 2] for p in wall])
    assert z.min() == pytest.approx(1.5 - 1.0)
    assert z.max() == pytest.approx(1.5 + 5.6 + 2.5)


@pytest.mark.parametrize("roof", PITCHED)
def test_walls_face_outwards_and_roofs_upwards(roof: str) -> None:
    m = massing("industrial", roof)
    for p in built(m, 1):
        n, middle = normals(p), triangles(p).mean(axis=1)
        if p.material in WALL_MATERIALS:
            outward = ((middle[:, :2] - m.footprint.mean(axis=0)) * n[:, :2]).sum(axis=1)
            assert (outward > 0)[np.linalg.norm(n, axis=1) > 1e-9].all()
        if p.material == "roof":
            assert (n[:, 2] > 0).all()


@pytest.mark.parametrize("lod", [0, 1])
def test_wall_and_roof_uv_are_metres_on_the_surface(lod: int) -> None:
    for p in built(massing("industrial"), lod):
        if p.material in WALL_MATERIALS or (p.material == "roof" and lod == 1):
            assert p.uv is not None
            a, b, c = np.moveaxis(p.uv[p.faces].astype(np.float64), 1, 0)
            uv_area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
            np.testing.assert_allclose(uv_area, np.linalg.norm(normals(p), axis=1), atol=2e-4)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_openings_lie_in_their_wall_and_apart(kind: str) -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        m = massing(kind)
        style = drawn_style(KINDS[kind], WALL_MATERIALS, rng=rng)
        for wall in walls_of(m, KINDS[kind], parapet_m=0.0):
            o = drawn_openings(wall, KINDS[kind], style, rng=rng)
            left, bottom, right, top = o.rects.T
            assert (left > 0).all()
            assert (right < wall.length_m).all()
            assert (right - left > 0.3).all()
            assert (top - bottom > 0.3).all()
            assert (bottom > wall.floors[o.storey]).all()
            assert (top < wall.floors[o.storey + 1]).all()
            for storey in np.unique(o.storey):
                row = o.rects[o.storey == storey]
                row = row[np.argsort(row[:, 0])]
                assert (row[1:, 0] > row[:-1, 2]).all()


def test_a_wall_is_its_rectangle_less_its_openings() -> None:
    rng = np.random.default_rng(1)
    kind, m = KINDS["apartments"], massing("apartments", "flat")
    style = drawn_style(kind, WALL_MATERIALS, rng=rng)
    for wall in walls_of(m, kind, parapet_m=0.5):
        openings = drawn_openings(wall, kind, style, rng=rng)
        left, bottom, right, top = openings.rects.T
        holes = float(((right - left) * (top - bottom)).sum())
        solid = (
            float(np.linalg.norm(normals(wall_surface(wall, style, openings)), axis=1).sum()) / 2
        )
        assert solid == pytest.approx(wall.length_m * (12.0 + 0.5 + 1.0) - holes)


def test_panes_stand_at_the_same_places_at_every_distance() -> None:
    m = massing("apartments", "flat", footprint=rectangle(9, 8), wall_height=6.0)
    panes = {}
    for lod in (0, 1, 2):
        (glass,) = (p for p in built(m, lod, seed=2) if p.material == "glass")
        quads = glass.vertices.reshape(-1, 4, 3).mean(axis=1)
        panes[lod] = quads[np.lexsort(quads.round(1).T)]
    assert len(panes[2]) > 10
    np.testing.assert_allclose(panes[1], panes[2], atol=0.03)
    gap = np.linalg.norm(panes[0][:, None] - panes[2], axis=2).min(axis=1)
    assert gap.max() < 0.3  # behind the reveal


def test_only_the_street_side_on_the_ground_has_a_door() -> None:
    rng = np.random.default_rng(0)
    kind = KINDS["retail"]
    style = drawn_style(kind, WALL_MATERIALS, rng=rng)
    for on_ground in (True, False):
        m = massing("retail", "flat", front=2, on_ground=on_ground)
        walls = walls_of(m, kind, parapet_m=0.4)
        doors = [len(drawn_openings(w, kind, style, rng=rng).of("door")) for w in walls]
        assert doors == ([0, 0, 1, 0] if on_ground else [0, 0, 0, 0])


def test_wall_materials_come_from_the_given_ones() -> None:
    rng = np.random.default_rng(0)
    places = Places(np.zeros((1, 2)), rng=rng)
    model = build(massing(), rng=rng, lod=0, places=places, walls=("wall_2",))
    assert {p.material for p in model} & set(WALL_MATERIALS) == {"wall_2"}


def test_flat_roofs_keep_to_their_footprint_and_pitched_ones_overhang_it() -> None:
    m = massing("industrial", "flat")
    for roof, grows in (("flat", False), ("gabled", True)):
        model = built(massing("industrial", roof), 2)
        xy = np.concatenate([p.vertices[:, :2] for p in model if p.material != "glass"])
        assert (np.ptp(xy, axis=0) > np.ptp(m.footprint, axis=0) + 0.2).all() == grows


# ---- roofs and solids -------------------------------------------------------------------------


@pytest.mark.parametrize("form", PITCHED)
def test_roofs_start_at_the_eaves_and_end_at_their_height(form: str) -> None:
    ring = turned(rectangle(12, 8), 0.7, (5.0, 3.0))
    roof = roof_surface(ring, form, 2.4, 0.7)  # type: ignore[arg-type]
    middle = ring.mean(axis=0)
    plan = middle + np.linspace(0, 1, 101)[:, None, None] * (ring - middle)
    assert roof.height(ring).min() == pytest.approx(0, abs=1e-9)
    assert roof.height(plan).max() == pytest.approx(2.4)


def test_a_skillion_roof_rises_along_its_direction() -> None:
    roof = roof_surface(rectangle(10, 6), "skillion", 1.2, np.pi / 2)
    across = np.array([[3.0, 0.0], [3.0, 3.0], [3.0, 6.0]])
    np.testing.assert_allclose(roof.height(across), [0, 0.6, 1.2], atol=1e-12)


@pytest.mark.parametrize("ring", [rectangle(12, 8), L_SHAPE], ids=["rectangle", "L"])
@pytest.mark.parametrize("form", ("flat", *PITCHED))
def test_roof_faces_cover_the_plan_once(ring: Array, form: str) -> None:
    roof = roof_surface(ring, form, 2.0, 0.3)  # type: ignore[arg-type]
    faces = [polygon for polygons in roof.faces(ring) for polygon in polygons]
    assert sum(area(p) for p in faces) == pytest.approx(area(ring))
    assert min(area(p) for p in faces) > 0


def test_a_hipped_roof_has_one_ridge_and_four_hips() -> None:
    lines = roof_surface(rectangle(12, 8), "hipped", 2.0, 0.0).ridges(rectangle(12, 8))
    level = [line for line in lines if abs(line[0, 2] - line[1, 2]) < 1e-9]
    assert len(lines) == 5
    assert len(level) == 1
    assert np.ptp(level[0][:, 0]) == pytest.approx(12 - 8)


def test_the_profile_of_a_gable_is_a_triangle() -> None:
    ring = rectangle(12, 8)
    t, h = roof_surface(ring, "gabled", 2.0, 0.0).profile(ring[1], ring[2])
    np.testing.assert_allclose(t, [0, 0.5, 1])
    np.testing.assert_allclose(h, [0, 2, 0], atol=1e-12)


def test_convex_pieces_are_convex_and_add_up() -> None:
    pieces = convex_pieces(L_SHAPE)
    assert sum(area(p) for p in pieces) == pytest.approx(area(L_SHAPE))
    for p in pieces:
        before, after = p - np.roll(p, 1, axis=0), np.roll(p, -1, axis=0) - p
        assert (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] >= 0).all()


def test_boxes_enclose_their_volume() -> None:
    quads = boxes([[0, 0, 0], [5, 5, 5]], [[1, 2, 3], [6, 7, 5.5]])

    def volume(q: Array) -> float:  # divergence theorem
        n = np.cross(q[:, 1] - q[:, 0], q[:, 3] - q[:, 0])
        return float((q.mean(axis=1) * n).sum()) / 3

    assert volume(quads) == pytest.approx(1 * 2 * 3 + 1 * 2 * 0.5)
    assert volume(inside_out(quads)) == pytest.approx(-7.0)


# ---- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "castle"}, "kind 'castle' is unknown; choose from \\['apartments'"),
        ({"footprint": rectangle(9, 8)[::-1]}, "area -72 m², expected counter-clockwise"),
        ({"footprint": np.zeros((2, 2))}, "shape \\(2, 2\\), expected \\(N >= 3, 2\\)"),
        ({"front": 4}, "front is wall 4, the footprint has 4"),
    ],
)
def test_impossible_massings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        massing(**changes)  # type: ignore[arg-type]


def test_unknown_roofs_and_levels_of_detail_are_refused() -> None:
    with pytest.raises(ValueError, match="roof form 'dome' is unknown; choose from \\['flat'"):
        built(massing(roof="dome"), 0)
    with pytest.raises(ValueError, match="level of detail 3 is unknown; choose 0, 1 or 2"):
        built(massing(), 3)
