"""A capture from its folder to poses, surface and views from elsewhere."""

from schemas.capture.processed import ProcessedCapture
from schemas.job.captures import Captures
from workers.pipeline.stopwatch import Stopwatch
from workers.store.capture_folder import CaptureFolder


def process_capture(folder: CaptureFolder, captures: Captures, watch: Stopwatch) -> ProcessedCapture:
    """Estimate, reconstruct, prepare the views, score where there is truth. Raises CaptureError where it cannot be used."""
    raise NotImplementedError
