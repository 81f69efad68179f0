"""Detail follows the whole drive, and what its images magnify."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from test_ground import make_spec

from simgen import night
from simgen.layout import AT_HAND_M, CLOSE_M, CLOSE_TRIANGLES, Layout
from simgen.mesh import box, part, placed
from simgen.scene import _near_and_far

DRIVE = np.stack([np.arange(0.0, 61.0, 3.0), np.zeros(21)], axis=1)
LONG_LENS = 1 / np.tan(np.deg2rad(15.0))


def layout(way: np.ndarray = DRIVE, zoom: float = 1.0) -> Layout:
    site = SimpleNamespace(network=SimpleNamespace(lanes=[], buildings=[]))
    return Layout(site, make_spec("urban"), way, {}, zoom)


def test_the_last_frame_of_a_drive_sees_as_much_detail_as_the_first():
    drive = layout()
    for beside in (10.0, 60.0, 120.0):
        levels = {drive.lod(xy + np.array([0.0, beside])) for xy in DRIVE}
        assert levels == {layout(DRIVE[:1]).lod(np.array([0.0, beside]))}
    assert drive.in_view(DRIVE[-1] + [429.0, 259.0])
    assert not drive.in_view(DRIVE[-1] + [431.0, 0.0])
    assert not drive.in_view(DRIVE[0] - [31.0, 0.0])


def test_detail_of_a_single_frame_falls_with_distance():
    still = layout(DRIVE[:1])
    assert [still.lod(np.array([x, 0.0])) for x in (31.0, 33.0, 94.0, 96.0)] == [0, 1, 1, 2]
    np.testing.assert_allclose(still.distance([[3.0, 4.0], [0.0, 2.0]]), [5.0, 2.0])


def test_a_long_lens_magnifies_only_what_it_shows():
    still = layout(DRIVE[:1], LONG_LENS)
    ahead, beside, behind = (np.array(xy) for xy in ([110.0, 20.0], [40.0, 60.0], [-110.0, 0.0]))
    assert still.lod(ahead) == 0
    assert still.lod(beside) == 1
    assert still.lod(behind) == 2


def test_street_lamps_burn_around_the_rig_wherever_it_is_on_its_way():
    drive = layout()
    drive.lights.append(np.column_stack([np.arange(0.0, 300.0, 10.0), *np.full((2, 30), 5.0)]))
    T = np.eye(4)
    T[0, 3] = 60.0
    *_, nearest = night.lamps(drive, T)[:5]
    assert nearest.xyz[0] == 60.0


@pytest.mark.usefixtures("mitsuba_active")
def test_sheets_are_sharp_along_the_whole_drive():
    from simgen.materials import FAR_SHEET_M, MATERIALS
    from simgen.mesh import box, part
    from simgen.sheets import Sheet

    walls = [part(*box((1, 1, 1), (x, 0.0, 0.0)), "wall_0", 11, uv=np.zeros((24, 2)))
             for x in (0.0, 60.0 + 0.5 * FAR_SHEET_M, 70.0 + FAR_SHEET_M)]  # fmt: skip
    sheet = Sheet(np.full((64, 64, 3), 128, np.uint8), 1.0)
    near, far = _near_and_far("wall_0", walls, sheet, MATERIALS["wall_0"], DRIVE)
    assert len(near.parts) == 2
    assert len(far.parts) == 1


def test_eyes_of_a_near_plant_are_where_the_rig_is_in_the_plants_frame():
    here = layout(np.array([[3.0, 1.0]]))
    heading, foot = 0.7, np.array([9.0, 5.0])
    eyes = here.close_eyes(foot[None], heading)
    assert eyes is not None
    (eye,) = eyes
    marker = [part(*box((0.1, 0.1, 0.1), eye), "matte", 0)]
    (stands,) = placed(marker, xyz=[*foot, 0.0], heading_rad=heading)
    np.testing.assert_allclose(stands.vertices.mean(axis=0)[:2], [3.0, 1.0])


def test_single_leaves_end_with_distance_and_with_their_triangles():
    here = layout(DRIVE[:1])
    assert here.close_eyes(np.array([[40.0, 0.0]])) is None
    assert here.close_eyes(np.array([[9.0, 0.0], [40.0, 0.0]])) is not None
    assert here.close_eyes(np.array([[-9.0, 0.0]])) is None
    here.close_triangles = CLOSE_TRIANGLES
    assert here.close_eyes(np.array([[9.0, 0.0]])) is None


def test_plants_further_away_leave_half_the_triangles_to_those_at_hand():
    here = layout(DRIVE[:1])
    at_hand, beyond = np.array([[AT_HAND_M - 1, 0.0]]), np.array([[CLOSE_M - 1, 0.0]])
    plant = [part(*box((1, 1, 1), (0, 0, 0)), "leaf", 21)] * (CLOSE_TRIANGLES // 24 + 1)
    here.spend_close(plant, here.close_eyes(beyond))
    assert here.close_eyes(beyond) is None
    here.spend_close(plant, here.close_eyes(at_hand))
    assert here.close_eyes(at_hand) is None
