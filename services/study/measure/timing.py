"""Processor time of a scene with each setting, and a setting's errors with their confidence intervals.

- Processor time of a scene with each setting, in turn within a round, on one core.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from schemas.errors import SceneError
from services.bench.figures import Spread
from services.study.measure.settling import context_for
from services.study.model import ERRORS, Figure, Row, Setting
from workers.physics.settle import settle_scene
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.effects import Facts, plan_effects
from workers.scene.plan import SceneChance, plan_scene
from workers.shard.run_shard import run_scene

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


WARM_SCENES = 4

SceneTimes = dict[str, Any]


def time_scene(
    context: WorkerContext, whole: Sequence[Setting], settling: Sequence[Setting], scene_id: int, lap: int
) -> SceneTimes:
    """Seconds of processor by setting: of the whole scene up to its encoded files, or of `settling` alone.

    The first run, of the job itself, builds the scene's shapes, as a job does in every scene; all others find them in caches,
    so that the cost of new shapes is known (`cold`). The others run in a new order in each scene and `lap`, so that no
    setting always follows the same one. Bytes are those of all files and of no rows.
    """
    began = time.process_time()
    run_scene(context, scene_id, Stopwatch())
    cold = time.process_time() - began
    answer: SceneTimes = {"whole": {}, "settling": {}, "bytes": {}, "cold": cold}
    order = np.random.default_rng([scene_id, lap])
    for setting in [whole[k] for k in order.permutation(len(whole))]:
        worker = context_for(context, setting)
        began = time.process_time()
        output = run_scene(worker, scene_id, Stopwatch())
        took = time.process_time() - began
        if output.files:
            answer["whole"][setting.name] = took
            answer["bytes"][setting.name] = sum(len(file.data) for file in output.files)
    for setting in [settling[k] for k in order.permutation(len(settling))]:
        with suppress(SceneError):  # where the scene does not come to rest
            answer["settling"][setting.name] = _settle_s(context_for(context, setting), scene_id)
    return answer


def warm_up(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> None:
    """Make untimed scenes with every setting: the first run compiles code and shaders."""
    for number in range(WARM_SCENES):
        run_scene(context, scene_id + number, Stopwatch())
    for setting in settings:
        run_scene(context_for(context, setting), scene_id, Stopwatch())


def _settle_s(context: WorkerContext, scene_id: int) -> float:
    """Seconds for choosing the effects and settling. Raises SceneError."""
    plan = plan_scene(context.job, context.catalogue, SceneChance(context.job.seed, scene_id))
    began = time.process_time()
    settle_scene(plan, context.job.physics, plan_effects(Facts(context.job, plan, raycast_checked=False)))
    return time.process_time() - began


@dataclass(frozen=True)
class Cost:
    """A setting's time over the job's own, round by round, kilobytes a scene (None: as the job's own), and scenes timed."""

    ratio: Spread
    kilobytes: float | None
    scenes: int


def job_cost(laps: Sequence[Mapping[int, SceneTimes]], own: str) -> tuple[float, float]:
    """(milliseconds of processor, kilobytes) a scene of the job itself: medians over rounds, shapes new."""
    made = [[_own_s(lap, laps[0], scene, own) for scene, one in lap.items() if own in one["whole"]] for lap in laps]
    sizes = [answer["bytes"][own] for answer in laps[0].values() if own in answer["bytes"]]
    return median(fmean(times) for times in made if times) * 1e3, fmean(sizes) / 1e3


def _own_s(lap: Mapping[int, SceneTimes], first: Mapping[int, SceneTimes], scene: int, own: str) -> float:
    """Seconds of the job's own scene in this round, plus the cost of new shapes, which is measured once."""
    new = max(0.0, first[scene]["cold"] - first[scene]["whole"].get(own, first[scene]["cold"]))
    return float(lap[scene]["whole"][own]) + new


def timed_rows(settings: Sequence[Setting], laps: Sequence[Mapping[int, SceneTimes]]) -> Iterator[tuple[Row, int]]:
    """(row without errors, scenes timed) of each setting that has a time; the first setting is the job itself."""
    own = settings[0].name
    own_ms, own_kb = job_cost(laps, own)
    for setting in settings:
        cost = cost_of(setting.name, own, laps)
        if cost is None:
            continue
        row = Row(
            setting=setting,
            ms=own_ms * cost.ratio.median,
            ratio=cost.ratio.median,
            ratio_least=cost.ratio.least,
            ratio_most=cost.ratio.most,
            kilobytes=own_kb if cost.kilobytes is None else cost.kilobytes,
            errors={},
            failed_share=0.0,
        )
        yield row, cost.scenes


def cost_of(name: str, own: str, laps: Sequence[Mapping[int, SceneTimes]]) -> Cost | None:
    """A setting's cost over the scenes that it and the job made in a round; None where there are none.

    A setting that only settles is compared by settling: its difference to the job's own is added to the whole.
    """
    ratios, scenes_seen = [], set[int]()
    for lap in laps:
        more, base = 0.0, 0.0
        for scene, answer in lap.items():
            key = "whole" if name in answer["whole"] else "settling"
            if name not in answer[key] or own not in answer[key] or own not in answer["whole"]:
                continue
            more += answer[key][name] - answer[key][own]
            base += _own_s(lap, laps[0], scene, own)
            scenes_seen.add(scene)
        if base:
            ratios.append((base + more) / base)
    if not ratios:
        return None
    sizes = [a["bytes"][name] for a in laps[0].values() if name in a["bytes"]]
    return Cost(Spread.of(ratios), fmean(sizes) / 1e3 if sizes else None, len(scenes_seen))
