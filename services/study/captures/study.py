"""The study of a job of simulated captures: what views, estimates, iterations and voxels cost, and what they give."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from schemas.errors import InputError
from services.bench.machine import pinned
from services.run.progress import ProgressLine
from services.study.captures.measure import measure_capture, warm_up
from services.study.journal import Journal
from services.study.measure.statistics import image_figures
from services.study.measure.timing import timed_rows
from services.study.model import Plan, Row
from workers.pipeline.captures.make_capture import simulate_one
from workers.scene.context import WorkerContext
from workers.store.file_system import temporary_folder

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
