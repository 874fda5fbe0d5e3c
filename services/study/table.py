"""The table of a study: setting x scene x error x seconds, as answers of single scenes, and the rows that it comes to. Pure.

The parts of a scene are measured apart, because their times add up and their errors do not meet: how objects rest (`rest`,
and let go again `again`), what is drawn of them at the job's own rest (`draw`), its colour (`colour`); or a capture as a
whole (`capture`). A setting's row is put together of its parts, so that no combination across parts needs a measurement.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom, nct, norm

from schemas.base import Array
from services.study.knobs import REFERENCES, TIMED, Part, Parts
from services.study.model import ERRORS, NEGLIGIBLE, OWN, Figure, Row, Setting

Answer = Mapping[str, Any]
"""What one scene told of one setting: `s` seconds of processor (None where the machine slept), `took` seconds by the clock,
`errors`, `failed` with a reason, and by part `bytes`, `plan_s`, `corners`, `lost`."""

Answers = Mapping[int, Answer]
"""By scene."""

AGREE_MM = 0.05
"""Two references agree where their poses are nearer than this; only then is there a true pose."""

LEAST_OUTCOMES = 8
"""Scenes without which two distributions of outcomes are not compared: of two scenes their distance is chance alone."""

SCENE_MM = 1000.0
"""Stands for the pose of an object that is there with one setting alone."""

REFERENCE_TIMES = 8.0
"""A guess at how many times the job's own time a reference takes, before one was measured."""

# ---------------------------------------------------------------------------------------------- over scenes

PERCENTILE = 95.0
"""The percentile of the scenes' figures that is a setting's error."""

RESAMPLES = 200
"""Bootstrap samples of the scenes for an interval."""

INTERVAL = (2.5, 97.5)

SURE = 0.95
"""Confidence of a bound, one-sided."""


def figure_over_scenes(values: Sequence[float], negligible: float = 0.0, most: float = math.inf) -> Figure:
    """The 95th percentile of one value a scene, of at least one.

    In its bound values up to `negligible` count as that, and it is at most `most`, as shares are at most 1.
    """
    scenes = np.asarray(values, float)
    samples = np.percentile(scenes[_resampled(len(scenes))], PERCENTILE, axis=1)
    value, median = float(np.percentile(scenes, PERCENTILE)), float(np.median(scenes))
    least, greatest = bounds_of_percentile(scenes, negligible)
    return replace(_figure(samples, value, len(scenes)), median=median, most=min(most, greatest), least=least)


def bounds_of_percentile(values: Array, negligible: float = 0.0) -> tuple[float, float]:
    """What the `PERCENTILE` of all scenes is at least and at most, each with confidence `SURE`, from values [N] of some.

    Order statistics, whatever the distribution (Conover 1999, 3.2), the greater one of 59 scenes and more. Fewer bound nothing
    from above without a distribution; theirs is taken to be lognormal, for which the tolerance bound is exact (Hahn and Meeker
    1991, 4.6). Of 20 errors of piles of eight it covered 82 to 100 % of samples of 4 to 16 scenes out of 200, and the bootstrap
    14 to 61. Values up to `negligible`, above 0, count as that: the logarithm of rounding is no spread. Of one scene infinite.
    """
    count, ordered = len(values), np.sort(values)
    lower, upper = _ranks(count)
    least = float(ordered[lower - 1]) if lower else -math.inf
    if upper < count:
        return least, float(ordered[upper])
    if count == 1:
        return least, math.inf
    logs = np.log(np.maximum(values, negligible or np.finfo(float).tiny))
    greatest = logs.mean() + _tolerance(count) * logs.std(ddof=1)
    return least, float(np.exp(min(greatest, math.log(np.finfo(float).max))))


@cache
def _ranks(count: int) -> tuple[int, int]:
    """How many of so many values are at or below the percentile, with confidence `SURE`: at least, and at most."""
    least, most = binom.ppf((1.0 - SURE, SURE), count, PERCENTILE / 100.0)
    return int(least), int(most)


@cache
def _tolerance(count: int) -> float:
    """Standard deviations from the mean of so many to the one-sided tolerance bound of a normal distribution."""
    return float(nct.ppf(SURE, count - 1, norm.ppf(PERCENTILE / 100.0) * math.sqrt(count)) / math.sqrt(count))


