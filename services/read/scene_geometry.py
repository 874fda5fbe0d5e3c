"""The posed geometry of one stored scene or capture."""

import io

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

from schemas.dataset.codec import Row, read_world_poses
from schemas.dataset.layout import asset_path
from schemas.errors import CorruptError, InputError
from schemas.job.job import Job
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE
from services.job.record import require_job
from services.read.dataset_reader import StoredRange, find_scene
from services.read.replay import open_context
from workers.assets.catalogue import Catalogue
from workers.assets.external.plain import show_colors
from workers.assets.glb import linear_bytes, mesh_of_part
from workers.scene.plan import SceneChance, plan_scene
from workers.store.store import Store


def posed_scene(store: Store, scene_id: int) -> trimesh.Scene:
    """Floor, table and objects where the stored rows put them: world frame, z up, metres.

    Shapes come from the job's sources; poses from the manifest. Raises InputError where the scene was not made.
    """
    record, stored = require_job(store), find_scene(store, scene_id)
    row = stored.scene(scene_id)
    if row is None:
        reason = next((f["reason"] for f in stored.rows["failures"] if f["scene_id"] == scene_id), "unknown")
        raise InputError(f"scene {scene_id} was not made ({reason}): it has no geometry")
    if record.job.captures is not None:
        return captured_scene(store, stored, row)
    context = open_context(record)
    return planned_scene(context.job, context.catalogue, scene_id, row)


def captured_scene(store: Store, stored: StoredRange, row: Row) -> trimesh.Scene:
    """Board and object of a capture, from its stored shape. Raises CorruptError where that cannot be read."""
    T_world = read_world_poses(row)
    board = next(asset for asset in stored.rows["assets"] if asset["instance_id"] == row["table_id"])
    x, y, _ = (0.5 * size for size in board["extents_m"])
    rectangle = trimesh.Trimesh([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    rectangle.visual = ColorVisuals(
        rectangle, vertex_colors=linear_bytes(ColorVisuals(rectangle).vertex_colors / 255.0)
    )
    scene = trimesh.Scene()
    placed = [(f"board {row['table_id']}", rectangle, T_world[REGION_TABLE])]
    path = asset_path(row["category"], row["instance_id"])
    try:
        shape = trimesh.load_scene(io.BytesIO(store.read(path)), file_type="glb", process=False)
    except Exception as error:  # trimesh raises errors of many kinds for a damaged file
        raise CorruptError(
            f"{path} cannot be read: {error}; `verso replay {store.name} --repair` makes it again"
        ) from error
    thing = f"{row['category']} {row['instance_id']}"
    placed += [(thing, show_colors(mesh), T_world[REGION_FIRST_OBJECT]) for mesh in shape.geometry.values()]
    for name, mesh, T_world_mesh in placed:
        scene.add_geometry(mesh, geom_name=name, node_name=name, transform=T_world_mesh)
    return scene


def planned_scene(job: Job, catalogue: Catalogue, scene_id: int, row: Row) -> trimesh.Scene:
    """Floor, table and objects of a scene, from the job's sources. Raises SceneError where a shape cannot be made again."""
    plan = plan_scene(job, catalogue, SceneChance(job.seed, scene_id))
    T_world = {REGION_FLOOR: np.eye(4), **read_world_poses(row)}
    table = plan.table.asset
    placed = [("floor", REGION_FLOOR, plan.floor), (f"table {table.instance_id}", REGION_TABLE, table.shape)]
    for start in plan.objects:
        # Two objects may be of one instance: only the region id tells them apart.
        region = f" {start.region_id}" if len(plan.objects) > 1 else ""
        name = f"{start.asset.category} {start.asset.instance_id}{region}"
        placed.append((name, start.region_id, start.asset.shape))
    scene = trimesh.Scene()
    for name, region_id, shape in placed:
        for number, part in enumerate(shape.parts):
            label = f"{name}/{number}-{part.name}"
            scene.add_geometry(mesh_of_part(part), geom_name=label, node_name=label, transform=T_world[region_id])
    return scene
