"""A capture's folder from photographs to poses, masks, cloud and mesh; the files that say so, read back; views from anywhere."""

import io
import json
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from schemas.base import Pose, frozen_array
from schemas.capture import (
    CaptureCamera,
    CaptureEstimate,
    DepthCorrection,
    Estimates,
    PosedImages,
    Reconstruction,
    SynthesizedView,
    ViewEstimate,
)
from schemas.dataset.codec import Row, camera_columns
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CaptureError, OutputError, ViewError, command_line
from schemas.job.cameras import Mirror
from schemas.job.captures import Captures
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from workers.capture.folder import (
    CameraFile,
    CaptureFolder,
    camera_of,
    describe_camera,
    open_folder,
    pose_text,
    stored_depth,
    write_pose,
)
from workers.capture.reconstruct import (
    Given,
    Merged,
    corrections_of,
    estimate_surface,
    given_files,
    processor_clock,
    read_posed,
)
from workers.capture.results import (
    CLOUD_FILE,
    MESH_FILE,
    POSES_FILE,
    PROCESS_FILE,
    cloud_ply,
    mesh_ply,
    read_record,
    read_surface,
    write_results,
)
from workers.capture.surface.object_mask import Ground, down_to_board, silhouette
from workers.capture.surface.posed_view import PosedView, distort_mask
from workers.capture.surface.synthesize import Source, choose_sources, color_depth, prepare_source, synthesize_view
from workers.capture.surface.tsdf import fit_depth
from workers.scene.cameras import place_mirror_camera
from workers.scene.pairs import front_distance
from workers.stopwatch import Stopwatch
from workers.store.images import encode_mask, encode_png

_CAMERA = ("T_world_cam", "width", "height", "fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv")
_RESIDUALS = ("reprojection_before_px", "reprojection_px", "depth_before_mm", "depth_mm", "sigma_mm", "sigma_deg")

SCHEMA = pa.schema(
    [
        *(("number", pa.int64()), ("estimate", pa.string()), ("chosen", pa.bool_()), ("status", pa.string())),
        ("reasons", pa.list_(pa.string())),
        ("cluttered", pa.bool_()),
        *((name, SCHEMAS["views"].field(name).type) for name in _CAMERA),
        ("markers", pa.int64()),
        *((name, pa.float64()) for name in _RESIDUALS),
    ]
)
"""Camera columns are those of the table `views` of a dataset, the board frame being the world; `before` is by markers alone.

T_world_cam is null where no pose could be estimated; sigma_mm, sigma_deg are the largest standard deviation of the camera's
place and direction in any direction.
"""


def residual_columns(view: ViewEstimate, before: ViewEstimate | None) -> Row:
    """The columns of a view's residuals that poses.parquet and the table `views` of a dataset share."""
    return {
        "number": view.number,
        "markers": view.markers,
        "reprojection_before_px": before.reprojection_px if before is not None else None,
        "reprojection_px": view.reprojection_px,
        "depth_mm": view.depth_mm,
    }


def pose_table(estimates: Estimates, camera: CaptureCamera) -> bytes:
    """A Parquet file with a row for each estimate and view, in this order."""
    rows = [
        _pose_row(view, estimates.by_markers.get(view.number), camera)
        | {"estimate": name, "chosen": name == estimates.chosen}
        for name, estimate in estimates.by_name.items()
        for view in estimate.views
    ]
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, SCHEMA), sink, compression="zstd")
    return sink.getvalue()


def _pose_row(view: ViewEstimate, before: ViewEstimate | None, camera: CaptureCamera) -> Row:
    pose = np.eye(4) if view.T_board_cam is None else view.T_board_cam
    row = {**camera_columns(Camera(camera.intrinsics, pose)), **residual_columns(view, before)}
    row |= {
        "status": view.status,
        "reasons": view.reasons,
        "cluttered": view.is_cluttered,
        "depth_before_mm": before.depth_mm if before else None,
    }
    if view.T_board_cam is None:
        row["T_world_cam"] = None
    if view.covariance is not None:
        place, turn = (np.linalg.eigvalsh(view.covariance[part, part]).max() for part in (np.s_[:3], np.s_[3:]))
        row |= {"sigma_mm": 1e3 * max(place, 0.0) ** 0.5, "sigma_deg": float(np.degrees(max(turn, 0.0) ** 0.5))}
    return row


def read_poses(path: Path) -> tuple[ViewEstimate, ...]:
    """The views of the chosen estimate in a folder's poses.parquet, without their covariances. Raises CaptureError."""
    try:
        rows = pq.read_table(path / POSES_FILE, schema=SCHEMA).to_pylist()
    except FileNotFoundError:
        words = f"{path / POSES_FILE} is not there: run `{command_line('capture', 'process', path)}`"
        raise CaptureError("not_processed", words) from None
    except (pa.ArrowException, OSError) as error:
        raise CaptureError("unreadable", f"{path / POSES_FILE} is damaged: process the capture again") from error
    return tuple(
        ViewEstimate(
            number=row["number"],
            status=row["status"],
            T_board_cam=None if row["T_world_cam"] is None else frozen_array(row["T_world_cam"]).reshape(4, 4),
            covariance=None,
            markers=row["markers"],
            reprojection_px=row["reprojection_px"],
            depth_mm=row["depth_mm"],
            reasons=tuple(row["reasons"]),
            is_cluttered=bool(row["cluttered"]),
        )
        for row in rows
        if row["chosen"]
    )


