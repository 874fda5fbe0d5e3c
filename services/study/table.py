"""From answers of single scenes to figures, verdicts and the table of settings. Pure.

The parts of a scene are measured apart, because their times add up and their errors do not meet: how objects rest (`rest`,
and let go again `again`), what is drawn of them at the job's own rest (`draw`), its colour (`colour`); or a capture as a
whole (`capture`). A setting's row is put together of its parts, so that no combination across parts needs a measurement.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import fmean
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom, nct, norm

from schemas.base import Array
from services.study.knobs import REFERENCES
from services.study.model import ERRORS, NEGLIGIBLE, OWN, Figure, Group, Row, Setting

Answer = Mapping[str, Any]
"""What one scene told of one setting: `s` seconds of processor (None where the machine slept), `took` seconds by the clock,
`errors`, `failed` with a reason, and by kind `bytes`, `plan_s`, `corners`, `lost`."""

Answers = Mapping[int, Answer]
"""By scene."""

PERCENTILE = 95.0
"""The percentile of the scenes' figures that is a setting's error."""

RESAMPLES = 200
"""Bootstrap samples of the scenes for an interval."""

INTERVAL = (2.5, 97.5)

SURE = 0.95
"""Confidence of a verdict, one-sided."""

AGREE_MM = 0.05
"""Two references agree where their poses are nearer than this; only then is there a true pose."""

LEAST_OUTCOMES = 8
"""Scenes without which two distributions of outcomes are not compared: of two scenes their distance is chance alone."""

SCENE_MM = 1000.0
"""Stands for the pose of an object that is there with one setting alone."""

Verdict = Literal["meets", "misses", "open"]


def _resampled(count: int) -> NDArray[np.int64]:
    """[RESAMPLES, count] places of scenes, the same ones for every figure of as many scenes, so that settings are paired."""
    return np.random.default_rng(0).integers(0, count, (RESAMPLES, count), dtype=np.int64)


def _figure(samples: Array, value: float, median: float, scenes: int, most: float | None = None) -> Figure:
    low, high = np.percentile(samples, INTERVAL)
    return Figure(value, float(low), float(high), median, scenes, most)


def figure_over_scenes(figures: Sequence[float], least: float = 0.0, most: float = math.inf) -> Figure:
    """The 95th percentile of one figure a scene, of at least one.

    In its bound figures up to `least` count as `least`, and it is at most `most`, as shares are at most 1.
    """
    values = np.asarray(figures, float)
    samples = np.percentile(values[_resampled(len(values))], PERCENTILE, axis=1)
    value, median = float(np.percentile(values, PERCENTILE)), float(np.median(values))
    return _figure(samples, value, median, len(values), min(most, greatest_percentile(values, least)))


def greatest_percentile(values: Array, least: float = 0.0) -> float:
    """What the `PERCENTILE` of all scenes is at most, with confidence `SURE`, from figures [N] of some of them.

    Of 59 scenes and more it is an order statistic, whatever the distribution: the exact interval of `verdict`. Fewer bound
    nothing without a distribution; theirs is taken to be lognormal, for which the tolerance bound is exact (Hahn and Meeker
    1991, 4.6). Of 20 errors of piles of eight it covered 82 to 100 % of samples of 4 to 16 scenes out of 200, and the
    bootstrap 14 to 61. Figures up to `least`, above 0, count as `least`: the logarithm of rounding is no spread. Infinite for
    one scene.
    """
    count, ordered = len(values), np.sort(values)
    if (above := _most_above(count)) is not None:
        return float(ordered[count - 1 - above])
    if count == 1:
        return math.inf
    logs = np.log(np.maximum(values, least or np.finfo(float).tiny))
    return float(np.exp(min(logs.mean() + _tolerance(count) * logs.std(ddof=1), _MOST_LOG)))


_MOST_LOG = math.log(np.finfo(float).max)


@cache
def _most_above(count: int) -> int | None:
    """The most of so many scenes above a target that leave its percentile surely met; None where none may be."""
    above = np.arange(count)
    sure = above[beta.ppf(SURE, above + 1, count - above) <= 1.0 - PERCENTILE / 100.0]
    return int(sure[-1]) if len(sure) else None


@cache
def _tolerance(count: int) -> float:
    """Standard deviations from the mean of so many to the one-sided tolerance bound of a normal distribution."""
    return float(nct.ppf(SURE, count - 1, norm.ppf(PERCENTILE / 100.0) * math.sqrt(count)) / math.sqrt(count))


def _most_of_counts(part: float, whole: float) -> float:
    """What a share is at most, with confidence `SURE`, from a count out of another (Clopper and Pearson 1934)."""
    return float(beta.ppf(SURE, part + 1, whole - part)) if part < whole else 1.0


def share(parts: Sequence[float], wholes: Sequence[float] | None = None, counted: bool = False) -> Figure:
    """The sum of `parts` over that of `wholes`, which are 1 where they are not told: of flags the share of true ones.

    Of `counted` things the bound is never below that of as many that are alike, so that none of six says little.
    """
    part = np.asarray(parts, float)
    whole = np.ones(len(part)) if wholes is None else np.asarray(wholes, float)
    rows = _resampled(len(part))
    value = float(part.sum() / whole.sum())
    found = _figure(part[rows].sum(axis=1) / whole[rows].sum(axis=1), value, value, len(part))
    most = max(found.high, _most_of_counts(part.sum(), whole.sum())) if counted else None
    return replace(found, most=most)


def apart(own: Sequence[float], truth: Sequence[float]) -> Figure:
    """The first Wasserstein distance of two distributions, given by samples [N] of the same scenes in the same order.

    It is the area between the cumulative distributions, in the samples' unit (Villani 2009, Optimal Transport, 6.2; Ramdas,
    Garcia and Cuturi 2017 for one dimension), for as many samples of either the mean gap of the sorted samples. The end of
    a tumbling object is random, so that only distributions can be compared. The interval is a paired bootstrap's; the
    median repeats the value.
    """
    mine, other = np.asarray(own, float), np.asarray(truth, float)
    rows = _resampled(len(mine))
    samples = np.abs(np.sort(mine[rows], axis=1) - np.sort(other[rows], axis=1)).mean(axis=1)
    value = float(np.abs(np.sort(mine) - np.sort(other)).mean())
    return _figure(samples, value, value, len(mine))


def ratio_of_times(setting: Answers, own: Answers) -> Figure | None:
    """The sum of a setting's seconds over the job's own in the scenes that both have; None without one.

    The interval of a single scene is the value itself: there is none.
    """
    both = [scene for scene in setting if scene in own and setting[scene].get("s") and own[scene].get("s")]
    return share([setting[n]["s"] for n in both], [own[n]["s"] for n in both]) if both else None


def figures_of(answers: Answers, references: Sequence[Answers] = ()) -> dict[str, Figure]:
    """A setting's errors in the order of `ERRORS`, from its answers and, of physics, those of the references."""
    some = {scene: one for scene, one in answers.items() if "errors" in one}
    found: dict[str, Figure] = {}
    for name in ERRORS:
        if values := [one["errors"][name] for one in some.values() if name in one["errors"]]:
            found[name] = figure_over_scenes(values, NEGLIGIBLE[ERRORS[name].unit], _most_of(name))
    if answers:
        found["failed_share"] = share(["failed" in one for one in answers.values()], counted=True)
    if counted := [one for one in answers.values() if "lost" in one]:
        planned = [one["planned"] for one in counted]
        found["lost_share"] = share([one["lost"] for one in counted], planned, counted=True)
        found["redrawn_share"] = share([one["redrawn"] for one in counted], planned, counted=True)
    if references:
        both = [
            (one["errors"], references[0][n]["errors"])
            for n, one in some.items()
            if "errors" in references[0].get(n, {})
        ]
        for error, told in (("outcome_mm", "slid_mm"), ("outcome_deg", "rolled_deg")):
            if len(both) >= LEAST_OUTCOMES:
                found[error] = apart([a[told] for a, _ in both], [b[told] for _, b in both])
        poses = [
            pose
            for n, one in some.items()
            if (pose := pose_error(one, [ref.get(n, {}) for ref in references])) is not None
        ]
        if poses:
            found["pose_mm"] = figure_over_scenes(poses, NEGLIGIBLE["mm"])
    return {name: found[name] for name in ERRORS if name in found}


