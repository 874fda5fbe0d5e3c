"""The whole study within a budget: a pilot, rounds of settings, the choice, and its proof on fresh scenes."""

import hashlib
import itertools
import json
import math
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from schemas.errors import OutputError, RunError, describe_seconds, plural
from schemas.job.job import Job
from services.run.progress import ProgressLine
from services.study import choose
from services.study.images import measure_colour, measure_drawn
from services.study.measure import LIMIT, RESTS, measure_capture, measure_rest
from services.study.model import OWN, Proof, Row, Setting, Study, Targets, apply, joined
from services.study.table import AT_REST, PARTS, Part, Table, figures_of, part_of, split_settings, unit_name
from workers.capture.results import open_sources
from workers.pool import Answers, Ended, Pool
from workers.scene.context import WorkerContext, open_worker
from workers.shard.run_shard import run_scene
from workers.stopwatch import Stopwatch


@dataclass(frozen=True)
class Plan:
    """The job that is measured, its settings and presets, the targets, the seconds to spend, and processes."""

    job: Job
    job_folder: Path
    settings: tuple[Setting, ...]
    targets: Targets | None
    budget_s: float
    processes: int


@dataclass(frozen=True)
class Unit:
    """One scene to measure with these settings on top of a base setting.

    `job`: as JSON, beside the folder that its paths are of; `scratch`: a folder that all processes share; `part`: of `PARTS` in
    services/study/table.py; `limit_s`: seconds of processor that one setting may take.
    """

    job: str
    folder: str
    scratch: str
    part: str
    scene_id: int
    settings: tuple[Setting, ...]
    base: Setting = OWN
    limit_s: float = math.inf


def answer_unit(unit: Unit) -> bytes:
    """Answers by the settings' names, as JSON."""
    context = _worker(unit.job, unit.folder, json.dumps(dict(unit.base.changes)))
    LIMIT["s"], RESTS["folder"] = unit.limit_s, Path(unit.scratch)
    measures = {"rest": measure_rest, "draw": measure_drawn, "colour": measure_colour, "capture": measure_capture}
    began = time.monotonic()
    # Another order in each scene, so that what a process does first is no setting's disadvantage.
    order = np.random.default_rng([unit.scene_id, len(unit.settings)]).permutation(len(unit.settings))
    answers = measures[unit.part](context, [unit.settings[place] for place in order], unit.scene_id)
    shared_s = (time.monotonic() - began - sum(answer["took"] for answer in answers.values())) / len(answers)
    for answer in answers.values():
        answer["took"] += shared_s  # what was made for all
    return json.dumps(answers).encode()


WARM_SCENES = (2_000_000, 2_000_001)
"""Scenes of one object that compile a process's loops and shaders; no study measures them."""


@cache
def _worker(job: str, folder: str, changes: str) -> WorkerContext:
    """The worker of the job, or the same one with a base setting's job: one object each, because caches know it."""
    if changes != "{}":
        own = _worker(job, folder, "{}")
        return replace(own, job=apply(own.job, json.loads(changes)))
    parsed = Job.model_validate_json(job)
    context = open_worker(parsed, open_sources(parsed, Path(folder)))
    if parsed.captures is None:
        few = replace(context, job=apply(parsed, {"objects_per_scene": 1}))
        for scene_id in WARM_SCENES:
            run_scene(few, scene_id, Stopwatch())
    return context


JOURNAL_FILE, HEADER, SPENT = "answers", "study", "spent"
"""The file of a journal, and its keys beside those of answers: what was studied, and seconds of the budget."""


class Journal(dict[str, Any]):
    """Answers by key, kept in a file of a study's folder, so that the same command goes on where it stopped."""

    def __init__(self, folder: Path, header: Mapping[str, str]) -> None:
        """Raises OutputError where the folder cannot be written, or holds another study."""
        path = folder / JOURNAL_FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()
        except OSError as error:
            raise OutputError(f"{folder} cannot be written: {error.strerror or error}; choose another --out") from error
        self._kept = Answers(path)
        super().__init__((key, json.loads(answer)) for key in self._kept if (answer := self._kept.get(key)))
        if self.get(HEADER, header) != header:
            raise OutputError(
                f"{folder} holds the measurements of another study, of another job or by other code: choose another --out, "
                f"or delete {path.name} there"
            )
        self.add(HEADER, dict(header))

    def add(self, key: str, answer: Any) -> None:
        """Keep an answer, on disk too."""
        self[key] = answer
        self._kept.put(key, json.dumps(answer).encode())


