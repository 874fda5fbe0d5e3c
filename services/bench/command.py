"""`verso bench`: measures, and prints the figures as text and JSON; and the packages that it and `verso tradeoff` need."""

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from statistics import mean, median
from typing import Any

from schemas.errors import InputError, MachineError
from schemas.job.job import Job
from schemas.job.physics import ONE_OBJECT
from services.bench import effects
from services.bench.figures import Lap, by_clock, by_processor, format_spread, slope_ratio, stage_table, with_loading
from services.bench.measure import Look, Measured, bench_folder, measure, measure_memory
from services.job.job_file import change_key, load_job, validate_job
from workers.store.file_system import file_system_of

PACKAGES = {"flip_evaluator": "flip-evaluator", "isal": "isal", "matplotlib": "matplotlib"}
"""Names on the index by the names that are imported."""

SCENES = 80
"""Scenes that each side makes unless told."""


def require_extra(command: str) -> None:
    """Raises MachineError, with the remedy, where a package of the extra is not installed."""
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise MachineError(
            f"`verso {command}` needs {', '.join(missing)}: `./verso extra study` installs what is missing in a checkout; "
            "elsewhere use `pip install --require-hashes -r requirements-study.lock`"
        )


def main(options: argparse.Namespace) -> int:
    """Measure what the options ask for and print it; 1 where captures miss their bar. Raises VersoError if a side cannot run."""
    require_extra("bench")
    if options.job == Path("captures"):
        return _compare_captures(options)
    if options.job is None:
        job, job_folder = _own_job({"name": "bench"}, options.changes), Path()
    else:
        job, job_folder = load_job(options.job, options.changes), options.job.parent
    if options.effects is not None:
        return _print(options, job, effects.measure_effects(job, job_folder, options.effects), effects.describe)
    if options.targets is not None:
        timed = effects.measure_targets(job, job_folder, options.targets)
        return _print(options, job, timed, effects.describe_targets)
    refuse_unmatched(job)
    with bench_folder(options.folder) as folder:
        if options.nodes is not None:
            from services.bench import scaling  # loads Ray

            laps = scaling.measure_simulated(job, folder, options.nodes, scaling.SHARD_S)
            return _print(options, job, {"simulated": laps}, scaling.describe)
        # Printed before the folder is deleted, which takes a while on a busy disk.
        return _print(options, job, _measure_all(options, job, job_folder, folder), describe)


def _own_job(tree: dict[str, Any], changes: Sequence[str]) -> Job:
    for change in changes:
        change_key(tree, change)
    return validate_job(tree, "the default job")


def _compare_captures(options: argparse.Namespace) -> int:
    from services.bench import captures  # loads what processes them

    job = _own_job(captures.job_tree(), options.changes)
    with bench_folder(options.folder) as folder:
        found = captures.measure_captures(job, folder, options.scenes or captures.COUNT)
        return _print(options, job, found, captures.describe)


def _measure_all(options: argparse.Namespace, job: Job, job_folder: Path, folder: Path) -> dict[str, Any]:
    rounds = summarise(measure(job, job_folder, folder, options.scenes or SCENES))
    memory = options.memory and measure_memory(job, job_folder, folder / "memory", options.memory)
    scaling = None
    if options.workers is not None:
        from services.bench.scaling import measure_scaling  # loads Ray, which would count as our start-up

        scaling = measure_scaling(job, job_folder, folder, options.workers, options.scaling_scenes)
    return {"file_system": file_system_of(folder), **rounds, "memory": memory, "scaling": scaling}


def _print(
    options: argparse.Namespace, job: Job, found: dict[str, Any], describe: Callable[[dict[str, Any]], list[str]]
) -> int:
    """The figures as text and, where asked for, as one line of JSON; returns 0, or 1 where they are not `ok`."""
    figures = {"ok": True, "command": shlex.join(["verso", *sys.argv[1:]]), "job": job.name, **found}
    print("\n".join(describe(figures)), flush=True)
    if options.json:
        print(json.dumps(figures))
    return 0 if figures["ok"] else 1


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


# ---------------------------------------------------------------------------------------------- the report


def summarise(measured: Measured) -> dict[str, Any]:
    """The figures of the rounds: plain numbers, milliseconds per scene, ratios of slopes."""
    laps = measured.laps
    ours, bound = laps["ours"], laps["floor"]
    scenes = sum(lap.scenes for lap in ours)
    return {
        "machine": measured.machine,
        "core": measured.core,
        "scenes": scenes,
        "rounds": len(ours),
        "bytes_per_scene": measured.bytes / scenes,
        "startup_s": measured.startup_s,
        "ours": _side(ours),
        "floor": _side(bound) | {"encoders": measured.encoders, "upload_ms": _apart(bound)},
        "times_floor": asdict(slope_ratio(ours, bound)),
        "times_floor_cpu": asdict(slope_ratio(ours, bound, by_processor)),
        "others": {look.name: _other(look, laps[look.name], ours) for look in measured.looks.values()},
    }


def _other(look: Look, laps: Sequence[Lap], ours: Sequence[Lap]) -> dict[str, Any]:
    """A look of the script; a ratio is how many times as many scenes we make in the same time."""
    return _side(laps) | {
        "title": look.title,
        "makes": look.makes,
        "load_ms": _apart(laps),
        "ratio": asdict(slope_ratio(laps, ours)),
        "ratio_cpu": asdict(slope_ratio(laps, ours, by_processor)),
        "ratio_with_loading": asdict(slope_ratio(laps, ours, with_loading)),
    }


