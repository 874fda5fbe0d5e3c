"""From what a camera ought to see to what its sensor stores: masks and labels stay exact."""

from dataclasses import replace

from schemas.camera import ROLES
from schemas.job import Job
from schemas.scene import View
from workers.render.light import sense_rgb
from workers.render.sensor import sense_depth
from workers.scene.randomness import Stream, stream
from workers.scene.views import quantise_depth, stored_depth_m


def sense_view(job: Job, view: View, scene_id: int, pair: int) -> View:
    """An exact view as its sensors store it; the same view where the job asks for no effect.

    Chance is named by scene, effect, pair and role: another pair, another view or another effect moves no noise.
    """
    assert view.region is not None
    own = (pair, ROLES.index(view.role))
    rgb, depth = view.rgb, view.depth
    if rgb is not None and job.sensor.changes_rgb:
        exposure = stream(job.seed, scene_id, Stream.SENSOR_EXPOSURE, *own)
        noise = stream(job.seed, scene_id, Stream.SENSOR_RGB, *own)
        rgb = sense_rgb(rgb, view.camera.intrinsics, job.sensor, exposure, noise)
    if job.sensor.depth_noise is not None:
        rng = stream(job.seed, scene_id, Stream.SENSOR_DEPTH, *own)
        exact_m = stored_depth_m(depth, job.images)
        depth = quantise_depth(sense_depth(exact_m, view.region, view.camera, job.sensor.depth_noise, rng), job.images)
    return view if rgb is view.rgb and depth is view.depth else replace(view, rgb=rgb, depth=depth)
