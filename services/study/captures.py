"""The study of a job of simulated captures: what views, estimates, iterations and voxels cost, and what they give.

- One capture processed with every setting: processor time, bytes, and errors against its truth.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.capture import CaptureScore, ProcessedCapture
from schemas.errors import CaptureError, InputError
from services.bench.figures import pinned
from services.run.progress import ProgressLine
from services.study.measure.settling import context_for
from services.study.measure.timing import image_figures, timed_rows
from services.study.model import Plan, Row, Setting
from services.study.study import Journal
from workers.capture.estimate import ProcessorClock
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.make_capture import process_capture, require_captures, simulate_one
from workers.geometry.camera import spread_evenly
from workers.scene.context import WorkerContext
from workers.store.file_system import temporary_folder

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


LEAST_CAPTURES = 2
"""Fewer tell nothing of how errors spread."""


def check_captures(plan: Plan) -> None:
    """Raises InputError where a job's captures cannot be studied."""
    captures = plan.job.captures
    if captures is None or captures.source != "simulate":
        raise InputError(
            "captures.source is folders: a study needs truth, which simulated captures alone have; use captures.source: simulate"
        )
    if plan.sizes.scenes < LEAST_CAPTURES:
        raise InputError(f"{plan.sizes.scenes} capture cannot tell how errors spread: ask for {LEAST_CAPTURES} or more")


def run_capture_study(plan: Plan, journal: Journal, context: WorkerContext, progress: ProgressLine) -> tuple[Row, ...]:
    """Measure what is not in the journal yet, and make the table; its first row is the job itself.

    A capture is simulated once, and processed with every setting in an order of its own, lap by lap, on one core.
    """
    first, sizes = plan.job.first_scene, plan.sizes
    units = {
        f"captures/{scene}/{lap}": (scene, lap)
        for scene, lap in itertools.product(range(first, first + sizes.scenes), range(sizes.laps))
    }
    missing: dict[int, list[str]] = {}
    for name, (scene, _) in units.items():
        if name not in journal:
            missing.setdefault(scene, []).append(name)
    progress.expect(len(units))
    with pinned():
        for number, (scene, names) in enumerate(missing.items()):
            with temporary_folder("study") as scratch:
                path = scratch / "capture"
                simulate_one(context, scene, path)
                if number == 0:
                    warm_up(context, plan.settings[0], path)
                for name in names:
                    journal.add(name, measure_capture(context, plan.settings, path, units[name]))
                    progress.show(sum(unit in journal for unit in units))
    laps: list[dict[int, dict[str, Any]]] = [{} for _ in range(sizes.laps)]
    for name, (scene, lap) in units.items():
        laps[lap][scene] = journal[name]
    return rows_of(plan, laps)


def rows_of(plan: Plan, laps: Sequence[Mapping[int, dict[str, Any]]]) -> tuple[Row, ...]:
    """The table, from the answers by lap and capture; settings that no capture could be processed with are left out."""
    answers, rows = list(laps[0].values()), []
    for row, _ in timed_rows(plan.settings, laps):
        name = row.setting.name
        failed = [str(one["failed"][name]) for one in answers if name in one["failed"]]
        rows.append(
            replace(
                row,
                errors=image_figures([one["errors"][name] for one in answers if name in one["errors"]]),
                failed_share=len(failed) / len(answers),
                notes=tuple(dict.fromkeys(failed)),
            )
        )
    return tuple(rows)
