"""The effects of physics, and the predicates that decide from shapes and scales which of them a scene needs. Pure."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from schemas.base import Array
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.shape import Hull
from workers.geometry.frames import transform
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.mesh import fills_hull, is_first
from workers.physics.support import inside_margin

NEIGHBOUR_RAD = math.radians(30.0)
"""Greatest angle between normals of a hull that belong to one stretch of its surface."""

ROUND_SHARE = 0.03
"""A stretch is round if the height of the centre of mass over it varies by less than this share: a prism of 13 sides or more.
The height over the faces of a box grows by a sixth within 10 degrees."""

TURN_RAD, RISE_SHARE = math.radians(61.0), 0.16
"""The same of what begins tilted: a nut tips from one of its six sides to the next, over an edge that is 15 % higher."""

TILTED_RAD = math.radians(1.0)
"""What begins with a face of its hull closer to level than this is set down on it, and does not tip onto others."""

SAME_PLANE_RAD = 0.02
"""Greatest angle between normals of one plane: a hull's faces are triangles, known to rounding."""

CELL = 0.04
"""Size of the cells of normals, of which one normal each is kept."""

LEAST_ROOM_M = 0.01
"""Objects with less room than this are simulated together."""

AT_REST = "placed in a statically stable pose; proof: the forces at its contacts balance its weight"

Predicate = Callable[[Sequence[ObjectStart], Table, Physics], str | None]


def is_round(hull: Hull, com: Array, turn_rad: float = NEIGHBOUR_RAD, rise: float = ROUND_SHARE) -> bool:
    """Whether the object may rest on a stretch of its hull over which it rolls; com [3], object frame.

    At rest the centre of mass is lower over the plane than over all its neighbours, which are at most `turn_rad` on, and on a
    round stretch lower than over some of them by at most the share `rise`.
    """
    normals = hull.normals[is_first(np.rint(hull.normals / CELL).astype(np.int64))]
    return _rests_on_round(hull.vertices, normals, com, math.cos(turn_rad), math.cos(SAME_PLANE_RAD), rise)


def rolls(start: ObjectStart) -> bool:
    """Whether an object rolls as it comes to rest: it is round, or begins tilted and tips easily from side to side."""
    hull, com = start.hull, start.asset.mass.com
    if is_round(hull, com):
        return True
    down = -start.T_world_obj[2, :3]
    return bool((hull.normals @ down).max() < math.cos(TILTED_RAD)) and is_round(hull, com, TURN_RAD, RISE_SHARE)


@compiled_for("const(f8[:,::1]), f8[:,::1], const(f8[::1]), f8, f8, f8")
def _rests_on_round(points: Array, normals: Array, com: Array, far: float, near: float, rise: float) -> bool:
    """Whether com [3] is at most as high over a normal's plane as over its neighbours', and over one higher by `rise` at most.

    points [V, 3] and normals [N, 3] of the hull. Most normals have a lower neighbour, and one that has none ends the search:
    few heights are ever asked for.
    """
    heights = np.full(len(normals), np.nan)
    for i in range(len(normals)):
        here, lowest = _height(points, normals, com, i, heights), np.inf
        for j in range(len(normals)):
            cosine = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
            if far < cosine < near:
                lowest = min(lowest, _height(points, normals, com, j, heights))
                if lowest < here:
                    break
        if here <= lowest <= here * (1.0 + rise):
            return True
    return False


@compiled
def _height(points: Array, normals: Array, com: Array, i: int, heights: Array) -> float:
    """How far points reach beyond com [3] along normal i; kept in heights [N], where nan is not known yet."""
    if np.isnan(heights[i]):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        farthest = -np.inf
        for n in range(len(points)):
            farthest = max(farthest, points[n, 0] * x + points[n, 1] * y + points[n, 2] * z)
        heights[i] = farthest - (com[0] * x + com[1] * y + com[2] * z)
    return heights[i]


def starts_over_top(start: ObjectStart, table: Table) -> bool:
    """Whether the whole object is released over the table's top, and the top is flat and convex."""
    if not table.top.convex:
        return False
    points = transform(start.T_world_obj, start.hull.vertices)[:, :2]
    return bool(inside_margin(points, table.top.outline).min() > 0.0)


