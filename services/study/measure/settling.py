"""Errors of settling: rest against finer steps than any that is measured, and the order of convergence of the integrator.

- Order of convergence of the integrator, on two smooth cases with a closed-form answer.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ScenePlan
from services.study.knobs import apply
from services.study.model import Setting
from workers.geometry.frames import motion_between, transform
from workers.physics.bullet import GRAVITY_M_S2, World, open_world
from workers.physics.fall import FINEST
from workers.physics.rigid_body import Body
from workers.physics.settle import Rest, moved_by, recheck_scene, settle_scene
from workers.scene.context import WorkerContext
from workers.scene.effects import Facts, plan_effects
from workers.scene.plan import SceneChance, plan_scene

RATES_HZ = (3840, 7680, 15360)
"""An order shows in the limit: in longer steps a sliding block loses contacts for single steps, and stops a little later."""

FALL_S = 0.5
SLIDE_M_S = 1.0
FRICTION = 0.6

_MARGIN_M = 1e-4
_SIDES_M = (0.2, 0.2, 0.01)
_HEIGHT_M = 3.0


def slopes() -> dict[str, float]:
    """Order in the step of each case, by least squares of log error over log step.

    Semi-implicit Euler, which is what Bullet integrates with, is of the first order (Hairer, Lubich and Wanner 2006, I.1).
    """
    found = {}
    for name, error in (("free fall", _fall_error_m), ("sliding to rest", _slide_error_m)):
        errors = [abs(error(rate)) for rate in RATES_HZ]
        found[name] = float(np.polyfit(-np.log(RATES_HZ), np.log(errors), 1)[0])
    return found


def _block() -> Body:
    x, y, z = _SIDES_M
    corners = np.array(list(itertools.product((-x, x), (-y, y), (-z, z)))) / 2
    return Body(1.0, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 12, (corners,), _MARGIN_M)


@contextmanager
def _world_of(height_m: float, rate_hz: int) -> Iterator[World]:
    """A world with a block at a height."""
    physics = Job(name="convergence").physics.model_copy(update={"step_hz": rate_hz, "friction": math.sqrt(FRICTION)})
    T = np.eye(4)
    T[2, 3] = height_m
    with open_world([(_block(), T)], 0.0, physics, 1) as world:
        yield world


def _fall_error_m(rate_hz: int) -> float:
    """Error of a free fall against half g t squared."""
    with _world_of(_HEIGHT_M, rate_hz) as world:
        _advance(world, round(FALL_S * rate_hz))
        return float(_HEIGHT_M - world.pose()[0][2] - GRAVITY_M_S2 * FALL_S**2 / 2)


def _slide_error_m(rate_hz: int) -> float:
    """Error of a sliding distance against v squared / 2 mu g (Coulomb friction); the block first settles for a second."""
    with _world_of(_SIDES_M[2] / 2 + _MARGIN_M, rate_hz) as world:
        _advance(world, rate_hz)
        before = world.pose()[0][0]
        world.set_velocity((SLIDE_M_S, 0.0, 0.0))
        _advance(world, rate_hz)
        return float(world.pose()[0][0] - before - SLIDE_M_S**2 / (2.0 * FRICTION * GRAVITY_M_S2))


def _advance(world: World, steps: int) -> None:
    for _ in range(steps):
        world.advance()


AGREE_MM = 0.05
"""Two references agree where their poses are nearer than this; only then is there a true pose."""

REFERENCES: tuple[Mapping[str, Any], ...] = (
    {"step_hz": 3840, "max_step_travel_mm": 0.03, "solver_iterations": 400},
    {"step_hz": 7680, "max_step_travel_mm": 0.015, "solver_iterations": 400},
)
"""Settings of physics finer than every measured value. The first gives the distribution of outcomes; a pose has a truth where
both agree."""

RELEASED: Mapping[str, Any] = {"step_hz": 960, "max_step_travel_mm": 0.05, "solver_iterations": 400}
"""Settings of physics, in steps 16 times shorter, with which objects at rest are released again."""

Answer = dict[str, Any]


def measure_settling(
    context: WorkerContext, settings: Sequence[Setting], scene_id: int, posed: bool, released: bool
) -> dict[str, Answer]:
    """Figures of one scene by the settings' names, and of the reference under "reference".

    Each has `failed`, or else penetration_mm, gap_mm and unbalanced_share, slid_mm and rolled_deg (sideways travel of the
    centre of mass, and turn, since the object was released; the largest of several objects). With `posed` also pose_mm,
    where there is a truth; with `released` moved_mm and turned_deg. A scene that cannot be drawn has no answers.
    """
    try:
        plan = plan_scene(context.job, context.catalogue, SceneChance(context.job.seed, scene_id))
    except SceneError:
        return {}
    truths = [_settle(context.job, plan, reference) for reference in REFERENCES[: 2 if posed else 1]]
    answers = {"reference": _describe(plan, truths[0])}
    agreed = posed and None not in truths and _apart_mm(plan, *truths) <= AGREE_MM  # type: ignore[arg-type]
    answers["reference"]["agreed"] = agreed if posed else None
    again = dict[bytes, dict[str, float]]()
    for setting in settings:
        job = apply(context.job, setting.changes)
        rest = _settle(job, plan)
        answer = answers[setting.name] = _describe(plan, rest)
        if rest is None:
            continue
        if agreed and truths[0] is not None:
            answer["pose_mm"] = _apart_mm(plan, rest, truths[0])
        if released:
            key = b"".join(one.T_world_obj.tobytes() for one in rest.settled)
            if key not in again:
                again[key] = _release(context.job, plan, rest)
            answer.update(again[key])
    return answers


def _settle(job: Job, plan: ScenePlan, physics: Mapping[str, Any] | None = None) -> Rest | None:
    """None where the scene does not come to rest."""
    try:
        return settle_scene(plan, *_physics(job, plan, physics or {}))
    except SceneError:
        return None


def _physics(job: Job, plan: ScenePlan, changes: Mapping[str, Any]) -> tuple[Physics, EffectPlan]:
    """The job's physics with these changes, and the plan of effects with them."""
    physics = job.physics.model_copy(update=dict(changes))
    return physics, plan_effects(Facts(job.model_copy(update={"physics": physics}), plan, raycast_checked=False))


