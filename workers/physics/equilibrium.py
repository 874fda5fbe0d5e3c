"""Static equilibrium of bodies in contact, and their margin of support. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from shapely.geometry import MultiPoint, Point

from schemas.base import Array

CONE_EDGES = 8
"""Edges of the pyramid inside a friction cone: it has at least cos(pi / 8) = 92 % of the friction in every direction, and all
of it in eight."""

FIXED = -1
"""Number of the body that does not move: the table."""


@dataclass(frozen=True, eq=False)
class Weight:
    """A body in statics: mass, centre of mass [3] metres in world coordinates, and size in metres."""

    mass_kg: float
    com: Array
    size_m: float


@dataclass(frozen=True, eq=False)
class Contact:
    """Contacts of body `upper` with body `lower` (or `FIXED`): points and unit normals [N, 3], from lower to upper."""

    upper: int
    lower: int
    points: Array
    normals: Array


def equilibrium_residual(bodies: Sequence[Weight], contacts: Sequence[Contact], friction: float) -> Array:
    """[n_bodies]: the share of each body's weight that contact forces within the friction cones cannot balance.

    The larger of the force left over, in weights, and the moment about the centre of mass left over, in weights times size;
    0 is static equilibrium. Solved for all bodies at once by non-negative least squares (Lawson and Hanson 1974) along the
    `CONE_EDGES` edges of each contact's pyramid. `friction` is the coefficient between two bodies (in Bullet the product of
    both).
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
    """[6 n_bodies, N CONE_EDGES]: force and moment of a unit force along each edge, in each body's weight and size."""
    edges = _pyramid(contact.normals, friction)
    block = np.zeros((6 * len(bodies), len(edges) * CONE_EDGES))
    for who, sign in ((contact.upper, 1.0), (contact.lower, -1.0)):
        if who == FIXED:
            continue
        body = bodies[who]
        lever = (contact.points - body.com)[:, None, :] / body.size_m
        both = np.concatenate([edges, np.cross(np.broadcast_to(lever, edges.shape), edges)], axis=2)
        # In units of the lightest weight: columns of heavy bodies must not vanish beside those of light ones.
        unit = min(one.mass_kg for one in bodies) / body.mass_kg
        block[6 * who : 6 * who + 6] += sign * unit * both.reshape(-1, 6).T
    return block


def _pyramid(normals: Array, friction: float) -> Array:
    """[N, CONE_EDGES, 3]: edges of the friction pyramids about unit normals, with a normal component of 1."""
    other = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, other)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2.0 * np.pi * np.arange(CONE_EDGES) / CONE_EDGES
    side = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return normals[:, None] + friction * side


def support_margin_m(points: Array, com: Array) -> float:
    """Metres from the projected centre of mass [3] to the edge of the level hull of contact points [N, 3]; negative outside.

    For contacts on a line or a point: minus the distance to it. -inf without contacts.
    """
    if len(points) == 0:
        return -np.inf
    outline, at = MultiPoint(points[:, :2]).convex_hull, Point(com[:2])
    if outline.geom_type == "Polygon" and outline.contains(at):
        return float(outline.exterior.distance(at))
    return -float(outline.distance(at))
