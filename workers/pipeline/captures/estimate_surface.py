"""Poses and surface of a capture: the same steps whether results are written into its folder or not."""

from dataclasses import replace

from schemas.capture.estimate import Estimates
from schemas.job.captures import Captures
from workers.pipeline.captures.corrections import Given, correct_manually
from workers.pipeline.captures.estimate import estimate_poses
from workers.pipeline.captures.reconstruct import Merged, reconstruct
from workers.scene.context import Stopwatch


def estimate_surface(given: Given, captures: Captures, watch: Stopwatch) -> tuple[Estimates, Merged]:
    """The estimates with the user's corrections, and the merged views, whose notes the chosen estimate has too.

    Raises CaptureError where the capture cannot be used.
    """
    with watch.stage("estimate"):
        estimates = correct_manually(given, estimate_poses(given, captures.estimation))
    merged = reconstruct(given, estimates.estimate, captures.fusion, watch)
    return with_notes(estimates, merged.notes), merged


def with_notes(estimates: Estimates, notes: tuple[str, ...]) -> Estimates:
    """The estimates with further notes in the chosen one, each once."""
    chosen = estimates.estimate
    told = replace(chosen, notes=tuple(dict.fromkeys((*chosen.notes, *notes))))
    return replace(estimates, by_name={**estimates.by_name, estimates.chosen: told})
