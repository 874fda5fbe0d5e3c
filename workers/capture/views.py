"""The views of a processed capture: captured ones without their lens, ones from elsewhere, and the files of the latter."""

import json
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureEstimate, DepthCorrection, PosedImages, Reconstruction, SynthesizedView, ViewEstimate
from schemas.errors import CaptureError, OutputError, ViewError
from schemas.job.captures import Captures
from schemas.job.views import Mirror
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import CameraFile, CaptureFolder, camera_of, open_folder, read_pose, write_pose
from workers.capture.reconstruct import Given, given_files, read_posed
from workers.capture.results import PROCESS_FILE, read_cloud, read_mesh, read_record
from workers.capture.surface.object_mask import Ground, down_to_board, silhouette
from workers.capture.surface.posed_view import PosedView
from workers.capture.surface.synthesize import Source, choose_sources, move_depth, prepare_source, synthesize_view
from workers.capture.surface.tsdf import MOST_EDGE_DEG, fit_depth
from workers.geometry.pixels import round_depth
from workers.scene.pairs import front_distance, place_mirror_camera
from workers.store.images import encode_mask, encode_png

KEPT = 12
"""Prepared views in memory, 40 MB each at 1920 x 1080: twice as many as one synthesised view needs."""


@dataclass(eq=False)
class CaptureViews:
    """Reads and prepares views when they are needed, and keeps the latest. `body` is the object down to the board."""

    given: Given
    estimate: CaptureEstimate
    captures: Captures
    body: Mesh
    _sources: OrderedDict[int, Source] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        self.cameras = {
            view.number: view.T_board_cam @ self.estimate.depth.T_cam_depth
            for view in self.estimate.used
            if view.T_board_cam is not None and self.folder.file("depth", view.number) is not None
        }
        """T_board_depth [4, 4] of the views that can be sources."""

    @property
    def folder(self) -> CaptureFolder:
        """Where the views are."""
        return self.given.folder

    def posed(self, number: int) -> PosedView:
        """A used view, read anew. Raises CaptureError."""
        return read_posed(self.given, self.estimate, number)

    def images(self, number: int) -> PosedImages:
        """A captured view: its picture without the lens, its depth in the same camera, the object's mask.

        Depth is what was measured, corrected. Where the correction moves the depth camera, depth is drawn anew from there.
        """
        view = self.posed(number)
        mask = silhouette(self.body, view.camera) if view.mask is None else view.mask
        depth_m = view.depth_m
        if not np.array_equal(view.camera.T_world_cam, view.depth_camera.T_world_cam):
            depth_m = move_depth(depth_m, view.depth_camera, view.camera)
        return PosedImages(number, view.camera, view.rgb, depth_m.astype(np.float64), mask)

    def synthesize(self, camera: Camera, without: int | None = None) -> SynthesizedView:
        """What `camera` sees, poses in the board frame; `without` names a view that must not be a source."""
        axes = {number: T[:3, 2] for number, T in self.cameras.items() if number != without}
        chosen = choose_sources(axes, camera, self.captures.synthesis)
        return synthesize_view([self._source(number) for number in chosen], camera, self.captures.synthesis)

    def mirror(self, number: int, mirror: Mirror | None = None) -> tuple[Camera, float, SynthesizedView]:
        """(camera, d_z in metres, view) from the other side of the object, half a turn about the board's normal.

        d_z comes from the object's own depth pixels. Raises ViewError where the view has none, CaptureError.
        """
        images = self.images(number)
        d_z = front_distance(images.depth_m, images.mask, mirror or Mirror())
        camera = place_mirror_camera(images.camera, d_z, mirror or Mirror())
        return camera, d_z, self.synthesize(camera)

    def _source(self, number: int) -> Source:
        if number not in self._sources:
            view = self.posed(number)
            fitted = fit_depth(view.depth_m, view.depth_camera.intrinsics, MOST_EDGE_DEG)
            self._sources[number] = prepare_source(view, fitted, silhouette(self.body, view.depth_camera))
            while len(self._sources) > max(KEPT, 2 * self.captures.synthesis.views):
                self._sources.popitem(last=False)
        self._sources.move_to_end(number)
        return self._sources[number]


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
        if captures.estimation.calibrate:
            folder = replace(folder, camera=camera_of(CameraFile.model_validate(record["camera"])))
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
        ViewEstimate(number, view["status"], _final_pose(path, number), None, 0, None, None, tuple(view["reasons"]))
        for view in record["views"]
        for number in [int(view["number"])]
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
