"""The cheapest setting that meets the targets, and the front of settings that are worth their time. Pure."""

import math
from collections.abc import Callable, Mapping, Sequence
from decimal import ROUND_CEILING, Context
from typing import NamedTuple

from schemas.errors import InputError, RunError, did_you_mean
from schemas.job.job import Job
from services.study.knobs import OTHER_WORLD
from services.study.model import ERRORS, NEGLIGIBLE, Figure, Row, amount, listed, short, times, unit

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
    if name not in row.errors and name == "failed_share":
        return Figure(row.failed_share, row.failed_share, row.failed_share, row.failed_share, 0)
    return row.errors.get(name) or own_row(rows).errors.get(name)


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


# ---------------------------------------------------------------------------------------------- the choice


def recommend(rows: Sequence[Row], targets: Targets | None = None) -> Row:
    """The setting to use for the targets, or for the default ones without a change for the worse. Raises TargetError."""
    if targets is not None:
        return choose(rows, targets)
    asked, bounds = default_targets(rows)
    seeing = [row for row in rows if not set(dict(row.setting.parts)) & blind_knobs(rows)]
    return choose(seeing, asked, bounds)


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


def choose(rows: Sequence[Row], targets: Targets, bounds: Targets | None = None) -> Row:
    """The cheapest setting all of whose errors meet the targets. Raises TargetError.

    What a user asks for, without `bounds`, is met with bounds for scenes at large (`Figure.bound`). Where no setting does, by
    values (`value <= target`) of settings whose bounds are nearest to the targets; of fewer than `FEWEST_SCENES` scenes of
    the job itself by nothing. Default targets are met by values, and `bounds` are further targets that no message names.
    """
    if unknown := [name for name in targets if all(error_of(row, name, rows) is None for row in rows)]:
        raise TargetError(_describe_unmeasured(rows, unknown[0]))
    able = [row for row in candidates(rows, targets) if meets(row, {**(bounds or {}), **targets}, rows)]
    if not able:
        raise TargetError(describe_miss(rows, targets, default=bounds is not None))
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


def candidates(rows: Sequence[Row], targets: Targets) -> list[Row]:
    """The settings that may be chosen.

    The job itself, and those that were measured in a few scenes at least, make the same world (`OTHER_WORLD`) and do not
    fail `MORE_FAILED` more scenes, unless failed scenes are a target themselves.
    """
    most = math.inf if "failed_share" in targets else own_row(rows).failed_share + MORE_FAILED
    same = [row for row in rows if not OTHER_WORLD & set(dict(row.setting.parts)) and row.failed_share <= most]
    scenes = {row.setting.name: min((one.scenes for one in row.errors.values()), default=math.inf) for row in same}
    return [row for row in same if not row.setting.parts or scenes[row.setting.name] >= FEWEST_SCENES]


def meets(row: Row, targets: Targets, rows: Sequence[Row]) -> bool:
    """Whether all errors are at most their targets; what was never measured is not."""
    figures = {name: error_of(row, name, rows) for name in targets}
    return all(figure is not None and figure.value <= targets[name] for name, figure in figures.items())


def _excess(row: Row, targets: Targets, rows: Sequence[Row]) -> float:
    """How many times its target the bound of a setting's worst error is; 1 where all are met. What is negligible is met."""
    figures = {name: error_of(row, name, rows) for name in targets}
    above = [
        figure.bound / max(targets[name], NEGLIGIBLE[ERRORS[name].unit])
        for name, figure in figures.items()
        if figure is not None and figure.bound > targets[name]
    ]
    return max([1.0, *above])


def cheapest(some: Sequence[Row], rows: Sequence[Row]) -> Row:
    """The cheapest of some of the rows, at least one, so that the choice is repeatable.

    Errors are, to the bit, because scenes are a pure function of job and seed; times are not. So every cost up to `AS_CHEAP`
    times the least upper end of an interval counts as the least, and facts without noise decide among those: the job itself
    first, because a change for 5 % is not worth making; then the least sum of errors relative to the job's own; then the
    fewest changes; then the name.
    """

    def order(row: Row) -> tuple[bool, float, int, str]:
        parts = row.setting.parts
        return bool(parts), round(relative_error(row, rows), 6), len(parts), row.setting.name

    least = min(max(row.ratio, row.ratio_most) for row in some)
    return min((row for row in some if row.ratio <= least * AS_CHEAP), key=order)


def relative_error(row: Row, rows: Sequence[Row]) -> float:
    """The sum of a setting's errors, each as a share of the job's own; what is negligible counts as the bound of that."""
    shares = []
    for name, figure in own_row(rows).errors.items():
        least = NEGLIGIBLE[ERRORS[name].unit]
        shares.append(max((error_of(row, name, rows) or figure).value, least) / max(figure.value, least))
    return sum(shares)


def next_better(rows: Sequence[Row], chosen: Row, targets: Targets) -> Row | None:
    """The cheapest setting that is better: in one target its interval lies below, and in no other its value is above.

    Intervals decide, so that the noise of a few scenes does not count as better.
    """
    better = []
    for row in candidates(rows, targets):
        both = [(error_of(row, name, rows), error_of(chosen, name, rows)) for name in targets]
        pairs = [(theirs, ours) for theirs, ours in both if theirs and ours]
        no_worse = all(theirs.value <= ours.high for theirs, ours in pairs)
        if no_worse and any(theirs.high < ours.low for theirs, ours in pairs):
            better.append(row)
    return cheapest(better, rows) if better else None


