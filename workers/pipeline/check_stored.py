"""Labels derived again from what is stored: the images, the rows and the job, and nothing of the renderer."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.dataset.layout import file_pose_id, image_path, stored_images
from schemas.dataset.tables import worst_rest
from schemas.job.job import Job
from schemas.scene.camera import Camera, Intrinsics, Role
from schemas.scene.region import REGION_FIRST_OBJECT, REGION_TABLE
from schemas.scene.view import ObjectLabel, View
from workers.cameras.pivot_depth import object_distance
from workers.cameras.placement import place_aligned_camera, place_mirror_camera
from workers.geometry.camera import image_coordinates
from workers.geometry.frames import invert
from workers.geometry.pixels import measure_regions
from workers.labels.derive import compare_views, derive_projected, projection_shares
from workers.pipeline.check_stored_patches import ReadImage, Row, check_patches
from workers.pipeline.image_files import patch_object_fraction

SAME = 1e-12
"""Poses and distances that are computed again from the same doubles agree to rounding."""

FIRST_OBJECT = ("category", "instance_id", "source", "object_scale", "T_world_obj", "redraws")
"""Columns of `scenes` that are those of its first body."""

DTYPES = {"rgb": np.uint8, "depth": np.uint16, "region": np.uint8}


def check_stored_scene(scene: Row) -> list[str]:
    """What a scene's own columns say that its bodies do not; nothing where it was stored before there were bodies."""
    bodies = scene["bodies"]
    if bodies is None:
        return []
    expected = {name: bodies[0][name] for name in FIRST_OBJECT} | worst_rest(bodies)
    where = f"scene {scene['scene_id']}"
    faults = [
        f"{where}: {name} is {scene[name]}, its bodies give {value}"
        for name, value in expected.items()
        if scene[name] != value
    ]
    regions = [body["region_id"] for body in bodies]
    if regions != list(range(REGION_FIRST_OBJECT, REGION_FIRST_OBJECT + len(bodies))):
        faults.append(f"{where}: its bodies have the regions {regions}")
    return faults


def check_stored_pair(job: Job, views: Mapping[str, Row], objects: list[Row], scene: Row, read: ReadImage) -> list[str]:
    """Everything of one pair that does not follow from the rest of it, a sentence each; empty where all does.

    `views` holds the pair's rows by role, `objects` its rows of that table, `read` returns an image by its path.
    """
    faults: list[str] = []
    loaded = {role: _load(row, job, read, faults) for role, row in views.items()}
    if faults:
        return faults
    stored = {role: _view(row, loaded[role], _labels(objects, row)) for role, row in views.items()}
    for role, view in stored.items():
        if role != "projected":
            faults += _check_labels(view, scene)
            faults += _check_patch_shares(job, view, scene, objects)
            faults += _check_images(view)
        faults += check_patches(view, stored["mirror" if role == "projected" else role], job, read, views[role])
    faults += _check_cameras(job, stored, views)
    if "mirror" in stored:
        faults += _check_agreement(job, stored, views)
    if "projected" in stored:
        faults += _check_projection(job, stored, views)
    return faults


def _load(row: Row, job: Job, read: ReadImage, faults: list[str]) -> dict[str, NDArray]:
    """A view's images by kind of pixel, with their sizes and types checked."""
    images: dict[str, NDArray] = {}
    for image in stored_images(row["role"], job):
        path = image_path(row["category"], image.content, file_pose_id(row["role"], row["parent_id"]))
        pixels = read(path)
        shape = (row["height"], row["width"], 3)[: 3 if image.pixels == "rgb" else 2]
        if pixels.shape != shape or pixels.dtype != DTYPES[image.pixels]:
            faults.append(
                f"{path}: is {pixels.dtype} {pixels.shape}, and must be {DTYPES[image.pixels].__name__} {shape}"
            )
        images[image.pixels] = pixels
    return images


