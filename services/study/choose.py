"""The cheapest setting that meets the targets, the front of settings worth their time, and the answer in words. Pure."""

import math
from collections.abc import Callable, Mapping, Sequence
from decimal import ROUND_CEILING, Context

from schemas.errors import InputError, RunError, describe_seconds, did_you_mean, milliseconds, size
from schemas.job.job import Job
from services.study.knobs import OTHER_WORLD
from services.study.model import ERRORS, NEGLIGIBLE, Figure, Row, Study, amount, listed, short, times, unit

Targets = Mapping[str, float]
"""The greatest allowed value of each error, by name of `ERRORS`, in the unit of the table: shares from 0 to 1."""

AS_CHEAP = 1.05
"""Costs up to this many times the least count as the least: interleaved medians on one core repeat within some 3 %."""

FEWEST_SCENES = 4
"""Fewer scenes recommend nothing, and compare nothing: a setting that is better in one or two is so by chance."""

MORE_FAILED = 0.01
"""A setting may fail this share of scenes more than the job; one that fails more is cheap because it leaves work out."""

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


class TargetError(RunError):
    """No setting meets the targets; the message names the nearest, by how much it misses, and what it would meet."""


def own_row(rows: Sequence[Row]) -> Row:
    """The row of the job as it is. Raises ValueError where there is none."""
    for row in rows:
        if not row.setting.parts:
            return row
    raise ValueError("a study has one row for the job as it is; here there is none")


def error_of(row: Row, name: str, rows: Sequence[Row]) -> Figure | None:
    """An error of a setting, or the job's own where this setting did not measure it, or None where neither did.

    A setting measures only the errors that its knobs can move.
    """
    found = row.errors.get(name)
    if found is None and name == "failed_share":
        found = Figure(row.failed_share, row.failed_share, row.failed_share, row.failed_share, 0)
    return found or own_row(rows).errors.get(name)


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """The Pareto front of time and an error, from the cheapest setting to the best, of those measured in a few scenes at least.

    Of settings equal in both, the first by name is kept.
    """
    kept: list[Row] = []
    known = [row for row in rows if tells(row, error) and not math.isnan(row.errors[error].value)]
    for row in sorted(known, key=lambda row: (row.ratio, row.errors[error].value, row.setting.name)):
        if not kept or row.errors[error].value < kept[-1].errors[error].value:
            kept.append(row)
    return kept


def tells(row: Row, error: str) -> bool:
    """Whether a setting measured an error in enough scenes to say that it is better or worse than another."""
    return error in row.errors and row.errors[error].scenes >= FEWEST_SCENES


def as_cheap(row: Row, other: Row) -> bool:
    """Whether the times of two settings overlap, so that their order is noise."""
    return row.ratio_least <= other.ratio_most and other.ratio_least <= row.ratio_most


def choose(rows: Sequence[Row], targets: Targets, bounds: Targets | None = None) -> Row:
    """The cheapest setting all of whose errors meet the targets. Raises InputError, TargetError.

    What a user asks for, without `bounds`, is met with bounds for scenes at large (`Figure.bound`). Where no setting does, by
    values (`value <= target`) of settings whose bounds are nearest to the targets; of fewer than `FEWEST_SCENES` scenes of
    the job itself by nothing. Default targets are met by values.

    An error that a setting did not measure is the job's own (`error_of`). Unless failed scenes are a target themselves, a
    setting that fails `MORE_FAILED` more of them than the job is left out. `bounds` are further targets that the message
    does not name.

    The choice should be repeatable. Errors are, to the bit, because scenes are a pure function of job and seed; times are
    not. So every cost up to `AS_CHEAP` times the least upper end of an interval counts as the least, and facts without noise
    decide among those: the job itself first, because a change for 5 % is not worth making; then the least sum of errors
    relative to the job's own; then the fewest changes; then the name.
    """
    check_targets(rows, targets)
    able = [row for row in candidates(rows, targets) if meets(row, {**(bounds or {}), **targets}, rows)]
    if not able:
        raise TargetError(describe_miss(rows, targets))
    if bounds is not None:
        return cheapest(able, rows)
    own = own_row(rows)
    if few := [name for name in targets if name in own.errors and not tells(own, name)]:
        raise TargetError(
            f"of {listed([short(name) for name in few])} fewer than {FEWEST_SCENES} scenes of the job were measured, which "
            "promise nothing of others: give a longer --budget"
        )
    excess = {row.setting.name: _excess(row, targets, rows) for row in able}
    most = max(1.0, min(excess.values()) * AS_CHEAP)
    return cheapest([row for row in able if excess[row.setting.name] <= most], rows)


def _excess(row: Row, targets: Targets, rows: Sequence[Row]) -> float:
    """How many times its target the bound of a setting's worst error is; 1 where all are met. What is negligible is met."""
    worst = 1.0
    for name, target in targets.items():
        figure = error_of(row, name, rows)
        if figure is not None and figure.bound > target:
            worst = max(worst, figure.bound / max(target, NEGLIGIBLE[ERRORS[name].unit]))
    return worst


