"""One scene with some settings, measured by a process of its own: the unit of a study's work."""

import json
import math
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from schemas.job.job import Job
from services.study.images import measure_colour, measure_drawn
from services.study.measure import LIMIT, RESTS, measure_capture, measure_rest
from services.study.model import OWN, Setting, apply
from workers.assets.catalogue import open_catalogue
from workers.scene.context import Stopwatch, WorkerContext, open_worker
from workers.shard.run_shard import run_scene


@dataclass(frozen=True)
class Unit:
    """One scene to measure with these settings on top of a base setting.

    `job`: as JSON, beside the folder that its paths are of; `scratch`: a folder that all processes share; `part`: of `PARTS` in
    services/study/table.py; `limit_s`: seconds of processor that one setting may take.
    """

    job: str
    folder: str
    scratch: str
    part: str
    scene_id: int
    settings: tuple[Setting, ...]
    base: Setting = OWN
    limit_s: float = math.inf


def answer_unit(unit: Unit) -> bytes:
    """Answers by the settings' names, as JSON."""
    context = _worker(unit.job, unit.folder, json.dumps(dict(unit.base.changes)))
    LIMIT["s"], RESTS["folder"] = unit.limit_s, Path(unit.scratch)
    measures = {"rest": measure_rest, "draw": measure_drawn, "colour": measure_colour, "capture": measure_capture}
    began = time.monotonic()
    # Another order in each scene, so that what a process does first is no setting's disadvantage.
    order = np.random.default_rng([unit.scene_id, len(unit.settings)]).permutation(len(unit.settings))
    answers = measures[unit.part](context, [unit.settings[place] for place in order], unit.scene_id)
    shared_s = (time.monotonic() - began - sum(answer["took"] for answer in answers.values())) / len(answers)
    for answer in answers.values():
        answer["took"] += shared_s  # what was made for all
    return json.dumps(answers).encode()


WARM_SCENES = (2_000_000, 2_000_001)
"""Scenes of one object that compile a process's loops and shaders; no study measures them."""


@cache
def _worker(job: str, folder: str, changes: str) -> WorkerContext:
    """The worker of the job, or the same one with a base setting's job: one object each, because caches know it."""
    if changes != "{}":
        own = _worker(job, folder, "{}")
        return replace(own, job=apply(own.job, json.loads(changes)))
    parsed = Job.model_validate_json(job)
    context = open_worker(parsed, open_catalogue(parsed.assets, Path(folder), tuple(parsed.categories)))
    if parsed.captures is None:
        few = replace(context, job=apply(parsed, {"objects_per_scene": 1}))
        for scene_id in WARM_SCENES:
            run_scene(few, scene_id, Stopwatch())
    return context
