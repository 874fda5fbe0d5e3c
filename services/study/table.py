"""The table of a study: setting x scene x error x seconds, as answers of single scenes, and the rows that it comes to. Pure.

The parts of a scene are measured apart, because their times add up and their errors do not meet: how objects rest (`rest`),
what is drawn of them at the job's own rest (`draw`), its colour (`colour`); or a capture as a whole (`capture`). A setting's
row is put together of its parts, so that no combination across parts needs a measurement.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom, nct, norm

from schemas.base import Array
from schemas.errors import plural
from services.study.model import ERRORS, OWN, REFERENCES, Figure, Row, Setting

Answer = Mapping[str, Any]
"""What one scene says of one setting: `s` seconds of processor, `took` seconds by the clock,
`errors`, `failed` with a reason, and by part `bytes`, `plan_s`, `corners`, `lost` and `planned`."""

Answers = Mapping[int, Answer]
"""By scene."""

Part = str

AT_REST = ("physics.", "start.", "assets.")
"""Keys that change how objects rest; every other one changes what is drawn."""


@dataclass(frozen=True)
class PartKind:
    """A part of a scene in words, the groups of its errors, the keys that change it, its most scenes, and its share of time."""

    words: str
    groups: tuple[str, ...]
    is_changed_by: Callable[[str], bool]
    scenes: int
    share: float = 1.0


PARTS: Mapping[Part, PartKind] = {
    "rest": PartKind("how objects rest", ("physics",), lambda key: key.startswith(AT_REST), 512, 3.0),
    "draw": PartKind("depth and masks", ("labels", "mirror"), lambda key: not key.startswith(AT_REST), 64, 2.0),
    "colour": PartKind("colour", ("colour",), lambda key: key.startswith("render."), 8),
    "capture": PartKind("captures", ("capture",), lambda _: True, 32),
}

UNTIMED = "colour"
"""The part that measures errors and no time: its settings are timed where they are drawn."""


def part_of(error: str) -> Part:
    """The part that measures an error."""
    return next(part for part, kind in PARTS.items() if ERRORS[error].group in kind.groups)


@dataclass(frozen=True)
class Split:
    """What is measured: by part the settings, the job itself first, and of each setting of the table its settings by part."""

    measured: Mapping[Part, tuple[Setting, ...]]
    of: Mapping[str, Mapping[Part, Setting]]

    @property
    def timed(self) -> list[Part]:
        """The parts whose times make up a scene's."""
        return [part for part in self.measured if part != UNTIMED]


def split_settings(settings: Iterable[Setting], captured: bool) -> Split:
    """Settings by part; equal changes are measured once, under the name of the first setting that has them."""
    parts = ("capture",) if captured else ("rest", "draw", "colour")
    known = {(part, repr([])): OWN for part in parts}
    of: dict[str, dict[Part, Setting]] = {}
    for setting in settings:
        of[setting.name] = {}
        for part in parts:
            changes = {key: value for key, value in setting.changes.items() if PARTS[part].is_changed_by(key)}
            key = part, repr(sorted(changes.items()))
            of[setting.name][part] = known.setdefault(key, Setting(setting.parts, changes))
    measured = {part: tuple(setting for (at, _), setting in known.items() if at == part) for part in parts}
    if not captured:
        measured["rest"] += REFERENCES
    return Split(measured, of)


PERCENTILE = 95.0
"""The percentile of the scenes' figures that is a setting's error."""

SURE = 0.95
"""Confidence of a bound, one-sided."""

RESAMPLES, INTERVAL = 200, (2.5, 97.5)
"""Bootstrap samples of the scenes for an interval, and its percentiles of them."""


def figure_over_scenes(values: Sequence[float], negligible: float = 0.0, most: float = math.inf) -> Figure:
    """The 95th percentile of one value a scene, of at least one.

    In its bound values up to `negligible` count as that, and it is at most `most`, as shares are at most 1.
    """
    scenes = np.asarray(values, float)
    least, greatest = bounds_of_percentile(scenes, negligible)
    percentiles = np.percentile(scenes[_resampled(len(scenes))], PERCENTILE, axis=1)
    return _figure(percentiles, len(scenes), min(most, greatest), least)


