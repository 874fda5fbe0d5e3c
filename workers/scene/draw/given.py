"""A scene that a user's table has (`scenes_from`): its objects, its table and its cameras in place of drawn ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.errors import StartError
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, ScenePlan
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset
from schemas.scene.view import Camera, Intrinsics
from workers.assets.catalogue import Catalogue, InstanceRef, choose_object, choose_table
from workers.assets.scene_tables import GivenObject, GivenScene, read_scene
from workers.geometry.frames import invert, pose
from workers.geometry.hull import hull_of
from workers.scene.chance import SceneChance, Stream


def read_given(job: Job, catalogue: Catalogue, scene_id: int) -> GivenScene | None:
    """The rows of a scene, for a studio its first object's; None where the job has no table of scenes. Raises StartError."""
    if catalogue.scenes is None:
        return None
    given = read_scene(catalogue.scenes, scene_id)
    if job.scene == "studio":
        return replace(given, objects=given.objects[:1], table_id=None)
    if given.alone:
        raise StartError("no_table", f"{catalogue.scenes.path} has scenes of a studio: set scene: studio")
    return given


def choose_given(catalogue: Catalogue, chance: SceneChance, given: GivenScene) -> tuple[list[InstanceRef], InstanceRef]:
    """The instances of the objects, in order, and of the table; what has none is drawn. Raises StartError."""
    objects = list[InstanceRef]()
    for number, each in enumerate(given.objects):
        where, category = f"object {number} of scene {chance.scene_id}", each.category
        if each.instance_id is not None:
            objects.append(_find(catalogue, each.instance_id, where))
            if category not in (None, (known := objects[-1].category)):
                raise StartError(
                    "unknown_instance", f"{where}: {each.instance_id} is a {known}, and category is {category!r}"
                )
        elif catalogue.offers(str(category)):
            objects.append(choose_object(catalogue, str(category), chance.object_stream(Stream.GIVEN, number)))
        else:
            raise StartError(
                "unknown_category", f"{where}: no source in assets.objects offers {category!r}: add one, or rename it"
            )
    if given.table_id is None:
        return objects, choose_table(catalogue, chance.stream(Stream.TABLE))
    return objects, _find(catalogue, given.table_id, f"scene {chance.scene_id}", tables=True)


def _find(catalogue: Catalogue, name: str, where: str, tables: bool = False) -> InstanceRef:
    if (ref := catalogue.find(name, tables)) is None:
        sources = f"no source in assets.{'tables' if tables else 'objects'} has {name!r}"
        raise StartError("unknown_instance", f"{where}: {sources}: add its own, with its seed and instances")
    return ref


def put_given(plan: ScenePlan, job: Job, given: GivenScene, assets: Sequence[Asset]) -> ScenePlan:
    """The plan with the table's objects, and with its cameras unless the job's always stand on the orbit. Raises StartError."""
    starts = list[ObjectStart]()
    for number, (each, asset) in enumerate(zip(given.objects, assets, strict=True), start=REGION_FIRST_OBJECT):
        T = frozen_array(_pose_of(each, asset))
        starts.append(ObjectStart(asset, hull_of(asset.shape), number, T, 0, not each.settle))
    plan = replace(plan, category=assets[0].category, objects=tuple(starts), kept=any(one.placed for one in starts))
    return _put_cameras(plan, job, given, np.zeros(3))


def put_alone(plan: ScenePlan, job: Job, given: GivenScene, asset: Asset) -> ScenePlan:
    """The plan of a studio with its object turned as the table's, of the shape `asset` in any size, and cameras moved as it is.

    Raises StartError.
    """
    T = _pose_of(given.objects[0], asset)
    turned = replace(plan.objects[0], T_world_obj=frozen_array(pose(T[:3, :3], np.zeros(3))))
    return _put_cameras(replace(plan, objects=(turned,), kept=True), job, given, T[:3, 3])


def _pose_of(each: GivenObject, asset: Asset) -> Pose:
    if each.sha256 not in (None, asset.sha256):
        shapes = f"{asset.instance_id} has the SHA-256 {asset.sha256[:12]}, and had {str(each.sha256)[:12]}"
        raise StartError("other_shape", f"{shapes}: its source, or Verso, is of another version: use that one")
    return each.T_world_obj @ invert(asset.T_source_to_object) if each.of_source else each.T_world_obj


def _put_cameras(plan: ScenePlan, job: Job, given: GivenScene, origin: Array) -> ScenePlan:
    """The plan with the table's cameras, unless the job's always stand on the orbit; about `origin` [3] of the table's world."""
    if job.cameras.orbit.always or not given.cameras:
        return plan
    if len(given.cameras) < job.pairs_per_scene:
        count = f"scene {plan.scene_id} has {len(given.cameras)} cameras, and pairs_per_scene is {job.pairs_per_scene}"
        raise StartError("few_cameras", f"{count}: lower that, add cameras, or set cameras.orbit.always: true")
    usual = Intrinsics.of(job.cameras.sensor.fixed())
    there = given.cameras[: job.pairs_per_scene]
    cameras = tuple(Camera(k or usual, frozen_array(pose(T[:3, :3], T[:3, 3] - origin))) for T, k in there)
    return replace(plan, input_cameras=cameras, aimed=True)
