"""One scene from its id to what is written: the list of steps, readable in one glance."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from schemas.base import frozen_array
from schemas.dataset.layout import input_pose_id
from schemas.scene.camera import ROLES, Camera, Role
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ScenePlan
from schemas.scene.region import REGION_FLOOR, REGION_TABLE
from schemas.scene.scene import Placed, PosedScene, Settled
from schemas.scene.view import GBuffer, ObjectLabel, Pair, View
from workers.assets.catalogue import choose_object, choose_table, load_asset
from workers.cameras.pivot_depth import object_distance
from workers.cameras.placement import place_aligned_camera, place_mirror_camera
from workers.geometry.pixels import measure_regions
from workers.geometry.stored_depth import quantise_depth
from workers.labels.derive import compare_views, derive_projected, label_region, projection_shares
from workers.labels.ray_check import check_against_rays, check_pair
from workers.physics.step import recheck_scene, settle_scene
from workers.pipeline.context import WorkerContext
from workers.plan.effect import Facts
from workers.plan.effects import is_raycast_scene, plan_effects
from workers.plan.randomness import Stream, of_object, stream
from workers.plan.step import choose_category, count_objects, plan_scene
from workers.render.step import draw_view
from workers.sensor.step import SensorChance, sense_view


@dataclass(frozen=True, eq=False)
class Scene:
    """A finished scene before it is encoded."""

    plan: ScenePlan
    settled: tuple[Settled, ...]
    posed: PosedScene
    pairs: tuple[Pair, ...]
    raycast_checked: bool
    effects: EffectPlan
    called: Mapping[str, str]
    """Effects that the plan left out and that ran after all, and why."""


@dataclass(frozen=True)
class Stopwatch:
    """Seconds by stage, and by effect where an effect has a time of its own; what runs twice adds up.

    Stages follow one another and sum up to the scene; an effect's time lies within those of stages.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    effects: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, effect: str | None = None) -> Iterator[None]:
        """Adds the time that the block takes to the stage's, and to the effect's that it is the work of."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            took = time.perf_counter() - begun
            self.seconds[name] = self.seconds.get(name, 0.0) + took
            if effect is not None:
                self.effects[effect] = self.effects.get(effect, 0.0) + took

    @contextmanager
    def effect(self, name: str) -> Iterator[None]:
        """Adds the time that the block, which has stages of its own, takes to the effect's."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.effects[name] = self.effects.get(name, 0.0) + time.perf_counter() - begun


def make_scene(context: WorkerContext, scene_id: int, watch: Stopwatch) -> Scene:
    """Plan, settle, look, derive, check. Raises SceneError where this scene cannot be made."""
    job = context.job
    with watch.stage("assets"):
        plan = plan_with_assets(context, scene_id)
    checked = is_raycast_scene(job, scene_id)
    with watch.stage("plan"):
        effects = plan_effects(Facts(job, plan, checked), context.forced)
    with watch.stage("physics", "dynamics" if effects.runs("dynamics") else None):
        rest = settle_scene(plan, job.physics, effects)
    if effects.runs("release_again"):
        with watch.stage("recheck", "release_again"):
            rest = recheck_scene(plan, rest, job.physics, effects)
    posed = pose_scene(plan, rest.settled)
    view = SceneView(context, plan, posed, effects, watch)
    with watch.stage("render", "light_maps" if effects.runs("light_maps") else None):
        context.renderer.prepare_light(posed.things, posed.appearance, job.render, effects)
    pairs = tuple(make_pair(view, camera, number) for number, camera in enumerate(plan.input_cameras))
    with watch.stage("check"):
        for pair in pairs:
            check_pair(pair, job.check)
    return Scene(plan, rest.settled, posed, pairs, checked, effects, rest.called)


def pose_scene(plan: ScenePlan, settled: tuple[Settled, ...]) -> PosedScene:
    """Floor, table and objects where they rest, in order of region id."""
    objects = tuple(
        Placed(start.region_id, start.asset.shape, rest.T_world_obj)
        for start, rest in zip(plan.objects, settled, strict=True)
    )
    table = Placed(REGION_TABLE, plan.table.asset.shape, plan.table.T_world_table)
    floor = Placed(REGION_FLOOR, plan.floor, frozen_array(np.eye(4)))
    return PosedScene((floor, table, *objects), plan.appearance)


def plan_with_assets(context: WorkerContext, scene_id: int) -> ScenePlan:
    """Draw table, categories and objects, load them, and draw everything else."""
    job, catalogue = context.job, context.catalogue
    assets = []
    for number in range(count_objects(job, scene_id)):
        rng = stream(job.seed, scene_id, Stream.OBJECT, *of_object(number))
        assets.append(load_asset(catalogue, choose_object(catalogue, choose_category(job, scene_id, number), rng)))
    table = load_asset(catalogue, choose_table(catalogue, stream(job.seed, scene_id, Stream.TABLE)))
    return plan_scene(job, scene_id, table, *assets)


