"""Edge: reads PLY files from outside by the library plyfile, OFF, STL by trimesh, and what trimesh made of a stored GLB.

What the elements of a PLY mean is not in the format. Read are the names that MeshLab, CloudCompare, Blender, the Stanford scans
and BOP write: colours of vertices and faces, coordinates of pictures by vertex or by corner, several pictures, and strips of
triangles.
"""

import io
import re
import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from schemas.base import Array
from schemas.errors import MeshError
from schemas.scene.shape import Material
from workers.door.meshes.caps import FolderResolver, decode_names, decode_picture, unreadable
from workers.door.meshes.mesh import (
    DEFAULT,
    WHITE,
    Indices,
    MeshVisual,
    RawMesh,
    cut_faces,
    cut_strip,
    make_material,
)
from workers.geometry.colour import attribute_colors, encode_srgb

_TEXTURE = re.compile(rb"^comment TextureFile[ \t]+([^\r\n]+)", re.MULTILINE)
_ELEMENT = re.compile(rb"^element\s+(\w+)\s+(\d+)", re.MULTILINE)
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_CORNERS = ("vertex_indices", "vertex_index")
_SPLATS = ("f_dc_0", "scale_0", "rot_0")
_ROUGHNESS = 0.9
"""Of a scan's picture or colours: nothing in the format says how they shine."""


def named_by_ply(path: Path, data: bytes) -> list[str]:
    """Names of the pictures that a PLY file asks for."""
    return decode_names(_TEXTURE.findall(_head(data)))


def count_ply(data: bytes) -> tuple[int, int]:
    """Vertices and faces that a PLY file's header declares; MeshError `unreadable` where its bytes cannot hold them."""
    counts = {name: int(count) for name, count in _ELEMENT.findall(_head(data)[:65536])}
    if any(count > len(data) for count in counts.values()):
        promised = min(max(counts.values()), 10**18)
        raise MeshError("unreadable", f"the PLY header promises {promised} elements in {len(data)} bytes")
    return counts.get(b"vertex", 0), counts.get(b"face", 0)


def _head(data: bytes) -> bytes:
    return data[: max(data.find(b"end_header"), 0)]


