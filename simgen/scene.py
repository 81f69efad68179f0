"""Everything drawn → one Mitsuba scene of few, merged meshes and a table of all its faces.

Every scene has the same *slots* (mesh + BSDF), filled or not, so that the renderer compiles its
kernels once. A material that is coloured by a sheet has two slots: the sheet itself, and a
filtered copy for surfaces far away, since Mitsuba has no mip-maps. The ground has one slot per
ring of its ortho maps. Ground that shines, since it is wet, has another BSDF: one structure
more, with kernels of its own, which a process compiles at its first wet scene.

A *face id* counts the faces of all slots in slot order; ground truth is looked up by it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from simgen.materials import FAR_SHEET_FACTOR, FAR_SHEET_M, MATERIALS, Material
from simgen.mesh import Part, blocks, flat
from simgen.sheets import Sheet, filtered
from simgen.wetness import SPECULAR


@dataclass(frozen=True, eq=False)
class GroundRing:
    """A piece of the ground and the ortho map that colours it."""

    parts: list[Part]
    """uv in [0, 1]² of the map; v = 0 is its first row"""
    image: NDArray[np.uint8]
    """(H, W, 3) sRGB"""
    roughness: NDArray[np.uint8] | None = None
    """(h, w) of ground that shines, 255 = 1; for all rings of a scene or for none"""


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light that burns at night."""

    xyz: NDArray[np.float64]
    direction: NDArray[np.float64]
    intensity: NDArray[np.float64]
    """(3,) radiant intensity on the axis [W/sr, in the unit of the scene's radiance]"""
    cutoff_deg: float
    beam_deg: float


@dataclass(frozen=True, eq=False)
class World:
    """All surfaces and lights of a scene, before Mitsuba: plain arrays, metres, near the origin."""

    parts: list[Part]
    ground: list[GroundRing]
    sheets: dict[str, Sheet]
    """one for each material that is coloured by metres"""
    sign_atlas: NDArray[np.uint8]
    sky: NDArray[np.float32]
    """(H, W, 3) linear radiance, latitude–longitude, see daylight.py"""
    lamps: list[Lamp] = field(default_factory=list)
    """none by day; at night in order of importance"""
    movers: list[dict[str, Any]] = field(default_factory=list)
    """what can move, see layout.Mover.record"""
    way: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 2)))
    """(N, 2) where the rig stands in the frames of the scene"""


@dataclass(frozen=True, eq=False)
class FaceTable:
    """What ground truth needs to know of each face, by face id."""

    plane: NDArray[np.float64]
    """(F, 4) world plane (n, d) with n·x = d; n is not normalised, and 0 for a degenerate face"""
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    glass: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Glow:
    """Faces that send out light by themselves; none by day."""

    face: NDArray[np.int64]
    """(G,) their ids, ascending"""
    radiance: NDArray[np.float32]
    """(G, 3)"""
    corners: NDArray[np.float64]
    """(G, 3, 3)"""


@dataclass(frozen=True, eq=False)
class Scene:
    """A loaded scene."""

    mi_scene: Any
    shapes: list[Any]
    """Mitsuba's shape of each slot"""
    first_face: NDArray[np.int64]
    """(num_slots,) face id of each slot's first face"""
    faces: FaceTable
    sky: NDArray[np.float32]
    """the environment map, see daylight.py"""
    glow: Glow
    movers: list[dict[str, Any]]
    """what can move, see layout.Mover.record"""


@dataclass(frozen=True, eq=False)
class _Slot:
    name: str
    parts: list[Part]
    bsdf: dict[str, Any]
    material: Material


def load(world: World, *, num_lamps: int) -> Scene:
    """Hands the world to Mitsuba.

    ``num_lamps`` is the number of light slots of a night scene (0 by day): the first lamps take
    all but one of them, slots that are left over stay dark.

    Nothing is loaded in parallel: which kernels that takes would depend on how its threads meet.
    """
    slots = _slots(world)
    with _no_expansion():
        meshes = [_mesh(slot) for slot in slots]
    shapes = {f"slot_{i:02d}": m[0] for i, m in enumerate(meshes)}
    lights = {f"lamp_{i:02d}": x for i, x in enumerate(_lamp_dicts(world.lamps, num_lamps))}
    mi_scene = mi.load_dict(
        {
            "type": "scene",
            # Otherwise rays leak through edges that triangles share: some pixels in a million.
            "embree_use_robust_intersections": True,
            **shapes,
            **lights,
            "sky": _sky_dict(world.sky),
        },
        optimize=False,
        parallel=False,
    )
    counts = [len(m[2]) for m in meshes]
    return Scene(
        mi_scene,
        list(shapes.values()),
        np.cumsum([0, *counts[:-1]]),
        _face_table(slots, [(m[1], m[2]) for m in meshes]),
        world.sky,
        _glow(slots),
        world.movers,
    )


