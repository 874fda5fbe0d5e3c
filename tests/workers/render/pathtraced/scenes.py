"""What the tests of the path-traced tier share."""

import importlib.util

import pytest

from schemas.base import frozen_array
from schemas.scene.shape import Light, Material, Part, Shape

MITSUBA = importlib.util.find_spec("mitsuba") is not None
traced = pytest.mark.skipif(not MITSUBA, reason="Mitsuba is not installed: the path-traced tier goes untested")

DOWN = Light(frozen_array([0.0, 0.0, 1.0]), (0.7, 0.7, 0.7))


def with_material(shape: Shape, material: Material) -> Shape:
    return Shape(tuple(Part(p.name, p.vertices, p.faces, material, p.normals, p.uv, p.colors) for p in shape.parts))


def matte(albedo: float) -> Material:
    """The sRGB value whose linear light is `albedo`."""
    s = 12.92 * albedo if albedo <= 0.0031308 else 1.055 * albedo ** (1 / 2.4) - 0.055
    return Material((s, s, s, 1.0), roughness=1.0)
