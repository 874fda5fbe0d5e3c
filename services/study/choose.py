"""Which settings are measured next, the cheapest that meets the targets, the front, and the answer in words. Pure.

Rounds over one table, as in successive halving (Jamieson and Talwalkar 2016), for each part of a scene by itself. A round
brings every setting that can still win to twice as many scenes, the same ones for all. A setting is out once it surely
misses a target, or surely takes longer than one that surely meets all. Where a round would take more than the seconds that
it may, the less promising half of its settings is left behind, and once more, until the others fit.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from schemas.errors import RunError, describe_seconds, milliseconds, plural, size
from services.study.model import (
    ERRORS,
    OWN,
    REFERENCES,
    Figure,
    Proof,
    Row,
    Setting,
    Targets,
    amount,
    joined,
    short,
    times,
)
from services.study.table import PARTS, Part, Table, part_of

AS_CHEAP, WORTH = 1.05, 0.05
"""Costs up to this many times the least count as the least: interleaved medians on one core repeat within some 3 %. And the
share of the job's time that a change has to save, with its whole interval below the job's time, to be worth making."""

FEWEST_SCENES, MORE_FAILED = 4, 0.01
"""Fewer scenes recommend nothing, as what is better in one or two is so by chance; and the share of scenes that a setting may
fail more than the job, because one that fails more is cheap as it leaves work out."""

DEFAULT_TARGETS: Targets = {kind.name: kind.target for kind in ERRORS.values() if kind.target is not None}
"""The targets without a wish of the user: the accuracy that a dataset's labels promise."""


ROUGH = 1.25
"""Ends of an interval of time, one over the other, from which a setting that may save `WORTH` is measured in further scenes: of a
dozen settings whose times vary by half from scene to scene, the cheapest in a few scenes is so by chance."""

LEAST, FEWEST_RACING = 8, 4
"""Nothing is out, no part is decided and no combination is made before so many scenes; and so many settings are in every round,
where even these do not fit in as many scenes as fit."""

REFERENCE_SHARE = 0.3
"""References, which errors of all are held against, are in a round while each takes no more than this share of the others."""


class Wanted(NamedTuple):
    """One scene that is to be measured with a setting of a part."""

    part: Part
    scene_id: int
    setting: Setting


class Standing(NamedTuple):
    """A setting of a part: its verdict on the part's targets, whether its values miss one, and its ratio of time, if any."""

    setting: Setting
    verdict: str
    is_missing: bool
    ratio: Figure | None


def standings(table: Table, part: Part, targets: Targets) -> list[Standing]:
    """The settings that can still win: the job itself, then those that meet the targets so far, the cheapest first."""
    asked = {name: most for name, most in targets.items() if part_of(name) == part and name in table.figures(part, OWN)}
    every = []
    for setting in (setting for setting in table.split.measured[part] if setting not in REFERENCES):
        figures = table.figures(part, setting)
        verdicts = [figures[name].verdict(most) if name in figures else "open" for name, most in asked.items()]
        verdict = "misses" if "misses" in verdicts else "open" if "open" in verdicts else "meets"
        is_missing = any(figures[name].value > most for name, most in asked.items() if name in figures)
        every.append(Standing(setting, verdict, is_missing, table.ratio(part, setting)))
    known = [some for some in every if len(table.answers(part, some.setting)) >= min(LEAST, PARTS[part].scenes)]
    best = min((some.ratio.high for some in known if some.ratio and some.verdict == "meets"), default=math.inf)
    out = [some for some in known if some.verdict == "misses" or (some.ratio and some.ratio.low > best * AS_CHEAP)]
    left = [some for some in every if some not in out or some.setting == OWN]
    return sorted(left, key=lambda s: (s.setting != OWN, s.is_missing, s.ratio.value if s.ratio else 1.0))


def undecided(table: Table, part: Part, targets: Targets) -> list[Setting]:
    """Settings that may turn out cheaper than the cheapest that surely meets the targets; the job, unless that saves `WORTH`."""
    left = standings(table, part, targets)
    best = min((some.ratio.value for some in left if some.ratio and some.verdict == "meets"), default=math.inf)

    def may_win(some: Standing) -> bool:
        if some.setting == OWN:
            return best > 1.0 - WORTH
        return some.ratio.low * AS_CHEAP < best if some.ratio else some.setting.kind != "several"

    return [some.setting for some in left if some.verdict == "open" and may_win(some)]


def roughly_timed(table: Table, part: Part, targets: Targets) -> list[Setting]:
    """Settings that surely meet the targets and may save `WORTH`, of whose time little is known yet."""
    met = [some for some in standings(table, part, targets) if some.verdict == "meets" and some.setting != OWN]
    return [
        some.setting
        for some in met
        if some.ratio and some.ratio.low < 1.0 - WORTH and some.ratio.high > ROUGH * some.ratio.low
    ]


