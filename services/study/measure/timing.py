"""Processor time of a scene with each setting, in turn within a round, on one core."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any

import numpy as np

from schemas.errors import SceneError
from services.bench.ratios import Spread
from services.study.measure.settling import context_for
from services.study.model import Row, Setting
from workers.physics.settle import settle_scene
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.effects import Facts, plan_effects
from workers.scene.plan import SceneChance, plan_scene
from workers.shard.run_shard import run_scene

WARM_SCENES = 4

Answer = dict[str, Any]


def time_scene(
    context: WorkerContext, whole: Sequence[Setting], settling: Sequence[Setting], scene_id: int, lap: int
) -> Answer:
    """Seconds of processor by setting: of the whole scene up to its encoded files, or of `settling` alone.

    The first run, of the job itself, builds the scene's shapes, as a job does in every scene; all others find them in caches,
    so that the cost of new shapes is known (`cold`). The others run in a new order in each scene and `lap`, so that no
    setting always follows the same one. Bytes are those of all files and of no rows.
    """
    began = time.process_time()
    run_scene(context, scene_id, Stopwatch())
    cold = time.process_time() - began
    answer: Answer = {"whole": {}, "settling": {}, "bytes": {}, "cold": cold}
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


def job_cost(laps: Sequence[Mapping[int, Answer]], own: str) -> tuple[float, float]:
    """(milliseconds of processor, kilobytes) a scene of the job itself: medians over rounds, shapes new."""
    made = [[_own_s(lap, laps[0], scene, own) for scene, one in lap.items() if own in one["whole"]] for lap in laps]
    sizes = [answer["bytes"][own] for answer in laps[0].values() if own in answer["bytes"]]
    return median(fmean(times) for times in made if times) * 1e3, fmean(sizes) / 1e3


def _own_s(lap: Mapping[int, Answer], first: Mapping[int, Answer], scene: int, own: str) -> float:
    """Seconds of the job's own scene in this round, plus the cost of new shapes, which is measured once."""
    new = max(0.0, first[scene]["cold"] - first[scene]["whole"].get(own, first[scene]["cold"]))
    return float(lap[scene]["whole"][own]) + new


def timed_rows(settings: Sequence[Setting], laps: Sequence[Mapping[int, Answer]]) -> Iterator[tuple[Row, int]]:
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


def cost_of(name: str, own: str, laps: Sequence[Mapping[int, Answer]]) -> Cost | None:
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
