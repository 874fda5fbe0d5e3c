"""The output of a scene: the images that its views leave, and its rows in each manifest table. Pure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.dataset.codec import Row, body_columns, camera_columns, columns_of_bodies, label_columns, matrix_column
from schemas.dataset.layout import asset_path, image_path, images_of, patch_index, patch_path, samples_path
from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.views import Images, Patch, Targets
from schemas.scene.scene import EncodedFile, Placed, SceneOutput, encoded_file
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset, Shape
from schemas.scene.view import MODALITIES, ObjectLabel, Pair, PixelKind, View, crop_box
from workers.assets.glb import asset_glb
from workers.assets.samples import draw_samples, encode_samples
from workers.geometry.camera import inclination, yaw
from workers.geometry.pixels import measure_regions
from workers.scene.context import WorkerContext
from workers.scene.effects import write_receipt
from workers.scene.labels import patch_object_fraction
from workers.scene.make_scene import Scene
from workers.stopwatch import Stopwatch
from workers.store.images import encode_png
from workers.targets.targets import coordinate_scale

Box = tuple[int | slice, ...]
"""Which part of an image: rows and columns, or all; of one that each object has, the object's number first."""


def encode_view(view: View, pair: Pair, images: Images) -> tuple[EncodedFile, ...]:
    """The view's images and their patches as PNG."""
    files = []
    objects = object_labels(view, pair)
    for path, kind, box in image_boxes(view, objects, objects[0].category, images.patch):
        files.append(encoded_file(path, encode_png(view.images[kind][box], images.png_level)))
    return tuple(files)


def image_boxes(
    view: View, objects: Sequence[ObjectLabel], category: str, patch: Patch
) -> Iterator[tuple[str, PixelKind, Box]]:
    """Path, kind of pixels and part of each image that the view holds and of its patches.

    objects: the labels that have patches, where the view is one of a pair. `category` is the scene's.
    """
    boxes = [(patch_index(label.region_id, len(objects)), crop_box(label, view.camera, patch)) for label in objects]
    there = view.images
    for image in images_of(view.role):
        if image.pixels not in there:
            continue
        each = MODALITIES[image.pixels].each
        for n, (index, _) in enumerate(boxes if each else [(None, None)]):
            yield (
                image_path(category, image.content, view.pose_id, index, view.number),
                image.pixels,
                (n,) if each else (),
            )
        for n, (index, box) in enumerate(boxes):
            if box is not None and view.number is None:
                path = patch_path(category, image.content, view.pose_id, index)
                yield path, image.pixels, (n, *box) if each else box


def object_labels(view: View, pair: Pair) -> list[ObjectLabel]:
    """Labels of the objects alone, by region id; a projected view is seen by the mirror camera and has its labels."""
    labelled = pair.mirror if view.role == "projected" else view
    assert labelled is not None
    return [label for label in labelled.labels if label.region_id >= REGION_FIRST_OBJECT]


ASSET_COLUMNS = ("instance_id", "category", "source", "licence", "path", "sha256", "volume_m3", "watertight", "scale")
"""Columns of `assets` that are fields of an asset."""


def record_scene(context: WorkerContext, scene: Scene, watch: Stopwatch) -> SceneOutput:
    """Files and rows of a finished scene, without its timings."""
    files: list[EncodedFile] = []
    views, objects = list[Row](), list[Row]()
    for pair, view in scene.views():
        with watch.stage("encode"):
            encoded = encode_view(view, pair, context.job.images)
            files += encoded
            views.append(view_row(scene.plan.scene_id, pair, view, encoded, context.job))
            objects += object_rows(scene.plan.scene_id, view, context.job, scene.posed.things)
    with watch.stage("encode"):
        table = () if scene.plan.ground is None else (scene.plan.table.asset,)
        every = (*table, *(start.asset for start in scene.plan.objects))
        assets = list({asset.instance_id: asset for asset in every}.values())
        files += [shape_file(asset) for asset in assets if asset.shareable]
    # Of objects alone: a table takes as long and as much room, and no network is trained to complete it.
    end = len(table) + len({start.asset.instance_id for start in scene.plan.shown})
    sampled = sample_assets(assets[len(table) : end], context.job.targets, watch)
    sampled = [*[NO_SAMPLES] * len(table), *sampled, *[NO_SAMPLES] * (len(assets) - end)]
    files += [samples.file for samples in sampled if samples.file is not None]
    rows = {
        "scenes": [scene_row(context, scene)],
        "views": views,
        "objects": objects,
        "assets": [asset_row(asset, context.job, samples) for asset, samples in zip(assets, sampled, strict=True)],
        "failures": [],
    }
    return SceneOutput(scene.plan.scene_id, tuple(files), rows)


