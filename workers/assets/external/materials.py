"""Pure: the materials, texture coordinates and colours that trimesh read, in the terms of schemas.scene.shape."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import MultiMaterial, PBRMaterial, SimpleMaterial

from schemas.base import Array
from schemas.scene.shape import Material
from workers.assets.external.caps import describe_error
from workers.geometry.colour import encode_srgb

MIN_TINT = 0.02
"""Darkest base colour that multiplies a texture; below it the colour is an exporter's leftover and is ignored."""
MIN_ALPHA = 0.01
"""Smallest alpha that is believed; below it alpha is 1, because some exporters write opacity inverted."""
WHITE = Material(base_color=(1.0, 1.0, 1.0, 1.0))
DEFAULT = Material()
"""The material of a mesh that has none; parts with it are recognised by identity."""


@dataclass(frozen=True, eq=False)
class MeshVisual:
    """Material, uv [V, 2] or None, colors [V, 4] uint8 sRGB or None, face_colors [F, 4] uint8 sRGB or None."""

    material: Material
    uv: Array | None = None
    colors: NDArray[np.uint8] | None = None
    face_colors: NDArray[np.uint8] | None = None


def read_visual(mesh: trimesh.Trimesh, linear: bool) -> tuple[MeshVisual, tuple[str, ...]]:
    """The material and colours of one trimesh geometry, and notes. `linear`: its colours are linear, as glTF's are."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        uv = getattr(visual, "uv", None)
        usable = uv is not None and np.shape(uv) == (len(mesh.vertices), 2) and bool(np.isfinite(uv).all())
        material, notes = _material(visual.material, textured=usable)
        colors = _attribute_colors(visual.vertex_attributes.get("color"), len(mesh.vertices), linear)
        return MeshVisual(material, np.asarray(uv, dtype=np.float64) if usable else None, colors), notes
    if visual.kind == "vertex" and len(visual.vertex_colors) == len(mesh.vertices):
        return MeshVisual(WHITE, colors=_colors(visual.vertex_colors, linear)), ()
    if visual.kind == "face" and len(visual.face_colors) == len(mesh.faces):
        return MeshVisual(WHITE, face_colors=_colors(visual.face_colors, linear)), ()
    return MeshVisual(DEFAULT), ()


def _colors(values: NDArray, linear: bool) -> NDArray[np.uint8]:
    rgba = np.asarray(values, dtype=np.uint8).copy()
    if linear:
        rgba[:, :3] = np.round(255.0 * encode_srgb(rgba[:, :3] / 255.0)).astype(np.uint8)
    return rgba


def _attribute_colors(values: NDArray | None, count: int, linear: bool) -> NDArray[np.uint8] | None:
    """Vertex colours stored beside a material, as floats in [0, 1] or as integers that use the whole range of their type."""
    if values is None or np.shape(values) not in ((count, 3), (count, 4)):
        return None
    whole = np.issubdtype(values.dtype, np.integer)
    share = np.ones((count, 4))
    share[:, : values.shape[1]] = values / np.iinfo(values.dtype).max if whole else values
    if not np.isfinite(share).all():
        return None
    share = np.clip(share, 0.0, 1.0)
    if linear:
        share[:, :3] = encode_srgb(share[:, :3])
    return np.round(255.0 * share).astype(np.uint8)


def _material(source: object, textured: bool) -> tuple[Material, tuple[str, ...]]:
    if isinstance(source, MultiMaterial):
        source = source.materials[0] if source.materials else None
    notes: list[str] = []
    if isinstance(source, PBRMaterial):
        texture = _texture(source.baseColorTexture, notes) if textured else None
        factor = np.ones(4) if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255.0
        color = np.append(encode_srgb(factor[:3]), factor[3])
        metallic = 1.0 if source.metallicFactor is None else float(source.metallicFactor)
        roughness = 1.0 if source.roughnessFactor is None else float(source.roughnessFactor)
    elif isinstance(source, SimpleMaterial):
        texture = _texture(source.image, notes) if textured else None
        color = np.asarray(source.diffuse, dtype=np.float64) / 255.0
        color[3] = _opacity(source, float(color[3]))
        metallic = 0.0
        # Blinn-Phong exponent to GGX alpha, and alpha to perceptual roughness (Karis, "Specular BRDF reference", 2013).
        roughness = (2.0 / (max(source.glossiness, 0.0) + 2.0)) ** 0.25
    else:
        return DEFAULT, ()
    if color[3] < MIN_ALPHA:
        color[3] = 1.0
        notes.append("an alpha of 0 was read as 1")
    if texture is not None and color[:3].max() < MIN_TINT:
        color[:3] = 1.0
    base = tuple(float(c) for c in np.clip(np.nan_to_num(color, nan=0.7), 0.0, 1.0))
    finite = [float(np.clip(np.nan_to_num(value, nan=0.6), 0.0, 1.0)) for value in (metallic, roughness)]
    return Material((base[0], base[1], base[2], base[3]), finite[0], finite[1], texture), tuple(notes)


def _opacity(source: SimpleMaterial, otherwise: float) -> float:
    """The `d` of an MTL file; `Tr` is ignored, because half of the exporters write it inverted."""
    try:
        return float(source.kwargs["d"][0])
    except (KeyError, IndexError, TypeError, ValueError):
        return otherwise


def _texture(image: Image.Image | None, notes: list[str]) -> NDArray[np.uint8] | None:
    """[h, w, 3 or 4] uint8, read-only; None with a note where the image cannot be decoded."""
    if image is None:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            alpha = "A" in image.getbands() or "transparency" in image.info
            pixels = np.array(image.convert("RGBA" if alpha else "RGB"), dtype=np.uint8)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        notes.append(f"a texture cannot be decoded ({describe_error(error)}): plain base colour used")
        return None
    pixels.setflags(write=False)
    return pixels
