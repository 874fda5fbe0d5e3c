"""One scene framed before anything is written: a job none of whose cameras can see an object is refused."""

from collections import Counter
from itertools import product

import numpy as np

from schemas.base import Pose, Range
from schemas.errors import InputError, SceneError
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, Table
from schemas.scene.view import Camera
from workers.assets.catalogue import Catalogue
from workers.geometry.camera import project
from workers.geometry.frames import invert, transform, translation
from workers.scene.cameras import frame_cameras, place_mirror_camera, place_orbits, points_of, require_depth
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import plan_scene

SAMPLED = 8
"""Scenes that are planned at most. The first that can be framed is enough: one with bad luck is a row in `failures`."""


def require_framed(job: Job, catalogue: Catalogue) -> None:
    """Raises InputError where none of the first scenes can be planned, or shows an object, whatever physics does with it.

    A job that lets all of its scenes fail is not asked, nor one of a table of scenes, each of which is its user's.
    """
    if job.captures is not None or job.scenes_from is not None or job.run.max_failure_share == 1.0:
        return
    reasons = Counter[str]()
    for scene_id in range(job.first_scene, job.first_scene + min(SAMPLED, job.scenes)):
        try:
            plan = plan_scene(job, catalogue, SceneChance(job.seed, scene_id))
            poses = [_set_down(start, plan.table) if plan.ground else start.T_world_obj for start in plan.objects]
            plan = frame_cameras(job, plan, poses)
            placed = zip(plan.objects, poses, strict=True)
            unseen = [_unseen(job, *pair, camera) for pair, camera in product(placed, plan.input_cameras)]
            points = points_of(plan, poses)
            for entry in job.cameras.more if plan.ground is None else ():  # on a table, objects lie otherwise at rest
                for camera in place_orbits(job, entry, SceneChance(job.seed, scene_id), plan, points):
                    require_depth(job, camera, points)
        except SceneError as error:
            unseen = [error.detail]
        if "" in unseen:
            return
        reasons[unseen[0]] += 1
    most = reasons.most_common(1)[0][0]
    raise InputError(f"job {job.name}: none of the first {reasons.total()} scenes can be planned and framed: {most}")


def _set_down(start: ObjectStart, table: Table) -> Pose:
    """`T_world_obj` of an object straight below its start, on the table's top."""
    lowest_m = float(transform(start.T_world_obj, start.hull.vertices)[:, 2].min())
    return translation(0.0, 0.0, table.top.height_m - lowest_m) @ start.T_world_obj


def _unseen(job: Job, start: ObjectStart, T_world_obj: Pose, camera: Camera) -> str:
    """Why an object is not in the picture of an input camera or of its mirror camera; or nothing."""
    points = transform(T_world_obj, start.hull.vertices)
    sides = {"cameras.orbit.radius_m": ("input", camera, job.cameras.orbit.radius_m)}
    if job.cameras.mirror.enabled:
        front_m = float(transform(invert(camera.T_world_cam), points)[:, 2].min())
        opposite = place_mirror_camera(camera, front_m, job.cameras.mirror)
        sides["cameras.mirror.T_z_m"] = ("mirror", opposite, job.cameras.mirror.T_z_m)
    for key, (role, seen_by, given) in sides.items():
        value = f"{given:g}" if isinstance(given, float) else given
        local, k = transform(invert(seen_by.T_world_cam), points), seen_by.intrinsics
        where = f"the {role} camera has the object {local[:, 2].min():.3g} to {local[:, 2].max():.3g} m before it"
        there = local
        for kept, (near, far) in _depth_ranges(job).items():
            there = there[(there[:, 2] > near) & (there[:, 2] < far)]
            if not len(there):
                return f"{where}, outside {kept} [{near:g}, {far:g}]: change {key}, which is {value}"
        pixels = zip(project(there, k), (k.width, k.height), strict=True)
        if min(np.ptp(np.clip(at, 0.0, most)) for at, most in pixels) < 1.0:
            look = f"see cameras.sensor, start.offset_m and {key} ({value})"
            return f"{where}, beside its picture or smaller than a pixel: {look}"
    return ""


def _depth_ranges(job: Job) -> dict[str, Range]:
    """By key: what bounds the depth that is stored."""
    noise = job.sensor.depth_noise
    ranges = {"images.depth_range_m": job.images.depth_range_m}
    return ranges if noise is None else {**ranges, "sensor.depth_noise.range_m": noise.range_m}