FIRST_SHARE, PILOT_SHARE, RACE_SHARE = 0.5, 0.3, 0.75
"""By these shares of the budget the job's own first scenes must be there, the first round ends, and the last, so that a proof
still fits. The first scenes have more time than the first round, because processes start before them."""

LATE_SHARE = 0.03
"""What is under way then may take this share more, because a process that is ended takes seconds to come back."""

PAGE_S, UNIT_SHARE = 6.0, 0.01
"""Seconds of the budget that are kept for the page, and the share that a unit of several settings takes at most, about."""

SLOW, LEAST_LIMIT_S = 3.0, 40.0
"""A scene that takes this many times the longest of the job's own, and so many seconds of processor at least, is a time out."""


@dataclass
class Measurement:
    """What a study is measured with: its plan, answers so far, processes, the folder that they share, and its clock."""

    plan: Plan
    journal: Journal
    pool: Pool[Unit]
    scratch: str
    progress: ProgressLine
    began: float
    before_s: float

    def __post_init__(self) -> None:
        """Splits the plan's settings."""
        self.targets = self.plan.targets or choose.DEFAULT_TARGETS
        self.add(())

    @property
    def spent_s(self) -> float:
        """Seconds spent of the budget, those of earlier starts with it."""
        return self.before_s + time.monotonic() - self.began

    def left_s(self, share: float = 1.0) -> float:
        """Seconds until a share of the budget is spent, but for what the page takes."""
        return share * (self.plan.budget_s - PAGE_S) - self.spent_s

    def table(self) -> Table:
        """The table so far."""
        return Table(self.split, self.journal)

    def add(self, settings: Iterable[Setting]) -> None:
        """Settings that are measured too from now on."""
        known = {setting.name for setting in self.plan.settings}
        new = tuple(setting for setting in settings if setting.name not in known)
        self.plan = replace(self.plan, settings=(*self.plan.settings, *new))
        self.split = split_settings(self.plan.settings, self.plan.job.captures is not None)

    def run(self, wanted: Sequence[choose.Wanted], share: float, base: Setting = OWN) -> None:
        """Measures, in order, until a share of the budget is spent, and keeps the answers; what a process died of is `broken`.

        Settings of one part and scene, on top of the base setting, are measured side by side in units.
        """
        table, units = self.table(), list[Unit]()
        where = self.plan.job.model_dump_json(), str(self.plan.job_folder), self.scratch
        for (part, scene), items in itertools.groupby(wanted, key=lambda item: (item.part, item.scene_id)):
            some = list(items)
            size = max(1, int(UNIT_SHARE * self.plan.budget_s * len(some) / max(choose.seconds(table, some), 1e-3)))
            took = [answer["took"] for answer in table.answers(part, OWN).values()]
            limit_s = max(LEAST_LIMIT_S, SLOW * max(took)) if took and base == OWN else math.inf
            for n in range(0, len(some), size):
                settings = tuple(item.setting for item in some[n : n + size])
                units.append(Unit(*where, part, scene, settings, base, limit_s))
        last, end = (time.monotonic() + self.left_s(some) for some in (share, min(1.0, share + LATE_SHARE)))
        for unit, answer in self.pool.run(units, last, end):
            by_name = {} if isinstance(answer, Ended) else json.loads(answer)
            for setting in unit.settings:
                died = {"failed": "broken", "broken": f"its process died: {getattr(answer, 'detail', '')}", "took": 0.0}
                self.journal.add(unit_name(unit.part, unit.scene_id, setting), by_name.get(setting.name, died))
            self.progress.show(round(self.spent_s))


OPEN = {
    choose.undecided: "whether these keep the targets is not sure to 95 %",
    choose.roughly_timed: f"how long these take is not known to a factor of {choose.ROUGH:g}",
}
"""What settings of a part are measured further for, and what is told where the budget ends before."""