def _describe(plan: ScenePlan, rest: Rest | None) -> Answer:
    if rest is None:
        return {"failed": True}
    slid, rolled = [], []
    for start, end in zip(plan.objects, rest.settled, strict=True):
        before, after = (transform(T, start.asset.mass.com[None])[0, :2] for T in (start.T_world_obj, end.T_world_obj))
        slid.append(float(np.linalg.norm(after - before)) * 1e3)
        rolled.append(math.degrees(motion_between(start.hull.vertices, start.T_world_obj, end.T_world_obj)[1]))
    return {
        "failed": False,
        "penetration_mm": max(one.penetration_mm for one in rest.settled),
        "gap_mm": max(one.hover_gap_mm for one in rest.settled),
        "unbalanced_share": max(one.equilibrium_residual for one in rest.settled),
        "slid_mm": max(slid),
        "rolled_deg": max(rolled),
    }


def _apart_mm(plan: ScenePlan, one: Rest, other: Rest) -> float:
    """The largest distance between the places of a point of an object in two rests, mm."""
    return max(
        moved_by(start, a.T_world_obj, b.T_world_obj)[0]
        for start, a, b in zip(plan.objects, one.settled, other.settled, strict=True)
    )


def _release(job: Job, plan: ScenePlan, rest: Rest) -> dict[str, float]:
    again = recheck_scene(plan, rest, *_physics(job, plan, RELEASED), FINEST).settled
    return {
        "moved_mm": max(one.recheck_move_mm or 0.0 for one in again),
        "turned_deg": max(one.recheck_turn_deg or 0.0 for one in again),
    }


def context_for(context: WorkerContext, setting: Setting) -> WorkerContext:
    """The same worker with the setting's job. The settings' digest stays: nothing is stored under it."""
    return dataclasses.replace(context, job=apply(context.job, setting.changes))