def shape_file(asset: Asset) -> EncodedFile:
    """The asset's file in the dataset, encoded once and kept as long as the asset."""
    if (file := _shape_files.get(asset)) is None:
        path = asset_path(asset.category, asset.instance_id)
        file = _shape_files[asset] = encoded_file(path, asset_glb(asset, encode_png))
    return file


_shape_files: WeakKeyDictionary[Asset, EncodedFile] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class StoredSamples:
    """What is stored of an asset's samples: their file and the value of the column `samples`, or why there are none."""

    file: EncodedFile | None = None
    column: Row | None = None
    notes: tuple[str, ...] = ()


NO_SAMPLES = StoredSamples()


def sample_assets(assets: Sequence[Asset], targets: Targets, watch: Stopwatch) -> list[StoredSamples]:
    """The samples of each asset that the job asks for."""
    if not targets.shape:
        return [NO_SAMPLES] * len(assets)
    with watch.stage("samples"):
        return [stored_samples(asset, targets) for asset in assets]


def stored_samples(asset: Asset, targets: Targets) -> StoredSamples:
    """Its samples, drawn once as long as they are kept; none of a shape that may not be passed on."""
    if not asset.shareable:
        return StoredSamples(notes=("no samples: its source does not say that its shape may be passed on",))
    if (asset, targets) not in _samples:
        drawn, file, column = draw_samples(asset, targets), None, None
        if drawn.arrays:
            file = encoded_file(samples_path(asset.category, asset.instance_id), encode_samples(drawn.arrays))
            column = {**file_columns(file), "points": targets.points, "open_share": drawn.open_share}
        _samples[asset, targets] = StoredSamples(file, column, drawn.notes)
    return _samples[asset, targets]


SAMPLES_BYTES = 256 * 1024 * 1024
"""Samples that a process keeps: of some sixty shapes with 100,000 points each."""


def _bytes_of(stored: StoredSamples) -> int:
    """What counts of the memory: some also where there is no file, and never more than there is."""
    return min(max(2**20, 0 if stored.file is None else len(stored.file.data)), SAMPLES_BYTES)


_samples: LRUCache[tuple[Asset, Targets], StoredSamples] = LRUCache(SAMPLES_BYTES, getsizeof=_bytes_of)


def file_columns(file: EncodedFile) -> Row:
    """A file as rows list it."""
    return {"path": file.path, "bytes": len(file.data), "sha256": file.sha256}


SURROUNDINGS = (
    *("floor", "floor_tile_m", "table", "table_tile_m", "background", "room_m"),
    *("lights", "environment", "environment_deg"),
)


def surroundings_column(scene: Scene, job: Job) -> Row | None:
    """What was drawn of the surroundings; None where the job asks for none."""
    if scene.plan.surroundings is None:
        return None
    clutter = [
        {
            "region_id": start.region_id,
            "category": start.asset.category,
            "instance_id": start.asset.instance_id,
            "T_world_obj": matrix_column(rest.T_world_obj),
        }
        for start, rest in zip(scene.plan.objects, scene.settled, strict=True)
        if start.is_clutter
    ]
    return {**dict.fromkeys(SURROUNDINGS), **scene.plan.surroundings, "clutter": clutter}


def scene_row(context: WorkerContext, scene: Scene) -> Row:
    """The row of `scenes`: names of the first object, and the worst figures of all objects."""
    ran, skipped = write_receipt(scene.effects, scene.called)
    table = None if scene.plan.ground is None else scene.plan.table
    friction_of = context.job.physics.friction_of if table and context.job.physics.varies else lambda _: None
    posed = [both for both in zip(scene.plan.objects, scene.settled, strict=True) if not both[0].is_clutter]
    bodies = [body_columns(start, rest, friction_of(start.asset.category)) for start, rest in posed]
    return {
        "scene_id": scene.plan.scene_id,
        "table_id": None if table is None else table.asset.instance_id,
        "T_world_table": None if table is None else matrix_column(table.T_world_table),
        "pose": context.job.start.pose if context.job.scenes_from is None else "as_given",
        "effects": ran,
        "skipped": skipped,
        **columns_of_bodies(bodies),
        "settle_s": None if table is None else max(rest.settle_s for rest in scene.settled),
        "raycast_checked": scene.raycast_checked,
        "settings_digest": context.settings_digest,
        "bodies": bodies,
        "surroundings": surroundings_column(scene, context.job),
        "capture": None,
    }