def share(parts: Sequence[float], wholes: Sequence[float] | None = None, counted: bool = False) -> Figure:
    """The sum of `parts` over that of `wholes`, which are 1 where they are not given: of flags the share of true ones.

    Of `counted` things the bound is never below the exact one of as many that are alike (Clopper and Pearson 1934), so that
    none of six says little.
    """
    part = np.asarray(parts, float)
    whole = np.ones(len(part)) if wholes is None else np.asarray(wholes, float)
    rows, count, out_of = _resampled(len(part)), part.sum(), whole.sum()
    figure = _figure(part[rows].sum(axis=1) / whole[rows].sum(axis=1), float(count / out_of), len(part))
    if not counted:
        return figure
    exact = float(beta.ppf(SURE, count + 1, out_of - count)) if count < out_of else 1.0
    return replace(figure, most=max(figure.high, exact))


def apart(values: Sequence[float], truth: Sequence[float]) -> Figure:
    """The first Wasserstein distance of two distributions, given by samples [N] of the same scenes in the same order.

    For as many samples of either it is the mean gap of the sorted ones (Ramdas, Garcia and Cuturi 2017), in their unit. The
    end of a tumbling object is random, so that only distributions can be compared. The interval is a paired bootstrap's.
    """
    mine, other = np.asarray(values, float), np.asarray(truth, float)
    rows = _resampled(len(mine))
    samples = np.abs(np.sort(mine[rows], axis=1) - np.sort(other[rows], axis=1)).mean(axis=1)
    return _figure(samples, float(np.abs(np.sort(mine) - np.sort(other)).mean()), len(mine))


def is_less(pairs: Sequence[tuple[float, float]]) -> bool | None:
    """Whether most scenes surely have less of an error than with the job itself: the sign test (Conover 1999, 3.4).

    `pairs`: the setting's and the job's values of the same scenes. None where there are none, or all are alike.
    """
    less, more = sum(a < b for a, b in pairs), sum(a > b for a, b in pairs)
    return bool(binom.cdf(more, less + more, 0.5) <= 1.0 - SURE) if less + more else None


def _resampled(count: int) -> NDArray[np.int64]:
    """[RESAMPLES, count] places of scenes, the same ones for every figure of as many scenes, so that settings are paired."""
    return np.random.default_rng(0).integers(0, count, (RESAMPLES, count), dtype=np.int64)


def _figure(samples: Array, value: float, scenes: int) -> Figure:
    low, high = np.percentile(samples, INTERVAL)
    return Figure(value, float(low), float(high), value, scenes)


# ---------------------------------------------------------------------------------------------- errors of one setting


def figures_of(answers: Answers, references: Sequence[Answers] = ()) -> dict[str, Figure]:
    """A setting's errors in the order of `ERRORS`, from its answers and, of rest, those of the references."""
    known = {scene: answer["errors"] for scene, answer in answers.items() if "errors" in answer}
    figures: dict[str, Figure] = {}
    for name in ERRORS:
        if values := [errors[name] for errors in known.values() if name in errors]:
            figures[name] = figure_over_scenes(values, NEGLIGIBLE[ERRORS[name].unit], _most_of(name))
    if answers:
        figures["failed_share"] = share(["failed" in answer for answer in answers.values()], counted=True)
    if counted := [answer for answer in answers.values() if "lost" in answer]:
        planned = [answer["planned"] for answer in counted]
        for name, key in (("lost_share", "lost"), ("redrawn_share", "redrawn")):
            figures[name] = share([answer[key] for answer in counted], planned, counted=True)
    if references:
        truth = {n: answer["errors"] for n, answer in references[0].items() if n in known and "errors" in answer}
        for name, key in (("outcome_mm", "slid_mm"), ("outcome_deg", "rolled_deg")):
            if len(truth) >= LEAST_OUTCOMES:
                figures[name] = apart([known[n][key] for n in truth], [truth[n][key] for n in truth])
        off = [pose_error(answers[n], [reference.get(n, {}) for reference in references]) for n in known]
        if poses := [value for value in off if value is not None]:
            figures["pose_mm"] = figure_over_scenes(poses, NEGLIGIBLE["mm"])
    return {name: figures[name] for name in ERRORS if name in figures}


def _most_of(error: str) -> float:
    """What an error can be at most: shares are at most 1."""
    return math.inf if ERRORS[error].unit else 1.0