def pose_error(one: Answer, references: Sequence[Answer]) -> float | None:
    """The largest distance of an object's place to that of the first reference, mm; None where the references disagree.

    Places are those of the corners of the object's own box, which no point of the object moves farther than.
    """
    if len(references) < 2 or any("corners" not in other for other in (one, *references)):
        return None
    if _apart_mm(references[0], references[1]) > AGREE_MM:
        return None
    return _apart_mm(one, references[0])


def _apart_mm(one: Answer, other: Answer) -> float:
    mine, theirs = np.array(one["corners"]), np.array(other["corners"])
    if mine.shape != theirs.shape:
        return SCENE_MM
    return float(np.linalg.norm(mine - theirs, axis=-1).max())


def _scaled(figure: Figure, times: float, most: float) -> Figure:
    """Times a factor, and at most `most`."""
    ends = {name: min(most, getattr(figure, name) * times) for name in ("value", "low", "high", "median")}
    return replace(figure, **ends, most=None if figure.most is None else min(most, figure.most * times))


def _most_of(error: str) -> float:
    """What an error can be at most: shares are at most 1."""
    return math.inf if ERRORS[error].unit else 1.0


def values_of(answers: Answers, error: str) -> list[float]:
    """One figure a scene, of an error that is a percentile of such."""
    return [one["errors"][error] for one in answers.values() if error in one.get("errors", {})]