def _figure(samples: Array, scenes: int, most: float | None = None, least: float | None = None) -> Figure:
    """A figure from its value and those of the bootstrap's samples, which are its bounds where there are no better ones."""
    value, (low, high) = float(samples[0]), np.percentile(samples[1:], INTERVAL).tolist()
    return Figure(value, low, high, low if least is None else least, max(value, high if most is None else most), scenes)


def bounds_of_percentile(values: Array, negligible: float = 0.0) -> tuple[float, float]:
    """What the `PERCENTILE` of all scenes is at least and at most, each with confidence `SURE`, from values [N] of some.

    Order statistics, whatever the distribution (Conover 1999, 3.2), the greater one of 59 scenes and more. Fewer bound nothing
    from above without a distribution; theirs is taken to be lognormal, for which the tolerance bound is exact (Hahn and Meeker
    1991, 4.6). Of 20 errors of piles of eight it covered 82 to 100 % of samples of 4 to 16 scenes out of 200, and the bootstrap
    14 to 61. Values up to `negligible`, above 0, count as that: the logarithm of rounding is no spread. Of one scene infinite.
    """
    count, ordered = len(values), np.sort(values)
    lower, upper, deviations = _bounding(count)
    least = float(ordered[lower - 1]) if lower else -math.inf
    if upper < count:
        return least, float(ordered[upper])
    if count == 1:
        return least, math.inf
    logs = np.log(np.maximum(values, negligible or np.finfo(float).tiny))
    return least, float(np.exp(min(logs.mean() + deviations * logs.std(ddof=1), math.log(np.finfo(float).max))))


@cache
def _bounding(count: int) -> tuple[int, int, float]:
    """Of so many values how many are at or below the percentile, with confidence `SURE`: at least, and at most.

    And the standard deviations from their mean to the one-sided tolerance bound of a normal distribution.
    """
    least, most = binom.ppf((1.0 - SURE, SURE), count, PERCENTILE / 100.0)
    bound = nct.ppf(SURE, count - 1, norm.ppf(PERCENTILE / 100.0) * math.sqrt(count)) / math.sqrt(count)
    return int(least), int(most), float(bound)


def share(parts: Sequence[float], wholes: Sequence[float], counted: bool = False) -> Figure:
    """The sum of `parts` over that of `wholes`.

    Of `counted` things the bound is never below the exact one of as many that are alike (Clopper and Pearson 1934), so that
    none of six says little.
    """
    rows, part, whole = _resampled(len(parts)), np.asarray(parts, float), np.asarray(wholes, float)
    count, rest = part.sum(), whole.sum() - part.sum()
    figure = _figure(part[rows].sum(axis=1) / whole[rows].sum(axis=1), len(part))
    if not counted:
        return figure
    return replace(figure, most=max(figure.most, float(beta.ppf(SURE, count + 1, rest)) if rest else 1.0))


def apart(values: Sequence[float], truth: Sequence[float]) -> Figure:
    """The first Wasserstein distance of two distributions, given by samples [N] of the same scenes in the same order.

    For as many samples of either it is the mean gap of the sorted ones (Ramdas, Garcia and Cuturi 2017), in their unit. The
    end of a tumbling object is random, so that only distributions can be compared. The interval is a paired bootstrap's.
    """
    both = np.sort(np.asarray([values, truth], float)[:, _resampled(len(values))], axis=-1)
    return _figure(np.abs(both[0] - both[1]).mean(axis=-1), len(values))


@cache
def _resampled(count: int) -> NDArray[np.int64]:
    """[1 + RESAMPLES, count] places of scenes: all, then samples, the same for every figure, so that settings are paired."""
    samples = np.random.default_rng(0).integers(0, count, (RESAMPLES, count), dtype=np.int64)
    return np.vstack([np.arange(count), samples])


AGREE_MM = 0.05
"""Two references agree where their poses are nearer than this; only then is there a true pose."""

