"""Convex parts of a body that is not convex, by CoACD (Wei, Liu, Ling and Su 2022, doi 10.1145/3528223.3530103).

Built-in shapes are not cut so, but by their making: see `workers.geometry.lathe_decomposition`, with the same figures.

Built-in shapes, number 0 of each category, 0.25 m along their diagonal, by CoACD's threshold: parts / their vertices in all /
seconds on one busy core / millimetres that parts stand out of the surface at most. Half of all that parts show lies on
the surface (but at 0.1), and nothing out of the hull.

             0.1                        0.05                       0.02
    mug      22 / 1,545 / 2.9 / 7.4     59 / 2,462 / 2.6 / 3.9     220 / 5,153 / 6.1 / 1.6
    bowl     24 / 2,957 / 1.4 / 8.1     51 / 3,881 / 2.4 / 4.1     173 / 6,065 / 5.2 / 1.8
    jar      41 / 2,436 / 3.3 / 7.7     116 / 4,344 / 6.8 / 3.8    441 / 10,125 / 13.7 / 1.8
    bottle   2 / 852 / 0.4 / 1.3        2 / 852 / 0.4 / 1.3        10 / 1,241 / 0.8 / 1.2
    laptop   2 / 153 / 0.3 / 3.1        3 / 178 / 0.3 / 1.4        3 / 178 / 0.3 / 1.4
    camera   3 / 592 / 0.4 / 6.9        25 / 1,201 / 1.1 / 4.4     164 / 3,917 / 7.5 / 2.3

With CoACD's own depth of search the mug takes 142 s for 47 parts.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import manifold3d
import numpy as np
import shapely

from schemas.base import Array, frozen_array
from schemas.errors import MachineError, MeshError
from schemas.scene.shape import Asset, Mesh
from workers.geometry.convexity import components, concavity_m, mesh_of, solid_of, weld
from workers.geometry.hull import convex_hull
from workers.geometry.lathe_decomposition import TOLERANCE, decompose_lofts
from workers.physics.convex_parts.coacd_process import MISSING
from workers.physics.convex_parts.parts_cache import USUAL_FOLDER, PartsCache, key_of

THRESHOLD = 0.05
"""CoACD's concavity at which it stops, in units in which the mesh is 2 across: 0.02 halves what stands out, and has three
times the parts."""

CONVEX_SHARE = 0.9999
"""A body that fills this share of its hull is convex."""

SHALLOW_M = 5e-5
"""A surface nowhere deeper below its hull than this is convex: as near as counts as touching."""

SIMPLER = 2e-3
"""Share of its size by which a closed body may be made simpler before it is cut: CoACD's time goes with the faces."""

MOST_PIECES = 128
"""A mesh in more pieces than this is cut as one."""

OPTIONS = {"mcts_iterations": 10, "mcts_nodes": 6, "mcts_max_depth": 1, "resolution": 300, "seed": 0}
"""A search one cut deep with few trials; CoACD's own is three deep with 150, fifty times as long, and makes a fifth fewer
parts of a mug."""

OPEN = {"preprocess_mode": "on", "preprocess_resolution": 40}
"""What is not a closed manifold is first wrapped in voxels; CoACD ends the process without."""

CLOSED = {"preprocess_mode": "off"}

LIBRARIES = ("coacd", "manifold3d", "numpy", "scipy")
"""With other versions of these a mesh may have other parts."""

NOT_INSTALLED = "the package `{}` is not installed, or cannot be loaded: set Verso up again with `./verso test`"

LONGEST_S = 300
"""On some broken meshes CoACD never ends; the slowest that did end took a tenth of this."""

Way = Literal["convex", "coacd", "pieces"]


@dataclass(frozen=True, eq=False)
class Parts:
    """Vertex clouds [N, 3] float64, metres, the hulls of which are a body's convex parts.

    `way`: the body or each of its pieces is convex; CoACD cut it; or CoACD failed and they are the hulls of its pieces.
    """

    clouds: tuple[Array, ...]
    way: Way


_CACHE = PartsCache()


def parts_of(asset: Asset, threshold: float = THRESHOLD, share: float = TOLERANCE) -> tuple[Array, ...]:
    """Vertex clouds [N, 3] of an asset's convex parts, object frame: those that follow from its making, or else CoACD's.

    `threshold` is CoACD's, `share` that of `decompose_lofts`. Where a built-in shape's own outlines cannot be cut, for they
    meet but for the last bits, it is cut by CoACD too.
    """
    lofts = asset.lofts
    if lofts is None:
        return decompose(asset.shape.mesh, asset.sha256, threshold).clouds
    key = key_of("lofts", repr(share), asset.sha256, asset.shape.mesh.vertices.tobytes())
    try:
        return _CACHE.get(key, None, lambda: ("lofts", decompose_lofts(lofts, share)))[1]
    except (ValueError, shapely.errors.GEOSException):
        return decompose(asset.shape.mesh, asset.sha256, threshold).clouds


