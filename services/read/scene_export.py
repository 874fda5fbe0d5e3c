"""`verso scene`: the posed geometry of one stored scene as one GLB."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from schemas.base import Pose
from schemas.errors import InputError
from schemas.scene.plan import ScenePlan
from schemas.scene.shape import Part, Shape
from services.job.record import require_job
from services.read.dataset_reader import Row, find_scene
from services.read.replay import open_context
from workers.pipeline.make_scene import plan_with_assets
from workers.store.store import Store


def export_scene(store: Store, scene_id: int, target: Path) -> int:
    """Write floor, table and objects where the stored rows put them; returns the bytes written.

    World frame, z up, metres, as everywhere in a dataset. Shapes come from the job's sources; poses from the manifest.
    Raises InputError where the scene was not made.
    """
    record, stored = require_job(store), find_scene(store, scene_id)
    row = next((row for row in stored.rows["scenes"] if row["scene_id"] == scene_id), None)
    if row is None:
        reason = next((f["reason"] for f in stored.rows["failures"] if f["scene_id"] == scene_id), "unknown")
        raise InputError(f"scene {scene_id} was not made ({reason}): it has no geometry")
    plan = plan_with_assets(open_context(record), scene_id)
    scene = trimesh.Scene()
    for name, shape, T in (
        ("floor", plan.floor, np.eye(4)),
        (f"table {plan.table.asset.instance_id}", plan.table.asset.shape, np.reshape(row["T_world_table"], (4, 4))),
        *_objects(plan, row),
    ):
        for number, part in enumerate(shape.parts):
            label = f"{name}/{number}-{part.name}"
            scene.add_geometry(_mesh(part), geom_name=label, node_name=label, transform=T)
    data: bytes = scene.export(file_type="glb")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    return len(data)


def _objects(plan: ScenePlan, row: Row) -> Iterator[tuple[str, Shape, Pose]]:
    """Name, shape and pose of every object; of several, names end in their region ids, as two may be of one instance."""
    bodies = row["bodies"] or [{"T_world_obj": row["T_world_obj"]}]
    for start, body in zip(plan.objects, bodies, strict=True):
        region = f" {start.region_id}" if len(bodies) > 1 else ""
        name = f"{start.asset.category} {start.asset.instance_id}{region}"
        yield name, start.asset.shape, np.reshape(body["T_world_obj"], (4, 4))


def _mesh(part: Part) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, visual=_visual(part), process=False)


def _visual(part: Part) -> TextureVisuals | ColorVisuals:
    material = part.material
    if part.colors is not None and material.texture is None:
        return ColorVisuals(vertex_colors=part.colors)
    pbr = PBRMaterial(
        baseColorFactor=np.round(np.array(material.base_color) * 255).astype(np.uint8),
        metallicFactor=material.metallic,
        roughnessFactor=material.roughness,
        baseColorTexture=None if material.texture is None else Image.fromarray(material.texture),
    )
    return TextureVisuals(uv=part.uv, material=pbr)
