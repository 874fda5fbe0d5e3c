"""A processed capture read back from its folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture.estimate import CaptureEstimate, DepthCorrection, Reconstruction, ViewEstimate
from schemas.errors import CaptureError
from schemas.job.captures import Captures
from schemas.scene.shape import Mesh
from workers.capture.masks import down_to_board
from workers.capture.object_region import Ground
from workers.pipeline.captures.corrections import given_files
from workers.pipeline.captures.views import CaptureViews
from workers.store.capture_folder import CaptureFolder, open_folder, read_pose
from workers.store.capture_results import PROCESS_FILE, read_cloud, read_mesh, read_record


@dataclass(frozen=True, eq=False)
class StoredResult:
    """The folder, the settings it was processed with, the estimate with its final poses, the surface, and its views."""

    folder: CaptureFolder
    captures: Captures
    estimate: CaptureEstimate
    surface: Reconstruction
    views: CaptureViews


def read_result(path: Path) -> StoredResult:
    """What processing wrote. Raises CaptureError where the folder was not processed, or a file is missing or damaged."""
    folder, record = open_folder(path), read_record(path)
    if record is None:
        raise CaptureError("not_processed", f"{path} was not processed: run `verso capture process {path}`")
    try:
        captures = Captures.model_validate(record["settings"])
        estimate = _estimate(path, record)
        ground = Ground(tuple(record["board_as_measured"]["plane"]), float(record["board_as_measured"]["clearance_m"]))
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError("unreadable", f"{path / PROCESS_FILE} is damaged ({error!r}): process it again") from error
    points, normals, colors, views = read_cloud(path)
    vertices, faces, vertex_colors = read_mesh(path)
    surface = Reconstruction(points, normals, colors, views, vertices, faces, vertex_colors)
    body = down_to_board(Mesh(vertices, faces), ground)
    return StoredResult(
        folder, captures, estimate, surface, CaptureViews(given_files(folder), estimate, captures, body)
    )


def _estimate(path: Path, record: dict[str, Any]) -> CaptureEstimate:
    depth = record["depth"]
    correction = DepthCorrection(
        float(depth["offset_m"]), float(depth["scale"]), frozen_array(depth["T_cam_depth"]), tuple(depth["identified"])
    )
    views = tuple(
        ViewEstimate(
            number=int(view["number"]),
            status=view["status"],
            T_board_cam=_final_pose(path, int(view["number"])),
            covariance=None,
            markers=0,
            reprojection_px=None,
            depth_mm=None,
            reasons=tuple(view["reasons"]),
        )
        for view in record["views"]
    )
    return CaptureEstimate(record["estimate"], views, correction, float(record["print_scale"]))


def _final_pose(path: Path, number: int) -> Pose | None:
    """correction · board, None where either file is missing."""
    board = read_pose(path / f"board_{number:05d}.txt")
    correction = read_pose(path / f"correction_{number:05d}.txt")
    return None if board is None or correction is None else frozen_array(np.asarray(correction @ board))
