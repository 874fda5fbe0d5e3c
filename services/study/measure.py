"""Measures a scene with each setting: how it comes to rest, and its time; and a setting's errors with their intervals.

Rest is held against finer steps than any that is measured. Times are of processor on one core, settings in turn.
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from schemas.errors import SceneError
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ScenePlan
from services.bench.figures import Spread
from services.study.knobs import apply
from services.study.model import ERRORS, Figure, Row, Setting
from workers.geometry.frames import motion_between, transform
from workers.physics.bullet import GRAVITY_M_S2, World, open_world
from workers.physics.fall import FINEST
from workers.physics.recheck import moved_by, recheck_scene
from workers.physics.rigid_body import Body
from workers.physics.settle import Rest, settle_scene
from workers.scene.chance import SceneChance
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.effects import Facts, plan_effects
from workers.scene.plan import plan_scene, pouring_of
from workers.shard.run_shard import run_scene

RATES_HZ = (3840, 7680, 15360)
"""An order shows in the limit: in longer steps a sliding block loses contacts for single steps, and stops a little later."""

FALL_S, HEIGHT_M = 0.5, 3.0
SLIDE_M_S, FRICTION = 1.0, 0.6

SIDES_M, MARGIN_M = (0.2, 0.2, 0.01), 1e-4
"""Of the block that falls and slides, and the margin of its shape."""


def slopes() -> dict[str, float]:
    """Order in the step of each case, by least squares of log error over log step.

    Semi-implicit Euler, which is what Bullet integrates with, is of the first order (Hairer, Lubich and Wanner 2006, I.1).
    """
    found = {}
    for name, error in (("free fall", _fall_error_m), ("sliding to rest", _slide_error_m)):
        errors = [abs(error(rate)) for rate in RATES_HZ]
        found[name] = float(np.polyfit(-np.log(RATES_HZ), np.log(errors), 1)[0])
    return found


@contextmanager
def _block_at(height_m: float, rate_hz: int) -> Iterator[World]:
    """A world with the block at a height."""
    physics = Job(name="convergence").physics.model_copy(update={"step_hz": rate_hz, "friction": math.sqrt(FRICTION)})
    squares = np.square(SIDES_M)
    corners = np.array(list(itertools.product(*((-side, side) for side in SIDES_M)))) / 2
    T = np.eye(4)
    T[2, 3] = height_m
    with open_world([(Body(1.0, (squares.sum() - squares) / 12, (corners,), MARGIN_M), T)], 0.0, physics, 1) as world:
        yield world


def _fall_error_m(rate_hz: int) -> float:
    """Error of a free fall against half g t squared."""
    with _block_at(HEIGHT_M, rate_hz) as world:
        _advance(world, round(FALL_S * rate_hz))
        return float(HEIGHT_M - world.pose()[0][2] - GRAVITY_M_S2 * FALL_S**2 / 2)


def _slide_error_m(rate_hz: int) -> float:
    """Error of a sliding distance against v squared / 2 mu g (Coulomb friction); the block first settles for a second."""
    with _block_at(SIDES_M[2] / 2 + MARGIN_M, rate_hz) as world:
        _advance(world, rate_hz)
        before = world.pose()[0][0]
        world.set_velocity((SLIDE_M_S, 0.0, 0.0))
        _advance(world, rate_hz)
        return float(world.pose()[0][0] - before - SLIDE_M_S**2 / (2.0 * FRICTION * GRAVITY_M_S2))


def _advance(world: World, steps: int) -> None:
    for _ in range(steps):
        world.advance()


AGREE_MM = 0.05
"""Two references agree where their poses are nearer than this; only then is there a true pose."""

REFERENCES: tuple[Mapping[str, Any], ...] = (
    {"step_hz": 3840, "max_step_travel_mm": 0.03, "solver_iterations": 400},
    {"step_hz": 7680, "max_step_travel_mm": 0.015, "solver_iterations": 400},
)
"""Settings of physics finer than every measured value. The first gives the distribution of outcomes; a pose has a truth where
both agree."""

SCENE_MM = 1000.0
"""Stands for the pose of an object that is there with one setting alone."""

RELEASED: Mapping[str, Any] = {"step_hz": 960, "max_step_travel_mm": 0.05, "solver_iterations": 400}
"""Settings of physics, in steps 16 times shorter, with which objects at rest are released again."""

WARM_SCENES = 4

PERCENTILE = 95.0
"""The percentile of the scenes' figures that is a setting's error."""

RESAMPLES = 200
"""Bootstrap samples of the scenes for an interval."""

INTERVAL = (2.5, 97.5)

Answer = dict[str, Any]
Laps = Sequence[Mapping[int, Mapping[str, Any]]]
"""What `time_scene` told, by round and scene."""


def measure_settling(
    context: WorkerContext, settings: Sequence[Setting], scene_id: int, posed: bool, released: bool
) -> dict[str, Answer]:
    """Figures of one scene by the settings' names, and of the reference under "reference".

    Each has `failed`, or else penetration_mm, gap_mm and unbalanced_share, slid_mm and rolled_deg (sideways travel of the
    centre of mass, and turn, since the object was released; the largest of several objects). With `posed` also pose_mm,
    where there is a truth; with `released` moved_mm and turned_deg. A scene that cannot be drawn has no answers.
    """
    try:
        plan = plan_scene(context.job, context.catalogue, SceneChance(context.job.seed, scene_id))
    except SceneError:
        return {}
    truths = [_settle(context.job, plan, reference) for reference in REFERENCES[: 2 if posed else 1]]
    answers = {"reference": _describe(truths[0])}
    agreed = posed and None not in truths and _apart_mm(*truths) <= AGREE_MM  # type: ignore[arg-type]
    answers["reference"]["agreed"] = agreed if posed else None
    again = dict[bytes, dict[str, float]]()
    for setting in settings:
        job = apply(context.job, setting.changes)
        rest = _settle(job, plan)
        answer = answers[setting.name] = _describe(rest)
        if rest is None:
            continue
        if agreed and truths[0] is not None:
            answer["pose_mm"] = _apart_mm(rest, truths[0])
        if released:
            key = b"".join(one.T_world_obj.tobytes() for one in rest.settled)
            if key not in again:
                again[key] = _release(context.job, plan, rest)
            answer.update(again[key])
    return answers


def _settle(job: Job, plan: ScenePlan, physics: Mapping[str, Any] | None = None) -> Rest | None:
    """None where the scene does not come to rest. What is lost is drawn again or removed as by `run`."""
    pouring = pouring_of(job.start, SceneChance(job.seed, plan.scene_id), plan)
    try:
        return settle_scene(plan, *_physics(job, plan, physics or {}), pouring)
    except SceneError:
        return None


def _physics(job: Job, plan: ScenePlan, changes: Mapping[str, Any]) -> tuple[Physics, EffectPlan]:
    """The job's physics with these changes, and the plan of effects with them."""
    physics = job.physics.model_copy(update=dict(changes))
    return physics, plan_effects(Facts(job.model_copy(update={"physics": physics}), plan, raycast_checked=False))