# --- slots ------------------------------------------------------------------------------------


def _slots(world: World) -> list[_Slot]:
    """The fixed list of slots."""
    slots = []
    for name, material in MATERIALS.items():
        parts = [p for p in world.parts if p.material == name]
        if material.color_by == "ground":
            slots += [_ground_slot(i, ring, material) for i, ring in enumerate(world.ground)]
        elif material.color_by == "metres":
            slots += _near_and_far(name, parts, world.sheets[name], material, world.way)
        else:
            texture = _texture(world.sign_atlas) if material.color_by == "atlas" else _VERTEX_COLOR
            slots.append(_Slot(name, parts, _bsdf(material, texture), material))
    _check(world.parts)
    return slots


def _check(parts: Sequence[Part]) -> None:
    """Raises ValueError for a part that would be dropped or wrap around."""
    free = {name for name, m in MATERIALS.items() if m.color_by != "ground"}
    unknown = {p.material for p in parts} - free
    if unknown:
        raise ValueError(f"scene: parts of material {sorted(unknown)}; expected {sorted(free)}")
    highest = max((p.instance for p in parts), default=0)
    if highest > np.iinfo(np.uint16).max:
        raise ValueError(f"scene: instance id {highest}, but a shard holds 16 bits")


def _ground_slot(i: int, ring: GroundRing, material: Material) -> _Slot:
    texture = _texture(ring.image, wrap="clamp")
    bsdf = _bsdf(material, texture)
    if ring.roughness is not None:
        gloss = {**_texture(ring.roughness, wrap="clamp"), "raw": True}
        bsdf = _wet(texture, gloss)
    return _Slot(f"ground_{i}", ring.parts, bsdf, material)


def _wet(texture: dict[str, Any], gloss: dict[str, Any]) -> dict[str, Any]:
    """Ground under water, as rough as the bitmap ``gloss`` says."""
    water = {"type": "principled", "base_color": texture, "roughness": gloss,
             "specular": SPECULAR}  # fmt: skip
    return {"type": "twosided", "bsdf": water}


def _near_and_far(
    name: str, parts: Sequence[Part], sheet: Sheet, material: Material, way: NDArray[np.float64]
) -> list[_Slot]:
    """Splits by distance from the rig where it comes nearest, and filters the far sheet."""
    rig = cKDTree(way)
    distance = [rig.query(p.vertices[:, :2])[0].min() for p in parts]
    near = [p for p, d in zip(parts, distance, strict=True) if d < FAR_SHEET_M]
    far = [p for p, d in zip(parts, distance, strict=True) if d >= FAR_SHEET_M]
    far_sheet = filtered(sheet, FAR_SHEET_FACTOR)
    return [
        _Slot(label, ps, _bsdf(material, _texture(s.image, s.metres)), material)
        for label, ps, s in ((name, near, sheet), (f"{name}_far", far, far_sheet))
    ]


_VERTEX_COLOR = {"type": "mesh_attribute", "name": "vertex_color"}


def _texture(image: NDArray[np.uint8], metres: float = 1.0, wrap: str = "repeat") -> dict[str, Any]:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
        "wrap_mode": wrap,
        "to_uv": mi.ScalarTransform4f().scale([1 / metres, 1 / metres, 1.0]),
    }


def _bsdf(material: Material, texture: dict[str, Any]) -> dict[str, Any]:
    surfaces: dict[str, dict[str, Any]] = {
        "diffuse": {"type": "diffuse", "reflectance": texture},
        "paint": {"type": "principled", "base_color": texture, "roughness": 0.35,
                  "specular": 0.5, "clearcoat": 1.0, "clearcoat_gloss": 0.95},
        "glass": {"type": "principled", "base_color": texture, "roughness": 0.06,
                  "specular": 1.0},  # 8 %: a pane reflects on both of its sides
        "metal": {"type": "principled", "base_color": texture, "metallic": 0.7,
                  "roughness": 0.45},
    }  # fmt: skip
    return {"type": "twosided", "bsdf": surfaces[material.reflects]}


