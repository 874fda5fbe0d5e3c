"""Conditions that end a simulation early: what fell off, and what stands, so that nothing is left to simulate. Pure."""

import math
from collections.abc import Callable

import numpy as np

from schemas.base import Array
from schemas.scene.plan import ObjectStart
from workers.geometry.frames import invert
from workers.physics.energy import LIFT_M, Velocity, energy_height_m
from workers.physics.rest_pose import find_face
from workers.physics.rigid_body import Body, BodyPose, as_pose
from workers.physics.table_top import inside_margin

SLIDE_M = 1e-7
"""Distance that an object may still slide. Bullet's own steps at rest move it by as much."""

StopCondition = Callable[[int, BodyPose], bool]
"""Whether a body, by its number, at this pose ends the simulation."""

StandingCondition = Callable[[BodyPose, Velocity], bool]
"""Whether a body at this pose and velocity stays on the face below it."""


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


def leaves_room(middle: Array, room_m: float) -> StopCondition:
    """Stop when a centre of mass is further than `room_m` from the vertical line through `middle` [2]."""
    x, y = float(middle[0]), float(middle[1])
    return lambda _, at: math.hypot(at[0][0] - x, at[0][1] - y) > room_m


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

    def stands(at: BodyPose, moving: Velocity) -> bool:
        energy_m = energy_height_m(radii2, at, moving)
        moving_m = energy_m - at[0][2]
        if moving_m > friction * SLIDE_M:
            return False
        face = find_face(as_pose(at) @ T_body_obj, start.hull, start.asset.mass.com)
        if face is None:
            return False
        over_m = max(0.0, energy_m - top_m - face.height_m)
        return over_m + LIFT_M <= math.hypot(face.height_m, face.margin_m) - face.height_m

    return stands
