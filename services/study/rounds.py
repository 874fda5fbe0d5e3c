"""Which settings are measured in which scenes next, and which are tried together. Pure.

Rounds over one table, as in successive halving (Jamieson and Talwalkar 2016), for each part of a scene by itself. A round
brings every setting that can still win to twice as many scenes, the same ones for all. A setting is out once it surely
misses a target, or surely takes longer than one that surely meets all. Where a round would take more than the seconds that
it may, the less promising half of its settings is left behind, and once more, until the others fit.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from services.study.choose import AS_CHEAP
from services.study.knobs import REFERENCES, Part, joined, part_of
from services.study.model import ERRORS, NEGLIGIBLE, OWN, Row, Setting, Verdict
from services.study.table import Table

Targets = Mapping[str, float]

MOST: Mapping[Part, int] = {"rest": 512, "again": 64, "draw": 64, "colour": 8, "capture": 32}
"""The most scenes of each part."""

SHARES: Mapping[Part, float] = {"rest": 3.0, "again": 1.0, "draw": 2.0, "colour": 1.0, "capture": 1.0}
"""How the time of a round is shared among the parts that are not decided."""

LEAST = 8
"""Nothing is out before it was measured in so many scenes."""

FEWEST_RACING = 4
"""So many settings are in every round; where even these do not fit, in as many scenes as fit."""

REFERENCE_SHARE = 0.3
"""References, which errors of all are held against, are in a round while each takes no more than this share of the others."""

DEAR, DEAR_SCENES = 6.0, 4
"""Settings that take this many times the usual one's seconds are measured in so many scenes and no more."""

OUT_MISSES, OUT_COSTS = "misses a target", "costs more than one that meets the targets"


class Wanted(NamedTuple):
    """One scene that is to be measured with a setting of a part."""

    part: Part
    scene_id: int
    setting: Setting