def _describe(rest: Rest | None) -> Answer:
    if rest is None:
        return {"failed": True}
    slid, rolled = [], []
    for start, end in zip(rest.starts, rest.settled, strict=True):
        before, after = (transform(T, start.asset.mass.com[None])[0, :2] for T in (start.T_world_obj, end.T_world_obj))
        slid.append(float(np.linalg.norm(after - before)) * 1e3)
        rolled.append(math.degrees(motion_between(start.hull.vertices, start.T_world_obj, end.T_world_obj)[1]))
    return {
        "failed": False,
        "penetration_mm": max(one.penetration_mm for one in rest.settled),
        "gap_mm": max(one.hover_gap_mm for one in rest.settled),
        "unbalanced_share": max(one.equilibrium_residual for one in rest.settled),
        "slid_mm": max(slid),
        "rolled_deg": max(rolled),
    }


def _apart_mm(one: Rest, other: Rest) -> float:
    """The largest distance between the places of a point of an object in two rests, mm; as long as a scene if one has fewer."""
    if len(one.starts) != len(other.starts):
        return SCENE_MM
    return max(
        moved_by(start, a.T_world_obj, b.T_world_obj)[0]
        for start, a, b in zip(one.starts, one.settled, other.settled, strict=True)
    )


def _release(job: Job, plan: ScenePlan, rest: Rest) -> dict[str, float]:
    again = recheck_scene(plan, rest, *_physics(job, plan, RELEASED), FINEST).settled
    return {
        "moved_mm": max(one.recheck_move_mm or 0.0 for one in again),
        "turned_deg": max(one.recheck_turn_deg or 0.0 for one in again),
    }


