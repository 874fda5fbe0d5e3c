"""Measures one scene with settings, each in turn: how it comes to rest, what is drawn of it, and the processor's time of both.

What no code foresaw in a setting is a counted answer, `broken`, and never the end of a study. At the end of the file: how
errors fall with the step where the truth is a formula.
"""

import contextlib
import dataclasses
import itertools
import math
import os
import pickle
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from schemas.base import Array
from schemas.errors import SceneError
from schemas.job.identity import settings_digest
from schemas.job.job import Job
from schemas.scene.scene import ObjectStart, Settled
from services.study.knobs import apply
from services.study.model import OWN, Setting
from workers.geometry.frames import motion_between, transform
from workers.physics.bullet import GRAVITY_M_S2, World, open_world
from workers.physics.fall import FINEST
from workers.physics.rigid_body import Body
from workers.physics.settle import Rest, recheck_scene
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.effects import Facts, plan_effects
from workers.scene.make_scene import Laid, lay_scene, plan_with_effects
from workers.shard.run_shard import describe, run_scene

RELEASED = {"step_hz": 960, "max_step_travel_mm": 0.05, "solver_iterations": 400}
"""Settings of physics, in steps 16 times shorter, with which objects at rest are released again."""

POSED = 48
"""Scenes of which poses are kept, the first ones."""

QUICK_S = {"rest": 2.0, "draw": 20.0}
"""By part: a process's first answer of a setting that takes less is measured once more, because the first compiles code and
shaders. What draws compiles for seconds on a busy machine; rest compiles before, and a second pile costs more than it tells."""

RESTS: dict[str, Path | None] = {"folder": None}
"""Where the processes of a study keep how its slow scenes rest, for each other; None keeps nothing."""

DIGITS = 6
"""Decimals of an error that are kept: a nanometre, a millionth of a share. What is less is rounding."""

SLEPT_S = 1.0
"""Times of what the machine slept in for longer are thrown away."""

Answer = dict[str, Any]

_seen: set[int] = set()
"""Scenes whose shapes this process has built."""


class Meter:
    """Within `with`, measures: `s` seconds of processor, None where the machine slept in between; `took` seconds by the clock."""

    s: float | None
    took: float

    def __enter__(self) -> "Meter":
        self._began = time.process_time(), time.monotonic(), time.clock_gettime(time.CLOCK_BOOTTIME)
        return self

    def __exit__(self, *_: object) -> None:
        cpu, clock, wall = self._began
        self.took = time.monotonic() - clock
        slept = time.clock_gettime(time.CLOCK_BOOTTIME) - wall - self.took > SLEPT_S
        self.s = None if slept else time.process_time() - cpu


class TimeOut(SceneError):
    """A scene that took many times as long as the job's own."""

    stage = "study"


LIMIT = {"s": math.inf}
"""The seconds of processor that one answer of this process may take."""


def _out_of_time(*_: object) -> NoReturn:
    raise TimeOut("time_out", f"took more than {LIMIT['s']:.0f} s of processor")


def answer_for(measure: Callable[[Meter], Answer]) -> Answer:
    """What `measure` found, with its times: it gets a meter for what counts as the setting's time, the clock runs for all.

    A scene that cannot be made, or takes longer than the limit, is `failed` with its reason; anything else that it raises is
    also `broken`.
    """
    meter = Meter()
    meter.s = None
    with Meter() as whole:
        try:
            if LIMIT["s"] < math.inf:
                signal.signal(signal.SIGPROF, _out_of_time)
                signal.setitimer(signal.ITIMER_PROF, LIMIT["s"])
            answer = measure(meter)
            if "errors" in answer:
                answer["errors"] = {name: round(value, DIGITS) for name, value in answer["errors"].items()}
        except SceneError as error:
            answer = {"failed": error.reason}
        except Exception as error:  # one scene that breaks a measure must not end the study
            answer = {"failed": "broken", "broken": describe(error)}
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    return {**answer, "s": meter.s, "took": whole.took}


_ran: set[tuple[str, str]] = set()
"""Parts and settings that this process has run."""


