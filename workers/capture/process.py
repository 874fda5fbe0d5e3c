"""A capture's folder from photographs to poses, masks, cloud and mesh, written beside them: the list of steps."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from schemas.capture import CaptureCamera, CaptureEstimate, Estimates, ViewEstimate
from schemas.dataset.codec import Row, camera_columns
from schemas.job.captures import Captures
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import CaptureFolder, describe_camera, open_folder, pose_text
from workers.capture.reconstruct import Given, Merged, ProcessorClock, corrections_of, estimate_surface, given_files
from workers.capture.results import CLOUD_FILE, MESH_FILE, POSES_FILE, cloud_ply, mesh_ply, write_results
from workers.capture.surface.object_mask import silhouette
from workers.capture.surface.posed_view import distort_mask
from workers.store.images import encode_mask

_f64, _i64, _str = pa.float64(), pa.int64(), pa.string()
_matrix = pa.list_(pa.field("item", _f64, nullable=False), 16)

SCHEMA = pa.schema(
    [
        pa.field("number", _i64, False),
        pa.field("estimate", _str, False),
        pa.field("chosen", pa.bool_(), False),
        pa.field("status", _str, False),
        pa.field("reasons", pa.list_(_str), False),
        pa.field("T_world_cam", _matrix, True),
        *(pa.field(name, _i64, False) for name in ("width", "height")),
        *(pa.field(name, _f64, False) for name in ("fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv")),
        pa.field("markers", _i64, False),
        *(
            pa.field(name, _f64)
            for name in ("reprojection_before_px", "reprojection_px", "depth_before_mm", "depth_mm")
        ),
        *(pa.field(name, _f64) for name in ("sigma_mm", "sigma_deg")),
    ]
)
"""Camera columns are those of the table `views` of a dataset, the board frame being the world; `before` is by markers alone.

T_world_cam is null where no pose could be estimated; sigma_mm, sigma_deg are the largest standard deviation of the camera's
place and direction in any direction.
"""


def pose_rows(estimates: Estimates, camera: CaptureCamera) -> list[Row]:
    """The rows in order of estimate and number."""
    before = estimates.by_markers
    return [
        _row(view, before.get(view.number), camera) | {"estimate": name, "chosen": name == estimates.chosen}
        for name, estimate in estimates.by_name.items()
        for view in estimate.views
    ]


def pose_table(estimates: Estimates, camera: CaptureCamera) -> bytes:
    """The rows as a Parquet file."""
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(pose_rows(estimates, camera), SCHEMA), sink, compression="zstd")
    return sink.getvalue()


def _row(view: ViewEstimate, before: ViewEstimate | None, camera: CaptureCamera) -> Row:
    T = np.eye(4) if view.T_board_cam is None else view.T_board_cam
    columns = camera_columns(Camera(camera.intrinsics, T))
    if view.T_board_cam is None:
        columns["T_world_cam"] = None
    sigma_mm, sigma_deg = _sigmas(view)
    return {
        **columns,
        "number": view.number,
        "status": view.status,
        "reasons": list(view.reasons),
        "markers": view.markers,
        "reprojection_before_px": None if before is None else before.reprojection_px,
        "reprojection_px": view.reprojection_px,
        "depth_before_mm": None if before is None else before.depth_mm,
        "depth_mm": view.depth_mm,
        "sigma_mm": sigma_mm,
        "sigma_deg": sigma_deg,
    }


def _sigmas(view: ViewEstimate) -> tuple[float | None, float | None]:
    if view.covariance is None:
        return None, None
    place, turn = (
        float(np.linalg.eigvalsh(block).max()) for block in (view.covariance[:3, :3], view.covariance[3:, 3:])
    )
    return 1e3 * float(np.sqrt(max(place, 0.0))), float(np.degrees(np.sqrt(max(turn, 0.0))))


@dataclass(frozen=True, eq=False)
class ProcessedFolder:
    """What processing found and wrote; `users`: files that the user gave and that stayed."""

    folder: CaptureFolder
    estimates: Estimates
    merged: Merged
    seconds: Mapping[str, float]
    users: tuple[str, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user must know of poses and surface."""
        return self.estimates.estimate.notes


