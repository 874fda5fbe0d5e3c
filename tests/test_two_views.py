"""Agreement of the input depth, projected into the mirror view, with the mirror depth, on whole scenes.

Visibility is found by ray casting, and the interpolation is written out here.

The bound follows from the quantisation of both images: 0.1 mm in the median, for the scene and for the object
alone wherever both cameras see fifty of its pixels. A pixel is compared where the point and the four mirror pixels
about it lie on one surface, judged by the triangles that rays meet there: the rim of a mug is about a pixel wide, and a
point between a rim's pixel and the next is on neither.

A step of the input's depth moves a point along the input's ray, and off its surface by that step times the cosine between
ray and normal; along the mirror's ray the error is then that distance divided by the mirror ray's cosine. Where the mirror
camera sees a surface at a more grazing angle than the input camera, as a laptop's screen from behind its edge, the error
grows by the ratio of the two. On the object alone the bound holds with that ratio divided out where it is above 1; the
median with the ratio is recorded as well.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from schemas.base import Counts
from schemas.errors import SceneError
from schemas.job.job import Job, settings_digest
from schemas.scene.scene import PosedScene
from schemas.scene.view import Pair
from services.job.job_file import load_job
from workers.assets.catalogue import open_catalogue
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.context import WorkerContext
from workers.scene.make_scene import make_scene
from workers.stopwatch import Stopwatch

JOB = load_job(Path(__file__).resolve().parents[1] / "deploy" / "jobs" / "tabletop.yaml")
MEDIAN_MM = 0.1
FEWEST = 50
SEEN_M = 0.0005
"""A point counts as seen by the mirror camera if the first surface on its ray is at most this far from it."""

ONE_SURFACE = np.cos(np.radians(20.0))
"""Least cosine between normals on one surface: neighbouring facets of a lathed shape differ by up to 12 degrees, the two
sides of an edge by far more."""

ONE_PLANE_M = 0.0005
"""Largest distance from the tangent plane of a neighbouring pixel's surface, some 2.5 mm away: that of a sphere of 6 mm."""


