"""The output of a capture: encoded files, and its rows in the tables that scenes have. Pure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.capture.estimate import CaptureEstimate
from schemas.capture.processed import ProcessedCapture, ViewScore
from schemas.dataset.codec import Row, matrix_column
from schemas.dataset.layout import asset_path
from schemas.dataset.tables import NOT_OF_CAPTURES
from schemas.scene.scene import EncodedFile, SceneOutput, encoded_file
from schemas.scene.view import Role
from workers.assets.catalogue import split_of
from workers.assets.glb import asset_glb
from workers.pipeline.captures.capture_pair import CapturedObject, CapturedPair
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.rows import asset_row, encode_view, object_rows, view_row
from workers.store.images import encode_png

SCORES = ("pose_mm", "pose_deg", "cloud_median_mm", "cloud_p95_mm", "completeness", "depth_median_mm")


@dataclass(frozen=True)
class Origin:
    """Where a capture came from.

    `simulated` inside the job; `input_sha256` of its folder, None where it was simulated; `skipped`: [{effect, why}].
    """

    simulated: bool
    input_sha256: str | None = None
    effects: tuple[str, ...] = ()
    skipped: tuple[Mapping[str, str], ...] = ()


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
    for one in pairs:
        if isinstance(one, LeftOut):
            left_out.append(one)
            continue
        shares += [one.mirror.measured_share] if one.mirror is not None else []
        with watch.stage("encode"):
            for view in one.pair.views:
                own = encode_view(view, one.pair, job.images)
                files += own
                row = view_row(scene_id, one.pair, view, own, job)
                views.append(row | {"capture": view_columns(done, one, view.role)})
                objects += object_rows(scene_id, view, job)
    with watch.stage("encode"):
        path = asset_path(thing.asset.category, thing.asset.instance_id)
        files.append(encoded_file(path, asset_glb(thing.asset, encode_png)))
    split = split_of(done.name, job.assets.split)  # of the object: no capture of it may fall into another
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
        "skipped": [dict(one) for one in origin.skipped],
        "raycast_checked": False,
        "settings_digest": context.settings_digest,
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
        "left_out": [vars(one) for one in sorted([*refused, *left_out], key=lambda one: one.number)],
        "notes": list(chosen.notes),
        **{name: getattr(done.score, name) if done.score is not None else None for name in SCORES},
    }


def view_columns(done: ProcessedCapture, one: CapturedPair, role: Role) -> Row:
    """The column `capture` of `views`: residuals and errors of the captured view, and of what the mirror view is made."""
    estimate: CaptureEstimate = done.estimates.estimate
    own = next(view for view in estimate.views if view.number == one.number)
    before = done.estimates.by_markers.get(one.number)
    score = done.score.views.get(one.number, ViewScore()) if done.score is not None else ViewScore()
    made = one.mirror if role == "mirror" else None
    return {
        "number": one.number,
        "markers": own.markers,
        "reprojection_before_px": before.reprojection_px if before is not None else None,
        "reprojection_px": own.reprojection_px,
        "depth_mm": own.depth_mm,
        "pose_mm": score.pose_mm,
        "pose_deg": score.pose_deg,
        "measured_share": made.measured_share if made is not None else None,
        "depth_median_mm": score.depth_median_mm if role == "input" else None,
        "sources": list(made.sources) if made is not None else None,
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
