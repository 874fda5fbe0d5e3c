"""A capture from its folder to poses, surface and views from elsewhere, without writing anything into the folder."""

import numpy as np

from schemas.capture.estimate import CaptureEstimate, DepthCorrection
from schemas.capture.processed import CaptureScore, ProcessedCapture
from schemas.job.captures import Captures
from workers.pipeline.captures.corrections import given_files
from workers.pipeline.captures.estimate_surface import estimate_surface
from workers.pipeline.captures.reconstruct import Merged
from workers.pipeline.captures.score import read_whole_truth, score_capture
from workers.pipeline.captures.views import CaptureViews
from workers.scene.context import Stopwatch
from workers.store.capture_folder import CaptureFolder


def process_capture(folder: CaptureFolder, captures: Captures, watch: Stopwatch) -> ProcessedCapture:
    """Estimate, merge, score where there is truth. Raises CaptureError where the capture cannot be used."""
    with watch.stage("read"):
        given = given_files(folder)
    estimates, merged = estimate_surface(given, captures, watch)
    views = CaptureViews(given, estimates.estimate, captures, merged.body)
    with watch.stage("score"):
        score = score_against_truth(folder, estimates.estimate, merged, views)
    return ProcessedCapture(
        name=folder.about.name,
        category=folder.about.category,
        licence=folder.about.licence,
        board=folder.board,
        estimates=estimates,
        surface=merged.surface,
        images=views.images,
        synthesize=views.synthesize,
        undistorted=folder.camera.has_lens,
        depth_corrected=is_corrected(estimates.estimate.depth),
        score=score,
    )


def score_against_truth(
    folder: CaptureFolder, estimate: CaptureEstimate, merged: Merged, views: CaptureViews
) -> CaptureScore | None:
    """The errors of a simulated capture, None of a real one."""
    truth = read_whole_truth(folder)
    return None if truth is None else score_capture(estimate, merged.surface, views, truth).summary


def is_corrected(depth: DepthCorrection) -> bool:
    """Whether an estimate changes what was measured."""
    return depth.offset_m != 0.0 or depth.scale != 1.0 or not np.array_equal(depth.T_cam_depth, np.eye(4))