def read_ply(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """One mesh for each picture of a PLY file.

    Raises MeshError `index_out_of_range`, `no_faces` for points and splats, or `unreadable`.
    """
    try:
        elements = {element.name: element for element in _parse(path)}
    except (
        PlyParseError,
        UnicodeDecodeError,
    ):  # a strict reader: trimesh takes lines that are too long, and strange heads
        return read_plain(path, data, resolver)
    try:
        vertices, faces = elements["vertex"], elements.get("face", elements.get("faces"))
        points = np.column_stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"])
        if faces is not None and len(faces):
            corners, face = _triangles(path, faces, points)
        elif "tristrips" in elements:
            corners, face = _strips(elements["tristrips"]), None
        else:
            splats = set(_SPLATS) <= {prop.name for prop in vertices.properties}
            what = "Gaussian splats" if splats else "a cloud of points"
            raise MeshError("no_faces", f"{path} is {what} without triangles: make a mesh of it")
        return _meshes(named_by_ply(path, data), vertices, points, faces, corners, face, resolver)
    except (KeyError, ValueError, TypeError, IndexError, StopIteration) as error:
        raise unreadable(path, error) from error


def _parse(path: Path) -> list[PlyElement]:
    """The elements. Lists as of a file of triangles, which are read at once, or else list by list."""
    lengths = dict.fromkeys(_CORNERS, 3) | {"texcoord": 6}
    try:
        return list(PlyData.read(str(path), known_list_len={"face": lengths}).elements)
    except PlyParseError:
        return list(PlyData.read(str(path)).elements)


def _triangles(path: Path, faces: PlyElement, points: Array) -> tuple[Indices, Indices]:
    """[T, 3, 2]: the triangles of all faces, each corner a vertex and a place in its face; and [T] the face of each."""
    lists = faces[next(prop.name for prop in faces.properties if prop.name in _CORNERS)]
    alike = lists.dtype != object
    counts = np.full(len(lists), lists.shape[-1]) if alike else np.array([len(row) for row in lists])
    corners = (lists.ravel() if alike else np.concatenate(lists)).astype(np.int64)
    places, face = cut_faces(path, corners, counts, points)
    if not len(face):
        raise MeshError("no_faces", f"{path} has no triangles")
    return np.stack([corners[places], places - (np.cumsum(counts) - counts)[face][:, None]], axis=-1), face


def _strips(strips: PlyElement) -> Indices:
    """[T, 3, 1]: the triangles of strips, in which -1 begins another one."""
    rows = [np.asarray(row, np.int64) for row in strips["vertex_indices"]]
    parts = [part[part >= 0] for row in rows for part in np.split(row, np.flatnonzero(row < 0))]
    return np.concatenate([cut_strip(part) for part in parts])[..., None]


def _meshes(
    named: list[str],
    vertices: PlyElement,
    points: Array,
    faces: PlyElement | None,
    corners: Indices,
    face: Indices | None,
    resolver: FolderResolver,
) -> list[RawMesh]:
    names = {prop.name for prop in vertices.properties}
    pictures = [_picture(name, resolver) for name in named]
    normals = np.column_stack([vertices[n] for n in ("nx", "ny", "nz")]) if {"nx", "ny", "nz"} <= names else None
    colors = _colors(vertices)
    by_face = _colors(faces) if faces is not None and colors is None else None
    uv = next((np.column_stack([vertices[a], vertices[b]]) for a, b in _COORDINATES if {a, b} <= names), None)
    index = corners[..., 0]
    if faces is not None and face is not None and "texcoord" in {prop.name for prop in faces.properties} and pictures:
        uv = _corner_coordinates(faces["texcoord"], face, corners[..., 1])
        points, index = points[index.ravel()], np.arange(index.size).reshape(-1, 3)
        flat = corners[..., 0].ravel()
        normals, colors = (None if array is None else array[flat] for array in (normals, colors))
    if uv is None or not pictures or not np.isfinite(uv).all():
        visual = MeshVisual(WHITE if colors is not None or by_face is not None else DEFAULT, colors=colors)
        shown = None if by_face is None or face is None else by_face[face]
        return [RawMesh(points, index, normals, MeshVisual(visual.material, None, colors, shown), np.eye(4))]
    which = np.zeros(len(index), np.int64)
    if faces is not None and face is not None and "texnumber" in {prop.name for prop in faces.properties}:
        which = np.clip(np.asarray(faces["texnumber"], np.int64)[face], 0, len(pictures) - 1)
    return [
        RawMesh(points, index[which == k], normals, MeshVisual(pictures[k], np.asarray(uv, np.float64)), np.eye(4))
        for k in np.unique(which).tolist()
    ]


def _corner_coordinates(lists: NDArray, face: Indices, place: Indices) -> Array:
    """[3 T, 2] of triangles [T, 3] that are corners `place` of faces: a list u, v, u, v ... a face; 0 where it is short."""
    widest = max((len(row) for row in lists), default=0) // 2 * 2
    table = np.zeros((len(lists), max(widest, 2)))
    for row, values in zip(table, lists, strict=True):
        row[: min(len(values), widest)] = values[:widest]
    at = np.minimum(place, table.shape[1] // 2 - 1)
    return table.reshape(len(lists), -1, 2)[face[:, None], at].reshape(-1, 2)


def _colors(element: PlyElement) -> NDArray[np.uint8] | None:
    """[N, 4] uint8 sRGB of an element's own colours: whole numbers up to 255, or floats in [0, 1]."""
    names = {prop.name for prop in element.properties if not isinstance(prop, PlyListProperty)}
    rgb = next((found for found in _COLORS if set(found) <= names), None)
    if rgb is None:
        return None
    columns = [element[name] for name in (*rgb, *(["alpha"] if "alpha" in names else []))]
    table = np.full((len(element), 4), 255, np.uint8)
    for k, column in enumerate(columns):
        values: NDArray[Any] = np.asarray(column)
        if values.dtype.kind == "f":
            values = np.nan_to_num(values) * (255.0 if values.max(initial=0.0) <= 1.0 else 1.0)
        elif values.dtype.itemsize > 1 and values.max(initial=0) > 255:
            values = values / np.iinfo(values.dtype).max * 255.0
        table[:, k] = np.clip(np.round(values), 0, 255)
    return table


def _picture(name: str, resolver: FolderResolver) -> Material:
    """The material of a picture: as it is, or the neutral grey where it cannot be had."""
    picture = resolver.picture(name)
    return DEFAULT if picture is None else make_material(np.ones(4), 0.0, _ROUGHNESS, picture, resolver.notes)


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


_OFF = re.compile(r"\s*(ST)?(C)?(N)?(4)?(n)?OFF(?!\s+BINARY)")


def read_off(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The mesh of an OFF file as Geomview has it, with colours of vertices or of faces, whole numbers or shares.

    A reader of its own: trimesh leaves out colours, and cuts polygons as fans. MeshError `format` for a binary or one of four
    dimensions, `index_out_of_range` or `unreadable`.
    """
    text = re.sub("#.*", "", data.decode("utf-8", "replace"))
    head = _OFF.match(text)
    if (head is None and text.lstrip()[:1].isalpha()) or (head is not None and (head[4] or head[5])):
        raise MeshError("format", f"{path} is not an OFF file of three dimensions in text: export it as .ply")
    lines = [line.split() for line in text[head.end() if head else 0 :].splitlines() if line.strip()]
    try:
        vertices, faces = int(lines[0][0]), int(lines[0][1])
        rows = np.array(lines[1 : 1 + vertices], dtype=np.float64).reshape(vertices, -1)
        told = lines[1 + vertices : 1 + vertices + faces]
        counts = np.array([int(line[0]) for line in told])
        corners = np.array([word for line in told for word in line[1 : 1 + int(line[0])]], dtype=np.int64)
        if len(told) < faces or len(corners) != counts.sum():
            raise ValueError(f"{len(told)} of {faces} faces")
        places, face = cut_faces(path, corners, counts, rows[:, :3])
        first = 6 if head is not None and head[3] else 3
        colors = _off_colors(lines[1 : 1 + vertices], first) if head is not None and head[2] else None
        shown = None if colors is not None else _off_colors([line[int(line[0]) :] for line in told], 1)
        normals = rows[:, 3:6] if first == 6 else None
        if any(len(line) == 2 + int(line[0]) for line in told):
            resolver.notes.append("not drawn: colours of a map by their numbers")
    except (ValueError, IndexError, OverflowError) as error:
        raise unreadable(path, error) from error
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
            visual = read_visual(mesh, resolver.notes)
            stated = "vertex_normals" in mesh._cache.cache  # trimesh would compute them
            normals = np.asarray(mesh.vertex_normals, dtype=np.float64) if stated else None
            faces = np.asarray(mesh.faces, dtype=np.int64)
            meshes.append(RawMesh(np.asarray(mesh.vertices), faces, normals, visual, np.asarray(matrix, np.float64)))
    return meshes


def read_visual(mesh: trimesh.Trimesh, notes: list[str]) -> MeshVisual:
    """The material and colours of one trimesh geometry."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        uv = getattr(visual, "uv", None)
        usable = uv is not None and np.shape(uv) == (len(mesh.vertices), 2) and bool(np.isfinite(uv).all())
        material = _trimesh_material(visual.material, usable, notes)
        colors = attribute_colors(visual.vertex_attributes.get("color"), len(mesh.vertices))
        return MeshVisual(material, np.asarray(uv, dtype=np.float64) if usable else None, colors)
    if visual.kind == "vertex" and len(visual.vertex_colors) == len(mesh.vertices):
        return MeshVisual(WHITE, colors=attribute_colors(np.asarray(visual.vertex_colors), len(mesh.vertices)))
    if visual.kind == "face" and len(visual.face_colors) == len(mesh.faces):
        return MeshVisual(WHITE, face_colors=np.asarray(visual.face_colors, dtype=np.uint8))
    return MeshVisual(DEFAULT)


def _trimesh_material(source: object, textured: bool, notes: list[str]) -> Material:
    """A material of trimesh's; the picture only where the mesh has coordinates for it."""
    if isinstance(source, PBRMaterial):
        factor = np.ones(4) if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255.0
        image, color = source.baseColorTexture, np.append(encode_srgb(factor[:3]), factor[3])
        metallic, roughness = (1.0 if x is None else float(x) for x in (source.metallicFactor, source.roughnessFactor))
    elif isinstance(source, SimpleMaterial) and source.image is not None:
        image, color, metallic, roughness = source.image, np.ones(4), 0.0, _ROUGHNESS  # its own colour darkens by 0.4
    else:
        return DEFAULT
    texture = decode_picture(image, notes) if textured and image is not None else None
    return make_material(color, metallic, roughness, texture, notes)
