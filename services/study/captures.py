"""Measures a simulated capture with settings: the time of its processing, and the errors that its truth tells."""

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import fmean

import numpy as np

from schemas.capture import CaptureScore, SynthesizedView
from schemas.errors import InputError
from schemas.job.job import Job
from schemas.scene.view import Camera
from services.study.measure import Answer, Meter, answer_for, context_for
from services.study.model import OWN, Setting
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.make_capture import require_captures, simulate_one
from workers.capture.process import CaptureViews
from workers.capture.reconstruct import estimate_surface, given_files, processor_clock
from workers.capture.score import read_whole_truth, score_capture
from workers.geometry.camera import spread_evenly
from workers.scene.context import WorkerContext

POINT_BYTES, VERTEX_BYTES, FACE_BYTES = 3 * 4 + 3 * 4 + 3, 3 * 4 + 3, 3 * 4
"""As a cloud and a mesh are written: float32 coordinates and normals, 8-bit colours, 32-bit indices."""

ERRORS_OF_SCORE = {
    "camera_mm": "pose_mm",
    "camera_deg": "pose_deg",
    "cloud_mm": "cloud_median_mm",
    "cloud_p95_mm": "cloud_p95_mm",
    "view_depth_mm": "depth_median_mm",
}
"""Names of the study's errors, and of the score's figures."""

HELD_OUT = 3
"""Views that are made of the others, for their depth and their time."""

_warm: list[bool] = []


def measure_capture(
    context: WorkerContext, settings: Sequence[Setting], scene_id: int, number: int, scratch: Path
) -> dict[str, Answer]:
    """Time, bytes and errors by setting of a simulated capture, which is kept in `scratch` for all settings.

    Time is that of detection, estimates, cloud, mesh and as many synthesised views as there are photographs. A process works
    untimed first: that compiles its loops.
    """
    if not _warm:
        _warm.append(True)
        answer_for(partial(_process, context, scene_id, scratch, OWN))
    order = np.random.default_rng([scene_id, len(settings)]).permutation(len(settings))
    return {settings[k].name: answer_for(partial(_process, context, scene_id, scratch, settings[k])) for k in order}


def _simulated(context: WorkerContext, worker: WorkerContext, scene_id: int, scratch: Path) -> CaptureFolder:
    """The capture with the job's own number of views, and the setting's scale of images; made once."""
    scale = require_captures(worker.job).simulate.image_scale
    place = scratch / f"capture-{scene_id}-{scale:g}"
    if not place.exists():
        made = scratch / f"{place.name}-{os.getpid()}"
        scaled = Setting((), {"captures.simulate.image_scale": scale})
        simulate_one(context_for(context, scaled), scene_id, made)
        with suppress(OSError):  # another process was faster, with the same bytes
            made.rename(place)
    return open_folder(place)


@dataclass(eq=False)
class TimedViews(CaptureViews):
    """Views that keep the seconds of processor that each synthesised one took."""

    seconds: list[float] = field(default_factory=list)

    def synthesize(self, camera: Camera, without: int | None = None) -> SynthesizedView:
        """As `CaptureViews.synthesize`."""
        began = time.process_time()
        made = super().synthesize(camera, without)
        self.seconds.append(time.process_time() - began)
        return made


def _process(context: WorkerContext, scene_id: int, scratch: Path, setting: Setting, meter: Meter) -> Answer:
    worker, watch = context_for(context, setting), processor_clock()
    captures, whole = require_captures(worker.job), _simulated(context, worker, scene_id, scratch)
    folder = fewer_views(whole, captures.simulate.views)
    with watch.stage("read"):
        given = given_files(folder, captures.estimation)
    estimates, merged = estimate_surface(given, captures, watch)
    truth, surface = read_whole_truth(folder), merged.surface
    views = TimedViews(given, captures, estimates.estimate, surface, merged.body)
    score = None if truth is None else score_capture(views, truth, HELD_OUT).summary
    mirrors_s = fmean(views.seconds) * len(estimates.estimate.used) if views.seconds else 0.0
    meter.s = sum(watch.seconds.values()) + mirrors_s
    points, vertices, faces = map(len, (surface.points, surface.vertices, surface.faces))
    size = points * POINT_BYTES + vertices * VERTEX_BYTES + faces * FACE_BYTES
    return {"errors": errors_of(score or CaptureScore()), "bytes": size}


def fewer_views(folder: CaptureFolder, views: int) -> CaptureFolder:
    """The same capture with some of its views only, evenly over the path."""
    return replace(folder, numbers=tuple(folder.numbers[place] for place in spread_evenly(len(folder.numbers), views)))


def errors_of(score: CaptureScore) -> dict[str, float]:
    """The study's errors from a score; what was not measured is left out."""
    found = {name: getattr(score, figure) for name, figure in ERRORS_OF_SCORE.items()}
    found["missing_share"] = None if score.completeness is None else 1.0 - score.completeness
    return {name: float(value) for name, value in found.items() if value is not None}


def check_captures(job: Job) -> None:
    """Raises InputError where a job's captures cannot be studied."""
    if job.captures is None or job.captures.folders:
        raise InputError(
            "captures.folders names folders: a study needs truth, which virtual captures alone have; leave it out"
        )