def cheapest(some: Sequence[Row], rows: Sequence[Row]) -> Row:
    """The cheapest of some of the rows, at least one, by the rules of `choose`."""

    def order(row: Row) -> tuple[bool, float, int, str]:
        parts = row.setting.parts
        return bool(parts), round(relative_error(row, rows), 6), len(parts), row.setting.name

    least = min(max(row.ratio, row.ratio_most) for row in some)
    return min((row for row in some if row.ratio <= least * AS_CHEAP), key=order)


def relative_error(row: Row, rows: Sequence[Row]) -> float:
    """The sum of a setting's errors, each as a share of the job's own; what is negligible counts as the bound of that."""
    own = own_row(rows).errors
    shares = []
    for name, figure in own.items():
        least = NEGLIGIBLE[ERRORS[name].unit]
        shares.append(max((error_of(row, name, rows) or figure).value, least) / max(figure.value, least))
    return sum(shares)


def candidates(rows: Sequence[Row], targets: Targets) -> list[Row]:
    """The settings that may be chosen.

    The job itself, and those that were measured in a few scenes at least, make the same world (`OTHER_WORLD`) and do not
    fail too many scenes.
    """
    most = own_row(rows).failed_share + MORE_FAILED
    same = [row for row in rows if not OTHER_WORLD & set(dict(row.setting.parts))]
    same = [row for row in same if not row.setting.parts or _scenes(row) >= FEWEST_SCENES]
    return [row for row in same if "failed_share" in targets or row.failed_share <= most]


def _scenes(row: Row) -> float:
    """The fewest scenes of a setting's errors; infinite where it measured none."""
    return min((figure.scenes for figure in row.errors.values()), default=math.inf)


def meets(row: Row, targets: Targets, rows: Sequence[Row]) -> bool:
    """Whether all errors are at most their targets; what was never measured is not."""
    found = {name: error_of(row, name, rows) for name in targets}
    return all(figure is not None and figure.value <= targets[name] for name, figure in found.items())


def check_targets(rows: Sequence[Row], targets: Targets) -> None:
    """Raises InputError for an error that is not known, TargetError for one that no setting has measured."""
    for name in targets:
        if name not in ERRORS:
            raise InputError(_unknown(name))
        if all(error_of(row, name, rows) is None for row in rows):
            why = sorted({note for row in rows for note in row.notes if name in note})
            known = ", ".join(sorted({error for row in rows for error in row.errors}))
            raise TargetError(
                f"--target {name}: this study did not measure it{': ' + '; '.join(why) if why else ''}. It measured {known}"
            )


def _unknown(name: str) -> str:
    return f"--target {name}: there is no such error; {did_you_mean(name, ERRORS)}Known: {', '.join(ERRORS)}"


# ---------------------------------------------------------------------------------------------- no setting meets them


def describe_miss(rows: Sequence[Row], targets: Targets, default: bool = False) -> str:
    """The nearest setting, by how much it misses the targets, and which targets it would meet.

    For `default` targets, which nobody asked for, with the option that sets others.
    """
    nearest = nearest_row(rows, targets)
    told, loosened = [], {}
    for name, target in targets.items():
        found = error_of(nearest, name, rows)
        if found is None:
            told.append(f"{name}, which was not measured with it")
        elif found.value > target:
            over = f"{amount(name, found.value - target)} more than {amount(name, target)}"
            ratio = f" ({times(found.value / target)})" if target > 0 else ""
            told.append(f"{name}, {amount(name, found.value)} is {over}{ratio}")
            above = Context(prec=2, rounding=ROUND_CEILING).create_decimal(repr(found.value))  # so that it is met
            loosened[name] = f"{above:f}"
    asked = {name: f"{target:g}" for name, target in targets.items()}
    missed = listed(told) or "none of them, and is worse than the job in another error"
    miss = f"The nearest is {nearest.setting.name}, at {times(nearest.ratio)} the job's time: it misses {missed}"
    if default:
        others = _as_option({**asked, **loosened}, ",")
        return f"no setting meets the default targets. {miss}. Set others with --target {others}"
    remedy = f". Loosen to at least {_as_option(loosened, ',')}" if loosened else ""
    return f"no setting meets {_as_option(asked, ', ')}. {miss}{remedy}"


def _as_option(targets: Mapping[str, str], between: str) -> str:
    return between.join(f"{name}={most}" for name, most in targets.items())


def nearest_row(rows: Sequence[Row], targets: Targets) -> Row:
    """The setting whose greatest excess over its targets is the least; then the cheapest, then by name."""

    def key(row: Row) -> tuple[float, float, str]:
        """How many times its target the worst error is, a target of 0 counting as a millionth; time; and name."""
        worst = 1.0
        for name, target in targets.items():
            found = error_of(row, name, rows)
            value = math.inf if found is None else found.value
            worst = max(worst, value / max(target, 1e-6) if value > target else 1.0)
        return worst, row.ratio, row.setting.name

    return min(candidates(rows, targets), key=key)


# ---------------------------------------------------------------------------------------------- what a user types


