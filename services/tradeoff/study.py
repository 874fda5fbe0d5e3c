"""The study from end to end: every knob by itself, then what is promising together, and the table of both."""

import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from schemas.job import Job
from services.bench.machine import describe_machine, pinned
from services.tradeoff.answer import DEFAULT_TARGETS, default_targets
from services.tradeoff.choose import TargetError
from services.tradeoff.convergence import slopes
from services.tradeoff.crew import Crew, Task
from services.tradeoff.errors import ERRORS
from services.tradeoff.journal import Journal
from services.tradeoff.knobs import apply, groups_of
from services.tradeoff.model import Figure, Group, Knob, Row, Setting, Study
from services.tradeoff.pairs import promising
from services.tradeoff.statistics import image_figures, settling_figures
from services.tradeoff.steady import close_calls
from services.tradeoff.timing import cost_of, job_cost, time_scene, warm_up
from workers.context import WorkerContext

LAPS_OF_CLOSE_CALLS = 3
"""So many times the rounds of timing for settings whose time decides the choice."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes.

    Of `scenes` the images are looked at; of `settled` only how they come to rest: `released` of them are let go again, and
    `posed` have their poses compared with the truth. `timed` are timed in each of `laps` rounds; `coloured` are drawn with
    very many paths.
    """

    scenes: int = 48
    settled: int = 500
    released: int = 24
    posed: int = 48
    timed: int = 16
    laps: int = 3
    coloured: int = 4


@dataclass(frozen=True)
class Plan:
    """What is asked: the job that is timed, its knobs and settings, the presets, the targets."""

    job: Job
    job_folder: Path
    knobs: tuple[Knob, ...]
    settings: tuple[Setting, ...]
    presets: tuple[Setting, ...]
    targets: Mapping[str, float] | None
    sizes: Sizes = field(default_factory=Sizes)


@dataclass(frozen=True)
class _Unit:
    """One thing to measure, which is kept by its name: work for another process, or a round of timing for this one."""

    name: str
    kind: str
    settings: tuple[Setting, ...]
    scene_id: int


def run_study(
    plan: Plan, journal: Journal, context: WorkerContext, crew: Crew, progress: "Progress"
) -> tuple[Row, ...]:
    """Measure what is not in the journal yet, and make the table. The job itself is its first row.

    Every knob by itself; then what is promising together; then those settings once more against the clock whose time decides
    the choice.
    """
    bench = _Bench(journal, context, crew, progress)
    rows = bench.measure(_Round(plan, "alone", plan.settings))
    units = {name: kind.unit for name, kind in ERRORS.items()}
    chosen = (Setting(), *plan.presets, *promising(rows, units, plan.targets or DEFAULT_TARGETS))
    together = bench.measure(_Round(plan, f"together-{_digest(chosen)}", chosen))
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
    timed = bench.measure(_Round(longer, f"close-{_digest(again)}", again, times_only=True))
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
class _Round:
    """Settings that are measured beside one another; the job itself is the first of them."""

    plan: Plan
    name: str
    settings: tuple[Setting, ...]
    times_only: bool = False

    def of(self, *groups: Group) -> tuple[Setting, ...]:
        """The settings that change any of these parts of a scene, and the job's own."""
        knobs = {knob.name: knob for knob in self.plan.knobs}
        return tuple(
            setting
            for number, setting in enumerate(self.settings)
            if number == 0 or groups_of(setting, knobs) & set(groups)
        )

    def timings(self) -> list[_Unit]:
        """Rounds of timing, one unit a scene."""
        scenes, sizes = self._scenes(self.plan.sizes.timed), self.plan.sizes
        return [
            _Unit(f"{self.name}/time/{lap}/{scene}", "time", self.settings, scene)
            for lap, scene in itertools.product(range(sizes.laps), scenes)
        ]

    def errors(self) -> list[_Unit]:
        """Everything else, a unit a scene each."""
        sizes = self.plan.sizes
        kinds: list[tuple[str, tuple[Setting, ...], int]] = [
            ("colour", self.of("colour"), sizes.coloured),
            ("images", self.of("labels", "mirror"), sizes.scenes),
            ("settling", self.of("physics"), sizes.settled),
        ]
        return [
            _Unit(f"{self.name}/{kind}/{scene}", kind, settings, scene)
            for kind, settings, count in kinds
            for scene in self._scenes(count)
            if len(settings) > 1 and not self.times_only
        ]

    def units(self) -> list[_Unit]:
        """All."""
        return [*self.timings(), *self.errors()]

    def _scenes(self, count: int) -> list[int]:
        return list(range(self.plan.job.first_scene, self.plan.job.first_scene + count))

    def rows(self, journal: Journal) -> tuple[Row, ...]:
        """The table of this round from what was measured."""
        return tuple(_rows(self, journal))

    def answers(self, journal: Journal, kind: str) -> list[dict[str, Any]]:
        """Of all scenes, in order."""
        return [journal[unit.name] for unit in self.errors() if unit.kind == kind]


