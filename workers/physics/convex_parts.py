"""Convex parts of a body that is not convex, by CoACD (Wei, Liu, Ling and Su 2022, doi 10.1145/3528223.3530103).

Parts of built-in shapes follow from their making instead: see `workers.geometry.lathe_decomposition`. Parts are kept in memory
and in files, which may be deleted. docs/measured.md says what CoACD's threshold costs.
"""

import hashlib
import io
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import manifold3d
import numpy as np
import shapely
from cachetools import LRUCache
from scipy.spatial import QhullError

from schemas.base import Array, frozen_array
from schemas.environment import cache_folder
from schemas.errors import MachineError, MeshError
from schemas.scene.shape import Asset, Mesh
from workers.geometry import mesh as convexity
from workers.geometry.hull import convex_hull
from workers.geometry.lathe_decomposition import TOLERANCE, decompose_lofts
from workers.geometry.mesh import components, is_convex_surface, mesh_of, solid_of, weld
from workers.physics.coacd_process import MISSING

CAPACITY_BYTES = 64 * 1024 * 1024
"""Memory per process: a thousand mugs."""


class Parts(NamedTuple):
    """Vertices [N, 3] float64, metres, of each convex part of a body, and how they were made.

    convex: every piece of the body is; coacd: by CoACD; pieces: CoACD failed, and they are the hulls of the pieces; lofts:
    from the making of a built-in shape; none: there are none, because CoACD took too long.
    """

    clouds: tuple[Array, ...]
    method: str


USUAL_FOLDER = cache_folder("parts")


def key_of(*inputs: str | bytes) -> str:
    """SHA-256 of everything that an answer depends on."""
    whole = hashlib.sha256()
    for one in inputs:
        data = one.encode() if isinstance(one, str) else one
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()


class PartsCache:
    """The parts used last that fit `capacity_bytes` together, and files of all parts if a folder is given.

    A file begins with the SHA-256 of its content, by which a torn one is found and made again, and is renamed into place. A
    folder that cannot be written is ignored.
    """

    def __init__(self, capacity_bytes: int = CAPACITY_BYTES) -> None:
        self._kept: LRUCache[str, Parts] = LRUCache(capacity_bytes, lambda parts: sum(c.nbytes for c in parts.clouds))

    def get(self, key: str, folder: Path | None, make: Callable[[], Parts]) -> Parts:
        """The parts of this key: from memory, from the folder, or made. An exception of `make` leaves no trace."""
        if (parts := self._kept.get(key)) is not None:
            return parts
        parts = None if folder is None else _read(folder / key)
        if parts is None:
            parts = make()
            if folder is not None:
                with suppress(OSError):
                    _write(folder, key, parts)
        with suppress(ValueError):  # larger than all that is kept
            self._kept[key] = parts
        return parts


def _read(path: Path) -> Parts | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    if hashlib.sha256(data[size:]).digest() != data[:size]:
        return None
    with np.load(io.BytesIO(data[size:])) as stored:
        counts = stored["counts"]
        clouds = np.split(stored["vertices"], np.cumsum(counts)[:-1]) if len(counts) else []
        return Parts(tuple(frozen_array(cloud) for cloud in clouds), str(stored["method"]))


def _write(folder: Path, key: str, parts: Parts) -> None:
    content, counts = io.BytesIO(), [len(cloud) for cloud in parts.clouds]
    np.savez(content, method=parts.method, vertices=np.concatenate([np.empty((0, 3)), *parts.clouds]), counts=counts)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{key}.", delete=False) as file:
        try:
            file.write(hashlib.sha256(content.getvalue()).digest() + content.getvalue())
            file.flush()
            os.replace(file.name, folder / key)
        except OSError:
            Path(file.name).unlink(missing_ok=True)
            raise


THRESHOLD = 0.05
"""CoACD's concavity at which it stops, in units in which the mesh is 2 across. 0.02 halves the error and triples the parts."""

SIMPLER = 2e-3
"""Tolerance, as a share of its size, to which a closed body is simplified first: CoACD's time grows with the faces."""

MOST_PIECES = 128
"""A mesh in more pieces than this is cut as one."""

