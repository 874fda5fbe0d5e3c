"""One pair of a settled scene: cameras that follow from the input camera, views as they are stored, and how they agree."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.dataset.layout import file_pose_id, input_pose_id
from schemas.errors import ViewError, plural
from schemas.job.cameras import Mirror
from schemas.job.job import Job
from schemas.job.views import Images
from schemas.scene.scene import EffectPlan, PosedScene, ScenePlan
from schemas.scene.shape import is_object
from schemas.scene.view import ROLES, VIEW_ROLES, Camera, Pair, Role, View
from workers.assets.look.surroundings import require_camera_inside
from workers.geometry.pixels import dequantise_depth, quantise_depth
from workers.render.pathtraced import draw_view
from workers.scene.cameras import (
    BESIDE,
    OPPOSITE,
    draw_mirror_share,
    place_beside,
    place_fixed,
    place_mirror_camera,
    require_room,
)
from workers.scene.chance import SceneChance, Stream
from workers.scene.context import WorkerContext
from workers.scene.labels import compare_views, count_unoccluded, derive_projected, label_regions, projection_shares
from workers.scene.ray_check import check_against_rays
from workers.scene.sensor import sense_view
from workers.stopwatch import Stopwatch
from workers.targets.coverage import with_alpha
from workers.targets.targets import Sight, draw_targets


def object_distance(depth: NDArray[np.uint16], region: NDArray[np.uint8], images: Images, mirror: Mirror) -> float:
    """`front_distance` of the object in a stored view; converts only the object's pixels to metres."""
    return front_distance(dequantise_depth(depth[is_object(region)], images), np.True_, mirror)


def front_distance(depth_m: Array, object_pixels: NDArray[np.bool_] | np.bool_, mirror: Mirror) -> float:
    """d_z: distance to the object's front surface along the optical axis, metres, from its stored depth.

    A low percentile by default, because the nearest pixel is noisy. Raises ViewError where no pixel of the object has
    depth.
    """
    z = depth_m[object_pixels & (depth_m > 0.0)]
    if z.size == 0:
        raise ViewError(
            "object_not_seen", "the input view has no depth pixel of the object: go nearer, or leave it out"
        )
    return float(np.percentile(z, mirror.percentile))


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
    first, sight = sense(scene, exact_input, number), Sight(scene.posed.things, camera)
    beside = []
    for role, near in place_beside(camera, job).items():
        if not effects.runs(effect := str(VIEW_ROLES[role].effect)):
            continue
        with stopwatch.effect(effect):
            moves = (f"change {VIEW_ROLES[role].branch}.offset_m",) * 2
            require_room(role, near, scene.plan, scene.posed.things, moves)
            beside.append(sense(scene, render_view(scene, role, number, near, sight), number))
    assert first.region is not None
    try:
        d_z_m = object_distance(first.depth, first.region, images, job.cameras.mirror)
    except ViewError as error:
        raise ViewError(error.reason, _why_unseen(job, exact_input)) from error
    pair = Pair(d_z_m, first, tuple(beside))
    if not effects.runs("mirror"):
        return pair
    with stopwatch.effect("mirror"):
        share = draw_mirror_share(scene.chance, job.cameras.mirror, number)
        mirror_camera = place_mirror_camera(camera, pair.d_z_m, job.cameras.mirror, share)
        require_room("mirror", mirror_camera, scene.plan, scene.posed.things, OPPOSITE)
        exact_mirror = render_view(scene, "mirror", number, mirror_camera, sight)
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


