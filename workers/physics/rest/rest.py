"""Exact rest of bodies on a ground: convex steps from rest between true meshes, until nothing moves. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose
from schemas.scene.shape import MassProperties
from workers.geometry.contact_surface import Surface
from workers.geometry.frames import DOWN, pose, rotation_about, transform
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.rest.contacts import DEEPEST_M, Contacts, find_contacts, find_near_features
from workers.physics.rest.step import Inertia, JammedError, Motion, step

LEVEL = 1e-3
"""Slope of a table that counts as level: what stands must not fall if the table leans by a millimetre in a metre. What would
moves by about this share of a fall; what stands, by gaps of some nanometres that are left."""

REACH_M = 1e-3
"""Gap up to which a contact is known. A point moves by half of it in a step at most, so that nothing is met unseen; a point
100 mm from an axis then leaves its tangent by 1.3 micrometres, which the next step corrects."""

FALL_M = 1e-4
"""Free fall in the shortest step. Longer ones, by powers of two, cross slow tipping in few steps."""

LONGEST_FALL_M = 0.05
"""Free fall in the longest step: 0.1 s."""

STILL = 1e-5
"""Motion as a share of free fall at which a body rests: of its weight, no more than this share is without balance."""

ASLANT_RAD = 0.3
"""Turn of these sides about z: along none of the symmetries of built shapes, which would carry one from edge to edge."""

MOST_NUDGES = 3
"""What stands still again so often after a nudge stands; a nudge moves by a tenth of a millimetre, and friction keeps some."""

MOST_STEPS = 160
"""Of piles of eight most need 3 to 60 steps; what falls from a part that fills a hollow does so by half a millimetre a step."""


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
    """Where bodies came to rest, or how far they came: `T_world_obj` [4, 4] of each. `still`: whether they rest."""

    poses: tuple[Pose, ...]
    still: bool
    steps: int


def rest(things: Sequence[Thing], poses: Sequence[Pose], ground: Surface, friction: float) -> Rested:
    """Bodies let go at rest from `poses` (`T_world_obj`), followed without speed until nothing moves any more.

    What overlaps is moved apart, what hovers falls, what is out of balance tips, also from an edge or a corner that it was
    balanced on. friction: the coefficient of a contact. Not `still` after `MOST_STEPS`, or where overlapping bodies are jammed.
    """
    surfaces, at, near = [*(thing.surface for thing in things), ground], tuple(poses), None
    reaches = np.array([np.linalg.norm(one.surface.vertices - one.mass.com, axis=1).max() for one in things])
    fall_m, known_m, nudges = FALL_M, 0.0, 0
    for number in range(MOST_STEPS):
        points = [transform(T, thing.surface.vertices) for T, thing in zip(at, things, strict=True)] + [ground.vertices]
        if near is None or known_m <= 0.0:
            near, known_m = find_near_features(surfaces, points, DEEPEST_M + REACH_M), REACH_M
        contacts = find_contacts(surfaces, points, near, REACH_M, DEEPEST_M)
        inertias = [thing.inertia(T) for T, thing in zip(at, things, strict=True)]
        try:
            motion = step(inertias, contacts, friction, fall_m * DOWN, GRAVITY_M_S2)
            moved_m = _farthest(motion, reaches)
            if moved_m <= STILL * fall_m and nudges < MOST_NUDGES:
                nudge, nudges = _nudge(inertias, contacts, friction, reaches), nudges + 1
                if _farthest(nudge, reaches) > LEVEL * LEVEL * LONGEST_FALL_M:
                    motion, moved_m = nudge, _farthest(nudge, reaches)
        except JammedError:
            return Rested(at, False, number)
        if moved_m <= STILL * fall_m:
            return Rested(at, True, number)
        share = min(1.0, REACH_M / 2 / moved_m)
        at = tuple(
            _moved(T, body.com, share * move, share * turn)
            for T, body, move, turn in zip(at, inertias, motion.moves, motion.turns, strict=True)
        )
        known_m -= share * moved_m
        fall_m = _next_fall(fall_m, moved_m)
    return Rested(at, False, MOST_STEPS)


def _farthest(motion: Motion, reaches: Array) -> float:
    """Bound on the distance that any point moves; reaches [bodies]: of the points from their centre of mass, metres."""
    return float((np.linalg.norm(motion.moves, axis=1) + np.linalg.norm(motion.turns, axis=1) * reaches).max())


def _nudge(bodies: Sequence[Inertia], contacts: Contacts, friction: float, reaches: Array) -> Motion:
    """The farthest motion of bodies in balance on a ground that leans by `LEVEL` to one of four sides."""
    x, y = LEVEL * math.cos(ASLANT_RAD), LEVEL * math.sin(ASLANT_RAD)
    sides = np.array([[x, y, 0.0], [-y, x, 0.0], [-x, -y, 0.0], [y, -x, 0.0]])
    motions = [step(bodies, contacts, friction, LONGEST_FALL_M * (DOWN + side), GRAVITY_M_S2) for side in sides]
    return max(motions, key=lambda motion: _farthest(motion, reaches))


def _next_fall(fall_m: float, moved_m: float) -> float:
    """The free fall of the next step: so that bodies move by something below half of `REACH_M`."""
    if moved_m > REACH_M / 2:
        return max(FALL_M, fall_m / 2)
    return min(LONGEST_FALL_M, 2 * fall_m) if moved_m < REACH_M / 4 else fall_m


def _moved(T: Pose, com: Array, move: Array, turn: Array) -> Pose:
    """A pose [4, 4] turned by a rotation vector [3] about its centre of mass, which is moved."""
    angle = float(np.linalg.norm(turn))
    R = rotation_about(turn / angle, angle) if angle > 0.0 else np.eye(3)
    return pose(R @ T[:3, :3], com + move + R @ (T[:3, 3] - com))