OPTIONS = {"mcts_iterations": 10, "mcts_nodes": 6, "mcts_max_depth": 1, "resolution": 300, "seed": 0}
"""A search one cut deep. CoACD's own, three deep with 150 trials, takes fifty times as long for a fifth fewer parts of a mug."""

OPEN = {"preprocess_mode": "on", "preprocess_resolution": 40}
"""For a mesh that is not a closed manifold, which is wrapped in voxels first: without, CoACD ends the process."""

LIBRARIES = ("coacd", "manifold3d", "numpy", "scipy")
"""Libraries whose versions change the parts of a mesh."""

NOT_INSTALLED = "the package `{}` is not installed, or cannot be loaded: set Verso up again with `./verso test`"

LONGEST_S = 60
"""Processor time for all pieces of a mesh: on some broken meshes CoACD never ends. The slowest that did end took half of it. It
is half of the default `run.scene_timeout_s`, so that a mesh without an end is a failure of that mesh, the same in every run:
where a job sets a shorter time, the worker is killed first, which is a failure of the machine."""

SCRAP = 1e-3
"""Thickness of a loose triangle, as a share of its distance from the middle of the mesh."""

MEMORY_MB = 2048
"""Address space of CoACD, MiB; where it is not enough CoACD gives up."""

NO_PARTS = "none"
"""The method of a body that has no parts within `LONGEST_S`, which is kept too."""

_CACHE = PartsCache()


def parts_of(asset: Asset, threshold: float = THRESHOLD, share: float = TOLERANCE) -> tuple[Array, ...]:
    """Vertices [N, 3], object frame, of each of an asset's convex parts: from its making if known, or else by CoACD.

    `threshold` is CoACD's, `share` that of `decompose_lofts`. CoACD also cuts a built-in shape whose outlines touch except
    for the last bits, which cannot be cut by its making.
    """
    lofted = asset.lofted
    if lofted is None:
        return decompose(asset.shape.mesh, asset.sha256, threshold).clouds
    key = key_of("lofts", repr(share), asset.sha256, asset.shape.mesh.vertices.tobytes())
    try:
        return _CACHE.get(key, None, lambda: Parts(decompose_lofts(lofted.lofts, share), "lofts")).clouds
    except (ValueError, shapely.errors.GEOSException):
        return decompose(asset.shape.mesh, asset.sha256, threshold).clouds


def decompose(mesh: Mesh, digest: str, threshold: float = THRESHOLD, folder: Path | None = USUAL_FOLDER) -> Parts:
    """Convex parts of a mesh: all within its hull, and together with the hull's vertices. Connected pieces are cut apart.

    The same arguments give the same bytes in every process, so results are kept in memory and in `folder` (None: nowhere).
    Raises MachineError if CoACD is missing or was killed from outside, MeshError `no_convex_parts` if it does not end in
    `LONGEST_S`: that is kept as parts are.
    """
    key = key_of(_version(), repr(threshold), digest, mesh.vertices.tobytes(), mesh.faces.tobytes())
    parts = _CACHE.get(key, folder, lambda: _decompose(mesh, threshold))
    if parts.method == NO_PARTS:
        detail = f"CoACD found no convex parts in {LONGEST_S} s of processor time, or none with a volume: mend the mesh"
        raise MeshError("no_convex_parts", detail)
    return parts


@cache
def _version() -> str:
    """Digest of the code that parts depend on: this folder's and the geometry's files, and the versions of libraries."""
    folders = Path(__file__).parent, Path(convexity.__file__).parent
    files = [file for folder in folders for file in sorted(folder.glob("*.py"))]
    try:
        return key_of(*(file.read_bytes() for file in files), *(version(name) for name in LIBRARIES))
    except PackageNotFoundError as error:
        raise MachineError(NOT_INSTALLED.format(error.name)) from error


