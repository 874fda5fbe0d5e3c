"""A capture from its folder to poses, surface and views from elsewhere."""

import numpy as np

from schemas.capture.estimate import CaptureEstimate, DepthCorrection
from schemas.capture.processed import PosedImages, ProcessedCapture
from schemas.job.captures import Captures
from schemas.scene.camera import Camera
from schemas.scene.shape import Mesh
from workers.capture.depth_fit import fit_depth
from workers.capture.fuse import fuse_views
from workers.capture.masks import down_to_board, silhouette
from workers.capture.object_region import find_object
from workers.capture.posed_view import PosedView, pose_view
from workers.capture.synthesize import synthesize_view
from workers.capture.warp import prepare_source
from workers.geometry.projection import forward_project
from workers.pipeline.captures.estimate import estimate_poses
from workers.pipeline.stopwatch import Stopwatch
from workers.store.capture_folder import CaptureFolder, read_view


def process_capture(folder: CaptureFolder, captures: Captures, watch: Stopwatch) -> ProcessedCapture:
    """Estimate, reconstruct, prepare the views, score where there is truth. Raises CaptureError where it cannot be used."""
    with watch.stage("estimate"):
        estimates = estimate_poses(folder, captures.estimation)
    with watch.stage("reconstruct"):
        posed = pose_views(folder, estimates.estimate)
        region = find_object(list(posed.values()), folder.board, captures.fusion)
        surface = fuse_views(list(posed.values()), region, captures.fusion)
        mesh = down_to_board(Mesh(surface.vertices, surface.faces), region)
    with watch.stage("prepare"):
        sources = [
            prepare_source(
                view,
                fit_depth(view.depth_m, view.depth_camera.intrinsics, captures.fusion.max_edge_deg),
                silhouette(mesh, view.depth_camera),
            )
            for view in posed.values()
        ]
    return ProcessedCapture(
        name=folder.about.name,
        category=folder.about.category,
        licence=folder.about.licence,
        board=folder.board,
        estimates=estimates,
        surface=surface,
        images=lambda number: stored_images(posed[number], mesh),
        synthesize=lambda camera: synthesize_view(sources, camera, captures.synthesis),
        undistorted=folder.camera.has_lens,
        depth_corrected=is_corrected(estimates.estimate.depth),
    )


def pose_views(folder: CaptureFolder, estimate: CaptureEstimate) -> dict[int, PosedView]:
    """The used views without their lens, by number."""
    posed = {}
    for view in estimate.used:
        assert view.T_board_cam is not None
        posed[view.number] = pose_view(read_view(folder, view.number), folder.camera, view.T_board_cam, estimate.depth)
    return posed


def stored_images(view: PosedView, mesh: Mesh) -> PosedImages:
    """The images of a captured view, all of its colour camera.

    Depth is what was measured, moved by the correction; where that moves the depth camera, pixels between its points are 0.
    """
    return PosedImages(view.number, view.camera, view.rgb, depth_of(view), silhouette(mesh, view.camera))


def depth_of(view: PosedView) -> np.ndarray:
    """[H, W] float64, metres: depth in the colour camera."""
    measured = view.depth_m.astype(np.float64)
    if np.array_equal(view.camera.T_world_cam, view.depth_camera.T_world_cam):
        return measured
    return forward_project(measured, view.depth_camera, Camera(view.camera.intrinsics, view.camera.T_world_cam)).depth_m


def is_corrected(depth: DepthCorrection) -> bool:
    """Whether an estimate changes what was measured."""
    return depth.offset_m != 0.0 or depth.scale != 1.0 or not np.array_equal(depth.T_cam_depth, np.eye(4))
