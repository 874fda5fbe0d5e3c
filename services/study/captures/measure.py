"""One capture processed with every setting: processor time, bytes, and errors against its truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.capture.processed import CaptureScore, ProcessedCapture
from schemas.errors import CaptureError
from services.study.measure.settling import context_for
from services.study.model import Setting
from workers.geometry.spread import spread_evenly
from workers.pipeline.captures.make_capture import require_captures
from workers.pipeline.captures.process_capture import process_capture
from workers.pipeline.captures.processor_clock import ProcessorClock
from workers.scene.context import WorkerContext
from workers.store.capture_folder import CaptureFolder, open_folder

BYTES_OF_POINT = 3 * 4 + 3 * 4 + 3
BYTES_OF_VERTEX = 3 * 4 + 3
BYTES_OF_FACE = 3 * 4
"""As a cloud and a mesh are written: float32 coordinates and normals, 8-bit colours, 32-bit indices."""

ERRORS_OF_SCORE = {
    "camera_mm": "pose_mm",
    "camera_deg": "pose_deg",
    "cloud_mm": "cloud_median_mm",
    "cloud_p95_mm": "cloud_p95_mm",
    "view_depth_mm": "depth_median_mm",
}
"""Names of the study's errors, and of the score's figures."""


def warm_up(context: WorkerContext, setting: Setting, path: Path) -> None:
    """Process a capture untimed: the first processing in a process compiles its loops. Raises CaptureError."""
    process_capture(open_folder(path), require_captures(context_for(context, setting).job), ProcessorClock())


def measure_capture(
    context: WorkerContext, settings: Sequence[Setting], path: Path, unit: tuple[int, int]
) -> dict[str, Any]:
    """Seconds of processor, bytes and errors by setting of a simulated capture; settings that fail say why.

    Time is that of detection, estimates, cloud and mesh. `unit` is (scene, lap): the order of settings follows from it, so
    that none always follows the same one.
    """
    answer: dict[str, Any] = {"whole": {}, "settling": {}, "bytes": {}, "errors": {}, "failed": {}}
    whole = open_folder(path)
    for setting in [settings[n] for n in np.random.default_rng(unit).permutation(len(settings))]:
        captures = require_captures(context_for(context, setting).job)
        folder = fewer_views(whole, captures.simulate.views)
        watch = ProcessorClock()
        try:
            done = process_capture(folder, captures, watch)
            answer["whole"][setting.name] = sum(s for stage, s in watch.seconds.items() if stage != "score")
            answer["errors"][setting.name] = errors_of(done.score or CaptureScore())
            answer["bytes"][setting.name] = _bytes(done)
        except CaptureError as error:
            answer["failed"][setting.name] = str(error)
    answer["cold"] = answer["whole"].get(settings[0].name, 0.0)
    return answer


def fewer_views(folder: CaptureFolder, views: int) -> CaptureFolder:
    """The same capture with some of its views only, evenly over the path."""
    return replace(folder, numbers=tuple(folder.numbers[place] for place in spread_evenly(len(folder.numbers), views)))


def errors_of(score: CaptureScore) -> dict[str, float]:
    """The study's errors from a score; what was not measured is left out."""
    found = {name: getattr(score, figure) for name, figure in ERRORS_OF_SCORE.items()}
    found["missing_share"] = None if score.completeness is None else 1.0 - score.completeness
    return {name: float(value) for name, value in found.items() if value is not None}


def _bytes(done: ProcessedCapture) -> int:
    surface = done.surface
    points, vertices, faces = len(surface.points), len(surface.vertices), len(surface.faces)
    return points * BYTES_OF_POINT + vertices * BYTES_OF_VERTEX + faces * BYTES_OF_FACE
