"""The whole study within a budget: a pilot, rounds of settings, the choice, and its proof on fresh scenes."""

import hashlib
import itertools
import json
import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from schemas.errors import OutputError, RunError, describe_seconds, plural
from services.run.progress import ProgressLine
from services.study import answer as words
from services.study.choose import DEFAULT_TARGETS, FEWEST_SCENES, TargetError, recommend, targets_of
from services.study.knobs import AGAIN, REFERENCES, TIMED, Part, Parts, changes_by_part, joined, part_of
from services.study.measure import Answer, Unit, answer_unit
from services.study.model import OWN, Figure, Plan, Proof, Row, Setting, Study
from services.study.rounds import MOST, SHARES, Wanted, missing, next_round, promising, undecided, why_out
from services.study.table import Table, figures_of, unit_name
from workers.pool import Answers, Ended, Pool

# ---------------------------------------------------------------------------------------------- what was measured before

JOURNAL_FILE = "answers"

HEADER, SPENT, OTHERS = "study", "spent", "others"
"""Keys of a journal beside those of answers: what was studied, seconds of the budget, seconds that other processes took."""


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
        before = self.setdefault(HEADER, dict(header))
        if other := sorted(key for key in header if before.get(key) != header[key]):
            raise OutputError(
                f"{folder} holds the measurements of another study (other {', '.join(other)}): choose another --out, or "
                f"delete {path.name} there"
            )
        self.add(HEADER, before)

    def add(self, key: str, answer: Any) -> None:
        """Keep an answer, on disk too."""
        self[key] = answer
        self._kept.put(key, json.dumps(answer).encode())


# ---------------------------------------------------------------------------------------------- measuring within a budget

FIRST_SHARE, PILOT_SHARE, PROOF_SHARE = 0.5, 0.3, 1.0
"""By these shares of the budget the job's own first scenes must be there, and the pilot and the proof end. The first scenes
have more time than the pilot, because processes start before them, in seconds that no later start saves."""

LEAST_PROOF_SHARE, MOST_PROOF_SHARE = 0.13, 0.33
"""Within these shares of the budget lies the time that is kept for a proof: that of its fewest scenes."""

LATE_SHARE = 0.03
"""What is under way then may take this share more, because a process that is ended takes seconds to come back."""

PAGE_S = 6.0
"""Seconds of the budget that are kept for the tables, the plots and the page."""

UNIT_SHARE = 0.01
"""A unit of several settings takes about this share of the budget at most."""

SLOW, LEAST_LIMIT_S = 3.0, 40.0
"""A scene that takes this many times the longest of the job's own, and so many seconds of processor at least, is a time out."""