def process_folder(path: Path, captures: Captures) -> ProcessedFolder:
    """Estimates poses, merges the views and writes the results into the folder.

    Started again on the same folder it writes the same bytes, but for the seconds in process.json. Raises CaptureError where
    the capture cannot be used; nothing is written then.
    """
    watch = ProcessorClock()
    with watch.stage("read"):
        folder = open_folder(path)
        given = given_files(folder, captures.estimation)
    estimates, merged = estimate_surface(given, captures, watch)
    with watch.stage("masks"):
        files = {**_pose_files(given, estimates), **_mask_files(given, estimates.estimate, merged.body)}
    surface = merged.surface
    with watch.stage("encode"):
        files[CLOUD_FILE] = cloud_ply(surface.points, surface.normals, surface.colors, surface.views)
        files[MESH_FILE] = mesh_ply(surface.vertices, surface.faces, surface.vertex_colors)
        files[POSES_FILE] = pose_table(estimates, given.folder.camera)
    seconds = {name: round(s, 3) for name, s in _all_seconds(estimates, watch).items()}
    masks = [f"mask_{number:05d}.png" for number in folder.numbers if given.has_mask(number)]
    stayed = write_results(
        path, files, _record(captures, estimates, merged, given.folder.camera) | {"seconds": seconds}
    )
    return ProcessedFolder(folder, estimates, merged, seconds, tuple(sorted([*stayed, *masks])))


def _pose_files(given: Given, estimates: Estimates) -> dict[str, bytes]:
    """board_ and correction_ files of every view with a pose."""
    files = {}
    for number, (board, correction) in corrections_of(given, estimates).items():
        files[f"board_{number:05d}.txt"] = pose_text(board).encode()
        files[f"correction_{number:05d}.txt"] = pose_text(correction).encode()
    return files


def _mask_files(given: Given, estimate: CaptureEstimate, body: Mesh) -> dict[str, bytes]:
    """mask_ files of every view with a pose and without a mask of the user's, as the lens draws them."""
    camera, files = given.folder.camera, {}
    for view in estimate.views:
        if view.T_board_cam is not None and not given.has_mask(view.number):
            mask = silhouette(body, Camera(camera.intrinsics, view.T_board_cam))
            files[f"mask_{view.number:05d}.png"] = encode_mask(distort_mask(mask, camera))
    return files


def _all_seconds(estimates: Estimates, watch: ProcessorClock) -> dict[str, float]:
    """Seconds of processor time by stage, those of the estimates in place of their sum."""
    own: dict[str, float] = {f"poses_{name}": s for name, s in estimates.seconds.items()}
    for name, estimate in estimates.by_name.items():
        own[f"poses_{name}"] = sum(estimate.seconds.values())
    rest = {name: s for name, s in watch.seconds.items() if name != "estimate"}
    return {**own, **rest, "total": sum(watch.seconds.values())}


def _record(captures: Captures, estimates: Estimates, merged: Merged, camera: CaptureCamera) -> dict[str, Any]:
    """process.json without the seconds and the files."""
    chosen, region = estimates.estimate, merged.region
    depth = chosen.depth
    return {
        "settings": captures.model_dump(mode="json", include={"estimation", "fusion", "synthesis"}),
        "camera": describe_camera(camera).model_dump(mode="json"),
        "estimate": chosen.estimate,
        "views": [
            {"number": view.number, "status": view.status, "reasons": list(view.reasons)} for view in chosen.views
        ],
        "depth": {
            "offset_m": depth.offset_m,
            "scale": depth.scale,
            "T_cam_depth": depth.T_cam_depth.tolist(),
            "identified": list(depth.identified),
        },
        "print_scale": chosen.print_scale,
        "board_as_measured": {
            "plane": list(region.plane),
            "spread_m": region.spread_m,
            "clearance_m": region.clearance_m,
        },
        "hidden_by_clearance": merged.hidden_share,
        "cloud_points": len(merged.surface.points),
        "mesh_faces": len(merged.surface.faces),
        "notes": list(chosen.notes),
    }
