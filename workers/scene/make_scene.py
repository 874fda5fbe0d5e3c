"""One scene from its id to what is written: the list of steps."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from schemas.base import frozen_array
from schemas.scene.scene import EffectPlan, Placed, PosedScene, ScenePlan, Settled
from schemas.scene.shape import REGION_FLOOR, REGION_TABLE
from schemas.scene.view import Pair, View
from workers.physics.pour import NOTHING_MORE
from workers.physics.settle import Rest, keep_scene, recheck_scene, settle_scene
from workers.scene.cameras import frame_cameras, place_more, require_inputs
from workers.scene.chance import SceneChance
from workers.scene.context import WorkerContext
from workers.scene.draw.plan import plan_scene, pouring_of
from workers.scene.draw.studio import stand_alone
from workers.scene.draw.surround import surround
from workers.scene.effects import BRANCHES, Facts, is_raycast_scene, plan_effects
from workers.scene.pairs import SettledScene, make_further, make_pair
from workers.scene.ray_check import check_pair
from workers.stopwatch import Stopwatch


def no_further(pair: Pair, number: int) -> Iterator[View]:
    """No views of named cameras."""
    yield from ()


@dataclass(frozen=True, eq=False)
class Scene:
    """A finished scene before it is encoded."""

    plan: ScenePlan
    settled: tuple[Settled, ...]
    posed: PosedScene
    pairs: tuple[Pair, ...]
    effects: EffectPlan
    called: Mapping[str, str]
    """Effects that the plan left out and that ran after all, and why."""
    further: Callable[[Pair, int], Iterator[View]] = no_further
    """Draws the views of named cameras with a pair, by its number: one after another, since there may be a thousand."""

    def views(self) -> Iterator[tuple[Pair, View]]:
        """Every view with its pair: those of all pairs, each pair's before those of named cameras."""
        for number, pair in enumerate(self.pairs):
            yield from ((pair, view) for view in pair.views)
            yield from ((pair, view) for view in self.further(pair, number))

    @property
    def raycast_checked(self) -> bool:
        """Whether every view was checked against the ray caster."""
        return self.effects.runs("raycast_check")


@dataclass(frozen=True, eq=False)
class Laid:
    """A scene whose objects rest, before anything is drawn: the plan with the starts that led there, the effects, the rest."""

    plan: ScenePlan
    effects: EffectPlan
    rest: Rest


def make_scene(context: WorkerContext, scene_id: int, stopwatch: Stopwatch) -> Scene:
    """Plan, settle, render, derive, check. Raises SceneError where this scene cannot be made."""
    return render_scene(context, lay_scene(context, scene_id, stopwatch), stopwatch)


def plan_with_effects(context: WorkerContext, scene_id: int, stopwatch: Stopwatch) -> tuple[ScenePlan, EffectPlan]:
    """What chance decides, and the effects that it calls for. Raises SceneError."""
    job, chance = context.job, SceneChance(context.job.seed, scene_id)
    look = job.drawn_look.without(*(branch for name, branch in BRANCHES.items() if name in context.withdrawn))
    with stopwatch.stage("assets"):
        catalogue = replace(context.catalogue, recolour=look.recolour)
        plan = plan_scene(job, catalogue, chance)
        plan = surround(job, look, catalogue, chance, plan)
    with stopwatch.stage("plan"):
        facts = Facts(job, plan, is_raycast_scene(job.check, chance))
        return plan, plan_effects(facts, context.forced).without(*context.withdrawn)


def lay_scene(context: WorkerContext, scene_id: int, stopwatch: Stopwatch) -> Laid:
    """Plan and settle: all before the renderer. Raises SceneError."""
    job = context.job
    plan, effects = plan_with_effects(context, scene_id, stopwatch)
    if job.scene == "studio":
        rest = Rest(plan.objects, stand_alone(plan))
        return Laid(place_cameras(context, plan, rest), effects, rest)
    with stopwatch.stage("physics", "dynamics" if effects.runs("dynamics") else None):
        if effects.runs("kept_poses"):
            rest = keep_scene(plan, job.physics, effects, job.check.overlap_mm)
        else:
            drawn = job.scenes_from is None
            pouring = pouring_of(job.start, SceneChance(job.seed, scene_id), plan) if drawn else NOTHING_MORE
            rest = settle_scene(plan, job.physics, effects, pouring)
    plan = replace(plan, objects=rest.starts)
    if effects.runs("release_again"):
        with stopwatch.stage("recheck", "release_again"):
            rest = recheck_scene(plan, rest, job.physics, effects)
    return Laid(place_cameras(context, plan, rest), effects, rest)


def place_cameras(context: WorkerContext, plan: ScenePlan, rest: Rest) -> ScenePlan:
    """The plan with the cameras that follow from where its objects rest. Raises ViewError."""
    shown = replace(plan, objects=plan.shown)
    poses = [each.T_world_obj for each in rest.settled[: len(shown.objects)]]
    framed = shown if plan.aimed else frame_cameras(context.job, shown, poses)
    require_inputs(framed, poses)
    chance = SceneChance(context.job.seed, plan.scene_id)
    more = tuple(place_more(context.job, chance, framed, poses, context.catalogue.poses))
    return replace(framed, objects=plan.objects, more=more)


def render_scene(context: WorkerContext, laid: Laid, stopwatch: Stopwatch) -> Scene:
    """Render, derive, check: all after physics. Raises SceneError."""
    job, chance = context.job, SceneChance(context.job.seed, laid.plan.scene_id)
    plan, effects, rest = laid.plan, laid.effects, laid.rest
    posed = pose_scene(plan, rest.settled)
    scene = SettledScene(context, chance, plan, posed, effects, stopwatch)
    with stopwatch.stage("render", "light_maps" if effects.runs("light_maps") else None):
        context.renderer.prepare_light(posed.things, posed.appearance, job.render, effects)
    pairs = tuple(make_pair(scene, camera, number) for number, camera in enumerate(plan.input_cameras))
    with stopwatch.stage("check"):
        for pair in pairs:
            check_pair(pair, job.check)
    return Scene(plan, rest.settled, posed, pairs, effects, rest.called, partial(make_further, scene))


def pose_scene(plan: ScenePlan, settled: Sequence[Settled]) -> PosedScene:
    """Floor, table and objects where they rest, in order of region id."""
    objects = tuple(
        Placed(start.region_id, start.asset.shape, rest.T_world_obj)
        for start, rest in zip(plan.objects, settled, strict=True)
    )
    things = objects
    if plan.ground is not None:
        ground, still = plan.ground, frozen_array(np.eye(4))
        table = Placed(REGION_TABLE, ground.cover or plan.table.asset.shape, plan.table.T_world_table)
        walls = () if ground.walls is None else (Placed(REGION_FLOOR, ground.walls.shape, still),)
        things = (Placed(REGION_FLOOR, plan.floor, still), *walls, table, *objects)
    return PosedScene(things, plan.appearance)
