"""Conditions that end a simulation early. Pure."""

import math
from collections.abc import Callable

import numpy as np

from schemas.base import Array
from workers.physics.rigid_body import BodyPose
from workers.physics.table_top import inside_margin

StopCondition = Callable[[BodyPose], bool]
"""Whether the pose of a body ends the simulation."""


def leaves_outline(outline: Array, reach_m: float) -> StopCondition:
    """Stop when a body of this reach may extend beyond the edge of a convex outline [N, 2].

    Skips the edges while the body is nearer to the outline's middle than any edge, less the reach.
    """
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    x, y = middle.tolist()
    safe_m = float(inside_margin(middle[None, :], outline)[0]) - reach_m

    def leaves(at: BodyPose) -> bool:
        if math.hypot(at[0][0] - x, at[0][1] - y) < safe_m:
            return False
        return bool(inside_margin(np.array([at[0][:2]]), outline)[0] < reach_m)

    return leaves


def leaves_room(middle: Array, room_m: float) -> StopCondition:
    """Stop when a centre of mass is further than `room_m` from the vertical line through `middle` [2]."""
    x, y = float(middle[0]), float(middle[1])
    return lambda at: math.hypot(at[0][0] - x, at[0][1] - y) > room_m


def falls_below(height_m: float) -> StopCondition:
    """Stop when a centre of mass is below this height, world z."""
    return lambda at: at[0][2] < height_m
