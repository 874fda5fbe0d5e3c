"""Pure: mass, centre of mass and inertia of a mesh, by exact integrals over its triangles."""

import manifold3d
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.scene.shape import MassProperties, Mesh, Shape
from workers.door.meshes.mesh import find_bodies, find_repeated, is_solid, merge_points
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of, mesh_of, piece_of, solid_of

MOST_UNITED = 512
"""Bodies of a file from which overlaps are not looked for."""

MOST_MEETING = 4_000_000
"""Pairs of bodies whose boxes meet, each times the root of its two counts of faces, from which overlaps are not looked for:
1.5 s of one core where they cross one another at random (`Manifold.batch_boolean` of cylinders of 128 and 384 faces)."""

SAME = 1e-9
"""Share of the volume below which an overlap is rounding."""


def mass_properties(shape: Shape, density_kg_m3: float, shell_kg_m2: float) -> MassProperties:
    """Mass properties in the shape's own frame: of a solid where the shape is watertight, else of a thin shell.

    Watertight means: after merging vertices at one place over all parts, every body is closed and consistently wound.
    A body wound inwards is a void and is taken away. Where closed bodies overlap, their union is weighed.
    """
    return weigh(shape, density_kg_m3, shell_kg_m2)[0]


def weigh(shape: Shape, density_kg_m3: float, shell_kg_m2: float) -> tuple[MassProperties, float | None]:
    """As `mass_properties`; and the volume that bodies have in common, which is weighed once, m^3.

    None where the bodies are too many to look for it: what they share, they then weigh twice.
    """
    vertices, faces = shape.vertices, shape.faces.astype(np.int64)
    if not is_solid(vertices, faces):
        return shell_mass(vertices, faces, shell_kg_m2), 0.0
    united, common_m3 = unite_bodies(vertices, faces)
    return solid_mass(*united, density_kg_m3), common_m3


def unite_bodies(vertices: Array, faces: NDArray[np.int64]) -> tuple[tuple[Array, NDArray[np.int64]], float | None]:
    """The surface of the union of closed bodies, voids taken from the body around them; and the volume that they share.

    As they are where none meet another or a void lies in none; None as the volume where it would take too long.
    """
    as_they_are = (vertices, faces)
    corners = merge_points(vertices)[faces]
    bodies = find_bodies(vertices, faces, corners, apart=True)
    all_m3, once = float(bodies.volume.sum()), corners
    repeated = find_repeated(corners, oriented=True)
    if repeated.any():  # a body that a file shows more than once
        single = find_bodies(vertices, faces[~repeated], corners[~repeated], apart=True)
        bodies, once = (single, corners[~repeated]) if single.closed.all() else (bodies, corners)
    if len(bodies.volume) > MOST_UNITED:
        return as_they_are, None
    places = np.zeros((int(corners.max()) + 1, 3))
    places[corners] = vertices[faces]
    whole = Mesh(places, once.astype(np.int32))
    pieces = [piece_of(whole, once[bodies.body == k]) for k in range(len(bodies.volume))]
    low, high = np.stack([bounds_of(piece.vertices) for piece in pieces], axis=1)
    outer = np.flatnonzero(bodies.volume > 0.0)
    below = (low[outer, None] < high[None, outer]).all(axis=2)
    a, b = np.nonzero(np.triu(below & below.T, k=1))
    if not len(a) and len(once) == len(corners):
        return as_they_are, 0.0
    count = np.sqrt([len(pieces[k].faces) for k in outer])
    if float((count[a] * count[b]).sum()) > MOST_MEETING:
        return as_they_are, None
    solids = {k: solid for k, piece in enumerate(pieces) if (solid := solid_of(piece)) is not None}
    for void in solids.keys() - set(outer.tolist()):
        around = [k for k in outer.tolist() if (low[k] < low[void]).all() and (high[void] < high[k]).all()]
        inmost = min(around, key=lambda k: float(bodies.volume[k]), default=None)
        if inmost not in solids:
            return as_they_are, 0.0
        solids[inmost] = solids[inmost] - solids[void]
    if len(solids) < len(pieces):
        return as_they_are, 0.0
    united = manifold3d.Manifold.batch_boolean([solids[k] for k in outer.tolist()], manifold3d.OpType.Add)
    common_m3 = all_m3 - united.volume()
    if common_m3 <= SAME * all_m3:
        return as_they_are, 0.0
    mesh = mesh_of(united)
    return (np.ascontiguousarray(mesh.vertices), mesh.faces.astype(np.int64)), common_m3


