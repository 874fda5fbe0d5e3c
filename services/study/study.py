"""The whole study within a budget: a pilot, rounds of a race between settings, the choice, and its proof on fresh scenes."""

import hashlib
import itertools
import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from schemas.errors import RunError, describe_seconds, plural
from services.bench.figures import describe_machine
from services.run.progress import ProgressLine
from services.study.choose import DEFAULT_TARGETS, FEWEST_SCENES, TargetError, answer, recommend, targets_of
from services.study.knobs import REFERENCES, joined
from services.study.lanes import Journal, Lanes, Unit
from services.study.measure import slopes
from services.study.model import ERRORS, NEGLIGIBLE, OWN, Figure, Plan, Proof, Row, Setting, Study
from services.study.race import FIRST_LEVEL, MOST, SHARES, SURE_SCENES, Race, Wanted, grouped, promising
from services.study.table import AGAIN, UNTIMED, Part, Parts, Table, changes_by_part, figures_of, part_of, unit_name

FIRST_SHARE, PILOT_SHARE, RACE_SHARE, LOOK_SHARE, PROOF_SHARE = 0.5, 0.3, 0.87, 0.9, 1.0
"""By these shares of the budget the job's own first scene must be there, and the pilot, the race, the pictures and the proof
end. The first scene has more time than the pilot, because processes start before it, in seconds that no later start saves."""

LATE_SHARE = 0.03
"""What is under way then may take this share more, because a process that is ended takes seconds to come back."""

PAGE_S = 6.0
"""Seconds of the budget that are kept for the tables, the plots and the page."""

FRESH_SCENE = 1_000_000
"""How far from the job's first scene those begin that prove a recommendation: no study measures them before."""

PROVED, LEAST_PROVED = 200, 4
"""The most scenes of a proof, and the fewest."""

MOST_PROOF_SHARE = 0.3
"""Where the fewest scenes of a proof need more than the share that is left for it, they have up to this, and the race less."""

SPENT = "spent"
"""The journal's entry of the seconds that were spent before."""

LEVEL_OF_CHOICE = 8
"""Scenes from which combinations are chosen, and from which a part may be decided."""

RELEASED_SCENES = 4
"""Scenes whose objects are let go again, unless a target asks for more."""

AGAIN_SHARE = 0.002
"""Objects that take longer than this share of the budget to come to rest are not let go again: that takes 15 times as long."""

UNIT_SHARE = 0.01
"""A unit of several settings takes about this share of the budget at most."""

SLOW, LEAST_LIMIT_S = 3.0, 40.0
"""A scene that takes this many times the longest of the job's own, and so many seconds of processor at least, is a time out."""


@dataclass
class Measurement:
    """What a study is measured with: its plan, parts, journal, processes and clock."""

    plan: Plan
    parts: Parts
    journal: Journal
    lanes: Lanes
    progress: ProgressLine
    began: float
    before_s: float
    race_share: float = RACE_SHARE

    @property
    def spent_s(self) -> float:
        """Seconds spent of the budget, those of earlier starts with it."""
        return self.before_s + time.monotonic() - self.began

    def deadline(self, share: float) -> float:
        """The moment of the monotonic clock at which a share of the budget is spent, but for what the page takes."""
        return self.began + share * (self.plan.budget_s - PAGE_S) - self.before_s

    def left_s(self, share: float) -> float:
        """Seconds until then."""
        return self.deadline(share) - time.monotonic()

    def table(self) -> Table:
        """The table so far."""
        return Table(self.parts, self.journal)

    def run(self, wanted: Sequence[Wanted], share: float) -> None:
        """Measures, in order, until a share of the budget is spent, and keeps the answers."""
        first = self.plan.job.first_scene
        groups = grouped(wanted, UNIT_SHARE * self.plan.budget_s)
        own = {part: [one["took"] for one in self.table().answers(part, OWN).values()] for part in self.parts.measured}
        limits = {part: max(LEAST_LIMIT_S, SLOW * max(took)) if took else math.inf for part, took in own.items()}
        units = [Unit(part, scene, scene - first, settings, OWN, limits[part]) for part, scene, settings in groups]
        self.keep(units, share)

    def keep(self, units: Sequence[Unit], share: float) -> None:
        """Measures these units until a share of the budget is spent, and keeps the answers."""
        for unit, answers in self.lanes.run(units, self.deadline(share), self.deadline(share + LATE_SHARE)):
            for one in unit.settings:
                self.journal.add(unit_name(unit.part, unit.scene_id, one), answers[one.name])
            self.progress.show(round(self.spent_s))

    def keep_clock(self) -> None:
        """Writes down what was spent, for the next start."""
        self.journal.add(SPENT, self.spent_s)