# --- meshes -----------------------------------------------------------------------------------

# An unused slot holds one small triangle far below every scene.
_NOWHERE = np.array([[0.0, 0.0, -900.0], [0.01, 0.0, -900.0], [0.0, 0.01, -900.0]])


@contextmanager
def _no_expansion() -> Iterator[None]:
    """Sums vertex normals by atomic additions.

    By default Dr.Jit gives each thread a copy of the target, whose size becomes part of the kernel:
    every scene would compile.
    """
    threshold = dr.expand_threshold()
    dr.set_expand_threshold(0)
    try:
        yield
    finally:
        dr.set_expand_threshold(threshold)


def _mesh(slot: _Slot) -> tuple[Any, NDArray[np.float32], NDArray[np.uint32]]:
    """Merges a slot's parts to one Mitsuba mesh; returns it with its vertices and faces."""
    curved = slot.material.curved
    parts = [flat(p) if curved and p.normals is None else p for p in slot.parts]
    vertices, faces = _merged_geometry(parts)
    has_uv = slot.material.color_by != "vertex"
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(slot.bsdf, parallel=False)
    # It begins as one triangle and grows with its arrays: add_attribute copies number by number.
    # Arrays of scalar variants cannot grow.
    scalar = str(mi.variant()).startswith("scalar")
    num_vertices, num_faces = (len(vertices), len(faces)) if scalar else (3, 1)
    mesh = mi.Mesh(
        slot.name, num_vertices, num_faces, has_vertex_normals=curved,
        has_vertex_texcoords=has_uv, props=properties,
    )  # fmt: skip
    if not has_uv:
        mesh.add_attribute("vertex_color", 3, [0.0] * (3 * num_vertices))
    params = mi.traverse(mesh)
    params["vertex_positions"] = aligned(vertices)
    params["faces"] = aligned(faces)
    key, name, size = ("texcoords", "uv", 2) if has_uv else ("color", "color", 3)
    params[f"vertex_{key}"] = aligned(_attribute(parts, name, size))
    params.update()
    if curved:  # only now, since new positions bring normals of Mitsuba's own
        params["vertex_normals"] = aligned(_attribute(parts, "normals", 3))
        params.update()
    return mesh, vertices, faces


def aligned(values: NDArray[Any]) -> NDArray[Any]:
    """A flat copy (N,) that begins at a multiple of 64 bytes.

    Dr.Jit reads NumPy's memory where it is, by another kernel where it is not aligned.
    """
    room = np.empty(values.nbytes + 64, dtype=np.uint8)
    start = -room.ctypes.data % 64
    copy = room[start : start + values.nbytes].view(values.dtype)
    copy[:] = values.ravel()
    return copy


def _merged_geometry(parts: Sequence[Part]) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    if not parts:
        return _NOWHERE.astype(np.float32), np.array([[0, 1, 2]], dtype=np.uint32)
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    vertices = np.concatenate([p.vertices for p in parts]).astype(np.float32)
    faces = np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)])
    return vertices, _led_by_short_edges(vertices, faces).astype(np.uint32)