def warm_answer_for(part: str, setting: Setting, measure: Callable[[Meter], Answer]) -> Answer:
    """`answer_for`, twice where it is this process's first of the setting and quick (`QUICK_S`)."""
    answer = answer_for(measure)
    if (part, setting.name) not in _ran:
        _ran.add((part, setting.name))
        if answer["took"] < QUICK_S[part]:
            return answer_for(measure)
    return answer


def context_for(context: WorkerContext, setting: Setting) -> WorkerContext:
    """The same worker with the setting's job. The settings' digest stays: nothing is stored under it."""
    return dataclasses.replace(context, job=apply(context.job, setting.changes))


def measure_rest(
    context: WorkerContext,
    settings: Sequence[Setting],
    scene_id: int,
    number: int,
) -> dict[str, Answer]:
    """How the scene comes to rest, by the settings' names. `number`: its place among the measured scenes.

    `s` is the time to rest, without the plan. Errors: penetration_mm, gap_mm, unbalanced_share, slid_mm and rolled_deg
    (sideways travel of the centre of mass, and turn, since the object was released; the largest of several objects). Beside
    them `lost`, `planned` and `redrawn` objects, `corners`, mm, of each object's box in the world, and `planned_s`, the time
    of a plan whose shapes are there. The job itself also has `plan_s`, that of its plan with new shapes.
    """
    new_s: float | None = None
    cold_s: float | None = None
    answers: dict[str, Answer] = {}
    if scene_id not in _seen:
        _seen.add(scene_id)
        with Meter() as planning, contextlib.suppress(Exception):  # told by what is measured
            plan_with_effects(context, scene_id, Stopwatch())
        new_s = planning.s
        if _kept_rest(context, scene_id) is None:
            cold = answer_for(partial(_rest, context, scene_id, number, OWN))
            if cold["took"] < QUICK_S["rest"]:
                cold_s = cold["s"]
            elif OWN in settings:
                answers[OWN.name] = cold
    order = np.random.default_rng([scene_id, len(settings)]).permutation(len(settings))
    for setting in (settings[k] for k in order):
        if setting.name not in answers:
            worker = context_for(context, setting)
            answers[setting.name] = warm_answer_for("rest", setting, partial(_rest, worker, scene_id, number, setting))
    own = answers.get(OWN.name)
    if own is not None and new_s is not None:
        own["plan_s"] = new_s + max(0.0, (cold_s or 0.0) - (own.get("planned_s") or 0.0) - (own["s"] or 0.0))
    return answers


def _rest(worker: WorkerContext, scene_id: int, number: int, setting: Setting, meter: Meter) -> Answer:
    with Meter() as planning:
        plan, _ = plan_with_effects(worker, scene_id, Stopwatch())
    planned, before = len(plan.objects), sum(start.redraws for start in plan.objects)
    try:
        with meter:
            laid = lay_scene(worker, scene_id, Stopwatch())
    except SceneError as error:
        return {"failed": error.reason, "lost": planned, "planned": planned, "redrawn": 0}
    finally:
        if meter.s is not None and planning.s is not None:
            meter.s -= planning.s
    rest = laid.rest
    if setting == OWN:
        _keep_rest(worker, scene_id, rest, meter.took)
    answer: Answer = {
        "planned_s": planning.s,
        "errors": _errors_of(rest),
        "lost": planned - len(rest.settled),
        "planned": planned,
        "redrawn": max(0, sum(start.redraws for start in rest.starts) - before),
    }
    if number < POSED:
        answer["corners"] = [
            _corners_mm(start, end).tolist() for start, end in zip(rest.starts, rest.settled, strict=True)
        ]
    return answer


def _errors_of(rest: Rest) -> dict[str, float]:
    slid, rolled = [], []
    for start, end in zip(rest.starts, rest.settled, strict=True):
        before, after = (transform(T, start.asset.mass.com[None])[0, :2] for T in (start.T_world_obj, end.T_world_obj))
        slid.append(float(np.linalg.norm(after - before)) * 1e3)
        rolled.append(math.degrees(motion_between(start.hull.vertices, start.T_world_obj, end.T_world_obj)[1]))
    return {
        "penetration_mm": max(one.penetration_mm for one in rest.settled),
        "gap_mm": max(one.hover_gap_mm for one in rest.settled),
        "unbalanced_share": max(one.equilibrium_residual for one in rest.settled),
        "slid_mm": max(slid),
        "rolled_deg": max(rolled),
    }


