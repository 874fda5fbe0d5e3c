"""The stored result of a processed capture, and the files of views that are made from it.

- A processed capture read back from its folder.
- Files of synthesised views: pictures with the names that a capture's have, their poses, and views.json with the
  shares.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureEstimate, DepthCorrection, Reconstruction, SynthesizedView, ViewEstimate
from schemas.errors import CaptureError, OutputError, ViewError
from schemas.job.captures import Captures
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import CaptureFolder, open_folder, read_pose, write_pose
from workers.capture.reconstruct import given_files
from workers.capture.results import PROCESS_FILE, read_cloud, read_mesh, read_record
from workers.capture.surface.object_mask import Ground, down_to_board
from workers.capture.views import CaptureViews
from workers.geometry.pixels import round_depth
from workers.store.images import encode_mask, encode_png


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


FARTHEST_UNITS = 65_535.0


def write_synthesized(result: StoredResult, T_board_cam: Pose, out: Path, number: int = 0) -> dict[str, Any]:
    """The view from one pose. Returns what is said of it; raises CaptureError where nothing is seen from there."""
    camera = Camera(result.folder.camera.intrinsics, frozen_array(T_board_cam))
    return _finish(result, out, [_write(result, result.views.synthesize(camera), camera, out, number)])[0]


def write_mirrors(result: StoredResult, out: Path) -> list[dict[str, Any]]:
    """The mirror view of every used view, with the number of that view; views that see nothing of the object have none."""
    made = []
    for view in result.estimate.used:
        try:
            camera, d_z, shown = result.views.mirror(view.number)
        except (ViewError, CaptureError):
            continue
        made.append(_write(result, shown, camera, out, view.number) | {"d_z_m": d_z})
    return _finish(result, out, made)


def _write(result: StoredResult, view: SynthesizedView, camera: Camera, out: Path, number: int) -> dict[str, Any]:
    if out.resolve() == result.folder.path.resolve():
        raise OutputError(f"{out} is the capture itself: name another folder")
    out.mkdir(parents=True, exist_ok=True)
    units = result.folder.camera.depth_units_per_m
    depth = round_depth(view.depth_m, 0.0, FARTHEST_UNITS / units, units)
    (out / f"rgb_{number:05d}.png").write_bytes(encode_png(view.rgb))
    (out / f"depth_{number:05d}.png").write_bytes(encode_png(depth))
    (out / f"mask_{number:05d}.png").write_bytes(encode_mask(view.mask))
    (out / f"measured_{number:05d}.png").write_bytes(encode_mask(view.measured))
    write_pose(out / f"board_{number:05d}.txt", camera.T_world_cam)
    return {"name": f"{number:05d}", "measured_share": view.measured_share, "sources": list(view.sources)}


def _finish(result: StoredResult, out: Path, made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """views.json: the pinhole camera, pixel centres at 0.5, and what is said of each view."""
    if made:
        k = result.folder.camera.intrinsics
        camera = {**k.model_dump(), "pixel_centre": "0.5", "depth_units_per_m": result.folder.camera.depth_units_per_m}
        (out / "views.json").write_text(
            json.dumps({"camera": camera, "views": made}, indent=1) + "\n", encoding="utf-8"
        )
    return made
