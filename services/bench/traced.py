"""`verso bench --pathtraced`: the path-traced tier and, where an interpreter has `bpy`, Blender's Cycles, in turn."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from schemas.errors import MachineError, RunError, SceneError
from schemas.job.job import Job
from schemas.job.render import Render
from services.bench.cycles import CyclesProcess, cycles_process, hand_over, trace_lap
from services.bench.machine import describe_machine, pinned
from services.bench.ratios import Lap, Spread, by_processor, slope_ratio
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import open_worker
from workers.pipeline.make_scene import Scene, make_scene
from workers.pipeline.stopwatch import Stopwatch
from workers.plan.effects import Facts, plan_effects
from workers.render.raster.gbuffer import shared_renderer
from workers.render.step import require_tier

SAMPLES = (16, 1)


def measure_traced(options: argparse.Namespace, job: Job, job_folder: Path, folder: Path) -> int:
    """Time both sides on the job's first scenes, three views each, and print milliseconds a view and the ratio.

    Raises InputError where Mitsuba is not installed.
    """
    require_tier(Render(tier="pathtraced"))
    with pinned() as core:
        scenes = first_scenes(job, job_folder, options.scenes)
        machine = describe_machine(shared_renderer().name)
        try:
            with cycles_process(options.pathtraced) as cycles:
                version, laps = (
                    cycles.version,
                    [measure_scene(s, folder / str(n), cycles) for n, s in enumerate(scenes)],
                )
        except MachineError as error:
            version = f"not measured: {error}"
            laps = [measure_scene(scene, folder, None) for scene in scenes]
    figures = {
        "ok": True,
        "machine": machine,
        "core": core,
        "scenes": len(scenes),
        "cycles": version,
        **summarise(laps),
    }
    print("\n".join(describe(figures)))
    if options.json:
        print(json.dumps(figures))
    return 0


def first_scenes(job: Job, job_folder: Path, count: int) -> list[Scene]:
    """The first scenes that can be made, posed and with their cameras. Raises RunError for none."""
    job = job.model_copy(update={"render": Render(tier="raster")})
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories))
    context = open_worker(job, catalogue)
    made, reason = [], ""
    for scene_id in range(job.first_scene, job.first_scene + count):
        try:
            made.append(make_scene(context, scene_id, Stopwatch()))
        except SceneError as error:
            reason = str(error)
    if not made:
        raise RunError(f"none of the first {count} scenes could be made: {reason}")
    return made


def measure_scene(scene: Scene, folder: Path, cycles: CyclesProcess | None) -> dict[str, Lap]:
    """Laps over the scene's three rendered views by side and samples, such as `ours 16`, including building the scene."""
    pair = scene.pairs[0]
    cameras = [view.camera for view in pair.views if view.role != "projected"]
    laps = {}
    handed = None if cycles is None else hand_over(scene.posed, cameras, Render(), folder)
    for samples in SAMPLES:
        render = Render(tier="pathtraced", path_samples=samples)
        effects = plan_effects(Facts(Job(name="bench", render=render), scene.plan, False))
        laps[f"ours {samples}"] = trace_lap(scene.posed, cameras, render, effects)
        if cycles is not None and handed is not None:
            laps[f"cycles {samples}"] = cycles.lap(handed, len(cameras), samples)
    return laps


def summarise(laps: list[dict[str, Lap]]) -> dict[str, Any]:
    """Milliseconds of processor a view, and our views for each view of Cycles, over scenes."""
    sides = {name: [lap[name] for lap in laps] for name in laps[0]}
    ms = {name: asdict(Spread.of([1e3 * by_processor(lap) for lap in own])) for name, own in sides.items()}
    both = [n for n in SAMPLES if f"cycles {n}" in sides]
    ratio = {str(n): asdict(slope_ratio(sides[f"cycles {n}"], sides[f"ours {n}"], by_processor)) for n in both}
    return {"cpu_ms_per_view": ms, "ratio_cpu": ratio}


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    machine = figures["machine"]
    lines = [
        f"machine    {machine['cpu']}, load {machine['load_1min']:.1f}",
        f"command    verso {' '.join(sys.argv[1:])}",
        f"measured   {figures['scenes']} scenes of 3 views, each side in turn on core {figures['core']}, one thread each",
        f"Cycles     {figures['cycles']}",
        "",
    ]
    for name, ms in figures["cpu_ms_per_view"].items():
        side, samples = name.split()
        who = "path-traced tier (Mitsuba)" if side == "ours" else "Blender Cycles"
        lines.append(
            f"{who:28} {samples:>2} samples {ms['median']:8.0f} ms a view [{ms['least']:.0f} to {ms['most']:.0f}] of processor"
        )
    for samples, ratio in figures["ratio_cpu"].items():
        spread = f"{ratio['median']:.2f} [{ratio['least']:.2f} to {ratio['most']:.2f}]"
        lines.append(f"at {samples:>2} samples: {spread} views while Cycles makes one")
    return lines
