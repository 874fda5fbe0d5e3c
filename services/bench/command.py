"""`verso bench`: measures, and prints the figures as text and JSON."""

import argparse
import json
import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from schemas.errors import InputError
from schemas.job.job import Job
from schemas.job.start import ONE_OBJECT
from services.bench.effects import measure_effects
from services.bench.extra import require_extra
from services.bench.measure import bench_folder, measure
from services.bench.memory import measure_memory
from services.bench.others import other_systems
from services.bench.report import describe, summarise
from services.bench.traced import measure_traced
from services.job.read import change_key, load_job, validate_job
from workers.store.file_system import file_system_of


def main(options: argparse.Namespace) -> int:
    """Measure what the options ask for and print it; returns 0. Raises VersoError where a side cannot run."""
    require_extra("bench")
    job, job_folder = _job(options)
    if options.effects is not None:
        return measure_effects(options, job, job_folder)
    refuse_unmatched(job)
    with bench_folder(options.folder) as folder:
        if options.pathtraced is not None:
            return measure_traced(options, job, job_folder, folder)
        rounds = summarise(measure(job, job_folder, folder, options.scenes))
        memory = options.memory and asdict(measure_memory(job, job_folder, folder / "memory", options.memory))
        scaling = None
        if options.workers is not None:
            from services.bench.scaling import measure_scaling  # loads Ray, which would count as our start-up

            scaling = asdict(measure_scaling(job, job_folder, folder, options.workers, options.scaling_scenes))
        figures = {
            "ok": True,
            "command": shlex.join(["verso", *sys.argv[1:]]),
            "job": job.name,
            "file_system": file_system_of(folder),
            **rounds,
            "memory": memory,
            "scaling": scaling,
            "other_systems": other_systems(),
        }
        # Printed before the folder is deleted, which takes a while on a busy disk.
        print("\n".join(describe(figures)), flush=True)
    if options.json:
        print(json.dumps(figures))
    return 0


def _job(options: argparse.Namespace) -> tuple[Job, Path]:
    """The job to measure, and the folder that its relative paths start from."""
    if options.job is None:
        tree: dict[str, Any] = {"name": "bench"}
        for change in options.changes:
            change_key(tree, change)
        job, folder = validate_job(tree, "the default job"), Path()
    else:
        job, folder = load_job(options.job, options.changes), options.job.parent
    return job, folder


def refuse_unmatched(job: Job) -> None:
    """Raises InputError for a job whose scenes the script does not make, or that is stored in tars."""
    if job.output.layout != "files":
        raise InputError(f"output.layout is {job.output.layout!r}: the benchmark compares files, leave it at 'files'")
    if job.objects_per_scene != ONE_OBJECT:
        raise InputError("objects_per_scene is not 1: the benchmark compares scenes of one object, leave it at 1")
    switches = {
        "cameras.depth.enabled": job.cameras.depth.enabled,
        "cameras.mirror.enabled": job.cameras.mirror.enabled,
        "images.projection.enabled": job.images.projection.enabled,
        "render.rgb": job.render.rgb,
    }
    if off := [name for name, on in switches.items() if not on]:
        raise InputError(f"{', '.join(off)} is off: the benchmark compares whole pairs, leave it on")
