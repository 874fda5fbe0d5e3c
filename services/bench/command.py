"""`verso bench`: measures, and prints the figures as text and JSON; and the packages that it and `verso tradeoff` need."""

import argparse
import json
import shlex
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from schemas.errors import InputError, MachineError
from schemas.job.job import Job
from schemas.job.physics import ONE_OBJECT
from services.bench import effects, report
from services.bench.measure import bench_folder, measure
from services.bench.scaling import measure_memory
from services.job.job_file import change_key, load_job, validate_job
from workers.store.file_system import file_system_of

PACKAGES = {"flip_evaluator": "flip-evaluator", "isal": "isal", "matplotlib": "matplotlib"}
"""Names on the index by the names that are imported."""


def require_extra(command: str) -> None:
    """Raises MachineError, with the remedy, where a package of the extra is not installed."""
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise MachineError(
            f"`verso {command}` needs {', '.join(missing)}: `./verso extra study` installs what is missing in a checkout; "
            "elsewhere use `pip install --require-hashes -r requirements-study.lock`"
        )


def main(options: argparse.Namespace) -> int:
    """Measure what the options ask for and print it; returns 0. Raises VersoError where a side cannot run."""
    require_extra("bench")
    if options.job is None:
        tree: dict[str, Any] = {"name": "bench"}
        for change in options.changes:
            change_key(tree, change)
        job, job_folder = validate_job(tree, "the default job"), Path()
    else:
        job, job_folder = load_job(options.job, options.changes), options.job.parent
    if options.effects is not None:
        return _print(options, job, effects.measure_effects(job, job_folder, options.effects), effects.describe)
    refuse_unmatched(job)
    with bench_folder(options.folder) as folder:
        if options.nodes is not None:
            from services.bench import simulated  # loads Ray

            laps = simulated.measure_simulated(job, folder, options.nodes, simulated.SHARD_S)
            return _print(options, job, {"simulated": laps}, simulated.describe)
        # Printed before the folder is deleted, which takes a while on a busy disk.
        return _print(options, job, _measure_all(options, job, job_folder, folder), report.describe)


def _measure_all(options: argparse.Namespace, job: Job, job_folder: Path, folder: Path) -> dict[str, Any]:
    rounds = report.summarise(measure(job, job_folder, folder, options.scenes))
    memory = options.memory and measure_memory(job, job_folder, folder / "memory", options.memory)
    scaling = None
    if options.workers is not None:
        from services.bench.scaling import measure_scaling  # loads Ray, which would count as our start-up

        scaling = measure_scaling(job, job_folder, folder, options.workers, options.scaling_scenes)
    return {"file_system": file_system_of(folder), **rounds, "memory": memory, "scaling": scaling}


def _print(
    options: argparse.Namespace, job: Job, found: dict[str, Any], describe: Callable[[dict[str, Any]], list[str]]
) -> int:
    """The figures as text and, where asked for, as one line of JSON; returns 0."""
    figures = {"ok": True, "command": shlex.join(["verso", *sys.argv[1:]]), "job": job.name, **found}
    print("\n".join(describe(figures)), flush=True)
    if options.json:
        print(json.dumps(figures))
    return 0


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
