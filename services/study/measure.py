"""Measures one scene with settings, each in turn: how it comes to rest, what is drawn of it, and the processor's time of both.

It runs in the pool's processes (workers/pool.py), each of which keeps the context of its job. What no code foresaw in a setting
is a counted answer, `broken`, and never the end of a study.
"""

import itertools
import json
import math
import os
import pickle
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
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
from workers.assets.catalogue import open_catalogue
from workers.geometry.frames import motion_between, transform
from workers.physics.fall import FINEST
from workers.physics.settle import Rest, recheck_scene
from workers.scene.context import Stopwatch, WorkerContext, open_worker
from workers.scene.effects import Facts, plan_effects
from workers.scene.make_scene import Laid, lay_scene, plan_with_effects
from workers.shard.run_shard import describe, run_scene

# ---------------------------------------------------------------------------------------------- a process of the pool


@dataclass(frozen=True)
class Unit:
    """One scene to measure with these settings on top of a base setting.

    `job`: the job as JSON, beside the folder that its paths are of; `scratch`: a folder that all processes share; `part`: one of
    services/study/knobs.py; `number`: the scene's place among the measured ones; `limit_s`: seconds of processor
    that one setting may take.
    """

    job: str
    folder: str
    scratch: str
    part: str
    scene_id: int
    number: int
    settings: tuple[Setting, ...]
    base: Setting = OWN
    limit_s: float = math.inf


def answer_unit(unit: Unit) -> bytes:
    """Answers by the settings' names, as JSON. The parts are imported here: captures load what scenes have no use for."""
    context = _based(unit.job, unit.folder, json.dumps(dict(unit.base.changes)))
    LIMIT["s"], RESTS["folder"] = unit.limit_s, Path(unit.scratch)
    if unit.part == "capture":
        from services.study.captures import measure_capture

        measure: Callable[..., dict[str, Answer]] = partial(measure_capture, scratch=Path(unit.scratch))
    else:
        from services.study.images import measure_colour, measure_drawn

        measure = {
            "rest": measure_rest,
            "again": measure_again,
            "draw": measure_drawn,
            "colour": measure_colour,
        }[unit.part]
    return json.dumps(measure(context, unit.settings, unit.scene_id, unit.number)).encode()


@cache
def _opened(job: str, folder: str) -> WorkerContext:
    """The worker of the job itself, after scenes of one object that compile its loops and shaders."""
    parsed = Job.model_validate_json(job)
    context = open_worker(parsed, open_catalogue(parsed.assets, Path(folder), tuple(parsed.categories)))
    if parsed.captures is None:
        few = replace(context, job=apply(parsed, {"objects_per_scene": 1}))
        for number in range(WARM_SCENES):
            run_scene(few, WARM_SCENE + number, Stopwatch())
    return context


@cache
def _based(job: str, folder: str, changes: str) -> WorkerContext:
    """The job's worker, with a base setting's job: one object each, because caches know it."""
    own, based = _opened(job, folder), json.loads(changes)
    return replace(own, job=apply(own.job, based)) if based else own


WARM_SCENES, WARM_SCENE = 2, 2_000_000
"""How many scenes warm a process up, and the id of the first, which no study measures."""

# ---------------------------------------------------------------------------------------------- one answer

Answer = dict[str, Any]

DIGITS = 6
"""Decimals of an error that are kept: a nanometre, a millionth of a share. What is less is rounding."""

SLEPT_S = 1.0
"""Times of what the machine slept in for longer are thrown away."""

QUICK_S = {"rest": 2.0, "draw": 20.0}
"""By part: a process's first answer of a setting that takes less is measured once more, because the first compiles code and
shaders. What draws compiles for seconds on a busy machine; rest compiles before, and a second pile costs more than it tells."""

LIMIT = {"s": math.inf}
"""The seconds of processor that one answer of this process may take."""


class Meter:
    """Within `with`, measures: `s` seconds of processor, None where the machine slept in between; `took` seconds by the clock."""

    s: float | None = None
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


def _out_of_time(*_: object) -> NoReturn:
    raise TimeOut("time_out", f"took more than {LIMIT['s']:.0f} s of processor")


def answer_for(measure: Callable[[Meter], Answer]) -> Answer:
    """What `measure` answers, with its times: it gets a meter for what counts as the setting's time, the clock runs for all.

    A scene that cannot be made, or takes longer than the limit, is `failed` with its reason; anything else that it raises is
    also `broken`.
    """
    meter = Meter()
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
    return replace(context, job=apply(context.job, setting.changes))


def shuffled(settings: Sequence[Setting], scene_id: int) -> list[Setting]:
    """Another order in each scene, so that what a process does first is no setting's disadvantage."""
    return [settings[k] for k in np.random.default_rng([scene_id, len(settings)]).permutation(len(settings))]


# ---------------------------------------------------------------------------------------------- how a scene comes to rest

POSED = 48
"""Scenes of which poses are kept, the first ones."""

_seen: set[int] = set()
"""Scenes whose shapes this process has built."""