def _is_less(error: str, setting: Answers, same: Answers) -> bool | None:
    """Whether most scenes surely have less of an error than with the job itself: the sign test (Conover 1999, 3.4).

    `same`: the job's own answers in scenes of the setting. None where no scene has both, or all are alike.
    """
    both = [(setting[n].get("errors", {}), one.get("errors", {})) for n, one in same.items()]
    apart = [mine[error] - theirs[error] for mine, theirs in both if error in mine and error in theirs]
    less, more = sum(one < 0.0 for one in apart), sum(one > 0.0 for one in apart)
    return bool(binom.cdf(more, less + more, 0.5) <= 1.0 - SURE) if less + more else None


def verdict(values: Sequence[float], figure: Figure | None, target: float) -> Verdict:
    """Whether an error is surely at most its target, with confidence `SURE`.

    A percentile of scenes is judged by the exact interval of the share of scenes above the target (Clopper and Pearson
    1934), whatever their distribution: 59 scenes without one above it are needed. What is one figure of all scenes is judged
    by its bootstrap's interval.
    """
    if values:
        above, count = sum(value > target for value in values), len(values)
        allowed = 1.0 - PERCENTILE / 100.0
        if above < count and beta.ppf(SURE, above + 1, count - above) <= allowed:
            return "meets"
        return "misses" if above and beta.ppf(1.0 - SURE, above, count - above + 1) > allowed else "open"
    if figure is None or math.isnan(figure.value):
        return "open"
    return "meets" if figure.bound <= target else "misses" if figure.low > target else "open"


# ---------------------------------------------------------------------------------------------- the table

Part = str
"""rest, again, draw, colour or capture."""

_PART_OF: Mapping[Group, Part] = {
    "physics": "rest",
    "labels": "draw",
    "mirror": "draw",
    "colour": "colour",
    "capture": "capture",
}

AGAIN: Mapping[str, Part] = {"moved_mm": "again", "turned_deg": "again"}
"""Errors of rest that only another release tells, which takes a hundred times as long as the fall: a part of their own."""

UNTIMED = frozenset({"colour", "again"})
"""Parts that measure errors and no time."""


def part_of(error: str) -> Part:
    """The part that measures an error."""
    return AGAIN.get(error) or _PART_OF[ERRORS[error].group]


AT_REST = ("physics.", "start.", "assets.")
"""Keys that change how objects rest; every other one changes what is drawn."""
_COLOUR = ("render.",)


def unit_name(part: Part, scene_id: int, setting: Setting) -> str:
    """The name of an answer in the journal."""
    return f"{part}/{scene_id}/{setting.name}"


