"""A second opinion on image targets, by Mitsuba's own rays: `python -m tests.judge.traced --scenes 20`.

Takes what Mitsuba's `aov` integrator records of a ray (position, normal, shape), of rays through pixel centres, where that
integrator has random ones, and goes on behind each hit for the layers. Mitsuba computes in float32. Pixels of objects
alone, every `STRIDE`th. Ends with 1 where Mitsuba is missing or does not agree.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml

from schemas.base import Array
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.views import ViewTarget
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import View
from tests.judge.targets import context_of
from workers.geometry.frames import invert, transform
from workers.render.pathtraced import Tracer
from workers.render.tiers import require_mitsuba
from workers.scene.make_scene import Scene, make_scene
from workers.stopwatch import Stopwatch

STRIDE = 13
"""Prime, so that pixels of every column come up."""

BEHIND_M = 5e-5
"""Where a ray goes on behind a hit: float32 leaves 1e-6 m, and surfaces nearer than this to one another are passed by."""

BOUNDS = {"normals, degrees": 0.05, "coordinates, of the diagonal": 1e-4, "layers, mm": 0.15}
"""What float32 leaves: of layers, half a unit of stored depth and 0.05 mm."""

LEAST_SHARE = 0.99
"""Of the pixels; the rest are centres near edges, and surfaces nearer to one another than Mitsuba tells apart."""


def hits_of(mi: Any, scene: Any, sensor: Any, at: Array) -> Iterator[tuple[int, Array, Array]]:
    """(region, position [3], unit normal [3]) of every surface along a ray, world frame; `at`: shares of the image."""
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(*at), mi.Point2f(0.5, 0.5))
    while (hit := scene.ray_intersect(ray)).is_valid():
        yield int(hit.shape.id().split("-")[1]), np.array(hit.p, float), np.array(hit.n, float)
        ray = mi.Ray3f(ray(hit.t + BEHIND_M), ray.d)


def compare(tracer: Tracer, scene: Scene, view: View) -> dict[str, list[float]]:
    """Errors of a view's pixels, by target; inf where regions or the number of layers differ."""
    mi, images, k = tracer._mi, view.images, view.camera.intrinsics
    objects = {thing.region_id: thing for thing in scene.posed.things if thing.region_id >= REGION_FIRST_OBJECT}
    built = tracer.build(list(objects.values()), scene.posed.appearance, scene.effects).scene
    sensor = tracer.sensor(view.camera)
    errors: dict[str, list[float]] = {name: [] for name in BOUNDS}
    for row, column in np.argwhere(images["region"] >= REGION_FIRST_OBJECT)[::STRIDE]:
        at = np.array([(column + 0.5) / k.width, (row + 0.5) / k.height])
        found = list(hits_of(mi, built, sensor, at))
        if not found or found[0][0] != images["region"][row, column]:
            for name in BOUNDS:
                errors[name].append(np.inf)
            continue
        region, point, normal = found[0]
        ray = point - view.camera.position
        normal = (normal if normal @ ray < 0.0 else -normal) @ view.camera.T_world_cam[:3, :3]
        told = images["normals"][row, column] / 65535.0 * 2.0 - 1.0
        errors["normals, degrees"].append(float(np.degrees(np.linalg.norm(told - normal))))
        thing = objects[region]
        low, high = thing.shape.bounds
        diagonal = float(np.linalg.norm(high - low))
        own = transform(invert(thing.T_world_shape), point[None])[0]
        share = (own - (low + high) / 2.0) / diagonal + 0.5
        errors["coordinates, of the diagonal"].append(
            float(np.abs(images["coordinates"][row, column] / 65535.0 - share).max())
        )
        errors["layers, mm"].append(_layers_off(view, row, column, [(one, point) for one, point, _ in found]))
    return errors


def _layers_off(view: View, row: int, column: int, found: Sequence[tuple[int, Array]]) -> float:
    """Largest error of the pixel's layers, mm; inf where one is of another region, missing or too many."""
    images, count, worst = view.images, sum(name.endswith("_region") for name in view.images) - 1, 0.0
    for name, n in [*((f"layer{n + 1}", n) for n in range(count)), ("back", len(found) - 1)]:
        region = images[f"{name}_region"][row, column]
        if n >= len(found):
            worst = np.inf if region else worst
            continue
        z = transform(invert(view.camera.T_world_cam), found[n][1][None])[0, 2]
        off_mm = abs(images[name][row, column] / 5.0 - 1e3 * z)
        worst = max(worst, off_mm if region == found[n][0] else np.inf)
    return float(worst)


def main() -> int:
    """Make the scenes and print, for each target, the median error and the share of pixels within its bound."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--job", default="deploy/jobs/pile.yaml")
    ask.add_argument("--scenes", type=int, default=20)
    ask.add_argument("--objects", type=int, nargs=2, help="least and most objects of a scene, instead of the job's")
    given = ask.parse_args()
    require_mitsuba()
    document = yaml.safe_load(Path(given.job).read_text())
    document.pop("verso", None)
    document["targets"] = {"views": list(get_args(ViewTarget))}
    if given.objects:
        document["objects_per_scene"] = given.objects
    context, tracer = context_of(Job.model_validate(document).model_dump_json()), Tracer()
    errors: dict[str, list[float]] = {name: [] for name in BOUNDS}
    for scene_id in range(given.scenes):
        try:
            scene = make_scene(context, scene_id, Stopwatch())
        except SceneError as error:
            print(f"scene {scene_id}: refused: {error.reason}")
            continue
        for view in (view for pair in scene.pairs for view in pair.views if view.region is not None):
            for name, more in compare(tracer, scene, view).items():
                errors[name] += more
    shares = {name: float((np.array(errors[name]) <= bound).mean()) for name, bound in BOUNDS.items()}
    for name, share in shares.items():
        print(
            f"{name}: {share:.3%} of {len(errors[name])} pixels within {BOUNDS[name]:g}, median {np.median(errors[name]):.2g}"
        )
    return int(min(shares.values()) < LEAST_SHARE)


if __name__ == "__main__":
    sys.exit(main())