def _led_by_short_edges(
    vertices: NDArray[np.float32], faces: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Faces that begin with the corner opposite their longest edge.

    Mitsuba solves for barycentric coordinates in the two edges at the first corner, in float32: of
    a kerb's edge of 100 m by 1 cm, the two long ones gave NaN as the colour.
    """
    led = np.empty_like(faces)
    for rows in blocks(len(faces)):
        a, b, c = (np.take(vertices, corner, axis=0) for corner in faces[rows].T)
        opposite = [np.einsum("fk,fk->f", e, e) for e in (c - b, a - c, b - a)]
        first = np.argmax(opposite, axis=0)
        led[rows] = np.take_along_axis(faces[rows], (first[:, None] + [0, 1, 2]) % 3, axis=1)
    return led


def _attribute(parts: Sequence[Part], name: str, size: int) -> NDArray[np.float32]:
    if not parts:
        return np.zeros((3, size), dtype=np.float32)
    for p in parts:
        if getattr(p, name) is None:
            raise ValueError(f"scene: a part of material {p.material!r} has no {name}")
    return np.concatenate([getattr(p, name) for p in parts]).astype(np.float32)


def _face_table(
    slots: Sequence[_Slot], geometry: Sequence[tuple[NDArray[np.float32], NDArray[np.uint32]]]
) -> FaceTable:
    planes = [_planes(v.astype(np.float64), f) for v, f in geometry]

    def per_face(attribute: str) -> NDArray[Any]:
        columns = [
            np.full(len(p.faces), getattr(p, attribute))
            for slot in slots
            for p in (slot.parts or [_EMPTY])
        ]
        return np.concatenate(columns)

    glass = [
        np.full(len(f), s.material.reflects == "glass")
        for s, (_, f) in zip(slots, geometry, strict=True)
    ]
    return FaceTable(
        np.concatenate(planes),
        per_face("semantic").astype(np.uint8),
        per_face("instance").astype(np.uint16),
        np.concatenate(glass),
    )


def _glow(slots: Sequence[_Slot]) -> Glow:
    """What glows among the faces of all slots, those of _NOWHERE included."""
    parts = [p for slot in slots for p in (slot.parts or [_EMPTY])]
    first = np.cumsum([0, *(len(p.faces) for p in parts)])
    faces: list[NDArray[Any]] = [np.empty(0, np.int64)]
    radiance: list[NDArray[Any]] = [np.empty((0, 3))]
    corners: list[NDArray[Any]] = [np.empty((0, 3, 3))]
    for p, start in zip(parts, first, strict=False):
        if p.emission is not None:
            on = p.emission.any(axis=1)
            faces.append(start + np.flatnonzero(on))
            radiance.append(p.emission[on])
            corners.append(p.vertices[p.faces[on]])
    return Glow(
        np.concatenate(faces),
        np.concatenate(radiance).astype(np.float32),
        np.concatenate(corners),
    )


_EMPTY = Part(_NOWHERE, np.array([[0, 1, 2]]), "", 0)


def _planes(vertices: NDArray[np.float64], faces: NDArray[np.uint32]) -> NDArray[np.float64]:
    """(F, 4) planes through the float32 vertices that the renderer holds, in float64."""
    planes = np.empty((len(faces), 4))
    for rows in blocks(len(faces)):
        a, b, c = (np.take(vertices, corner, axis=0).T for corner in faces[rows].T)
        (ux, uy, uz), (vx, vy, vz) = b - a, c - a
        normal = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        offset = normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2]
        planes[rows] = np.stack([*normal, offset], axis=1)
    return planes


# --- lights -----------------------------------------------------------------------------------


def _sky_dict(sky: NDArray[np.float32]) -> dict[str, Any]:
    """An environment emitter, turned from Mitsuba's y-up and seam to those of daylight.py."""
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(sky, dtype=np.float32)),
        "to_world": mi.ScalarTransform4f().rotate([0, 0, 1], 90).rotate([1, 0, 0], 90),
    }


def _lamp_dicts(lamps: Sequence[Lamp], num: int) -> list[dict[str, Any]]:
    """``num`` slots, the last of which is always dark.

    Were all of them lit, Mitsuba would choose among them evenly, which is another kernel.
    """
    off = Lamp(np.array([0.0, 0, -800]), np.array([0.0, 0, -1]), np.zeros(3), 60.0, 50.0)
    lit = lamps[: max(0, num - 1)]
    return [_spot(lamp) for lamp in [*lit, *[off] * (num - len(lit))]]


def _spot(lamp: Lamp) -> dict[str, Any]:
    up = [1.0, 0.0, 0.0] if abs(lamp.direction[2]) > 0.9 else [0.0, 0.0, 1.0]
    return {
        "type": "spot",
        "intensity": {"type": "rgb", "value": [float(x) for x in lamp.intensity]},
        "sampling_weight": 1.0 if np.any(lamp.intensity) else 0.0,
        "cutoff_angle": lamp.cutoff_deg,
        "beam_width": lamp.beam_deg,
        "to_world": mi.ScalarTransform4f().look_at(
            origin=lamp.xyz.tolist(), target=(lamp.xyz + lamp.direction).tolist(), up=up
        ),
    }
