"""One scene framed before anything is written: a job none of whose cameras can see an object is refused."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from schemas.base import Array
from schemas.errors import InputError, SceneError
from schemas.job.job import Job
from schemas.scene.scene import ScenePlan
from schemas.scene.view import Camera
from workers.assets.catalogue import Catalogue
from workers.geometry.camera import project
from workers.geometry.frames import invert, transform
from workers.scene.chance import SceneChance
from workers.scene.pairs import place_mirror_camera
from workers.scene.plan import plan_scene

SAMPLED = 8
"""Scenes that are planned at most. The first that can be framed is enough: one with bad luck is a row in `failures`."""


def require_framed(job: Job, catalogue: Catalogue) -> None:
    """Raises InputError where none of the first scenes can be planned, or shows an object, whatever physics does with it.

    An object is framed as it is let go, set down on the table. A job that lets all of its scenes fail is not asked.
    """
    if job.captures is not None or job.run.max_failure_share == 1.0:
        return
    reasons = Counter[str]()
    for scene_id in range(job.first_scene, job.first_scene + min(SAMPLED, job.scenes)):
        try:
            reason = _unframed(job, plan_scene(job, catalogue, SceneChance(job.seed, scene_id)))
        except SceneError as error:
            reason = error.detail
        if not reason:
            return
        reasons[reason] += 1
    most = reasons.most_common(1)[0][0]
    raise InputError(f"job {job.name}: none of the first {reasons.total()} scenes can be planned and framed: {most}")


def _unframed(job: Job, plan: ScenePlan) -> str:
    """Why no pair of a scene has an object in both pictures; empty where one has."""
    reasons = [_unseen(job, points, camera) for points in _resting(plan) for camera in plan.input_cameras]
    return "" if "" in reasons else reasons[0]


def _resting(plan: ScenePlan) -> Iterator[Array]:
    """[N, 3] world: the hull of each object, moved down to the table's top."""
    for start in plan.objects:
        points = transform(start.T_world_obj, start.hull.vertices)
        yield points + np.array([0.0, 0.0, plan.table.top.height_m - points[:, 2].min()])


def _unseen(job: Job, points: Array, camera: Camera) -> str:
    """Why an object at `points` [N, 3], world, is not in the picture of an input camera and of its mirror camera."""
    distance_m = float(transform(invert(camera.T_world_cam), points)[:, 2].min())
    sides = [("input", camera, "cameras.orbit.radius_m", job.cameras.orbit.radius_m)]
    if job.cameras.mirror.enabled:
        mirror = place_mirror_camera(camera, distance_m, job.cameras.mirror)
        sides.append(("mirror", mirror, "cameras.mirror.T_z_m", job.cameras.mirror.T_z_m))
    for role, seen_by, key, value in sides:
        local = transform(invert(seen_by.T_world_cam), points)
        low, high = float(local[:, 2].min()), float(local[:, 2].max())
        near, far = job.images.depth_range_m
        where = f"the {role} camera has the object {low:.3g} to {high:.3g} m before it"
        there = local[(local[:, 2] > near) & (local[:, 2] < far)]
        if not len(there):
            return f"{where}, outside images.depth_range_m [{near:g}, {far:g}]: change {key}, which is {value:g}"
        k = seen_by.intrinsics
        pixels = zip(project(there, k), (k.width, k.height), strict=True)
        if min(np.ptp(np.clip(at, 0.0, most)) for at, most in pixels) < 1.0:
            look = f"see cameras.sensor, start.offset_m and {key} ({value:g})"
            return f"{where}, beside its picture or smaller than a pixel: {look}"
    return ""