@dataclass
class Measurement:
    """What a study is measured with: its plan, parts, answers so far, processes, the folder that they share, and its clock."""

    plan: Plan
    parts: Parts
    journal: Journal
    pool: Pool[Unit]
    scratch: str
    progress: ProgressLine
    began: float
    before_s: float

    @property
    def targets(self) -> Mapping[str, float]:
        """What settings are measured for."""
        return self.plan.targets or DEFAULT_TARGETS

    @property
    def spent_s(self) -> float:
        """Seconds spent of the budget, those of earlier starts with it."""
        return self.before_s + time.monotonic() - self.began

    def left_s(self, share: float) -> float:
        """Seconds until a share of the budget is spent, but for what the page takes."""
        return share * (self.plan.budget_s - PAGE_S) - self.spent_s

    def table(self) -> Table:
        """The table so far."""
        return Table(self.parts, self.journal)

    def add(self, settings: Iterable[Setting]) -> None:
        """Settings that are measured too from now on."""
        known = {one.name for one in self.plan.settings}
        new = tuple(one for one in settings if one.name not in known)
        self.plan = replace(self.plan, settings=(*self.plan.settings, *new))
        self.parts = split_of(self.plan)

    def run(self, wanted: Sequence[Wanted], share: float) -> None:
        """Measures, in order, until a share of the budget is spent: settings of one part and scene side by side in units."""
        table, units = self.table(), list[Unit]()
        for (part, scene), some in itertools.groupby(wanted, key=lambda one: (one.part, one.scene_id)):
            settings = [one.setting for one in some]
            mean_s = sum(table.cost_s(part, one) for one in settings) / len(settings)
            size = max(1, int(UNIT_SHARE * self.plan.budget_s / max(mean_s, 1e-3)))
            took = [answer["took"] for answer in table.answers(part, OWN).values()]
            limit_s = max(LEAST_LIMIT_S, SLOW * max(took)) if took else math.inf
            units += [
                self.unit(part, scene, settings[n : n + size], limit_s=limit_s) for n in range(0, len(settings), size)
            ]
        self.keep(units, share)

    def keep(self, units: Sequence[Unit], share: float) -> None:
        """Measures these until a share of the budget is spent, and keeps the answers."""
        for unit, setting, answer in self.answers(units, share, share + LATE_SHARE):
            self.journal.add(unit_name(unit.part, unit.scene_id, setting), answer)

    def unit(self, part: Part, scene_id: int, settings: Sequence[Setting], **more: Any) -> Unit:
        """One scene to measure, with what a process must know."""
        number = scene_id - self.plan.job.first_scene
        where = self.plan.job.model_dump_json(), str(self.plan.job_folder), self.scratch
        return Unit(*where, part, scene_id, number, tuple(settings), **more)

    def answers(self, units: Sequence[Unit], share: float, late_share: float) -> Iterator[tuple[Unit, Setting, Answer]]:
        """Each unit with a setting and its answer, as they come; what a process died of is `broken`."""
        last, end = (time.monotonic() + self.left_s(some) for some in (share, late_share))
        for unit, answer in self.pool.run(units, last, end):
            if isinstance(answer, Ended):
                broken = {"failed": "broken", "broken": f"its process died: {answer.detail}", "s": None, "took": 0.0}
                by_name = {one.name: broken for one in unit.settings}
            else:
                by_name = json.loads(answer)
            yield from ((unit, setting, by_name[setting.name]) for setting in unit.settings)
            self.progress.show(round(self.spent_s))

    def race_share(self) -> float:
        """The share of the budget at which rounds end, so that the fewest scenes of a proof still fit."""
        table = self.table()
        own = [table.answers(part, OWN).values() for part in self.parts.timed]
        scene_s = sum(max((answer["took"] for answer in answers), default=0.0) for answers in own)
        share = math.ceil(FEWEST_SCENES / self.plan.processes) * scene_s / max(1.0, self.plan.budget_s - PAGE_S)
        return PROOF_SHARE - min(MOST_PROOF_SHARE, max(LEAST_PROOF_SHARE, LATE_SHARE + share))


def run_study(plan: Plan, journal: Journal, progress: ProgressLine, began: float, **about: Any) -> Study:
    """Measures until the answer is sure or the budget is spent, proves the answer, and puts it in words.

    `began` is when the command did, by the monotonic clock; `about`: further fields of the study. The same journal goes on: a
    longer budget refines. Raises RunError where no scene of the job can be made, or none within the budget.
    """
    with (
        tempfile.TemporaryDirectory(prefix="verso-study-") as scratch,
        Pool(answer_unit, processes=plan.processes) as pool,
    ):
        before_s = float(journal.get(SPENT, 0.0))
        bench = Measurement(plan, split_of(plan), journal, pool, scratch, progress, began, before_s)
        try:
            run_pilot(bench)
            run_rounds(bench)
            rows, able, proofs = choose_and_prove(bench)
        finally:
            journal.add(SPENT, bench.spent_s)
    table = bench.table()
    out = {part: why_out(table, part, bench.targets) for part in bench.parts.measured}

    def with_reasons(row: Row) -> Row:
        of = bench.parts.of.get(row.setting.name, {})
        reasons = dict.fromkeys(out[part][one.name] for part, one in of.items() if one.name in out[part])
        return replace(row, notes=(*row.notes, *(f"out of the race: {reason}" for reason in reasons)))

    study = Study(
        job=plan.job.name,
        scenes=max(table.scenes(part, OWN) for part in bench.parts.measured),
        rows=tuple(map(with_reasons, rows)),
        preset=plan.job.preset,
        job_scenes=plan.job.scenes,
        budget_s=plan.budget_s,
        seconds=bench.spent_s,
        doubts=tuple(words.doubts_of(table, bench.targets, plan.processes)),
        proofs=tuple(proofs),
        **about,
    )
    asked = [one.name for one in (*plan.settings, *plan.presets) if table.row(one) is None]
    if asked:
        study = replace(study, notes=(*study.notes, f"not reached within the budget: {', '.join(asked)}"))
    if proofs and not proofs[-1].holds:
        return replace(study, answer=words.describe_withdrawn(proofs))
    with suppress(TargetError):
        study = replace(study, chosen=recommend(able, plan.targets).setting.name)
    return replace(study, answer=words.answer(study, able, plan.targets))


def split_of(plan: Plan) -> Parts:
    """What is measured of a plan's settings."""
    again = bool(AGAIN & set(plan.targets or ()))
    return Parts.split((*plan.settings, *plan.presets), plan.job.captures is not None, again)