def context_for(context: WorkerContext, setting: Setting) -> WorkerContext:
    """The same worker with the setting's job. The settings' digest stays: nothing is stored under it."""
    return dataclasses.replace(context, job=apply(context.job, setting.changes))


# ---------------------------------------------------------------------------------------------- time


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
    pouring = pouring_of(context.job.start, SceneChance(context.job.seed, scene_id), plan)
    began = time.process_time()
    settle_scene(plan, context.job.physics, plan_effects(Facts(context.job, plan, raycast_checked=False)), pouring)
    return time.process_time() - began


def job_cost(laps: Laps, own: str) -> tuple[float, float]:
    """(milliseconds of processor, kilobytes) a scene of the job itself: medians over rounds, shapes new."""
    made = [[_own_s(lap, laps[0], scene, own) for scene, one in lap.items() if own in one["whole"]] for lap in laps]
    sizes = [answer["bytes"][own] for answer in laps[0].values() if own in answer["bytes"]]
    return median(fmean(times) for times in made if times) * 1e3, fmean(sizes) / 1e3


def _own_s(lap: Mapping[int, Mapping[str, Any]], first: Mapping[int, Mapping[str, Any]], scene: int, own: str) -> float:
    """Seconds of the job's own scene in this round, plus the cost of new shapes, which is measured once."""
    new = max(0.0, first[scene]["cold"] - first[scene]["whole"].get(own, first[scene]["cold"]))
    return float(lap[scene]["whole"][own]) + new


def timed_rows(settings: Sequence[Setting], laps: Laps) -> Iterator[tuple[Row, int]]:
    """(row without errors, scenes timed) of each setting that has a time; the first setting is the job itself.

    Over the scenes that a setting and the job made in a round. A setting that only settles is compared by settling: its
    difference to the job's own is added to the whole.
    """
    own = settings[0].name
    own_ms, own_kb = job_cost(laps, own)
    for setting in settings:
        name = setting.name
        ratios, scenes = [], set[int]()
        for lap in laps:
            more, base = 0.0, 0.0
            for scene, answer in lap.items():
                times = answer["whole" if name in answer["whole"] else "settling"]
                if name in times and own in times and own in answer["whole"]:
                    more += times[name] - times[own]
                    base += _own_s(lap, laps[0], scene, own)
                    scenes.add(scene)
            if base:
                ratios.append((base + more) / base)
        if ratios:
            ratio, sizes = Spread.of(ratios), [one["bytes"][name] for one in laps[0].values() if name in one["bytes"]]
            kilobytes = fmean(sizes) / 1e3 if sizes else own_kb
            yield (
                Row(setting, own_ms * ratio.median, ratio.median, ratio.least, ratio.most, kilobytes, {}, 0.0),
                len(scenes),
            )


# ---------------------------------------------------------------------------------------------- a setting over scenes


def figure_over_scenes(figures: Sequence[float]) -> Figure:
    """The 95th percentile of one figure a scene, of at least one."""
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


def _figure(count: int, measure: Callable[[NDArray[np.int64]], float], median: float | None = None) -> Figure:
    """The value over all scenes, with a bootstrap's interval; without a median the value is it."""
    rng = np.random.default_rng(0)
    samples = [measure(rng.integers(0, count, count, dtype=np.int64)) for _ in range(RESAMPLES)]
    low, high = np.percentile(samples, INTERVAL)
    value = measure(np.arange(count, dtype=np.int64))
    return Figure(value, float(low), float(high), value if median is None else median, count)


def settling_figures(name: str, scenes: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
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
