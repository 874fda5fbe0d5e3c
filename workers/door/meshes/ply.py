"""Edge: reads PLY files from outside, and writes and reads our own. trimesh reads no binary lists of different lengths.

What the elements of a PLY mean is not in the format. Read are the names that MeshLab, CloudCompare, Blender, the Stanford scans
and BOP write: colours of vertices and faces, coordinates of pictures by vertex or by corner, several pictures, and strips of
triangles.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import MeshError
from schemas.scene.shape import Material
from workers.door.meshes.raw import (
    DEFAULT,
    WHITE,
    FolderResolver,
    Indices,
    MeshVisual,
    RawMesh,
    cut_faces,
    cut_strip,
    make_material,
)
from workers.door.opening import as_utf8

Element = dict[str, NDArray]
"""Columns by name: [N], of lists [N, n] where all are as long, else [N] objects, each an array."""

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TEXTURE = re.compile(rb"^comment TextureFile[ \t]+([^\r\n]+)", re.MULTILINE)
_ELEMENT = re.compile(rb"^element\s+(\w+)\s+(\d+)", re.MULTILINE)
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_CORNERS = ("vertex_indices", "vertex_index")
_SPLATS = ("f_dc_0", "scale_0", "rot_0")
_ROUGHNESS = 0.9
"""Of a scan's picture or colours: nothing in the format says how they shine."""

Property = tuple[str, str, str]
"""Name, numpy's kind of number, and that of the length of a list, empty for a single number."""