def run_pilot(bench: Measurement) -> None:
    """One scene of the job itself, a few more, then one of every setting, for costs. Raises RunError."""
    timed, first_scene = bench.parts.timed, bench.plan.job.first_scene

    def run_own(parts: Sequence[Part], scenes: int, share: float) -> None:
        # Part by part, so that a scene is drawn once another process has settled it.
        for part in parts:
            bench.run(missing(bench.table(), part, [OWN], range(first_scene, first_scene + scenes)), share)

    run_own(timed, 1, FIRST_SHARE)
    if any(not bench.table().answers(part, OWN) for part in timed):
        raise RunError(
            f"the job's first scene took more than {describe_seconds(max(0.0, FIRST_SHARE * bench.plan.budget_s))}, half of "
            f"--budget {describe_seconds(bench.plan.budget_s)}: give more, such as --budget 2h (the first on a machine also "
            "compiles, for about a minute)"
        )
    run_own(timed[:1], FEWEST_SCENES, FIRST_SHARE)
    own = first_answers(bench)
    if all("failed" in answer for answer in own):
        reasons = sorted({str(answer.get("broken", answer["failed"])) for answer in own})
        raise RunError(
            f"none of the job's first {plural(len(own), 'scene')} can be made ({'; '.join(reasons)}): "
            "a study needs scenes; `verso run` with --scenes 4 tells more of each"
        )
    run_own(timed[1:], FEWEST_SCENES, FIRST_SHARE)
    table, scene = bench.table(), range(first_scene, first_scene + 1)
    bench.run(
        [one for part, some in bench.parts.measured.items() for one in missing(table, part, in_turn(some), scene)],
        PILOT_SHARE,
    )


def first_answers(bench: Measurement) -> list[Mapping[str, Any]]:
    """The job's own answers of its first part."""
    return list(bench.table().answers(bench.parts.timed[0], OWN).values())


def in_turn(settings: Iterable[Setting]) -> list[Setting]:
    """The knobs in turn, the first value of each, then the second, so that a pilot that is cut off knows something of all."""
    turns: dict[str, int] = {}
    places: dict[str, tuple[bool, int]] = {}
    for one in settings:
        turns[one.knob] = turns.get(one.knob, 0) + 1
        places[one.name] = one in REFERENCES, turns[one.knob]
    return sorted(settings, key=lambda one: places[one.name])


LEVEL_OF_CHOICE = 8
"""Scenes from which combinations are chosen, and from which a part may be decided."""


def run_rounds(bench: Measurement) -> None:
    """Rounds of twice as many scenes, until every part is decided or the budget's share is spent.

    A round takes half of the time that is left at most, and each part its share of that.
    """
    levels, share, first = dict.fromkeys(bench.parts.measured, 2), bench.race_share(), bench.plan.job.first_scene
    combined = False
    while levels and bench.left_s(share) > 0.0:
        table, allowed_s = bench.table(), bench.left_s(share) * bench.plan.processes / 2
        weights, wanted = sum(SHARES[part] for part in levels), list[Wanted]()
        for part, level in list(levels.items()):
            scenes = range(first, first + min(level, MOST[part]))
            some, whole = next_round(table, part, bench.targets, scenes, allowed_s * SHARES[part] / weights)
            wanted += some
            decided = level >= MOST[part] or (level > LEVEL_OF_CHOICE and not undecided(table, part, bench.targets))
            if decided if whole else not some:
                del levels[part]
            elif whole:  # otherwise what is left of this level waits for what other parts leave of the budget
                levels[part] = 2 * level
        # Scene by scene, so that what the end of the budget cuts off leaves the same scenes of all.
        bench.run(sorted(wanted, key=lambda one: (one.scene_id, one.part)), share)
        if not combined and max(levels.values(), default=LEVEL_OF_CHOICE) >= LEVEL_OF_CHOICE:
            bench.add(combinations(bench))
            combined = True


def combinations(bench: Measurement) -> list[Setting]:
    """Promising combinations of knobs of one part; those across parts are put together of their parts."""
    table, together = bench.table(), list[Setting]()
    for part in bench.parts.timed:
        settings = [OWN, *(one for one in bench.plan.settings if bench.parts.of[one.name].get(part, OWN) != OWN)]
        together += promising([row for one in settings if (row := table.row(one))], bench.targets)
    return together


# ---------------------------------------------------------------------------------------------- the choice and its proof

FRESH_SCENE = 1_000_000
"""How far from the job's first scene those begin that prove a recommendation: no study measures them before."""

