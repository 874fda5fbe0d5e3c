"""`verso scene`: the posed geometry of one stored scene as a GLB file."""

from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

from schemas.dataset.codec import Row, read_world_poses
from schemas.errors import InputError, OutputError
from schemas.job.job import Job
from schemas.scene.shape import REGION_FLOOR, REGION_TABLE
from services.job.record import require_job
from services.read.capture_export import captured_geometry
from services.read.dataset_reader import StoredRange, find_scene
from services.read.part_mesh import linear_bytes, mesh_of_part
from services.read.replay import open_context
from workers.assets.catalogue import Catalogue
from workers.scene.plan import SceneChance, plan_scene
from workers.store.store import Store


def export_scene(store: Store, scene_id: int, target: Path) -> int:
    """Write floor, table and objects where the stored rows put them; returns the bytes written.

    World frame, z up, metres, as everywhere in a dataset. Shapes come from the job's sources; poses from the manifest.
    Raises InputError where the scene was not made, OutputError where the file cannot be written.
    """
    record, stored = require_job(store), find_scene(store, scene_id)
    row = stored.scene(scene_id)
    if row is None:
        reason = next((f["reason"] for f in stored.rows["failures"] if f["scene_id"] == scene_id), "unknown")
        raise InputError(f"scene {scene_id} was not made ({reason}): it has no geometry")
    if record.job.captures is not None:
        scene = captured_scene(store, stored, row)
    else:
        context = open_context(record)
        scene = planned_scene(context.job, context.catalogue, scene_id, row)
    data: bytes = scene.export(file_type="glb")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror or error}; choose another --glb") from error
    return len(data)


def captured_scene(store: Store, stored: StoredRange, row: Row) -> trimesh.Scene:
    """Board and object of a capture, from its stored shape. Raises CorruptError where that cannot be read."""
    scene = trimesh.Scene()
    for name, mesh, T_world_mesh in captured_geometry(store, stored, row):
        if isinstance(mesh.visual, ColorVisuals):
            mesh.visual = ColorVisuals(mesh, vertex_colors=linear_bytes(mesh.visual.vertex_colors / 255.0))
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