def parse_targets(text: str) -> dict[str, float]:
    """From "penetration_mm=0.1,depth_mm=0.5". Raises InputError with the remedy."""
    targets: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        name, value = _as_lost(name, value)
        if not equals or not name:
            raise InputError(f"--target {part.strip() or text!r}: write it as penetration_mm=0.1,depth_mm=0.5")
        if name not in ERRORS:
            raise InputError(_unknown(name))
        if name in targets:
            raise InputError(f"--target {name}: is given twice, as {targets[name]:g} and as {value}")
        try:
            targets[name] = float(value)
        except ValueError:
            targets[name] = math.nan
        if not 0.0 <= targets[name] < math.inf:
            example = ", a share such as 0.001 for 0.1 %" if unit(name) == "%" else ""
            raise InputError(f"--target {name}={value}: must be a number from 0 up{example}")
    return targets


KEPT = "kept_share"
"""How a user may ask for a share of objects that are kept: `lost_share` is 1 minus it."""


def _as_lost(name: str, value: str) -> tuple[str, str]:
    if name != KEPT:
        return name, value
    try:
        return "lost_share", f"{round(1.0 - float(value), 12)}"
    except ValueError:
        return "lost_share", value


_NOT_MEASURED: tuple[tuple[Callable[[Job], bool], str, str], ...] = (
    (lambda job: job.captures is None, "capture", "the job has no captures"),
    (lambda job: job.captures is not None, "physics labels mirror colour", "the job is one of captures"),
    (lambda job: not job.cameras.mirror.enabled, "mirror", "cameras.mirror.enabled is false"),
    (lambda job: not job.render.rgb, "colour", "render.rgb is false"),
    (
        lambda job: job.start.pose == "tumbled" or job.objects_per_scene.high > 1,
        "pose_mm",
        "where things end is random when they tumble or meet, so no pose is the true one; ask for outcome_mm",
    ),
)
"""Jobs in which an error, or the errors of some groups, cannot be measured, and why."""


def refuse_unmeasured(job: Job, targets: Targets, missing: str | None) -> None:
    """Raises InputError for a target that no setting of the job can have, before anything is measured.

    `missing` says why this machine has no truth of colour.
    """
    for name in targets:
        for is_so, what, why in _NOT_MEASURED:
            if is_so(job) and (name in what.split() or ERRORS[name].group in what.split()):
                raise InputError(f"--target {name}: it cannot be measured here: {why}")
        if name == "flip" and missing is not None:
            raise InputError(f"--target flip: {missing}")


def answer(study: Study, targets: Targets | None = None) -> str:
    """One sentence: which setting to use for the targets, what it costs, and what the next better one costs.

    Without targets they are `DEFAULT_TARGETS` as far as the study measured them, and no other error may grow beyond the
    job's own interval, so that a user without a wish keeps the same images.
    """
    asked, bounds = (targets, {}) if targets is not None else default_targets(study.rows)
    wish = describe_targets(asked)
    try:
        chosen = recommend(study.rows, targets)
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
    unproved = " It is not proved: the budget left no time for fresh scenes." if asked and not study.proofs else ""
    better = next_better(study.rows, chosen, {**bounds, **asked})
    if better is None:
        after = "nothing that was measured is better"
    elif better.ratio <= chosen.ratio * AS_CHEAP:
        after = f"{better.setting.name} is better and costs as much"
    else:
        after = f"the next better, {better.setting.name}, costs {times(better.ratio / chosen.ratio)} as much"
    return f"For {wish}, {use}, which costs {cost}{saved}{loss}; {after}.{_doubt(chosen, targets or {}, study.rows)}{unproved}"


def _doubt(row: Row, targets: Targets, rows: Sequence[Row]) -> str:
    """A sentence on the targets that other scenes may miss; empty where all are sure."""
    found = {name: error_of(row, name, rows) for name in targets}
    open_ = [
        f"{short(name)} up to {amount(name, figure.bound) if math.isfinite(figure.bound) else 'any'} (from {figure.scenes})"
        for name, figure in found.items()
        if figure is not None and figure.bound > targets[name]
    ]
    return f" It is not sure to 95 %: scenes that were not measured may have {listed(open_)}." if open_ else ""


def recommend(rows: Sequence[Row], targets: Targets | None = None) -> Row:
    """The setting that the sentence names. Raises TargetError, InputError."""
    if targets is not None:
        return choose(rows, targets)
    asked, bounds = default_targets(rows)
    seeing = [row for row in rows if not set(dict(row.setting.parts)) & blind_knobs(rows)]
    try:
        return choose(seeing, asked, bounds)
    except TargetError:
        raise TargetError(describe_miss(seeing, asked, default=True)) from None


def targets_of(rows: Sequence[Row], targets: Targets | None) -> Targets:
    """The targets that were asked for, or the default ones that were measured."""
    return default_targets(rows)[0] if targets is None else targets


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
        if theirs is not None and theirs.low > ours.high and theirs.value > NEGLIGIBLE[ERRORS[name].unit]:
            worse.append(f"{short(name)} ({amount(name, theirs.value)} instead of {amount(name, ours.value)})")
    return worse