def cast(scene: PosedScene, origin: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(distance in lengths of `towards`, unit normal) where rays first meet the scene; inf and 0 where they do not."""
    meshes = [
        trimesh.Trimesh(trimesh.transform_points(t.shape.vertices, t.T_world_shape), t.shape.faces, process=False)
        for t in scene.things
    ]
    mesh: Any = trimesh.util.concatenate(meshes)
    hit, ray, where = mesh.ray.intersects_id(
        np.broadcast_to(origin, towards.shape), towards, multiple_hits=False, return_locations=True
    )
    distance, normal = np.full(len(towards), np.inf), np.zeros(towards.shape)
    distance[ray] = np.linalg.norm(where - origin, axis=1) / np.linalg.norm(towards[ray], axis=1)
    normal[ray] = mesh.face_normals[hit]
    return distance, normal


def differences_mm(pair: Pair, scene: PosedScene, object_only: bool) -> tuple[np.ndarray, np.ndarray]:
    """(|projected input depth - mirror depth|, ratio) of co-visible pixels, interpolated bilinearly in 1/z on one surface.

    The ratio is the growth of an error of the input's depth along the mirror's ray.
    """
    first, mirror = pair.input, pair.mirror
    assert mirror is not None and first.region is not None and mirror.region is not None
    k, R, eye = first.camera.intrinsics, mirror.camera.T_world_cam[:3, :3], mirror.camera.T_world_cam[:3, 3]
    step = 1 if object_only else 7
    rows, columns = (
        index[::step] for index in np.nonzero((first.region >= (3 if object_only else 1)) & (first.depth > 0))
    )
    z = first.depth[rows, columns] / 5000.0
    rays = np.stack([(columns + 0.5 - k.cx) / k.fx, (rows + 0.5 - k.cy) / k.fy, np.ones(len(z))], axis=1)
    world = (rays * z[:, None]) @ first.camera.T_world_cam[:3, :3].T + first.camera.T_world_cam[:3, 3]
    distance, normal = cast(scene, eye, world - eye)
    visible = np.abs(distance - 1.0) * np.linalg.norm(world - eye, axis=1) < SEEN_M
    local, own, normal = (world - eye)[visible] @ R, first.region[rows, columns][visible], normal[visible]
    along_input = np.abs(((rays @ first.camera.T_world_cam[:3, :3].T)[visible] * normal).sum(axis=1))
    along_mirror = np.abs(((local / local[:, 2:]) @ R.T * normal).sum(axis=1))
    ratio = along_input / np.maximum(along_mirror, 1e-9)
    x, y = k.fx * local[:, 0] / local[:, 2] + k.cx - 0.5, k.fy * local[:, 1] / local[:, 2] + k.cy - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    good = (i >= 0) & (j >= 0) & (i < k.height - 1) & (j < k.width - 1)
    inverse = np.zeros(len(local))
    for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
        a, b = np.where(good, i + di, 0), np.where(good, j + dj, 0)
        pixel = np.stack([(b + 0.5 - k.cx) / k.fx, (a + 0.5 - k.cy) / k.fy, np.ones(len(a))], axis=1) @ R.T
        reached, facing = cast(scene, eye, pixel)
        met = np.where(np.isinf(reached), 0, reached)[:, None] * pixel
        off = np.abs(((met - local @ R.T) * normal).sum(axis=1))
        good &= (mirror.region[a, b] == own) & (mirror.depth[a, b] > 0)
        good &= ((facing * normal).sum(axis=1) > ONE_SURFACE) & (off < ONE_PLANE_M)
        weight = (1 - np.abs(y - i - di)) * (1 - np.abs(x - j - dj))
        inverse += weight * 5000.0 / np.maximum(mirror.depth[a, b], 1)
    return np.abs(local[good, 2] - 1.0 / inverse[good]) * 1e3, ratio[good]


def worst_medians(scenes: range, job: Job = JOB) -> tuple[float, float, float, int]:
    """Largest median over scenes of the whole scene, of objects alone, the same as stored, and how many counted."""
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    context = WorkerContext(job, catalogue, shared_renderer(), settings_digest(job, catalogue.digest))
    whole, objects, as_stored = [], [], []
    for scene_id in scenes:
        try:
            scene = make_scene(context, scene_id, Stopwatch())
        except SceneError:
            continue
        for pair in scene.pairs:
            whole.append(float(np.median(differences_mm(pair, scene.posed, object_only=False)[0])))
            of_object, ratio = differences_mm(pair, scene.posed, object_only=True)
            if len(of_object) >= FEWEST:
                objects.append(float(np.median(of_object / np.maximum(ratio, 1.0))))
                as_stored.append(float(np.median(of_object)))
    return max(whole), max(objects), max(as_stored), len(objects)


@pytest.mark.parametrize(
    "scenes",
    [
        pytest.param(range(4), id="4"),
        pytest.param(range(12), id="12", marks=pytest.mark.minute),
        pytest.param(range(200), id="200", marks=pytest.mark.slow),
    ],
)
def test_input_depth_projected_into_the_mirror_view_agrees(scenes, record_figure):
    whole, objects, as_stored, counted = worst_medians(scenes)
    record_figure(f"two views, whole scene, {len(scenes)} scenes", "must agree", whole, MEDIAN_MM)
    record_figure(f"two views, object alone, {counted} of {len(scenes)} scenes", "must agree", objects, MEDIAN_MM)
    record_figure(f"two views, object alone, slant included, {counted} scenes", "either", as_stored, 1.1 * MEDIAN_MM)
    assert counted >= len(scenes) // 2
    assert as_stored <= 1.1 * MEDIAN_MM
    assert whole <= MEDIAN_MM
    assert objects <= MEDIAN_MM


@pytest.mark.minute
def test_input_depth_of_five_objects_projected_into_the_mirror_view_agrees(record_figure):
    """Both cameras see some of five objects in every scene; a single object is often seen by one camera only."""
    job = JOB.model_copy(update={"objects_per_scene": Counts(5, 5)})
    whole, objects, _, counted = worst_medians(range(6), job)
    record_figure("two views, five objects, whole scene, 6 scenes", "must agree", whole, MEDIAN_MM)
    record_figure(f"two views, five objects, objects alone, {counted} of 6 scenes", "must agree", objects, MEDIAN_MM)
    assert counted >= 5
    assert whole <= MEDIAN_MM
    assert objects <= MEDIAN_MM
