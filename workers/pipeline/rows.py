"""What is written of a scene: encoded files, and one row or more in each manifest table. Pure."""

import hashlib
from typing import Any

from schemas.base import Pose
from schemas.dataset.layout import asset_path
from schemas.dataset.tables import worst_rest
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.scene.camera import Camera
from schemas.scene.plan import ObjectStart
from schemas.scene.region import REGION_FIRST_OBJECT
from schemas.scene.scene import SceneOutput, Settled
from schemas.scene.shape import Asset
from schemas.scene.view import Pair, View
from workers.assets.catalogue import split_of
from workers.assets.glb import asset_glb
from workers.geometry.camera import inclination, yaw
from workers.pipeline.context import WorkerContext
from workers.pipeline.image_files import Files, encode_view, object_labels, patch_object_fraction
from workers.pipeline.make_scene import Scene, Stopwatch
from workers.plan.effects import write_receipt
from workers.store.images import encode_png

Row = dict[str, Any]


def record_scene(context: WorkerContext, scene: Scene, watch: Stopwatch) -> SceneOutput:
    """Everything that a finished scene leaves behind, but its timings."""
    files: Files = []
    views: list[Row] = []
    with watch.stage("encode"):
        for pair in scene.pairs:
            for view in pair.views:
                own = encode_view(view, pair, context.job)
                files += own
                views.append(view_row(scene, pair, view, own, context.job))
        every = (scene.plan.table.asset, *(start.asset for start in scene.plan.objects))
        assets = list({asset.instance_id: asset for asset in every}.values())
        for asset in assets:
            if asset.shareable:
                files.append((asset_path(asset.category, asset.instance_id), asset_glb(asset, encode_png)))
    rows = {
        "scenes": [scene_row(context, scene)],
        "views": views,
        "objects": [
            row for pair in scene.pairs for view in pair.views for row in object_rows(scene, view, context.job)
        ],
        "assets": [asset_row(asset, context.job) for asset in assets],
        "failures": [],
    }
    return SceneOutput(scene.plan.scene_id, tuple(files), rows)


def matrix(T: Pose) -> list[float]:
    """16 doubles, row-major."""
    return [float(x) for x in T.ravel()]


def scene_row(context: WorkerContext, scene: Scene) -> Row:
    """The row of `scenes`: its own columns are the first object's, and of the figures the worst of all objects."""
    start, rest = scene.plan.objects[0], scene.settled[0]
    ran, skipped = write_receipt(scene.effects, scene.called)
    bodies = [body_row(start, rest) for start, rest in zip(scene.plan.objects, scene.settled, strict=True)]
    return {
        "scene_id": scene.plan.scene_id,
        "category": scene.plan.category,
        "instance_id": start.asset.instance_id,
        "source": start.asset.source,
        "table_id": scene.plan.table.asset.instance_id,
        "object_scale": start.asset.scale,
        "T_world_obj": matrix(rest.T_world_obj),
        "T_world_table": matrix(scene.plan.table.T_world_table),
        "pose": context.job.start.pose,
        "redraws": start.redraws,
        "effects": ran,
        "skipped": skipped,
        **worst_rest(bodies),
        "settle_s": max(rest.settle_s for rest in scene.settled),
        "raycast_checked": scene.raycast_checked,
        "settings_digest": context.settings_digest,
        "bodies": bodies,
    }


def body_row(start: ObjectStart, rest: Settled) -> Row:
    """One object of a scene, an item of `scenes.bodies`."""
    return {
        "region_id": start.region_id,
        "category": start.asset.category,
        "instance_id": start.asset.instance_id,
        "source": start.asset.source,
        "object_scale": start.asset.scale,
        "T_world_obj": matrix(rest.T_world_obj),
        "redraws": start.redraws,
        "penetration_mm": rest.penetration_mm,
        "hover_gap_mm": rest.hover_gap_mm,
        "support_margin_mm": rest.support_margin_mm,
        "residual_speed_mm_s": rest.residual_speed_mm_s,
        "recheck_move_mm": rest.recheck_move_mm,
        "recheck_turn_deg": rest.recheck_turn_deg,
        "equilibrium_residual": rest.equilibrium_residual,
    }


