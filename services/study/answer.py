"""The answer of a study in one sentence. Pure."""

from collections.abc import Sequence

from schemas.errors import describe_seconds
from services.study.choose import (
    AS_CHEAP,
    TargetError,
    Targets,
    candidates,
    cheapest,
    choose,
    describe_default_miss,
    error_of,
    own_row,
)
from services.study.model import Row, Study
from services.study.words import amount, listed, milliseconds, short, size, times

DEFAULT_TARGETS: Targets = {
    "penetration_mm": 0.1,
    "gap_mm": 0.1,
    "unbalanced_share": 0.01,
    "pose_mm": 0.1,
    "depth_mm": 0.1,
    "mask_share": 0.001,
    "camera_mm": 0.5,
    "camera_deg": 0.05,
    "cloud_mm": 1.0,
    "cloud_p95_mm": 3.0,
    "missing_share": 0.05,
    "view_depth_mm": 1.5,
}
"""The targets without a wish of the user: the accuracy that a dataset's labels promise."""


def answer(study: Study, targets: Targets | None = None) -> str:
    """One sentence: which setting to use for the targets, what it costs, and what the next better one costs.

    Without targets they are `DEFAULT_TARGETS` as far as the study measured them, and no other error may grow beyond the
    job's own interval, so that a user without a wish keeps the same images.
    """
    asked, bounds = (targets, {}) if targets is not None else default_targets(study.rows)
    wish = describe_targets(asked)
    try:
        chosen = recommend(study, targets)
    except TargetError as error:
        return f"{wish[0].upper()}{wish[1:]} is met by nothing that was measured: {error}."
    own = own_row(study.rows)
    if bounds and (chosen is not own or not asked):
        wish = f"{wish} and nothing else worse than the job has it" if asked else "nothing worse than the job has it"
    use = "use the job as it is" if chosen is own else f"use {chosen.setting.name}"
    cost, count = f"{milliseconds(chosen.ms)} of processor a scene", study.job_scenes
    if count:
        whole = f"{describe_seconds(chosen.ms * count / 1e3)}, {size(chosen.kilobytes * count)}"
        cost += f" ({count:,} scene{'s' * (count != 1)}: {whole})"
    saved = "" if chosen is own else f", {times(chosen.ratio)} the job's time"
    given_up = [] if bounds else worse_than(chosen, own, study.rows)
    loss = f", and gives up {listed(given_up)}" if given_up else ""
    better = next_better(study.rows, chosen, {**bounds, **asked})
    if better is None:
        after = "nothing that was measured is better"
    elif better.ratio <= chosen.ratio * AS_CHEAP:
        after = f"{better.setting.name} is better and costs as much"
    else:
        after = f"the next better, {better.setting.name}, costs {times(better.ratio / chosen.ratio)} as much"
    return f"For {wish}, {use}, which costs {cost}{saved}{loss}; {after}."


def recommend(study: Study, targets: Targets | None = None) -> Row:
    """The setting that the sentence names. Raises TargetError, InputError."""
    if targets is not None:
        return choose(study.rows, targets)
    asked, bounds = default_targets(study.rows)
    seeing = [row for row in study.rows if not set(dict(row.setting.parts)) & blind_knobs(study.rows)]
    try:
        return choose(seeing, asked, bounds)
    except TargetError:
        raise TargetError(describe_default_miss(seeing, asked)) from None


def default_targets(rows: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    """The default targets that were measured, and the bound of every other error: the upper end of the job's own interval."""
    own = own_row(rows).errors
    asked = {name: target for name, target in DEFAULT_TARGETS.items() if name in own}
    return asked, {name: max(own[name].value, own[name].high) for name in own if name not in asked}


def blind_knobs(rows: Sequence[Row]) -> set[str]:
    """Knobs without any measured error, such as the tier without FLIP: their loss is unknown."""
    single = [(row.setting.knob, row) for row in rows if len(row.setting.parts) == 1]
    return {knob for knob, _ in single} - {knob for knob, row in single if set(row.errors) - {"failed_share"}}


def describe_targets(targets: Targets) -> str:
    """Such as "at most 0.1 mm (penetration, gap) and 0.1 % (the object's mask pixels)"."""
    by_amount: dict[str, list[str]] = {}
    for name, target in targets.items():
        by_amount.setdefault(amount(name, target), []).append(short(name))
    words = [f"{most} ({', '.join(names)})" for most, names in by_amount.items()]
    return f"at most {listed(words)}" if words else "any error at all"


def next_better(rows: Sequence[Row], chosen: Row, targets: Targets) -> Row | None:
    """The cheapest setting that is better: in one target its interval lies below, and in no other its value is above.

    Intervals decide, so that the noise of a few scenes does not count as better; among equal costs (`AS_CHEAP`) errors
    decide, as in `choose`.
    """
    better = []
    for row in candidates(rows, targets):
        both = [(error_of(row, name, rows), error_of(chosen, name, rows)) for name in targets]
        pairs = [(theirs, ours) for theirs, ours in both if theirs and ours]
        no_worse = all(theirs.value <= ours.high for theirs, ours in pairs)
        if no_worse and any(theirs.high < ours.low for theirs, ours in pairs):
            better.append(row)
    return cheapest(better, rows) if better else None


def worse_than(row: Row, own: Row, rows: Sequence[Row]) -> list[str]:
    """The losses of a setting against the job, in words: errors whose interval lies above the job's."""
    worse = []
    for name, ours in own.errors.items():
        theirs = error_of(row, name, rows)
        if theirs is not None and theirs.low > ours.high:
            worse.append(f"{short(name)} ({amount(name, theirs.value)} instead of {amount(name, ours.value)})")
    return worse
