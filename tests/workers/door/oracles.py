"""What the tests of assets measure meshes with, trimesh and brute-force rays; and files of meshes, written by hand."""

import io
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import ConvexHull

from schemas.base import Array
from schemas.scene.shape import Shape

Files = Mapping[str, bytes]
"""The files of an asset by name; the first is the mesh or URDF."""


def welded(shape: Shape) -> trimesh.Trimesh:
    """All parts as one mesh, vertices at the very same place made one."""
    points, index = np.unique(shape.vertices, axis=0, return_inverse=True)
    return trimesh.Trimesh(points, index.reshape(-1)[shape.faces], process=False)


def hits(vertices: Array, faces: np.ndarray, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Distances at which a ray meets faces, ascending, and whether it goes in (-1) or out (+1) there: Moeller-Trumbore."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    across = np.cross(direction, e2)
    det = (e1 * across).sum(axis=1)
    safe = np.where(np.abs(det) < 1e-18, np.inf, det)
    u = ((origin - a) * across).sum(axis=1) / safe
    q = np.cross(origin - a, e1)
    v = (q @ direction) / safe
    t = (e2 * q).sum(axis=1) / safe
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & np.isfinite(safe)
    order = np.argsort(t[hit])
    return t[hit][order], np.sign((np.cross(e1, e2) @ direction)[hit])[order]


def faulty_rays(vertices: Array, faces: np.ndarray, rng: np.random.Generator, count: int) -> int:
    """How many of `count` random rays do not go in and out by turns: there surfaces overlap, face wrongly or lie inside."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    reach = 2.0 * float(np.linalg.norm(high - low))
    faults = 0
    for _ in range(count):
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        _, sides = hits(vertices, faces, rng.uniform(low, high) - reach * direction, direction)
        faults += int(len(sides) % 2 == 1 or (sides[0::2] > 0).any() or (sides[1::2] < 0).any())
    return faults


def support_margin(mesh: trimesh.Trimesh, tolerance: float = 1e-9) -> float:
    """How far, metres, the centre of mass lies inside the hull of the vertices at the lowest height."""
    lowest = mesh.vertices[:, 2].min()
    contact = mesh.vertices[mesh.vertices[:, 2] <= lowest + tolerance][:, :2]
    sides = ConvexHull(contact).equations
    return float(-(sides[:, :2] @ mesh.center_mass[:2] + sides[:, 2]).max())


def write(path: Path, text: str | bytes) -> Path:
    """A file with its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def write_all(folder: Path, files: Files) -> Path:
    """Files in a folder; the path of the first."""
    written = [write(folder / name, data) for name, data in files.items()]
    return written[0]


def picture(kind: str = "PNG", size: tuple[int, int] = (4, 4), colour: tuple[int, ...] | None = (255, 0, 0)) -> bytes:
    """A PNG or JPEG of one colour, or of noise."""
    noise = np.random.default_rng(0).integers(0, 255, (*size[::-1], 3), dtype=np.uint8)
    stream = io.BytesIO()
    (Image.fromarray(noise) if colour is None else Image.new("RGB", size, colour)).save(stream, kind)
    return stream.getvalue()


CUBE = """
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 1 4 3 2
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""
"""An OBJ file: the unit cube in quadrilaterals, wound outwards."""


def textured_obj(name: str = "skin.png", more: str = "") -> Files:
    """The cube as an OBJ file whose material has a picture, each face over the whole of it; without the picture."""
    corners = "mtllib cube.mtl\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    lines = [
        "f " + " ".join(f"{v}/{k + 1}" for k, v in enumerate(line.split()[1:])) if line.startswith("f ") else line
        for line in CUBE.replace("\nf", "\nusemtl skin\nf", 1).splitlines()
    ]
    material = f"newmtl skin\nKd 1 1 1\n{more}map_Kd {name}\n"
    return {"cube.obj": (corners + "\n".join(lines) + "\n").encode(), "cube.mtl": material.encode()}


def textured_cube(folder: Path, picture: str = "skin.png", more: str = "") -> Path:
    """`textured_obj` in a folder."""
    return write_all(folder, textured_obj(picture, more))


def gltf(name: str = "cube.gltf", buffer: str = "cube.bin", picture: str = "skin.png", **changes: Any) -> Files:
    """A unit cube whose corners, faces and texture coordinates lie in one buffer, after the specification; no picture."""
    mesh = trimesh.creation.box((1, 1, 1))
    blocks = [mesh.vertices.astype("<f4").tobytes(), mesh.faces.astype("<u2").tobytes()]
    blocks.append(np.random.default_rng(0).random((8, 2)).astype("<f4").tobytes())
    starts = np.cumsum([0, *map(len, blocks)])
    views = [{"buffer": 0, "byteOffset": int(s), "byteLength": len(b)} for s, b in zip(starts, blocks, strict=False)]
    colour = {"baseColorTexture": {"index": 1}, "metallicFactor": 0.0}
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": colour, "normalTexture": {"index": 0}}],
        "images": [{"uri": "no such normal map.png"}, {"uri": picture}],
        "textures": [{"source": 0}, {"source": 1}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 8, "type": "VEC2"},
        ],
        "bufferViews": views,
        "buffers": [{"uri": buffer, "byteLength": int(starts[-1])}],
        **changes,
    }
    return {name: json.dumps(tree).encode(), "cube.bin": b"".join(blocks)}


def glb(tree: dict[str, Any] | str, binary: bytes = b"") -> bytes:
    """A binary glTF file of a tree, or of what stands where one should."""
    text = (tree if isinstance(tree, str) else json.dumps(tree)).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def visual(geometry: str, origin: str = "", material: str = "") -> str:
    """A visual of a URDF."""
    return f"<visual>{origin}<geometry>{geometry}</geometry>{material}</visual>"


def urdf(*visuals: str, more: str = "") -> str:
    """A URDF of one link."""
    return f'<robot name="r"><link name="l">{"".join(visuals)}</link>{more}</robot>'
