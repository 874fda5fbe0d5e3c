"""The object models of a BOP export: numbered as they first appear, one PLY file each, in a constant amount of memory."""

import csv
import io
import json
import sqlite3
from collections.abc import Iterator
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.distance import cdist

from schemas.base import Array
from schemas.dataset.codec import Row
from schemas.scene.shape import Part
from services.export.folder import ExportFolder
from services.export.shapes import ColoredShape
from workers.geometry.hull import convex_hull

_INFO, _NAMES = "models/models_info.json", "objects.csv"
_MM = 1000.0
_AT_ONCE = 512
"""Rows of a block of distances: some tens of megabytes at most."""


class BopModels:
    """Gives each instance its number, obj_id, from 1, and writes its model in millimetres when it first appears."""

    def __init__(self, folder: ExportFolder, state: dict[str, Any] | None) -> None:
        self._folder = folder
        self._next = 1 if state is None else int(state["next_object"])
        self.without = 0 if state is None else int(state["without_model"])
        """Objects whose shape is not here."""
        self._first = True if state is None else bool(state["first"])
        self._db = sqlite3.connect(folder.work / "objects.sqlite")
        self._db.execute("PRAGMA synchronous = OFF")  # a power loss is not what this is for
        self._db.execute("CREATE TABLE IF NOT EXISTS objects (instance TEXT PRIMARY KEY, id INTEGER) WITHOUT ROWID")
        self._db.execute("DELETE FROM objects WHERE id >= ?", (self._next,))
        if state is None:
            folder.append(_NAMES, b"obj_id,category,instance_id,split,source,licence\n")
            folder.append(_INFO, b"{")

    def number(self, instance_id: str) -> int | None:
        """The obj_id of an instance, None where it is new."""
        found = self._db.execute("SELECT id FROM objects WHERE instance = ?", (instance_id,)).fetchone()
        return None if found is None else int(found[0])

    def add(self, asset: Row, shape: ColoredShape | None) -> int:
        """The obj_id of a new instance, whose row of `assets` and shape these are."""
        number, self._next = self._next, self._next + 1
        self._db.execute("INSERT INTO objects VALUES (?, ?)", (asset["instance_id"], number))
        text = io.StringIO()
        names = ("category", "instance_id", "split", "source", "licence")
        csv.writer(text, lineterminator="\n").writerow((number, *(asset[name] for name in names)))
        self._folder.append(_NAMES, text.getvalue().encode())
        if shape is None:
            self.without += 1
            return number
        self._folder.put(f"models/obj_{number:06d}.ply", b"".join(ply_lines(shape)))
        entry = f'{"" if self._first else ","}\n "{number}": {json.dumps(model_info(_MM * shape.shape.vertices))}'
        self._folder.append(_INFO, entry.encode())
        self._first = False
        return number

    def state(self) -> dict[str, Any]:
        """What a new one must know; the numbers themselves are safe on the disk."""
        self._db.commit()
        return {"next_object": self._next, "without_model": self.without, "first": self._first}

    def finish(self) -> None:
        """Ends models_info.json."""
        self._folder.append(_INFO, b"\n}\n")

    def close(self) -> None:
        """Closes the file of numbers."""
        self._db.close()

    @property
    def count(self) -> int:
        """How many instances have a number."""
        return self._next - 1


def model_info(vertices_mm: Array) -> dict[str, float]:
    """Bounding box and diameter, the largest distance between two vertices, in millimetres."""
    low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
    sizes = dict(zip(("min_x", "min_y", "min_z"), low.tolist(), strict=True))
    sizes |= dict(zip(("size_x", "size_y", "size_z"), (high - low).tolist(), strict=True))
    return {"diameter": _diameter(vertices_mm), **sizes}


def _diameter(points: Array) -> float:
    """The largest distance between two of the points [N, 3]."""
    corners = convex_hull(points).vertices
    blocks = (corners[first : first + _AT_ONCE] for first in range(0, len(corners), _AT_ONCE))
    return float(max(cdist(block, corners).max() for block in blocks))


def ply_lines(colored: ColoredShape) -> Iterator[bytes]:
    """An ASCII PLY file: vertices in millimetres, unit normals, colours, and triangles."""
    shape, mesh = colored.shape, colored.shape.mesh
    normals = np.concatenate([_normals(part) for part in shape.parts])
    floats, letters = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    header = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in floats] + [f"property uchar {name}" for name in letters]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    yield "".join(f"{line}\n" for line in header).encode()
    rows = zip((_MM * mesh.vertices).tolist(), normals.tolist(), colored.colors.tolist(), strict=True)
    line = "%.9g %.9g %.9g %.6g %.6g %.6g %d %d %d\n"
    yield "".join(line % (*xyz, *normal, *rgb) for xyz, normal, rgb in rows).encode()
    yield "".join(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces.tolist()).encode()


def _normals(part: Part) -> Array:
    """[V, 3]: those of the part, else the mean of the faces about each vertex, weighed by their angles."""
    if part.normals is not None:
        return part.normals
    return np.asarray(trimesh.Trimesh(part.vertices, part.faces, process=False).vertex_normals)
