"""`verso bench`: measures, prints, and answers in JSON."""

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
from services.bench.others import other_systems
from services.bench.report import describe, summarise
from services.bench.traced import measure_traced
from services.job.read import load_job, set_key, validate_job
from workers.store.mounts import file_system_of


def main(options: argparse.Namespace) -> int:
    """Measure what the options ask for; 0, or an error where a side cannot be run at all."""
    require_extra("bench")
    job, job_folder = _job(options)
    if options.effects is not None:
        return measure_effects(options, job, job_folder)
    refuse_unmatched(job)
    with bench_folder(options.folder) as folder:
        if options.pathtraced is not None:
            return measure_traced(options, job, job_folder, folder)
        figures = {
            "ok": True,
            "command": shlex.join(["verso", *sys.argv[1:]]),
            "job": job.name,
            "file_system": file_system_of(folder),
            **summarise(measure(job, job_folder, folder, options.scenes)),
            "memory": _memory(options, job, job_folder, folder),
            "scaling": _scaling(options, job, job_folder, folder),
            "other_systems": other_systems(),
        }
        # Before the folder goes: thousands of files take a while where the disk is busy.
        print("\n".join(describe(figures)), flush=True)
    if options.json:
        print(json.dumps(figures))
    return 0


def _job(options: argparse.Namespace) -> tuple[Job, Path]:
    """The job to measure, and where its relative folders are resolved from."""
    if options.job is None:
        tree: dict[str, Any] = {"name": "bench"}
        for change in options.changes:
            set_key(tree, change)
        job, folder = validate_job(tree, "the default job"), Path()
    else:
        job, folder = load_job(options.job, options.changes), options.job.parent
    return job, folder


def refuse_unmatched(job: Job) -> None:
    """Raises InputError for a job whose scenes the straightforward script does not make, or that is stored in tars."""
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


def _memory(options: argparse.Namespace, job: Job, job_folder: Path, folder: Path) -> dict[str, Any] | None:
    if options.memory is None:
        return None
    from services.bench.memory import measure_memory

    return asdict(measure_memory(job, job_folder, folder / "memory", options.memory))


def _scaling(options: argparse.Namespace, job: Job, job_folder: Path, folder: Path) -> dict[str, Any] | None:
    if options.workers is None:
        return None
    from services.bench.scaling import measure_scaling

    return asdict(measure_scaling(job, job_folder, folder, options.workers, options.scaling_scenes))
