"""The physics step for objects without a drawn scene: by the effects that they call for, or by others."""

import dataclasses
from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, Ground, ObjectStart, ScenePlan, Settled, Table
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box, table
from workers.geometry.hull import convex_hull
from workers.physics.effects import called_for, called_for_with
from workers.physics.fall import FINEST
from workers.physics.hold import moved_by, release_again
from workers.physics.settle import RECHECK_S, settle_scene
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import draw_scene

PHYSICS = Job(name="t").physics


def start_at(asset: Asset, T_world_obj: Pose | None = None, region_id: int = 3, placed: bool = False) -> ObjectStart:
    """The object released there; its own frame is the world's where no pose is given."""
    T = frozen_array(np.eye(4) if T_world_obj is None else T_world_obj)
    return ObjectStart(asset, convex_hull(asset.shape.vertices), region_id, T, 0, placed)


@cache
def _drawn() -> ScenePlan:
    return draw_scene(Job(name="t"), SceneChance(0, 0), table(), asset_of(box(0.1, 0.1, 0.1)))


def scene_of(starts: Sequence[ObjectStart], on: Table) -> ScenePlan:
    """A scene of these objects over this table."""
    return dataclasses.replace(_drawn(), ground=Ground(on, _drawn().floor), objects=tuple(starts))


def effects_of(starts: Sequence[ObjectStart], on: Table, physics: Physics) -> EffectPlan:
    """The effects that the objects call for."""
    return EffectPlan(tuple(sorted(called_for(starts, on, physics))), {})


def settle_group(
    starts: Sequence[ObjectStart], on: Table, physics: Physics = PHYSICS, names: Iterable[str] | None = None
) -> tuple[Settled, ...]:
    """The objects at rest, with the effects of these names or else those that they call for. Raises SettleError."""
    effects = effects_of(starts, on, physics) if names is None else EffectPlan(tuple(names), {})
    return settle_scene(scene_of(starts, on), physics, effects).settled


def settle_single(
    start: ObjectStart, on: Table, physics: Physics = PHYSICS, names: Iterable[str] | None = None
) -> Settled:
    """The same of one object."""
    return settle_group((start,), on, physics, names)[0]


def recheck_group(
    starts: Sequence[ObjectStart], settled: Sequence[Settled], on: Table, physics: Physics, rate: float = FINEST
) -> list[tuple[float, float]]:
    """(mm that the farthest point moves, degrees that it turns) of every object, when all are released again.

    For `RECHECK_S`, on the ground that they came to rest on, in the finest steps or as `release_again` says.
    """
    effects = effects_of(starts, on, physics)
    if any(each.support == "mesh" for each in settled):
        effects = EffectPlan((*effects.ran, *called_for_with("table_mesh", starts, physics)), {})
    after = release_again(scene_of(starts, on), settled, physics, effects, RECHECK_S, rate)
    return [moved_by(one, rest.T_world_obj, T) for one, rest, T in zip(starts, settled, after, strict=True)]


def recheck(
    start: ObjectStart, settled: Settled, on: Table, physics: Physics, rate: float = FINEST
) -> tuple[float, float]:
    """The same of one object."""
    return recheck_group((start,), (settled,), on, physics, rate)[0]
