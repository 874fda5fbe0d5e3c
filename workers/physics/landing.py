"""The landing in closed form: of objects that fall straight down onto faces and stand there. Pure."""

import itertools
import math
from collections.abc import Sequence

from schemas.base import Pose
from schemas.scene.scene import ObjectStart, Table
from workers.geometry.frames import translation
from workers.physics.bullet import GRAVITY_M_S2
from workers.physics.placement import TOUCHING_M, Form, Placement, farthest_m, place, placed_mesh
from workers.physics.pour import points_of
from workers.physics.release import Drop, hold
from workers.physics.support import columns_apart, stands_on_face, vertical_gap


def land(drop: Drop, flat: bool, forms: Sequence[Form]) -> tuple[Placement, tuple[Pose, ...], float] | None:
    """Objects that stand where they first touch the table: placed, at `T_world_obj` [4, 4] of each, after so many seconds.

    None where one goes on. What then stands has come to rest: an impact without a rebound takes all speed where contacts all
    about the centre of mass take it at once, on a face (Stronge 2000, "Impact Mechanics"). A simulator, which finds them one by
    one, would turn and push it by millimetres; but a single hull on the flat top it lands within 2 micrometres, and that is not
    asked for here.
    """
    effects = drop.effects
    if effects.runs("restitution") or (flat and drop.single and not effects.runs("decomposition")):
        return None
    fallen = _fall_straight(drop.starts, drop.table)
    if fallen is None or fallen[1] > drop.physics.max_settle_s:
        return None
    poses, seconds = fallen
    placement = place(drop.starts, poses, forms, drop.table, drop.physics.friction**2)
    rested = hold(drop, placement, poses)
    stands = rested.still and farthest_m(drop.starts, poses, rested.poses) <= TOUCHING_M
    return (placement, rested.poses, seconds) if stands else None


def _fall_straight(starts: Sequence[ObjectStart], table: Table) -> tuple[tuple[Pose, ...], float] | None:
    """(poses [4, 4] where objects first touch the table, seconds of the longest fall), all straight down.

    None where one does not come down on a face of its hull, or not in a column of its own.
    """
    if not all(stands_on_face(start.hull.vertices, -start.T_world_obj[2, :3]) for start in starts):
        return None
    if not all(columns_apart(points_of(a), points_of(b)) for a, b in itertools.combinations(starts, 2)):
        return None
    falls_m = [vertical_gap(placed_mesh(start, start.T_world_obj), table.mesh) for start in starts]
    if not 0.0 <= min(falls_m) <= max(falls_m) < math.inf:
        return None
    poses = tuple(translation(0.0, 0.0, -m) @ start.T_world_obj for start, m in zip(starts, falls_m, strict=True))
    return poses, math.sqrt(2.0 * max(falls_m) / GRAVITY_M_S2)
