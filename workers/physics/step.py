"""The physics step: objects from release to rest, and their second release as a check."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from schemas.base import Pose
from schemas.job.physics import Physics
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ObjectStart, ScenePlan
from schemas.scene.scene import Settled
from workers.geometry.frames import motion_between
from workers.physics.effects import called_for_with, rooms_m
from workers.physics.fall import FINEST
from workers.physics.hold import let_go
from workers.physics.placement import forms_of, place
from workers.physics.release import Drop
from workers.physics.settle import LeftRoomError, add_effects, settle

RECHECK_S = 1.0
"""Simulated time of the second release."""

RECHECK_RATE = 4.0
"""Steps a second of the second release, in the settings', of a single object on level ground: a quarter of the finest. Nothing
slips slowly there. At rest, tilted and lifted, both rates refuse the same (docs/rest.md), this one in 0.31 of the time."""

LEFT_TOP, LEFT_ROOM = "a footprint left the table's flat top", "an object left the room that it had to itself"


@dataclass(frozen=True, eq=False)
class Rest:
    """Every object of a scene at rest, and the reasons why effects that the plan had skipped ran after all."""

    settled: tuple[Settled, ...]
    called: Mapping[str, str] = field(default_factory=dict)


def settle_scene(plan: ScenePlan, physics: Physics, effects: EffectPlan) -> Rest:
    """Drop the scene's objects, wait until they rest, and correct the simulator's gap and tilt of single ones.

    Objects that cannot meet settle one by one. Raises SettleError `objects_overlap`, `not_at_rest`, `left_table`,
    `unsupported` or `table_too_fine`. A pure function: every simulation starts from an empty world.
    """
    starts, table, called = plan.objects, plan.table, dict[str, str]()
    if len(starts) > 1 and effects.runs("object_contacts"):
        settled = settle(Drop(starts, table, physics, effects))
    else:
        try:
            rooms = zip(starts, rooms_m(starts), strict=True)
            settled = tuple(settle(Drop((start,), table, physics, effects, room_m))[0] for start, room_m in rooms)
        except LeftRoomError:
            called = dict.fromkeys(called_for_with("object_contacts", starts, physics), LEFT_ROOM)
            settled = settle(Drop(starts, table, physics, add_effects(effects, called)))
    if any(rest.support == "mesh" for rest in settled):
        called |= dict.fromkeys(called_for_with("table_mesh", starts, physics), LEFT_TOP)
    return Rest(settled, {name: why for name, why in called.items() if not effects.runs(name)})


def recheck_scene(
    plan: ScenePlan, rest: Rest, physics: Physics, effects: EffectPlan, level_rate: float = RECHECK_RATE
) -> Rest:
    """The same rest, with the motion of every object after a second release of all. level_rate: as of `release_again`."""
    effects = add_effects(effects, rest.called)
    poses = release_again(plan, rest.settled, physics, effects, RECHECK_S, level_rate)
    settled = []
    for start, before, after in zip(plan.objects, rest.settled, poses, strict=True):
        moved_mm, turned_deg = moved_by(start, before.T_world_obj, after)
        settled.append(dataclasses.replace(before, recheck_move_mm=moved_mm, recheck_turn_deg=turned_deg))
    return dataclasses.replace(rest, settled=tuple(settled))


def release_again(
    plan: ScenePlan,
    settled: Sequence[Settled],
    physics: Physics,
    effects: EffectPlan,
    seconds: float,
    level_rate: float = FINEST,
) -> tuple[Pose, ...]:
    """`T_world_obj` [4, 4] of every object this long after its release from where it rests, or once one moved by `hold.FAR_M`.

    With the effects of the plan, without correction. Nothing counts as resting before the end. In the finest steps, and a single
    object on level ground in `level_rate` times as many a second as the settings say.
    """
    rest = physics.rest.model_copy(update={"window_s": 2.0 * seconds})
    physics = physics.model_copy(update={"max_settle_s": seconds, "rest": rest})
    starts, poses = plan.objects, [each.T_world_obj for each in settled]
    placement = place(starts, poses, forms_of(starts), plan.table, physics.friction**2)
    return let_go(Drop(starts, plan.table, physics, effects), placement, poses, level_rate=level_rate)


def moved_by(start: ObjectStart, before: Pose, after: Pose) -> tuple[float, float]:
    """(mm that the farthest point of an object moves between two poses, degrees that it turns)."""
    moved_m, turned_rad = motion_between(start.hull.vertices, before, after)
    return moved_m * 1e3, math.degrees(turned_rad)