def next_round(
    table: Table, part: Part, targets: Targets, scenes: range, allowed_s: float
) -> tuple[list[Wanted], bool]:
    """What is missing in these scenes of the settings in this round, scene by scene; and whether all of that fits."""
    racing = by_promise(table, part, targets, len(scenes))
    while seconds(table, wanted := missing(table, part, racing, scenes)) > allowed_s and len(racing) > FEWEST_RACING:
        racing = racing[: max(FEWEST_RACING, len(racing) // 2)]
    most_s = REFERENCE_SHARE * seconds(table, wanted)
    references = [missing(table, part, [one], scenes) for one in REFERENCES if one in table.parts.measured[part]]
    wanted += [one for some in references if seconds(table, some) <= most_s for one in some]
    wanted.sort(key=lambda one: one.scene_id)
    costs = itertools.accumulate(table.cost_s(part, one.setting) for one in wanted)
    fitting = sum(cost <= (1.0 + REFERENCE_SHARE * len(REFERENCES)) * allowed_s for cost in costs)
    return wanted[:fitting], fitting == len(wanted)


def missing(table: Table, part: Part, settings: Iterable[Setting], scenes: range) -> list[Wanted]:
    """What has no answer of these settings in these scenes."""
    return [Wanted(part, n, one) for n in scenes for one in settings if n not in table.answers(part, one)]


def seconds(table: Table, wanted: Sequence[Wanted]) -> float:
    """What these take by the clock, about, one after the other."""
    return sum(table.cost_s(one.part, one.setting) for one in wanted)


def by_promise(table: Table, part: Part, targets: Targets, scenes: int) -> list[Setting]:
    """The settings that can still win: the job itself, then those that meet the targets so far, the cheapest first."""
    settings = [one for one in table.parts.measured[part] if one not in REFERENCES]
    usual_s, out = median(table.cost_s(part, one) for one in settings), why_out(table, part, targets)

    def promise(setting: Setting) -> tuple[bool, bool, float]:
        figures, ratio = table.figures(part, setting), table.ratio(part, setting)
        missed = any(name in figures and figures[name].value > most for name, most in targets.items())
        return setting != OWN, missed, ratio.value if ratio else 1.0

    def is_dear(setting: Setting) -> bool:
        return setting != OWN and table.cost_s(part, setting) > DEAR * usual_s

    racing = [one for one in settings if one.name not in out and (scenes <= DEAR_SCENES or not is_dear(one))]
    return sorted(racing, key=promise)


def verdict(table: Table, part: Part, setting: Setting, targets: Targets) -> Verdict:
    """Whether a setting surely meets those targets whose errors the part measures, or surely misses one."""
    figures, known = table.figures(part, setting), table.figures(part, OWN)
    asked = {name: most for name, most in targets.items() if part_of(name) == part and name in known}
    verdicts = {figures[name].verdict(most) if name in figures else "open" for name, most in asked.items()}
    return "misses" if "misses" in verdicts else "open" if "open" in verdicts else "meets"


def why_out(table: Table, part: Part, targets: Targets) -> dict[str, str]:
    """By name the settings of a part that cannot win any more, and why; never the job itself."""
    judged = [one for one in table.parts.measured[part] if table.scenes(part, one) >= min(LEAST, MOST[part])]
    verdicts = {one.name: verdict(table, part, one, targets) for one in judged}
    ratios = {one.name: ratio for one in judged if (ratio := table.ratio(part, one))}
    best = min((ratio.high for name, ratio in ratios.items() if verdicts[name] == "meets"), default=float("inf"))
    out = {name: OUT_COSTS for name, ratio in ratios.items() if ratio.low > best * AS_CHEAP}
    out |= {name: OUT_MISSES for name, found in verdicts.items() if found == "misses"}
    return {name: why for name, why in out.items() if name not in {one.name for one in (OWN, *REFERENCES)}}


def undecided(table: Table, part: Part, targets: Targets) -> list[Setting]:
    """Settings that may turn out cheaper than the cheapest that surely meets the targets."""
    out = why_out(table, part, targets)
    alive = [one for one in table.parts.measured[part] if one.name not in out and one not in REFERENCES]
    verdicts = {one.name: verdict(table, part, one, targets) for one in alive}
    ratios = {one.name: ratio for one in alive if (ratio := table.ratio(part, one))}
    best = min((ratio.value for name, ratio in ratios.items() if verdicts[name] == "meets"), default=float("inf"))
    return [
        one
        for one in alive
        if verdicts[one.name] == "open"
        and (ratios[one.name].low * AS_CHEAP < best if one.name in ratios else one.kind != "several")
    ]


# ---------------------------------------------------------------------------------------------- combinations

SAVES, WORSE, BETTER = 0.98, 1.5, 0.67
"""A value saves time at this share of the job's own, keeps an error that grows to this share, and shrinks one below this."""

DEAREST = 5.0
"""A value that takes at least this many times the job's time is measured by itself only."""

MOST_OF_A_KIND = 3
"""The most knobs that are paired among those that save time, and among those that are more exact."""


def promising(rows: Sequence[Row], targets: Targets) -> tuple[Setting, ...]:
    """Settings of two and more knobs to measure next.

    `rows`: the job's own first, then one value of one knob each. For each knob the cheapest value that keeps every error, and
    the most exact value that shrinks one; of either kind the best knobs, two by two and all at once; and at once the cheapest
    value of every knob that meets the targets.
    """
    singles = [row for row in rows[1:] if len(row.setting.parts) == 1 and row.ratio < DEAREST]
    shares = {row.setting.name: _least_share(row, rows[0]) for row in singles}
    known = [(share, row) for row in singles if (share := shares[row.setting.name]) is not None]
    cheap = sorted((row for row in singles if row.ratio < SAVES), key=lambda row: (row.ratio, row.setting.name))
    saving = _first_of_knobs(row for row in cheap if shares[row.setting.name] is not None)
    exact = _first_of_knobs(
        row for share, row in sorted(known, key=lambda pair: (pair[0], pair[1].setting.name)) if share < BETTER
    )
    meeting = _first_of_knobs(
        row for row in cheap if all(row.errors[name].value <= targets[name] for name in set(targets) & set(row.errors))
    )
    pairs = [pair for kind in (saving, exact) for pair in itertools.combinations(kind[:MOST_OF_A_KIND], 2)]
    together = [some for some in (*pairs, saving, exact, meeting) if len(some) > 1]
    # In the order of the table, whatever the ranks, so that names do not depend on noise.
    settings = [joined([row.setting for row in singles if row in some]) for some in together]
    return tuple({setting.name: setting for setting in settings}.values())


def _first_of_knobs(rows: Iterable[Row]) -> list[Row]:
    """The first value of each knob, in the order of the rows."""
    first: dict[str, Row] = {}
    for row in rows:
        first.setdefault(row.setting.knob, row)
    return list(first.values())


def _least_share(row: Row, own: Row) -> float | None:
    """The least of its errors as a share of the job's own where that is not negligible, 1 without any.

    None where an error has grown beyond the factor and is not negligible.
    """
    both = [name for name in row.errors if name in own.errors]
    pairs = [(row.errors[name].value, own.errors[name].value, NEGLIGIBLE[ERRORS[name].unit]) for name in both]
    if any(value > max(negligible, WORSE * mine) for value, mine, negligible in pairs):
        return None
    return min((value / mine for value, mine, negligible in pairs if mine > negligible), default=1.0)