def solid_mass(vertices: Array, faces: np.ndarray, density_kg_m3: float) -> MassProperties:
    """Mass properties of the volume inside a closed, outward-wound mesh, kilograms and metres.

    Sums signed tetrahedra from the middle of the bounding box to each triangle (a, b, c), with s = a + b + c:
    volume det/6, first moment det/24 s, second moment det/120 (a a^T + b b^T + c c^T + s s^T)
    (Blow and Binstock, "How to find the inertia tensor of a solid body", 2004).
    """
    middle = bounds_of(vertices).sum(axis=0) * 0.5
    corners, det = _tetrahedra(vertices, faces, middle)
    mass = density_kg_m3 * float(det.sum()) / 6.0
    return _assemble(middle, corners, density_kg_m3 * det / 24.0, density_kg_m3 * det / 120.0, mass, solid=True)


def shell_mass(vertices: Array, faces: np.ndarray, shell_kg_m2: float) -> MassProperties:
    """Mass properties of a thin shell of uniform surface density, kilograms and metres; both sides of a face count once.

    For a triangle (a, b, c) of area A, with s = a + b + c: first moment A/3 s, second moment
    A/12 (a a^T + b b^T + c c^T + s s^T), from the barycentric integrals of 1, u, u^2 and u v
    (A, A/3, A/6 and A/12; Eisenberg and Malvern, "On finite element integration in natural co-ordinates", 1973).
    """
    middle = bounds_of(vertices).sum(axis=0) * 0.5
    corners, _ = _tetrahedra(vertices, faces, middle)
    a, b, c = corners
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a, axis=0), axis=0)
    mass = shell_kg_m2 * float(area.sum())
    return _assemble(middle, corners, shell_kg_m2 * area / 3.0, shell_kg_m2 * area / 12.0, mass, solid=False)


@compiled_for("f8[:,::1], i8[:,::1], f8[::1]", "f8[:,::1], const(i8[:,::1]), f8[::1]")
def _tetrahedra(vertices: Array, faces: NDArray[np.int64], middle: Array) -> tuple[Array, Array]:
    """The faces' corners measured from `middle` [3], [corner, axis, F], and six times the volumes [F] of their tetrahedra."""
    count = len(faces)
    corners, det = np.empty((3, 3, count)), np.empty(count)
    for f in range(count):
        for k in range(3):
            for axis in range(3):
                corners[k, axis, f] = vertices[faces[f, k], axis] - middle[axis]
        bx, by, bz = corners[1, 0, f], corners[1, 1, f], corners[1, 2, f]
        cx, cy, cz = corners[2, 0, f], corners[2, 1, f], corners[2, 2, f]
        x = corners[0, 0, f] * (by * cz - bz * cy)
        y = corners[0, 1, f] * (bz * cx - bx * cz)
        det[f] = x + y + corners[0, 2, f] * (bx * cy - by * cx)
    return corners, det


@compiled_for("f8[:,:,::1], f8[::1], f8[::1]")
def _moment_terms(corners: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """What `_assemble` adds up: [3, F] of the first moments, and [6, 4 F] of the second ones, in the order of `_PAIRS`."""
    count = len(first)
    firsts, seconds = np.empty((3, count)), np.empty((6, 4, count))
    point = np.empty((4, 3))
    for f in range(count):
        for axis in range(3):
            a, b, c = corners[0, axis, f], corners[1, axis, f], corners[2, axis, f]
            point[0, axis], point[1, axis], point[2, axis], point[3, axis] = a, b, c, a + b + c
            firsts[axis, f] = first[f] * point[3, axis]
        for vector in range(4):
            x, y, z = point[vector]
            seconds[0, vector, f] = second[f] * x * x
            seconds[1, vector, f] = second[f] * y * y
            seconds[2, vector, f] = second[f] * z * z
            seconds[3, vector, f] = second[f] * x * y
            seconds[4, vector, f] = second[f] * x * z
            seconds[5, vector, f] = second[f] * y * z
    return firsts, seconds.reshape(6, -1)


_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _assemble(middle: Array, corners: Array, first: Array, second: Array, mass: float, solid: bool) -> MassProperties:
    """Mass properties from the weights [F] of s and of the outer products; numpy adds the terms, pairwise."""
    firsts, seconds = _moment_terms(corners, first, second)
    com = firsts.sum(axis=1) / mass
    moments = np.empty((3, 3))
    for (j, k), term in zip(_PAIRS, seconds.sum(axis=1), strict=True):
        moments[j, k] = moments[k, j] = float(term) - mass * com[j] * com[k]
    inertia = np.trace(moments) * np.eye(3) - moments
    return MassProperties(mass, frozen_array(middle + com), frozen_array(inertia), solid)
