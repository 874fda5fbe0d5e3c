"""From figures of single scenes to an error with its interval and its bound for scenes at large. Pure."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom, nct, norm

from schemas.base import Array
from services.study.model import Figure

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
