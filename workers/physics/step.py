"""From release to rest: the objects of a scene, one by one or together, and what becomes of them if they are let go again."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from schemas.base import Pose
from schemas.job.physics import Physics
from schemas.scene.effects import EffectPlan
from schemas.scene.scene import ObjectStart, ScenePlan, Settled, Table
from workers.geometry.frames import motion_between
from workers.physics.effects import called_for, on_mesh, rooms_m
from workers.physics.settle_group import release_together, settle_together
from workers.physics.settle_single import LeftRoomError, let_go, settle_alone, watching

RECHECK_S = 1.0
"""How long an object is watched when it is released again."""

LEFT_TOP = "a footprint left the table's flat top"
LEFT_ROOM = "an object left the room that it had to itself"


@dataclass(frozen=True, eq=False)
class Rest:
    """Every object of a scene at rest, and the effects that the plan had left out and that were called for after all."""

    settled: tuple[Settled, ...]
    called: Mapping[str, str] = field(default_factory=dict)


def settle_scene(plan: ScenePlan, physics: Physics, effects: EffectPlan) -> Rest:
    """Drop the scene's objects, wait until they rest, and remove what the simulator left of gap and tilt.

    Raises SettleError `not_at_rest`, `left_table`, `unsupported` or `table_too_fine`. The result is a function of the
    arguments alone: the world is made anew each time.
    """
    starts, table, called = plan.objects, plan.table, dict[str, str]()
    if len(starts) == 1:
        settled: tuple[Settled, ...] = (settle_alone(starts[0], table, physics, effects.ran),)
    elif effects.runs("object_contacts"):
        settled = settle_together(starts, table, physics, effects.ran)
    else:
        try:
            rooms = rooms_m(starts)
            settled = tuple(
                settle_alone(start, table, physics, effects.ran, room)
                for start, room in zip(starts, rooms, strict=True)
            )
        except LeftRoomError:
            called["object_contacts"] = LEFT_ROOM
            called |= {name: LEFT_ROOM for name in on_mesh(starts, physics) if name != "table_mesh"}
            settled = settle_together(starts, table, physics, (*effects.ran, *called))
    if any(rest.support == "mesh" for rest in settled):
        called |= dict.fromkeys(on_mesh(starts, physics), LEFT_TOP)
    return Rest(settled, {name: why for name, why in called.items() if not effects.runs(name)})


def recheck(start: ObjectStart, settled: Settled, table: Table, physics: Physics) -> tuple[float, float]:
    """How far the farthest point moves, mm, and the object turns, degrees, when it is released again where it rests.

    For `RECHECK_S`, in the finest steps, on the ground that it came to rest on. Nothing is corrected afterwards.
    """
    ran = called_for((start,), table, physics) | set(on_mesh((start,), physics) if settled.support == "mesh" else ())
    return moved_by(start, settled.T_world_obj, let_go(start, settled, table, physics, ran, RECHECK_S))


def recheck_scene(plan: ScenePlan, rest: Rest, physics: Physics, effects: EffectPlan) -> Rest:
    """The same, with how far every object moved and turned when all were released again."""
    called = EffectPlan((*effects.ran, *rest.called), effects.skipped)
    poses = release_again(plan, rest.settled, physics, called, RECHECK_S)
    settled = []
    for start, before, after in zip(plan.objects, rest.settled, poses, strict=True):
        moved, turned = moved_by(start, before.T_world_obj, after)
        settled.append(dataclasses.replace(before, recheck_move_mm=moved, recheck_turn_deg=turned))
    return dataclasses.replace(rest, settled=tuple(settled))


def release_again(
    plan: ScenePlan, settled: Sequence[Settled], physics: Physics, effects: EffectPlan, seconds: float
) -> tuple[Pose, ...]:
    """Where the objects are, `T_world_obj` [4, 4] each, that long after they were released where they rest.

    With the effects that the plan names, in the finest steps; nothing is corrected afterwards.
    """
    if len(plan.objects) > 1 and effects.runs("object_contacts"):
        flat = not effects.runs("table_mesh") and all(rest.support != "mesh" for rest in settled)
        poses = [rest.T_world_obj for rest in settled]
        return release_together(plan.objects, poses, plan.table, watching(physics, seconds), effects.ran, flat).poses
    return tuple(
        let_go(start, rest, plan.table, physics, effects.ran, seconds)
        for start, rest in zip(plan.objects, settled, strict=True)
    )


def moved_by(start: ObjectStart, before: Pose, after: Pose) -> tuple[float, float]:
    """Between two poses of an object: how far its farthest point went, mm, and by how much it turned, degrees."""
    moved_m, turned_rad = motion_between(start.hull.vertices, before, after)
    return moved_m * 1e3, math.degrees(turned_rad)
