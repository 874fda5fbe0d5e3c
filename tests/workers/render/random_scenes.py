"""Scenes from a seed, with shapes of their own: tables on legs, and objects with thin, small, open and round parts; looks of
them: a tier's settings, and the plan of effects of a scene that calls for all it has.
"""

import functools
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.base import Array, Pose, frozen_array
from schemas.job.assets import CATEGORIES, Assets
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from workers.assets.catalogue import Catalogue, choose_object, choose_table, load_asset, open_catalogue
from workers.geometry.camera import orbit_pose
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import UP, invert, pose, rotation_about, transform, uniform_rotation
from workers.scene.cameras import mirror_pose

VGA = Intrinsics(width=640, height=480, fx=525.0, fy=525.0, cx=320.0, cy=240.0)
FLOOR_HALF_M = 30.0
PLAIN = Material()
EYE = np.eye(4)

APPEARANCE = Appearance(
    ambient=(0.3, 0.3, 0.3),
    lights=(
        Light(frozen_array([0.36, 0.48, 0.8]), (0.6, 0.6, 0.55)),
        Light(frozen_array([-0.6, 0.0, 0.8]), (0.2, 0.2, 0.25)),
    ),
    background=(0.2, 0.3, 0.4),
)


WHITE = Appearance(ambient=(1.0, 1.0, 1.0), lights=(), background=(0.0, 0.0, 0.0))


def camera(k: Intrinsics = VGA, T: Pose = EYE) -> Camera:
    """A camera at the world's origin that looks along z, x to the right, y down, unless T says where."""
    return Camera(k, T)


def small(width: int, height: int, **moved: float) -> Intrinsics:
    """A camera of this many pixels with the middle in the middle, 45 degrees to the sides."""
    k = {"fx": width / 2, "fy": width / 2, "cx": width / 2, "cy": height / 2, **moved}
    return Intrinsics(width=width, height=height, **k)


def facing(z: float, half: float = 100.0) -> Shape:
    """A square across the optical axis."""
    return quad([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])


def part_of(mesh: trimesh.Trimesh, color: tuple[float, float, float] = (0.7, 0.7, 0.7), smooth: bool = False) -> Part:
    """One part in the mesh's own frame."""
    normals = frozen_array(mesh.vertex_normals) if smooth else None
    material = Material(base_color=(*color, 1.0))
    return Part("part", frozen_array(mesh.vertices), frozen_array(mesh.faces, np.int32), material, normals)


def shape_of(*meshes: trimesh.Trimesh) -> Shape:
    """A part for each mesh."""
    return Shape(tuple(part_of(mesh) for mesh in meshes))


def quad(corners: object, turned: bool = False, material: Material = PLAIN) -> Shape:
    """Four corners in order as two triangles; `turned` takes the other diagonal."""
    faces = [[1, 2, 3], [1, 3, 0]] if turned else [[0, 1, 2], [0, 2, 3]]
    return Shape((Part("quad", frozen_array(corners), frozen_array(faces, np.int32), material),))


def floor() -> Placed:
    """A level square of 60 m at z = 0, region 1."""
    h = FLOOR_HALF_M
    return Placed(
        1, quad([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]], material=Material(roughness=0.9)), np.eye(4)
    )


def table_shape(rng: np.random.Generator) -> tuple[Shape, float]:
    """(a table that stands on z = 0, the height of its top): a box or a disc on four legs or on a foot."""
    height, thickness, color = rng.uniform(0.4, 0.8), rng.uniform(0.01, 0.05), tuple(rng.uniform(0.2, 0.8, 3))
    size = rng.uniform([0.7, 0.7], [1.4, 1.0])
    if rng.random() < 0.5:
        top = trimesh.creation.box((*size, thickness))
        spots = [(x * 0.45 * size[0], y * 0.45 * size[1]) for x in (-1, 1) for y in (-1, 1)]
        legs = [trimesh.creation.cylinder(rng.uniform(0.01, 0.03), height - thickness, sections=12) for _ in spots]
    else:
        top = trimesh.creation.cylinder(size[1] / 2, thickness, sections=int(rng.integers(20, 90)))
        spots, legs = [(0.0, 0.0)], [trimesh.creation.box((0.06, 0.06, height - thickness))]
    top.apply_translation((0, 0, height - thickness / 2))
    for leg, (x, y) in zip(legs, spots, strict=True):
        leg.apply_translation((x, y, (height - thickness) / 2))
    return Shape(tuple(part_of(mesh, color) for mesh in (top, *legs))), height


