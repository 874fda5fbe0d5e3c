"""A capture from its folder to poses, surface and views from elsewhere."""

from dataclasses import replace

import numpy as np

from schemas.capture.estimate import DepthCorrection, Estimates
from schemas.capture.processed import ProcessedCapture
from schemas.job.captures import Captures
from workers.pipeline.captures.corrections import correct_manually, given_files
from workers.pipeline.captures.estimate import estimate_poses
from workers.pipeline.captures.reconstruct import reconstruct
from workers.pipeline.captures.score import read_whole_truth, score_capture
from workers.pipeline.captures.views import CaptureViews
from workers.pipeline.stopwatch import Stopwatch
from workers.store.capture_folder import CaptureFolder


def process_capture(folder: CaptureFolder, captures: Captures, watch: Stopwatch) -> ProcessedCapture:
    """Estimate, reconstruct, prepare the views, score where there is truth. Raises CaptureError where it cannot be used."""
    with watch.stage("estimate"):
        estimates = correct_manually(given_files(folder), estimate_poses(folder, captures.estimation))
    merged = reconstruct(folder, estimates.estimate, captures.fusion, watch)
    estimates = _with_notes(estimates, merged.notes)
    views = CaptureViews(folder, estimates.estimate, captures, merged.body)
    with watch.stage("score"):
        truth = read_whole_truth(folder)
        score = None if truth is None else score_capture(estimates.estimate, merged.surface, views, truth).summary
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


def is_corrected(depth: DepthCorrection) -> bool:
    """Whether an estimate changes what was measured."""
    return depth.offset_m != 0.0 or depth.scale != 1.0 or not np.array_equal(depth.T_cam_depth, np.eye(4))


def _with_notes(estimates: Estimates, notes: tuple[str, ...]) -> Estimates:
    chosen = estimates.estimate
    told = replace(chosen, notes=tuple(dict.fromkeys((*chosen.notes, *notes))))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: told})