def run_study(plan: Plan, journal: Journal, progress: ProgressLine, began: float, **about: Any) -> Study:
    """Measures until the answer is sure or the budget is spent, proves the answer, and puts it in words.

    `began` is when the command did, by the monotonic clock; `about`: further fields of the study. The same journal goes on: a
    longer budget refines. Raises RunError where no scene of the job can be made, or none within the budget.
    """
    with (
        tempfile.TemporaryDirectory(prefix="verso-study-") as scratch,
        Pool(answer_unit, processes=plan.processes) as pool,
    ):
        bench = Measurement(plan, journal, pool, scratch, progress, began, float(journal.get(SPENT, 0.0)))
        try:
            run_first(bench)
            run_rounds(bench)
            rows, able, proofs = choose_and_prove(bench)
        finally:
            journal.add(SPENT, bench.spent_s)
    table, notes, doubts = bench.table(), list(about.pop("notes")), list[str]()
    if late := [setting.name for setting in plan.settings if table.row(setting) is None]:
        notes.append(f"not reached within the budget: {', '.join(late)}")
    for part in bench.split.measured:
        for test, what in OPEN.items():
            if rivals := test(table, part, bench.targets):
                names = [f"{some.name} ({plural(len(table.answers(part, some)), 'scene')})" for some in rivals]
                doubts.append(f"{PARTS[part].words}: {what}: {', '.join(names)}")
    answer, chosen = choose.describe_answer(able, plan.targets, proofs, plan.job.scenes)
    return Study(
        job=plan.job.name,
        scenes=max(len(table.answers(part, OWN)) for part in bench.split.measured),
        rows=tuple(rows),
        job_scenes=plan.job.scenes,
        notes=tuple(notes),
        budget_s=plan.budget_s,
        seconds=bench.spent_s,
        answer=answer,
        chosen=chosen,
        doubts=tuple(doubts),
        proofs=tuple(proofs),
        **about,
    )


def run_first(bench: Measurement) -> None:
    """One scene of the job itself, and a few more. Raises RunError where there is none."""
    timed, first_scene = bench.split.timed, bench.plan.job.first_scene

    def run_own(parts: Sequence[Part], scenes: int) -> None:
        # Part by part, so that a scene is drawn once another process has settled it.
        for part in parts:
            wanted = choose.missing(bench.table(), part, [OWN], range(first_scene, first_scene + scenes))
            bench.run(wanted, FIRST_SHARE)

    run_own(timed, 1)
    if any(not bench.table().answers(part, OWN) for part in timed):
        raise RunError(
            f"the job's first scene took more than {describe_seconds(FIRST_SHARE * bench.plan.budget_s)}, half of "
            f"--budget {describe_seconds(bench.plan.budget_s)}: give more, such as --budget 2h (the first on a machine also "
            "compiles, for about a minute)"
        )
    run_own(timed[:1], choose.FEWEST_SCENES)
    own = bench.table().answers(timed[0], OWN).values()
    if all("failed" in answer for answer in own):
        reasons = sorted({str(answer.get("broken", answer["failed"])) for answer in own})
        raise RunError(
            f"none of the job's first {plural(len(own), 'scene')} can be made ({'; '.join(reasons)}): "
            "a study needs scenes; `verso run` with --scenes 4 tells more of each"
        )
    run_own(timed[1:], choose.FEWEST_SCENES)


LEVELS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
"""Scenes of the rounds, of which the first is a pilot that tells costs."""


def run_rounds(bench: Measurement) -> None:
    """Rounds of twice as many scenes, until every part is decided or the budget's share is spent.

    A round takes half of the time that is left at most, and each part its share of that. What did not fit is asked again.
    """
    first = bench.plan.job.first_scene
    for level in LEVELS:
        table, share = bench.table(), PILOT_SHARE if level == 1 else RACE_SHARE
        parts = [part for part in bench.split.measured if level <= PARTS[part].scenes]
        parts = [part for part in parts if level <= choose.LEAST or any(f(table, part, bench.targets) for f in OPEN)]
        weights, wanted = sum(PARTS[part].share for part in parts), list[choose.Wanted]()
        for part in parts:
            part_s = bench.left_s(share) * bench.plan.processes / 2 * PARTS[part].share / weights
            allowed_s = math.inf if level == 1 else part_s
            wanted += choose.next_round(table, part, bench.targets, range(first, first + level), allowed_s)
        # Scene by scene, so that what the end of the budget cuts off leaves the same scenes of all.
        bench.run(sorted(wanted, key=lambda item: item.scene_id), share)
        if level == choose.LEAST:
            bench.add(combinations(bench))


