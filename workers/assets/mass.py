"""Pure: mass, centre of mass and inertia of a mesh, by exact integrals over its triangles."""

import numpy as np

from schemas.base import Array, frozen_array
from schemas.scene.shape import MassProperties, Shape
from workers.assets.external.topology import is_solid


def mass_properties(shape: Shape, density_kg_m3: float, shell_kg_m2: float) -> MassProperties:
    """Mass properties in the shape's own frame: of a solid where the shape is watertight, else of a thin shell.

    Watertight means: after merging vertices at one place over all parts, every body is closed and consistently wound.
    Bodies are weighed one by one and added: where two closed bodies overlap, the overlap weighs twice, as glued pieces
    would; a body wound inwards is a void and is taken away.
    """
    vertices, faces = shape.vertices, shape.faces.astype(np.int64)
    if is_solid(vertices, faces):
        return solid_mass(vertices, faces, density_kg_m3)
    return shell_mass(vertices, faces, shell_kg_m2)


def solid_mass(vertices: Array, faces: np.ndarray, density_kg_m3: float) -> MassProperties:
    """Mass properties of the volume inside a closed, outward-wound mesh, kilograms and metres.

    Sums signed tetrahedra from the middle of the bounding box to each triangle (a, b, c), with s = a + b + c:
    volume det/6, first moment det/24 s, second moment det/120 (a a^T + b b^T + c c^T + s s^T)
    (Blow and Binstock, "How to find the inertia tensor of a solid body", 2004).
    """
    middle, corners = _corners(vertices, faces)
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
    det = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    mass = density_kg_m3 * float(det.sum()) / 6.0
    return _assemble(middle, corners, density_kg_m3 * det / 24.0, density_kg_m3 * det / 120.0, mass, solid=True)


def shell_mass(vertices: Array, faces: np.ndarray, shell_kg_m2: float) -> MassProperties:
    """Mass properties of a thin shell of uniform surface density, kilograms and metres; both sides of a face count once.

    For a triangle (a, b, c) of area A, with s = a + b + c: first moment A/3 s, second moment
    A/12 (a a^T + b b^T + c c^T + s s^T), from the barycentric integrals of 1, u, u^2 and u v
    (A, A/3, A/6 and A/12; Eisenberg and Malvern, "On finite element integration in natural co-ordinates", 1973).
    """
    middle, corners = _corners(vertices, faces)
    a, b, c = corners
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a, axis=0), axis=0)
    mass = shell_kg_m2 * float(area.sum())
    return _assemble(middle, corners, shell_kg_m2 * area / 3.0, shell_kg_m2 * area / 12.0, mass, solid=False)


def _corners(vertices: Array, faces: np.ndarray) -> tuple[Array, Array]:
    """The bounding box's middle [3], and the faces' corners measured from it: [corner, axis, F]."""
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    local = np.ascontiguousarray((vertices - middle).T)
    return middle, np.stack([np.take(local, faces[:, k], axis=1) for k in range(3)])


def _assemble(middle: Array, corners: Array, first: Array, second: Array, mass: float, solid: bool) -> MassProperties:
    """Mass properties from the weights [F] of s and of the outer products."""
    total = corners[0] + corners[1] + corners[2]
    com = (first * total).sum(axis=1) / mass
    vectors = np.stack([*corners, total], axis=1)  # [axis, vector, F]
    weighted = second * vectors
    moments = np.empty((3, 3))
    for j, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        moments[j, k] = moments[k, j] = float((weighted[j] * vectors[k]).sum()) - mass * com[j] * com[k]
    inertia = np.trace(moments) * np.eye(3) - moments
    return MassProperties(mass, frozen_array(middle + com), frozen_array(inertia), solid)
