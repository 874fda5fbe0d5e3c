"""Meshes from outside, as a stranger's tool might leave them: each written to a file and read through the door."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from schemas.base import Array
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Asset
from tests.kit.shapes import box
from tests.workers.door.oracles import textured_cube, write
from workers.assets.library.reading import hash_files, place_asset
from workers.assets.library.table import Row
from workers.door.meshes.formats import load_shape

SIDE_M = 0.1


def enter(make_file: Callable[[Path], Path], scale: float = 1.0) -> Asset:
    """The asset of the file that is made in a folder of its own; `scale` takes its units to metres. Raises MeshError."""
    with tempfile.TemporaryDirectory() as folder:
        path = make_file(Path(folder))
        loaded = load_shape(path, MeshLimits())
        files = hash_files([path], Path(folder))
        row = Row(path.name, category="box", unit=scale, licence="CC0-1.0", files=files, sha256=files[0].sha256)
        asset = place_asset(loaded, row, MeshLimits())
        return replace(asset, shareable=True, volume_m3=asset.mass.mass_kg / 600.0 if asset.watertight else None)


def obj(vertices: Array, faces: Array, more: str = "") -> Callable[[Path], Path]:
    """A writer of an OBJ with every digit of its numbers; `more` are further lines."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices).tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in np.asarray(faces).tolist()]
    return lambda folder: write(folder / "thing.obj", "\n".join(lines) + "\n" + more)


def of(mesh: Any, more: str = "") -> Callable[[Path], Path]:
    """The same of a mesh."""
    return obj(mesh.vertices, mesh.faces, more)


def _cube(side: float = SIDE_M, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return box(side, side, side, at)


def millimetres() -> Asset:
    """A cube whose file says 100."""
    return enter(of(_cube(100.0)), 0.001)


def far_away() -> Asset:
    """A cube 10 km from its origin along every axis."""
    return enter(of(_cube(at=(1e4, 1e4, 1e4))))


def mirrored() -> Asset:
    """A lopsided solid whose node scales x by -1."""
    scene = trimesh.Scene()
    corners = np.array([[0, 0, 0], [15, 0, 0], [15, 10, 0], [0, 10, 0], [3, 0, 10], [3, 10, 10]]) / 100.0
    wedge = trimesh.convex.convex_hull(corners)
    scene.add_geometry(wedge, transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    return enter(lambda folder: write(folder / "thing.glb", scene.export(file_type="glb")))


def flat_sheet() -> Asset:
    """A square without thickness, drawn from one side."""
    s = SIDE_M / 2
    return enter(obj(np.array([[-s, -s, 0], [s, -s, 0], [s, s, 0], [-s, s, 0]]), np.array([[0, 1, 2], [0, 2, 3]])))


def inverted() -> Asset:
    """Every face inwards."""
    mesh = _cube()
    return enter(obj(mesh.vertices, mesh.faces[:, ::-1]))


def mixed() -> Asset:
    """Every other face inwards."""
    mesh = _cube()
    odd = (np.arange(len(mesh.faces)) % 2 == 1)[:, None]
    return enter(obj(mesh.vertices, np.where(odd, mesh.faces[:, ::-1], mesh.faces)))


def open_shell() -> Asset:
    """A cube without its upper side: single-sided walls."""
    mesh = _cube()
    return enter(obj(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] < 0.5]))


def holed() -> Asset:
    """A cube that lacks one triangle of its base."""
    mesh = _cube()
    base = int(np.flatnonzero(mesh.face_normals[:, 2] < -0.5)[0])
    return enter(obj(mesh.vertices, np.delete(mesh.faces, base, axis=0)))


def doubled() -> Asset:
    """Faces twice, faces turned round, faces of one point and of one line."""
    mesh = _cube()
    return enter(of(mesh, "\n".join(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces) + "\nf 1 1 2\nf 3 3 3\n"))


def coplanar() -> Asset:
    """Two cubes side by side: the faces between them lie in one plane, and so do four pairs of their sides."""
    pair = trimesh.util.concatenate([_cube(at=(-SIDE_M / 2, 0, 0)), _cube(at=(SIDE_M / 2, 0, 0))])
    return enter(of(pair))


def see_through() -> Asset:
    """A cube of 1 m in its file whose picture is transparent in every other column."""

    def make(folder: Path) -> Path:
        picture = np.full((8, 8, 4), 200, np.uint8)
        picture[:, ::2, 3] = 0
        Image.fromarray(picture, "RGBA").save(folder / "skin.png")
        return textured_cube(folder)

    return enter(make, SIDE_M)


def not_a_number() -> Asset:
    """A cube with one coordinate that is not a number."""
    mesh = _cube()
    vertices = mesh.vertices.copy()
    vertices[3, 1] = np.nan
    return enter(obj(vertices, mesh.faces))