def combinations(bench: Measurement) -> list[Setting]:
    """Promising combinations of knobs of one part; those across parts are put together of their parts."""
    table, together = bench.table(), list[Setting]()
    for part in bench.split.timed:
        settings = [OWN, *(some for some in bench.plan.settings if bench.split.of[some.name].get(part, OWN) != OWN)]
        together += choose.promising([row for some in settings if (row := table.row(some))], bench.plan.targets)
    return together


FRESH_SCENE, PROVED = 1_000_000, 200
"""How far from the job's first scene those begin that prove a recommendation, which no study measures before, and the most."""


def crossed_rows(bench: Measurement, rows: Sequence[Row]) -> list[Row]:
    """Of every setting that changes rest alone with every one that changes what is drawn alone; their parts were measured."""
    known = [row.setting for row in rows if row.setting.kind in ("single", "several")]
    resting, drawn = (
        [some for some in known if all(key.startswith(AT_REST) == is_rest for key in some.changes)]
        for is_rest in (True, False)
    )
    crossed = [joined(pair) for pair in itertools.product(resting, drawn)]
    table = Table(split_settings((*bench.plan.settings, *crossed), bench.plan.job.captures is not None), bench.journal)
    return [row for setting in crossed if (row := table.row(setting))]


def choose_and_prove(bench: Measurement) -> tuple[list[Row], list[Row], list[Proof]]:
    """The rows of the table, with every setting that was proved; all that no proof withdrew; the proofs, the answer's last."""
    table, asked, proofs = bench.table(), bench.plan.targets, list[Proof]()
    rows = [row for setting in bench.plan.settings if (row := table.row(setting))]
    able = every = [*rows, *crossed_rows(bench, rows)]
    while True:
        try:
            chosen = choose.recommend(able, asked)
        except choose.TargetError:
            break
        if chosen not in rows:
            rows.append(chosen)
        targets = choose.default_targets(able)[0] if asked is None else asked
        if chosen.setting.name in {proof.setting for proof in proofs} or not (proof := prove(bench, chosen, targets)):
            break
        proofs.append(proof)
        failed = {proof.setting for proof in proofs if not proof.holds}
        able = [row for row in every if row.setting == OWN or row.setting.name not in failed]
        if proof.holds or bench.left_s() <= 0.0:
            break
    return rows, able, proofs


def prove(bench: Measurement, chosen: Row, targets: Targets) -> Proof | None:
    """The chosen setting on fresh scenes, all its parts at once; None where there is no time for a few.

    Its answers are kept, so that the same command proves the same.
    """
    parts = [part for part in bench.split.measured if part in set(map(part_of, targets))]
    if not parts:
        return None
    digest = hashlib.sha256(repr(sorted(chosen.setting.changes.items())).encode()).hexdigest()[:8]
    fresh, first = Setting((("proof", digest),)), bench.plan.job.first_scene + FRESH_SCENE
    scenes = {part: range(first, first + min(PROVED, PARTS[part].scenes)) for part in parts}
    wanted = [item for part in parts for item in choose.missing(bench.table(), part, [fresh], scenes[part])]
    # A scene is drawn after its rest was measured, so that no process settles what another is settling.
    wanted.sort(key=lambda item: ((item.scene_id - first) // bench.plan.processes, parts.index(item.part)))
    bench.run(wanted, 1.0, base=chosen.setting)
    answers = {part: bench.table().answers(part, fresh) for part in parts}
    count = min(map(len, answers.values()))
    if count < choose.FEWEST_SCENES:
        return None
    figures = {name: figure for part in parts for name, figure in figures_of(part, answers[part]).items()}
    asked = {name: target for name, target in targets.items() if name in figures}
    promised = {name: chosen.errors[name] for name in asked if name in chosen.errors}
    return Proof(chosen.setting.name, count, asked, {name: figures[name] for name in asked}, promised)
