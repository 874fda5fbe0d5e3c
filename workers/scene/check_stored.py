"""Check of stored labels: derives each again from the stored images, the rows and the job, by the producer's functions."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.dataset.codec import Row, columns_of_bodies, read_camera, read_label, read_world_poses
from schemas.dataset.layout import file_pose_id, image_path, patch_index, stored_images, stored_shape, view_name
from schemas.dataset.tables import misplaced_columns
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import MODALITIES, Role, View
from workers.geometry.camera import image_coordinates
from workers.geometry.frames import invert
from workers.geometry.pixels import measure_regions
from workers.scene.cameras import draw_mirror_share, place_beside, place_fixed, place_mirror_camera
from workers.scene.chance import SceneChance
from workers.scene.labels import compare_views, derive_projected, patch_object_fraction, projection_shares
from workers.scene.pairs import object_distance
from workers.scene.rows import amodal_columns, image_boxes

ROUNDING = 1e-12
"""Largest difference of poses and distances that are computed again from the same doubles."""

ReadImage = Callable[[str], NDArray]


def check_stored_scene(scene: Row) -> list[str]:
    """Columns of `scenes` that disagree with its bodies, or are absent, a sentence each; a capture has no bodies."""
    where = f"scene {scene['scene_id']}"
    if fault := misplaced_columns(scene):
        return [f"{where}: {fault}"]
    if _is_captured(scene):
        return []
    bodies = scene["bodies"]
    expected = columns_of_bodies(bodies)
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
    """Labels of one pair that do not follow from its images and rows, a sentence each.

    `views` holds the pair's rows by name, `objects` its rows of that table, `read` returns an image by its path.
    """
    faults: list[str] = []
    stored = {role: _read_view(row, job, objects, read, faults) for role, row in views.items()}
    if faults:
        return faults
    for role, view in stored.items():
        if role != "projected":
            faults += _check_labels(job, view, objects, scene)
            faults += _check_images(view, scene)
            faults += _check_amodal(view, objects)
        faults += _check_patches(view, stored["mirror" if role == "projected" else role], job, read, views[role])
    faults += _check_cameras(job, stored, views)
    if "mirror" in stored and not _is_captured(scene):
        faults += _check_agreement(job, stored, views)
    if "projected" in stored:
        faults += _check_projection(job, stored, views, EffectPlan(tuple(scene["effects"]), {}))
    return faults


def _read_view(row: Row, job: Job, objects: Sequence[Row], read: ReadImage, faults: list[str]) -> View:
    """A stored view; images of a wrong size or type are added to the faults."""
    role: Role = row["role"]
    rows = _rows_of((row["pose_id"], role, row["number"]), objects)
    count = sum(label["region_id"] >= REGION_FIRST_OBJECT for label in rows)
    images: dict[str, NDArray] = {}
    for image in stored_images(role, job):
        modality, pose_id = MODALITIES[image.pixels], file_pose_id(role, row["parent_id"])
        numbers = [patch_index(REGION_FIRST_OBJECT + n, count) for n in range(count)] if modality.each else [None]
        paths = [image_path(row["category"], image.content, pose_id, number, row["number"]) for number in numbers]
        planes = [read(path) for path in paths]
        shape = stored_shape(modality, row["height"], row["width"], job)
        wrong = [n for n, pixels in enumerate(planes) if pixels.shape != shape or pixels.dtype != modality.dtype]
        for n in wrong:
            wanted = f"is {planes[n].dtype} {planes[n].shape}, and must be {modality.dtype} {shape}"
            faults.append(f"{paths[n]}: {wanted}")
        images[image.pixels] = np.stack(planes) if modality.each and not wrong else planes[0]
    labels = tuple(read_label(label) for label in sorted(rows, key=lambda label: label["region_id"]))
    camera, ids = read_camera(row), (row["pose_id"], row["parent_id"])
    rgb, depth, region = (images.pop(name, None) for name in ("rgb", "depth", "region"))
    assert depth is not None
    return View(role, *ids, camera, rgb, depth, region, labels, images, row["number"])


def _rows_of(view: tuple[int, Role, int | None], objects: Sequence[Row]) -> list[Row]:
    """The rows of `objects` of a view, by its pose id, role and number."""
    return [row for row in objects if (row["pose_id"], row["role"], row["number"]) == view]


def _check_amodal(view: View, objects: Sequence[Row]) -> Iterator[str]:
    """Extents of silhouettes that are not those of their images; each holds the pixels that the mask shows of its object."""
    masks = view.further.get("amodal", ())
    rows = {row["region_id"]: row for row in _rows_of((view.pose_id, view.role, view.number), objects)}
    for region_id, mask in enumerate(masks, start=REGION_FIRST_OBJECT):
        expected = amodal_columns(mask)
        stored = {name: rows[region_id][name] for name in expected}
        if stored != expected:
            yield f"{_named(view)}, region {region_id}: its image amodal gives {expected}, objects says {stored}"


def _differs(a: ArrayLike, b: ArrayLike) -> bool:
    return bool(np.abs(np.asarray(a) - np.asarray(b)).max() > ROUNDING)


def _named(view: View) -> str:
    return f"pose {view.pose_id} ({view_name(view.role, view.number)})"


def _check_labels(job: Job, view: View, objects: Sequence[Row], scene: Row) -> Iterator[str]:
    """Compare rows of `objects` with the mask, the poses, and the share of its patch that each object fills."""
    assert view.region is not None
    T_world = read_world_poses(scene)
    if {label.region_id for label in view.labels} != set(T_world):
        regions = [label.region_id for label in view.labels]
        yield f"{_named(view)}: objects has the regions {regions}, scenes {list(T_world)}"
        return
    rows = _rows_of((view.pose_id, view.role, view.number), objects)
    shares = {row["region_id"]: row["patch_object_fraction"] for row in rows}
    extents = measure_regions(view.region)
    for label in view.labels:
        pixels, box = extents[label.region_id]
        name = f"{_named(view)}, region {label.region_id}"
        stored_share, share = shares[label.region_id], patch_object_fraction(view, label, job.images.patch)
        if pixels != label.pixels:
            yield f"{name}: the mask has {pixels} pixels, objects says {label.pixels}"
        if box != label.bbox_xywh:
            yield f"{name}: the mask's box is {box}, objects says {label.bbox_xywh}"
        if image_coordinates(label.T_cam_obj, view.camera.intrinsics) != (label.u, label.v):
            yield f"{name}: T_cam_obj projects to another pixel than ({label.u}, {label.v})"
        if _differs(invert(view.camera.T_world_cam) @ T_world[label.region_id], label.T_cam_obj):
            yield f"{name}: T_cam_obj does not follow from the camera's and the object's poses"
        if not 0.0 <= label.visible_fraction <= 1.0:
            yield f"{name}: visible_fraction {label.visible_fraction} is no share"
        if label.region_id >= REGION_FIRST_OBJECT and share != stored_share:
            yield f"{name}: fills {share} of its patch, objects says {stored_share}"


def _is_captured(scene: Row) -> bool:
    """Whether a row of `scenes` is of a capture."""
    return scene["capture"] is not None


def _check_images(view: View, scene: Row) -> Iterator[str]:
    """Compare the mask with the depth, and its regions with those of `objects`.

    Nothing, in a photograph, is what is neither board nor object, and may have depth; a view that was made of photographs
    shows nothing without depth.
    """
    assert view.region is not None
    where, known = _named(view), {0, 1} | {label.region_id for label in view.labels}
    known |= {body["region_id"] for body in (scene["surroundings"] or {}).get("clutter", ())}
    if foreign := set(np.unique(view.region).tolist()) - known:
        yield f"{where}: the mask has regions {sorted(foreign)} that objects lacks"
    if not _is_captured(scene) and (view.depth[view.region == 0] != 0).any():
        yield f"{where}: depth where the mask says that nothing was hit"
    if _is_captured(scene) and view.role == "mirror" and (view.region[view.depth == 0] != 0).any():
        yield f"{where}: the mask has regions where there is no depth"


def _check_patches(view: View, labelled: View, job: Job, read: ReadImage, row: Row) -> Iterator[str]:
    """Patches that are not the crop of their image, and files that are missing or too many.

    `labelled` is the view that holds the labels: the mirror view for a projected one, else the view itself.
    """
    listed = {file["path"] for file in row["files"]}
    objects = [label for label in labelled.labels if label.region_id >= REGION_FIRST_OBJECT]
    expected = set()
    for path, kind, box in image_boxes(view, objects, row["category"], job.images.patch):
        expected.add(path)
        full = view.images.get(kind)
        if box and path in listed and full is not None and not np.array_equal(read(path), full[box]):
            yield f"{path}: is not the crop of its image"
    if expected != listed:
        wrong = sorted(expected ^ listed)
        yield f"{_named(view)}: files {wrong} should be there, or should not"


def _check_cameras(job: Job, stored: Mapping[str, View], views: Mapping[str, Row]) -> Iterator[str]:
    """Compare d_z with the input's stored depth, and the other poses with the input pose and d_z."""
    first = stored["input"]
    assert first.region is not None
    d_z = object_distance(first.depth, first.region, job.images, job.cameras.mirror)
    pair = first.parent_id // 2 % job.pairs_per_scene
    share = draw_mirror_share(SceneChance(job.seed, views["input"]["scene_id"]), job.cameras.mirror, pair)
    mirror = place_mirror_camera(first.camera, d_z, job.cameras.mirror, share)
    poses = {**place_beside(first.camera, job), "mirror": mirror, "projected": mirror}
    fixed = place_fixed(job, {"input": first.camera, "mirror": mirror})
    poses |= {view_name(named.name, named.number): named.camera for named in fixed}
    for role, camera in poses.items():
        if role in stored and _differs(camera.T_world_cam, stored[role].camera.T_world_cam):
            yield f"{_named(stored[role])}: T_world_cam does not follow from the input pose and d_z"
    for role, row in views.items():
        if abs(row["d_z_m"] - d_z) > ROUNDING:
            yield f"pose {row['pose_id']} ({role}): d_z_m is {row['d_z_m']}, the input depth gives {d_z}"