def is_convex(start: ObjectStart) -> bool:
    """Whether the object fills its hull; a mesh that encloses no body does not."""
    volume = start.asset.volume_m3
    return volume is not None and fills_hull(volume, start.hull.vertices)


def rooms_m(starts: Sequence[ObjectStart]) -> list[float]:
    """Metres that each centre of mass may go sideways before any two objects can meet; negative where they already can."""
    middles = [transform(start.T_world_obj, start.asset.mass.com[None, :])[0, :2] for start in starts]
    reaches = [float(np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max()) for start in starts]
    rooms = [math.inf] * len(starts)
    for i, j in itertools.combinations(range(len(starts)), 2):
        room = (float(np.linalg.norm(middles[i] - middles[j])) - reaches[i] - reaches[j]) / 2
        rooms[i], rooms[j] = min(rooms[i], room), min(rooms[j], room)
    return rooms


def _resting(predicate: Predicate) -> Predicate:
    """The predicate of an effect of motion, which is skipped where nothing moves."""

    def skipped(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
        return AT_REST if all(start.placed for start in starts) else predicate(starts, table, physics)

    return skipped


def _table_mesh(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    if not all(starts_over_top(start, table) for start in starts):
        return None
    return (
        "all starts over the table's convex flat top, and nothing left it; proof: each was watched, and over the top it "
        "touches the top alone"
    )


def _object_contacts(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    if len(starts) == 1:
        return "there is one object; proof: nothing else is there to meet"
    apart = "no two objects came near one another; proof: each was watched, and stayed in a room of its own"
    return apart if min(rooms_m(starts)) > LEAST_ROOM_M else None


def _decomposition(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    apart = _object_contacts(starts, table, physics) is not None
    if physics.collision == "planned" and apart and _table_mesh(starts, table, physics) is not None:
        return "over a flat top an object touches with its hull alone; proof: geometry, its parts reach no lower"
    return _parts_needless(starts, physics)


def _parts_needless(starts: Sequence[ObjectStart], physics: Physics) -> str | None:
    """The reason why objects fall whole wherever they touch; None where one needs convex parts."""
    if physics.collision in ("box", "hull"):
        return f"physics.collision is {physics.collision}"
    return "every object is convex; proof: geometry, each is its own hull" if all(map(is_convex, starts)) else None


def called_for_with(name: str, starts: Sequence[ObjectStart], physics: Physics) -> tuple[str, ...]:
    """`table_mesh` or `object_contacts`, needed after all, with `decomposition` where objects then need convex parts."""
    return (name,) if _parts_needless(starts, physics) else (name, "decomposition")


def _rolling(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> str | None:
    stated = physics.rolling_friction, physics.spinning_friction
    if not any(stated):
        return "physics.rolling_friction and physics.spinning_friction are 0"
    if stated != _USUAL_ROLLING:  # asked for
        return None
    flat = "nothing here is round; proof: measured, drops with it and without it end alike (docs/measured.md)"
    return None if any(rolls(start) for start in starts) else flat


_USUAL_ROLLING = (Physics().rolling_friction, Physics().spinning_friction)


PREDICATES: dict[str, Predicate] = {
    "dynamics": _resting(lambda *_: None),
    "table_mesh": _resting(_table_mesh),
    "object_contacts": _resting(_object_contacts),
    "decomposition": _resting(_decomposition),
    "fine_step": _resting(lambda *_: None),
    "rolling_friction": _resting(_rolling),
    "restitution": _resting(lambda *given: None if given[2].restitution else "physics.restitution is 0"),
}


REMOVED, SPIN_LEFT = "lost_removed", "spin_left"

ONLY_LATE: dict[str, str] = {
    REMOVED: "an object left the table's top or found no balance",
    SPIN_LEFT: "an object spun on where it stood, and nothing slows that: its turn is the one at physics.max_settle_s",
}
"""Effects that are in no plan, and in the receipt only where they ran, and why each does."""


def called_for(starts: Sequence[ObjectStart], table: Table, physics: Physics) -> frozenset[str]:
    """The names of the effects of physics that these objects need."""
    return frozenset(name for name, skipped in PREDICATES.items() if skipped(starts, table, physics) is None)
