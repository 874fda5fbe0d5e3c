"""The cheapest setting that meets the targets, the front of settings that are worth their time, and the answer in words. Pure."""

import math
from collections.abc import Callable, Sequence

from schemas.errors import InputError, RunError, describe_seconds, did_you_mean, milliseconds, plural, size
from schemas.job.job import Job
from services.study.model import ERRORS, Figure, Proof, Row, Targets, amount, short, times

AS_CHEAP, WORTH = 1.05, 0.05
"""Costs up to this many times the least count as the least: interleaved medians on one core repeat within some 3 %. And the
share of the job's time that a change has to save, with its whole interval below the job's time, to be worth making."""

FEWEST_SCENES, MORE_FAILED = 4, 0.01
"""Fewer scenes recommend nothing, as what is better in one or two is so by chance; and the share of scenes that a setting may
fail more than the job, because one that fails more is cheap as it leaves work out."""

DEFAULT_TARGETS: Targets = {kind.name: kind.target for kind in ERRORS.values() if kind.target is not None}
"""The targets without a wish of the user: the accuracy that a dataset's labels promise."""


class TargetError(RunError):
    """No setting meets the targets; the message names the nearest, by how much it misses, and what it would meet."""


def own_row(rows: Sequence[Row]) -> Row:
    """The row of the job as it is, which every table has."""
    return next(row for row in rows if not row.setting.parts)


def error_of(row: Row, name: str, rows: Sequence[Row]) -> Figure | None:
    """An error of a setting, or the job's own where this setting did not measure it, or None where neither did.

    A setting measures only the errors that its knobs can move.
    """
    return row.errors.get(name) or own_row(rows).errors.get(name)


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """The Pareto front of time and an error, the cheapest setting first, of those measured in a few scenes; of ties by name."""
    kept: list[Row] = []
    known = [row for row in rows if tells(row, error)]
    for row in sorted(known, key=lambda row: (row.ratio, row.errors[error].value, row.setting.name)):
        if not kept or row.errors[error].value < kept[-1].errors[error].value:
            kept.append(row)
    return kept


def tells(row: Row, error: str) -> bool:
    """Whether a setting measured an error in enough scenes to say that it is better or worse than another."""
    return error in row.errors and row.errors[error].scenes >= FEWEST_SCENES


def recommend(rows: Sequence[Row], targets: Targets | None) -> Row:
    """The setting to use for the targets, or for the default ones without a change for the worse. Raises TargetError."""
    if targets is not None:
        return choose(rows, targets)
    asked, bounds = default_targets(rows)
    single = [row for row in rows if row.setting.kind == "single"]
    telling = {row.setting.knob for row in single if set(row.errors) - {"failed_share"}}
    blind = {row.setting.knob for row in single} - telling  # knobs without any measured error: their loss is unknown
    return choose([row for row in rows if not set(dict(row.setting.parts)) & blind], asked, bounds)


