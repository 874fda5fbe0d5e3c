"""The release of a scene's objects in the simulator, with the effects that the plan runs."""

import dataclasses
import math
from dataclasses import dataclass

from schemas.job.physics import Physics
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart
from workers.geometry.frames import transform
from workers.physics.fall import Outcome, choose_steps, fall, free_fall_m
from workers.physics.placement import Ground
from workers.physics.rest_pose import stands_on_face
from workers.physics.rigid_body import build_body, choose_collision_shape
from workers.physics.stop_conditions import can_touch, falls_below, leaves_outline, leaves_room, tips_over

MANY = 4
"""Number of objects from which they fall as coarser convex parts: the time grows with the pairs of parts near one another."""

GROUP_TRAVEL = 40.0
"""Several objects may travel so many times further in a step, 2 mm. Where they come to rest is chaotic: its distribution
matters and not the path. At twice that corners sink into the walls of mugs, which are 2 to 3 mm thick."""


@dataclass(frozen=True, eq=False)
class Drop:
    """Objects to be released over a table, with the settings and the plan of effects.

    room_m: how far the centre of mass of a single object may go sideways.
    """

    starts: tuple[ObjectStart, ...]
    ground: Ground
    physics: Physics
    effects: EffectPlan
    room_m: float = math.inf

    @property
    def single(self) -> bool:
        """Whether there is one object."""
        return len(self.starts) == 1


def release(drop: Drop, flat: bool, damping: float = 0.0) -> Outcome:
    """Release the objects where they start, onto the table's flat top or its mesh, until they rest or must be stopped.

    Stopped by `edge` where a footprint may leave the flat top, `below` where an object falls below the mesh, and `room`
    where a single object leaves its room.
    """
    table, effects, physics = drop.ground.table, drop.effects, _settings(drop)
    starts = [choose_collision_shape(start, physics) for start in drop.starts]
    poses = [start.T_world_obj for start in starts]
    bodies = [build_body(start, physics, effects, damping, len(starts) >= MANY) for start in starts]
    hulls = [transform(T, start.hull.vertices) for T, start in zip(poses, starts, strict=True)]
    free_m = min(free_fall_m(points, table, flat) for points in hulls)
    # On a mesh a single object keeps the shortest travel per step, however far it falls.
    drop_m = max(float(points[:, 2].min()) for points in hulls) - table.top.height_m
    steps = choose_steps(starts, physics, effects, drop_m if flat or not drop.single else 0.0)
    ground = table.top.height_m if flat else table.mesh
    reach_m = max(body.reach_m for body in bodies)
    stops = {"below": falls_below(float(table.mesh.vertices[:, 2].min()) - reach_m)}
    if flat:
        stops = {"edge": leaves_outline(table.top.outline, reach_m)}
    T_world_body = poses[0] @ bodies[0].T_obj_body
    if math.isfinite(drop.room_m):
        stops["room"] = leaves_room(T_world_body[:2, 3], drop.room_m)
    parts, down = bodies[0].parts, -T_world_body[2, :3]
    if flat and drop.single and len(parts) == 1 and stands_on_face(parts[0], down):
        # An object on a level plane touches it with few vertices until it tips, and the time grows with their number. It
        # falls with these, and once more with all of them if it tips.
        reduced = dataclasses.replace(bodies[0], parts=(parts[0][can_touch(parts[0], down)],))
        outcome = fall([reduced], poses, ground, physics, steps, free_m, stops | {"tilt": tips_over(T_world_body)})
        if outcome.stopped_by != "tilt":
            return outcome
    return fall(bodies, poses, ground, physics, steps, free_m, stops)


def _settings(drop: Drop) -> Physics:
    """The settings with those of effects that do not run at zero; for several objects with longer travel per step.

    And with more solver iterations: the solver goes from contact to contact, and an iteration carries the less of a force the
    more the masses differ.
    """
    changes: dict[str, float] = {}
    if not drop.single:
        masses = [start.asset.mass.mass_kg for start in drop.starts]
        changes["solver_iterations"] = drop.physics.solver_iterations * math.ceil(math.sqrt(max(masses) / min(masses)))
        changes["max_step_travel_mm"] = drop.physics.max_step_travel_mm * GROUP_TRAVEL
    if not drop.effects.runs("restitution"):
        changes["restitution"] = 0.0
    if not drop.effects.runs("rolling_friction"):
        changes |= {"rolling_friction": 0.0, "spinning_friction": 0.0}
    return drop.physics.model_copy(update=changes)
