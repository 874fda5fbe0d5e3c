"""When a simulation with less than the whole world in it is no longer the right one. Pure."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from workers.physics.table_top import inside_margin

Motion = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position, metres, and quaternion (x, y, z, w) of a body frame, which lies in the centre of mass."""

Watch = Callable[[Motion], bool]
"""Tells of a pose whether the simulation that came to it is to be dropped."""

TIPPED_RAD = 0.2
"""An object that was dropped onto a face and leans further than this is tipping over."""

TOUCH_RAD = 0.35
"""Vertices are kept that can touch a plane at this lean: an object that passes `TIPPED_RAD` between two looks at it, 8
ms apart, does not get here, which would take 18 rad/s."""

SAME_PLANE_M = 1e-6
"""Vertices this near the lowest one lie in one level face with it."""

PROBES = 32
"""How many of the lowest vertices the others are held against: more find no more that can be left out."""


def watch_edge(outline: Array, reach: float) -> Watch:
    """Whether something within `reach` metres of the body may be beyond the edge of a convex outline [N, 2].

    Where even the edge that is nearest to the outline's middle is further from there than the body and `reach` together,
    no edge has to be looked at.
    """
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    x, y = middle.tolist()
    safe = float(inside_margin(middle[None, :], outline)[0]) - reach

    def leaves(motion: Motion) -> bool:
        at = motion[0]
        if math.hypot(at[0] - x, at[1] - y) < safe:
            return False
        return bool(inside_margin(np.array([at[:2]]), outline)[0] < reach)

    return leaves


def watch_room(middle: Array, room_m: float) -> Watch:
    """Whether a body's centre of mass is further than `room_m` from the vertical line through `middle` [2]."""
    x, y = float(middle[0]), float(middle[1])

    def strays(motion: Motion) -> bool:
        return math.hypot(motion[0][0] - x, motion[0][1] - y) > room_m

    return strays


def watch_gone(below_m: float) -> Watch:
    """Whether a body's centre of mass is lower than `below_m`, world z: below everything that it could land on."""

    def gone(motion: Motion) -> bool:
        return motion[0][2] < below_m

    return gone


def watch_tilt(T_world_body: Pose) -> Watch:
    """Whether the body leans by more than `TIPPED_RAD` from how it began."""
    a, b, c = T_world_body[2, :3].tolist()
    limit = math.cos(TIPPED_RAD)

    def tips(motion: Motion) -> bool:
        x, y, z, w = motion[1]
        return 2 * (x * z - y * w) * a + 2 * (y * z + x * w) * b + (1 - 2 * (x * x + y * y)) * c < limit

    return tips


def stands_on_face(vertices: Array, down: Array) -> bool:
    """Whether at least three vertices [N, 3] are lowest in the unit direction `down` [3]."""
    depth = vertices @ down
    return bool(np.count_nonzero(depth >= depth.max() - SAME_PLANE_M) >= 3)


def can_touch(vertices: Array, down: Array) -> NDArray[np.bool_]:
    """[N] bool: which vertices of a convex body can be its lowest while `down` turns by at most `TOUCH_RAD` in it.

    None is left out that can. Vertex v is lowest in direction d if d . (v - u) >= 0 for every other vertex u; with d
    within an angle t of `down`, that needs the line from u up to v to climb by at most t.
    """
    depth = vertices @ down
    probes = vertices[np.argsort(-depth, kind="stable")[:PROBES]]
    line = vertices[:, None, :] - probes
    climb = -(line @ down)
    return (climb <= math.sin(TOUCH_RAD) * np.linalg.norm(line, axis=2) + SAME_PLANE_M).all(axis=1)