def _decompose(mesh: Mesh, threshold: float) -> Parts:
    welded = weld(mesh)
    pieces = components(welded)
    if not pieces:
        return Parts((frozen_array(convex_hull(mesh.vertices).vertices),), "convex")
    if len(pieces) > MOST_PIECES:
        pieces = [welded]
    stop_s, made = _children_s() + LONGEST_S, []
    middle = 0.5 * (welded.vertices.min(axis=0) + welded.vertices.max(axis=0))
    for piece in pieces:
        try:
            if _has_hull(piece.vertices):
                made.append(_parts_of(piece, threshold, stop_s))
            else:
                # And a point a little nearer to the middle of the mesh, hence within its hull
                inner = piece.vertices.mean(axis=0) * (1.0 - SCRAP) + SCRAP * middle
                made.append(("convex", [np.concatenate([piece.vertices, [inner]])]))
        except subprocess.TimeoutExpired:
            return Parts((), NO_PARTS)
    method = max((method for method, _ in made), key=("convex", "coacd", "pieces").index)
    bodies = [cloud for _, clouds in made for cloud in clouds if _has_hull(cloud)]
    return Parts(tuple(frozen_array(cloud) for cloud in bodies), method if bodies else NO_PARTS)


def _has_hull(points: Array) -> bool:
    """Whether points [N, 3] have a convex hull: a single triangle has none, nor have points in a line but for rounding."""
    try:
        convex_hull(points)
    except (QhullError, ValueError):
        return False
    return True


def _children_s() -> float:
    """Processor seconds of all processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _parts_of(piece: Mesh, threshold: float, stop_s: float) -> tuple[str, list[Array]]:
    """How a piece was cut, and its parts. Raises TimeoutExpired where `_children_s` would come to `stop_s`."""
    hull, solid = convex_hull(piece.vertices), solid_of(piece)
    if is_convex_surface(piece, solid):
        return "convex", [hull.vertices]
    options = {**OPTIONS, **(OPEN if solid is None else {"preprocess_mode": "off"}), "threshold": threshold}
    size = float(np.linalg.norm(np.ptp(hull.vertices, axis=0)))
    cut = _run(piece if solid is None else mesh_of(solid.simplify(SIMPLER * size)), options, stop_s - _children_s())
    fitted = _fit(cut, hull.vertices, hull.normals)
    return ("coacd", fitted) if fitted else ("pieces", [hull.vertices])


def _run(mesh: Mesh, options: dict[str, object], cpu_s: float) -> list[Array]:
    """CoACD's parts of a mesh; none where it gives up. Raises TimeoutExpired after `cpu_s` of processor time, at least one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "request.npz", vertices=mesh.vertices, faces=mesh.faces, options=json.dumps(options))
        script = Path(__file__).with_name("coacd_process.py")
        limits = [str(max(1, math.ceil(cpu_s))), str(MEMORY_MB)]
        done = subprocess.run([sys.executable, "-P", str(script), name, *limits], capture_output=True)
        if done.returncode == -signal.SIGXCPU:
            raise subprocess.TimeoutExpired(done.args, cpu_s)
        if done.returncode == MISSING:
            raise MachineError(NOT_INSTALLED.format("coacd"))
        if done.returncode in (-signal.SIGINT, -signal.SIGKILL, -signal.SIGTERM):
            raise MachineError("CoACD was killed from outside, perhaps for want of memory: use fewer workers")
        if done.returncode != 0:
            return []
        with np.load(folder / "parts.npz") as parts:
            return [c for c in np.split(parts["vertices"], np.cumsum(parts["counts"])[:-1]) if len(c) >= 4]


def _fit(clouds: list[Array], vertices: Array, normals: Array) -> list[Array]:
    """The parts clipped to the hull, with the vertices of the hull that they lost."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    reach = (vertices @ normals.T).max(axis=0)
    whole = manifold3d.Manifold.hull_points(np.ascontiguousarray(vertices))
    fitted = []
    for cloud in clouds:
        if (cloud @ normals.T - reach).max() > 1e-9 * size:
            cloud = mesh_of(manifold3d.Manifold.hull_points(np.ascontiguousarray(cloud)) ^ whole).vertices
        if len(cloud) >= 4:
            fitted.append(cloud)
    if not fitted:  # CoACD gave up, or the hull is flat and clips all voxels away
        return []
    owner = np.concatenate([np.full(len(cloud), k) for k, cloud in enumerate(fitted)])
    points = np.concatenate(fitted)
    nearest = np.array([((points - vertex) ** 2).sum(axis=1).argmin() for vertex in vertices])
    lost = (points[nearest] != vertices).any(axis=1)
    return [np.concatenate([cloud, vertices[lost & (owner[nearest] == k)]]) for k, cloud in enumerate(fitted)]
