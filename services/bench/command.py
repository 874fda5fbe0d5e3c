"""`verso bench`: measures, and prints the figures as text and JSON."""

import argparse
import json
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from schemas.errors import InputError
from schemas.job.job import Job
from schemas.job.physics import ONE_OBJECT
from services.bench.figures import by_processor, slope_ratio, summarise_side
from services.bench.measure import Measured, bench_folder, measure
from services.bench.script import LOOKS
from services.job.job_file import change_key, load_job, validate_job
from workers.store.file_system import file_system_of


def main(options: argparse.Namespace) -> int:
    """Measure what the options ask for and print it. Raises VersoError if a side cannot run."""
    if options.job is None:
        tree: dict[str, Any] = {"name": "bench"}
        for change in options.changes:
            change_key(tree, change)
        job, job_folder = validate_job(tree, "the default job"), Path()
    else:
        job, job_folder = load_job(options.job, options.changes), options.job.parent
    refuse_unmatched(job)
    with bench_folder(options.folder) as folder:
        figures = {
            "ok": True,
            "command": shlex.join(["verso", *sys.argv[1:]]),
            "job": job.name,
            "file_system": file_system_of(folder),
            **summarise(measure(job, job_folder, folder, options.scenes)),
            "scaling": None,
        }
        if options.workers is not None:
            from services.bench.scaling import measure_scaling  # loads Ray

            figures["scaling"] = measure_scaling(job, job_folder, folder, options.workers, options.scaling_scenes)
        # Printed before the folder is deleted, which takes a while on a busy disk.
        print("\n".join(describe(figures)), flush=True)
        if options.json:
            print(json.dumps(figures), flush=True)
    return 0


def refuse_unmatched(job: Job) -> None:
    """Raises InputError for a job whose scenes the script does not make, or that is stored in tars."""
    fits = {
        "output.layout: files": job.output.layout == "files",
        "objects_per_scene: 1": job.objects_per_scene == ONE_OBJECT,
        "cameras.depth.enabled: true": job.cameras.depth.enabled,
        "cameras.mirror.enabled: true": job.cameras.mirror.enabled,
        "images.projection.enabled: true": job.images.projection.enabled,
        "render.rgb: true": job.render.rgb,
    }
    if missing := [setting for setting, holds in fits.items() if not holds]:
        raise InputError(f"the benchmark compares whole pairs of one object in files: set {', '.join(missing)}")


# ---------------------------------------------------------------------------------------------- the report


def summarise(measured: Measured) -> dict[str, Any]:
    """The figures of the rounds: plain numbers, milliseconds per scene, ratios of slopes.

    A ratio of a look of the script is how many times as many scenes we make in the same time.
    """
    ours, floor = measured.ours, measured.floor
    scenes = sum(lap.scenes for lap in ours)
    return {
        "machine": measured.machine,
        "core": measured.core,
        "scenes": scenes,
        "rounds": len(ours),
        "bytes_per_scene": measured.bytes / scenes,
        "ours": summarise_side(ours),
        "floor": summarise_side(floor),
        "times_floor": slope_ratio(ours, floor),
        "times_floor_cpu": slope_ratio(ours, floor, by_processor),
        "script": {
            look: summarise_side(laps)
            | {"ratio": slope_ratio(laps, ours), "ratio_cpu": slope_ratio(laps, ours, by_processor)}
            for look, laps in measured.script.items()
        },
    }


def describe(figures: Mapping[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    machine, script = figures["machine"], figures["script"]
    lines = [
        f"machine    {machine['usable_cores']} of {machine['cores']} cores, {machine['cpu']}, load {machine['load_1min']:.1f}",
        f"           {machine['gl_renderer']}",
        f"           Python {machine['python']}, " + ", ".join(f"{k} {v}" for k, v in machine["versions"].items()),
        f"command    {figures['command']}",
        f"measured   {figures['scenes']} scenes in {figures['rounds']} rounds, each side in turn on core "
        f"{figures['core']}, a commit a round, {figures['bytes_per_scene'] / 1e3:.0f} kB a scene on {figures['file_system']}",
        "",
        *_table("ours", figures["ours"]),
        *_table("floor: bare passes, the same encoding, durable writes", figures["floor"]),
        f"  before its clock each scene's shapes go to the GPU: {figures['floor']['apart_ms']:.1f} ms a scene",
    ]
    for look, side in script.items():
        lines += _table(f"the script, look {look}: {LOOKS[look]}", side)
        lines.append(f"  before its clock it reads its files: {side['apart_ms']:.1f} ms a scene")
    lines += ["", f"{'as many scenes as':24} {'by the clock':24} by processor time"]
    lines += [f"  {'the script, ' + k:22} {_times(v['ratio']):24} {_times(v['ratio_cpu'])}" for k, v in script.items()]
    lines.append(
        f"{'times the lower bound':24} {_times(figures['times_floor']):24} {_times(figures['times_floor_cpu'])}"
    )
    return lines + (_describe_scaling(figures["scaling"]) if figures["scaling"] else [])


def _table(title: str, side: Mapping[str, Any]) -> list[str]:
    total, means = side["ms_per_scene"], side["stages_mean_ms"]
    stages = sorted(side["stages_ms"].items(), key=lambda stage: (stage[0] == "rest", -stage[1]))
    return [
        title,
        f"  {total:.1f} ms a scene, {1e3 / total:.2f} scenes/s ({side['cpu_ms_per_scene']:.1f} ms of processor)",
        *(f"    {name:22} {ms:8.2f} ms {ms / total:6.1%}, mean {means[name]:.2f} ms" for name, ms in stages),
    ]


def _times(spread: Mapping[str, float], form: str = ".2f", unit: str = " x") -> str:
    """The median, and in brackets the minimum and the maximum."""
    return f"{spread['median']:{form}}{unit} [{spread['least']:{form}} to {spread['most']:{form}}]"


def _describe_scaling(scaling: Mapping[str, Any]) -> list[str]:
    shares = (_times(scaling[name], ".1%", "") for name in ("ray_share_one", "ray_share"))
    return [
        "",
        f"{scaling['workers']} at once against one     {'as many scenes':24} {'processor for a scene':24} scenes/s",
        *(
            f"  {name:22} {_times(gain['speedup']):24} {_times(gain['inflation']):24} "
            f"{gain['one_scenes_per_s']:.2f} and {gain['all_scenes_per_s']:.2f}, {gain['scenes']} scenes"
            for name, gain in (("through Ray", scaling["ray"]), ("plain processes", scaling["bare"]))
        ),
        f"  Ray gives {scaling['share_of_bare']:.1%} of what plain processes gain",
        f"  Ray's share of time    {next(shares)} with one worker, {next(shares)} with {scaling['workers']}, "
        f"their uneven end included; ranges of {scaling['range']}",
    ]
