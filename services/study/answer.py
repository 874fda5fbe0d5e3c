"""Pure: the one sentence that a study comes to."""

from collections.abc import Sequence

from services.study.choose import AS_CHEAP, TargetError, Targets, candidates, cheapest, choose, error_of, own_row
from services.study.model import Figure, Row, Study
from services.study.words import amount, duration, listed, milliseconds, short, size, times

DEFAULT_TARGETS: Targets = {"penetration_mm": 0.1, "gap_mm": 0.1, "pose_mm": 0.1, "depth_mm": 0.1, "mask_share": 0.001}
"""What is asked where nothing is: what a dataset's labels are promised to keep to."""


def answer(study: Study, targets: Targets | None = None) -> str:
    """One sentence: which setting to use for the targets, what it costs, and what the next better costs.

    Where no targets are given they are `DEFAULT_TARGETS` as far as the study measured them, and nothing else may become
    worse than the job is, as far as the scenes can tell: whoever asks for nothing keeps the images that they have.
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
    cost = f"{milliseconds(chosen.ms)} of processor a scene{_whole(study, chosen)}"
    saved = "" if chosen is own else f", {times(chosen.ratio)} the job's time"
    given_up = [] if bounds else worse_than(chosen, own, study.rows)
    loss = f", and gives up {listed(given_up)}" if given_up else ""
    after = _after(chosen, next_better(study.rows, chosen, {**bounds, **asked}))
    return f"For {wish}, {use}, which costs {cost}{saved}{loss}; {after}."


def _after(chosen: Row, better: Row | None) -> str:
    if better is None:
        return "nothing that was measured is better"
    if better.ratio <= chosen.ratio * AS_CHEAP:
        return f"{better.setting.name} is better and costs as much"
    return f"the next better, {better.setting.name}, costs {times(better.ratio / chosen.ratio)} as much"


def recommend(study: Study, targets: Targets | None = None) -> Row:
    """The setting that the sentence names. Raises TargetError, InputError."""
    if targets is not None:
        return choose(study.rows, targets)
    asked, bounds = default_targets(study.rows)
    seeing = [row for row in study.rows if not set(dict(row.setting.parts)) & blind_knobs(study.rows)]
    return choose(seeing, asked, bounds)


def default_targets(rows: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    """What is asked where nothing is, and what every other error may be: the upper end of the job's own interval."""
    own = own_row(rows).errors
    asked = {name: target for name, target in DEFAULT_TARGETS.items() if name in own}
    return asked, {name: max(own[name].value, own[name].high) for name in own if name not in asked}


def blind_knobs(rows: Sequence[Row]) -> set[str]:
    """Knobs of which no value has a figure, such as the tier where FLIP was not measured: nobody knows what they cost."""
    single = [(row.setting.parts[0][0], row) for row in rows if len(row.setting.parts) == 1]
    return {knob for knob, _ in single} - {knob for knob, row in single if set(row.errors) - {"failed_share"}}


def describe_targets(targets: Targets) -> str:
    """Such as "at most 0.1 mm (penetration, gap) and 0.1 % (the object's mask pixels)"."""
    by_amount: dict[str, list[str]] = {}
    for name, target in targets.items():
        by_amount.setdefault(amount(name, target), []).append(short(name))
    words = [f"{most} ({', '.join(names)})" for most, names in by_amount.items()]
    return f"at most {listed(words)}" if words else "any error at all"


def next_better(rows: Sequence[Row], chosen: Row, targets: Targets) -> Row | None:
    """The cheapest that is better in what was asked: one interval below, and no other value above.

    Intervals decide, so that noise of a few scenes is not called better; and of what costs as much as the cheapest
    (`AS_CHEAP`) errors decide, as in `choose`.
    """

    def pair(row: Row, name: str) -> tuple[Figure, Figure] | None:
        theirs, ours = error_of(row, name, rows), error_of(chosen, name, rows)
        return (theirs, ours) if theirs and ours else None

    better = []
    for row in candidates(rows, targets):
        pairs = [both for name in targets if (both := pair(row, name))]
        if all(theirs.value <= ours.high for theirs, ours in pairs):
            better += [row] if any(theirs.high < ours.low for theirs, ours in pairs) else []
    return cheapest(better, rows) if better else None


def worse_than(row: Row, own: Row, rows: Sequence[Row]) -> list[str]:
    """What a setting gives up against the job, in words: errors whose interval lies above the job's."""
    worse = []
    for name, ours in own.errors.items():
        theirs = error_of(row, name, rows)
        if theirs is not None and theirs.low > ours.high:
            worse.append(f"{short(name)} ({amount(name, theirs.value)} instead of {amount(name, ours.value)})")
    return worse


def _whole(study: Study, row: Row) -> str:
    if not study.job_scenes:
        return ""
    count = f"{study.job_scenes:,} scene{'s' * (study.job_scenes != 1)}"
    return f" ({count}: {duration(row.ms * study.job_scenes / 1e3)}, {size(row.kilobytes * study.job_scenes)})"
