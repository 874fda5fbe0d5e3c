"""Edge: reads OFF files from outside, and STL by trimesh."""

import io
import re
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.errors import MeshError
from workers.door.meshes.caps import FolderResolver, unreadable
from workers.door.meshes.mesh import DEFAULT, WHITE, MeshVisual, RawMesh, cut_faces


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


def read_stl(path: Path, data: bytes, resolver: FolderResolver) -> list[RawMesh]:
    """The solids of an STL file; MeshError `unreadable`."""
    if count := _binary_faces(data):
        if count != (declared := _declared_faces(data)):
            resolver.notes.append(f"its head tells {declared} faces, and {count} are there: all were read")
        # trimesh takes a file with bytes behind the last face for text
        data = data[:80] + struct.pack("<I", count) + data[84 : 84 + 50 * count]
    elif (declared := _declared_faces(data)) and b"facet" not in data[:1024]:
        whole = max(len(data) - 84, 0) // 50
        raise MeshError("unreadable", f"{path} ends early: {whole} of {declared} faces are there: copy it again")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(io.BytesIO(data), file_type="stl", process=False)
    except MemoryError:
        raise
    except Exception as error:
        raise unreadable(path, error) from error
    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            stated = "vertex_normals" in mesh._cache.cache  # trimesh would compute them
            normals = np.asarray(mesh.vertex_normals, dtype=np.float64) if stated else None
            faces = np.asarray(mesh.faces, dtype=np.int64)
            visual = MeshVisual(DEFAULT)
            meshes.append(RawMesh(np.asarray(mesh.vertices), faces, normals, visual, np.asarray(matrix, np.float64)))
    return meshes