@dataclass(frozen=True, eq=False)
class ProcessedFolder:
    """What processing made and wrote; `users`: files that the user gave and that stayed."""

    estimates: Estimates
    merged: Merged
    seconds: Mapping[str, float]
    users: tuple[str, ...]


def process_folder(path: Path, captures: Captures) -> ProcessedFolder:
    """Estimates poses, merges the views and writes the results into the folder.

    Started again on the same folder it writes the same bytes, but for the seconds in process.json. Raises CaptureError where
    the capture cannot be used; nothing is written then.
    """
    watch = processor_clock()
    with watch.stage("read"):
        given = given_files(open_folder(path), captures.estimation)
    estimates, merged = estimate_surface(given, captures, watch)
    with watch.stage("masks"):
        files = _view_files(given, estimates, merged.body)
    surface = merged.surface
    with watch.stage("encode"):
        files[CLOUD_FILE] = cloud_ply(surface)
        files[MESH_FILE] = mesh_ply(surface)
        files[POSES_FILE] = pose_table(estimates, given.folder.camera)
    seconds = {name: round(s, 3) for name, s in _all_seconds(estimates, watch).items()}
    masks = [f"mask_{number:05d}.png" for number in given.folder.numbers if given.has_mask(number)]
    record = _record(captures, estimates.estimate, merged, given.folder.camera) | {"seconds": seconds}
    stayed = write_results(path, files, record)
    return ProcessedFolder(estimates, merged, seconds, tuple(sorted([*stayed, *masks])))


def _view_files(given: Given, estimates: Estimates, body: Mesh) -> dict[str, bytes]:
    """board_ and correction_ files of every view with a pose; mask_ files, as the lens draws them, where the user has none."""
    camera, files = given.folder.camera, {}
    for number, (board, correction) in corrections_of(given, estimates).items():
        files[f"board_{number:05d}.txt"] = pose_text(board).encode()
        files[f"correction_{number:05d}.txt"] = pose_text(correction).encode()
        if not given.has_mask(number):
            hides = estimates.estimate.view(number).is_cluttered
            depth_m = color_depth(read_posed(given, estimates.estimate, number)) if hides else None
            mask = silhouette(body, Camera(camera.intrinsics, correction @ board), depth_m)
            files[f"mask_{number:05d}.png"] = encode_mask(distort_mask(mask, camera))
    return files


def _all_seconds(estimates: Estimates, watch: Stopwatch) -> dict[str, float]:
    """Seconds of processor time by stage, those of the estimates in place of their sum."""
    seconds: dict[str, float] = {f"poses_{name}": s for name, s in estimates.seconds.items()}
    for name, estimate in estimates.by_name.items():
        seconds[f"poses_{name}"] = sum(estimate.seconds.values())
    rest = {name: s for name, s in watch.seconds.items() if name != "estimate"}
    return {**seconds, **rest, "total": sum(watch.seconds.values())}


def _record(captures: Captures, chosen: CaptureEstimate, merged: Merged, camera: CaptureCamera) -> dict[str, Any]:
    """process.json without the seconds and the files."""
    region = merged.region
    return {
        "settings": captures.model_dump(mode="json", include={"estimation", "fusion", "synthesis"}),
        "camera": describe_camera(camera).model_dump(mode="json"),
        "estimate": chosen.estimate,
        "depth": vars(chosen.depth) | {"T_cam_depth": chosen.depth.T_cam_depth.tolist()},
        "print_scale": chosen.print_scale,
        "board_as_measured": {name: getattr(region, name) for name in ("plane", "spread_m", "clearance_m")},
        "hidden_by_clearance": merged.hidden_share,
        "cloud_points": len(merged.surface.points),
        "mesh_faces": len(merged.surface.faces),
        "notes": list(chosen.notes),
    }


KEPT = 12
"""Prepared views in memory, 40 MB each at 1920 x 1080: twice as many as one synthesised view needs."""