def default_targets(rows: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    """The default targets that were measured, and the bound of every other error: the upper end of the job's own interval."""
    own = own_row(rows).errors
    asked = {name: target for name, target in DEFAULT_TARGETS.items() if name in own}
    return asked, {name: max(own[name].value, own[name].high) for name in own if name not in asked}


def choose(rows: Sequence[Row], targets: Targets, bounds: Targets | None = None) -> Row:
    """The cheapest setting all of whose errors meet the targets. Raises TargetError.

    What a user asks for, without `bounds`, is met with bounds for scenes at large (`Figure.most`). Where no setting does, by
    values (`value <= target`) of settings whose bounds are nearest to the targets; of fewer than `FEWEST_SCENES` scenes of
    the job itself by nothing. Default targets are met by values, and `bounds` are further targets that no message names.
    """
    own = own_row(rows)
    if unknown := [name for name in targets if all(error_of(row, name, rows) is None for row in rows)]:
        known = ", ".join(sorted({error for row in rows for error in row.errors}))
        raise TargetError(f"--target {unknown[0]}: this study did not measure it. It measured {known}")
    limits = {**(bounds or {}), **targets}
    able = [row for row in candidates(rows, targets) if excess(row, limits, rows, "value") == 0.0]
    if not able:
        raise TargetError(describe_miss(rows, targets))
    if bounds is not None:
        return cheapest(able, rows)
    if few := [short(name) for name in targets if name in own.errors and not tells(own, name)]:
        raise TargetError(
            f"of {listed(few)} fewer than {FEWEST_SCENES} scenes of the job were measured, which promise nothing of others: "
            "give a longer --budget"
        )
    above = {row.setting.name: excess(row, targets, rows, "most") for row in able}
    most = max(1.0, min(above.values()) * AS_CHEAP)
    return cheapest([row for row in able if above[row.setting.name] <= most], rows)


def candidates(rows: Sequence[Row], targets: Targets) -> list[Row]:
    """The job itself, and settings that were measured in a few scenes and do not fail `MORE_FAILED` more, or their target."""
    most = targets.get("failed_share", own_row(rows).failed_share + MORE_FAILED)
    kept = [row for row in rows if row.failed_share <= most]
    return [row for row in kept if not row.setting.parts or all(tells(row, name) for name in row.errors)]


def excess(row: Row, targets: Targets, rows: Sequence[Row], end: str) -> float:
    """How many times its target the value or the bound (`most`) of a setting's worst error is; 0 where all are met.

    Infinite where one was never measured. A bound is held against what is negligible at least.
    """
    above = [0.0]
    for name, target in targets.items():
        figure = error_of(row, name, rows)
        value = math.inf if figure is None else getattr(figure, end)
        if value > target:
            above.append(value / max(target, 1e-6 if end == "value" else ERRORS[name].negligible))
    return max(above)


def cheapest(some: Sequence[Row], rows: Sequence[Row]) -> Row:
    """The cheapest of some of the rows, at least one, so that the choice is repeatable.

    The job itself stays unless others save `WORTH`, surely. Errors are repeatable to the bit, because scenes are a pure
    function of job and seed; times are not. So every cost up to `AS_CHEAP` times the least upper end of an interval counts
    as the least, and facts without noise decide among those: the fewest changes; then the least sum of errors relative to the
    job's own, where what is negligible counts as the bound of that; then the name.
    """
    own = own_row(rows).errors
    if any(not row.setting.parts for row in some):
        some = [row for row in some if saves(row)] or [own_row(rows)]

    def order(row: Row) -> tuple[int, float, str]:
        least = {name: ERRORS[name].negligible for name in own}
        values = {name: (error_of(row, name, rows) or own[name]).value for name in own}
        relative = sum(max(values[name], least[name]) / max(own[name].value, least[name]) for name in own)
        return len(row.setting.parts), round(relative, 6), row.setting.name

    least_ratio = min(max(row.ratio, row.ratio_most) for row in some)
    return min((row for row in some if row.ratio <= least_ratio * AS_CHEAP), key=order)


def saves(row: Row) -> bool:
    """Whether a setting takes so much less time than the job that a change is worth making, with its interval clear of 1."""
    return row.ratio <= 1.0 - WORTH and row.ratio_most < 1.0


def describe_miss(rows: Sequence[Row], targets: Targets) -> str:
    """The nearest setting, whose greatest excess is the least, and by how much it misses the targets."""
    near = candidates(rows, targets)
    nearest = min(near, key=lambda row: (excess(row, targets, rows, "value"), row.ratio, row.setting.name))
    missed = []
    for name, target in targets.items():
        figure = error_of(nearest, name, rows)
        if figure is None or figure.value > target:
            value = "unknown" if figure is None else amount(name, figure.value)
            missed.append(f"{name}, which is {value} instead of {amount(name, target)}")
    words = listed(missed) or "none of them, and is worse than the job in another error"
    return (
        f"no setting meets {','.join(f'{name}={most:g}' for name, most in targets.items())}. The nearest is "
        f"{nearest.setting.name}, at {times(nearest.ratio)} the job's time: it misses {words}. Set others with --target"
    )


def describe_answer(
    rows: Sequence[Row], targets: Targets | None, proofs: Sequence[Proof], scenes: int
) -> tuple[str, str]:
    """Which of these rows to use for the targets, what it costs, and what is not sure; and its name, empty where it is none.

    Without targets they are `DEFAULT_TARGETS` as far as the study measured them, and no other error may grow beyond the
    job's own interval, so that a user without a wish keeps the same images.
    """
    if proofs and not proofs[-1].holds:
        names = ", ".join(sorted({proof.setting for proof in proofs}))
        words = f"{names} did not keep the targets on fresh scenes. A longer --budget tells more."
        return f"Nothing is recommended: {words}", ""
    asked = default_targets(rows)[0] if targets is None else targets
    own, others = own_row(rows), [row for row in rows if row.setting.parts]
    few = [row for row in others if not all(tells(row, name) for name in row.errors)]
    judged = len(few) < len(others) or any(proof.setting != own.setting.name for proof in proofs)
    if not judged or not all(tells(own, name) for name in asked if name in own.errors):
        words = f"fewer than {FEWEST_SCENES} scenes of the job, or of every other setting, were measured"
        return f"No verdict: {words}, which promise nothing of others. Give a longer --budget.", ""
    limits = listed([f"{amount(name, most)} of {short(name)}" for name, most in asked.items()])
    wish = f"at most {limits}" if asked else "any error at all"
    wish += ", and nothing else worse than the job has it" if targets is None else ""
    try:
        chosen = recommend(rows, targets)
    except TargetError as error:
        return f"{wish[0].upper()}{wish[1:]} is met by nothing that was measured: {error}.", ""
    use = "use the job as it is" if chosen is own else f"use {chosen.setting.name}"
    saved = "" if chosen is own else f", {times(chosen.ratio)} the job's time"
    losses = [
        f"{short(name)} ({amount(name, figure.value)} instead of {amount(name, own.errors[name].value)})"
        for name, figure in chosen.errors.items()
        if name in own.errors and figure.low > own.errors[name].high and figure.value > ERRORS[name].negligible
    ]
    loss = f", and gives up {listed(losses)}" if losses else ""
    whole = f"{describe_seconds(chosen.ms * scenes / 1e3)}, {size(chosen.kilobytes * scenes)}"
    cost = f"{milliseconds(chosen.ms)} of processor a scene ({plural(scenes, 'scene')}: {whole})"
    unproved = " It is not proved: the budget left no time for fresh scenes." if asked and not proofs else ""
    doubt = _doubt(chosen, targets or {}, rows)
    if few:
        doubt += f" Of {plural(len(few), 'setting')} fewer than {FEWEST_SCENES} scenes were measured: nothing is said of these."
    return f"For {wish}, {use}, which costs {cost}{saved}{loss}.{doubt}{unproved}", chosen.setting.name


def listed(words: Sequence[str]) -> str:
    """Words in one phrase: "a", "a and b" or "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _doubt(row: Row, targets: Targets, rows: Sequence[Row]) -> str:
    """A sentence on the targets that other scenes may miss; empty where all are sure."""
    figures = {name: error_of(row, name, rows) for name in targets}
    unsure = [
        f"{short(name)} up to {amount(name, figure.most) if math.isfinite(figure.most) else 'any'} (from {figure.scenes})"
        for name, figure in figures.items()
        if figure is not None and figure.most > targets[name]
    ]
    return f" It is not sure to 95 %: scenes that were not measured may have {listed(unsure)}." if unsure else ""


def parse_targets(text: str) -> dict[str, float]:
    """From "penetration_mm=0.1,depth_mm=0.5"; `kept_share` is 1 minus `lost_share`. Raises InputError with the remedy."""
    targets: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = (piece.strip() for piece in part.partition("="))
        if not name or not value:
            raise InputError(f"--target {part.strip() or text!r}: write it as penetration_mm=0.1,depth_mm=0.5")
        try:
            most = float(value)
        except ValueError:
            most = math.nan
        if name == "kept_share":
            name, most = "lost_share", round(1.0 - most, 12)
        if name not in ERRORS:
            raise InputError(
                f"--target {name}: there is no such error; {did_you_mean(name, ERRORS)}Known: {', '.join(ERRORS)}"
            )
        if name in targets:
            raise InputError(f"--target {name}: is given twice, as {targets[name]:g} and as {most:g}")
        if not 0.0 <= most < math.inf:
            raise InputError(f"--target {part.strip()}: must be a number from 0 up, such as 0.001 for 0.1 %")
        targets[name] = most
    return targets


_UNMEASURED: tuple[tuple[Callable[[Job], bool], str, str], ...] = (
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
        for is_so, names, why in _UNMEASURED:
            if is_so(job) and {name, ERRORS[name].group} & set(names.split()):
                raise InputError(f"--target {name}: it cannot be measured here: {why}")
        if name == "flip" and missing is not None:
            raise InputError(f"--target flip: {missing}")
