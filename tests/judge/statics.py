"""Static equilibrium of bodies under their weight, as a linear program over the friction cones of all contacts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from schemas.base import Array
from tests.judge.contacts import Contacts

EDGES = 32
"""Edges of the pyramid inside a friction cone: it has at least cos(pi / 32) = 99.5 % of the friction in any direction, so
a body may be told to lack up to 0.5 % of its friction."""

GROUND = -1
"""Number of the body that does not move."""

CLOSE = 1e-4
"""Share of a weight to which the greatest unbalanced share is found."""

MOST_ROUNDS = 12
"""Rounds of further directions: each multiplies what the bound may be off by less than a half."""


@dataclass(frozen=True, eq=False)
class Body:
    """A weight: kilograms, centre of mass [3] and size in metres."""

    mass_kg: float
    com: Array
    size_m: float


@dataclass(frozen=True, eq=False)
class Touch:
    """Contacts between two bodies, with normals towards `upper` and a coefficient of friction."""

    upper: int
    lower: int
    at: Contacts
    friction: float


def unbalanced_shares(bodies: Sequence[Body], touches: Sequence[Touch]) -> Array:
    """[N]: what forces within the cones must leave of each weight.

    The larger of the force, in weights, and of the moment about the centre of mass, in weights times size. The largest of
    bodies that touch one another is the least possible, and then their sum. Gravity is along -z.
    """
    shares = np.zeros(len(bodies))
    for members in _groups(len(bodies), touches):
        own = [touch for touch in touches if touch.upper in members]
        shares[members] = _solve([bodies[k] for k in members], own, {k: n for n, k in enumerate(members)})
    return shares


def _groups(count: int, touches: Sequence[Touch]) -> list[list[int]]:
    """The numbers of bodies that hang together by contacts among themselves."""
    links = [(touch.upper, touch.lower) for touch in touches if touch.lower != GROUND and len(touch.at.points)]
    i, j = np.array(links, dtype=int).reshape(-1, 2).T
    label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count)), directed=False)[1]
    return [list(np.flatnonzero(label == one)) for one in np.unique(label)]


def _solve(bodies: Sequence[Body], touches: Sequence[Touch], number: dict[int, int]) -> Array:
    blocks = [_columns(bodies, touch, number) for touch in touches if len(touch.at.points)]
    weights = np.tile([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], len(bodies))
    if not blocks:
        return np.ones(len(bodies))
    matrix = np.concatenate(blocks, axis=1)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    directions = [axes] * (2 * len(bodies))
    for _ in range(MOST_ROUNDS):
        forces, bounds = _program(matrix, weights, directions)
        left = (matrix @ forces + weights).reshape(-1, 3)
        sizes = np.linalg.norm(left, axis=1)
        found = sizes.reshape(-1, 2).max(axis=1)
        short = sizes > np.repeat(bounds, 2) + CLOSE
        if not short.any():
            break
        directions = [
            np.concatenate([known, rest[None] / size]) if more else known
            for known, rest, size, more in zip(directions, left, sizes, short, strict=True)
        ]
    return found


def _program(matrix: Array, weights: Array, directions: Sequence[Array]) -> tuple[Array, Array]:
    """(forces along every edge, bound on each body's share) where the greatest bound is least, then their sum.

    Row by row: what is left of a force or a moment, along each of its directions, is at most its body's bound.
    """
    count, edges = len(directions) // 2, matrix.shape[1]
    rows = np.concatenate([along @ matrix[3 * k : 3 * k + 3] for k, along in enumerate(directions)])
    limits = np.concatenate([-along @ weights[3 * k : 3 * k + 3] for k, along in enumerate(directions)])
    owner = np.repeat(np.arange(len(directions)) // 2, [len(along) for along in directions])
    own = -np.eye(count)[owner]
    worst = linprog(
        np.append(np.zeros(edges), 1.0), A_ub=np.column_stack([rows, -np.ones(len(rows))]), b_ub=limits, method="highs"
    )
    if worst.status != 0:
        raise RuntimeError(f"the linear program of {count} bodies has no answer: {worst.message}")
    if count == 1 or worst.fun <= CLOSE:
        return worst.x[:edges], np.full(count, worst.x[edges])
    cap = [(0.0, None)] * edges + [(0.0, worst.fun + CLOSE / 10)] * count
    goal = np.append(np.zeros(edges), np.ones(count))
    all_of = linprog(goal, A_ub=np.column_stack([rows, own]), b_ub=limits, bounds=cap, method="highs")
    best = all_of if all_of.status == 0 else worst
    return best.x[:edges], best.x[edges:] if all_of.status == 0 else np.full(count, worst.x[edges])


def _columns(bodies: Sequence[Body], touch: Touch, number: dict[int, int]) -> Array:
    """[6 n, N EDGES]: force in weights and moment in weights times size, of a force along each edge of each pyramid.

    A force of 1 is the weight of the lighter of the two.
    """
    across = _tangents(touch.at.normals)
    angle = 2.0 * np.pi * np.arange(EDGES) / EDGES
    turn = np.stack([np.cos(angle), np.sin(angle)])
    forces = touch.at.normals[:, None] + touch.friction * np.einsum("ke,nkx->nex", turn, across)
    two = [(k, sign) for k, sign in ((touch.upper, 1.0), (touch.lower, -1.0)) if k != GROUND]
    unit = min(bodies[number[k]].mass_kg for k, _ in two)
    block = np.zeros((6 * len(bodies), len(forces) * EDGES))
    for k, sign in two:
        n, body = number[k], bodies[number[k]]
        arms = np.broadcast_to((touch.at.points - body.com)[:, None] / body.size_m, forces.shape)
        wrench = np.concatenate([forces, np.cross(arms, forces)], axis=2)
        block[6 * n : 6 * n + 6] = sign * unit / body.mass_kg * wrench.reshape(-1, 6).T
    return block


def _tangents(normals: Array) -> Array:
    """[N, 2, 3]: two unit vectors at right angles to each normal and to one another."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)
