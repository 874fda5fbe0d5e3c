"""What is watched as bodies fall: their energy, and the conditions that end a simulation early. Pure."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from schemas.base import Array
from schemas.scene.plan import ObjectStart
from workers.geometry.frames import invert
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.rest_pose import Face, find_face
from workers.physics.rigid_body import Body, BodyPose, as_pose
from workers.physics.table_top import inside_margin

SHARE = 1e-3
"""Bound on a rise of energy, as a share of what the drop sets free."""

LIFT_M = 2e-5
"""The same as a height that the rise would lift the body by, where that is more: what Bullet leaves a shape to hover by."""

SLIDE_M = 1e-7
"""Distance that an object may still slide. Bullet's own steps at rest move it by as much."""

Velocity = tuple[Sequence[float], Sequence[float]]
"""Velocity of the centre of mass, m/s, and angular velocity, rad/s, world axes."""

StopCondition = Callable[[int, BodyPose], bool]
"""Whether a body, by its number, at this pose ends the simulation."""

StandingCondition = Callable[[BodyPose, Velocity], Face | None]
"""The face below a body at this pose and velocity, if it stays on it."""


class EnergyRecord:
    """The energy of bodies from time to time, over their weight, metres: the first, the least and the last of it."""

    def __init__(self, bodies: Sequence[Body], at: Sequence[BodyPose], moving: Sequence[Velocity]) -> None:
        mass_kg = sum(body.mass_kg for body in bodies)
        self._shares = [body.mass_kg / mass_kg for body in bodies]
        self._radii2 = [[float(moment) / body.mass_kg for moment in body.moments] for body in bodies]
        self._first = self._least = self._last = self._height_m(at, moving)
        self._most = 0.0

    def add(self, at: Sequence[BodyPose], moving: Sequence[Velocity]) -> None:
        """Note the energy at these poses and velocities."""
        self._last = self._height_m(at, moving)
        self._least = min(self._least, self._last)
        self._most = max(self._most, self._last - self._least)

    def rise(self) -> float:
        """The most that the energy rose above its least until then, as a share of the bound."""
        return self._most / max(SHARE * (self._first - self._last), LIFT_M)

    def _height_m(self, at: Sequence[BodyPose], moving: Sequence[Velocity]) -> float:
        """The height at which their centre of mass has as much at rest."""
        height_m = 0.0
        for share, radii2, pose, motion in zip(self._shares, self._radii2, at, moving, strict=True):
            height_m += share * energy_height_m(radii2, pose, motion)
        return height_m


def energy_height_m(radii2: Sequence[float], at: BodyPose, moving: Velocity) -> float:
    """The energy of a body over its weight, metres, from these squares [3] of its radii of inertia, metres squared."""
    (_, _, height), (x, y, z, w) = at
    (u, v, s), (p, q, r) = moving
    # The angular velocity along the body's axes
    along = (
        (1 - 2 * (y * y + z * z)) * p + 2 * (x * y + z * w) * q + 2 * (x * z - y * w) * r,
        2 * (x * y - z * w) * p + (1 - 2 * (x * x + z * z)) * q + 2 * (y * z + x * w) * r,
        2 * (x * z + y * w) * p + 2 * (y * z - x * w) * q + (1 - 2 * (x * x + y * y)) * r,
    )
    turning = radii2[0] * along[0] * along[0] + radii2[1] * along[1] * along[1] + radii2[2] * along[2] * along[2]
    return height + (u * u + v * v + s * s + turning) / (2 * GRAVITY_M_S2)


def leaves_outline(outline: Array, reach_m: float) -> StopCondition:
    """Stop when a body of this reach may extend beyond the edge of a convex outline [N, 2].

    Skips the edges while the body is nearer to the outline's middle than any edge, less the reach.
    """
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    x, y = middle.tolist()
    safe_m = float(inside_margin(middle[None, :], outline)[0]) - reach_m

    def leaves(_: int, at: BodyPose) -> bool:
        if math.hypot(at[0][0] - x, at[0][1] - y) < safe_m:
            return False
        return bool(inside_margin(np.array([at[0][:2]]), outline)[0] < reach_m)

    return leaves


def strays(middles: Array, far_m: float) -> StopCondition:
    """Stop when a centre of mass is further than this from its middle [3], or from the vertical line through it [2]."""
    at, axes = middles.tolist(), middles.shape[1]
    return lambda number, now: math.dist(now[0][:axes], at[number]) > far_m


def falls_below(height_m: float) -> StopCondition:
    """Stop when a centre of mass is below this height, world z."""
    return lambda _, at: at[0][2] < height_m


def stays_standing(start: ObjectStart, body: Body, top_m: float, friction: float) -> StandingCondition:
    """The condition of an object over a flat top at the height `top_m`, with this coefficient of friction.

    It has less energy than it takes to tip over the nearest edge of a steady face, and than friction takes up in `SLIDE_M`:
    m g h <= friction m g s. Energy may rise in the simulation, but not by more than `LIFT_M`.
    """
    radii2 = [float(moment) / body.mass_kg for moment in body.moments]
    T_body_obj = invert(body.T_obj_body)

    def stands(at: BodyPose, moving: Velocity) -> Face | None:
        energy_m = energy_height_m(radii2, at, moving)
        if energy_m - at[0][2] > friction * SLIDE_M:
            return None
        face = find_face(as_pose(at) @ T_body_obj, start.hull, start.asset.mass.com)
        if face is None:
            return None
        over_m = max(0.0, energy_m - top_m - face.height_m)
        return face if over_m + LIFT_M <= math.hypot(face.height_m, face.margin_m) - face.height_m else None

    return stands
