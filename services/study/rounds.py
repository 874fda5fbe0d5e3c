"""Which settings are measured in which scenes next, and which are tried together. Pure.

Rounds over one table, as in successive halving (Jamieson and Talwalkar 2016), for each part of a scene by itself. A round
brings every setting that can still win to twice as many scenes, the same ones for all. A setting is out once it surely
misses a target, or surely takes longer than one that surely meets all. Where a round would take more than the seconds that
it may, the less promising half of its settings is left behind, and once more, until the others fit.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from services.study.choose import AS_CHEAP, default_targets
from services.study.model import OWN, REFERENCES, Figure, Row, Setting, Targets, joined
from services.study.table import PARTS, Part, Table, part_of

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
    """Settings that may turn out cheaper than the cheapest that surely meets the targets."""
    left = standings(table, part, targets)
    best = min((some.ratio.value for some in left if some.ratio and some.verdict == "meets"), default=math.inf)
    return [
        some.setting
        for some in left
        if some.verdict == "open"
        and (some.ratio.low * AS_CHEAP < best if some.ratio else some.setting.kind != "several")
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
