"""The answer in words: which setting to use, what it costs, what is not sure, and the next better one. Pure."""

import math
from collections.abc import Mapping, Sequence

from schemas.errors import describe_seconds, milliseconds, plural, size
from services.study.choose import (
    AS_CHEAP,
    TargetError,
    Targets,
    default_targets,
    error_of,
    next_better,
    own_row,
    recommend,
)
from services.study.knobs import Part
from services.study.model import ERRORS, NEGLIGIBLE, Proof, Row, Study, amount, listed, short, times
from services.study.rounds import MOST, undecided
from services.study.table import Table


def answer(study: Study, rows: Sequence[Row], targets: Targets | None = None) -> str:
    """Which of these rows to use for the targets, what it costs, and what the next better one costs.

    Without targets they are `DEFAULT_TARGETS` as far as the study measured them, and no other error may grow beyond the
    job's own interval, so that a user without a wish keeps the same images.
    """
    asked, bounds = (targets, {}) if targets is not None else default_targets(rows)
    wish = describe_targets(asked)
    try:
        chosen = recommend(rows, targets)
    except TargetError as error:
        return f"{wish[0].upper()}{wish[1:]} is met by nothing that was measured: {error}."
    own = own_row(rows)
    if bounds and (chosen is not own or not asked):
        wish = f"{wish} and nothing else worse than the job has it" if asked else "nothing worse than the job has it"
    use = "use the job as it is" if chosen is own else f"use {chosen.setting.name}"
    saved = "" if chosen is own else f", {times(chosen.ratio)} the job's time"
    given_up = [] if bounds else worse_than(chosen, own, rows)
    loss = f", and gives up {listed(given_up)}" if given_up else ""
    after = _describe_next(chosen, next_better(rows, chosen, {**bounds, **asked}))
    doubt = _doubt(chosen, targets or {}, rows)
    unproved = " It is not proved: the budget left no time for fresh scenes." if asked and not study.proofs else ""
    return f"For {wish}, {use}, which costs {_cost(chosen, study.job_scenes)}{saved}{loss}; {after}.{doubt}{unproved}"


def describe_targets(targets: Targets) -> str:
    """Such as "at most 0.1 mm (penetration, gap) and 0.1 % (the object's mask pixels)"."""
    by_amount: dict[str, list[str]] = {}
    for name, target in targets.items():
        by_amount.setdefault(amount(name, target), []).append(short(name))
    words = [f"{most} ({', '.join(names)})" for most, names in by_amount.items()]
    return f"at most {listed(words)}" if words else "any error at all"


def _cost(row: Row, scenes: int) -> str:
    cost = f"{milliseconds(row.ms)} of processor a scene"
    if not scenes:
        return cost
    whole = f"{describe_seconds(row.ms * scenes / 1e3)}, {size(row.kilobytes * scenes)}"
    return f"{cost} ({scenes:,} scene{'s' * (scenes != 1)}: {whole})"


def _describe_next(chosen: Row, better: Row | None) -> str:
    if better is None:
        return "nothing that was measured is better"
    if better.ratio <= chosen.ratio * AS_CHEAP:
        return f"{better.setting.name} is better and costs as much"
    return f"the next better, {better.setting.name}, costs {times(better.ratio / chosen.ratio)} as much"


def worse_than(row: Row, own: Row, rows: Sequence[Row]) -> list[str]:
    """The losses of a setting against the job, in words: errors whose interval lies above the job's."""
    pairs = [(name, error_of(row, name, rows), ours) for name, ours in own.errors.items()]
    return [
        f"{short(name)} ({amount(name, theirs.value)} instead of {amount(name, ours.value)})"
        for name, theirs, ours in pairs
        if theirs is not None and theirs.low > ours.high and theirs.value > NEGLIGIBLE[ERRORS[name].unit]
    ]


def _doubt(row: Row, targets: Targets, rows: Sequence[Row]) -> str:
    """A sentence on the targets that other scenes may miss; empty where all are sure."""
    figures = {name: error_of(row, name, rows) for name in targets}
    unsure = [
        f"{short(name)} up to {amount(name, figure.bound) if math.isfinite(figure.bound) else 'any'} (from {figure.scenes})"
        for name, figure in figures.items()
        if figure is not None and figure.bound > targets[name]
    ]
    return f" It is not sure to 95 %: scenes that were not measured may have {listed(unsure)}." if unsure else ""


def describe_withdrawn(proofs: Sequence[Proof]) -> str:
    """The answer where no setting kept the targets."""
    names = sorted({proof.setting for proof in proofs})
    return f"Nothing is recommended: {', '.join(names)} did not keep the targets on fresh scenes. A longer --budget tells more."


# ---------------------------------------------------------------------------------------------- what is not decided

NAMES: Mapping[Part, str] = {
    "rest": "how objects rest",
    "again": "motion when let go again",
    "draw": "depth, masks and the mirror",
    "colour": "colour",
    "capture": "captures",
}
"""Of parts, in words."""

SURE_SCENES = 59
"""Scenes that make a 95th percentile sure whatever its distribution (1 - 0.95^59 > 0.95)."""


def doubts_of(table: Table, targets: Targets, processes: int) -> list[str]:
    """What is not decided with 95 % confidence, and how long that would take."""
    doubts = []
    for part in table.parts.measured:
        rivals = undecided(table, part, targets)
        scenes = {one.name: table.scenes(part, one) for one in rivals}
        most = min(SURE_SCENES, MOST[part])
        more_s = sum(max(0, most - scenes[one.name]) * table.cost_s(part, one) for one in rivals) / processes
        names = [f"{one.name} ({plural(scenes[one.name], 'scene')})" for one in rivals]
        words = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        longer = f"about {describe_seconds(more_s)} more would tell"
        after = longer if more_s > 0 else "they lie too near to a target to tell"
        if rivals:
            doubts.append(f"{NAMES[part]}: whether these keep the targets is not sure to 95 %: {words}; {after}")
    return doubts