def view_row(scene_id: int, pair: Pair, view: View, files: Sequence[EncodedFile], job: Job) -> Row:
    """The row of `views`, key (pose_id, role); the category is the first object's."""
    labels = object_labels(view, pair)
    projected = view.role == "projected"
    agreement = pair.agreement if view.role == "mirror" else None
    return {
        "pose_id": view.pose_id,
        "parent_id": view.parent_id,
        "role": view.role,
        "number": view.number,
        "scene_id": scene_id,
        "category": labels[0].category,
        **camera_columns(view.camera),
        "inclination_rad": inclination(view.camera.T_world_cam),
        "yaw_rad": yaw(view.camera.T_world_cam),
        "depth_units_per_m": job.images.depth_units_per_m,
        "d_z_m": pair.d_z_m,
        "files": [file_columns(file) for file in files],
        "object_pixels": None if projected else sum(label.pixels for label in labels),
        "visible_fraction": None if projected else labels[0].visible_fraction,
        "mirror_agreement": None
        if agreement is None or agreement.median_mm is None
        else {"median_mm": agreement.median_mm, "share": agreement.share},
        "projected_filled_share": pair.filled_share if projected else None,
        "projected_hidden_share": pair.hidden_share if projected else None,
        "patch_object_fraction": None
        if projected or view.number is not None
        else patch_object_fraction(view, labels[0], job.images.patch),
        "capture": None,
    }


def object_rows(scene_id: int, view: View, job: Job, things: Sequence[Placed]) -> list[Row]:
    """The rows of `objects`, key (pose_id, role, region_id); the table has one too. `things` are those that can be seen."""
    shapes = {thing.region_id: thing.shape for thing in things}
    return [
        {
            "pose_id": view.pose_id,
            "role": view.role,
            "number": view.number,
            "scene_id": scene_id,
            **label_columns(label),
            "patch_object_fraction": None
            if label.region_id < REGION_FIRST_OBJECT
            else patch_object_fraction(view, label, job.images.patch),
            **target_columns(view, label, shapes[label.region_id], job.captures is not None),
        }
        for label in view.labels
    ]


def target_columns(view: View, label: ObjectLabel, shape: Shape, captured: bool) -> Row:
    """Columns of `objects` of the image targets that there are; of the table, and without any, all are null."""
    columns: Row = dict.fromkeys(TARGET_COLUMNS)
    images = view.further
    if label.region_id < REGION_FIRST_OBJECT:
        return columns
    if "amodal" in images:
        columns |= amodal_columns(images["amodal"][label.region_id - REGION_FIRST_OBJECT])
    if "coordinates" in images:
        scale, offset = coordinate_scale(shape)
        columns |= {"coordinates_scale_m": scale, "coordinates_offset_m": offset.tolist()}
    if captured and (drawn := [images[name] for name in ("normals", "coordinates") if name in images]):
        here = drawn[0][view.region == label.region_id].any(axis=1)
        columns["targets_share"] = float(here.mean()) if len(here) else None
    return columns


TARGET_COLUMNS = ("amodal_bbox_xywh", "amodal_pixels", "coordinates_scale_m", "coordinates_offset_m", "targets_share")


def amodal_columns(mask: NDArray[np.uint8]) -> Row:
    """The extent of a silhouette [H, W] of 255."""
    whole = measure_regions(mask)[255]
    return {"amodal_bbox_xywh": list(whole.bbox_xywh), "amodal_pixels": whole.pixels}


def asset_row(asset: Asset, job: Job, samples: StoredSamples = NO_SAMPLES) -> Row:
    """The row of `assets`."""
    return {
        **{name: getattr(asset, name) for name in ASSET_COLUMNS},
        "extents_m": [float(x) for x in asset.extents_m],
        "T_source_to_object": matrix_column(asset.T_source_to_object),
        "split": job.assets.split.of(asset.instance_id),
        "notes": [*asset.notes, *samples.notes],
        "samples": samples.column,
    }


def failed_scene(scene_id: int, category: str, error: SceneError, attempts: int = 1) -> SceneOutput:
    """The output of a scene that cannot be made: no files, one row in `failures`."""
    columns = {name: getattr(error, name) for name in ("stage", "kind", "reason", "detail")}
    row: Row = {"scene_id": scene_id, "category": category, **columns, "attempts": attempts}
    return SceneOutput(scene_id, (), {"failures": [row]})


def timing_row(scene_id: int, category: str, watch: Stopwatch) -> Row:
    """The row of `timings`, which alone is no function of job and seed."""
    stages, effects = (
        [{"name": name, "seconds": seconds} for name, seconds in clock.items()]
        for clock in (watch.seconds, watch.effects)
    )
    return {
        "scene_id": scene_id,
        "category": category,
        "stages": stages,
        "effects": effects,
        "total_s": sum(watch.seconds.values()),
    }