def _check_agreement(job: Job, stored: Mapping[str, View], views: Mapping[str, Row]) -> Iterator[str]:
    """Compare the agreement of the two views."""
    mirror = stored["mirror"]
    agreement = compare_views(stored["input"], mirror, job.images, job.check.mirror_agreement_mm)
    row = views["mirror"]["mirror_agreement"]
    derived = None if agreement.median_mm is None else (agreement.median_mm, agreement.share)
    if (row is None) != (derived is None) or (
        derived and _differs(np.array(derived), [row["median_mm"], row["share"]])
    ):
        yield f"pose {mirror.pose_id} (mirror): the two views agree to {derived}, views says {row}"


def _check_projection(
    job: Job, stored: Mapping[str, View], views: Mapping[str, Row], effects: EffectPlan
) -> Iterator[str]:
    """The projected images to the byte, and their shares; `effects` are those that the scene's receipt names."""
    first, mirror, projected = stored["input"], stored["mirror"], stored["projected"]
    where = _named(projected)
    rgb, depth = derive_projected(first, mirror.camera, job.images, job.sensor.distortion, effects)
    same_rgb = rgb is None or (projected.rgb is not None and np.array_equal(rgb, projected.rgb))
    if not same_rgb or not np.array_equal(depth, projected.depth):
        yield f"{where}: the stored input depth projects to other images"
    shares = projection_shares(depth, mirror.depth, job.images)
    if _differs(shares, [views["projected"][f"projected_{name}_share"] for name in ("filled", "hidden")]):
        yield f"{where}: the shares filled and hidden are {shares}, and not what views says"
