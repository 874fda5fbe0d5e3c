"""Pure: the built-in assets; the same instance for the same category, seed and index, in every version."""

import hashlib
import importlib
from collections.abc import Callable
from functools import cache

import numpy as np

from schemas.base import frozen_array
from schemas.job.assets import BUILT_IN, TABLE, ProceduralSource, instance_id
from schemas.scene.shape import Asset, Lofted, Shape
from workers.assets.builtin.parts import Model, cut_into_parts
from workers.assets.mass import solid_mass
from workers.geometry.frames import pose
from workers.geometry.mesh import bounds_of

LICENCE = "CC0-1.0"


def make_model(category: str, seed: int, index: int) -> Model:
    """Instance `index` of a category, in true metres; the same bits for the same arguments."""
    stream = np.random.SeedSequence(seed, spawn_key=(BUILT_IN[category].number, index))
    return _generator(BUILT_IN[category].generator)(np.random.default_rng(stream))


@cache
def _generator(name: str) -> Callable[[np.random.Generator], Model]:
    """The function of a `Category.generator`."""
    module, _, function = name.partition(":")
    make: Callable[[np.random.Generator], Model] = getattr(importlib.import_module(f"{__package__}.{module}"), function)
    return make


def make_asset(category: str, settings: ProceduralSource, index: int, density_kg_m3: float) -> Asset:
    """Instance `index` of a category as an asset; objects are scaled to `diagonal_m` unless `size` is metric."""
    model = make_model(settings.named(category), settings.seed, index)
    lofts, (lower, upper) = model.solid.lofts, bounds_of(model.solid.vertices)
    centre, extent = 0.5 * (lower + upper), upper - lower
    scale = 1.0
    if category != TABLE and settings.size == "article":
        scale = settings.diagonal_m / float(np.sqrt((extent * extent).sum()))
    shape = cut_into_parts(model.solid, model.surfaces, centre, scale)
    mass = solid_mass((model.solid.vertices - centre) * scale, model.solid.faces, density_kg_m3)
    return Asset(
        instance_id=instance_id(settings.named(category), settings.seed, index),
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