@dataclass(eq=False)
class CaptureViews:
    """A processed capture: the final poses, the surface, and `body`, the object down to the board.

    Views are read and prepared when they are needed, and the latest are kept.
    """

    given: Given
    captures: Captures
    estimate: CaptureEstimate
    surface: Reconstruction
    body: Mesh
    _sources: OrderedDict[int, Source] = field(init=False, default_factory=OrderedDict)

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

        Depth is what was measured, corrected; what hides the object of a cluttered view is no part of its mask.
        """
        view = self.posed(number)
        depth_m, mask = color_depth(view), view.mask
        if mask is None:
            mask = silhouette(self.body, view.camera, depth_m if self.estimate.view(number).is_cluttered else None)
        return PosedImages(number, view.camera, view.rgb, depth_m.astype(np.float64), mask)

    def synthesize(self, camera: Camera, without: int | None = None) -> SynthesizedView:
        """What `camera` sees, poses in the board frame; `without` names a view that must not be a source."""
        axes = {number: T[:3, 2] for number, T in self.cameras.items() if number != without}
        chosen = choose_sources(axes, camera, self.captures.synthesis)
        return synthesize_view([self._source(number) for number in chosen], camera, self.body)

    def mirror(self, number: int) -> tuple[Camera, float, SynthesizedView]:
        """(camera, d_z in metres, view) from the other side of the object, half a turn about the board's normal.

        d_z comes from the object's own depth pixels. Raises ViewError where the view has none, CaptureError.
        """
        images = self.images(number)
        d_z = front_distance(images.depth_m, images.mask, Mirror())
        camera = place_mirror_camera(images.camera, d_z, Mirror())
        return camera, d_z, self.synthesize(camera)

    def _source(self, number: int) -> Source:
        if number not in self._sources:
            view = self.posed(number)
            fitted = fit_depth(view.depth_m, view.depth_camera.intrinsics)
            self._sources[number] = prepare_source(view, fitted)
            while len(self._sources) > max(KEPT, 2 * self.captures.synthesis.views):
                self._sources.popitem(last=False)
        self._sources.move_to_end(number)
        return self._sources[number]


def read_result(path: Path) -> CaptureViews:
    """What processing wrote. Raises CaptureError where the folder was not processed, or a file is missing or damaged."""
    folder, record = open_folder(path), read_record(path)
    if record is None:
        raise CaptureError(
            "not_processed", f"{path} was not processed: run `{command_line('capture', 'process', path)}`"
        )
    try:
        captures = Captures.model_validate(record["settings"])
        if captures.estimation.calibrate:
            folder = replace(folder, camera=camera_of(CameraFile.model_validate(record["camera"])))
        depth, board = record["depth"], record["board_as_measured"]
        correction = DepthCorrection(
            float(depth["offset_m"]),
            float(depth["scale"]),
            frozen_array(depth["T_cam_depth"]),
            tuple(depth["identified"]),
        )
        ground = Ground(tuple(board["plane"]), float(board["clearance_m"]))
        estimate = CaptureEstimate(record["estimate"], read_poses(path), correction, float(record["print_scale"]))
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError("unreadable", f"{path / PROCESS_FILE} is damaged ({error!r}): process it again") from error
    surface = read_surface(path)
    body = down_to_board(Mesh(surface.vertices, surface.faces), ground)
    return CaptureViews(given_files(folder), captures, estimate, surface, body)


def write_synthesized(result: CaptureViews, T_board_cam: Pose, out: Path) -> dict[str, Any]:
    """The view from one pose. Returns what is said of it; raises CaptureError where nothing is seen from there."""
    camera = Camera(result.folder.camera.intrinsics, frozen_array(T_board_cam))
    return _write_views(result, out, [(0, camera, result.synthesize(camera), {})])[0]


@contextmanager
def unless_unseen() -> Iterator[None]:
    """Passes over a view that sees nothing of the object or has no depth; what is damaged is told."""
    try:
        yield
    except ViewError:
        return
    except CaptureError as error:
        if error.reason not in ("nothing_seen", "no_depth"):
            raise


def write_mirrors(result: CaptureViews, out: Path) -> list[dict[str, Any]]:
    """The mirror view of every used view, with the number of that view; views that see nothing of the object have none."""

    def mirrors() -> Iterator[Written]:
        for view in result.estimate.used:
            with unless_unseen():
                camera, d_z, shown = result.mirror(view.number)
                yield view.number, camera, shown, {"d_z_m": d_z}

    return _write_views(result, out, mirrors())


Written = tuple[int, Camera, SynthesizedView, dict[str, Any]]
"""A view's number, its camera, what it shows, and what else is said of it."""


def _write_views(result: CaptureViews, out: Path, views: Iterable[Written]) -> list[dict[str, Any]]:
    """The files of views, made one by one, and views.json: the pinhole camera, pixel centres at 0.5, and what is said of each."""
    if out.resolve() == result.folder.path.resolve():
        raise OutputError(f"{out} is the capture itself: name another folder")
    units, said = result.folder.camera.depth_units_per_m, []
    for number, camera, view, more in views:
        out.mkdir(parents=True, exist_ok=True)
        files = {"rgb": encode_png(view.rgb), "depth": encode_png(stored_depth(view.depth_m, units))}
        files |= {"mask": encode_mask(view.mask), "measured": encode_mask(view.measured)}
        for kind, data in files.items():
            (out / f"{kind}_{number:05d}.png").write_bytes(data)
        write_pose(out / f"board_{number:05d}.txt", camera.T_world_cam)
        share = {"measured_share": view.measured_share, "sources": list(view.sources)}
        said.append({"name": f"{number:05d}"} | share | more)
    if said:
        pinhole = result.folder.camera.intrinsics.model_dump()
        described = {"camera": {**pinhole, "pixel_centre": "0.5", "depth_units_per_m": units}, "views": said}
        (out / "views.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return said