def pose_error(answer: Answer, references: Sequence[Answer]) -> float | None:
    """The largest distance of an object's place to that of the first reference, mm; None where the references disagree.

    Places are those of the corners of the object's own box, which no point of the object moves farther than.
    """
    if len(references) < 2 or any("corners" not in other for other in (answer, *references)):
        return None
    if _apart_mm(references[0], references[1]) > AGREE_MM:
        return None
    return _apart_mm(answer, references[0])


def _apart_mm(answer: Answer, other: Answer) -> float:
    mine, theirs = np.array(answer["corners"]), np.array(other["corners"])
    return float(np.linalg.norm(mine - theirs, axis=-1).max()) if mine.shape == theirs.shape else SCENE_MM


def ratio_of_times(setting: Answers, own: Answers) -> Figure | None:
    """The sum of a setting's seconds over the job's own in the scenes that both have; None without one."""
    both = [scene for scene in setting if scene in own and setting[scene].get("s") and own[scene].get("s")]
    return share([setting[n]["s"] for n in both], [own[n]["s"] for n in both]) if both else None


# ---------------------------------------------------------------------------------------------- the table


def unit_name(part: Part, scene_id: int, setting: Setting) -> str:
    """The key of an answer."""
    return f"{part}/{scene_id}/{setting.name}"


