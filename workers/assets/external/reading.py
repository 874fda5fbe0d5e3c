"""Edge: reads a mesh file from outside into trimesh, behind caps that hold before anything large is built."""

import io
import re
import warnings
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import trimesh

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from workers.assets.external.caps import FolderResolver, check_counts, declared_counts, describe_error
from workers.assets.external.glb_check import check_glb
from workers.assets.external.gltf_file import named_by_gltf, pack_gltf

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
