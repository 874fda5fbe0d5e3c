"""A scene that a user's table has (`scenes_from`): its objects, its table and its cameras in place of drawn ones."""

from collections.abc import Sequence
from dataclasses import replace

from schemas.base import frozen_array
from schemas.errors import StartError
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, ScenePlan
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset
from schemas.scene.view import Camera, Intrinsics
from workers.assets.catalogue import Catalogue, InstanceRef, choose_object, choose_table
from workers.assets.scene_tables import GivenObject, GivenScene, read_scene
from workers.geometry.hull import hull_of
from workers.scene.chance import SceneChance, Stream


def read_given(catalogue: Catalogue, scene_id: int) -> GivenScene | None:
    """The rows of a scene; None where the job has no table of scenes. Raises StartError."""
    return None if catalogue.scenes is None else read_scene(catalogue.scenes, scene_id)


def choose_given(catalogue: Catalogue, chance: SceneChance, given: GivenScene) -> tuple[list[InstanceRef], InstanceRef]:
    """The instances of the objects, in order, and of the table; what has none is drawn. Raises StartError."""
    objects = [_choose(catalogue, chance, number, each) for number, each in enumerate(given.objects)]
    if given.table_id is None:
        return objects, choose_table(catalogue, chance.stream(Stream.TABLE))
    if (table := catalogue.find(given.table_id, tables=True)) is None:
        raise StartError(
            "unknown_instance", f"no source in assets.tables has {given.table_id}: add the one that it is of"
        )
    return objects, table


def _choose(catalogue: Catalogue, chance: SceneChance, number: int, each: GivenObject) -> InstanceRef:
    where, category = f"object {number} of scene {chance.scene_id}", each.category
    sources = "no source in assets.objects"
    if each.instance_id is None:
        if not catalogue.offers(str(category)):
            raise StartError("unknown_category", f"{where}: {sources} offers {category!r}: add one, or rename it")
        return choose_object(catalogue, str(category), chance.object_stream(Stream.GIVEN, number))
    name = each.instance_id
    if (ref := catalogue.find(name)) is None:
        remedy = "add its own, with its seed and instances"
        raise StartError("unknown_instance", f"{where}: {sources} has {name!r}: {remedy}")
    if category not in (None, ref.category):
        raise StartError("unknown_instance", f"{where}: {name} is a {ref.category}, and category is {category!r}")
    return ref


def put_given(plan: ScenePlan, job: Job, given: GivenScene, assets: Sequence[Asset]) -> ScenePlan:
    """The plan with the table's objects, and with its cameras unless the job's always stand on the orbit. Raises StartError."""
    if len({each.settle for each in given.objects}) > 1:
        falls = ", ".join(str(number) for number, each in enumerate(given.objects) if each.settle)
        raise StartError(
            "settle_some", f"objects {falls} have settle: true, and others do not: give all of a scene the same"
        )
    kept = not given.objects[0].settle
    for each, asset in zip(given.objects, assets, strict=True):
        if each.sha256 not in (None, asset.sha256):
            shapes = f"{asset.instance_id} has the SHA-256 {asset.sha256[:12]}, and had {str(each.sha256)[:12]}"
            raise StartError("other_shape", f"{shapes}: its source, or Verso, is of another version: use that one")
    starts = tuple(
        ObjectStart(asset, hull_of(asset.shape), REGION_FIRST_OBJECT + number, frozen_array(each.T_world_obj), 0, kept)
        for number, (each, asset) in enumerate(zip(given.objects, assets, strict=True))
    )
    plan = replace(plan, category=assets[0].category, objects=starts, kept=kept)
    if job.cameras.orbit.always or not given.cameras:
        return plan
    if len(given.cameras) < job.pairs_per_scene:
        count = f"scene {plan.scene_id} has {len(given.cameras)} cameras, and pairs_per_scene is {job.pairs_per_scene}"
        raise StartError("few_cameras", f"{count}: lower that, add cameras, or set cameras.orbit.always: true")
    usual = Intrinsics.of(job.cameras.sensor.fixed())
    cameras = tuple(Camera(k or usual, frozen_array(T)) for T, k in given.cameras[: job.pairs_per_scene])
    return replace(plan, input_cameras=cameras, aimed=True)