@dataclass(frozen=True)
class Parts:
    """What is measured: by part the settings, the job itself first, and of each setting of the table its settings by part."""

    measured: Mapping[Part, tuple[Setting, ...]]
    of: Mapping[str, Mapping[Part, Setting]]

    @classmethod
    def split(cls, settings: Iterable[Setting], captured: bool, again: bool = False) -> "Parts":
        """Settings by part; equal changes are measured once, under the name of the first setting that has them.

        With `again` objects are let go again with every setting, otherwise with the job and its presets alone.
        """
        known: dict[tuple[Part, str], Setting] = {}
        measured: dict[Part, dict[str, Setting]] = {}
        of: dict[str, dict[Part, Setting]] = {}
        for setting in settings:
            of[setting.name] = {}
            whole = again or setting.kind in ("own", "preset")
            for part, changes in changes_by_part(setting.changes, captured, whole).items():
                key = part, repr(sorted(changes.items()))
                one = known.setdefault(key, Setting(setting.parts, changes) if changes else OWN)
                measured.setdefault(part, {OWN.name: OWN})[one.name] = of[setting.name][part] = one
        if not captured:
            measured["rest"] |= {one.name: one for one in REFERENCES}
        return cls({part: tuple(some.values()) for part, some in measured.items()}, of)


def changes_by_part(changes: Mapping[str, Any], captured: bool, again: bool) -> dict[Part, dict[str, Any]]:
    """A setting's changes by the parts of a scene, or of a capture, that they change; with `again` of those let go again too."""
    if captured:
        return {"capture": dict(changes)}
    rest = {key: value for key, value in changes.items() if key.startswith(AT_REST)}
    colour = {key: value for key, value in changes.items() if key.startswith(_COLOUR)}
    drawn = {key: value for key, value in changes.items() if key not in rest}
    return {"rest": rest, **({"again": rest} if again else {}), "draw": drawn, "colour": colour}