def _corners_mm(start: ObjectStart, end: Settled) -> Array:
    """[8, 3] the corners of the object's own box in the world, mm, to a nanometre."""
    low, high = start.hull.vertices.min(axis=0), start.hull.vertices.max(axis=0)
    return np.round(
        1e3 * transform(end.T_world_obj, np.array(list(itertools.product(*zip(low, high, strict=True))))), DIGITS
    )


def measure_again(context: WorkerContext, settings: Sequence[Setting], scene_id: int, number: int) -> dict[str, Answer]:
    """How far objects at rest move when they are let go again in the finest steps: moved_mm and turned_deg."""
    return {one.name: answer_for(partial(_again, context_for(context, one), scene_id)) for one in settings}


def _again(worker: WorkerContext, scene_id: int, meter: Meter) -> Answer:
    laid = lay_scene(worker, scene_id, Stopwatch())
    physics = worker.job.physics.model_copy(update=RELEASED)
    effects = plan_effects(Facts(worker.job.model_copy(update={"physics": physics}), laid.plan, raycast_checked=False))
    again = recheck_scene(laid.plan, laid.rest, physics, effects, FINEST).settled
    moved, turned = ([getattr(one, name) or 0.0 for one in again] for name in ("recheck_move_mm", "recheck_turn_deg"))
    return {"errors": {"moved_mm": max(moved), "turned_deg": max(turned)}}


@lru_cache(maxsize=2)
def own_rest(context: WorkerContext, scene_id: int) -> Rest:
    """How the job's own scene rests, kept for what is drawn of it. Raises SceneError."""
    if (file := _kept_rest(context, scene_id)) is not None:
        return pickle.loads(file.read_bytes())
    with Meter() as meter:
        rest = lay_scene(context, scene_id, Stopwatch()).rest
    _keep_rest(context, scene_id, rest, meter.took)
    return rest


def _keep_rest(context: WorkerContext, scene_id: int, rest: Rest, took: float) -> None:
    """Keeps how a slow scene rests for all processes: a bin settles for half a minute, and is drawn in a fifth of a second."""
    if took >= QUICK_S["rest"] and (file := _rest_file(context, scene_id)) is not None:
        fresh = file.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(pickle.dumps(rest))
        fresh.replace(file)


def _kept_rest(context: WorkerContext, scene_id: int) -> Path | None:
    file = _rest_file(context, scene_id)
    return file if file is not None and file.exists() else None


def _rest_file(context: WorkerContext, scene_id: int) -> Path | None:
    """By the scene and its settings, because a recommendation is proved with its own; the context's digest is of the job's."""
    folder = RESTS["folder"]
    return folder and folder / f"rest-{scene_id}-{settings_digest(context.job, context.catalogue.digest)}"


def laid_for(context: WorkerContext, worker: WorkerContext, scene_id: int) -> Laid:
    """The scene at the job's own rest, as a setting that changes no physics would draw it. Raises SceneError."""
    rest = own_rest(context, scene_id)
    plan, effects = plan_with_effects(worker, scene_id, Stopwatch())
    return Laid(replace(plan, objects=rest.starts), effects, rest)


WARM_SCENES, WARM_SCENE = 2, 2_000_000
"""How many scenes warm a process up, and the id of the first, which no study measures."""


def warm_up(context: WorkerContext) -> None:
    """Makes scenes of one object, untimed: the first run compiles code and shaders."""
    few = dataclasses.replace(context, job=apply(context.job, {"objects_per_scene": 1}))
    for number in range(WARM_SCENES):
        run_scene(few, WARM_SCENE + number, Stopwatch())


# ---------------------------------------------------------------------------------------------- where the truth is a formula

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
