"""The whole study: its journal, every knob by itself, then promising combinations, and the table of both.

The journal is a file of answers, with which the same command goes on where it stopped. A round is settings that are
measured side by side, in units of one scene.
"""

import hashlib
import itertools
import json
import multiprocessing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from schemas.errors import OutputError
from schemas.job.job import Job
from services.bench.figures import describe_machine, pinned
from services.run.progress import ProgressLine
from services.study.choose import DEFAULT_TARGETS, TargetError, close_calls, default_targets
from services.study.images import measure_colour, measure_scene_images
from services.study.knobs import apply, groups_of, joined
from services.study.measure import (
    image_figures,
    measure_settling,
    settling_figures,
    slopes,
    time_scene,
    timed_rows,
    warm_up,
)
from services.study.model import ERRORS, Figure, Group, Plan, Row, Setting, Study
from workers.assets.catalogue import open_catalogue
from workers.scene.context import WorkerContext, open_worker

JOURNAL_FILE = "journal.jsonl"


class Journal(dict[str, Any], AbstractContextManager):
    """Answers by the unit's name, one JSON line each; the first line identifies the study.

    A line that the end of a process cut off is dropped, and its unit measured again.
    """

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        """Raises OutputError where the folder cannot be written, or holds another study."""
        self._path = folder / JOURNAL_FILE
        super().__init__()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("a+b")
        except OSError as error:
            raise OutputError(f"{folder} cannot be written: {error.strerror or error}; choose another --out") from error
        try:
            self._read(header)
        except BaseException:
            self._file.close()
            raise

    def _read(self, header: Mapping[str, Any]) -> None:
        self._file.seek(0)
        written = self._file.read()
        whole = written[: written.rfind(b"\n") + 1]
        self._file.truncate(len(whole))
        if not whole:
            self._write(header)
            return
        first, *entries = map(json.loads, whole.splitlines())
        wanted = json.loads(json.dumps(header))
        if other := sorted(key for key in {*first, *wanted} if first.get(key) != wanted.get(key)):
            raise OutputError(
                f"{self._path.parent} holds the measurements of another study (other {', '.join(other)}): choose another "
                f"--out, or delete {self._path.name} there"
            )
        self.update((entry["unit"], entry["answer"]) for entry in entries)

    def add(self, unit: str, answer: Any) -> None:
        """Keep an answer, on disk too."""
        self[unit] = answer
        self._write({"unit": unit, "answer": answer})

    def _write(self, entry: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(entry, sort_keys=True).encode() + b"\n")
        self._file.flush()

    def __exit__(self, *_: object) -> None:
        self._file.close()


SAVES, WORSE, BETTER = 0.98, 1.5, 0.67
"""A value saves time at this share of the job's own, keeps an error that grows to this share, and shrinks one below this."""

NEGLIGIBLE: Mapping[str, float] = {"mm": 0.02, "deg": 0.02, "": 0.001}
"""By unit: errors below this are as good as none, however they compare."""

DEAREST = 5.0
"""A value that takes at least this many times the job's time is measured by itself only."""

MOST_OF_A_KIND = 3
"""The most knobs that are paired among those that save time, and among those that are more exact."""


def promising(rows: Sequence[Row], targets: Mapping[str, float]) -> tuple[Setting, ...]:
    """Settings of two and more knobs to measure next.

    `rows`: the job's own first, then one value of one knob each. For each knob the cheapest value that keeps every error, and
    the most exact value that shrinks one; of either kind the best knobs, two by two and all at once; and at once the cheapest
    value of every knob that meets the targets.
    """
    singles = [row for row in rows[1:] if len(row.setting.parts) == 1 and row.ratio < DEAREST]
    shares = {row.setting.name: _least_share(row, rows[0]) for row in singles}
    cheap = sorted((row for row in singles if row.ratio < SAVES), key=lambda row: (row.ratio, row.setting.name))
    ranks = {name: share for name, share in shares.items() if share is not None and share < BETTER}
    saving = _first_of_knobs(row for row in cheap if shares[row.setting.name] is not None)
    shrinking = [row for row in singles if row.setting.name in ranks]
    exact = _first_of_knobs(sorted(shrinking, key=lambda row: (ranks[row.setting.name], row.setting.name)))
    meeting = _first_of_knobs(
        row for row in cheap if all(row.errors[name].value <= targets[name] for name in set(targets) & set(row.errors))
    )
    pairs = [pair for kind in (saving, exact) for pair in itertools.combinations(kind[:MOST_OF_A_KIND], 2)]
    together = [some for some in (*pairs, saving, exact, meeting) if len(some) > 1]
    # In the order of the table, whatever the ranks, so that names do not depend on noise.
    found = [joined([row.setting for row in singles if row in some]) for some in together]
    return tuple({setting.name: setting for setting in found}.values())