# ---------------------------------------------------------------------------------------------- no setting meets them


def _describe_unmeasured(rows: Sequence[Row], name: str) -> str:
    known = ", ".join(sorted({error for row in rows for error in row.errors}))
    return f"--target {name}: this study did not measure it. It measured {known}"


def describe_miss(rows: Sequence[Row], targets: Targets, default: bool = False) -> str:
    """The nearest setting, by how much it misses the targets, and which targets it would meet.

    For `default` targets, which nobody asked for, with the option that sets others.
    """
    nearest = nearest_row(rows, targets)
    missed, loosened = list[str](), dict[str, str]()
    for name, target in targets.items():
        figure = error_of(nearest, name, rows)
        if figure is None:
            missed.append(f"{name}, which was not measured with it")
        elif figure.value > target:
            over = f"{amount(name, figure.value - target)} more than {amount(name, target)}"
            ratio = f" ({times(figure.value / target)})" if target > 0 else ""
            missed.append(f"{name}, {amount(name, figure.value)} is {over}{ratio}")
            above = Context(prec=2, rounding=ROUND_CEILING).create_decimal(repr(figure.value))  # so that it is met
            loosened[name] = f"{above:f}"
    asked = {name: f"{target:g}" for name, target in targets.items()}
    words = listed(missed) or "none of them, and is worse than the job in another error"
    miss = f"The nearest is {nearest.setting.name}, at {times(nearest.ratio)} the job's time: it misses {words}"
    if default:
        return f"no setting meets the default targets. {miss}. Set others with --target {_as_option(asked | loosened)}"
    remedy = f". Loosen to at least {_as_option(loosened)}" if loosened else ""
    return f"no setting meets {_as_option(asked)}. {miss}{remedy}"


def _as_option(targets: Mapping[str, str]) -> str:
    return ",".join(f"{name}={most}" for name, most in targets.items())


def nearest_row(rows: Sequence[Row], targets: Targets) -> Row:
    """The setting whose greatest excess over its targets is the least; then the cheapest, then by name."""

    def excess(row: Row) -> tuple[float, float, str]:
        """How many times its target the worst error is, a target of 0 counting as a millionth; time; and name."""
        figures = {name: error_of(row, name, rows) for name in targets}
        values = {name: math.inf if figure is None else figure.value for name, figure in figures.items()}
        above = [value / max(targets[name], 1e-6) for name, value in values.items() if value > targets[name]]
        return max([1.0, *above]), row.ratio, row.setting.name

    return min(candidates(rows, targets), key=excess)


# ---------------------------------------------------------------------------------------------- what a user types

KEPT = "kept_share"
"""How a user may ask for a share of objects that are kept: `lost_share` is 1 minus it."""


def parse_targets(text: str) -> dict[str, float]:
    """From "penetration_mm=0.1,depth_mm=0.5". Raises InputError with the remedy."""
    targets: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or not name:
            raise InputError(f"--target {part.strip() or text!r}: write it as penetration_mm=0.1,depth_mm=0.5")
        try:
            most = float(value)
        except ValueError:
            most = math.nan
        if name == KEPT:
            name, most = "lost_share", round(1.0 - most, 12)
            value = f"{most:g}"
        if name not in ERRORS:
            known = ", ".join(ERRORS)
            raise InputError(f"--target {name}: there is no such error; {did_you_mean(name, ERRORS)}Known: {known}")
        if name in targets:
            raise InputError(f"--target {name}: is given twice, as {targets[name]:g} and as {value}")
        if not 0.0 <= most < math.inf:
            example = ", a share such as 0.001 for 0.1 %" if unit(name) == "%" else ""
            raise InputError(f"--target {name}={value}: must be a number from 0 up{example}")
        targets[name] = most
    return targets


class Unmeasured(NamedTuple):
    """Jobs in which an error, or the errors of some groups, cannot be measured, and why."""

    is_so: Callable[[Job], bool]
    names: str
    why: str


_UNMEASURED = (
    Unmeasured(lambda job: job.captures is None, "capture", "the job has no captures"),
    Unmeasured(lambda job: job.captures is not None, "physics labels mirror colour", "the job is one of captures"),
    Unmeasured(lambda job: not job.cameras.mirror.enabled, "mirror", "cameras.mirror.enabled is false"),
    Unmeasured(lambda job: not job.render.rgb, "colour", "render.rgb is false"),
    Unmeasured(
        lambda job: job.start.pose == "tumbled" or job.objects_per_scene.high > 1,
        "pose_mm",
        "where things end is random when they tumble or meet, so no pose is the true one; ask for outcome_mm",
    ),
)


def refuse_unmeasured(job: Job, targets: Targets, missing: str | None) -> None:
    """Raises InputError for a target that no setting of the job can have, before anything is measured.

    `missing` says why this machine has no truth of colour.
    """
    for name in targets:
        for row in _UNMEASURED:
            if row.is_so(job) and {name, ERRORS[name].group} & set(row.names.split()):
                raise InputError(f"--target {name}: it cannot be measured here: {row.why}")
        if name == "flip" and missing is not None:
            raise InputError(f"--target flip: {missing}")
