"""Mitsuba's meshes and materials of a scene's parts: pure functions to its dictionaries.

The module `mitsuba` is an argument, because tracer.py alone imports it. Both sides of every face are drawn.
"""

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.effects import EffectPlan
from schemas.scene.shape import Material, Part
from workers.geometry.frames import transform
from workers.geometry.srgb import SRGB_STEPS, decode_srgb
from workers.geometry.texels import HOLE_ALPHA, has_holes
from workers.render.raster.batches import MATTE_ROUGHNESS, texture_of

Bsdf = dict[str, Any]

GLASS_PALENESS = 0.3
"""Each sheet of glass transmits its opaque colour to this power: a bottle of green (0.03 of the light, opaque) lets an eighth
through two walls, as wine bottles do."""

LEAST_WIDTH = 0.02
"""Least width of a lobe: a sharper mirror is noise at affordable numbers of samples."""

LEAST_METAL_WIDTH = 0.12
"""Least width of a metal's lobe, whose reflections of the key light would leave fireflies on surfaces nearby."""

VERTEX_COLOR = "vertex_color"


def planned_part(part: Part, effects: EffectPlan) -> Part:
    """The part without what the plan leaves out: textures, their holes, glass."""
    transmission = part.material.transmission if effects.runs("glass") else 0.0
    texture = part.material.texture if effects.runs("textures") else None
    if texture is not None and not effects.runs("transparency"):
        texture = texture[..., :3]
    return replace(part, material=replace(part.material, transmission=transmission, texture=texture))


def make_mesh(mi: ModuleType, part: Part, T_world_shape: Pose, name: str) -> Any:
    """A part as a Mitsuba mesh in world coordinates, with its material; `name` is its id."""
    flat = part.normals is None
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf_of(mi, part))
    properties["face_normals"] = flat
    mesh = mi.Mesh(name, len(part.vertices), len(part.faces), properties, not flat, part.uv is not None)
    values = mi.traverse(mesh)
    values["vertex_positions"] = _floats(transform(T_world_shape, part.vertices))
    values["faces"] = part.faces.astype(np.uint32).ravel()
    if part.normals is not None:
        values["vertex_normals"] = _floats(part.normals @ T_world_shape[:3, :3].T)
    if part.uv is not None:
        values["vertex_texcoords"] = _floats(np.stack([part.uv[:, 0], 1.0 - part.uv[:, 1]], axis=1))  # its v runs down
    if _has_vertex_colors(part):
        assert part.colors is not None
        colors = SRGB_STEPS[part.colors[:, :3]] * decode_srgb(np.array(part.material.base_color[:3]))
        mesh.add_attribute(VERTEX_COLOR, 3, _floats(colors))
    values.update()
    return mesh


def bsdf_of(mi: ModuleType, part: Part) -> Bsdf:
    """Diffuse, plastic, rough metal or a blend of them; thin glass where it transmits; a mask where texels are clear."""
    body = _opaque(part.material, _color(mi, part))
    if part.material.transmission > 0.0:
        body = _glass(mi, part, body)
    texture = texture_of(part)
    if texture is not None and has_holes(texture):
        solid = (texture[..., 3] >= HOLE_ALPHA).astype(np.float32)
        body = {"type": "mask", "opacity": _picture(mi, solid), "nested": body}
    return body


def _opaque(material: Material, color: Any) -> Bsdf:
    width = max(material.roughness**2, LEAST_WIDTH)
    metal: Bsdf = {"type": "roughconductor", "material": "none", "specular_reflectance": color}
    metal["alpha"] = max(width, LEAST_METAL_WIDTH)
    if material.metallic >= 1.0:
        return _both_sides(metal)
    if material.roughness >= MATTE_ROUGHNESS:
        body: Bsdf = {"type": "diffuse", "reflectance": color}
    else:
        body = {"type": "roughplastic", "alpha": width, "diffuse_reflectance": color, "int_ior": 1.5}
    if material.metallic <= 0.0:
        return _both_sides(body)
    return _both_sides({"type": "blendbsdf", "weight": material.metallic, "first": body, "second": metal})


def _glass(mi: ModuleType, part: Part, body: Bsdf) -> Bsdf:
    """A tinted sheet that transmits light without refraction and mirrors some of it.

    The surface of a vessel is one such sheet, as if the vessel were empty; so is a wall, whose second side has `ior` 1.
    Samples of the lamps also find light that crosses straight on, so that shadows of glass are tinted and without
    fireflies.
    """
    material = part.material
    if material.ior == 1.0:
        return {"type": "null"}
    sheet = {"type": "thindielectric", "int_ior": material.ior, "specular_transmittance": _rgb(tint_of(part))}
    if material.transmission_map is not None and part.uv is not None:
        weight: Any = _picture(mi, 1.0 - material.transmission * material.transmission_map.astype(np.float32) / 255.0)
    elif material.transmission >= 1.0:
        return sheet
    else:
        weight = 1.0 - material.transmission
    return {"type": "blendbsdf", "weight": weight, "first": sheet, "second": body}


def tint_of(part: Part) -> Array:
    """[3] share of linear light that crosses a sheet of glass; of a textured one, from the mean of its clearest texels."""
    material, texture = part.material, texture_of(part)
    color = decode_srgb(np.array(material.base_color[:3]))
    if texture is not None:
        clear = np.ones(texture.shape[:2], np.bool_)
        if material.transmission_map is not None and material.transmission_map.shape == texture.shape[:2]:
            clear = material.transmission_map == material.transmission_map.max()
        color = color * SRGB_STEPS[texture[..., :3][clear]].mean(axis=0)
    return np.asarray(color**GLASS_PALENESS, np.float64)


def _both_sides(bsdf: Bsdf) -> Bsdf:
    return {"type": "twosided", "nested": bsdf}


def _color(mi: ModuleType, part: Part) -> Any:
    """The albedo; a texture takes precedence over vertex colours, which Mitsuba cannot multiply it with."""
    factor = decode_srgb(np.array(part.material.base_color[:3]))
    texture = texture_of(part)
    if texture is not None:
        return _picture(mi, (SRGB_STEPS[texture[..., :3]] * factor).astype(np.float32))
    if _has_vertex_colors(part):
        return {"type": "mesh_attribute", "name": VERTEX_COLOR}
    return _rgb(factor)


def _has_vertex_colors(part: Part) -> bool:
    return part.colors is not None and texture_of(part) is None


def _picture(mi: ModuleType, linear: NDArray[np.float32]) -> Bsdf:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(linear)), "raw": True}


def _rgb(color: NDArray) -> Bsdf:
    return {"type": "rgb", "value": [float(c) for c in color]}


def _floats(array: NDArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, np.float32).ravel()