def _first_of_knobs(rows: Iterable[Row]) -> list[Row]:
    """The first value of each knob, in the order of the rows."""
    first: dict[str, Row] = {}
    for row in rows:
        first.setdefault(row.setting.knob, row)
    return list(first.values())


def _least_share(row: Row, own: Row) -> float | None:
    """The least of its errors as a share of the job's own where that is not negligible, 1 without any.

    None where an error has grown beyond the factor and is not negligible.
    """
    both = [name for name in row.errors if name in own.errors]
    pairs = [(row.errors[name].value, own.errors[name].value, NEGLIGIBLE[ERRORS[name].unit]) for name in both]
    if any(value > max(negligible, WORSE * mine) for value, mine, negligible in pairs):
        return None
    return min((value / mine for value, mine, negligible in pairs if mine > negligible), default=1.0)


@dataclass(frozen=True)
class Unit:
    """One scene to measure with these settings; its answer is kept by its name.

    `kind`: time, settling, images or colour. Of time: its `lap`. Of settling: whether poses are held against the truth
    (`posed`) and objects released again (`released`).
    """

    name: str
    kind: str
    settings: tuple[Setting, ...]
    scene_id: int
    lap: int = 0
    posed: bool = False
    released: bool = False


@dataclass(frozen=True)
class Round:
    """Settings that are measured side by side; the first is the job itself."""

    plan: Plan
    name: str
    settings: tuple[Setting, ...]
    times_only: bool = False

    def of(self, *groups: Group) -> tuple[Setting, ...]:
        """The job's own setting, and those that change any of these parts of a scene."""
        knobs = {knob.name: knob for knob in self.plan.knobs}
        return (self.settings[0], *(one for one in self.settings[1:] if groups_of(one, knobs) & set(groups)))

    def timings(self) -> list[Unit]:
        """The units of time, in the order in which they are taken: lap by lap."""
        first, sizes = self.plan.job.first_scene, self.plan.sizes
        return [
            Unit(f"{self.name}/time/{lap}/{scene}", "time", self.settings, scene, lap)
            for lap, scene in itertools.product(range(sizes.laps), range(first, first + sizes.timed))
        ]

    def errors(self) -> list[Unit]:
        """The units of errors."""
        first, sizes = self.plan.job.first_scene, self.plan.sizes
        kinds = (
            ("colour", self.of("colour"), sizes.coloured),
            ("images", self.of("labels", "mirror"), sizes.scenes),
            ("settling", self.of("physics"), sizes.settled),
        )
        units = []
        for kind, settings, count in kinds:
            for number in range(count if len(settings) > 1 and not self.times_only else 0):
                name, part = f"{self.name}/{kind}/{first + number}", (number < sizes.posed, number < sizes.released)
                units.append(Unit(name, kind, settings, first + number, 0, *part))
        return units

    def rows(self, journal: Journal) -> tuple[Row, ...]:
        """The round's table, from the answers in the journal; settings without a time are left out."""
        laps: list[dict[int, dict[str, Any]]] = [{} for _ in range(self.plan.sizes.laps)]
        for unit in self.timings():
            laps[unit.lap][unit.scene_id] = journal[unit.name]
        units = self.errors()
        answers = {
            kind: [journal[unit.name] for unit in units if unit.kind == kind]
            for kind in ("settling", "images", "colour")
        }
        rows = []
        for row, scenes in timed_rows(self.settings, laps):
            errors = self._errors(answers, row.setting.name)
            failed = errors["failed_share"].value if "failed_share" in errors else 0.0
            notes = () if scenes >= self.plan.sizes.timed else (f"timed in {scenes} scenes",)
            rows.append(replace(row, errors=errors, failed_share=failed, notes=notes))
        return tuple(rows)

    @staticmethod
    def _errors(answers: Mapping[str, Sequence[Mapping[str, Any]]], name: str) -> dict[str, Figure]:
        """A setting's errors, `failed_share` last and the others in the order of `ERRORS`."""
        found = settling_figures(name, answers["settling"])
        for kind in ("images", "colour"):
            found |= image_figures([one[name] for one in answers[kind] if name in one])
        order = [error for error in ERRORS if error != "failed_share"]
        return {error: found[error] for error in (*order, "failed_share") if error in found}


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
        close = []
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
            with pinned():
                quick = [setting for setting in part.settings if not _is_slow(self.context.job, setting)]
                warm_up(self.context, quick, part.plan.job.first_scene + part.plan.sizes.timed)
                for unit in untimed:
                    self._keep(unit.name, _time(part, self.context, unit))
        for name, answer in measure_in_pool(self.context.job, part.plan.job_folder, self.processes, missing):
            self._keep(name, answer)
        return part.rows(self.journal)

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
