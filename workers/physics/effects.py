"""The effects of physics: which of them the scene calls for, from its shapes and scales alone. Pure."""

import itertools
import math
from collections.abc import Callable, Sequence

import manifold3d
import numpy as np

from schemas.base import Array
from schemas.job.physics import Physics
from schemas.scene.plan import ObjectStart, Table
from schemas.scene.shape import Hull
from workers.geometry.frames import transform
from workers.geometry.manifold import hold_to_one_thread
from workers.physics.convex_parts.step import CONVEX_SHARE
from workers.physics.table_top import inside_margin

NEIGHBOUR_RAD = math.radians(30.0)
"""Planes of a hull whose normals are this near belong to one stretch of its surface."""

ROUND_SHARE = 0.03
"""A stretch on which the centre of mass is as high to within this share, over what it rests on, is round: a prism of 13
sides or more. The height over the faces of a box grows by a sixth within 10 degrees."""

SAME_PLANE_RAD = 0.02
"""Normals this near are of one plane: a hull's faces are triangles, known to rounding."""

CELL = 0.04
"""Of normals in one cell of this size one is looked at."""

LEAST_ROOM_M = 0.01
"""Objects whose rooms are narrower than this are simulated together at once."""

AT_REST = "placed in a statically stable pose"

Predicate = Callable[[Sequence[ObjectStart], Table, Physics], str | None]


def is_round(hull: Hull, com: Array) -> bool:
    """Whether the object may rest on a stretch of its hull over which it rolls.

    com [3], object frame. Where the object rests, its centre of mass is lower above the plane than above all neighbours;
    on a round stretch it is hardly lower than above some of them.
    """
    cells = np.round(hull.normals / CELL).astype(np.int64) @ np.array([10_000, 100, 1])
    normals = hull.normals[np.unique(cells, return_index=True)[1]]
    height = (hull.vertices @ normals.T).max(axis=0) - normals @ com
    cosine = normals @ normals.T
    near = (cosine > math.cos(NEIGHBOUR_RAD)) & (cosine < math.cos(SAME_PLANE_RAD))
    lowest = np.where(near, height, np.inf).min(axis=1)  # of the neighbours
    return bool(((height <= lowest) & (lowest <= height * (1.0 + ROUND_SHARE))).any())


def starts_over_top(start: ObjectStart, table: Table) -> bool:
    """Whether every point of the object is over the table's flat top, which is convex, when it is let go."""
    if not table.top.convex:
        return False
    points = transform(start.T_world_obj, start.hull.vertices)[:, :2]
    return bool(inside_margin(points, table.top.outline).min() > 0.0)


def is_convex(start: ObjectStart) -> bool:
    """Whether the object fills its hull; what encloses no body does not."""
    volume = start.asset.volume_m3
    if volume is None:
        return False
    hold_to_one_thread()
    hull = manifold3d.Manifold.hull_points(np.ascontiguousarray(start.hull.vertices))
    return volume >= CONVEX_SHARE * hull.volume()


def rooms_m(starts: Sequence[ObjectStart]) -> list[float]:
    """How far each object's centre of mass may go sideways without any two having to meet; negative where they may."""
    middles = [transform(start.T_world_obj, start.asset.mass.com[None, :])[0, :2] for start in starts]
    reaches = [float(np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max()) for start in starts]
    rooms = [math.inf] * len(starts)
    for i, j in itertools.combinations(range(len(starts)), 2):
        room = (float(np.linalg.norm(middles[i] - middles[j])) - reaches[i] - reaches[j]) / 2
        rooms[i], rooms[j] = min(rooms[i], room), min(rooms[j], room)
    return rooms


def _resting(predicate: Predicate) -> Predicate:
    """An effect of motion: not called for where nothing moves."""

    def skipped(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
        return AT_REST if all(start.placed for start in starts) else predicate(starts, table, physics)

    return skipped


def _always(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return None


def _over_top(starts: Sequence[ObjectStart], table: Table) -> bool:
    return all(starts_over_top(start, table) for start in starts)


def _table_mesh(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return "all starts over the table's convex flat top, and nothing left it" if _over_top(starts, table) else None


def _object_contacts(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    if len(starts) == 1:
        return "there is one object"
    return "no two objects came near one another" if min(rooms_m(starts)) > LEAST_ROOM_M else None


def _decomposition(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    if physics.collision in ("box", "hull"):
        return f"physics.collision is {physics.collision}"
    alone = _object_contacts(starts, table, physics) is not None
    if physics.collision == "planned" and alone and _over_top(starts, table):
        return "over a flat top an object touches with its hull alone"
    return "every object is convex" if all(is_convex(start) for start in starts) else None


def on_mesh(starts: Sequence[ObjectStart], physics: Physics) -> tuple[str, ...]:
    """Effects that are called for where a footprint left the flat top, or an object came where it may meet another."""
    parts = physics.collision not in ("box", "hull") and not all(is_convex(start) for start in starts)
    return ("table_mesh", "decomposition") if parts else ("table_mesh",)


def _rolling(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return None if any(is_round(start.hull, start.asset.mass.com) for start in starts) else "nothing here is round"


def _restitution(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    return "physics.restitution is 0" if physics.restitution == 0.0 else None


PREDICATES: dict[str, Predicate] = {
    "dynamics": _resting(_always),
    "table_mesh": _resting(_table_mesh),
    "object_contacts": _resting(_object_contacts),
    "decomposition": _resting(_decomposition),
    "fine_step": _resting(_always),
    "rolling_friction": _resting(_rolling),
    "restitution": _resting(_restitution),
}

COSTS: dict[str, str] = {
    "dynamics": "milliseconds a scene",
    "table_mesh": "the simulation takes several times as long",
    "object_contacts": "all objects are simulated at once, until the last rests",
    "decomposition": "seconds for a mesh from outside, a tenth for a built-in shape, and hundreds of parts for one hull",
    "fine_step": "up to 16 times as many steps while things move fast",
    "rolling_friction": "three rows more for each pair in contact",
    "restitution": "the fall is simulated for longer",
}
"""What each costs where it runs."""


def called_for(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> frozenset[str]:
    """Names of the effects of physics that these objects call for."""
    return frozenset(name for name, skipped in PREDICATES.items() if skipped(starts, table, physics) is None)
