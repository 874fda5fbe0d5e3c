"""One convex time step of bodies that begin it at rest: gravity, contacts that may not close beyond touching, dry friction."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from schemas.base import Array
from workers.physics.rest.contacts import Contacts

CONE_EDGES = 8
"""Edges of the pyramid inside a friction cone: it has at least cos(pi / 8) = 92 % of the friction in every direction, and all
of it in eight."""

JAMMED = 1e-7
"""Distance from feasibility, in units in which 1 is a contact that is missed by the fall of a step."""


@dataclass(frozen=True, eq=False)
class Inertia:
    """A body in mechanics: mass, centre of mass [3] metres and tensor of inertia [3, 3] kg m^2, in world axes."""

    mass_kg: float
    com: Array
    tensor: Array


@dataclass(frozen=True, eq=False)
class Motion:
    """What bodies do in a step, and the forces that make them.

    moves and turns [bodies, 3]: of the centres of mass, metres, and about them, radians, world; forces [contacts, 3]: on the
    upper bodies, newtons, if nothing moves.
    """

    moves: Array
    turns: Array
    forces: Array


class JammedError(Exception):
    """No small motion takes all bodies out of one another."""


def step(bodies: Sequence[Inertia], contacts: Contacts, friction: float, fall_m: float, gravity_m_s2: float) -> Motion:
    """The motion of bodies from rest in the time in which gravity alone moves them by `fall_m`.

    The motion nearest to free fall, measured by kinetic energy, with `n . d + gap >= friction |t . d|` for the relative
    motion d at every contact: the convex relaxation of Coulomb's law by Anitescu (2006, "Optimization-based simulation of
    nonsmooth rigid multibody dynamics"). A least-distance problem, solved by nonnegative least squares (Lawson and Hanson
    1974, chapter 23). Its multipliers are the contact forces; where nothing moves they balance the weights, which is static
    equilibrium. Raises JammedError.
    """
    roots = [_inverse_root(body.tensor) for body in bodies]
    root_masses = np.sqrt([body.mass_kg for body in bodies])
    edges = _pyramid(contacts.normals, friction)
    matrix = _rows(bodies, roots, contacts, edges)
    free = np.zeros((len(bodies), 6))
    free[:, 2] = -root_masses
    # Lengths in units of `fall_m`, so that all numbers are near 1
    needed = -np.repeat(contacts.gaps / fall_m, CONE_EDGES) - matrix @ free.ravel()
    system = np.concatenate([matrix.T, needed[None]])
    goal = np.zeros(len(system))
    goal[-1] = 1.0
    if system.shape[1] == 0:
        return _motion(free * fall_m, roots, root_masses, np.empty((0, 3)))
    scale = np.linalg.norm(system, axis=0)
    share, distance = nnls(system / scale, goal, maxiter=max(1000, 10 * len(scale)))
    if distance < JAMMED:
        raise JammedError
    left = system @ (share / scale) - goal
    moved = free - (left[:-1] / left[-1]).reshape(free.shape)
    multipliers = (share / scale / -left[-1]).reshape(-1, CONE_EDGES)
    forces = gravity_m_s2 * (multipliers[:, :, None] * edges).sum(axis=1)
    return _motion(moved * fall_m, roots, root_masses, forces)


def _motion(moved: Array, roots: Sequence[Array], root_masses: Array, forces: Array) -> Motion:
    """The motion from that in units of root of kinetic energy [bodies, 6]."""
    turns = np.stack([root @ each for root, each in zip(roots, moved[:, 3:], strict=True)])
    return Motion(moved[:, :3] / root_masses[:, None], turns, forces)


def _inverse_root(tensor: Array) -> Array:
    """[3, 3]: the inverse of the square root of a tensor of inertia."""
    moments, axes = np.linalg.eigh(tensor)
    root: Array = (axes / np.sqrt(moments)) @ axes.T
    return root


def _rows(bodies: Sequence[Inertia], roots: Sequence[Array], contacts: Contacts, edges: Array) -> Array:
    """[contacts CONE_EDGES, 6 bodies]: how motion opens contacts along each edge, in units of root of kinetic energy."""
    rows = np.zeros((len(edges), CONE_EDGES, len(bodies), 6))
    for who, sign in ((contacts.upper, 1.0), (contacts.lower, -1.0)):
        for number, (body, root) in enumerate(zip(bodies, roots, strict=True)):
            own = np.flatnonzero(who == number)
            lever = (contacts.points[own] - body.com)[:, None, :]
            rows[own, :, number, :3] = sign * edges[own] / np.sqrt(body.mass_kg)
            rows[own, :, number, 3:] = sign * np.cross(lever, edges[own]) @ root
    return rows.reshape(-1, 6 * len(bodies))


def _pyramid(normals: Array, friction: float) -> Array:
    """[N, CONE_EDGES, 3]: edges of friction pyramids about unit normals, with a normal component of 1.

    The first edge leans against gravity, so that a slope has all of its friction.
    """
    up = np.array([0.0, 0.0, 1.0]) - normals[:, 2:] * normals
    level = np.linalg.norm(up, axis=1) < 1e-3
    up[level] = np.cross(normals[level], [0.0, 1.0, 0.0])
    first = up / np.linalg.norm(up, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2.0 * np.pi * np.arange(CONE_EDGES) / CONE_EDGES
    side = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return normals[:, None] + friction * side
