"""One pair of a settled scene: its views as they are stored, and how they agree."""

from dataclasses import dataclass, replace
from functools import partial

from schemas.dataset.layout import file_pose_id, input_pose_id
from schemas.scene.camera import ROLES, Camera, Role
from schemas.scene.effects import EffectPlan
from schemas.scene.plan import ScenePlan
from schemas.scene.scene import PosedScene
from schemas.scene.view import Pair, View
from workers.cameras.placement import object_distance, place_aligned_camera, place_mirror_camera
from workers.geometry.pixels import quantise_depth
from workers.labels.agreement import compare_views
from workers.labels.projected_view import derive_projected, projection_shares
from workers.labels.ray_check import check_against_rays
from workers.labels.regions import count_unoccluded, label_regions
from workers.pipeline.context import WorkerContext
from workers.pipeline.stopwatch import Stopwatch
from workers.plan.randomness import SceneChance, Stream
from workers.render.tiers import draw_view
from workers.sensor.step import SensorChance, sense_view


@dataclass(frozen=True, eq=False)
class SettledScene:
    """A scene at rest, and what making its views needs."""

    context: WorkerContext
    chance: SceneChance
    plan: ScenePlan
    posed: PosedScene
    effects: EffectPlan
    stopwatch: Stopwatch


def make_pair(scene: SettledScene, camera: Camera, number: int) -> Pair:
    """The views of one pair that the plan has. Raises ViewError where the input camera sees no object."""
    job, effects, stopwatch = scene.context.job, scene.effects, scene.stopwatch
    images, bound_mm = job.images, job.check.mirror_agreement_mm
    exact_input = render_view(scene, "input", number, camera)
    first = sense(scene, exact_input, number)
    aligned = None
    if effects.runs("depth_camera"):
        with stopwatch.effect("depth_camera"):
            aligned_camera = place_aligned_camera(camera, job.cameras.depth)
            aligned = sense(scene, render_view(scene, "aligned", number, aligned_camera), number)
    assert first.region is not None
    pair = Pair(object_distance(first.depth, first.region, images, job.cameras.mirror), first, aligned)
    if not effects.runs("mirror"):
        return pair
    with stopwatch.effect("mirror"):
        mirror_camera = place_mirror_camera(camera, pair.d_z_m, job.cameras.mirror)
        exact_mirror = render_view(scene, "mirror", number, mirror_camera)
        mirror = sense(scene, exact_mirror, number)
    with stopwatch.stage("check"):
        agreement = exact_agreement = compare_views(first, mirror, images, bound_mm)
    if effects.runs("exact_agreement"):
        with stopwatch.stage("check", "exact_agreement"):
            exact_agreement = compare_views(exact_input, exact_mirror, images, bound_mm)
    pair = replace(pair, mirror=mirror, agreement=agreement, exact_agreement=exact_agreement)
    if not effects.runs("projection"):
        return pair
    with stopwatch.stage("projection", "projection"):
        rgb, depth = derive_projected(first, mirror_camera, images, job.sensor.distortion, effects)
        filled, hidden = projection_shares(depth, mirror.depth, images)
    projected = View("projected", first.pose_id, first.pose_id, mirror_camera, rgb, depth, None, ())
    return replace(pair, projected=projected, filled_share=filled, hidden_share=hidden)


def render_view(scene: SettledScene, role: Role, number: int, camera: Camera) -> View:
    """One rendered view: exact images in their stored encodings, and labels of the table and of every object."""
    job, renderer, stopwatch = scene.context.job, scene.context.renderer, scene.stopwatch
    parent_id = input_pose_id(scene.plan.scene_id, number, job.pairs_per_scene)
    pose_id = file_pose_id(role, parent_id)
    with stopwatch.stage("render"):
        rng = partial(scene.chance.stream, Stream.PATHS, pose_id, parent_id, ROLES.index(role))
        buffer = draw_view(renderer, scene.posed.things, scene.posed.appearance, camera, job.render, rng, scene.effects)
    if scene.effects.runs("raycast_check"):
        with stopwatch.stage("raycast", "raycast_check"):
            check_against_rays(scene.posed, camera, buffer, job.images.depth_range_m)
    with stopwatch.stage("labels"):
        count = partial(count_unoccluded, count_drawn=renderer.count_pixels)
        labels = label_regions(scene.plan, scene.posed, camera, buffer.region, count)
        depth = quantise_depth(buffer.depth_m, job.images)
    return View(role, pose_id, parent_id, camera, buffer.rgb, depth, buffer.region, labels)


def sense(scene: SettledScene, exact: View, number: int) -> View:
    """An exact view as the job's sensors store it."""
    job, ran = scene.context.job, [name for name in scene.effects.ran if name.startswith("sensor_")]
    if not ran:
        return exact
    streams = (Stream.SENSOR_DEPTH, Stream.SENSOR_RGB, Stream.SENSOR_EXPOSURE)
    chance = SensorChance(*(scene.chance.stream(name, number, ROLES.index(exact.role)) for name in streams))
    with scene.stopwatch.stage("sensor", ran[0] if len(ran) == 1 else None):
        return sense_view(job.sensor, job.images, exact, chance, scene.effects)
