"""One convex time step of bodies that begin it at rest: gravity, contacts that may not close beyond touching, dry friction."""

from collections.abc import Sequence
from dataclasses import dataclass

import clarabel
import daqp
import numpy as np
from scipy.sparse import csc_array, eye_array

from schemas.base import Array
from workers.geometry.frames import cross_each
from workers.physics.rest.contacts import Contacts

CONE_EDGES = 16
"""Edges of the pyramid inside a friction cone: it has at least cos(pi / 16) = 98 % of the friction in every direction."""

OPTIMAL, UNBOUNDED = 1, 1e30
"""DAQP's mark of a solution, and of a side without a bound."""

EXACT = 1e-10
"""Tolerance of the solver, in units in which 1 is the free fall of a step."""

MANY = 25
"""Bodies from which Clarabel is used. Of 8 DAQP takes a seventh of its time, of 20 half of it, of 100 ten times as much."""


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


def step(bodies: Sequence[Inertia], contacts: Contacts, friction: float, fall: Array, gravity_m_s2: float) -> Motion:
    """The motion of bodies from rest in the time in which gravity alone moves them by `fall` [3], metres.

    The motion nearest to free fall, measured by kinetic energy, with `n . d + gap >= friction |t . d|` for the relative
    motion d at every contact: the convex relaxation of Coulomb's law by Anitescu (2006, "Optimization-based simulation of
    nonsmooth rigid multibody dynamics"). A least-distance problem, solved by DAQP (Arnstrom et al. 2022, "A dual active-set
    solver for embedded quadratic programming") or Clarabel (Goulart and Chen 2024, "Clarabel: an interior-point solver for
    conic programs with quadratic objectives"). Its multipliers are the contact forces; where nothing moves they balance the
    weights, which is static equilibrium. Raises JammedError.
    """
    roots = [_inverse_root(body.tensor) for body in bodies]
    root_masses = np.sqrt([body.mass_kg for body in bodies])
    edges = _pyramid(contacts.normals, friction)
    matrix = _rows(bodies, roots, contacts, edges)
    fall_m = float(np.linalg.norm(fall))
    free = np.zeros((len(bodies), 6))
    free[:, :3] = root_masses[:, None] * fall / fall_m
    # Lengths in units of `fall_m`, so that all numbers are near 1
    needed = -np.repeat(contacts.gaps / fall_m, CONE_EDGES) - matrix @ free.ravel()
    away, multipliers = _least_distance(matrix, needed)
    forces = gravity_m_s2 * (multipliers.reshape(-1, CONE_EDGES, 1) * edges).sum(axis=1)
    moved = (free + away.reshape(free.shape)) * fall_m
    turns = np.stack([root @ each for root, each in zip(roots, moved[:, 3:], strict=True)])
    return Motion(moved[:, :3] / root_masses[:, None], turns, forces)


def _least_distance(matrix: Array, least: Array) -> tuple[Array, Array]:
    """(x [n], multipliers [m] >= 0): the least x with `matrix @ x >= least`, which is `matrix.T @ multipliers`."""
    count, size = matrix.shape
    if count == 0:
        return np.zeros(size), np.zeros(0)
    if size >= MANY * 6:
        return _interior(matrix, least)
    bounds = np.full(count, UNBOUNDED), least, np.zeros(count, dtype=np.int32)
    x, _, flag, found = daqp.solve(np.eye(size), np.zeros(size), matrix, *bounds, primal_tol=EXACT, dual_tol=EXACT)
    if flag != OPTIMAL:
        raise JammedError
    return x, np.maximum(0.0, -found["lam"])


def _interior(matrix: Array, least: Array) -> tuple[Array, Array]:
    """The same by an interior-point method, where each row has few numbers that are not zero."""
    count, size = matrix.shape
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = 10.0 * EXACT  # rounding allows no less
    problem = eye_array(size, format="csc"), np.zeros(size), csc_array(-matrix), -least
    found = clarabel.DefaultSolver(*problem, [clarabel.NonnegativeConeT(count)], settings).solve()
    if found.status != clarabel.SolverStatus.Solved:
        raise JammedError
    return np.array(found.x), np.array(found.z)


def _inverse_root(tensor: Array) -> Array:
    """[3, 3]: the inverse of the square root of a tensor of inertia."""
    moments, axes = np.linalg.eigh(tensor)
    root: Array = (axes / np.sqrt(moments)) @ axes.T
    return root


def _rows(bodies: Sequence[Inertia], roots: Sequence[Array], contacts: Contacts, edges: Array) -> Array:
    """[contacts CONE_EDGES, 6 bodies]: how motion opens contacts along each edge, in units of root of kinetic energy."""
    rows = np.zeros((len(edges), CONE_EDGES, len(bodies), 6))
    for number, (body, root) in enumerate(zip(bodies, roots, strict=True)):
        own = np.flatnonzero(contacts.of(number))
        sign = np.where(contacts.upper[own] == number, 1.0, -1.0)[:, None, None]
        levers, along = contacts.points[own] - body.com, edges[own]
        rows[own, :, number, :3] = sign * along / np.sqrt(body.mass_kg)
        rows[own, :, number, 3:] = sign * cross_each(levers, along) @ root
    return rows.reshape(-1, 6 * len(bodies))


def _pyramid(normals: Array, friction: float) -> Array:
    """[N, CONE_EDGES, 3]: edges of friction pyramids about unit normals, with a normal component of 1.

    The first edge leans against gravity, so that a slope has all of its friction.
    """
    up = np.array([0.0, 0.0, 1.0]) - normals[:, 2:] * normals
    level = np.linalg.norm(up, axis=1) < 1e-3
    up[level] = cross_each(normals[level], np.full((np.count_nonzero(level), 1, 3), [0.0, 1.0, 0.0]))[:, 0]
    first = up / np.linalg.norm(up, axis=1, keepdims=True)
    second = cross_each(normals, first[:, None])[:, 0]
    angle = 2.0 * np.pi * np.arange(CONE_EDGES) / CONE_EDGES
    side = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return normals[:, None] + friction * side
