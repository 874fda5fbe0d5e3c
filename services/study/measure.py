"""What a study measures of one scene, or of one capture, with each setting: the processor's time, and how it comes to rest.

It runs in the pool's processes (workers/pool.py), each of which keeps the context of its job. What no code foresaw in a setting
is a counted answer, `broken`, and never the end of a study.
"""

import itertools
import math
import os
import pickle
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from statistics import fmean
from typing import Any, NoReturn

import numpy as np

from schemas.base import Array
from schemas.capture import SynthesizedView
from schemas.errors import SceneError
from schemas.job.job import settings_digest
from schemas.scene.scene import ObjectStart, Settled
from schemas.scene.view import Camera
from services.study.model import OWN, Setting, apply
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.make_capture import require_captures, simulate_one
from workers.capture.process import CaptureViews
from workers.capture.reconstruct import estimate_surface, given_files, processor_clock
from workers.capture.score import read_whole_truth, score_capture
from workers.geometry.camera import spread_evenly
from workers.geometry.frames import motion_between, transform
from workers.physics.settle import Rest
from workers.scene.context import WorkerContext
from workers.scene.make_scene import Laid, lay_scene, plan_with_effects
from workers.shard.run_shard import describe
from workers.stopwatch import Stopwatch

Answer = dict[str, Any]

DIGITS = 6
"""Decimals of an error that are kept: a nanometre, a millionth of a share. What is less is rounding."""

QUICK_S = {"rest": 2.0, "draw": 20.0}
"""By part: a process's first answer of a setting that takes less is measured once more, because the first compiles code and
shaders. What draws compiles for seconds on a busy machine; rest compiles before, and a second pile costs more than it tells."""

LIMIT = {"s": math.inf}
"""The seconds of processor that one answer of this process may take."""


class TimeOut(SceneError):
    """A scene that took many times as long as the job's own."""

    stage = "study"


def _out_of_time(*_: object) -> NoReturn:
    raise TimeOut("time_out", f"took more than {LIMIT['s']:.0f} s of processor")


def answer_for(measure: Callable[[], Answer]) -> Answer:
    """What `measure` answers, and the seconds by the clock that it `took`.

    A scene that cannot be made, or takes longer than the limit, is `failed` with its reason; anything else that it raises is
    also `broken`.
    """
    began = time.monotonic()
    try:
        if LIMIT["s"] < math.inf:
            signal.signal(signal.SIGPROF, _out_of_time)
            signal.setitimer(signal.ITIMER_PROF, LIMIT["s"])
        answer = measure()
        if "errors" in answer:
            answer["errors"] = {name: round(value, DIGITS) for name, value in answer["errors"].items()}
    except SceneError as error:
        answer = {"failed": error.reason}
    except Exception as error:  # one scene that breaks a measure must not end the study
        answer = {"failed": "broken", "broken": describe(error)}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return {**answer, "took": time.monotonic() - began}


_ran: set[tuple[str, str]] = set()
"""Parts and settings that this process has run."""


def warm_answer_for(part: str, setting: Setting, measure: Callable[[], Answer]) -> Answer:
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


_seen: set[int] = set()
"""Scenes whose shapes this process has built."""


def measure_rest(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, Answer]:
    """How the scene comes to rest, by the settings' names.

    `s` is the time to rest, and `planned_s` that of the plan before it. Errors: penetration_mm, gap_mm, unbalanced_share, slid_mm
    and rolled_deg (sideways travel of the centre of mass, and turn, since the object was released; the largest of several
    objects). Beside them `lost` and `planned` objects, and `corners`, mm, of each object's box in the world. The job itself has
    `plan_s`: what a scene takes besides rest with new shapes, which a process's first rest of a scene makes. That one is no
    setting's time, however slow it is: the shapes of a pile are a quarter of it.
    """
    answers: dict[str, Answer] = {}
    cold: Answer = {} if scene_id in _seen else answer_for(partial(_rest, context, scene_id, OWN))
    _seen.add(scene_id)
    for setting in settings:
        measure = partial(_rest, context_for(context, setting), scene_id, setting)
        answers[setting.name] = warm_answer_for("rest", setting, measure)
    own = answers.get(OWN.name, {})
    if "s" in own and "s" in cold:
        own["plan_s"] = cold["planned_s"] + max(0.0, cold["s"] - own["s"])
    return answers