def _why_unseen(job: Job, exact: View) -> str:
    """Why a view has no depth of the object as it is stored, and what to do; exact: the view before the sensor's effects."""
    assert exact.region is not None
    seen, noise = is_object(exact.region), job.sensor.depth_noise
    if not seen.any():
        aim = "narrow start.offset_m, or aim the cameras at it" if job.scene == "tabletop" else "see cameras.orbit"
        return f"the input view does not show the object, which is beside the picture or behind other things: {aim}"
    z = dequantise_depth(exact.depth[seen], job.images)
    z, pixels = z[z > 0.0], f"the object has {plural(int(seen.sum()), 'pixel')} in the input view"
    if not z.size:
        low, high = job.images.depth_range_m
        return f"{pixels}, all nearer or farther than images.depth_range_m [{low:g}, {high:g}]: widen that"
    if noise is not None and not ((z > noise.range_m.low) & (z < noise.range_m.high)).any():
        low, high = noise.range_m
        measures = f"sensor.depth_noise measures from {low:g} to {high:g} m"
        remedy = "change cameras.orbit.radius_m, or sensor.depth_noise.range_m"
        return f"{pixels}, {z.min():.3g} to {z.max():.3g} m away, and {measures}: {remedy}"
    return (
        f"{pixels}, and sensor.depth_noise leaves none of them depth: bring the camera nearer (cameras.orbit.radius_m)"
    )


def make_further(scene: SettledScene, pair: Pair, number: int) -> Iterator[View]:
    """The views of the cameras that the job names, one after another: those of the scene with its first pair."""
    job, sight = scene.context.job, Sight(scene.posed.things, pair.input.camera)
    cameras = {view.role: view.camera for view in pair.views}
    if not scene.effects.runs("further_views"):
        return
    standing, fixed = scene.plan.more if number == 0 else (), tuple(place_fixed(job, cameras))
    for named in fixed:
        require_room(named.name, named.camera, scene.plan, scene.posed.things, BESIDE)
    for named in (*standing, *fixed):
        with scene.stopwatch.effect("further_views"):
            exact = render_view(scene, named.name, number, named.camera, sight, named.number)
            view = sense(scene, exact, number)
        yield view


def render_view(
    scene: SettledScene, role: Role, pair: int, camera: Camera, sight: Sight | None = None, number: int | None = None
) -> View:
    """One rendered view: exact images in their stored encodings, and labels of the table and of every object.

    `sight`: what the pair's input camera sees, for the views of others; `number`: of a view of a named camera.
    """
    job, renderer, stopwatch = scene.context.job, scene.context.renderer, scene.stopwatch
    if scene.plan.ground is not None:
        require_camera_inside(scene.plan.ground.walls, role, camera)
    parent_id = input_pose_id(scene.plan.scene_id, pair, job.pairs_per_scene)
    pose_id = file_pose_id(role, parent_id)
    with stopwatch.stage("render"):
        rng = partial(scene.chance.stream, Stream.PATHS, pose_id, parent_id, *place_of(role, number))
        buffer = draw_view(renderer, scene.posed.things, scene.posed.appearance, camera, job.render, rng, scene.effects)
    if scene.effects.runs("raycast_check"):
        with stopwatch.stage("raycast", "raycast_check"):
            check_against_rays(scene.posed, camera, buffer, job.images.depth_range_m)
    with stopwatch.stage("labels"):
        count = partial(count_unoccluded, count_drawn=renderer.count_pixels)
        labels = label_regions(scene.plan, scene.posed, camera, buffer.region, count)
        depth = quantise_depth(buffer.depth_m, job.images)
    further = draw_targets(scene.posed.things, camera, buffer.region, job, scene.effects, stopwatch, sight)
    alpha = further.pop("alpha", None)
    rgb = buffer.rgb if alpha is None or buffer.rgb is None else with_alpha(buffer.rgb, buffer.region, alpha)
    return View(role, pose_id, parent_id, camera, rgb, depth, buffer.region, labels, further, number)


def place_of(role: Role, number: int | None) -> tuple[int, ...]:
    """The numbers of a view's own streams of chance within its pair."""
    return (ROLES.index(role),) if number is None else (len(ROLES), crc32(role.encode()), number)


def sense(scene: SettledScene, exact: View, number: int) -> View:
    """An exact view as the job's sensors store it."""
    job, ran = scene.context.job, [name for name in scene.effects.ran if name.startswith("sensor_")]
    if not ran:
        return exact
    within = place_of(exact.role, exact.number)
    with scene.stopwatch.stage("sensor", ran[0] if len(ran) == 1 else None):
        return sense_view(
            job.sensor, job.images, exact, lambda name: scene.chance.sensor_stream(name, number, *within), scene.effects
        )
