"""Which settings are measured in which scenes next, within what is left of the budget. Pure.

Successive halving (Jamieson and Talwalkar 2016) with paired scenes: in each round every setting that may still be the answer
is measured in twice as many scenes, the same ones for all. A setting is out of the race once it surely misses a target, or
surely takes longer than one that surely meets all (`Table.verdict`, 95 %). Parts of a scene race apart, each with a share of
what is left of the budget.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

from services.study.choose import AS_CHEAP
from services.study.knobs import REFERENCES, joined
from services.study.model import ERRORS, NEGLIGIBLE, OWN, Row, Setting
from services.study.table import Part, Table

MOST: Mapping[Part, int] = {"rest": 512, "again": 64, "draw": 64, "colour": 8, "capture": 32}
"""The most scenes of each part."""

LEAST = 8
"""Nothing is out of the race before it was measured in so many scenes."""

REFERENCE_TIMES = 8.0
"""A guess at how many times the job's own time a reference takes, before one was measured."""

REFERENCE_SHARE = 0.3
"""References may take this share of a round; where they would take more they wait, and errors against them have fewer scenes."""

SHARES: Mapping[Part, float] = {"rest": 3.0, "again": 1.0, "draw": 2.0, "colour": 1.0, "capture": 1.0}
"""How what is left of the budget is shared among the parts that are not decided."""

FIRST_LEVEL = 2
"""Scenes of the first round, in which every setting is."""

MOST_PROMISING = 4
"""So many settings at least are in every round; where they do not fit, in as many scenes as fit."""

SURE_SCENES = 59
"""Scenes without one above a target that make a 95th percentile sure (1 - 0.95^59 > 0.95)."""

DEAR, DEAR_LEVEL = 6.0, 4
"""Settings that take this many times the usual one's seconds are measured in so many scenes and no more."""

KEPT = frozenset({OWN.name, *(one.name for one in REFERENCES)})
"""What no rule puts out of the race."""


@dataclass(frozen=True)
class Wanted:
    """One scene that is to be measured with a setting, and a guess at its seconds."""

    part: Part
    scene_id: int
    setting: Setting
    cost_s: float


def grouped(wanted: Sequence[Wanted], most_s: float) -> list[tuple[Part, int, tuple[Setting, ...]]]:
    """Settings of one part and scene side by side, in units of at most about so many seconds."""
    units: list[tuple[Part, int, tuple[Setting, ...]]] = []
    order = dict.fromkeys((one.part, one.scene_id) for one in wanted)
    for part, scene in order:
        some, cost = list[Setting](), 0.0
        for one in (one for one in wanted if (one.part, one.scene_id) == (part, scene)):
            if some and cost + one.cost_s > most_s:
                units.append((part, scene, tuple(some)))
                some, cost = [], 0.0
            some.append(one.setting)
            cost += one.cost_s
        if some:
            units.append((part, scene, tuple(some)))
    return units


