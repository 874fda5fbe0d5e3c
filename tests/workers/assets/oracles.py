"""What the tests of assets measure meshes with: trimesh, brute-force rays, written-out files."""

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from schemas.base import Array, frozen_array
from schemas.scene.shape import Part, Shape


def shape_of(*meshes: trimesh.Trimesh) -> Shape:
    """A part for each mesh."""
    return Shape(
        tuple(Part(f"p{k}", frozen_array(m.vertices), frozen_array(m.faces, np.int32)) for k, m in enumerate(meshes))
    )


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


def textured_cube(folder: Path, picture: str = "skin.png", more: str = "") -> Path:
    """The cube as an OBJ file whose material has a picture, each face over the whole of it."""
    write(folder / "cube.mtl", f"newmtl skin\nKd 1 1 1\n{more}map_Kd {picture}\n")
    corners = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    body = CUBE.replace("\nf", "\nusemtl skin\nf", 1)
    body = "\n".join(
        "f " + " ".join(f"{v}/{k + 1}" for k, v in enumerate(line.split()[1:])) if line.startswith("f ") else line
        for line in body.splitlines()
    )
    return write(folder / "cube.obj", "mtllib cube.mtl\n" + corners + body + "\n")