@dataclass(frozen=True)
class _Bench:
    """Who measures, and where it is kept."""

    journal: Journal
    context: WorkerContext
    crew: Crew
    progress: Progress

    def measure(self, part: _Round) -> tuple[Row, ...]:
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

    def _take_times(self, part: _Round, missing: Sequence[_Unit]) -> None:
        if not missing:
            return
        with pinned():
            warm_up(self.context, part.settings, part.plan.job.first_scene + part.plan.sizes.timed)
            for unit in missing:
                self._keep(unit.name, _time(part, self.context, unit))

    def _keep(self, name: str, answer: Any) -> None:
        self.journal.add(name, answer)
        self.progress.tick()


def _time(part: _Round, context: WorkerContext, unit: _Unit) -> dict[str, Any]:
    """Settings of physics alone are timed by settling; those drawn with paths in the first round's first scene alone."""
    drawn = part.of("labels", "mirror", "colour")
    first = unit.name == part.timings()[0].name
    whole = [one for one in drawn if first or not _is_slow(context.job, one)]
    own, settles = part.settings[0], [one for one in part.settings if one not in drawn]
    return time_scene(context, whole, [own, *settles], unit.scene_id, int(unit.name.split("/")[2]))


def _is_slow(job: Job, setting: Setting) -> bool:
    return job.render.tier != "pathtraced" and apply(job, setting.changes).render.tier == "pathtraced"


def _rows(part: _Round, journal: Journal) -> Iterator[Row]:
    own = part.settings[0].name
    laps: list[dict[int, dict[str, Any]]] = [{} for _ in range(part.plan.sizes.laps)]
    for unit in part.timings():
        laps[int(unit.name.split("/")[2])][unit.scene_id] = journal[unit.name]
    own_ms, own_kb = job_cost(laps, own)
    for setting in part.settings:
        cost = cost_of(setting.name, own, laps)
        if cost is None:
            continue
        errors = _errors(part, journal, setting)
        failed = errors.pop("failed_share", None)
        yield Row(
            setting=setting,
            ms=own_ms * cost.ratio.median,
            ratio=cost.ratio.median,
            ratio_least=cost.ratio.least,
            ratio_most=cost.ratio.most,
            kilobytes=own_kb if cost.kilobytes is None else cost.kilobytes,
            errors=errors if failed is None else {**errors, "failed_share": failed},
            failed_share=0.0 if failed is None else failed.value,
            notes=() if cost.scenes >= part.plan.sizes.timed else (f"timed in {cost.scenes} scenes",),
        )


def _errors(part: _Round, journal: Journal, setting: Setting) -> dict[str, Figure]:
    """In the order of `ERRORS`."""
    found = settling_figures(setting.name, part.answers(journal, "settling"))
    for kind in ("images", "colour"):
        found.update(image_figures([one[setting.name] for one in part.answers(journal, kind) if setting.name in one]))
    return {name: found[name] for name in ERRORS if name in found}


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
