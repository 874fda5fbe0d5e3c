"""Pure: hollow vessels: a wall of even thickness around a hollow, with or without handles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from workers.assets.builtin.curves import half_circle_points, outward_normals
from workers.assets.builtin.solid import Indices, Solid, union_at

HANDLE_ROOM_M = 0.002
"""A handle may meet the faces of a vessel that are this near to its bounding box."""

OUTSIDE, INSIDE, BASE = 0, 1, 2
"""Surface numbers of a vessel."""


@dataclass(frozen=True, eq=False)
class Wall:
    """The profile of a hollow vessel and the surface number of each of its segments.

    profile [P, 2] of (radius, height), metres, axis to axis; surface [P - 1]; outer [Q, 2]: the stretch of the profile
    that is the outside of the wall, bottom to rim; thickness_m: of the wall.
    """

    profile: Array
    surface: Indices
    outer: Array
    thickness_m: float

    def radius_at(self, z: float) -> float:
        """Outer radius at a height, metres."""
        return float(np.interp(z, self.outer[:, 1], self.outer[:, 0]))

    def normal_at(self, z: float) -> Array:
        """[2] float64: the unit normal (radius, height) of the outside at a height."""
        low, high = z - 0.002, z + 0.002
        step = np.array([self.radius_at(high) - self.radius_at(low), high - low])
        return np.array([step[1], -step[0]]) / float(np.sqrt(step[0] * step[0] + step[1] * step[1]))

    def middle_at(self, z: float) -> Array:
        """[2] float64: the point (radius, height) midway through the wall that lies behind the outside at a height."""
        return np.array([self.radius_at(z), z]) - 0.5 * self.thickness_m * self.normal_at(z)


def wall_around(hollow: Array, thickness_m: float, foot_radius: float, foot_width: float, recess: float) -> Wall:
    """A wall of even thickness around a hollow [P, 2] from (0, height of the inner bottom) to the rim.

    The vessel stands on a ring from foot_radius - foot_width to foot_radius at height 0; inside the ring the underside lies
    `recess` higher. The rim is round.
    """
    offset = hollow + thickness_m * outward_normals(hollow)
    outer = offset[int(((offset[:, 0] > foot_radius + 2e-4) & (offset[:, 1] > 2e-4)).argmax()) :]
    inner_foot = foot_radius - foot_width
    base = np.array([[0.0, recess], [inner_foot - 0.4 * recess, recess], [inner_foot, 0.0], [foot_radius, 0.0]])
    rim = half_circle_points(outer[-1], hollow[-1], 3)
    profile = np.concatenate([base, outer, rim, hollow[::-1]])
    surface = np.repeat([BASE, OUTSIDE, INSIDE], [len(base) - 1, len(outer) + 2, len(hollow) + 1])
    return Wall(profile, surface, np.concatenate([base[-1:], outer]), thickness_m)


def with_handles(body: Solid, outside: int, handles: Sequence[Solid]) -> Solid:
    """A vessel about the z axis with handles that end inside its wall; `outside`: the surface number of its outside."""
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    touched = np.zeros(len(body.faces), dtype=np.bool_)
    for handle in handles:
        start, stop = handle.vertices.min(axis=0) - HANDLE_ROOM_M, handle.vertices.max(axis=0) + HANDLE_ROOM_M
        touched |= ((high >= start) & (low <= stop)).all(axis=1)
    touched &= body.surface == outside
    middle = 0.5 * float(low[touched, 2].min() + high[touched, 2].max())
    return union_at(body, touched, np.array([0.0, 0.0, middle]), handles)
