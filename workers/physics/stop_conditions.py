"""Conditions that end a simulation early, and the vertices that a tipping body can touch ground with. Pure."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from workers.physics.rest_pose import SAME_PLANE_M, TIPPED_RAD
from workers.physics.rigid_body import BodyPose
from workers.physics.table_top import inside_margin

StopCondition = Callable[[BodyPose], bool]
"""Whether the pose of a body ends the simulation."""

TOUCH_RAD = 0.35
"""Vertices are kept that can touch a plane at this lean. A body past `TIPPED_RAD` is found within 8 ms; to lean this far by
then it would have to turn at 18 rad/s."""

PROBES = 32
"""Number of lowest vertices that the others are compared with. More probes exclude no more vertices."""


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


def tips_over(T_world_body: Pose) -> StopCondition:
    """Stop when the body leans by more than `TIPPED_RAD` from this pose."""
    a, b, c = T_world_body[2, :3].tolist()
    limit = math.cos(TIPPED_RAD)

    def tips(at: BodyPose) -> bool:
        x, y, z, w = at[1]
        return 2 * (x * z - y * w) * a + 2 * (y * z + x * w) * b + (1 - 2 * (x * x + y * y)) * c < limit

    return tips


def can_touch(vertices: Array, down: Array) -> NDArray[np.bool_]:
    """[N] bool: the vertices of a convex body that can be its lowest while `down` turns by at most `TOUCH_RAD` in it.

    Conservative. Vertex v is lowest in direction d if d . (v - u) >= 0 for every other vertex u. With d within an angle t
    of `down`, the line from u up to v must climb by at most t.
    """
    depth = vertices @ down
    probes = vertices[np.argsort(-depth, kind="stable")[:PROBES]]
    line = vertices[:, None, :] - probes
    climb = -(line @ down)
    return (climb <= math.sin(TOUCH_RAD) * np.linalg.norm(line, axis=2) + SAME_PLANE_M).all(axis=1)