def camera_of(row: Row) -> Camera:
    """The camera that a row of `views` describes."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return Camera(
        Intrinsics(**{name: row[name] for name in names}), frozen_array(np.reshape(row["T_world_cam"], (4, 4)))
    )


def _labels(objects: list[Row], view: Row) -> tuple[ObjectLabel, ...]:
    rows = [row for row in objects if (row["pose_id"], row["role"]) == (view["pose_id"], view["role"])]
    return tuple(
        ObjectLabel(
            row["region_id"],
            row["category"],
            row["instance_id"],
            np.reshape(row["T_cam_obj"], (4, 4)),
            row["u"],
            row["v"],
            tuple(row["bbox_xywh"]),
            row["pixels"],
            row["visible_fraction"],
        )
        for row in sorted(rows, key=lambda row: row["region_id"])
    )


def _view(row: Row, images: Mapping[str, NDArray], labels: tuple[ObjectLabel, ...]) -> View:
    role: Role = row["role"]
    return View(
        role,
        row["pose_id"],
        row["parent_id"],
        camera_of(row),
        images.get("rgb"),
        images["depth"],
        images.get("region"),
        labels,
    )


def _differs(a: Array, b: Array) -> bool:
    return bool(np.abs(np.asarray(a) - np.asarray(b)).max() > SAME)


def _world_poses(scene: Row) -> dict[int, list[float]]:
    """Where the table and every object stand, by region id."""
    bodies = scene["bodies"] or [{"region_id": REGION_FIRST_OBJECT, "T_world_obj": scene["T_world_obj"]}]
    return {REGION_TABLE: scene["T_world_table"], **{body["region_id"]: body["T_world_obj"] for body in bodies}}


def _check_labels(view: View, scene: Row) -> list[str]:
    """Rows of `objects` against the mask and the poses."""
    assert view.region is not None
    where, faults = f"pose {view.pose_id} ({view.role})", []
    worlds = _world_poses(scene)
    if {label.region_id for label in view.labels} != set(worlds):
        return [f"{where}: objects has the regions {[label.region_id for label in view.labels]}, scenes {list(worlds)}"]
    extents = measure_regions(view.region)
    for label in view.labels:
        pixels, box = extents[label.region_id]
        name = f"{where}, region {label.region_id}"
        if pixels != label.pixels:
            faults.append(f"{name}: the mask has {pixels} pixels, objects says {label.pixels}")
        if box != label.bbox_xywh:
            faults.append(f"{name}: the mask's box is {box}, objects says {label.bbox_xywh}")
        if image_coordinates(label.T_cam_obj, view.camera.intrinsics) != (label.u, label.v):
            faults.append(f"{name}: T_cam_obj projects to another pixel than ({label.u}, {label.v})")
        if _differs(invert(view.camera.T_world_cam) @ np.reshape(worlds[label.region_id], (4, 4)), label.T_cam_obj):
            faults.append(f"{name}: T_cam_obj does not follow from the camera's and the object's poses")
        if not 0.0 <= label.visible_fraction <= 1.0:
            faults.append(f"{name}: visible_fraction {label.visible_fraction} is no share")
    return faults


def _check_patch_shares(job: Job, view: View, scene: Row, objects: list[Row]) -> list[str]:
    """How much of its patch each object fills; nothing where it was stored before there was such a column."""
    if scene["bodies"] is None:
        return []
    shares = {
        row["region_id"]: row["patch_object_fraction"]
        for row in objects
        if (row["pose_id"], row["role"]) == (view.pose_id, view.role)
    }
    found = {
        label.region_id: patch_object_fraction(view, label, job.images.patch)
        for label in view.labels
        if label.region_id >= REGION_FIRST_OBJECT
    }
    return [
        f"pose {view.pose_id} ({view.role}), region {region}: fills {share} of its patch, objects says {shares[region]}"
        for region, share in found.items()
        if share != shares[region]
    ]


def _check_images(view: View) -> list[str]:
    """Masks against depth, and against the regions that objects names."""
    assert view.region is not None
    known = {0, 1} | {label.region_id for label in view.labels}
    foreign = set(np.unique(view.region).tolist()) - known
    faults = (
        [f"pose {view.pose_id} ({view.role}): the mask has regions {sorted(foreign)} that objects lacks"]
        if foreign
        else []
    )
    if (view.depth[view.region == 0] != 0).any():
        faults.append(f"pose {view.pose_id} ({view.role}): depth where the mask says that nothing was hit")
    return faults


def _check_cameras(job: Job, stored: Mapping[str, View], views: Mapping[str, Row]) -> list[str]:
    """d_z from the input's stored depth; the aligned and mirror poses from it."""
    first, faults = stored["input"], []
    assert first.region is not None
    d_z = object_distance(first.depth, first.region, job.images, job.cameras.mirror)
    poses = {
        "aligned": place_aligned_camera(first.camera, job.cameras.depth),
        "mirror": place_mirror_camera(first.camera, d_z, job.cameras.mirror),
    }
    poses["projected"] = poses["mirror"]
    for role, camera in poses.items():
        if role in stored and _differs(camera.T_world_cam, stored[role].camera.T_world_cam):
            faults.append(
                f"pose {stored[role].pose_id} ({role}): T_world_cam does not follow from the input pose and d_z"
            )
    for role, row in views.items():
        if abs(row["d_z_m"] - d_z) > SAME:
            faults.append(f"pose {row['pose_id']} ({role}): d_z_m is {row['d_z_m']}, the input depth gives {d_z}")
    return faults


def _check_agreement(job: Job, stored: Mapping[str, View], views: Mapping[str, Row]) -> list[str]:
    """The agreement of the two views."""
    mirror = stored["mirror"]
    agreement = compare_views(job, stored["input"], mirror)
    told = views["mirror"]["mirror_agreement"]
    found = None if agreement.median_mm is None else (agreement.median_mm, agreement.share)
    if (told is None) != (found is None) or (
        found and _differs(np.array(found), np.array([told["median_mm"], told["share"]]))
    ):
        return [f"pose {mirror.pose_id} (mirror): the two views agree to {found}, views says {told}"]
    return []


def _check_projection(job: Job, stored: Mapping[str, View], views: Mapping[str, Row]) -> list[str]:
    """The projected images to the byte, and their shares."""
    first, mirror, projected = stored["input"], stored["mirror"], stored["projected"]
    where, faults = f"pose {projected.pose_id} (projected)", []
    rgb, depth = derive_projected(first, mirror.camera, job.images, job.sensor.distortion)
    same_rgb = rgb is None or (projected.rgb is not None and np.array_equal(rgb, projected.rgb))
    if not same_rgb or not np.array_equal(depth, projected.depth):
        faults.append(f"{where}: the stored input depth projects to other images")
    shares = projection_shares(depth, mirror.depth, job.images)
    if _differs(
        np.array(shares), np.array([views["projected"][f"projected_{name}_share"] for name in ("filled", "hidden")])
    ):
        faults.append(f"{where}: the shares filled and hidden are {shares}, and not what views says")
    return faults