@dataclass
class Race:
    """The state of the race: which settings are out, and why; and parts that this job and budget leave out."""

    targets: Mapping[str, float]
    first_scene: int
    out: dict[tuple[Part, str], str]
    left_out: list[Part]

    def alive(self, table: Table, part: Part) -> list[Setting]:
        """The settings of a part that are still in the race."""
        return [one for one in table.parts.measured[part] if (part, one.name) not in self.out]

    def reasons(self, mine: Mapping[Part, Setting]) -> tuple[str, ...]:
        """Why a setting with these parts is out of the race, in words; none where it is not."""
        found = [self.out.get((part, one.name)) for part, one in mine.items() if one != OWN]
        return tuple(f"out of the race: {reason}" for reason in dict.fromkeys(found) if reason)

    def judge(self, table: Table) -> None:
        """Puts out what surely misses, and what surely costs more than a setting that surely meets."""
        for part, settings in table.parts.measured.items():
            verdicts = {one.name: table.verdict(part, one, self.targets) for one in settings}
            sure = [
                one for one in settings if verdicts[one.name] == "meets" and self._scenes(table, part, one) >= LEAST
            ]
            costs = {one.name: table.ratio(_timed(part), one) for one in settings}
            cheapest = min((cost.high for one in sure if (cost := costs[one.name])), default=float("inf"))
            for one in settings:
                cost = costs[one.name]
                if one.name in KEPT or self._scenes(table, part, one) < min(LEAST, MOST[part]):
                    continue
                if verdicts[one.name] == "misses":
                    self.out.setdefault((part, one.name), "misses a target")
                elif cost and cost.low > cheapest * AS_CHEAP:
                    self.out.setdefault((part, one.name), "costs more than one that meets the targets")

    def open_rivals(self, table: Table, part: Part) -> list[Setting]:
        """Settings that may turn out cheaper than the cheapest that surely meets the targets, or than the job."""
        alive = self.alive(table, part)
        ratios = {one.name: table.ratio(_timed(part), one) for one in alive}
        sure = [one for one in alive if table.verdict(part, one, self.targets) == "meets" and ratios[one.name]]
        best = min((ratios[one.name].value for one in sure), default=float("inf"))  # type: ignore[union-attr]
        return [
            one
            for one in alive
            if one not in REFERENCES
            and (one.kind != "several" or ratios[one.name] is not None)  # a combination that was not promising enough
            and table.verdict(part, one, self.targets) == "open"
            and (ratios[one.name] is None or ratios[one.name].low * AS_CHEAP < best)  # type: ignore[union-attr]
        ]

    def is_decided(self, table: Table, part: Part) -> bool:
        """Whether more scenes of this part would not change the choice."""
        return all(self._scenes(table, part, one) >= MOST[part] for one in self.open_rivals(table, part))

    def next_round(self, table: Table, part: Part, level: int, allowed_s: float) -> tuple[list[Wanted], bool]:
        """What is missing of a part up to `level` scenes of the settings in this round, and whether all of it fits.

        Where not all settings can be measured until they are sure, each round keeps half of those of the round before, the
        most promising, and the references, which errors of all are held against. Where even these would take more than the
        seconds allowed, the last ones wait, and the last scenes.
        """
        dear = {one.name for one in self._dear(table, part)}
        wanted = [
            one for one in self.missing(table, part, level) if level <= DEAR_LEVEL or one.setting.name not in dear
        ]
        by_setting: dict[str, list[Wanted]] = {}
        for one in wanted:
            by_setting.setdefault(one.setting.name, []).append(one)
        order = [one.name for one in self._by_promise(table, part) if one.name in by_setting]
        alive = [one for one in self.alive(table, part) if one not in REFERENCES and one.name not in dear]
        sure = min(SURE_SCENES, MOST[part])
        whole_s = sum(self.cost_s(table, part, one) * max(0, sure - self._scenes(table, part, one)) for one in alive)
        if level > FIRST_LEVEL and whole_s > allowed_s:
            references = [one.name for one in REFERENCES if one.name in by_setting]
            others = [name for name in order if name not in references]
            order = others[: max(MOST_PROMISING, -(-len(alive) * FIRST_LEVEL // level))] + references
        if sum(one.cost_s for name in order for one in by_setting[name]) <= allowed_s:
            return [one for one in wanted if one.setting.name in order], True
        needed_s = sum(one.cost_s for name in order[:MOST_PROMISING] for one in by_setting[name])
        share = min(1.0, allowed_s / needed_s)
        chosen, left_s = list[Wanted](), allowed_s
        for name in order:
            scenes = int(len(by_setting[name]) * share)
            cost_s = scenes * by_setting[name][0].cost_s
            if cost_s <= left_s:
                chosen += by_setting[name][:scenes]
                left_s -= cost_s
        return chosen, False

    def missing(self, table: Table, part: Part, level: int) -> list[Wanted]:
        """What has no answer up to `level` scenes of a part's settings; references only as far as they take their share."""
        settings = self.alive(table, part)
        scenes = range(self.first_scene, self.first_scene + min(level, MOST[part]))
        costs = {one.name: self.cost_s(table, part, one) for one in settings}
        total = sum(costs[one.name] for one in settings if one not in REFERENCES)
        wanted = []
        for one in settings:
            if one in REFERENCES and level > 1 and costs[one.name] > REFERENCE_SHARE * total:
                continue
            done = table.answers(part, one)
            wanted += [Wanted(part, scene, one, costs[one.name]) for scene in scenes if scene not in done]
        return wanted

    def _by_promise(self, table: Table, part: Part) -> list[Setting]:
        """The job itself, then those that meet the targets so far, the cheapest first; dear ones and references last."""
        dear = self._dear(table, part)

        def key(one: Setting) -> tuple[bool, bool, bool, float]:
            figures, ratio = table.figures(part, one), table.ratio(_timed(part), one)
            missed = any(name in figures and figures[name].value > most for name, most in self.targets.items())
            return one != OWN, one in dear or one in REFERENCES, missed, ratio.value if ratio else 1.0

        return sorted(self.alive(table, part), key=key)

    def _dear(self, table: Table, part: Part) -> list[Setting]:
        """Settings that take many times the usual one's seconds a scene."""
        settings = [one for one in table.parts.measured[part] if one not in REFERENCES]
        usual_s = median(self.cost_s(table, part, one) for one in settings)
        return [one for one in settings if one != OWN and self.cost_s(table, part, one) > DEAR * usual_s]

    def cost_s(self, table: Table, part: Part, setting: Setting) -> float:
        """Seconds by the clock of one scene: the mean so far, or the usual one of the part's settings."""

        def means(settings: Iterable[Setting]) -> list[float]:
            took = [[one["took"] for one in table.answers(part, some).values()] for some in settings]
            return [fmean(some) for some in took if some]

        if own := means([setting]):
            return own[0]
        usual = means(table.parts.measured[part])
        return (REFERENCE_TIMES if setting in REFERENCES else 1.0) * (median(usual) if usual else 1.0)

    @staticmethod
    def _scenes(table: Table, part: Part, setting: Setting) -> int:
        return len(table.answers(part, setting))


def _timed(part: Part) -> Part:
    """The part that has the time of a part's settings."""
    return {"colour": "draw", "again": "rest"}.get(part, part)


# ---------------------------------------------------------------------------------------------- combinations

SAVES, WORSE, BETTER = 0.98, 1.5, 0.67
"""A value saves time at this share of the job's own, keeps an error that grows to this share, and shrinks one below this."""

DEAREST = 5.0
"""A value that takes at least this many times the job's time is measured by itself only."""

MOST_OF_A_KIND = 3
"""The most knobs that are paired among those that save time, and among those that are more exact."""


def promising(rows: Sequence[Row], targets: Mapping[str, float]) -> tuple[Setting, ...]:
    """Settings of two and more knobs to measure next.

    `rows`: the job's own first, then one value of one knob each. For each knob the cheapest value that keeps every error, and
    the most exact value that shrinks one; of either kind the best knobs, two by two and all at once; and at once the cheapest
    value of every knob that meets the targets.
    """
    singles = [row for row in rows[1:] if len(row.setting.parts) == 1 and row.ratio < DEAREST]
    shares = {row.setting.name: _least_share(row, rows[0]) for row in singles}
    cheap = sorted((row for row in singles if row.ratio < SAVES), key=lambda row: (row.ratio, row.setting.name))
    ranks = {name: share for name, share in shares.items() if share is not None and share < BETTER}
    saving = _first_of_knobs(row for row in cheap if shares[row.setting.name] is not None)
    shrinking = [row for row in singles if row.setting.name in ranks]
    exact = _first_of_knobs(sorted(shrinking, key=lambda row: (ranks[row.setting.name], row.setting.name)))
    meeting = _first_of_knobs(
        row for row in cheap if all(row.errors[name].value <= targets[name] for name in set(targets) & set(row.errors))
    )
    pairs = [pair for kind in (saving, exact) for pair in itertools.combinations(kind[:MOST_OF_A_KIND], 2)]
    together = [some for some in (*pairs, saving, exact, meeting) if len(some) > 1]
    # In the order of the table, whatever the ranks, so that names do not depend on noise.
    found = [joined([row.setting for row in singles if row in some]) for some in together]
    return tuple({setting.name: setting for setting in found}.values())


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