def parse_ply(data: bytes) -> dict[str, Element]:
    """The elements of a PLY file, in text or binary. Raises ValueError, LookupError or OverflowError where it is none."""
    end = re.search(rb"^end_header[ \t]*\r?\n", data, re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise ValueError("no header of a PLY")
    order, heads = "", list[tuple[str, int, list[Property]]]()
    for line in data[: end.start()].decode("utf-8", "replace").splitlines():
        match line.split():
            case ["format", encoding, *_]:
                order = _ENCODINGS[encoding]
            case ["element", name, number]:
                heads.append((name, int(number), []))
            case ["property", "list", length, kind, name]:
                heads[-1][2].append((name, order + _TYPES[kind], order + _TYPES[length]))
            case ["property", kind, name]:
                heads[-1][2].append((name, order + _TYPES[kind], ""))
    elements, at = dict[str, Element](), end.end()
    lines = (
        [] if order else [line.split() for line in data[at:].decode("utf-8", "replace").splitlines() if line.strip()]
    )
    for name, count, properties in heads:
        if order:
            elements[name], at = _read_binary(data, at, count, properties)
        else:
            elements[name], lines = _read_text(lines[:count], count, properties), lines[count:]
    return elements


def _read_binary(data: bytes, at: int, count: int, properties: list[Property]) -> tuple[Element, int]:
    """The columns of an element whose rows begin at a byte, and where they end; read at once where lists are alike."""
    fields, place = list[tuple](), at
    for name, kind, length in properties if count else ():
        size, place = _read_length(data, place, length)
        fields += [(f"{name} length", length), (name, kind, (size,))] if length else [(name, kind)]
        place += size * np.dtype(kind).itemsize
    row = np.dtype(fields)
    if count and properties and at + count * row.itemsize <= len(data):
        table = np.frombuffer(data, row, count, at)
        if all(np.ptp(table[f"{name} length"]) == 0 for name, _, length in properties if length):
            return {name: table[name] for name, _, _ in properties}, at + count * row.itemsize
    columns = {name: list[NDArray]() for name, _, _ in properties}
    for _ in range(count if properties else 0):
        for name, kind, length in properties:
            size, at = _read_length(data, at, length)
            columns[name].append(np.frombuffer(data, kind, size, at) if size else np.zeros(0, kind))
            at += size * np.dtype(kind).itemsize
    return {name: _join(columns[name], kind, bool(length)) for name, kind, length in properties}, at


def _read_length(data: bytes, at: int, length: str) -> tuple[int, int]:
    """How many numbers a property has in the row at a byte, and where they begin."""
    if not length:
        return 1, at
    size = int(np.frombuffer(data, length, 1, at)[0])
    if not 0 <= size <= len(data):
        raise ValueError(f"a list of {size} numbers")
    return size, at + np.dtype(length).itemsize


def _read_text(lines: list[list[str]], count: int, properties: list[Property]) -> Element:
    """The columns of lines of words; what a line has beyond its properties is passed over."""
    if len(lines) < count:
        raise ValueError(f"{len(lines)} lines of {count}")
    if not any(length for _, _, length in properties):
        table = np.array([line[: len(properties)] for line in lines], np.float64).reshape(count, len(properties))
        return {name: _cast(table[:, k], kind) for k, (name, kind, _) in enumerate(properties)}
    columns = {name: list[NDArray]() for name, _, _ in properties}
    for line in lines:
        at = 0
        for name, kind, length in properties:
            size = int(line[at]) if length else 1
            at += bool(length)
            words = line[at : at + size]
            if size < 0 or len(words) < size:
                raise ValueError(f"a line that ends within {name}")
            columns[name].append(_cast(np.array(words, np.float64), kind))
            at += size
    return {name: _join(columns[name], kind, bool(length)) for name, kind, length in properties}


def _cast(values: Array, kind: str) -> NDArray:
    """Numbers of a text as the kind that the head says. Raises ValueError where they do not fit."""
    with np.errstate(all="ignore"):
        cast = values.astype(kind)
    if cast.dtype.kind != "f" and not np.array_equal(cast, values):
        raise ValueError(f"a number that is no {cast.dtype}")
    return cast


def _join(rows: list[NDArray], kind: str, is_list: bool) -> NDArray:
    """A column of an element, from each row's own array."""
    if not is_list:
        return np.concatenate(rows) if rows else np.zeros(0, kind)
    if len({len(row) for row in rows}) < 2:
        return np.stack(rows) if rows else np.zeros((0, 0), kind)
    column = np.empty(len(rows), object)
    column[:] = rows
    return column


def encode_ply(comment: str, **elements: Mapping[str, NDArray]) -> bytes:
    """A binary file of elements, each its columns by name: [N] numbers, or [N, n] lists of up to 255 numbers."""
    names, head, body = {kind: name for name, kind in reversed(_TYPES.items())}, f"comment {comment}\n", b""
    for element, columns in elements.items():
        count, fields = len(next(iter(columns.values()))), list[tuple]()
        head += f"element {element} {count}\n"
        for name, column in columns.items():
            kind = column.dtype.newbyteorder("<")
            is_list = column.ndim > 1
            fields += [(f"{name} length", "u1"), (name, kind, column.shape[1:])] if is_list else [(name, kind)]
            head += f"property {'list uchar ' if is_list else ''}{names[kind.str[1:]]} {name}\n"
        table = np.empty(count, fields)
        for name, column in columns.items():
            table[name] = column
            if column.ndim > 1:
                table[f"{name} length"] = column.shape[1]
        body += table.tobytes()
    return f"ply\nformat binary_little_endian 1.0\n{head}end_header\n".encode() + body


def named_by_ply(path: Path, data: bytes) -> list[str]:
    """Names of the pictures that a PLY file asks for."""
    return [name.decode("utf-8", "replace").strip() for name in _TEXTURE.findall(_head(data))]


def decode_head(data: bytes) -> tuple[bytes, str | None]:
    """The file with its header in UTF-8, as `as_utf8`."""
    end = max(data.find(b"end_header"), 0)
    head, note = as_utf8(data[:end])
    return (data if head == data[:end] else head + data[end:]), note


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

    Raises MeshError `index_out_of_range`, or `no_faces` for points and splats.
    """
    elements = parse_ply(data)
    vertices, faces = elements["vertex"], elements.get("face", elements.get("faces"))
    points = np.column_stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"])
    if faces is not None and _count(faces):
        corners, face = _triangles(path, faces, points)
    elif "tristrips" in elements:
        corners, face = _strips(elements["tristrips"]), None
    else:
        what = "Gaussian splats" if set(_SPLATS) <= set(vertices) else "a cloud of points"
        raise MeshError("no_faces", f"{path} is {what} without triangles: make a mesh of it")
    return _meshes(named_by_ply(path, data), vertices, points, faces, corners, face, resolver)


def _count(element: Element) -> int:
    return max(map(len, element.values()), default=0)


def _triangles(path: Path, faces: Element, points: Array) -> tuple[Indices, Indices]:
    """[T, 3, 2]: the triangles of all faces, each corner a vertex and a place in its face; and [T] the face of each."""
    lists = faces[next(name for name in faces if name in _CORNERS)]
    alike = lists.dtype != object
    counts = np.full(len(lists), lists.shape[-1]) if alike else np.array([len(row) for row in lists])
    corners = (lists.ravel() if alike else np.concatenate(lists)).astype(np.int64)
    places, face = cut_faces(path, corners, counts, points)
    if not len(face):
        raise MeshError("no_faces", f"{path} has no triangles")
    return np.stack([corners[places], places - (np.cumsum(counts) - counts)[face][:, None]], axis=-1), face


def _strips(strips: Element) -> Indices:
    """[T, 3, 1]: the triangles of strips, in which -1 begins another one."""
    rows = [np.asarray(row, np.int64) for row in strips["vertex_indices"]]
    parts = [part[part >= 0] for row in rows for part in np.split(row, np.flatnonzero(row < 0))]
    return np.concatenate([cut_strip(part) for part in parts])[..., None]


def _meshes(
    named: list[str],
    vertices: Element,
    points: Array,
    faces: Element | None,
    corners: Indices,
    face: Indices | None,
    resolver: FolderResolver,
) -> list[RawMesh]:
    pictures = [_picture(name, resolver) for name in named]
    normals = (
        np.column_stack([vertices[n] for n in ("nx", "ny", "nz")]) if {"nx", "ny", "nz"} <= set(vertices) else None
    )
    colors = _colors(vertices)
    by_face = _colors(faces) if faces is not None and colors is None else None
    uv = next((np.column_stack([vertices[a], vertices[b]]) for a, b in _COORDINATES if {a, b} <= set(vertices)), None)
    index = corners[..., 0]
    if faces is not None and face is not None and "texcoord" in faces and pictures:
        uv = _corner_coordinates(faces["texcoord"], face, corners[..., 1])
        points, index = points[index.ravel()], np.arange(index.size).reshape(-1, 3)
        flat = corners[..., 0].ravel()
        normals, colors = (None if array is None else array[flat] for array in (normals, colors))
    uv = None if uv is None or not np.isfinite(uv).all() else np.asarray(uv, np.float64)
    if uv is None or not pictures:
        material = WHITE if colors is not None or by_face is not None else DEFAULT
        shown = None if by_face is None or face is None else by_face[face]
        return [RawMesh(points, index, normals, MeshVisual(material, uv, colors, shown), np.eye(4))]
    which = np.zeros(len(index), np.int64)
    if faces is not None and face is not None and "texnumber" in faces:
        which = np.clip(np.asarray(faces["texnumber"], np.int64)[face], 0, len(pictures) - 1)
    return [
        RawMesh(points, index[which == k], normals, MeshVisual(pictures[k], uv), np.eye(4))
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


def _colors(element: Element) -> NDArray[np.uint8] | None:
    """[N, 4] uint8 sRGB of an element's own colours: whole numbers up to 255, or floats in [0, 1]."""
    names = {name for name, column in element.items() if column.ndim == 1 and column.dtype != object}
    rgb = next((kinds for kinds in _COLORS if set(kinds) <= names), None)
    if rgb is None:
        return None
    columns = [element[name] for name in (*rgb, *(["alpha"] if "alpha" in names else []))]
    table = np.full((_count(element), 4), 255, np.uint8)
    for k, column in enumerate(columns):
        values = np.asarray(column)
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