@dataclass(frozen=True, eq=False)
class SceneView:
    """What rendering a pair of a settled scene needs."""

    context: WorkerContext
    plan: ScenePlan
    posed: PosedScene
    effects: EffectPlan
    watch: Stopwatch


def make_pair(scene: SceneView, camera: Camera, number: int) -> Pair:
    """The views of one pair that the job asks for. Raises ViewError where the input camera sees no object."""
    job, watch = scene.context.job, scene.watch
    parent = input_pose_id(scene.plan.scene_id, number, job.pairs_per_scene)
    exact_first = render_view(scene, "input", (parent, parent), camera)
    first = sense(scene, exact_first, number)
    aligned: View | None = None
    if scene.effects.runs("depth_camera"):
        with watch.effect("depth_camera"):
            aligned_camera = place_aligned_camera(camera, job.cameras.depth)
            aligned = sense(scene, render_view(scene, "aligned", (parent, parent), aligned_camera), number)
    assert first.region is not None
    d_z_m = object_distance(first.depth, first.region, job.images, job.cameras.mirror)
    if not scene.effects.runs("mirror"):
        return Pair(d_z_m, first, aligned)
    mirror_camera = place_mirror_camera(camera, d_z_m, job.cameras.mirror)
    with watch.effect("mirror"):
        exact_mirror = render_view(scene, "mirror", (parent + 1, parent), mirror_camera)
        mirror = sense(scene, exact_mirror, number)
    with watch.stage("check"):
        agreement = compare_views(job, first, mirror)
    exact_agreement = agreement
    if scene.effects.runs("exact_agreement"):
        with watch.stage("check", "exact_agreement"):
            exact_agreement = compare_views(job, exact_first, exact_mirror)
    if not scene.effects.runs("projection"):
        return Pair(d_z_m, first, aligned, mirror, None, agreement, exact_agreement)
    with watch.stage("projection", "projection"):
        rgb, depth = derive_projected(first, mirror.camera, job.images, job.sensor.distortion)
        filled, hidden = projection_shares(depth, mirror.depth, job.images)
    projected = View("projected", parent, parent, mirror.camera, rgb, depth, None, ())
    return Pair(d_z_m, first, aligned, mirror, projected, agreement, exact_agreement, filled, hidden)


def sense(scene: SceneView, exact: View, number: int) -> View:
    """An exact view as the job's sensors store it. Chance is named by scene, effect, pair and role."""
    job, on = scene.context.job, [name for name in scene.effects.ran if name.startswith("sensor_")]
    if not on:
        return exact
    own = (scene.plan.scene_id, number, ROLES.index(exact.role))
    with scene.watch.stage("sensor", on[0] if len(on) == 1 else None):
        return sense_view(job.sensor, job.images, exact, sensor_chance(job.seed, *own), scene.effects)


def sensor_chance(seed: int, scene_id: int, pair: int, role: int) -> SensorChance:
    """The generators of one view's sensor effects."""
    names = (Stream.SENSOR_DEPTH, Stream.SENSOR_RGB, Stream.SENSOR_EXPOSURE)
    return SensorChance(*(stream(seed, scene_id, name, pair, role) for name in names))


def render_view(scene: SceneView, role: Role, ids: tuple[int, int], camera: Camera) -> View:
    """One rendered view: exact images in their stored encodings, and labels of the table and of every object."""
    job, renderer = scene.context.job, scene.context.renderer
    with scene.watch.stage("render"):
        paths = stream(job.seed, scene.plan.scene_id, Stream.PATHS, *ids, ROLES.index(role))
        buffer = draw_view(
            renderer, scene.posed.things, scene.posed.appearance, camera, job.render, paths, scene.effects
        )
    if scene.effects.runs("raycast_check"):
        with scene.watch.stage("raycast", "raycast_check"):
            check_against_rays(scene.posed, camera, buffer, job.images.depth_range_m)
    with scene.watch.stage("labels"):
        labels = label_view(scene, camera, buffer)
        depth = quantise_depth(buffer.depth_m, job.images)
    return View(role, *ids, camera, buffer.rgb, depth, buffer.region, labels)


def label_view(scene: SceneView, camera: Camera, buffer: GBuffer) -> tuple[ObjectLabel, ...]:
    """Labels of the table and of every object, in order of region id."""
    table, extents = scene.plan.table.asset, measure_regions(buffer.region)
    names = {REGION_TABLE: ("table", table.instance_id)}
    names.update({start.region_id: (start.asset.category, start.asset.instance_id) for start in scene.plan.objects})
    return tuple(
        label_region(
            (thing.region_id, *names[thing.region_id], thing.T_world_shape),
            camera,
            extents[thing.region_id],
            lambda thing=thing: scene.context.renderer.count_pixels(thing, camera),  # type: ignore[misc]
        )
        for thing in scene.posed.things
        if thing.region_id >= REGION_TABLE
    )