def _rest(worker: WorkerContext, scene_id: int, setting: Setting) -> Answer:
    planning, watch = processor_clock(), processor_clock()
    plan, _ = plan_with_effects(worker, scene_id, planning)
    planned = len(plan.objects)
    try:
        rest = _settle(worker, scene_id, watch, is_kept=not setting.changes)
    except SceneError as error:
        return {"failed": error.reason, "lost": planned, "planned": planned}
    moves = list(zip(rest.starts, rest.settled, strict=True))
    return {
        "s": sum(s for stage, s in watch.seconds.items() if stage not in planning.seconds),
        "planned_s": sum(planning.seconds.values()),
        "errors": _errors_of(rest),
        "lost": planned - len(rest.settled),
        "planned": planned,
        "corners": [_corners_mm(*move).tolist() for move in moves],
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
    ends = np.stack([start.hull.vertices.min(axis=0), start.hull.vertices.max(axis=0)], axis=1)
    corners = np.array(list(itertools.product(*ends)))
    return np.round(1e3 * transform(end.T_world_obj, corners), DIGITS)


RESTS = {"folder": Path(os.devnull)}
"""Where the processes of a study keep how its slow scenes rest, for each other: a bin settles for half a minute, and is drawn in
a fifth of a second."""


@lru_cache(maxsize=2)
def own_rest(context: WorkerContext, scene_id: int) -> Rest:
    """How the job's own scene rests, kept for what is drawn of it. Raises SceneError."""
    if (file := _rest_file(context, scene_id)).exists():
        return pickle.loads(file.read_bytes())
    return _settle(context, scene_id, Stopwatch(), is_kept=True)


def _settle(context: WorkerContext, scene_id: int, watch: Stopwatch, is_kept: bool) -> Rest:
    """How a scene rests; what is slow is kept for other processes."""
    began, file = time.monotonic(), _rest_file(context, scene_id)
    rest = lay_scene(context, scene_id, watch).rest
    if is_kept and time.monotonic() - began >= QUICK_S["rest"] and RESTS["folder"].is_dir():
        fresh = file.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(pickle.dumps(rest))
        fresh.replace(file)
    return rest


def _rest_file(context: WorkerContext, scene_id: int) -> Path:
    """By the scene and its settings, because a recommendation is proved with its own; the context's digest is of the job's."""
    return RESTS["folder"] / f"rest-{scene_id}-{settings_digest(context.job, context.catalogue.digest)}"


def laid_for(context: WorkerContext, worker: WorkerContext, scene_id: int) -> Laid:
    """The scene at the job's own rest, as a setting that changes no physics would draw it. Raises SceneError."""
    rest = own_rest(context, scene_id)
    plan, effects = plan_with_effects(worker, scene_id, Stopwatch())
    return Laid(replace(plan, objects=rest.starts), effects, rest)


POINT_BYTES, VERTEX_BYTES, FACE_BYTES = 3 * 4 + 3 * 4 + 3, 3 * 4 + 3, 3 * 4
"""As a cloud and a mesh are written: float32 coordinates and normals, 8-bit colours, 32-bit indices."""

ERRORS_OF_SCORE = {
    "camera_mm": "pose_mm",
    "camera_deg": "pose_deg",
    "cloud_mm": "cloud_median_mm",
    "cloud_p95_mm": "cloud_p95_mm",
    "view_depth_mm": "depth_median_mm",
}
"""Names of the study's errors, and of the score's figures."""

HELD_OUT = 3
"""Views that are made of the others, for their depth and their time."""


def measure_capture(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, Answer]:
    """Time, bytes and errors by setting of a simulated capture, which is kept in the shared folder for all settings.

    Time is that of detection, estimates, cloud, mesh and as many synthesised views as there are photographs. A process works
    untimed first: that compiles its loops.
    """
    if not _seen:
        _seen.add(scene_id)
        answer_for(partial(_process, context, context, scene_id))
    workers = {setting.name: context_for(context, setting) for setting in settings}
    return {name: answer_for(partial(_process, context, worker, scene_id)) for name, worker in workers.items()}


def _simulated(context: WorkerContext, scale: float, scene_id: int) -> CaptureFolder:
    """The capture with the job's own number of views, and a scale of images; made once."""
    place = RESTS["folder"] / f"capture-{scene_id}-{scale:g}"
    if not place.exists():
        made = place.with_name(f"{place.name}-{os.getpid()}")
        simulate_one(context_for(context, Setting((), {"captures.simulate.image_scale": scale})), scene_id, made)
        with suppress(OSError):  # another process was faster, with the same bytes
            made.rename(place)
    return open_folder(place)


@dataclass(eq=False)
class TimedViews(CaptureViews):
    """Views that keep the seconds of processor that each synthesised one took."""

    seconds: list[float] = field(default_factory=list)

    def synthesize(self, camera: Camera, without: int | None = None) -> SynthesizedView:
        """As `CaptureViews.synthesize`."""
        began = time.process_time()
        made = super().synthesize(camera, without)
        self.seconds.append(time.process_time() - began)
        return made


def _process(context: WorkerContext, worker: WorkerContext, scene_id: int) -> Answer:
    watch, captures = processor_clock(), require_captures(worker.job)
    whole = _simulated(context, captures.simulate.image_scale, scene_id)
    chosen = spread_evenly(len(whole.numbers), captures.simulate.views)
    folder = replace(whole, numbers=tuple(whole.numbers[place] for place in chosen))
    with watch.stage("read"):
        given = given_files(folder, captures.estimation)
    estimates, merged = estimate_surface(given, captures, watch)
    truth, surface = read_whole_truth(folder), merged.surface
    assert truth is not None  # a simulated capture has it
    views = TimedViews(given, captures, estimates.estimate, surface, merged.body)
    score = score_capture(views, truth, HELD_OUT).summary
    mirrors_s = fmean(views.seconds) * len(estimates.estimate.used) if views.seconds else 0.0
    figures = {name: getattr(score, figure) for name, figure in ERRORS_OF_SCORE.items()}
    figures["missing_share"] = None if score.completeness is None else 1.0 - score.completeness
    points, vertices, faces = map(len, (surface.points, surface.vertices, surface.faces))
    return {
        "s": sum(watch.seconds.values()) + mirrors_s,
        "errors": {name: float(value) for name, value in figures.items() if value is not None},
        "bytes": points * POINT_BYTES + vertices * VERTEX_BYTES + faces * FACE_BYTES,
    }