def object_shape(rng: np.random.Generator) -> Shape:
    """One of eight kinds of thing, about 0.25 m across."""
    s = rng.uniform(0.07, 0.13)
    kind = int(rng.integers(8))
    cylinder, box = trimesh.creation.cylinder, trimesh.creation.box
    if kind == 0:
        meshes = [trimesh.creation.icosphere(int(rng.integers(2, 6)), s)]
    elif kind == 1:
        meshes = [cylinder(0.5 * s, 2 * s, sections=int(rng.integers(8, 200)))]
    elif kind == 2:
        meshes = [trimesh.creation.torus(0.8 * s, 0.25 * s, int(rng.integers(16, 64)), int(rng.integers(8, 48)))]
    elif kind == 3:  # a camera of boxes and small cylinders that run into one another
        meshes = [box((1.6 * s, 0.5 * s, s)), cylinder(0.4 * s, 0.8 * s, sections=64), box((0.1 * s, 0.1 * s, 1.2 * s))]
    elif kind == 4:  # rods of a millimetre or two
        meshes = [cylinder(rng.uniform(0.0005, 0.002), 2 * s, sections=6) for _ in range(6)]
        for mesh in meshes:
            mesh.apply_transform(pose(uniform_rotation(rng), rng.uniform(-0.3 * s, 0.3 * s, 3)))
    elif kind == 5:  # a bowl without thickness: an open surface, seen from both sides
        meshes = [trimesh.creation.icosphere(4, s)]
        meshes[0].update_faces(meshes[0].triangles_center[:, 2] < 0.1 * s)
    elif kind == 6:
        meshes = [trimesh.creation.annulus(0.6 * s, 0.65 * s, 1.8 * s, sections=int(rng.integers(24, 128)))]
    else:  # two thin boards, like an open laptop
        meshes = [box((2 * s, 1.4 * s, 0.004)), box((2 * s, 0.003, 1.4 * s))]
        meshes[1].apply_translation((0, 0.7 * s, 0.7 * s))
    return Shape(tuple(part_of(mesh, tuple(rng.uniform(0.1, 0.9, 3)), smooth=kind in (0, 2)) for mesh in meshes))


def stand(shape: Shape, rotation: Array, spot: Array, height: float) -> Pose:
    """[4, 4] float64: turned, and set down so that its lowest vertex is at `height` exactly."""
    turned = transform(pose(rotation, np.zeros(3)), shape.vertices)
    return pose(rotation, np.array([*spot, height - turned[:, 2].min()]))


def random_things(rng: np.random.Generator) -> tuple[list[Placed], float]:
    """(floor, a table, one to three objects on it, the height of the table's top).

    Objects do not touch one another: along a line where two surfaces cut through each other there is no edge.
    """
    table, height = table_shape(rng)
    things = [floor(), Placed(2, table, np.eye(4))]
    taken: list[Array] = []
    for _ in range(1 + int(rng.integers(3))):
        shape = object_shape(rng)
        upright = rng.random() < 0.5
        rotation = rotation_about(UP, rng.uniform(-np.pi, np.pi)) if upright else uniform_rotation(rng)
        radius, spot = float(np.linalg.norm(shape.vertices, axis=1).max()), rng.uniform(-0.25, 0.25, 2)
        if all(np.hypot(*(spot - other[:2])) > radius + other[2] for other in taken):
            taken.append(np.array([*spot, radius]))
            things.append(Placed(2 + len(taken), shape, stand(shape, rotation, spot, height)))
    return things, height


def orbit_and_mirror(rng: np.random.Generator, height: float, k: Intrinsics = VGA) -> tuple[Camera, Camera]:
    """An input camera of the dataset's orbit about the middle of the table top, and a mirror camera across from it."""
    T = orbit_pose(np.array([0.0, 0.0, height]), rng.uniform(0.7, 0.9), rng.uniform(-np.pi, np.pi), 2.5)
    return Camera(k, T), Camera(k, mirror_pose(T, rng.uniform(2.1, 2.7)))


def procedural_things(rng: np.random.Generator) -> tuple[list[Placed], float]:
    """(floor, a built-in table, one built-in object of any category on it, the height of the table's top)."""
    catalogue = built_in_assets()
    table = load_asset(catalogue, choose_table(catalogue, rng))
    category = CATEGORIES[int(rng.integers(len(CATEGORIES)))]
    thing = load_asset(catalogue, choose_object(catalogue, category, rng))
    height = float(table.extents_m[2])
    turn = rotation_about(UP, rng.uniform(-np.pi, np.pi)) if rng.random() < 0.8 else uniform_rotation(rng)
    return [
        floor(),
        Placed(2, table.shape, stand(table.shape, np.eye(3), np.zeros(2), 0.0)),
        Placed(3, thing.shape, stand(thing.shape, turn, rng.uniform(-0.25, 0.25, 2), height)),
    ], height