class Table:
    """Rows of settings from the journal's answers; what was asked for once is kept until the next `Table`."""

    def __init__(self, parts: Parts, journal: Mapping[str, Any]) -> None:
        """Sorts the answers by part, setting and scene."""
        self.parts = parts
        self._answers: dict[tuple[Part, str], dict[int, Any]] = {}
        for name, answer in journal.items():
            part, _, rest = name.partition("/")
            scene, _, setting = rest.partition("/")
            if part in parts.measured:
                self._answers.setdefault((part, setting), {})[int(scene)] = answer
        self._figures: dict[tuple[Part, str], dict[str, Figure]] = {}
        self._ratios: dict[tuple[Part, str], Figure | None] = {}
        own = {part: list(self.answers(part, OWN).values()) for part in parts.measured}
        seconds = {
            part: [one["s"] for one in some if one.get("s")] for part, some in own.items() if part not in UNTIMED
        }
        self._own_s = {part: fmean(some) for part, some in seconds.items() if some}
        planned = [one["plan_s"] for one in own.get("rest", ()) if "plan_s" in one]
        self.own_ms = 1e3 * (sum(self._own_s.values()) + (fmean(planned) if planned else 0.0))

    def answers(self, part: Part, setting: Setting) -> Answers:
        """By scene."""
        return self._answers.get((part, setting.name), {})

    def is_timed(self) -> bool:
        """Whether the job itself has a time of every part."""
        return self._own_s.keys() == self.parts.measured.keys() - UNTIMED

    def figures(self, part: Part, setting: Setting) -> dict[str, Figure]:
        """The errors of a part's setting; shares of failed scenes of rest alone.

        Percentiles over fewer scenes than the job's are the job's own times their ratio in the scenes of both (the ratio
        estimator, Cochran 1977, 6.3), where the job's are not negligible: of the easy scenes alone they would flatter.
        """
        key = part, setting.name
        if key not in self._figures:
            answers, own = self.answers(part, setting), self.answers(part, OWN)
            found = self._figures_of(part, answers)
            same = {scene: own[scene] for scene in answers if scene in own}
            if setting != OWN:
                found = {name: replace(one, less=_is_less(name, answers, same)) for name, one in found.items()}
            if 0 < len(same) < len(own):  # never of the job itself
                here, whole = self._figures_of(part, same), self.figures(part, OWN)
                for name in found.keys() & here.keys():
                    if not ERRORS[name].pooled and here[name].value > NEGLIGIBLE[ERRORS[name].unit]:
                        found[name] = _scaled(found[name], whole[name].value / here[name].value, _most_of(name))
            self._figures[key] = found
        return self._figures[key]

    def _figures_of(self, part: Part, answers: Answers) -> dict[str, Figure]:
        references = [self.answers("rest", one) for one in REFERENCES] if part == "rest" else []
        found = figures_of(answers, references)
        if part != "rest":
            found.pop("failed_share", None)
        return found

    def ratio(self, part: Part, setting: Setting) -> Figure | None:
        """The ratio of a whole scene's time to the job's own, with this part alone changed; None where it has no time."""
        key = part, setting.name
        if key not in self._ratios:
            found = (
                ratio_of_times(self.answers(part, setting), self.answers(part, OWN)) if part in self._own_s else None
            )
            weight = 1e3 * self._own_s.get(part, 0.0) / self.own_ms if self.own_ms else 0.0
            self._ratios[key] = found and Figure(
                1.0 + weight * (found.value - 1.0),
                1.0 + weight * (found.low - 1.0),
                1.0 + weight * (found.high - 1.0),
                1.0 + weight * (found.median - 1.0),
                found.scenes,
            )
        return self._ratios[key]

    def row(self, setting: Setting) -> Row | None:
        """A setting's row; None where one of its parts has no time yet."""
        return self.row_of(setting, self.parts.of[setting.name])

    def row_of(self, setting: Setting, mine: Mapping[Part, Setting]) -> Row | None:
        """The row of a setting with these settings of its parts."""
        changed = {part: one for part, one in mine.items() if one != OWN}
        ratios = [self.ratio(part, one) for part, one in changed.items() if part not in UNTIMED]
        if not self.is_timed() or None in ratios or (not ratios and setting != OWN):
            return None
        known = [one for one in ratios if one is not None]
        ratio = 1.0 + sum(one.value - 1.0 for one in known)
        less = math.hypot(*(one.value - one.low for one in known))
        more = math.hypot(*(one.high - one.value for one in known))
        errors = {
            k: v
            for part, one in (mine if setting == OWN else changed).items()
            for k, v in self.figures(part, one).items()
        }
        failed, notes = self._failed(mine)
        counts = {part: len(self.answers(part, one)) for part, one in changed.items()}
        fewer = [count for part, count in counts.items() if count < len(self.answers(part, OWN))]
        if known and min(one.scenes for one in known) == 1:
            notes = (*notes, "measured in one scene: no interval")
        elif fewer:
            notes = (
                *notes,
                f"measured in {min(fewer)} scenes and the job in more: percentiles are the job's, times the ratio in the same",
            )
        sizes = [
            one["bytes"]
            for part in ("draw", "capture")
            if part in mine
            for one in self.answers(part, mine[part]).values()
            if "bytes" in one
        ]
        kilobytes = fmean(sizes) / 1e3 if sizes else 0.0
        ordered = {name: errors[name] for name in ERRORS if name in errors}
        return Row(setting, self.own_ms * ratio, ratio, ratio - less, ratio + more, kilobytes, ordered, failed, notes)

    def _failed(self, mine: Mapping[Part, Setting]) -> tuple[float, tuple[str, ...]]:
        """The share of scenes that fail, of rest or of a capture and beyond it of drawing; and the reasons with their counts."""
        reasons: dict[str, int] = {}
        shares = {}
        for part, one in mine.items():
            some = self.answers(part, one)
            failed = [answer for answer in some.values() if "failed" in answer]
            shares[part] = len(failed) / len(some) if some else 0.0
            for answer in failed:
                told = answer.get("broken", answer["failed"])
                reasons[told] = reasons.get(told, 0) + 1
        first = shares.get("rest", shares.get("capture", 0.0))
        own_draw = self.answers("draw", OWN)
        own_failed = sum("failed" in answer for answer in own_draw.values()) / max(1, len(own_draw))
        share = min(1.0, first + max(0.0, shares.get("draw", 0.0) - own_failed))
        return share, tuple(f"{told}: {count} scene{'s' * (count > 1)}" for told, count in sorted(reasons.items()))

    def verdict(self, part: Part, setting: Setting, targets: Mapping[str, float]) -> Verdict:
        """Whether a part's setting surely meets those targets whose errors the part measures, or surely misses one."""
        found = [
            verdict(self._values(part, setting, name), self.figures(part, setting).get(name), most)
            for name, most in targets.items()
            if part_of(name) == part
        ]
        return "misses" if "misses" in found else "open" if "open" in found else "meets"

    def _values(self, part: Part, setting: Setting, name: str) -> Sequence[float]:
        return () if ERRORS[name].pooled else values_of(self.answers(part, setting), name)