def next_round(table: Table, part: Part, targets: Targets, scenes: range, allowed_s: float) -> list[Wanted]:
    """What is missing in these scenes of the settings in this round, scene by scene, as far as it fits."""
    racing = [some.setting for some in standings(table, part, targets)]
    while seconds(table, wanted := missing(table, part, racing, scenes)) > allowed_s and len(racing) > FEWEST_RACING:
        racing = racing[: max(FEWEST_RACING, len(racing) // 2)]
    most_s = REFERENCE_SHARE * seconds(table, wanted)
    references = [missing(table, part, [some], scenes) for some in REFERENCES if some in table.split.measured[part]]
    wanted += [item for some in references if seconds(table, some) <= most_s for item in some]
    wanted.sort(key=lambda item: item.scene_id)
    costs = itertools.accumulate(table.cost_s(part, item.setting) for item in wanted)
    return wanted[: sum(cost <= (1.0 + REFERENCE_SHARE * len(REFERENCES)) * allowed_s for cost in costs)]


def missing(table: Table, part: Part, settings: Iterable[Setting], scenes: range) -> list[Wanted]:
    """What has no answer of these settings in these scenes."""
    return [Wanted(part, n, setting) for n in scenes for setting in settings if n not in table.answers(part, setting)]


def seconds(table: Table, wanted: Sequence[Wanted]) -> float:
    """What these take by the clock, about, one after the other."""
    return sum(table.cost_s(item.part, item.setting) for item in wanted)


def promising(rows: Sequence[Row], targets: Targets | None) -> list[Setting]:
    """Settings of two and more knobs to measure next. `rows`: the job's own first, then one value of one knob each.

    Of the values that make no error worse which a target or the job holds: for each knob the cheapest that saves time; for each
    target that the job misses the cheapest that mends it; and both.
    """
    own = rows[0].errors
    limits = targets or {name: most for some in default_targets(rows) for name, most in some.items()}
    held = {name: max(most, own[name].high) for name, most in limits.items() if name in own}
    singles = [
        row for row in sorted(rows[1:], key=lambda row: (row.ratio, row.setting.name)) if row.setting.kind == "single"
    ]
    kept = [
        row for row in singles if all(row.errors[name].value <= held[name] for name in held.keys() & row.errors.keys())
    ]
    saving = [row for row in kept if row.ratio < 0.98]
    mending: list[Row] = []
    for name in (name for name in held if own[name].value > limits[name]):
        mending += [row for row in kept if name in row.errors and row.errors[name].value <= limits[name]][:1]
    settings = []
    for some in (saving, mending, [*mending, *saving]):
        first = {row.setting.knob: row for row in reversed(some)}.values()  # of each knob
        if len(first) > 1:  # in the order of the table, whatever the ranks, so that names do not depend on noise
            settings.append(joined([row.setting for row in rows if row in first]))
    return list({setting.name: setting for setting in settings}.values())


# ------------------------------------------------------------------------------------------------ the choice


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
    most_kb = AS_CHEAP * own_row(rows).kilobytes  # who asks for nothing keeps the disk space too
    kept = [row for row in rows if not set(dict(row.setting.parts)) & blind and row.kilobytes <= most_kb]
    return choose(kept, asked, bounds)


def default_targets(rows: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    """The default targets that were measured, and the bound of every other error: the upper end of the job's own interval."""
    own = own_row(rows).errors
    asked = {name: target for name, target in DEFAULT_TARGETS.items() if name in own}
    return asked, {name: max(own[name].value, own[name].high) for name in own if name not in asked}


def choose(rows: Sequence[Row], targets: Targets, bounds: Targets | None = None) -> Row:
    """The cheapest setting all of whose errors meet the targets. Raises TargetError.

    What a user asks for, without `bounds`, is met with bounds for scenes at large (`Figure.most`). Where no setting does, by
    values (`value <= target`) of settings whose bounds are nearest to the targets; of fewer than `FEWEST_SCENES` scenes of
    the job itself by nothing. Default targets are met by values, and `bounds` are further targets that no message names; the
    job itself misses them only where the whole interval of an error does, since a change within noise is none.
    """
    own = own_row(rows)
    if unknown := [name for name in targets if all(error_of(row, name, rows) is None for row in rows)]:
        known = ", ".join(sorted({error for row in rows for error in row.errors}))
        raise TargetError(f"--target {unknown[0]}: this study did not measure it. It measured {known}")
    limits = {**(bounds or {}), **targets}
    end = "value" if bounds is None else "low"
    able = [
        row for row in candidates(rows, targets) if excess(row, limits, rows, end if row is own else "value") == 0.0
    ]
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
    missed = {name: most for name, most in asked.items() if name in own.errors and own.errors[name].value > most}
    doubt = _doubt(chosen, (missed if chosen is own else {}) if targets is None else targets, rows)
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