def measure_rest(context: WorkerContext, settings: Sequence[Setting], scene_id: int, number: int) -> dict[str, Answer]:
    """How the scene comes to rest, by the settings' names. `number`: its place among the measured scenes.

    `s` is the time to rest, without the plan. Errors: penetration_mm, gap_mm, unbalanced_share, slid_mm and rolled_deg
    (sideways travel of the centre of mass, and turn, since the object was released; the largest of several objects). Beside
    them `lost`, `planned` and `redrawn` objects, `corners`, mm, of each object's box in the world, and `planned_s`, the time
    of a plan whose shapes are there. The job itself also has `plan_s`, that of its plan with new shapes: a process's first
    rest of a scene makes them, and is the job's answer only where it is too slow to be done again.
    """
    answers: dict[str, Answer] = {}
    new_s = cold_s = None
    if scene_id not in _seen:
        _seen.add(scene_id)
        with Meter() as planning, suppress(Exception):  # told by what is measured
            plan_with_effects(context, scene_id, Stopwatch())
        new_s = planning.s
        if not _rest_file(context, scene_id).exists():
            cold = answer_for(partial(_rest, context, scene_id, number, OWN))
            if cold["took"] < QUICK_S["rest"]:
                cold_s = cold["s"]
            elif OWN in settings:
                answers[OWN.name] = cold
    for setting in shuffled([one for one in settings if one.name not in answers], scene_id):
        measure = partial(_rest, context_for(context, setting), scene_id, number, setting)
        answers[setting.name] = warm_answer_for("rest", setting, measure)
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
            rest = lay_scene(worker, scene_id, Stopwatch()).rest
    except SceneError as error:
        return {"failed": error.reason, "lost": planned, "planned": planned, "redrawn": 0}
    finally:
        if meter.s is not None and planning.s is not None:
            meter.s -= planning.s
    if setting == OWN:
        _keep_rest(worker, scene_id, rest, meter.took)
    moves = list(zip(rest.starts, rest.settled, strict=True))
    return {
        "planned_s": planning.s,
        "errors": _errors_of(rest),
        "lost": planned - len(rest.settled),
        "planned": planned,
        "redrawn": max(0, sum(start.redraws for start in rest.starts) - before),
        **({"corners": [_corners_mm(*move).tolist() for move in moves]} if number < POSED else {}),
    }


def _errors_of(rest: Rest) -> dict[str, float]:
    slid, rolled = [], []
    for start, end in zip(rest.starts, rest.settled, strict=True):
        before, after = (transform(T, start.asset.mass.com[None])[0, :2] for T in (start.T_world_obj, end.T_world_obj))
        slid.append(float(np.linalg.norm(after - before)) * 1e3)
        rolled.append(math.degrees(motion_between(start.hull.vertices, start.T_world_obj, end.T_world_obj)[1]))
    return {
        "penetration_mm": max(end.penetration_mm for end in rest.settled),
        "gap_mm": max(end.hover_gap_mm for end in rest.settled),
        "unbalanced_share": max(end.equilibrium_residual for end in rest.settled),
        "slid_mm": max(slid),
        "rolled_deg": max(rolled),
    }


def _corners_mm(start: ObjectStart, end: Settled) -> Array:
    """[8, 3] the corners of the object's own box in the world, mm, to a nanometre."""
    low, high = start.hull.vertices.min(axis=0), start.hull.vertices.max(axis=0)
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    return np.round(1e3 * transform(end.T_world_obj, corners), DIGITS)


RELEASED = {"step_hz": 960, "max_step_travel_mm": 0.05, "solver_iterations": 400}
"""Settings of physics, in steps 16 times shorter, with which objects at rest are released again."""


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


# ---------------------------------------------------------------------------------------------- the job's own rest

RESTS = {"folder": Path(os.devnull)}
"""Where the processes of a study keep how its slow scenes rest, for each other: a bin settles for half a minute, and is drawn in
a fifth of a second."""


@lru_cache(maxsize=2)
def own_rest(context: WorkerContext, scene_id: int) -> Rest:
    """How the job's own scene rests, kept for what is drawn of it. Raises SceneError."""
    if (file := _rest_file(context, scene_id)).exists():
        return pickle.loads(file.read_bytes())
    with Meter() as meter:
        rest = lay_scene(context, scene_id, Stopwatch()).rest
    _keep_rest(context, scene_id, rest, meter.took)
    return rest


def _keep_rest(context: WorkerContext, scene_id: int, rest: Rest, took: float) -> None:
    if took >= QUICK_S["rest"] and RESTS["folder"].is_dir():
        file = _rest_file(context, scene_id)
        fresh = file.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(pickle.dumps(rest))
        fresh.replace(file)


def _rest_file(context: WorkerContext, scene_id: int) -> Path:
    """By the scene and its settings, because a recommendation is proved with its own; the context's digest is of the job's."""
    return RESTS["folder"] / f"rest-{scene_id}-{settings_digest(context.job, context.catalogue.digest)}"


def laid_for(context: WorkerContext, worker: WorkerContext, scene_id: int) -> Laid:
    """The scene at the job's own rest, as a setting that changes no physics would draw it. Raises SceneError."""
    rest = own_rest(context, scene_id)
    plan, effects = plan_with_effects(worker, scene_id, Stopwatch())
    return Laid(replace(plan, objects=rest.starts), effects, rest)
