"""Edge: the formats of mesh files, one row of `FORMATS` each, and a file as one clean shape behind caps.

A row says which files a file names, how it is read, and whether its size is known before it is parsed. A new format is a row.
glTF has a reader of its own; OBJ, STL and PLY are read by trimesh, to which `FolderResolver` gives material files and pictures.
"""

import io
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import MultiMaterial, PBRMaterial, SimpleMaterial

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Material
from workers.assets.external.caps import (
    Budget,
    FolderResolver,
    check_counts,
    check_nodes,
    declared_counts,
    describe_error,
    picture_pixels,
)
from workers.assets.external.gltf import named_by_gltf, read_gltf
from workers.assets.external.mesh import (
    DEFAULT,
    WHITE,
    LoadedMesh,
    MeshVisual,
    RawMesh,
    clean_shape,
    make_material,
    place_mesh,
)
from workers.geometry.colour import encode_srgb

_OBJ_COUNTED_BACK = re.compile(rb"^f[ \t][^\n]*-\d", re.MULTILINE)
_MAP_KD = re.compile(rb"^[ \t]*map_Kd[ \t]+([^\r\n]+)", re.MULTILINE | re.IGNORECASE)
_PLY_TEXTURE = re.compile(rb"^comment TextureFile[ \t]+([^\r\n]+)", re.MULTILINE)
_MTLLIB = re.compile(rb"mtllib[ \t]+([^\r\n]+)")


def load_shape(path: Path, limits: MeshLimits, root: Path | None = None, budget: Budget | None = None) -> LoadedMesh:
    """A mesh file's shape: finite, in range, no doubled or empty faces, wound outwards where it is closed.

    Material files and textures are looked for below `root` (default: the mesh's own folder) and nowhere else; a
    missing or refused one leaves the plain base colour and a note. `budget` counts what a whole asset reads. Raises
    MeshError with one of the reasons `missing`, `format`, `too_large`, `unreadable`, `index_out_of_range`, `not_finite`,
    `no_faces`.
    """
    resolver = FolderResolver(path, root or path.parent, limits, budget)
    data = read_bytes(path, limits)
    if (why := resolver.budget.take_file(len(data))) is not None:
        raise MeshError("too_large", f"{path} {why}")
    meshes = [mesh for mesh in FORMATS[path.suffix.lower()].read(path, data, resolver) if len(mesh.faces)]
    check_nodes(path, len(meshes), "parts", limits)
    check_counts(path, sum(len(m.vertices) for m in meshes), sum(len(m.faces) for m in meshes), limits)
    if not meshes:
        raise MeshError("no_faces", f"{path} has no triangles")
    shape, mended = clean_shape(path, [place_mesh(path, f"part{k}", mesh) for k, mesh in enumerate(meshes)])
    return LoadedMesh(shape, tuple(dict.fromkeys([*resolver.notes, *mended])))


def list_mesh_files(path: Path, root: Path, limits: MeshLimits) -> list[Path]:
    """A mesh file, then its material files and textures that exist below `root`; checks what the mesh declares.

    Raises MeshError `missing`, `format`, `too_large` or `unreadable`.
    """
    data, row = read_bytes(path, limits), FORMATS[path.suffix.lower()]
    # No format writes a vertex or a face in fewer than 8 bytes: a shorter file needs no counting.
    if row.counted and len(data) > 8 * min(limits.max_vertices, limits.max_faces):
        check_counts(path, *declared_counts(path.suffix.lower(), data), limits)
    resolver = FolderResolver(path, root, limits)
    found = _find(resolver, row.named(path, data))
    for material in [file for file in found if file.suffix.lower() == ".mtl"]:
        found += _find(resolver, _decode(_MAP_KD.findall(material.read_bytes())))
    return list(dict.fromkeys([path, *found]))


def read_bytes(path: Path, limits: MeshLimits) -> bytes:
    """A mesh file's bytes; MeshError `missing`, `format` or `too_large`."""
    if path.suffix.lower() not in FORMATS:
        raise MeshError("format", f"{path}: {path.suffix or 'no suffix'} is not one of {', '.join(FORMATS)}")
    try:
        size = path.stat().st_size
        if size > limits.max_file_mb * 1e6:
            raise MeshError("too_large", f"{path} has {size / 1e6:.1f} MB, over max_file_mb = {limits.max_file_mb:g}")
        return path.read_bytes()
    except OSError as error:
        raise MeshError("missing", f"{path} cannot be read: {error.strerror}") from error


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


def _read_by_trimesh(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The meshes of an OBJ, STL or PLY file; MeshError `too_large`, `index_out_of_range` or `unreadable`."""
    kind = path.suffix.lower()
    check_counts(path, *declared_counts(kind, data), resolver.limits)
    if kind == ".obj" and _OBJ_COUNTED_BACK.search(data) is not None and data.rfind(b"\nv ") > data.find(b"\nf "):
        raise MeshError("unreadable", f"{path} counts vertices back from each face, which is not supported")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], resolver=resolver, process=False)
    except MemoryError:
        raise
    except IndexError as error:
        raise MeshError("index_out_of_range", f"{path}: a face names a vertex that is not there ({error})") from error
    except Exception as error:
        raise MeshError(
            "unreadable", f"{path} is not a {kind[1:]} file that can be read: {describe_error(error):.200}"
        ) from error
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


@dataclass(frozen=True)
class Format:
    """How a kind of mesh file is read.

    named: the files that its bytes refer to, by name; read: its meshes, with notes in the resolver; counted: whether
    `declared_counts` knows how many vertices and faces its bytes hold.
    """

    named: Callable[[Path, bytes], list[str]]
    read: Callable[[Path, bytes, FolderResolver], list[RawMesh]]
    counted: bool = True


FORMATS: Mapping[str, Format] = {
    ".glb": Format(named_by_gltf, read_gltf, counted=False),
    ".gltf": Format(named_by_gltf, read_gltf, counted=False),
    ".obj": Format(lambda _, data: material_files(data), _read_by_trimesh),
    ".ply": Format(lambda _, data: _decode(_PLY_TEXTURE.findall(data)), _read_by_trimesh),
    ".stl": Format(lambda *_: [], _read_by_trimesh),
}
"""The formats of mesh files by suffix, the one that says most about a thing first."""


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
        return MeshVisual(
            WHITE, colors=_attribute_colors(np.asarray(visual.vertex_colors), len(mesh.vertices), linear)
        ), ()
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
    if isinstance(source, MultiMaterial):
        source = source.materials[0] if source.materials else None
    notes: list[str] = []
    if isinstance(source, PBRMaterial):
        factor = np.ones(4) if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255.0
        metallic, roughness = (1.0 if x is None else float(x) for x in (source.metallicFactor, source.roughnessFactor))
        texture = _texture(source.baseColorTexture, notes) if textured else None
        return make_material(np.append(encode_srgb(factor[:3]), factor[3]), metallic, roughness, texture)
    if not isinstance(source, SimpleMaterial):
        return DEFAULT, ()
    texture = _texture(source.image, notes) if textured else None
    color = np.asarray(source.diffuse, dtype=np.float64) / 255.0
    color[3] = _opacity(source, float(color[3]))
    # Blinn-Phong exponent to GGX alpha, and alpha to perceptual roughness (Karis, "Specular BRDF reference", 2013).
    roughness = (2.0 / (max(source.glossiness, 0.0) + 2.0)) ** 0.25
    material, more = make_material(color, 0.0, roughness, texture)
    return material, (*notes, *more)


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
            return picture_pixels(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        notes.append(f"a texture cannot be decoded ({describe_error(error)}): plain base colour used")
        return None