def _apart(laps: Sequence[Lap]) -> float:
    return median(lap.apart_s / lap.scenes for lap in laps) * 1e3


def _side(laps: Sequence[Lap]) -> dict[str, Any]:
    return {
        "ms_per_scene": median(map(by_clock, laps)) * 1e3,
        "cpu_ms_per_scene": median(map(by_processor, laps)) * 1e3,
        "stages_ms": stage_table(laps),
        "stages_mean_ms": stage_table(laps, mean),
    }


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    machine = figures["machine"]
    others, floor = figures["others"].values(), figures["floor"]
    threads = machine["threads_per_core"]
    lines = [
        f"machine    {machine['usable_cores']} of {machine['cores']} cores"
        + (f" ({threads} thread{'s' * (threads > 1)} each)" if threads else "")
        + f", {machine['cpu']}, load {machine['load_1min']:.1f}",
        f"           {machine['gl_renderer']}",
        f"           Python {machine['python']}, " + ", ".join(f"{k} {v}" for k, v in machine["versions"].items()),
        f"command    {figures['command']}",
        f"measured   {figures['scenes']} scenes in {figures['rounds']} rounds, each side in turn on core "
        f"{figures['core']}, a commit a round, {figures['bytes_per_scene'] / 1e3:.0f} kB a scene on {figures['file_system']}",
        "start-up   "
        + ", ".join(f"{name} {s:.1f} s" for name, s in figures["startup_s"].items())
        + ", the first scenes included; not counted below",
        "",
        *_table("ours", figures["ours"]),
        *_table("floor: bare passes, fastest encoder, durable writes", floor),
        f"  before its clock each scene's shapes go to the GPU: {floor['upload_ms']:.1f} ms a scene",
        f"  encoders: {', '.join(f'{kind} {name}' for kind, name in floor['encoders'].items())}",
    ]
    for other in others:
        lines += _table(f"{other['title']} ({other['makes']})", other)
        lines.append(f"  before its clock it reads its files: {other['load_ms']:.1f} ms a scene")
    lines += ["", f"{'as many scenes as':24} {'by the clock':24} {'by processor time':24} its reading counted"]
    lines += [
        f"  {other['title']:22} {_times(other['ratio']):24} {_times(other['ratio_cpu']):24} "
        f"{_times(other['ratio_with_loading'])}"
        for other in others
    ]
    lines += [f"{'times the lower bound':24} {_times(figures['times_floor']):24} {_times(figures['times_floor_cpu'])}"]
    lines += _describe_memory(figures["memory"]) if figures["memory"] else []
    lines += _describe_scaling(figures["scaling"]) if figures["scaling"] else []
    return lines


def _table(what: str, side: dict[str, Any]) -> list[str]:
    total = side["ms_per_scene"]
    cost = f"{total:.1f} ms a scene, {1e3 / total:.2f} scenes/s ({side['cpu_ms_per_scene']:.1f} ms of processor)"
    stages = sorted(side["stages_ms"].items(), key=lambda stage: (stage[0] == "rest", -stage[1]))
    means = side["stages_mean_ms"]
    return [
        what,
        f"  {cost}",
        *(f"    {name:22} {ms:8.2f} ms {ms / total:6.1%}, mean {means[name]:.2f} ms" for name, ms in stages),
    ]


def _times(spread: dict[str, float]) -> str:
    return format_spread(spread, unit=" x")


def _describe_memory(memory: dict[str, Any]) -> list[str]:
    settled, scenes = memory["settled_after"], memory["scenes"]
    return [
        "",
        f"one worker over {scenes} scenes",
        f"  memory                 {memory['settled_mb']:.0f} MB after {settled}, {memory['last_mb']:.0f} MB at the end: "
        f"{memory['grown']:+.1%}; at most {memory['peak_mb']:.0f} MB",
        f"  processor for a scene  {memory['first_ms']:.1f} ms in the first {settled}, {memory['last_ms']:.1f} ms in the "
        f"last: {memory['last_to_first']:.3f} times",
    ]


def _describe_scaling(scaling: dict[str, Any]) -> list[str]:
    return [
        "",
        f"{scaling['workers']} at once against one     {'as many scenes':24} {'processor for a scene':24} scenes/s",
        *(
            f"  {name:22} {_times(gain['speedup']):24} {_times(gain['inflation']):24} "
            f"{gain['one_scenes_per_s']:.2f} and {gain['all_scenes_per_s']:.2f}, {gain['scenes']} scenes"
            for name, gain in (("through Ray", scaling["ray"]), ("plain processes", scaling["bare"]))
        ),
        f"  {'empty loops':22} {_times(scaling['loops'])}",
        f"  Ray gives {scaling['share_of_bare']:.1%} of what plain processes gain",
        f"  Ray's share of time    {format_spread(scaling['ray_share_one'], '.1%')} with one worker, "
        f"{format_spread(scaling['ray_share'], '.1%')} with {scaling['workers']}, their uneven end included; "
        f"ranges of {scaling['range']}",
    ]
