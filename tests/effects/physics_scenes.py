"""Scenes for effects of physics: objects and a table in a drawn scene's place, settled with effects left out or forced."""

import dataclasses
from collections.abc import Sequence
from functools import cache

from schemas.base import Pose
from schemas.scene.scene import EffectPlan, Ground, ScenePlan, Settled
from services.read.audit import MOST_DEG, MOST_MM
from tests.effects.scenes import Setting, facts_of
from tests.hard_cases.drops import Drop
from workers.physics.fall import Outcome, StepSizes, Watch, fall
from workers.physics.hold import moved_by, release_again
from workers.physics.release import falls_below
from workers.physics.rigid_body import make_body
from workers.physics.settle import Rest, settle_scene
from workers.scene.effects import Facts, plan_effects

RELEASE_S = 1.0


@cache
def _drawn() -> Facts:
    return facts_of(Setting({}))


def facts_with(*cases: Drop) -> Facts:
    """A scene of the default physics with these objects, on the first one's table."""
    objects = tuple(dataclasses.replace(case.start, region_id=3 + k) for k, case in enumerate(cases))
    ground = Ground(cases[0].table, _drawn().plan.floor)
    plan: ScenePlan = dataclasses.replace(_drawn().plan, objects=objects, ground=ground)
    return dataclasses.replace(_drawn(), plan=plan)


def settled(facts: Facts, effects: EffectPlan | None = None) -> Rest:
    """The scene at rest, by its own plan or another. Raises SettleError."""
    return settle_scene(facts.plan, facts.job.physics, plan_effects(facts) if effects is None else effects)


def moved_when_forced(facts: Facts, *names: str) -> tuple[float, float]:
    """(mm, degrees) that the most any object of the scene, settled by its plan, moves and turns with effects forced."""
    rest, forced = settled(facts), plan_effects(facts, frozenset(names))
    return moved_under(facts, rest.settled, EffectPlan((*forced.ran, *rest.called), forced.skipped))


def moved_from(facts: Facts, poses: Sequence[Pose], effects: EffectPlan) -> tuple[float, float]:
    """The same from poses that nothing came to rest in."""
    rests = [Settled(T, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, "flat_top") for T in poses]
    return moved_under(facts, rests, effects)


def moved_under(facts: Facts, rests: Sequence[Settled], effects: EffectPlan) -> tuple[float, float]:
    """Released where they rest for `RELEASE_S` under these effects."""
    poses = release_again(facts.plan, rests, facts.job.physics, effects, RELEASE_S)
    moved = [
        moved_by(start, before.T_world_obj, after)
        for start, before, after in zip(facts.plan.objects, rests, poses, strict=True)
    ]
    return max(mm for mm, _ in moved), max(degrees for _, degrees in moved)


def is_still(moved: tuple[float, float]) -> bool:
    """Whether a motion (mm, degrees) is within what an approximation may change."""
    return moved[0] <= MOST_MM and moved[1] <= MOST_DEG


def drop_on(case: Drop, slab: bool) -> Outcome:
    """The object dropped by the simulator alone, as its hull, onto a level without end or onto the table's mesh.

    For 3 s, or until it is 0.2 m below the top.
    """
    physics = _drawn().job.physics.model_copy(update={"max_settle_s": 3.0})
    ground = case.table.top.height_m if slab else case.table.mesh
    steps = StepSizes(physics.step_hz, physics.max_step_travel_mm / 1e3)
    stops = {"below": falls_below(case.table.top.height_m - 0.2)}
    return fall([make_body(case.start)], [case.start.T_world_obj], ground, physics, steps, 0.0, Watch(stops))
