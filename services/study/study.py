"""The study from end to end: every knob by itself, then what is promising together, and the table of both."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from schemas.job.job import Job
from services.bench.machine import describe_machine, pinned
from services.study.answer import DEFAULT_TARGETS, default_targets
from services.study.choose import TargetError
from services.study.errors import ERRORS
from services.study.journal import Journal
from services.study.knobs import apply
from services.study.measure.convergence import slopes
from services.study.measure.process_pool import Crew, Task
from services.study.measure.timing import time_scene, warm_up
from services.study.model import Row, Setting, Study
from services.study.pairs import promising
from services.study.plan import Plan
from services.study.robustness import close_calls
from services.study.rounds import Round, Unit
from workers.pipeline.context import WorkerContext

LAPS_OF_CLOSE_CALLS = 3
"""So many times the rounds of timing for settings whose time decides the choice."""


def run_study(
    plan: Plan, journal: Journal, context: WorkerContext, crew: Crew, progress: "Progress"
) -> tuple[Row, ...]:
    """Measure what is not in the journal yet, and make the table. The job itself is its first row.

    Every knob by itself; then what is promising together; then those settings once more against the clock whose time decides
    the choice.
    """
    bench = _Bench(journal, context, crew, progress)
    rows = bench.measure(Round(plan, "alone", plan.settings))
    units = {name: kind.unit for name, kind in ERRORS.items()}
    chosen = (Setting(), *plan.presets, *promising(rows, units, plan.targets or DEFAULT_TARGETS))
    together = bench.measure(Round(plan, f"together-{_digest(chosen)}", chosen))
    rows = (*rows, *(replace(row, ms=rows[0].ms * row.ratio) for row in together[1:]))
    asked, bounds = (plan.targets, {}) if plan.targets else default_targets(rows)
    try:
        close = close_calls(rows, asked, bounds)
    except TargetError:  # nothing meets them, however long it takes
        return rows
    if not close:
        return rows
    again = (Setting(), *(row.setting for row in close))
    longer = replace(plan, sizes=replace(plan.sizes, laps=LAPS_OF_CLOSE_CALLS * plan.sizes.laps))
    timed = bench.measure(Round(longer, f"close-{_digest(again)}", again, times_only=True))
    return tuple(_with_time(row, timed, rows[0].ms) for row in rows)


def _with_time(row: Row, timed: Sequence[Row], own_ms: float) -> Row:
    """The row with the time of the longer measurement, where it was in it."""
    for other in timed[1:]:
        if other.setting == row.setting:
            ratios = {name: getattr(other, name) for name in ("ratio", "ratio_least", "ratio_most")}
            return replace(row, ms=own_ms * other.ratio, **ratios)
    return row


def _digest(settings: Sequence[Setting]) -> str:
    """A few letters that tell these settings from others: which are promising depends on the targets."""
    return hashlib.sha256("; ".join(setting.name for setting in settings).encode()).hexdigest()[:8]


class Progress:
    """How many units are to be measured, and when one is."""

    def expect(self, units: int) -> None:
        """So many more."""

    def tick(self) -> None:
        """One is done."""


@dataclass(frozen=True)
class _Bench:
    """Who measures, and where it is kept."""

    journal: Journal
    context: WorkerContext
    crew: Crew
    progress: Progress

    def measure(self, part: Round) -> tuple[Row, ...]:
        """What is missing of a round: its times first and alone, then the rest beside one another. The round's table."""
        self.progress.expect(len(part.units()))
        missing = [unit for unit in part.units() if unit.name not in self.journal]
        for _ in range(len(part.units()) - len(missing)):
            self.progress.tick()
        self._take_times(part, [unit for unit in missing if unit.kind == "time"])
        sizes, first = part.plan.sizes, part.plan.job.first_scene
        tasks = [
            Task(
                unit.name,
                unit.kind,
                unit.settings,
                unit.scene_id,
                posed=unit.scene_id - first < sizes.posed,
                released=unit.scene_id - first < sizes.released,
            )
            for unit in missing
            if unit.kind != "time"
        ]
        for name, answer in self.crew.measure(tasks):
            self._keep(name, answer)
        return part.rows(self.journal)

    def _take_times(self, part: Round, missing: Sequence[Unit]) -> None:
        if not missing:
            return
        with pinned():
            quick = [setting for setting in part.settings if not _is_slow(self.context.job, setting)]
            warm_up(self.context, quick, part.plan.job.first_scene + part.plan.sizes.timed)
            for unit in missing:
                self._keep(unit.name, _time(part, self.context, unit))

    def _keep(self, name: str, answer: Any) -> None:
        self.journal.add(name, answer)
        self.progress.tick()


def _time(part: Round, context: WorkerContext, unit: Unit) -> dict[str, Any]:
    """Settings of physics alone are timed by settling; those drawn with paths in the first round's first scene alone."""
    drawn = part.of("labels", "mirror", "colour")
    first = unit.name == part.timings()[0].name
    whole = [one for one in drawn if first or not _is_slow(context.job, one)]
    own, settles = part.settings[0], [one for one in part.settings if one not in drawn]
    return time_scene(context, whole, [own, *settles], unit.scene_id, unit.lap)


def _is_slow(job: Job, setting: Setting) -> bool:
    return job.render.tier != "pathtraced" and apply(job, setting.changes).render.tier == "pathtraced"


def study_of(plan: Plan, rows: Sequence[Row], renderer: str, command: str, left_out: Sequence[str]) -> Study:
    """What the report is made of."""
    return Study(
        job=plan.job.name,
        command=command,
        machine=describe_machine(renderer),
        scenes=plan.sizes.scenes,
        physics_scenes=plan.sizes.settled,
        job_scenes=plan.job.scenes,
        rows=tuple(rows),
        slopes=slopes(),
        notes=tuple(left_out),
    )


def header_of(plan: Plan, settings_digest: str, code: str) -> dict[str, Any]:
    """What must be the same for measurements to go on."""
    return {
        "job": settings_digest,
        "code": code,
        "sizes": asdict(plan.sizes),
        "knobs": [knob.name for knob in plan.knobs],
        "settings": [setting.name for setting in plan.settings],
    }