LEAST_OUTCOMES = 8
"""Scenes without which two distributions of outcomes are not compared: of two scenes their distance is chance alone."""

SCENE_MM = 1000.0
"""Stands for the pose of an object that is there with one setting alone."""


def figures_of(part: Part, answers: Answers, references: Sequence[Answers] = ()) -> dict[str, Figure]:
    """A setting's errors in the order of `ERRORS`, from its answers of a part and, of rest, those of the references."""
    known = {scene: answer["errors"] for scene, answer in answers.items() if "errors" in answer}
    values = {name: [errors[name] for errors in known.values() if name in errors] for name in ERRORS}
    figures: dict[str, Figure] = {}
    if part == "rest" and answers:
        failed = ["failed" in answer for answer in answers.values()]
        figures["failed_share"] = share(failed, [1.0] * len(failed), counted=True)
    if planned := {n: answer["planned"] for n, answer in answers.items() if "planned" in answer}:
        lost = [answers[n]["lost"] for n in planned]
        figures["lost_share"] = share(lost, list(planned.values()), counted=True)
    if references:
        truth = {n: answer["errors"] for n, answer in references[0].items() if n in known and "errors" in answer}
        for name, key in (("outcome_mm", "slid_mm"), ("outcome_deg", "rolled_deg")):
            if len(truth) >= LEAST_OUTCOMES:
                figures[name] = apart([known[n][key] for n in truth], [truth[n][key] for n in truth])
        off = [pose_error(answers[n], [reference.get(n, {}) for reference in references]) for n in known]
        values["pose_mm"] = [value for value in off if value is not None]
    for name, some in values.items():
        if some:
            figures[name] = figure_over_scenes(some, ERRORS[name].negligible, ERRORS[name].most)
    return {name: figures[name] for name in ERRORS if name in figures}


def pose_error(answer: Answer, references: Sequence[Answer]) -> float | None:
    """The largest distance of a corner of an object's own box to where the first reference has it, mm.

    No point of the object moves farther. None where the references disagree.
    """
    if any("corners" not in other for other in (answer, *references)):
        return None
    return _apart_mm(answer, references[0]) if _apart_mm(*references) <= AGREE_MM else None


def _apart_mm(answer: Answer, other: Answer) -> float:
    mine, theirs = np.array(answer["corners"]), np.array(other["corners"])
    return float(np.linalg.norm(mine - theirs, axis=-1).max()) if mine.shape == theirs.shape else SCENE_MM


def unit_name(part: Part, scene_id: int, setting: Setting) -> str:
    """The key of an answer."""
    return f"{part}/{scene_id}/{setting.name}"


