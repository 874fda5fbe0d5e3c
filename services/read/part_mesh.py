"""A part of a shape as a mesh of trimesh's, with its material."""

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from schemas.base import Array
from schemas.scene.shape import Part
from workers.geometry.colour import decode_srgb


def mesh_of_part(part: Part) -> trimesh.Trimesh:
    """The part in the shape's frame, metres. Its material is as glTF has it: colours linear, textures sRGB."""
    return trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, visual=_visual(part), process=False)


def _visual(part: Part) -> TextureVisuals | ColorVisuals:
    material = part.material
    if part.colors is not None and material.texture is None:
        return ColorVisuals(vertex_colors=linear_bytes(part.colors / 255.0))
    pbr = PBRMaterial(
        baseColorFactor=linear_bytes(np.array(material.base_color)),
        metallicFactor=material.metallic,
        roughnessFactor=material.roughness,
        baseColorTexture=None if material.texture is None else Image.fromarray(material.texture),
    )
    return TextureVisuals(uv=part.uv, material=pbr)


def linear_bytes(srgb: Array) -> NDArray[np.uint8]:
    """[..., 4] colours and vertex colours as glTF has them: linear, where textures and ours are sRGB; alpha as it is."""
    return np.rint(255.0 * np.concatenate([decode_srgb(srgb[..., :3]), srgb[..., 3:]], axis=-1)).astype(np.uint8)
