"""Exact rest of bodies on a ground: convex time steps between true meshes until nothing moves. Pure.

A step begins at rest: gravity, contacts that may not close beyond touching, dry friction.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial

import daqp
import numpy as np
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from schemas.scene.shape import MassProperties
from workers.geometry.frames import DOWN, pose, rotation_about, transform
from workers.physics.bullet import GRAVITY_M_S2, contact_friction
from workers.physics.contact_surface import Surface
from workers.physics.contacts import DEEPEST_M, Contacts, find_contacts, find_near_features

CONE_EDGES = 16
"""Edges of the pyramid inside a friction cone: it has at least cos(pi / 16) = 98 % of the friction in every direction."""

OPTIMAL, UNBOUNDED = 1, 1e30
"""DAQP's mark of a solution, and of a side without a bound."""

EXACT = 1e-10
"""Tolerance of the solver, in units in which 1 is the free fall of a step."""


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
    upper bodies, newtons, if nothing moves. multipliers [contacts, edges]: the same along the edges of the friction cones, as
    DAQP has them: negative, in units of its own.
    """

    moves: Array
    turns: Array
    forces: Array
    contacts: Contacts
    multipliers: Array

    def likely(self, contacts: Contacts, edge_count: int) -> Array:
        """[contacts, edges]: the multipliers of the next step, guessed: those of the nearest contact of the same two bodies."""
        guess = np.zeros((len(contacts.gaps), edge_count))
        carry = self.multipliers.any(axis=1)
        if len(guess) and carry.any() and self.multipliers.shape[1] == edge_count:
            away, nearest = cKDTree(_marks(contacts)).query(_marks(self.contacts)[carry])
            same = away < SAME_CONTACT_M
            guess[nearest[same]] = self.multipliers[carry][same]
        return guess


def _marks(contacts: Contacts) -> Array:
    """[N, 8]: near one another of contacts of the same bodies that are near and have like normals."""
    return np.column_stack([contacts.points, SAME_CONTACT_M * contacts.normals, contacts.upper, contacts.lower])


SAME_CONTACT_M = 5e-3
"""Distance up to which a contact of a step may be that of the step before. A wrong guess costs time alone."""


FLUSH_M = 1e-6
"""Overlap that may stay where contacts jam: sides of two bodies that are flush lie nanometres beyond one another, either way, and
no motion takes both apart."""


class JammedError(Exception):
    """No small motion takes all bodies out of one another."""


def step(
    bodies: Sequence[Inertia],
    frictions: Array,
    contacts: Contacts,
    fall: Array,
    spinning_m: float = 0.0,
    before: Motion | None = None,
) -> Motion:
    """The motion of bodies from rest in the time in which gravity alone moves them by `fall` [3], metres.

    The motion nearest to free fall, measured by kinetic energy, with `n . d + gap >= friction |t . d|` for the relative
    motion d at every contact: the convex relaxation of Coulomb's law by Anitescu (2006, "Optimization-based simulation of
    nonsmooth rigid multibody dynamics"). A least-distance problem, solved by DAQP (Arnstrom et al. 2022, "A dual active-set
    solver for embedded quadratic programming"). Its multipliers are the contact forces; where nothing moves they balance the
    weights, which is static equilibrium. Where no motion satisfies all, overlap of up to `FLUSH_M` may stay. frictions
    [bodies + 1]: coefficients of the bodies, and last of the ground. spinning_m: spinning friction of each, metres; the arm of a
    contact's torque is Bullet's, this times the sum of both coefficients. before: a step of the same bodies shortly before, by
    which it is solved ten times sooner. Raises JammedError.
    """
    # The inverse of the square root of each tensor of inertia
    roots = [(axes / np.sqrt(moments)) @ axes.T for moments, axes in (np.linalg.eigh(body.tensor) for body in bodies)]
    root_masses = np.sqrt([body.mass_kg for body in bodies])
    upper, lower = frictions[contacts.upper], frictions[contacts.lower]
    edges = _pyramid(contacts.normals, contact_friction(upper, lower))
    arms_m = np.zeros((len(edges), CONE_EDGES))
    if spinning_m:
        edges = np.concatenate([edges, contacts.normals[:, None].repeat(2, axis=1)], axis=1)
        arms_m = np.concatenate([arms_m, np.outer(spinning_m * (upper + lower), [1.0, -1.0])], axis=1)
    matrix, edge_count = _rows(bodies, roots, contacts, edges, arms_m), edges.shape[1]
    fall_m = float(np.linalg.norm(fall))
    free = np.zeros((len(bodies), 6))
    free[:, :3] = root_masses[:, None] * fall / fall_m
    # Lengths in units of `fall_m`, so that all numbers are near 1
    needed = -np.repeat(contacts.gaps / fall_m, edge_count) - matrix @ free.ravel()
    likely = None if before is None or not len(matrix) else before.likely(contacts, edge_count)
    try:
        away, multipliers = _least_distance(matrix, needed, likely)
    except JammedError:
        flush_m = np.where((contacts.gaps < 0.0) & (contacts.gaps >= -FLUSH_M), contacts.gaps, 0.0)
        if not flush_m.any():
            raise
        away, multipliers = _least_distance(matrix, needed + np.repeat(flush_m / fall_m, edge_count), likely)
    multipliers = multipliers.reshape(edges.shape[:2])
    forces = GRAVITY_M_S2 * (np.maximum(0.0, -multipliers)[..., None] * edges).sum(axis=1)
    moved = (free + away.reshape(free.shape)) * fall_m
    turns = np.stack([root @ each for root, each in zip(roots, moved[:, 3:], strict=True)])
    return Motion(moved[:, :3] / root_masses[:, None], turns, forces, contacts, multipliers)


def _least_distance(matrix: Array, least: Array, likely: Array | None = None) -> tuple[Array, Array]:
    """(x [n], multipliers [m] <= 0): the least x with `matrix @ x >= least`, which is `-matrix.T @ multipliers`.

    By the rows alone of multipliers that are `likely` [contacts, edges], if given, and such as prove to be missing: DAQP looks
    at all rows in every iteration, and a heap of 25 has seven thousand. Of each contact the edge is added that is worst.
    Raises JammedError where no x is.
    """
    if likely is None:
        return _solve(matrix, least)
    rows, multipliers, x = likely.ravel() != 0.0, likely.flatten(), np.zeros(matrix.shape[1])
    while True:
        if rows.any():
            x, multipliers[rows] = _solve(matrix[rows], least[rows], multipliers[rows])
        short = least - matrix @ x
        short[rows] = -np.inf
        worst = short.reshape(likely.shape).argmax(axis=1) + likely.shape[1] * np.arange(len(likely))
        missing = worst[short[worst] > EXACT]
        if not len(missing):
            return x, multipliers
        rows[missing] = True


def _solve(matrix: Array, least: Array, start: Array | None = None) -> tuple[Array, Array]:
    """The same of all rows, by DAQP, which begins at the multipliers `start` [m] and where that fails without."""
    count, size = matrix.shape
    if count == 0:
        return np.zeros(size), np.zeros(0)
    bounds = np.full(count, UNBOUNDED), least, np.zeros(count, dtype=np.int32)
    given = np.eye(size), np.zeros(size), matrix, *bounds
    x, _, flag, details = daqp.solve(*given, primal_tol=EXACT, dual_tol=EXACT, dual_start=start)
    if flag == OPTIMAL:
        return x, details["lam"]
    if start is None:
        raise JammedError
    return _solve(matrix, least)


def _rows(bodies: Sequence[Inertia], roots: Sequence[Array], contacts: Contacts, edges: Array, arms_m: Array) -> Array:
    """[contacts CONE_EDGES, 6 bodies]: how motion opens contacts along each edge, in units of root of kinetic energy."""
    rows = np.zeros((*edges.shape[:2], len(bodies), 6))
    twists = arms_m[:, :, None] * contacts.normals[:, None]
    for number, (body, root) in enumerate(zip(bodies, roots, strict=True)):
        its = np.flatnonzero(contacts.of(number))
        sign = np.where(contacts.upper[its] == number, 1.0, -1.0)[:, None, None]
        levers, along = contacts.points[its] - body.com, edges[its]
        rows[its, :, number, :3] = sign * along / np.sqrt(body.mass_kg)
        rows[its, :, number, 3:] = sign * (np.cross(levers[:, None], along) + twists[its]) @ root
    return rows.reshape(-1, 6 * len(bodies))


def _pyramid(normals: Array, friction: Array) -> Array:
    """[N, CONE_EDGES, 3]: edges of pyramids of these coefficients [N] about unit normals, with a normal component of 1.

    The first edge leans against gravity, so that a slope has all of its friction.
    """
    up = np.array([0.0, 0.0, 1.0]) - normals[:, 2:] * normals
    level = np.linalg.norm(up, axis=1) < 1e-3
    up[level] = np.cross(normals[level], [0.0, 1.0, 0.0])
    first = up / np.linalg.norm(up, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2.0 * np.pi * np.arange(CONE_EDGES) / CONE_EDGES
    side = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return normals[:, None] + friction[:, None, None] * side


LEVEL = 1e-3
"""Slope of a table that counts as level: what stands must not fall if the table leans by a millimetre in a metre. What would
moves by about this share of a fall; what stands, by gaps of some nanometres that are left."""

REACH_M = 1e-3
"""Gap up to which a contact is known. A point moves by half of it in a step at most, so that nothing is met unseen; a point
100 mm from an axis then leaves its tangent by 1.3 micrometres, which the next step corrects."""

FALL_M = 1e-4
"""Free fall in the shortest step. Longer ones, by powers of two, cross slow tipping in few steps."""

LONGEST_FALL_M = 0.4
"""Free fall in the longest step: 0.1 s."""

STILL = 1e-5
"""Motion as a share of free fall at which a body rests: of its weight, no more than this share is without balance."""

ASLANT_RAD = 0.3
"""Turn of these sides about z: along none of the symmetries of built shapes, which would carry one from edge to edge."""

MOST_NUDGES = 3
"""What stands still again so often after a nudge stands; a nudge moves by a tenth of a millimetre, and friction keeps some."""

MOST_STEPS, STEPS_EACH = 160, 40
"""Steps of few bodies, and for each of more. Of piles of eight most need 3 to 60; what falls from a part that fills a hollow does
so by half a millimetre a step, and of cups in one another each waits for the one below: six need 190."""

SLIDING_FALL_M = 6e-3
"""Free fall in the steps of what slides or tumbles freely; what creeps gets longer ones."""


SEAM_M = 1e-4
"""Overlap of which a jam is believed: steps leave nanometres of what they part, and Bullet some hundredths of a millimetre."""

MOST_SPUN = 16
"""Further steps in which contacts have spinning friction too, for what has not come to rest. A light body that is pinched
between a heavy one and the ground, corner over corner, can do nothing but spin."""


@dataclass(frozen=True, eq=False)
class Thing:
    """A body: the features of its mesh and its mass, in its own frame."""

    surface: Surface
    mass: MassProperties

    def inertia(self, T_world_obj: Pose) -> Inertia:
        """Its mass and inertia in world axes."""
        R = T_world_obj[:3, :3]
        return Inertia(self.mass.mass_kg, R @ self.mass.com + T_world_obj[:3, 3], R @ self.mass.inertia @ R.T)


@dataclass(frozen=True, eq=False)
class Rested:
    """Where bodies came to rest, or how far they came: `T_world_obj` [4, 4] of each. `still`: whether they rest.

    balanced: whether forces would hold them that nothing makes, as in a slot of their width, whatever the friction.
    """

    poses: tuple[Pose, ...]
    still: bool
    steps: int
    balanced: bool = False


def rest(
    things: Sequence[Thing],
    poses: Sequence[Pose],
    ground: Surface,
    frictions: Array,
    most_sliding: float = math.inf,
    spinning_m: float = 0.0,
) -> Rested:
    """Bodies let go at rest from `poses` (`T_world_obj`), followed without speed until nothing moves any more.

    What overlaps is moved apart, what hovers falls, what is out of balance tips, also from an edge or a corner that it was
    balanced on. frictions, spinning_m: as of `step`. Not `still` after `MOST_STEPS` and more or so many in which something
    slides, or where overlapping bodies are jammed.
    """
    most = max(MOST_STEPS, STEPS_EACH * len(things))
    surfaces, at, near = [*(thing.surface for thing in things), ground], tuple(poses), None
    reaches = np.array([np.linalg.norm(one.surface.vertices - one.mass.com, axis=1).max() for one in things])
    fall_m, longest_m, known_m, nudges, sliding = FALL_M, LONGEST_FALL_M, 0.0, 0, 0
    pushed, motion = np.zeros(0), None
    for number in range(most + (MOST_SPUN if spinning_m else 0)):
        sliding += fall_m < SLIDING_FALL_M
        if sliding > most_sliding and number < most:
            return Rested(at, False, number)
        points = [transform(T, thing.surface.vertices) for T, thing in zip(at, things, strict=True)] + [ground.vertices]
        if near is None or known_m <= 0.0:
            near, known_m = find_near_features(surfaces, points, DEEPEST_M + REACH_M), REACH_M
        contacts = find_contacts(surfaces, points, near, REACH_M, DEEPEST_M)
        inertias = [thing.inertia(T) for T, thing in zip(at, things, strict=True)]
        move = partial(step, inertias, frictions, spinning_m=spinning_m if number >= most else 0.0)
        try:
            motion, jammed = _step_past_seams(partial(move, before=motion), contacts, fall_m)
            if _farthest(motion, reaches) <= STILL * fall_m and nudges < MOST_NUDGES and not jammed:
                nudge, nudges = _nudge(partial(move, before=motion), contacts, reaches), nudges + 1
                if _farthest(nudge, reaches) > LEVEL * LEVEL * LONGEST_FALL_M:
                    motion, pushed = nudge, np.zeros(0)
        except JammedError:
            return Rested(at, False, number)
        moved_m = _farthest(motion, reaches)
        if moved_m <= STILL * fall_m:
            return Rested(at, not jammed, number)
        share = min(1.0, REACH_M / 2 / moved_m)
        at, known_m = _moved(at, inertias, motion, share), known_m - share * moved_m
        before, pushed = pushed, np.concatenate([motion.moves, motion.turns * reaches[:, None]]).ravel() / fall_m
        if len(before) and _swings_wider(before, pushed):
            longest_m = fall_m = max(FALL_M, fall_m / 4)
        else:
            fall_m = _next_fall_m(fall_m, longest_m, moved_m)
    return Rested(at, False, most)


Move = Callable[[Contacts, Array], Motion]
"""`step` of bodies, by contacts and a fall."""


def _step_past_seams(move: Move, contacts: Contacts, fall_m: float) -> tuple[Motion, bool]:
    """A step, and whether it left out contacts deeper than `SEAM_M`, which it does where none satisfies all. Raises JammedError.

    Edges on the two sides of a thin wall cross as if the wall were overlap: of bowls in one another for the instant in which
    their facets pass. Nothing may come to rest in such a step.
    """
    try:
        return move(contacts, fall_m * DOWN), False
    except JammedError:
        shallow = contacts.gaps >= -SEAM_M
        if shallow.all():
            raise
        few = Contacts(*(getattr(contacts, name.name)[shallow] for name in fields(Contacts)))
        return move(few, fall_m * DOWN), True


def _farthest(motion: Motion, reaches: Array) -> float:
    """Bound on the distance that any point moves; reaches [bodies]: of the points from their centre of mass, metres."""
    return float((np.linalg.norm(motion.moves, axis=1) + np.linalg.norm(motion.turns, axis=1) * reaches).max())


def _swings_wider(before: Array, now: Array) -> bool:
    """Whether motions of two steps, each as a share of its free fall, are opposed and grow.

    A step moves what hangs along the tangent of its swing, and beyond its lowest point where the free fall is over its length;
    over twice its length each step ends farther away than the one before.
    """
    sizes = float(np.linalg.norm(before)), float(np.linalg.norm(now))
    return sizes[1] > sizes[0] and float(before @ now) < -0.5 * sizes[0] * sizes[1]


def _nudge(move: Move, contacts: Contacts, reaches: Array) -> Motion:
    """The farthest motion of bodies in balance on a ground that leans by `LEVEL` to one of four sides."""
    x, y = LEVEL * math.cos(ASLANT_RAD), LEVEL * math.sin(ASLANT_RAD)
    sides = np.array([[x, y, 0.0], [-y, x, 0.0], [-x, -y, 0.0], [y, -x, 0.0]])
    motions = [move(contacts, LONGEST_FALL_M * (DOWN + side)) for side in sides]
    return max(motions, key=lambda motion: _farthest(motion, reaches))


def _next_fall_m(fall_m: float, longest_m: float, moved_m: float) -> float:
    """The free fall of the next step, so that bodies move by something below half of `REACH_M`."""
    if moved_m > REACH_M / 2:
        return max(FALL_M, fall_m / 2)
    return min(longest_m, 2 * fall_m) if moved_m < REACH_M / 4 else fall_m


def _moved(poses: Sequence[Pose], bodies: Sequence[Inertia], motion: Motion, share: float) -> tuple[Pose, ...]:
    """Poses [4, 4] after this share of a motion."""
    every = zip(poses, bodies, motion.moves, motion.turns, strict=True)
    return tuple(_turned(T, body.com, share * move, share * turn) for T, body, move, turn in every)


def _turned(T: Pose, com: Array, move: Array, turn: Array) -> Pose:
    """A pose [4, 4] turned by a rotation vector [3] about its centre of mass, which is moved."""
    angle = float(np.linalg.norm(turn))
    R = rotation_about(turn / angle, angle) if angle > 0.0 else np.eye(3)
    return pose(R @ T[:3, :3], com + move + R @ (T[:3, 3] - com))
