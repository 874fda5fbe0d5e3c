"""The release of a scene's objects in the simulator, with the effects that the plan runs."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from schemas.base import Array
from schemas.job.physics import Physics
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart, Table
from workers.geometry.frames import transform
from workers.physics.bullet import GroundShape
from workers.physics.fall import THIN_SHARE, Outcome, choose_steps, fall, free_fall_m
from workers.physics.placement import Ground
from workers.physics.rest_pose import stands_on_face
from workers.physics.rigid_body import build_body, choose_collision_shape
from workers.physics.stop_conditions import can_touch, falls_below, leaves_outline, leaves_room, tips_over

MANY = 4
"""Number of objects from which they fall as coarser convex parts: the time grows with the pairs of parts near one another."""

GROUP_TRAVEL = 40.0
"""Several objects may travel so many times further in a step, 2 mm. Where they come to rest is chaotic: its distribution
matters and not the path. At twice that corners sink into the walls of mugs, which are 2 to 3 mm thick."""

LEFT_M = 0.05
"""Depth of a centre of mass below the table's top at which the object has left the table."""

QUICK_RATE, QUICK_THIN = 0.5, 0.25
"""Steps and solver iterations of a quick drop as a share of others', and its travel in a step as one of the thinnest object.
All of 28 piles of eight that stayed on the table came to exact rest after it, and 30 of 35 with 0.25 and 0.5. What does not
falls once more, not quickly."""

PRISM_M = 0.5
"""Height of the body that stands for a flat top with its edges: nothing passes through it in a step. It spares the second drop,
onto the mesh, of the many that roll to an edge; a stack on it gains energy, four times the bound, and none on a slab."""


@dataclass(frozen=True, eq=False)
class Drop:
    """Objects to be released over a table, with the settings and the plan of effects.

    room_m: how far the centre of mass of a single object may go sideways; quick: in long steps, for many concave objects;
    exact: as parts that are not coarser where there are many.
    """

    starts: tuple[ObjectStart, ...]
    ground: Ground
    physics: Physics
    effects: EffectPlan
    room_m: float = math.inf
    quick: bool = False
    exact: bool = False

    @property
    def many(self) -> bool:
        """Whether there are many objects, some of them concave, so that coarse parts have to do."""
        return not self.exact and len(self.starts) >= MANY and self.effects.runs("decomposition")

    @property
    def single(self) -> bool:
        """Whether there is one object."""
        return len(self.starts) == 1


def release(drop: Drop, flat: bool) -> Outcome:
    """Release the objects where they start, onto the table's flat top or its mesh, until they rest or must be stopped.

    Stopped by `edge` where a footprint may leave the flat top, `below` where an object falls below the mesh, or among many
    below the top, and `room` where a single object leaves its room.
    """
    table, effects, physics = drop.ground.table, drop.effects, _settings(drop)
    starts = [choose_collision_shape(start, physics) for start in drop.starts]
    poses = [start.T_world_obj for start in starts]
    bodies = [build_body(start, physics, effects, drop.many) for start in starts]
    hulls = [transform(T, start.hull.vertices) for T, start in zip(poses, starts, strict=True)]
    free_m = min(free_fall_m(points, table, flat) for points in hulls)
    # On a mesh a single object keeps the shortest travel per step, however far it falls.
    drop_m = max(float(points[:, 2].min()) for points in hulls) - table.top.height_m
    thin = QUICK_THIN if drop.quick else THIN_SHARE
    steps = choose_steps(starts, physics, effects, drop_m if flat or not drop.single else 0.0, thin)
    reach_m = max(body.reach_m for body in bodies)
    lowest_m = table.top.height_m - LEFT_M if drop.many else float(table.mesh.vertices[:, 2].min())
    stops = {"below": falls_below(lowest_m - reach_m)}
    ground: GroundShape = table.mesh
    if flat and not drop.many:
        ground, stops = table.top.height_m, {"edge": leaves_outline(table.top.outline, reach_m)}
    elif flat:
        ground = _prism(table)
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


def _prism(table: Table) -> Array:
    """[2 N, 3]: corners of the body below a convex flat top."""
    outline, height_m = table.top.outline, table.top.height_m
    levels = (np.full((len(outline), 1), z) for z in (height_m, height_m - PRISM_M))
    return np.concatenate([np.hstack([outline, level]) for level in levels])


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
    if drop.quick:
        for name in ("step_hz", "solver_iterations"):
            changes[name] = max(1, round(QUICK_RATE * changes.get(name, getattr(drop.physics, name))))
    if not drop.effects.runs("restitution"):
        changes["restitution"] = 0.0
    if not drop.effects.runs("rolling_friction"):
        changes |= {"rolling_friction": 0.0, "spinning_friction": 0.0}
    return drop.physics.model_copy(update=changes)