PROVED = 200
"""The most scenes of a proof; the fewest are `FEWEST_SCENES`."""


def all_rows(bench: Measurement) -> tuple[list[Row], list[Row]]:
    """The measured settings' rows, the job's own first; and those of every setting of rest with every one of drawing."""
    table, of = bench.table(), bench.parts.of
    rows = [row for one in (*bench.plan.settings, *bench.plan.presets) if (row := table.row(one))]
    alone: dict[Part, list[Setting]] = {part: [] for part in ("rest", "draw")}
    for setting in (row.setting for row in rows if row.setting.kind != "preset"):
        changed = [part for part, one in of[setting.name].items() if one != OWN and part not in TIMED]
        if len(changed) == 1 and changed[0] in alone:
            alone[changed[0]].append(setting)
    pairs = itertools.product(alone["rest"], alone["draw"])
    of_rest = {part for part in bench.parts.measured if TIMED.get(part, part) == "rest"}
    crossed = [
        table.row(joined((rest, drawn)), {**of[drawn.name], **{part: of[rest.name][part] for part in of_rest}})
        for rest, drawn in pairs
    ]
    return rows, [row for row in crossed if row is not None]


def choose_and_prove(bench: Measurement) -> tuple[list[Row], list[Row], list[Proof]]:
    """The rows of the table, with every setting that was proved; all that no proof withdrew; the proofs, the answer's last."""
    rows, crossed = all_rows(bench)
    proofs: list[Proof] = []
    while True:
        able = without([*rows, *(row for row in crossed if row not in rows)], proofs)
        try:
            chosen = recommend(able, bench.plan.targets)
        except TargetError:
            break
        if chosen not in rows:
            rows.append(chosen)
        if chosen.setting.name in {proof.setting for proof in proofs}:
            break
        proof = prove(bench, chosen, targets_of(able, bench.plan.targets))
        if proof is not None:
            proofs.append(proof)
        if proof is None or proof.holds or bench.left_s(PROOF_SHARE) <= 0.0:
            break
    return rows, without([*rows, *(row for row in crossed if row not in rows)], proofs), proofs


def without(rows: Sequence[Row], proofs: Sequence[Proof]) -> list[Row]:
    """The rows without those that share what failed a proof: the changes of the part whose error was missed.

    The job's own stays, because all others are held against it.
    """
    changes = {row.setting.name: row.setting.changes for row in rows}
    failed = [
        (part, changes_by_part(changes[proof.setting], [part]))
        for proof in proofs
        for part in map(part_of, proof.missed)
    ]
    return [
        row
        for row in rows
        if row.setting == OWN or all(changes_by_part(row.setting.changes, [part]) != bad for part, bad in failed)
    ]


def prove(bench: Measurement, chosen: Row, targets: Mapping[str, float]) -> Proof | None:
    """The chosen setting on fresh scenes, all its parts at once; None where there is no time for a few.

    Its answers are kept, so that the same command proves the same.
    """
    parts = [part for part in bench.parts.measured if part in set(map(part_of, targets))]
    if not parts:
        return None
    key = f"proof-{hashlib.sha256(repr(sorted(chosen.setting.changes.items())).encode()).hexdigest()[:8]}"
    first = bench.plan.job.first_scene + FRESH_SCENE
    most = {part: PROVED if part in ("rest", "draw") else MOST[part] for part in parts}
    # A scene is drawn after its rest was measured, so that no process settles what another is settling.
    turns = [
        (n + place * bench.plan.processes, place, n) for place, part in enumerate(parts) for n in range(most[part])
    ]
    fresh = [(parts[place], first + n) for _, place, n in sorted(turns)]
    units = [
        bench.unit(part, scene, [OWN], base=chosen.setting)
        for part, scene in fresh
        if f"{key}/{part}/{scene}" not in bench.journal
    ]
    for unit, _, answer in bench.answers(units, PROOF_SHARE, PROOF_SHARE):
        bench.journal.add(f"{key}/{unit.part}/{unit.scene_id}", answer)
    measured: dict[str, Figure] = {}
    counts = []
    for part in parts:
        names = {n: name for n in range(most[part]) if (name := f"{key}/{part}/{first + n}") in bench.journal}
        measured |= figures_of({n: bench.journal[name] for n, name in names.items()})
        counts.append(len(names))
    if min(counts) < FEWEST_SCENES:
        return None
    asked = {name: target for name, target in targets.items() if name in measured}
    promised = {name: chosen.errors[name] for name in asked if name in chosen.errors}
    return Proof(chosen.setting.name, min(counts), asked, {name: measured[name] for name in asked}, promised)
