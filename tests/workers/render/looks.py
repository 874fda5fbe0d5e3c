"""Looks for tests of the renderer: a tier's settings, and the plan of effects of a scene that calls for all it has.

What the tests of the path-traced tier share.
"""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from schemas.base import Array, frozen_array
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import Appearance, Light, Material, Part, Shape
from schemas.scene.view import Camera
from tests.workers.render.random_scenes import EYE, floor
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import invert

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
