"""Pure: the built-in assets; the same instance for the same category, seed and index, in every version."""

import hashlib
from collections.abc import Callable

import numpy as np

from schemas.base import frozen_array
from schemas.job.assets import TABLE, ProceduralSource
from schemas.scene.shape import Asset, Lofted, Shape
from workers.assets.builtin.bottle import make_bottle
from workers.assets.builtin.box import make_box
from workers.assets.builtin.camera import make_camera
from workers.assets.builtin.can import make_can
from workers.assets.builtin.crockery import make_bowl, make_mug
from workers.assets.builtin.identity import instance_id
from workers.assets.builtin.jar import make_jar
from workers.assets.builtin.laptop import make_laptop
from workers.assets.builtin.parts import Model, cut_into_parts
from workers.assets.builtin.table import make_table
from workers.assets.mass import solid_mass
from workers.geometry.frames import pose
from workers.geometry.mesh import bounds_of

LICENCE = "CC0-1.0"
GENERATORS: dict[str, tuple[int, Callable[[np.random.Generator], Model]]] = {
    "bottle": (0, make_bottle),
    "camera": (1, make_camera),
    "can": (2, make_can),
    "jar": (3, make_jar),
    "laptop": (4, make_laptop),
    "mug": (5, make_mug),
    "bowl": (6, make_bowl),
    "box": (7, make_box),
    TABLE: (8, make_table),
}
"""The number of each category in the seed's spawn key, which never changes, and its generator."""


def make_model(category: str, seed: int, index: int) -> Model:
    """Instance `index` of a category, in true metres; the same bits for the same arguments."""
    number, make = GENERATORS[category]
    return make(np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, index))))


def make_asset(category: str, settings: ProceduralSource, index: int, density_kg_m3: float) -> Asset:
    """Instance `index` of a category as an asset; objects are scaled to `diagonal_m` unless `size` is metric."""
    model = make_model(category, settings.seed, index)
    lofts, (lower, upper) = model.solid.lofts, bounds_of(model.solid.vertices)
    centre, extent = 0.5 * (lower + upper), upper - lower
    scale = 1.0
    if category != TABLE and settings.size == "article":
        scale = settings.diagonal_m / float(np.sqrt((extent * extent).sum()))
    shape = cut_into_parts(model.solid, model.surfaces, centre, scale)
    mass = solid_mass((model.solid.vertices - centre) * scale, model.solid.faces, density_kg_m3)
    return Asset(
        instance_id=instance_id(category, settings.seed, index),
        category=category,
        source="procedural",
        licence=LICENCE,
        path=None,
        sha256=shape_digest(shape),
        shape=shape,
        mass=mass,
        T_source_to_object=frozen_array(pose(np.eye(3), -scale * centre)),
        scale=scale,
        watertight=True,
        volume_m3=mass.mass_kg / density_kg_m3,
        shareable=True,
        lofted=None if lofts is None else Lofted(lofts, scale * np.eye(3), -scale * centre),
    )


def shape_digest(shape: Shape) -> str:
    """SHA-256 over the arrays and materials of every part, in hexadecimal."""
    digest = hashlib.sha256()
    for part in shape.parts:
        material = part.material
        images = material.texture, material.transmission_map
        arrays = (part.vertices, part.faces, part.normals, part.uv, part.colors, *images)
        shapes = [None if array is None else array.shape for array in arrays]
        scalars = (material.base_color, material.metallic, material.roughness, material.transmission, material.ior)
        digest.update(repr((part.name, *scalars, shapes)).encode())
        for array in arrays:
            if array is not None:
                digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