def run_study(
    plan: Plan,
    journal: Journal,
    renderer: str,
    command: str,
    left_out: Sequence[str],
    progress: ProgressLine,
    began: float,
) -> Study:
    """Measures until the answer is sure or the budget is spent, proves the answer, and tells it.

    `began` is when the command did, by the monotonic clock. The same journal goes on: a longer budget refines. Raises
    RunError where no scene of the job can be made, or none within the budget.
    """
    parts = split_of(plan)
    with (
        tempfile.TemporaryDirectory(prefix="verso-study-") as scratch,
        Lanes(plan.job, plan.job_folder, plan.processes, Path(scratch)) as lanes,
    ):
        bench = Measurement(plan, parts, journal, lanes, progress, began, float(journal.get(SPENT, 0.0)))
        try:
            race = Race(plan.targets or DEFAULT_TARGETS, plan.job.first_scene, {}, [])
            run_pilot(bench, race)
            bench = run_race(bench, race)
            look_at_errors(bench)
            rows, among, proofs = choose_and_prove(bench)
        finally:
            bench.keep_clock()
        return told(bench, race, rows, among, proofs, renderer, command, left_out)


def split_of(plan: Plan) -> Parts:
    """What is measured of a plan's settings."""
    captured = plan.job.captures is not None
    return Parts.split((*plan.settings, *plan.presets), captured, again=bool(AGAIN.keys() & set(plan.targets or ())))


def run_pilot(bench: Measurement, race: Race) -> None:
    """One scene of the job itself, a few more, then one of every setting, for costs. Raises RunError."""
    run_own(bench, race, 1, FIRST_SHARE)
    table = bench.table()
    missing = [part for part in bench.parts.measured if part not in UNTIMED and not table.answers(part, OWN)]
    if missing:
        raise RunError(
            f"the job's first scene took more than {describe_seconds(max(0.0, FIRST_SHARE * bench.plan.budget_s))}, half of "
            f"--budget {describe_seconds(bench.plan.budget_s)}: give more, such as --budget 2h (the first on a machine also "
            "compiles, for about a minute)"
        )
    first = next(iter(bench.parts.measured))
    if all("failed" in one for one in table.answers(first, OWN).values()):
        few = [Wanted(first, bench.plan.job.first_scene + n, OWN, 0.0) for n in range(1, 4)]
        bench.run([one for one in few if one.scene_id not in table.answers(first, OWN)], FIRST_SHARE)
        failed = bench.table().answers(first, OWN)
        if all("failed" in one for one in failed.values()):
            reasons = sorted({str(one.get("broken", one["failed"])) for one in failed.values()})
            raise RunError(
                f"none of the job's first {plural(len(failed), 'scene')} can be made ({'; '.join(reasons)}): "
                "a study needs scenes; `verso run` with --scenes 4 tells more of each"
            )
    table = bench.table()
    rest_s = [one["took"] for one in table.answers("rest", OWN).values()]
    if rest_s and min(rest_s) > AGAIN_SHARE * bench.plan.budget_s and not AGAIN.keys() & set(race.targets):
        race.left_out.append("again")
    run_own(bench, race, FEWEST_SCENES, PILOT_SHARE)
    table = bench.table()
    bench.run(in_turn([one for part in parts_in(bench, race) for one in race.missing(table, part, 1)]), PILOT_SHARE)


def run_own(bench: Measurement, race: Race, level: int, share: float) -> None:
    """So many scenes of the job itself: part by part, so that a scene is drawn once another process has settled it."""
    for part in (part for part in bench.parts.measured if part not in UNTIMED):
        bench.run([one for one in race.missing(bench.table(), part, level) if one.setting == OWN], share)


def parts_in(bench: Measurement, race: Race) -> list[Part]:
    """The parts that are measured in this job and budget."""
    return [part for part in bench.parts.measured if part not in race.left_out]


