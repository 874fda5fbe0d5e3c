"""Whether bodies that touch can be at rest: static equilibrium, and the margin of support. Pure geometry."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from shapely.geometry import MultiPoint, Point

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.contact_points import find_contact_points
from workers.geometry.elevation import Terrain

CONE_EDGES = 8
"""Of the pyramid that stands for a cone of friction, within it: it holds at least cos(pi / 8) = 92 % of the true friction
in every direction, and all of it in eight."""

FIXED = -1
"""The number of what does not move, such as the table."""


@dataclass(frozen=True, eq=False)
class Weight:
    """A body as statics sees it: mass, centre of mass [3] metres in the world, and its size in metres."""

    mass_kg: float
    com: Array
    size_m: float


@dataclass(frozen=True, eq=False)
class Contact:
    """Where body `upper` touches body `lower` (or `FIXED`): points and unit normals [N, 3], from lower to upper."""

    upper: int
    lower: int
    points: Array
    normals: Array


def contact_points(upper: Mesh, lower: Mesh | Terrain, within_m: float) -> tuple[Array, Array]:
    """(points [N, 3], unit normals [N, 3], from lower to upper) where two meshes in world coordinates touch.

    Where they are within `within_m` of one another, see `find_contact_points`; of a surveyed ground only its vertices and
    faces that are not vertical.
    """
    if isinstance(lower, Terrain):
        a, b, c = lower.corners
        faces = np.arange(3 * len(a), dtype=np.int32).reshape(3, -1).T
        lower = Mesh(np.concatenate([a, b, c]), np.ascontiguousarray(faces))
    return find_contact_points(upper, lower, within_m)


def equilibrium_residual(bodies: Sequence[Weight], contacts: Sequence[Contact], friction: float) -> Array:
    """[n_bodies]: the share of each body's weight that no contact forces within the cones of friction can balance.

    The larger of what is left of the force, over the weight, and of the moment about the centre of mass, over weight
    times size; 0 is static equilibrium. Forces are found for all bodies at once by least squares under non-negativity
    (Lawson and Hanson 1974), in each contact along the `CONE_EDGES` edges of its pyramid. `friction` is the
    coefficient between two bodies (in Bullet the product of both).
    """
    blocks = [_columns(bodies, contact, friction) for contact in contacts if len(contact.points)]
    goal = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], len(bodies))
    left = goal
    if blocks:
        matrix = np.concatenate(blocks, axis=1)
        length = np.linalg.norm(matrix, axis=0)
        matrix = matrix / np.where(length > 0.0, length, 1.0)
        share, _ = nnls(matrix, goal, maxiter=max(1000, 10 * matrix.shape[1]))
        left = goal - matrix @ share
    parts = np.linalg.norm(left.reshape(-1, 2, 3), axis=2)
    return parts.max(axis=1)


def _columns(bodies: Sequence[Weight], contact: Contact, friction: float) -> Array:
    """[6 n_bodies, N CONE_EDGES]: force and moment that a unit along each edge gives, in each body's weight and size."""
    edges = _pyramid(contact.normals, friction)
    block = np.zeros((6 * len(bodies), len(edges) * CONE_EDGES))
    for who, sign in ((contact.upper, 1.0), (contact.lower, -1.0)):
        if who == FIXED:
            continue
        body = bodies[who]
        lever = (contact.points - body.com)[:, None, :] / body.size_m
        both = np.concatenate([edges, np.cross(np.broadcast_to(lever, edges.shape), edges)], axis=2)
        # In units of the lightest weight, so that columns of heavy and light bodies can be told apart.
        unit = min(one.mass_kg for one in bodies) / body.mass_kg
        block[6 * who : 6 * who + 6] += sign * unit * both.reshape(-1, 6).T
    return block


def _pyramid(normals: Array, friction: float) -> Array:
    """[N, CONE_EDGES, 3]: edges of the pyramids of friction about unit normals, each with a normal part of 1."""
    other = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, other)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2.0 * np.pi * np.arange(CONE_EDGES) / CONE_EDGES
    side = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return normals[:, None] + friction * side


def support_margin_m(points: Array, com: Array) -> float:
    """Metres that the centre of mass [3] projects inside the level hull of contact points [N, 3]; negative outside.

    On a line or a point there is no inside: minus the distance to it, 0 at best. -inf without contacts.
    """
    if len(points) == 0:
        return -np.inf
    outline, at = MultiPoint(points[:, :2]).convex_hull, Point(com[:2])
    if outline.geom_type == "Polygon" and outline.contains(at):
        return float(outline.exterior.distance(at))
    return -float(outline.distance(at))