def view_row(scene: Scene, pair: Pair, view: View, files: Files, job: Job) -> Row:
    """The row of `views`, key (pose_id, role)."""
    labels = object_labels(view, pair)
    projected = view.role == "projected"
    agreement = pair.agreement if view.role == "mirror" else None
    return {
        "pose_id": view.pose_id,
        "parent_id": view.parent_id,
        "role": view.role,
        "scene_id": scene.plan.scene_id,
        "category": scene.plan.category,
        **camera_columns(view.camera),
        "depth_units_per_m": job.images.depth_units_per_m,
        "d_z_m": pair.d_z_m,
        "files": [
            {"path": path, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for path, data in files
        ],
        "object_pixels": None if projected else sum(label.pixels for label in labels),
        "visible_fraction": None if projected else labels[0].visible_fraction,
        "mirror_agreement": None
        if agreement is None or agreement.median_mm is None
        else {"median_mm": agreement.median_mm, "share": agreement.share},
        "projected_filled_share": pair.filled_share if projected else None,
        "projected_hidden_share": pair.hidden_share if projected else None,
        "patch_object_fraction": None if projected else patch_object_fraction(view, labels[0], job.images.patch),
    }


def camera_columns(camera: Camera) -> Row:
    """The columns that describe a camera, in both pixel conventions."""
    k = camera.intrinsics
    return {
        "T_world_cam": matrix(camera.T_world_cam),
        "inclination_rad": inclination(camera.T_world_cam),
        "yaw_rad": yaw(camera.T_world_cam),
        "width": k.width,
        "height": k.height,
        "fx": k.fx,
        "fy": k.fy,
        "cx": k.cx,
        "cy": k.cy,
        "cx_opencv": k.cx_opencv,
        "cy_opencv": k.cy_opencv,
    }


def object_rows(scene: Scene, view: View, job: Job) -> list[Row]:
    """The rows of `objects`, key (pose_id, role, region_id); the table has one too."""
    return [
        {
            "pose_id": view.pose_id,
            "role": view.role,
            "region_id": label.region_id,
            "scene_id": scene.plan.scene_id,
            "category": label.category,
            "instance_id": label.instance_id,
            "u": label.u,
            "v": label.v,
            "T_cam_obj": matrix(label.T_cam_obj),
            "bbox_xywh": list(label.bbox_xywh),
            "pixels": label.pixels,
            "visible_fraction": label.visible_fraction,
            "patch_object_fraction": None
            if label.region_id < REGION_FIRST_OBJECT
            else patch_object_fraction(view, label, job.images.patch),
        }
        for label in view.labels
    ]


def asset_row(asset: Asset, job: Job) -> Row:
    """The row of `assets`."""
    return {
        "instance_id": asset.instance_id,
        "category": asset.category,
        "source": asset.source,
        "licence": asset.licence,
        "path": asset.path,
        "sha256": asset.sha256,
        "extents_m": [float(x) for x in asset.extents_m],
        "volume_m3": asset.volume_m3,
        "watertight": asset.watertight,
        "T_source_to_object": matrix(asset.T_source_to_object),
        "scale": asset.scale,
        "split": split_of(asset.instance_id, job.assets.split),
        "notes": list(asset.notes),
    }


def failed_scene(scene_id: int, category: str, error: SceneError, attempts: int = 1) -> SceneOutput:
    """A scene that cannot be made: no files, one row in `failures`."""
    row: Row = {
        "scene_id": scene_id,
        "category": category,
        "stage": error.stage,
        "kind": error.kind,
        "reason": error.reason,
        "detail": error.detail,
        "attempts": attempts,
    }
    return SceneOutput(scene_id, (), {"failures": [row]})


def timing_row(scene_id: int, category: str, watch: Stopwatch) -> Row:
    """The row of `timings`: the only one that is not a function of job and seed."""
    stages, effects = (
        [{"name": name, "seconds": seconds} for name, seconds in one.items()] for one in (watch.seconds, watch.effects)
    )
    return {
        "scene_id": scene_id,
        "category": category,
        "stages": stages,
        "effects": effects,
        "total_s": sum(watch.seconds.values()),
    }
