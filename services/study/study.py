"""The whole study: every knob by itself, then promising combinations, and the table of both."""

import hashlib
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from schemas.job.job import Job
from services.bench.machine import describe_machine, pinned
from services.run.progress import ProgressLine
from services.study.answer import DEFAULT_TARGETS, default_targets
from services.study.choose import TargetError, close_calls
from services.study.journal import Journal
from services.study.knobs import apply
from services.study.measure.convergence import slopes
from services.study.measure.scene_images import measure_colour, measure_scene_images
from services.study.measure.settling import measure_settling
from services.study.measure.timing import time_scene, warm_up
from services.study.model import Plan, Row, Setting, Study
from services.study.pairs import promising
from services.study.rounds import Round, Unit
from workers.assets.catalogue import open_catalogue
from workers.scene.context import WorkerContext, open_worker

LAPS_OF_CLOSE_CALLS = 3
"""Factor on the rounds of timing for settings whose time decides the choice."""


def run_study(
    plan: Plan, journal: Journal, context: WorkerContext, processes: int, progress: ProgressLine
) -> tuple[Row, ...]:
    """Measure what is not in the journal yet, and make the table; its first row is the job itself.

    First every knob by itself; then promising combinations; then the settings whose time decides the choice are timed for
    longer.
    """
    bench = _Bench(journal, context, processes, progress)
    rows = bench.measure(Round(plan, "alone", plan.settings))
    chosen = (Setting(), *plan.presets, *promising(rows, plan.targets or DEFAULT_TARGETS))
    combined = bench.measure(Round(plan, f"together-{_digest(chosen)}", chosen))
    rows = (*rows, *(with_time_of(row, row, rows[0].ms) for row in combined[1:]))
    asked, bounds = (plan.targets, {}) if plan.targets else default_targets(rows)
    try:
        close = close_calls(rows, asked, bounds)
    except TargetError:  # no setting meets the targets, however long it is timed
        return rows
    if not close:
        return rows
    again = (Setting(), *(row.setting for row in close))
    longer = replace(plan, sizes=replace(plan.sizes, laps=LAPS_OF_CLOSE_CALLS * plan.sizes.laps))
    timed = bench.measure(Round(longer, f"close-{_digest(again)}", again, times_only=True))
    longest = {row.setting.name: row for row in timed[1:]}
    return tuple(with_time_of(row, longest.get(row.setting.name, row), rows[0].ms) for row in rows)


def with_time_of(row: Row, timed: Row, own_ms: float) -> Row:
    """The row with the time of another measurement of its setting; `own_ms` is the job's own time."""
    ratios = {name: getattr(timed, name) for name in ("ratio", "ratio_least", "ratio_most")}
    return replace(row, ms=own_ms * timed.ratio, **ratios)


def _digest(settings: Sequence[Setting]) -> str:
    """Eight hexadecimal digits of the settings' names: which settings are promising depends on the targets."""
    return hashlib.sha256("; ".join(setting.name for setting in settings).encode()).hexdigest()[:8]


@dataclass
class _Bench:
    """Measures rounds, keeps the answers in the journal and shows the progress."""

    journal: Journal
    context: WorkerContext
    processes: int
    progress: ProgressLine
    asked: int = 0
    done: int = 0

    def measure(self, part: Round) -> tuple[Row, ...]:
        """The round's table. Missing times are taken first and with no other load, then errors side by side."""
        timings, errors = part.timings(), part.errors()
        missing = [unit for unit in errors if unit.name not in self.journal]
        untimed = [unit for unit in timings if unit.name not in self.journal]
        self.asked += len(timings) + len(errors)
        self.done = self.asked - len(untimed) - len(missing)
        self.progress.expect(self.asked)
        if untimed:
            self._take_times(part, untimed)
        for name, answer in measure_in_pool(self.context.job, part.plan.job_folder, self.processes, missing):
            self._keep(name, answer)
        return part.rows(self.journal)

    def _take_times(self, part: Round, missing: Sequence[Unit]) -> None:
        with pinned():
            quick = [setting for setting in part.settings if not _is_slow(self.context.job, setting)]
            warm_up(self.context, quick, part.plan.job.first_scene + part.plan.sizes.timed)
            for unit in missing:
                self._keep(unit.name, _time(part, self.context, unit))

    def _keep(self, name: str, answer: Any) -> None:
        self.journal.add(name, answer)
        self.done += 1
        self.progress.show(self.done)


def _time(part: Round, context: WorkerContext, unit: Unit) -> dict[str, Any]:
    """Settings of physics are timed by settling alone; path-traced ones only in the first scene of the first lap."""
    drawn = part.of("labels", "mirror", "colour")
    first = unit.name == part.timings()[0].name
    whole = [one for one in drawn if first or not _is_slow(context.job, one)]
    own, settles = part.settings[0], [one for one in part.settings if one not in drawn]
    return time_scene(context, whole, [own, *settles], unit.scene_id, unit.lap)


def _is_slow(job: Job, setting: Setting) -> bool:
    return job.render.tier != "pathtraced" and apply(job, setting.changes).render.tier == "pathtraced"


def measure_in_pool(job: Job, job_folder: Path, processes: int, units: Sequence[Unit]) -> Iterator[tuple[str, Any]]:
    """Answers by the units' names, as they are ready, from a pool of processes.

    What a unit raises is raised here, and the others are dropped.
    """
    if not units:
        return
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=fresh) as pool:
        told = job.model_dump_json(), str(job_folder)
        running = {pool.submit(_measure, *told, unit): unit.name for unit in units}
        try:
            for done in as_completed(running):
                yield running[done], done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@cache
def _context(job: str, folder: str) -> WorkerContext:
    parsed = Job.model_validate_json(job)
    return open_worker(parsed, open_catalogue(parsed.assets, Path(folder), tuple(parsed.categories)))


def _measure(job: str, folder: str, unit: Unit) -> Any:
    context = _context(job, folder)
    if unit.kind == "settling":
        return measure_settling(context, unit.settings, unit.scene_id, unit.posed, unit.released)
    measure = measure_scene_images if unit.kind == "images" else measure_colour
    return measure(context, unit.settings, unit.scene_id)


def study_of(plan: Plan, rows: Sequence[Row], renderer: str, command: str, left_out: Sequence[str]) -> Study:
    """The content of the report."""
    return Study(
        job=plan.job.name,
        command=command,
        machine=describe_machine(renderer),
        scenes=plan.sizes.scenes,
        physics_scenes=plan.sizes.settled,
        job_scenes=plan.job.scenes,
        rows=tuple(rows),
        slopes={} if plan.job.captures is not None else slopes(),
        preset=plan.job.preset,
        notes=tuple(left_out),
    )


def header_of(plan: Plan, settings_digest: str, code: str) -> dict[str, Any]:
    """The journal's first line: what must be the same for measurements to go on."""
    return {
        "job": settings_digest,
        "code": code,
        "sizes": asdict(plan.sizes),
        "knobs": [knob.name for knob in plan.knobs],
        "settings": [setting.name for setting in plan.settings],
    }
