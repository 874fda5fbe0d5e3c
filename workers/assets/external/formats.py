"""Edge: reads a mesh file from outside into trimesh, behind caps that hold before anything large is built; and its materials."""

import io
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import MultiMaterial, PBRMaterial, SimpleMaterial

from schemas.base import Array
from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Material
from workers.assets.external.caps import FolderResolver, check_counts, declared_counts, describe_error
from workers.assets.external.gltf import check_glb, named_by_gltf, pack_gltf
from workers.geometry.colour import encode_srgb

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf")
"""Formats that trimesh reads without further libraries."""

_OBJ_COUNTED_BACK = re.compile(rb"^f[ \t][^\n]*-\d", re.MULTILINE)
_MAP_KD = re.compile(rb"^[ \t]*map_Kd[ \t]+([^\r\n]+)", re.MULTILINE | re.IGNORECASE)
_PLY_TEXTURE = re.compile(rb"^comment TextureFile[ \t]+([^\r\n]+)", re.MULTILINE)
_MTLLIB = re.compile(rb"mtllib[ \t]+([^\r\n]+)")


def read_bytes(path: Path, limits: MeshLimits) -> bytes:
    """A mesh file's bytes; MeshError `missing`, `format` or `too_large`."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError("format", f"{path}: {path.suffix or 'no suffix'} is not one of {', '.join(MESH_SUFFIXES)}")
    try:
        size = path.stat().st_size
        if size > limits.max_file_mb * 1e6:
            raise MeshError("too_large", f"{path} has {size / 1e6:.1f} MB, over max_file_mb = {limits.max_file_mb:g}")
        return path.read_bytes()
    except OSError as error:
        raise MeshError("missing", f"{path} cannot be read: {error.strerror}") from error


def read_scene(path: Path, data: bytes, resolver: FolderResolver) -> trimesh.Scene:
    """The file as a trimesh scene, unprocessed; MeshError `too_large`, `index_out_of_range` or `unreadable`."""
    kind = path.suffix.lower()
    if kind == ".gltf":
        data, kind = pack_gltf(path, data, resolver), ".glb"
    if kind == ".glb":
        data = check_glb(path, data, resolver)
    else:
        check_counts(path, *declared_counts(kind, data), resolver.limits)
    if kind == ".obj" and _counts_back(data):
        raise MeshError("unreadable", f"{path} counts vertices back from each face, which is not supported")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], resolver=resolver, process=False)
    except MemoryError:
        raise
    except IndexError as error:
        raise MeshError("index_out_of_range", f"{path}: a face names a vertex that is not there ({error})") from error
    except Exception as error:
        raise MeshError(
            "unreadable", f"{path} is not a {kind[1:]} file that can be read: {describe_error(error):.200}"
        ) from error


def list_mesh_files(path: Path, root: Path, limits: MeshLimits) -> list[Path]:
    """A mesh file, then its material files and textures that exist below `root`; checks what the mesh declares.

    Raises MeshError `missing`, `format`, `too_large` or `unreadable`.
    """
    data = read_bytes(path, limits)
    kind = path.suffix.lower()
    # No format writes a vertex or a face in fewer than 8 bytes: a shorter file needs no counting.
    if kind not in (".glb", ".gltf") and len(data) > 8 * min(limits.max_vertices, limits.max_faces):
        check_counts(path, *declared_counts(kind, data), limits)
    resolver = FolderResolver(path, root, limits)
    found = _find(resolver, _references(path, kind, data))
    for material in [file for file in found if file.suffix.lower() == ".mtl"]:
        found += _find(resolver, _decode(_MAP_KD.findall(material.read_bytes())))
    return list(dict.fromkeys([path, *found]))


def _references(path: Path, kind: str, data: bytes) -> list[str]:
    """Names of the files that a mesh file's bytes ask for."""
    if kind == ".obj":
        return material_files(data)
    if kind == ".gltf":
        return named_by_gltf(path, data)
    return _decode(_PLY_TEXTURE.findall(data)) if kind == ".ply" else []


def _find(resolver: FolderResolver, names: Iterable[str]) -> list[Path]:
    """The files of as many different names as an asset may read."""
    first = islice(dict.fromkeys(names), resolver.limits.max_nodes)
    return [file for name in first if (file := resolver.find(name)) is not None]


def material_files(data: bytes) -> list[str]:
    """Names of the material files that an OBJ file's bytes ask for."""
    # Anchoring the expression to line starts would make it ten times slower, and it reads every byte of every mesh.
    matches = _MTLLIB.finditer(data)
    return _decode(m.group(1) for m in matches if m.start() == 0 or data[m.start() - 1 : m.start()].isspace())


def _decode(names: Iterable[bytes]) -> list[str]:
    return [name.decode("utf-8", "replace").strip() for name in names]


def _counts_back(data: bytes) -> bool:
    """Whether an OBJ file has negative indices that do not count from the end of the file."""
    return _OBJ_COUNTED_BACK.search(data) is not None and data.rfind(b"\nv ") > data.find(b"\nf ")


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
