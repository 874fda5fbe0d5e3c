"""The output of a capture: pairs of views with their regions, encoded files, and rows in the tables that scenes have."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose, frozen_array
from schemas.capture import PosedImages, ProcessedCapture, SynthesizedView, ViewScore
from schemas.dataset.codec import Row, matrix_column
from schemas.dataset.layout import asset_path, file_pose_id, input_pose_id
from schemas.dataset.tables import NOT_OF_CAPTURES
from schemas.job.captures import Board
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, EncodedFile, Placed, SceneOutput, encoded_file
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_NOTHING, REGION_TABLE, Asset
from schemas.scene.view import Camera, Pair, Role, View
from workers.assets.glb import asset_glb
from workers.capture.process import residual_columns
from workers.capture.surface.posed_view import pinhole_rays
from workers.geometry.pixels import quantise_depth
from workers.scene.cameras import place_mirror_camera
from workers.scene.context import WorkerContext
from workers.scene.labels import CountPixels, derive_projected, label_things, projection_shares
from workers.scene.pairs import object_distance
from workers.scene.rows import asset_row, encode_view, object_rows, view_row
from workers.stopwatch import Stopwatch
from workers.store.images import encode_png
from workers.targets.targets import draw_targets


def capture_regions(camera: Camera, board: Board, mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """[H, W] uint8: the object where `mask` is, the board where the ray through a pixel's centre meets it, else nothing.

    The camera's pose is in the board frame, so the board is the rectangle z = 0 about the origin, at the print's true
    size. Nothing means neither board nor object: what stands beside the board may have depth there.
    """
    k, T = camera.intrinsics, camera.T_world_cam
    half = 0.5 * board.scale * np.array([board.width_m, board.height_m])
    x, y = pinhole_rays(k, (k.height, k.width))
    rays = [T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] for axis in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = -T[2, 3] / rays[2]
        on_board = (T[2, 3] > 0.0) & (rays[2] < 0.0)  # from above
        for axis in (0, 1):
            on_board &= np.abs(T[axis, 3] + z * rays[axis]) <= half[axis]
    region = np.where(on_board, np.uint8(REGION_TABLE), np.uint8(REGION_NOTHING))
    region[mask] = REGION_FIRST_OBJECT
    return region


Synthesize = Callable[[Camera], SynthesizedView]


@dataclass(frozen=True, eq=False)
class CapturedObject:
    """The object of a capture on its board, in the board frame, which is the world of a capture.

    `effects` of the dataset's images that the job asks for.
    """

    scene_id: int
    asset: Asset
    T_world_obj: Pose
    board: Board
    board_asset: Asset
    effects: EffectPlan

    @property
    def things(self) -> tuple[Placed, Placed]:
        """Board and object where they are."""
        eye = np.eye(4)
        return (
            Placed(REGION_TABLE, self.board_asset.shape, eye),
            Placed(REGION_FIRST_OBJECT, self.asset.shape, self.T_world_obj),
        )


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """A pair as scenes have it; the number of its captured view, and its mirror view as it was made."""

    number: int
    pair: Pair
    mirror: SynthesizedView | None


def make_capture_pair(
    job: Job, thing: CapturedObject, images: PosedImages, at: int, synthesize: Synthesize, count: CountPixels
) -> CapturedPair:
    """The views of captured view `at` (its place among the used ones) that the job asks for.

    The mirror camera follows from the stored input depth as in scenes. Raises ViewError where the view has no depth of
    the object, CaptureError where no captured view shows anything to the mirror camera.
    """
    parent_id = input_pose_id(thing.scene_id, at, job.pairs_per_scene)
    assets = zip(thing.things, (thing.board_asset, thing.asset), strict=True)
    names = {placed.region_id: (asset.category, asset.instance_id) for placed, asset in assets}

    def view(role: Role, camera: Camera, made: PosedImages | SynthesizedView) -> View:
        region, depth = capture_regions(camera, thing.board, made.mask), quantise_depth(made.depth_m, job.images)
        if role == "mirror":
            region[depth == 0] = REGION_NOTHING
        labels = label_things(thing.things, names, camera, region, count)
        return View(role, file_pose_id(role, parent_id), parent_id, camera, made.rgb, depth, region, labels)

    first = view("input", images.camera, images)
    assert first.region is not None
    pair = Pair(object_distance(first.depth, first.region, job.images, job.cameras.mirror), first)
    if not thing.effects.runs("mirror"):
        return CapturedPair(images.number, pair, None)
    camera = place_mirror_camera(images.camera, pair.d_z_m, job.cameras.mirror)
    made = synthesize(camera)
    mirror = view("mirror", camera, made)
    # No agreement: which pixels are co-visible follows from normals, which the noise of measured depth turns about.
    pair = replace(pair, mirror=mirror)
    if thing.effects.runs("projection"):
        rgb, depth = derive_projected(first, camera, job.images, None, thing.effects)
        filled, hidden = projection_shares(depth, mirror.depth, job.images)
        projected = View("projected", first.pose_id, first.pose_id, camera, rgb, depth, None, ())
        pair = replace(pair, projected=projected, filled_share=filled, hidden_share=hidden)
    return CapturedPair(images.number, pair, made)


def with_targets(job: Job, thing: CapturedObject, made: CapturedPair, watch: Stopwatch) -> CapturedPair:
    """The pair with its image targets, of the merged mesh as its file has it, in float32: 0 where that has a hole."""
    board, body = thing.things
    # Faces of marching cubes are a micrometre narrow: rounding turns them by more than the steps of a stored normal.
    parts = (replace(part, vertices=frozen_array(np.float32(part.vertices))) for part in body.shape.parts)
    body = replace(body, shape=replace(body.shape, parts=tuple(parts)))
    # Its mask is a rectangle by rays: drawn a little larger, no pixel of its edge is without a face by a rounding.
    board = replace(board, T_world_shape=np.diag([1.01, 1.01, 1.0, 1.0]))

    def drawn(view: View) -> View:
        assert view.region is not None
        return replace(view, further=draw_targets((board, body), view.camera, view.region, job, thing.effects, watch))

    pair = made.pair
    mirror = None if pair.mirror is None else drawn(pair.mirror)
    return replace(made, pair=replace(pair, input=drawn(pair.input), mirror=mirror))


SCORES = ("pose_mm", "pose_deg", "cloud_median_mm", "cloud_p95_mm", "completeness", "depth_median_mm")


@dataclass(frozen=True)
class Origin:
    """A folder to process, the name of its object where the job knows it, and where it came from.

    `input_sha256` of the folder, None where it was simulated; `effects` that were simulated; `skipped`: [{effect, why}];
    `surroundings`: what was drawn of `look`.
    """

    path: Path
    name: str | None
    input_sha256: str | None
    effects: Sequence[str] = ()
    skipped: Sequence[Mapping[str, str]] = ()
    surroundings: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class LeftOut:
    """A view that is not stored, and why."""

    number: int
    status: str
    why: str


def record_capture(
    context: WorkerContext,
    thing: CapturedObject,
    done: ProcessedCapture,
    origin: Origin,
    pairs: Iterable[CapturedPair | LeftOut],
    watch: Stopwatch,
) -> SceneOutput:
    """Files and rows of a capture, without its timings. Pairs are encoded one by one, so that one at a time is in memory."""
    job, scene_id = context.job, thing.scene_id
    files: list[EncodedFile] = []
    views: list[Row] = []
    objects: list[Row] = []
    shares: list[float] = []
    left_out: list[LeftOut] = []
    for item in pairs:
        if isinstance(item, LeftOut):
            left_out.append(item)
            continue
        shares += [item.mirror.measured_share] if item.mirror is not None else []
        with watch.stage("encode"):
            for view in item.pair.views:
                encoded = encode_view(view, item.pair, job.images)
                files += encoded
                row = view_row(scene_id, item.pair, view, encoded, job)
                views.append(row | {"capture": view_columns(done, item, view.role)})
                objects += object_rows(scene_id, view, job, thing.things)
    with watch.stage("encode"):
        path = asset_path(thing.asset.category, thing.asset.instance_id)
        files.append(encoded_file(path, asset_glb(thing.asset, encode_png)))
    split = job.assets.split.of(done.name)  # of the object: no capture of it may fall into another
    rows = {
        "scenes": [scene_row(context, thing, done, origin, shares, left_out)],
        "views": views,
        "objects": objects,
        "assets": [asset_row(thing.board_asset, job), asset_row(thing.asset, job) | {"split": split}],
        "failures": [],
    }
    return SceneOutput(scene_id, tuple(files), rows)


def scene_row(
    context: WorkerContext,
    thing: CapturedObject,
    done: ProcessedCapture,
    origin: Origin,
    shares: Sequence[float],
    left_out: Sequence[LeftOut],
) -> Row:
    """The row of `scenes`: the board is the table, and the board frame the world."""
    absent: Row = dict.fromkeys(NOT_OF_CAPTURES)
    return {
        **absent,
        "scene_id": thing.scene_id,
        "category": thing.asset.category,
        "instance_id": thing.asset.instance_id,
        "source": thing.asset.source,
        "table_id": thing.board_asset.instance_id,
        "object_scale": thing.asset.scale,
        "T_world_obj": matrix_column(thing.T_world_obj),
        "T_world_table": matrix_column(np.eye(4)),
        "redraws": 0,
        "effects": [*origin.effects, *thing.effects.ran],
        "skipped": [dict(effect) for effect in origin.skipped],
        "raycast_checked": False,
        "settings_digest": context.settings_digest,
        "surroundings": origin.surroundings,
        "capture": quality_columns(done, origin, shares, left_out),
    }


def quality_columns(
    done: ProcessedCapture, origin: Origin, shares: Sequence[float], left_out: Sequence[LeftOut]
) -> Row:
    """The column `capture` of `scenes`: how well the poses fit, what was corrected, and the errors where truth is known."""
    chosen, used = done.estimates.estimate, done.estimates.estimate.used
    numbers = {view.number for view in used}
    refused = [
        LeftOut(view.number, view.status, "; ".join(view.reasons) or "no reason was given")
        for view in chosen.views
        if view.status != "used"
    ]
    return {
        "name": done.name,
        "estimate": chosen.estimate,
        "input_sha256": origin.input_sha256,
        "views": len(used) - len(left_out),
        "markers": sum(view.markers for view in used),
        "reprojection_before_px": _median(
            [view.reprojection_px for number, view in done.estimates.by_markers.items() if number in numbers]
        ),
        "reprojection_px": _median([view.reprojection_px for view in used]),
        "depth_mm": _median([view.depth_mm for view in used]),
        "depth_offset_m": chosen.depth.offset_m,
        "depth_scale": chosen.depth.scale,
        "print_scale": chosen.print_scale,
        "identified": list(chosen.depth.identified),
        "depth_corrected": done.depth_corrected,
        "undistorted": done.undistorted,
        "converged": chosen.converged,
        "iterations": chosen.iterations,
        "cloud_points": len(done.surface.points),
        "measured_share": _median(list(shares)),
        "left_out": [vars(view) for view in sorted([*refused, *left_out], key=lambda view: view.number)],
        "notes": list(chosen.notes),
        **{name: getattr(done.score, name) if done.score is not None else None for name in SCORES},
    }


def view_columns(done: ProcessedCapture, pair: CapturedPair, role: Role) -> Row:
    """The column `capture` of `views`: residuals and errors of the captured view, and of what the mirror view is made."""
    view = done.estimates.estimate.view(pair.number)
    score = done.score.views.get(pair.number, ViewScore()) if done.score is not None else ViewScore()
    made = pair.mirror if role == "mirror" else None
    return {
        **residual_columns(view, done.estimates.by_markers.get(view.number)),
        "pose_mm": score.pose_mm,
        "pose_deg": score.pose_deg,
        "measured_share": made.measured_share if made is not None else None,
        "depth_median_mm": score.depth_median_mm if role == "input" else None,
        "sources": list(made.sources) if made is not None else None,
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