class Table:
    """The answers by part, setting and scene, and the rows of settings; it does not change."""

    def __init__(self, split: Split, answers: Mapping[str, Any]) -> None:
        """Sorts the answers; keys that are none of these parts' are others'."""
        self.split = split
        self._answers: dict[tuple[Part, str], dict[int, Any]] = {}
        for name, answer in answers.items():
            part, _, scene_and_setting = name.partition("/")
            if part in split.measured:
                scene, _, setting = scene_and_setting.partition("/")
                self._answers.setdefault((part, setting), {})[int(scene)] = answer
        self._figures: dict[tuple[Part, str], dict[str, Figure]] = {}
        self._took = {key: fmean(answer["took"] for answer in some.values()) for key, some in self._answers.items()}
        seconds = {
            part: [answer["s"] for answer in self.answers(part, OWN).values() if answer.get("s")]
            for part in split.timed
        }
        self._own_s = {part: fmean(some) for part, some in seconds.items() if some}
        planned = [answer["plan_s"] for answer in self.answers("rest", OWN).values() if "plan_s" in answer]
        self.own_ms = 1e3 * (sum(self._own_s.values()) + (fmean(planned) if planned else 0.0))

    def answers(self, part: Part, setting: Setting) -> Answers:
        """By scene."""
        return self._answers.get((part, setting.name), {})

    def cost_s(self, part: Part, setting: Setting) -> float:
        """Seconds by the clock of one scene: the mean so far, or the usual one of the part's settings."""
        usual = median([s for (at, _), s in self._took.items() if at == part] or [1.0])
        return self._took.get((part, setting.name), usual)

    def figures(self, part: Part, setting: Setting) -> dict[str, Figure]:
        """The errors of a part's setting.

        Percentiles over fewer scenes than the job's are the job's own times their ratio in the scenes of both (the ratio
        estimator, Cochran 1977, 6.3), where the job's are not negligible: of the easy scenes alone they would flatter.
        """
        key = part, setting.name
        if key not in self._figures:
            references = [self.answers("rest", reference) for reference in REFERENCES] if part == "rest" else []
            answers, own = self.answers(part, setting), self.answers(part, OWN)
            figures = figures_of(part, answers, references)
            same = {scene: own[scene] for scene in answers if scene in own}
            if 0 < len(same) < len(own):  # never of the job itself
                here, whole = figures_of(part, same, references), self.figures(part, OWN)
                for name in figures.keys() & here.keys():
                    if not ERRORS[name].pooled and here[name].value > ERRORS[name].negligible:
                        ratio = whole[name].value / here[name].value
                        figures[name] = figures[name].scaled(ratio, ERRORS[name].most)
            self._figures[key] = figures
        return self._figures[key]

    def ratio(self, part: Part, setting: Setting) -> Figure | None:
        """The ratio of a whole scene's time to the job's own, with this part alone changed; None where it has no time.

        The part's is the sum of the setting's seconds over the job's own in the scenes that both have.
        """
        timed = "draw" if part == UNTIMED else part
        mine, own = self.answers(timed, setting), self.answers(timed, OWN)
        both = [scene for scene in mine if scene in own and mine[scene].get("s") and own[scene].get("s")]
        if not both or timed not in self._own_s:
            return None
        figure = share([mine[n]["s"] for n in both], [own[n]["s"] for n in both])
        weight = 1e3 * self._own_s[timed] / self.own_ms
        ends = (figure.low, figure.high) if len(both) > 1 else (-math.inf, math.inf)  # one scene says nothing of others
        value, low, high = (1.0 + weight * (ratio - 1.0) for ratio in (figure.value, *ends))
        return Figure(value, low, high, low, high, figure.scenes)

    def row(self, setting: Setting) -> Row | None:
        """A setting's row, put together of its parts; None where one of them has no time yet."""
        mine = self.split.of[setting.name]
        changed = {part: changes for part, changes in mine.items() if changes != OWN}
        ratios = [self.ratio(part, changes) for part, changes in changed.items() if part != UNTIMED]
        known = [ratio for ratio in ratios if ratio is not None]
        is_timed = self._own_s.keys() == set(self.split.timed)
        if not is_timed or len(known) < len(ratios) or (not ratios and setting != OWN):
            return None
        ratio = 1.0 + sum(figure.value - 1.0 for figure in known)
        less = math.hypot(*(figure.value - figure.low for figure in known))
        more = math.hypot(*(figure.high - figure.value for figure in known))
        figures = [self.figures(part, some) for part, some in (mine if setting == OWN else changed).items()]
        errors = {name: some[name] for name in ERRORS for some in figures if name in some}
        drawn = [self.answers(part, mine[part]).values() for part in ("draw", "capture") if part in mine]
        sizes = [answer["bytes"] for answers in drawn for answer in answers if "bytes" in answer]
        kilobytes = fmean(sizes) / 1e3 if sizes else 0.0
        every = [self.answers(part, some).values() for part, some in mine.items()]
        failed = max(sum("failed" in answer for answer in answers) / max(1, len(answers)) for answers in every)
        failures = [answer for answers in every for answer in answers if "failed" in answer]
        reasons = Counter(answer.get("broken", answer["failed"]) for answer in failures)
        notes = tuple(f"{reason}: {plural(count, 'scene')}" for reason, count in sorted(reasons.items()))
        return Row(setting, self.own_ms * ratio, ratio, ratio - less, ratio + more, kilobytes, errors, failed, notes)
