"""Edge: reads STL files from outside by trimesh, and what trimesh made of a stored GLB."""

import io
import struct
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual.material import MultiMaterial, PBRMaterial, SimpleMaterial

from schemas.errors import MeshError
from schemas.scene.shape import Material
from workers.assets.external.caps import FolderResolver, decode_picture, unreadable
from workers.assets.external.mesh import DEFAULT, WHITE, MeshVisual, RawMesh, make_material
from workers.geometry.colour import encode_srgb


def count_stl(data: bytes) -> tuple[int, int]:
    """Vertices and faces of an STL file; of the vertices of one in text nothing is known."""
    faces = _binary_faces(data)
    return (3 * faces, faces) if faces else (0, data.count(b"endfacet"))


def _binary_faces(data: bytes) -> int:
    """How many faces a binary STL file has; 0 for one in text. Some programs leave bytes behind the last face."""
    faces = int(struct.unpack_from("<I", data, 80)[0]) if len(data) >= 84 else 0
    behind = len(data) - 84 - 50 * faces
    text = data[:5].lower() == b"solid" and b"facet" in data[:1024]
    return faces if behind == 0 or (0 < behind < 1024 and not text) else 0


def read_plain(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The meshes of a file that trimesh reads; MeshError `index_out_of_range` or `unreadable`."""
    kind = path.suffix.lower()[1:]
    if kind == "stl" and (count := _binary_faces(data)):
        data = data[: 84 + 50 * count]  # trimesh takes a file with bytes behind the last face for text
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=cast(Any, resolver), process=False)
    except MemoryError:
        raise
    except IndexError as error:
        raise MeshError("index_out_of_range", f"{path}: a face names a vertex that is not there ({error})") from error
    except Exception as error:
        raise unreadable(path, error) from error
    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            visual, notes = read_visual(mesh)
            resolver.notes += notes
            stated = "vertex_normals" in mesh._cache.cache  # trimesh would compute them
            normals = np.asarray(mesh.vertex_normals, dtype=np.float64) if stated else None
            faces = np.asarray(mesh.faces, dtype=np.int64)
            meshes.append(RawMesh(np.asarray(mesh.vertices), faces, normals, visual, np.asarray(matrix, np.float64)))
    return meshes


def read_visual(mesh: trimesh.Trimesh, linear: bool = False) -> tuple[MeshVisual, tuple[str, ...]]:
    """The material and colours of one trimesh geometry, and notes. `linear`: its colours are linear, as those of a stored GLB."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        uv = getattr(visual, "uv", None)
        usable = uv is not None and np.shape(uv) == (len(mesh.vertices), 2) and bool(np.isfinite(uv).all())
        material, notes = _material(visual.material, textured=usable)
        colors = _attribute_colors(visual.vertex_attributes.get("color"), len(mesh.vertices), linear)
        return MeshVisual(material, np.asarray(uv, dtype=np.float64) if usable else None, colors), notes
    if visual.kind == "vertex" and len(visual.vertex_colors) == len(mesh.vertices):
        colors = _attribute_colors(np.asarray(visual.vertex_colors), len(mesh.vertices), linear)
        return MeshVisual(WHITE, colors=colors), ()
    if visual.kind == "face" and len(visual.face_colors) == len(mesh.faces):
        return MeshVisual(WHITE, face_colors=np.asarray(visual.face_colors, dtype=np.uint8)), ()
    return MeshVisual(DEFAULT), ()


def _attribute_colors(values: NDArray | None, count: int, linear: bool) -> NDArray[np.uint8] | None:
    """Vertex colours, floats in [0, 1] or integers that use the whole range of their type, as [V, 4] uint8 sRGB."""
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
    """A material of trimesh's; the picture only where the mesh has coordinates for it."""
    if isinstance(source, MultiMaterial):
        source = source.materials[0] if source.materials else None
    if isinstance(source, PBRMaterial):
        image, factor = source.baseColorTexture, np.ones(4)
        if source.baseColorFactor is not None:
            factor = np.asarray(source.baseColorFactor) / 255.0
        color = np.append(encode_srgb(factor[:3]), factor[3])
        metallic, roughness = (1.0 if x is None else float(x) for x in (source.metallicFactor, source.roughnessFactor))
    elif isinstance(source, SimpleMaterial):
        image, color = source.image, np.asarray(source.diffuse, dtype=np.float64) / 255.0
        # `Tr` is ignored, because half of the exporters write it inverted.
        with suppress(KeyError, IndexError, TypeError, ValueError):
            color[3] = float(source.kwargs["d"][0])
        # Blinn-Phong exponent to GGX alpha, and alpha to perceptual roughness (Karis, "Specular BRDF reference", 2013).
        metallic, roughness = 0.0, (2.0 / (max(source.glossiness, 0.0) + 2.0)) ** 0.25
    else:
        return DEFAULT, ()
    notes: list[str] = []
    texture = decode_picture(image, notes) if textured and image is not None else None
    material, more = make_material(color, metallic, roughness, texture)
    return material, (*notes, *more)
