"""Edge: the formats of mesh files, one row of `FORMATS` each, and a file as one clean shape behind caps; readers of OFF and STL.

A new format is a row, and a module that lists what a file names and reads its meshes as `RawMesh`, each with the material of
`make_material` and a picture of `decode_picture`. A reader may raise whatever it likes of malformed bytes: that is refused here.
"""

import io
import re
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.errors import MeshError, VersoError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Part
from workers.door import opening
from workers.door.meshes.dae import named_by_dae, read_dae
from workers.door.meshes.gltf import named_by_gltf, read_gltf
from workers.door.meshes.mesh import LoadedMesh, clean_shape, place_mesh
from workers.door.meshes.mjcf import count_msh, read_msh
from workers.door.meshes.obj import count_obj, named_by_mtl, named_by_obj, read_obj
from workers.door.meshes.ply import count_ply, decode_head, named_by_ply, read_ply
from workers.door.meshes.raw import (
    DEFAULT,
    WHITE,
    Budget,
    FolderResolver,
    MeshVisual,
    RawMesh,
    check_counts,
    check_nodes,
    cut_faces,
)
from workers.door.opening import as_utf8, describe_error

_OFF = re.compile(r"\s*(ST)?(C)?(N)?(4)?(n)?OFF(?!\s+BINARY)")


def read_off(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The mesh of an OFF file as Geomview has it, with colours of vertices or of faces, whole numbers or shares.

    A reader of its own: trimesh leaves out colours, and cuts polygons as fans. MeshError `format` for a binary or one of four
    dimensions, `index_out_of_range`.
    """
    text = re.sub("#.*", "", data.decode("utf-8", "replace"))
    head = _OFF.match(text)
    if (head is None and text.lstrip()[:1].isalpha()) or (head is not None and (head[4] or head[5])):
        raise MeshError("format", f"{path} is not an OFF file of three dimensions in text: export it as .ply")
    lines = [line.split() for line in text[head.end() if head else 0 :].splitlines() if line.strip()]
    vertices, faces = int(lines[0][0]), int(lines[0][1])
    rows = np.array(lines[1 : 1 + vertices], dtype=np.float64).reshape(vertices, -1)
    listed = lines[1 + vertices : 1 + vertices + faces]
    if any(len(line) <= int(line[0]) for line in listed):  # faces over several lines, which then have no colours
        words = iter([word for line in lines[1 + vertices :] for word in line])
        listed = [[count, *islice(words, int(count))] for count in islice(words, faces)]
    counts = np.array([int(line[0]) for line in listed])
    corners = np.array([word for line in listed for word in line[1 : 1 + int(line[0])]], dtype=np.int64)
    if len(listed) < faces or len(corners) != counts.sum():
        raise ValueError(f"{len(listed)} of {faces} faces")
    places, face = cut_faces(path, corners, counts, rows[:, :3])
    first = 6 if head is not None and head[3] else 3
    colors = _off_colors(lines[1 : 1 + vertices], first) if head is not None and head[2] else None
    shown = None if colors is not None else _off_colors([line[int(line[0]) :] for line in listed], 1)
    normals = rows[:, 3:6] if first == 6 else None
    if any(len(line) == 2 + int(line[0]) for line in listed):
        resolver.notes.append("not drawn: colours of a map by their numbers")
    visual = MeshVisual(DEFAULT if colors is None and shown is None else WHITE, None, colors)
    visual = visual if shown is None else replace(visual, face_colors=shown[face])
    return [RawMesh(rows[:, :3], corners[places], normals, visual, np.eye(4))]


def _off_colors(lines: list[list[str]], first: int) -> NDArray[np.uint8] | None:
    """[N, 4] uint8 sRGB of the three or four words behind the `first` of each line; None where a line has none."""
    words = [line[first : first + 4] for line in lines]
    if not words or min(map(len, words)) < 3:
        return None
    shares = any("." in word for line in words for word in line)
    table = np.array([[*line, "1" if shares else "255"][:4] for line in words], dtype=np.float64)
    return np.round(np.clip(np.nan_to_num(table) * (255.0 if shares else 1.0), 0.0, 255.0)).astype(np.uint8)


def count_stl(data: bytes) -> tuple[int, int]:
    """Vertices and faces of an STL file; of the vertices of one in text nothing is known."""
    faces = _binary_faces(data)
    return (3 * faces, faces) if faces else (0, data.count(b"endfacet"))


def _binary_faces(data: bytes) -> int:
    """How many faces a binary STL file has; 0 for one in text, or that ends within a face.

    Some programs leave bytes behind the last face, and some a wrong count: then all whole faces are meant.
    """
    faces = _declared_faces(data)
    behind, text = len(data) - 84 - 50 * faces, b"facet" in data[:1024]
    if behind == 0 or (0 < behind < 1024 and behind % 50 and not (text and data[:5].lower() == b"solid")):
        return faces
    return 0 if text or behind % 50 else max(len(data) - 84, 0) // 50


def _declared_faces(data: bytes) -> int:
    return int(struct.unpack_from("<I", data, 80)[0]) if len(data) >= 84 else 0


_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The solids of an STL file: of a binary one its only one, of text by trimesh; MeshError `unreadable`."""
    declared = _declared_faces(data)
    if count := _binary_faces(data):
        if count != declared:
            resolver.notes.append(f"its head tells {declared} faces, and {count} are there: all were read")
        points = np.frombuffer(data, _STL_FACE, count, 84)["corners"].reshape(-1, 3)
        solids = [(points, np.arange(len(points)).reshape(-1, 3))]
    elif declared and b"facet" not in data[:1024]:
        whole = max(len(data) - 84, 0) // 50
        raise MeshError("unreadable", f"{path} ends early: {whole} of {declared} faces are there: copy it again")
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(io.BytesIO(data), file_type="stl", process=False)
        solids = [(np.asarray(mesh.vertices), mesh.faces.astype(np.int64)) for mesh in scene.geometry.values()]
    return [RawMesh(points, faces, None, MeshVisual(DEFAULT), np.eye(4)) for points, faces in solids]


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
    with _as_verdict(path):
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
    with _as_verdict(path):
        files = _find(resolver, row.named(path, data))
    for material in [file for file in files if file.suffix.lower() == ".mtl"]:
        files += _find(resolver, named_by_mtl(as_utf8(material.read_bytes())[0]))
    return list(dict.fromkeys([path, *files]))


@contextmanager
def _as_verdict(path: Path) -> Iterator[None]:
    """Around a reader: MeshError `unreadable` for whatever it raises of a stranger's bytes."""
    try:
        yield
    except (VersoError, MemoryError):
        raise
    except Exception as error:
        kind = path.suffix.lower()[1:]
        raise MeshError(
            "unreadable", f"{path} is not a {kind} file that can be read: {describe_error(error)}"
        ) from error


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
