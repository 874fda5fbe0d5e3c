"""The settled state released once more under named effects: a stand-in until settling does this itself."""

import dataclasses

from schemas.base import Pose
from schemas.job import Physics
from schemas.scene import ScenePlan, Settled
from workers.scene.effect import EffectPlan
from workers.scene.settle import _simulate


def release_again(
    plan: ScenePlan, settled: tuple[Settled, ...], physics: Physics, effects: EffectPlan, seconds: float
) -> tuple[Pose, ...]:
    """Where every object [4, 4] is when the settled state was released for so long."""
    return tuple(
        _simulate(
            dataclasses.replace(start, T_world_obj=rest.T_world_obj, placed=False),
            plan.table,
            physics,
            seconds,
            flat=not effects.runs("table_mesh"),
        ).T_world_obj
        for start, rest in zip(plan.objects, settled, strict=True)
    )
