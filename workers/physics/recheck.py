"""A second release of objects that rest, as a check: whether they stay."""

import dataclasses
import math
from collections.abc import Sequence

from schemas.base import Pose
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart, ScenePlan, Settled
from workers.geometry.frames import motion_between
from workers.physics.fall import FINEST
from workers.physics.placement import forms_of, place
from workers.physics.release import Drop, let_go
from workers.physics.settle import Rest, add_effects

RECHECK_S = 1.0
"""Simulated time of the second release."""

RECHECK_RATE = 4.0
"""Steps a second of the second release, in the settings', of a single object on level ground: a quarter of the finest. Nothing
slips slowly there. At rest, tilted and lifted, both rates refuse the same (docs/rest.md), this one in 0.31 of the time."""


def recheck_scene(
    plan: ScenePlan, rest: Rest, physics: Physics, effects: EffectPlan, level_rate: float = RECHECK_RATE
) -> Rest:
    """The same rest, with the motion of every object after a second release of all. level_rate: as of `release_again`."""
    effects, plan = add_effects(effects, rest.called), dataclasses.replace(plan, objects=rest.starts)
    poses = release_again(plan, rest.settled, physics, effects, RECHECK_S, level_rate)
    settled = []
    for start, before, after in zip(rest.starts, rest.settled, poses, strict=True):
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