def five_procedural_things(rng: np.random.Generator) -> tuple[list[Placed], float]:
    """The same with four further objects, none within the circle about another."""
    things, height = procedural_things(rng)
    catalogue, taken = built_in_assets(), list[Array]()

    def reach(shape: Shape) -> float:
        return float(np.linalg.norm(shape.vertices, axis=1).max())

    taken.append(np.array([*things[2].T_world_shape[:2, 3], reach(things[2].shape)]))
    while len(taken) < 5:
        category = CATEGORIES[int(rng.integers(len(CATEGORIES)))]
        shape = load_asset(catalogue, choose_object(catalogue, category, rng)).shape
        turn = rotation_about(UP, rng.uniform(-np.pi, np.pi)) if rng.random() < 0.5 else uniform_rotation(rng)
        spot = rng.uniform(-0.45, 0.45, 2)
        if all(np.hypot(*(spot - other[:2])) > reach(shape) + other[2] for other in taken):
            taken.append(np.array([*spot, reach(shape)]))
            things.append(Placed(2 + len(taken), shape, stand(shape, turn, spot, height)))
    return things, height


@functools.cache
def built_in_assets() -> Catalogue:
    """The catalogue of a job that names no sources."""
    return open_catalogue(Assets(), Path(), CATEGORIES)


# ---------------------------------------------------------------------------------------------- looks

Look = tuple[Render, EffectPlan]

_SHADED = ("rgb", "shadows", "ambient_occlusion", "antialiasing")
_DRAWN = ("floor", "table", "textures", "transparency")

FLAT: Look = Render(tier="flat"), EffectPlan(("rgb", "floor", "table", "textures"), {})
RASTER: Look = Render(tier="raster"), EffectPlan((*_SHADED, *_DRAWN, "light_maps"), {})
FOUR: Look = Render(tier="raster", samples=4), EffectPlan((*_SHADED, "samples", *_DRAWN, "light_maps"), {})
_TRACED = EffectPlan(("rgb", "global_illumination", "glass", *_DRAWN), {})


def paths(samples: int, bounces: int = 8) -> Look:
    """The path-traced look."""
    return Render(tier="pathtraced", path_samples=samples, path_bounces=bounces), _TRACED


def without(look: Look, *names: str) -> Look:
    """The look with effects withdrawn from its plan; the numbers of the job stay."""
    assert set(names) <= set(look[1].ran), "it does not run anyway"
    return look[0], replace(look[1], ran=tuple(name for name in look[1].ran if name not in names))


def forcing(look: Look, *names: str) -> Look:
    """The look with effects forced, as the plan has them: what is forced runs."""
    ran = (*look[1].ran, *(name for name in names if name not in look[1].ran))
    return look[0], replace(look[1], ran=ran, forced=frozenset(names))


BLACK = (0.0, 0.0, 0.0)
DOWN = Appearance(BLACK, (Light(frozen_array([0.6, 0.0, 0.8]), (0.9, 0.9, 0.9)),), BLACK)
"""One light from +x, 53 degrees above the horizon, and nothing else."""


WHITE_MATTE = Material((1.0, 1.0, 1.0, 1.0), roughness=1.0)


def white_floor() -> Placed:
    """A matte floor that reflects all light."""
    (part,) = floor().shape.parts
    return Placed(1, Shape((Part("p", part.vertices, part.faces, WHITE_MATTE),)), EYE)


def brightness(rgb: Array) -> Array:
    """[H, W] linear green light."""
    return decode_srgb(rgb[..., 1] / 255.0)


def pixel_of(point: Array, view: Camera) -> tuple[float, float]:
    """(u, v) of a point of the world."""
    x, y, z = (invert(view.T_world_cam) @ np.append(point, 1.0))[:3]
    k = view.intrinsics
    return k.fx * x / z + k.cx, k.fy * y / z + k.cy


MITSUBA = importlib.util.find_spec("mitsuba") is not None
traced = pytest.mark.skipif(not MITSUBA, reason="Mitsuba is not installed: the path-traced tier goes untested")


def with_material(shape: Shape, material: Material) -> Shape:
    return Shape(tuple(Part(p.name, p.vertices, p.faces, material, p.normals, p.uv, p.colors) for p in shape.parts))


def matte(albedo: float) -> Material:
    """The sRGB value whose linear light is `albedo`."""
    s = 12.92 * albedo if albedo <= 0.0031308 else 1.055 * albedo ** (1 / 2.4) - 0.055
    return Material((s, s, s, 1.0), roughness=1.0)
