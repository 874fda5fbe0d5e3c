"""A setting's errors with their confidence intervals, from the figures of scenes. Pure."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from services.study.errors import ERRORS
from services.study.model import Figure

PERCENTILE = 95.0
"""The percentile of the scenes' figures that is a setting's error."""

RESAMPLES = 200
"""Bootstrap samples of the scenes for an interval."""

INTERVAL = (2.5, 97.5)

Answer = Mapping[str, Any]
Rows = NDArray[np.int64]


def figure_over_scenes(figures: Sequence[float]) -> Figure:
    """The 95th percentile of one figure a scene. Raises ValueError for no scenes."""
    if not figures:
        raise ValueError("an error of no scenes")
    values = np.asarray(figures, float)
    return _figure(len(values), lambda rows: float(np.percentile(values[rows], PERCENTILE)), float(np.median(values)))


def share(flags: Sequence[bool]) -> Figure:
    """The share of true flags."""
    values = np.asarray(flags, float)
    return _figure(len(values), lambda rows: float(values[rows].mean()))


def apart(own: Sequence[float], truth: Sequence[float]) -> Figure:
    """The first Wasserstein distance of two distributions, given by samples [N] of the same scenes in the same order.

    It is the area between the cumulative distributions, in the samples' unit (Villani 2009, Optimal Transport, 6.2; Ramdas,
    Garcia and Cuturi 2017 for one dimension). The end of a tumbling object is random, so that only distributions can be
    compared. The interval is a paired bootstrap's; the median repeats the value.
    """
    mine, other = np.asarray(own, float), np.asarray(truth, float)
    return _figure(len(mine), lambda rows: float(wasserstein_distance(mine[rows], other[rows])))


def _figure(count: int, measure: Callable[[Rows], float], median: float | None = None) -> Figure:
    """The value over all scenes, with a bootstrap's interval; without a median the value is it."""
    rng = np.random.default_rng(0)
    samples = [measure(rng.integers(0, count, count, dtype=np.int64)) for _ in range(RESAMPLES)]
    low, high = np.percentile(samples, INTERVAL)
    value = measure(np.arange(count, dtype=np.int64))
    return Figure(value, float(low), float(high), value if median is None else median, count)


def settling_figures(name: str, scenes: Sequence[Answer]) -> dict[str, Figure]:
    """A setting's errors of physics, from the answers of `measure_settling`, each of which has all settings."""
    mine = [scene[name] for scene in scenes if name in scene]
    if not mine:
        return {}
    found = {"failed_share": share([one["failed"] for one in mine])}
    for error in ("penetration_mm", "gap_mm", "unbalanced_share", "pose_mm", "moved_mm", "turned_deg"):
        if figures := [one[error] for one in mine if error in one]:
            found[error] = figure_over_scenes(figures)
    both = [
        (scene[name], scene["reference"])
        for scene in scenes
        if name in scene and not scene[name]["failed"] and not scene["reference"]["failed"]
    ]
    if len(both) > 1:
        found["outcome_mm"] = apart([a["slid_mm"] for a, _ in both], [b["slid_mm"] for _, b in both])
        found["outcome_deg"] = apart([a["rolled_deg"] for a, _ in both], [b["rolled_deg"] for _, b in both])
    return found


def image_figures(scenes: Sequence[Mapping[str, float]]) -> dict[str, Figure]:
    """A setting's errors of images, from one mapping a scene, in the order of `ERRORS`."""
    names = [name for name in ERRORS if any(name in scene for scene in scenes)]
    return {name: figure_over_scenes([scene[name] for scene in scenes if name in scene]) for name in names}
