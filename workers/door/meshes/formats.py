"""Edge: the formats of mesh files, one row of `FORMATS` each, and a file as one clean shape behind caps.

A new format is a row, and a module that lists what a file names and reads its meshes as `RawMesh`, each with the material of
`make_material` and a picture of `decode_picture`.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Part
from workers.door import opening
from workers.door.meshes.caps import Budget, FolderResolver, check_counts, check_nodes
from workers.door.meshes.dae import named_by_dae, read_dae
from workers.door.meshes.gltf import named_by_gltf, read_gltf
from workers.door.meshes.mesh import LoadedMesh, RawMesh, clean_shape, place_mesh
from workers.door.meshes.mjcf import count_msh, read_msh
from workers.door.meshes.obj import count_obj, named_by_mtl, named_by_obj, read_obj
from workers.door.meshes.plain import count_stl, read_off, read_stl
from workers.door.meshes.ply import count_ply, decode_head, named_by_ply, read_ply
from workers.door.opening import as_utf8


@dataclass(frozen=True)
class Format:
    """How a kind of mesh file is read.

    named: the files that its bytes refer to, by name; read: its meshes, with notes in the resolver; counted: how many
    vertices and faces its bytes declare, where that is known before they are parsed; decoded: what is text in UTF-8, with a
    note, as `as_utf8`.
    """

    named: Callable[[Path, bytes], list[str]]
    read: Callable[[Path, bytes, FolderResolver], list[RawMesh]]
    counted: Callable[[bytes], tuple[int, int]] | None = None
    decoded: Callable[[bytes], tuple[bytes, str | None]] = lambda data: (data, None)


FORMATS: Mapping[str, Format] = {
    ".glb": Format(named_by_gltf, read_gltf),
    ".gltf": Format(named_by_gltf, read_gltf, decoded=as_utf8),
    ".dae": Format(named_by_dae, read_dae, decoded=as_utf8),
    ".obj": Format(named_by_obj, read_obj, count_obj, as_utf8),
    ".ply": Format(named_by_ply, read_ply, count_ply, decode_head),
    ".msh": Format(lambda *_: [], read_msh, count_msh),
    ".off": Format(lambda *_: [], read_off, decoded=as_utf8),
    ".stl": Format(lambda *_: [], read_stl, count_stl),
}
"""The formats of mesh files by suffix, the one that says most about a thing first."""


def load_shape(path: Path, limits: MeshLimits, root: Path | None = None, budget: Budget | None = None) -> LoadedMesh:
    """A mesh file's shape: finite, in range, no doubled or empty faces, wound outwards where it is closed.

    Material files and textures are looked for below `root` (default: the mesh's own folder) and nowhere else; a
    missing or refused one leaves the plain base colour and a note. `budget` counts what a whole asset reads. Raises
    MeshError with one of the reasons `missing`, `format`, `too_large`, `unreadable`, `index_out_of_range`, `not_finite`,
    `no_faces`.
    """
    resolver = FolderResolver(path, root or path.parent, limits, budget)
    data = read_bytes(path, limits)
    row = FORMATS[path.suffix.lower()]
    data, encoding = row.decoded(data)
    if encoding is not None:
        resolver.notes.append(f"{path.name} {encoding}")
    if (why := resolver.budget.take_file(len(data))) is not None:
        raise MeshError("too_large", f"{path} {why}")
    if row.counted is not None:
        check_counts(path, *row.counted(data), limits)
    meshes = [mesh for mesh in row.read(path, data, resolver) if len(mesh.faces)]
    check_nodes(path, len(meshes), "parts", limits)
    check_counts(path, sum(len(m.vertices) for m in meshes), sum(len(m.faces) for m in meshes), limits)
    if not meshes:
        raise MeshError("no_faces", f"{path} has no triangles")
    shape, mended = clean_shape(path, [place_mesh(path, _opaque(mesh, resolver.notes)) for mesh in meshes])
    parts = tuple(with_jpeg(part, resolver) for part in shape.parts)
    return LoadedMesh(replace(shape, parts=parts), tuple(dict.fromkeys([*resolver.notes, *mended])))


def _opaque(mesh: RawMesh, notes: list[str]) -> RawMesh:
    """The mesh with colours of vertices or faces whose alpha of 0 is 1: some exporters leave it out, and none is drawn."""
    colors, face_colors = (_filled(values) for values in (mesh.visual.colors, mesh.visual.face_colors))
    if colors is mesh.visual.colors and face_colors is mesh.visual.face_colors:
        return mesh
    notes.append("an alpha of 0 of vertices or faces was read as 1")
    return replace(mesh, visual=replace(mesh.visual, colors=colors, face_colors=face_colors))


def _filled(colors: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
    if colors is None or colors[:, 3].all():
        return colors
    return np.where((colors[:, 3:] == 0) & (np.arange(4) == 3), np.uint8(255), colors)


def with_jpeg(part: Part, resolver: FolderResolver) -> Part:
    """The part with the file of its picture, if the resolver decoded that from a JPEG."""
    jpeg = resolver.jpeg_of(part.material.texture)
    return part if jpeg is None else replace(part, material=replace(part.material, jpeg=jpeg))


def list_mesh_files(path: Path, root: Path, limits: MeshLimits) -> list[Path]:
    """A mesh file, then its material files and textures that exist below `root`; checks what the mesh declares.

    Raises MeshError `missing`, `format`, `too_large` or `unreadable`.
    """
    data = read_bytes(path, limits)
    row = FORMATS[path.suffix.lower()]
    data, _ = row.decoded(data)
    # No format writes a vertex or a face in fewer than 8 bytes: a shorter file needs no counting.
    if row.counted is not None and len(data) > 8 * min(limits.max_vertices, limits.max_faces):
        check_counts(path, *row.counted(data), limits)
    resolver = FolderResolver(path, root, limits)
    found = _find(resolver, row.named(path, data))
    for material in [file for file in found if file.suffix.lower() == ".mtl"]:
        found += _find(resolver, named_by_mtl(as_utf8(material.read_bytes())[0]))
    return list(dict.fromkeys([path, *found]))


def read_bytes(path: Path, limits: MeshLimits) -> bytes:
    """A mesh file's bytes; MeshError `missing`, `irregular`, `format` or `too_large`."""
    if path.suffix.lower() not in FORMATS:
        raise MeshError(
            "format", f"{path}: {path.suffix or 'no suffix'} is not one of {', '.join(FORMATS)}: export it as .glb"
        )

    def refuse(reason: str, sentence: str) -> MeshError:
        large = f"{path} is over max_file_mb = {limits.max_file_mb:g}"
        return MeshError(reason, large if reason == "too_large" else sentence)

    return opening.read_bytes(path, int(limits.max_file_mb * 1e6), refuse)


def _find(resolver: FolderResolver, names: Iterable[str]) -> list[Path]:
    """The files of as many different names as an asset may read."""
    first = islice(dict.fromkeys(names), resolver.limits.max_nodes)
    return [file for name in first if (file := resolver.find(name)) is not None]