class Table:
    """The answers by part, setting and scene, and the rows of settings; it does not change."""

    def __init__(self, parts: Parts, journal: Mapping[str, Any]) -> None:
        """Sorts the answers; keys that are none of these parts' are others'."""
        self.parts = parts
        self._answers: dict[tuple[Part, str], dict[int, Any]] = {}
        for name, answer in journal.items():
            part, _, scene_and_setting = name.partition("/")
            if part in parts.measured:
                scene, _, setting = scene_and_setting.partition("/")
                self._answers.setdefault((part, setting), {})[int(scene)] = answer
        self._figures: dict[tuple[Part, str], dict[str, Figure]] = {}
        seconds = {part: [one["s"] for one in self.answers(part, OWN).values() if one.get("s")] for part in parts.timed}
        self._own_s = {part: fmean(some) for part, some in seconds.items() if some}
        planned = [one["plan_s"] for one in self.answers("rest", OWN).values() if "plan_s" in one]
        self.own_ms = 1e3 * (sum(self._own_s.values()) + (fmean(planned) if planned else 0.0))

    def answers(self, part: Part, setting: Setting) -> Answers:
        """By scene."""
        return self._answers.get((part, setting.name), {})

    def scenes(self, part: Part, setting: Setting) -> int:
        """In how many scenes a part's setting was measured."""
        return len(self.answers(part, setting))

    def cost_s(self, part: Part, setting: Setting) -> float:
        """Seconds by the clock of one scene: the mean so far, or the usual one of the part's settings."""
        if took := self._took(part, setting):
            return fmean(took)
        usual = [fmean(some) for other in self.parts.measured[part] if (some := self._took(part, other))]
        return (REFERENCE_TIMES if setting in REFERENCES else 1.0) * (median(usual) if usual else 1.0)

    def _took(self, part: Part, setting: Setting) -> list[float]:
        return [answer["took"] for answer in self.answers(part, setting).values()]

    def figures(self, part: Part, setting: Setting) -> dict[str, Figure]:
        """The errors of a part's setting; shares of failed scenes of rest alone.

        Percentiles over fewer scenes than the job's are the job's own times their ratio in the scenes of both (the ratio
        estimator, Cochran 1977, 6.3), where the job's are not negligible: of the easy scenes alone they would flatter.
        """
        key = part, setting.name
        if key not in self._figures:
            answers, own = self.answers(part, setting), self.answers(part, OWN)
            figures = self._figures_of(part, answers)
            same = {scene: own[scene] for scene in answers if scene in own}
            if setting != OWN:
                figures = {name: replace(one, less=_less(name, answers, same)) for name, one in figures.items()}
            if 0 < len(same) < len(own):  # never of the job itself
                here, whole = self._figures_of(part, same), self.figures(part, OWN)
                for name in figures.keys() & here.keys():
                    if not ERRORS[name].pooled and here[name].value > NEGLIGIBLE[ERRORS[name].unit]:
                        figures[name] = figures[name].scaled(whole[name].value / here[name].value, _most_of(name))
            self._figures[key] = figures
        return self._figures[key]

    def _figures_of(self, part: Part, answers: Answers) -> dict[str, Figure]:
        if part == "rest":
            return figures_of(answers, [self.answers("rest", one) for one in REFERENCES])
        return {name: figure for name, figure in figures_of(answers).items() if name != "failed_share"}

    def ratio(self, part: Part, setting: Setting) -> Figure | None:
        """The ratio of a whole scene's time to the job's own, with this part alone changed; None where it has no time."""
        timed = TIMED.get(part, part)
        figure = ratio_of_times(self.answers(timed, setting), self.answers(timed, OWN))
        if figure is None or timed not in self._own_s:
            return None
        weight = 1e3 * self._own_s[timed] / self.own_ms
        value, low, high = (1.0 + weight * (ratio - 1.0) for ratio in (figure.value, figure.low, figure.high))
        return Figure(value, low, high, value, figure.scenes)

    def row(self, setting: Setting, of: Mapping[Part, Setting] | None = None) -> Row | None:
        """A setting's row, put together of these settings of its parts; None where one of them has no time yet."""
        mine = self.parts.of[setting.name] if of is None else of
        changed = {part: one for part, one in mine.items() if one != OWN}
        ratios = [self.ratio(part, one) for part, one in changed.items() if part not in TIMED]
        known = [ratio for ratio in ratios if ratio is not None]
        is_timed = self._own_s.keys() == set(self.parts.timed)
        if not is_timed or len(known) < len(ratios) or (not ratios and setting != OWN):
            return None
        ratio = 1.0 + sum(one.value - 1.0 for one in known)
        less = math.hypot(*(one.value - one.low for one in known))
        more = math.hypot(*(one.high - one.value for one in known))
        figures = [self.figures(part, one) for part, one in (mine if setting == OWN else changed).items()]
        errors = {name: some[name] for name in ERRORS for some in figures if name in some}
        drawn = [self.answers(part, mine[part]).values() for part in ("draw", "capture") if part in mine]
        sizes = [answer["bytes"] for answers in drawn for answer in answers if "bytes" in answer]
        kilobytes = fmean(sizes) / 1e3 if sizes else 0.0
        notes = (*self._failures(mine), *self._few(changed, known))
        failed = self._failed_share(mine)
        return Row(setting, self.own_ms * ratio, ratio, ratio - less, ratio + more, kilobytes, errors, failed, notes)

    def _few(self, changed: Mapping[Part, Setting], ratios: Sequence[Figure]) -> tuple[str, ...]:
        """A note where a setting was measured in few scenes."""
        if ratios and min(ratio.scenes for ratio in ratios) == 1:
            return ("measured in one scene: no interval",)
        counts = {part: self.scenes(part, one) for part, one in changed.items()}
        fewer = [count for part, count in counts.items() if count < self.scenes(part, OWN)]
        if not fewer:
            return ()
        return (
            f"measured in {min(fewer)} scenes and the job in more: percentiles are the job's, times the ratio in the same",
        )

    def _failures(self, mine: Mapping[Part, Setting]) -> tuple[str, ...]:
        """The reasons of scenes that fail, with their counts."""
        answers = [answer for part, one in mine.items() for answer in self.answers(part, one).values()]
        reasons = [answer.get("broken", answer["failed"]) for answer in answers if "failed" in answer]
        counts = {reason: reasons.count(reason) for reason in sorted(set(reasons))}
        return tuple(f"{reason}: {count} scene{'s' * (count > 1)}" for reason, count in counts.items())

    def _failed_share(self, mine: Mapping[Part, Setting]) -> float:
        """The share of scenes that fail, of rest or of a capture, and of those that are drawn more than the job's own."""

        def failed(part: Part, setting: Setting) -> float:
            answers = self.answers(part, setting).values()
            return sum("failed" in answer for answer in answers) / len(answers) if answers else 0.0

        first = next(iter(mine))
        more = failed("draw", mine["draw"]) - failed("draw", OWN) if "draw" in mine else 0.0
        return min(1.0, failed(first, mine[first]) + max(0.0, more))


def _less(error: str, answers: Answers, same: Answers) -> bool | None:
    """The sign test of an error in the scenes that the job itself has too."""
    pairs = [(answers[n].get("errors", {}), own.get("errors", {})) for n, own in same.items()]
    return is_less([(mine[error], theirs[error]) for mine, theirs in pairs if error in mine and error in theirs])