def decompose(mesh: Mesh, digest: str, threshold: float = THRESHOLD, folder: Path | None = USUAL_FOLDER) -> Parts:
    """Convex parts of a mesh: none reaches out of its hull, and together they have the hull's vertices.

    Each piece that hangs together is cut by itself. The same arguments give the same bytes in every process, which is
    why answers may be kept in memory and in `folder` (None: nowhere). Raises MachineError where CoACD is missing or was
    killed from outside, MeshError `no_convex_parts` where it does not end.
    """
    key = key_of(_method(), repr(threshold), digest, mesh.vertices.tobytes(), mesh.faces.tobytes())
    way, clouds = _CACHE.get(key, folder, lambda: _decompose(mesh, threshold))
    return Parts(clouds, way)  # type: ignore[arg-type]


@cache
def _method() -> str:
    """What parts depend on beside the mesh and the threshold: this folder's files, and the versions of libraries."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    try:
        return key_of(*(file.read_bytes() for file in files), *(version(name) for name in LIBRARIES))
    except PackageNotFoundError as error:
        raise MachineError(NOT_INSTALLED.format(error.name)) from error


def _decompose(mesh: Mesh, threshold: float) -> tuple[Way, tuple[Array, ...]]:
    welded = weld(mesh)
    pieces = components(welded)
    if not pieces:
        return "convex", (frozen_array(convex_hull(mesh.vertices).vertices),)
    if len(pieces) > MOST_PIECES:
        pieces = [welded]
    made = [_parts_of(piece, threshold) for piece in pieces]
    ways = {way for way, _ in made}
    way: Way = "pieces" if "pieces" in ways else "coacd" if "coacd" in ways else "convex"
    return way, tuple(frozen_array(cloud) for _, clouds in made for cloud in clouds)


def _parts_of(piece: Mesh, threshold: float) -> tuple[Way, list[Array]]:
    if len(piece.vertices) < 4:
        return "convex", [piece.vertices]
    hull, solid = convex_hull(piece.vertices), solid_of(piece)
    fills = solid is not None and solid.volume() >= CONVEX_SHARE * solid.hull().volume()
    if fills or concavity_m(piece) <= SHALLOW_M:
        return "convex", [hull.vertices]
    size = float(np.linalg.norm(np.ptp(hull.vertices, axis=0)))
    if solid is None:
        found = _run(piece, {**OPTIONS, **OPEN, "threshold": threshold})
    else:
        found = _run(mesh_of(solid.simplify(SIMPLER * size)), {**OPTIONS, **CLOSED, "threshold": threshold})
    fitted = _fit(found, hull.vertices, hull.normals)
    return ("coacd", fitted) if fitted else ("pieces", [hull.vertices])


def _run(mesh: Mesh, options: dict[str, object]) -> list[Array]:
    """What CoACD makes of a mesh; nothing where it gives up."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "request.npz", vertices=mesh.vertices, faces=mesh.faces, options=json.dumps(options))
        script = Path(__file__).with_name("coacd_process.py")
        try:
            done = subprocess.run([sys.executable, "-P", str(script), name], capture_output=True, timeout=LONGEST_S)
        except subprocess.TimeoutExpired as error:
            detail = f"CoACD found no convex parts in {LONGEST_S} s: make the mesh simpler or mend it"
            raise MeshError("no_convex_parts", detail) from error
        if done.returncode == MISSING:
            raise MachineError(NOT_INSTALLED.format("coacd"))
        if done.returncode in (-2, -9, -15):
            raise MachineError("CoACD was killed from outside, perhaps for want of memory: use fewer workers")
        if done.returncode != 0:
            return []
        with np.load(folder / "parts.npz") as parts:
            return [c for c in np.split(parts["vertices"], np.cumsum(parts["counts"])[:-1]) if len(c) >= 4]


def _fit(clouds: list[Array], vertices: Array, normals: Array) -> list[Array]:
    """Parts cut off where they reach out of the hull, and given those of its vertices that they lost."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    reach = (vertices @ normals.T).max(axis=0)
    whole = manifold3d.Manifold.hull_points(np.ascontiguousarray(vertices))
    fitted = []
    for cloud in clouds:
        if (cloud @ normals.T - reach).max() > 1e-9 * size:
            cloud = mesh_of(manifold3d.Manifold.hull_points(np.ascontiguousarray(cloud)) ^ whole).vertices
        if len(cloud) >= 4:
            fitted.append(cloud)
    if not fitted:  # CoACD gave up, or the hull is flat and what is left of its voxels is nothing
        return []
    owner = np.concatenate([np.full(len(cloud), k) for k, cloud in enumerate(fitted)])
    points = np.concatenate(fitted)
    lost: dict[int, list[Array]] = {}
    for vertex in vertices:
        away = ((points - vertex) ** 2).sum(axis=1)
        nearest = int(np.argmin(away))
        if away[nearest] > 0.0:
            lost.setdefault(int(owner[nearest]), []).append(vertex)
    return [np.concatenate([cloud, lost[k]]) if k in lost else cloud for k, cloud in enumerate(fitted)]