def in_turn(wanted: Sequence[Wanted]) -> list[Wanted]:
    """The knobs in turn, the first value of each, then the second, so that a pilot that is cut off knows something of all."""
    place: dict[tuple[str, str], int] = {}
    order = []
    for one in wanted:
        key = one.part, one.setting.knob
        place[key] = place.get(key, 0) + 1
        order.append((one.part == "again", one.setting in REFERENCES, place[key]))
    return [wanted[k] for k in sorted(range(len(wanted)), key=lambda k: order[k])]


def race_share(table: Table, processes: int, budget_s: float) -> float:
    """The share of the budget at which the race ends, so that the pictures and the fewest scenes of a proof still fit."""
    answers = [table.answers(part, OWN).values() for part in table.parts.measured if part not in UNTIMED]
    scene_s = sum(max((one["took"] for one in some), default=0.0) for some in answers)
    share = -(-LEAST_PROVED // processes) * scene_s / max(1.0, budget_s - PAGE_S)
    return min(RACE_SHARE, 1.0 - (LOOK_SHARE - RACE_SHARE) - LATE_SHARE - min(MOST_PROOF_SHARE, share))


def run_race(bench: Measurement, race: Race) -> Measurement:
    """Rounds of twice as many scenes, until every part is decided or the budget's share is spent."""
    levels = dict.fromkeys(parts_in(bench, race), FIRST_LEVEL)
    most = {**MOST, **({} if AGAIN.keys() & set(race.targets) else {"again": RELEASED_SCENES})}
    combined = False
    bench = replace(bench, race_share=race_share(bench.table(), bench.plan.processes, bench.plan.budget_s))
    while levels and bench.left_s(bench.race_share) > 0.0:
        table = bench.table()
        race.judge(table)
        weights = sum(SHARES[part] for part in levels)
        allowed_s = bench.left_s(bench.race_share) * bench.plan.processes / weights
        wanted: list[Wanted] = []
        for part, level in list(levels.items()):
            some, whole = race.next_round(table, part, level, allowed_s * SHARES[part])
            wanted += some
            decided = level >= most[part] or (level > LEVEL_OF_CHOICE and race.is_decided(table, part))
            if decided if whole else not some:
                del levels[part]
            elif whole:  # otherwise what is left of this level waits for what other parts leave of the budget
                levels[part] = 2 * level
        # Scene by scene, so that what the end of the budget cuts off leaves the same scenes of all.
        bench.run(sorted(wanted, key=lambda one: one.scene_id), bench.race_share)
        if not combined and max(levels.values(), default=LEVEL_OF_CHOICE) >= LEVEL_OF_CHOICE:
            bench, combined = with_combinations(bench, race), True
    race.judge(bench.table())
    return bench


def with_combinations(bench: Measurement, race: Race) -> Measurement:
    """The race with promising combinations of knobs of one part; those across parts are put together from their parts."""
    table, plan = bench.table(), bench.plan
    found: list[Setting] = []
    for part in bench.parts.measured:
        if part in UNTIMED:
            continue
        singles = [one for one in plan.settings if one != OWN and bench.parts.of[one.name].get(part, OWN) != OWN]
        rows = [row for one in (OWN, *singles) if (row := table.row(one)) is not None]
        if rows and rows[0].setting == OWN:
            found += promising(rows, race.targets)
    known = {one.name for one in plan.settings}
    plan = replace(plan, settings=(*plan.settings, *(one for one in found if one.name not in known)))
    return replace(bench, plan=plan, parts=split_of(plan))


# ---------------------------------------------------------------------------------------------- the choice and its proof


def all_rows(bench: Measurement) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    """The measured settings' rows, the job's own first; and those of every setting of rest with every one of drawing."""
    table = bench.table()
    settings = (*bench.plan.settings, *bench.plan.presets)
    rows = tuple(row for one in settings if (row := table.row(one)) is not None)
    by_part: dict[Part, list[Setting]] = {part: [] for part in bench.parts.measured}
    for row in rows[1:]:
        changed = [part for part, one in bench.parts.of[row.setting.name].items() if one != OWN and part not in UNTIMED]
        if len(changed) == 1 and row.setting.kind != "preset":
            by_part[changed[0]].append(row.setting)
    crossed = []
    for pair in itertools.product(by_part.get("rest", ()), by_part.get("draw", ())):
        both = joined(pair)
        parts = {**bench.parts.of[pair[1].name], "rest": bench.parts.of[pair[0].name]["rest"]}
        if (row := table.row_of(both, parts)) is not None:
            crossed.append(row)
    return rows, tuple(crossed)


LOOKS = "look"
"""The part, in the journal, of pictures."""


def look_at_errors(bench: Measurement) -> None:
    """Pictures of the job's first scene with the settings that have the largest and the least error of each group."""
    if bench.plan.job.captures is not None or not bench.plan.job.render.rgb:
        return
    table, scene = bench.table(), bench.plan.job.first_scene
    single = [one for one in bench.plan.settings if one.kind in ("own", "single")]
    rows = [row for one in single if (row := table.row(one)) is not None]
    known = {name.split("/", 2)[2] for name in bench.journal if name.startswith(f"{LOOKS}/")}
    settings = [one for one in dict.fromkeys([OWN.name, *telling(rows)]) if one not in known]
    by_name = {row.setting.name: row.setting for row in rows}
    bench.keep(
        [Unit(LOOKS, scene, 0, (by_name[name],)) for name in settings], bench.race_share + LOOK_SHARE - RACE_SHARE
    )


def telling(rows: Sequence[Row]) -> list[str]:
    """Names of the settings with the largest and the least of each group's first error that settings move to be seen."""
    found: dict[str, None] = {}
    for group in ("physics", "labels", "colour"):  # the mirror camera's errors are not in the input view
        for name in (kind.name for kind in ERRORS.values() if kind.group == group and not kind.pooled):
            some = sorted((row.errors[name].value, row.setting.name) for row in rows if name in row.errors)
            if len(some) > 1 and some[-1][0] > max(1.05 * some[0][0], NEGLIGIBLE[ERRORS[name].unit]):
                found |= {some[-1][1]: None, some[0][1]: None}
                break
    return list(found)


def choose_and_prove(bench: Measurement) -> tuple[tuple[Row, ...], tuple[Row, ...], tuple[Proof, ...]]:
    """The rows of the table, with every setting that was proved; all that was chosen among; the proofs, the answer's last."""
    rows, crossed = all_rows(bench)
    proofs: list[Proof] = []
    while True:
        able = without((*rows, *crossed), proofs)
        try:
            chosen = recommend(able, bench.plan.targets)
        except TargetError:
            break
        if chosen not in rows:
            rows = (*rows, chosen)
        asked = targets_of(able, bench.plan.targets)
        if chosen.setting.name in {one.setting for one in proofs} or (proof := prove(bench, chosen, asked)) is None:
            break
        proofs.append(proof)
        if proof.holds or bench.left_s(PROOF_SHARE) <= 0.0:
            break
    return rows, (*rows, *(row for row in crossed if row not in rows)), tuple(proofs)


def without(rows: Sequence[Row], proofs: Sequence[Proof]) -> tuple[Row, ...]:
    """The rows without those that share what failed a proof: the changes of the part whose error was missed.

    The job's own stays, because all others are held against it.
    """
    settings = {row.setting.name: row.setting for row in rows}
    failed = [
        (part, _changes(settings[proof.setting], part)) for proof in proofs for part in map(part_of, proof.missed)
    ]
    return tuple(
        row
        for row in rows
        if row.setting == OWN or all(_changes(row.setting, part) != changes for part, changes in failed)
    )


def _changes(setting: Setting, part: Part) -> Mapping[str, Any]:
    return changes_by_part(setting.changes, captured=part == "capture", again=True)[part]


def prove(bench: Measurement, chosen: Row, targets: Mapping[str, float]) -> Proof | None:
    """The chosen setting on fresh scenes, all its parts at once; None where there is no time for a few.

    Its answers are kept in the journal, so that the same command proves the same.
    """
    parts = sorted({part_of(name) for name in targets}, key=list(bench.parts.measured).index)
    if not parts:
        return None
    digest = hashlib.sha256(repr(sorted(chosen.setting.changes.items())).encode()).hexdigest()[:8]
    first = bench.plan.job.first_scene + FRESH_SCENE
    most = {part: PROVED if part in ("rest", "draw") else MOST[part] for part in parts}
    # A scene is drawn after its rest was measured, so that no process settles what another is settling.
    turns = [
        (n + place * bench.plan.processes, place, n) for place, part in enumerate(parts) for n in range(most[part])
    ]
    units = [
        Unit(part, first + n, n, (OWN,), chosen.setting)
        for part, n in ((parts[place], n) for _, place, n in sorted(turns))
        if f"proof-{digest}/{part}/{first + n}" not in bench.journal
    ]
    for unit, answers in bench.lanes.run(units, bench.deadline(PROOF_SHARE)):
        bench.journal.add(f"proof-{digest}/{unit.part}/{unit.scene_id}", answers[OWN.name])
        bench.progress.show(round(bench.spent_s))
    measured: dict[str, Figure] = {}
    counts = []
    for part in parts:
        place = f"proof-{digest}/{part}/"
        found = {int(name[len(place) :]): one for name, one in bench.journal.items() if name.startswith(place)}
        measured |= figures_of(found)
        counts.append(len(found))
    if min(counts) < LEAST_PROVED:
        return None
    asked = {name: most for name, most in targets.items() if name in measured}
    promised = {name: figure for name in asked if (figure := chosen.errors.get(name)) is not None}
    return Proof(chosen.setting.name, min(counts), asked, {name: measured[name] for name in asked}, promised)


def told(
    bench: Measurement,
    race: Race,
    rows: tuple[Row, ...],
    among: tuple[Row, ...],
    proofs: tuple[Proof, ...],
    renderer: str,
    command: str,
    left_out: Sequence[str],
) -> Study:
    """The study in words and figures: `rows` are shown, and the answer is chosen `among` these and combinations across parts."""
    plan, table = bench.plan, bench.table()
    asked = [one for one in (*plan.settings, *plan.presets) if one.kind in ("single", "preset")]
    missing = [one.name for one in asked if table.row(one) is None]
    if race.left_out:
        left_out = [
            *left_out,
            "objects are not let go again: it would take too much of the budget; --target moved_mm=... asks for it",
        ]
    notes = [*left_out, *([f"not reached within the budget: {', '.join(missing)}"] if missing else [])]
    held = bool(proofs) and proofs[-1].holds
    withdrawn = {one.setting for one in proofs if not one.holds}
    rows = tuple(
        replace(row, notes=(*row.notes, *race.reasons(bench.parts.of.get(row.setting.name, {})))) for row in rows
    )
    able = without(among, proofs)
    scenes = max(len(table.answers(part, OWN)) for part in bench.parts.measured)
    study = Study(
        job=plan.job.name,
        command=command,
        machine=describe_machine(renderer),
        scenes=scenes,
        rows=rows,
        slopes={} if plan.job.captures is not None else slopes(),
        preset=plan.job.preset,
        job_scenes=plan.job.scenes,
        notes=tuple(notes),
        budget_s=plan.budget_s,
        seconds=bench.spent_s,
        doubts=doubts_of(bench, race, table),
        proofs=proofs,
    )
    try:
        chosen = recommend(able, plan.targets).setting.name
    except TargetError:
        chosen = ""
    if chosen in withdrawn or (proofs and not held):
        chosen = ""
    words = answer(replace(study, rows=able), plan.targets)
    if proofs and not held:
        words = (
            f"Nothing is recommended: {', '.join(sorted(withdrawn))} did not keep the targets on fresh scenes. A longer "
            "--budget tells more."
        )
    return replace(study, answer=words, chosen=chosen)


NAMES: Mapping[Part, str] = {
    "rest": "how objects rest",
    "again": "motion when let go again",
    "draw": "depth, masks and the mirror",
    "colour": "colour",
    "capture": "captures",
}
"""Of parts, in words."""


def doubts_of(bench: Measurement, race: Race, table: Table) -> tuple[str, ...]:
    """What is not decided with 95 % confidence, and how long that would take."""
    found = []
    for part in bench.parts.measured:
        rivals = race.open_rivals(table, part)
        if not rivals:
            continue
        scenes = {one.name: len(table.answers(part, one)) for one in rivals}
        need = min(SURE_SCENES, MOST[part])
        wanted_s = (
            sum(max(0, need - scenes[one.name]) * race.cost_s(table, part, one) for one in rivals)
            / bench.plan.processes
        )
        names = [f"{one.name} ({plural(scenes[one.name], 'scene')})" for one in rivals]
        words = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        longer = (
            f"about {describe_seconds(wanted_s)} more would tell"
            if wanted_s > 0
            else "they lie too near to a target to tell"
        )
        found.append(f"{NAMES[part]}: whether these keep the targets is not sure to 95 %: {words}; {longer}")
    return tuple(found)
