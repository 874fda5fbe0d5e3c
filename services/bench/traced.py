"""`verso bench --pathtraced`: the path-traced tier and, where an interpreter has `bpy`, Blender's Cycles, in turn.

Both get the same meshes, materials, lights, cameras and samples.
"""

import json
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from schemas.base import Array
from schemas.dataset.commit import Span
from schemas.errors import MachineError
from schemas.job.job import Job
from schemas.job.views import Render
from schemas.scene.scene import PosedScene
from schemas.scene.shape import Part
from schemas.scene.view import Camera
from services.bench.machine import describe_machine, pinned
from services.bench.others import SideProcess, start_side
from services.bench.ratios import Lap, Spread, by_processor, format_spread, slope_ratio
from services.bench.report import describe_head
from services.bench.stages import make_in_memory
from workers.assets.catalogue import open_catalogue
from workers.geometry.colour import decode_srgb
from workers.geometry.frames import transform
from workers.render.pathtraced import GLOW, SKY_PX, Tracer, encode_light, sky_directions, sky_picture, tint_of
from workers.render.raster.baking import LAMP_RAD
from workers.render.raster.gbuffer import shared_renderer
from workers.render.tiers import require_tier
from workers.scene.context import open_worker
from workers.scene.effects import Facts, plan_effects
from workers.scene.make_scene import Scene

SAMPLES = (16, 1)


def measure_traced(job: Job, job_folder: Path, folder: Path, count: int, python: str) -> dict[str, Any]:
    """Time both sides on the job's first scenes, three views each; `python` runs Blender's script.

    Raises InputError where Mitsuba is not installed.
    """
    require_tier(Render(tier="pathtraced"))
    with pinned() as core:
        job = job.model_copy(update={"render": Render(tier="raster")})
        context = open_worker(job, open_catalogue(job.assets, job_folder, tuple(job.categories)))
        scenes = make_in_memory(context, Span(start=job.first_scene, stop=job.first_scene + count))
        machine = describe_machine(shared_renderer().name)
        try:
            with start_cycles(python) as cycles:
                version: str = cycles.greeting["version"]
                laps = [measure_scene(scene, folder / str(number), cycles) for number, scene in enumerate(scenes)]
        except MachineError as error:
            version = f"not measured: {error}"
            laps = [measure_scene(scene, folder, None) for scene in scenes]
    return {"machine": machine, "core": core, "scenes": len(scenes), "cycles": version, **summarise(laps)}


def start_cycles(python: str) -> AbstractContextManager[SideProcess]:
    """Blender's script on our core, whose greeting has a `version`. Raises MachineError where `python` has no bpy."""
    return start_side("Blender's script", [python, "-I", str(Path(__file__).with_name("cycles_script.py"))])


def measure_scene(scene: Scene, folder: Path, cycles: SideProcess | None) -> dict[str, Lap]:
    """Laps over the scene's three rendered views by side and samples, such as `ours 16`, including building the scene."""
    cameras = [view.camera for view in scene.pairs[0].views if view.role != "projected"]
    laps = {}
    handed = None if cycles is None else hand_over(scene.posed, cameras, Render(), folder)
    for samples in SAMPLES:
        render = Render(tier="pathtraced", path_samples=samples)
        effects = plan_effects(Facts(Job(name="bench", render=render), scene.plan, False))
        tracer = Tracer()
        wall, cpu = time.perf_counter(), time.process_time()
        for camera in cameras:
            encode_light(tracer.radiance(scene.posed.things, scene.posed.appearance, camera, render, effects, 0))
        laps[f"ours {samples}"] = Lap(len(cameras), time.perf_counter() - wall, time.process_time() - cpu, {})
        if cycles is not None:
            took = cycles.ask({"scene": str(handed), "samples": samples})
            laps[f"cycles {samples}"] = Lap(len(cameras), took["wall_s"], took["cpu_s"], {})
    return laps


def hand_over(posed: PosedScene, cameras: Sequence[Camera], render: Render, folder: Path) -> Path:
    """Write the scene for Blender's script, outside any clock. Returns the path of its description."""
    folder.mkdir(parents=True)
    placed = [(part, thing.T_world_shape) for thing in posed.things for part in thing.shape.parts]
    for number, (part, T_world_shape) in enumerate(placed):
        np.savez(folder / f"{number}.npz", **_arrays(part, T_world_shape))
    # The sky in Blender's projection: the same columns as ours, and centred rows.
    directions = sky_directions((np.arange(SKY_PX[1]) + 0.5) / SKY_PX[1])
    np.save(folder / "sky.npy", sky_picture(posed.appearance, directions).astype(np.float32))
    described = {
        "parts": [_part(part) | {"arrays": f"{number}.npz"} for number, (part, _) in enumerate(placed)],
        "suns": [
            {
                "angle_rad": LAMP_RAD,
                "irradiance": [np.pi * (1.0 - GLOW) * c for c in light.color],
                # A lamp shines along its -z.
                "T_world_light": trimesh.geometry.align_vectors([0.0, 0.0, 1.0], light.direction).tolist(),
            }
            for light in posed.appearance.lights[:1]
        ],
        "sky": "sky.npy",
        "intrinsics": cameras[0].intrinsics.model_dump(),
        "cameras": [camera.T_world_cam.tolist() for camera in cameras],
        "bounces": render.path_bounces,
    }
    path = folder / "scene.json"
    path.write_text(json.dumps(described))
    return path


def _arrays(part: Part, T_world_shape: Array) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "vertices": transform(T_world_shape, part.vertices).astype(np.float32),
        "faces": part.faces.astype(np.int32),
    }
    if part.normals is not None:
        arrays["normals"] = part.normals @ T_world_shape[:3, :3].T
    if part.uv is not None:
        arrays["uv"] = part.uv.astype(np.float32)
        if part.material.texture is not None:
            arrays["texture"] = part.material.texture[..., :3]
        if part.material.transmission_map is not None:
            arrays["opaque"] = 1.0 - part.material.transmission_map.astype(np.float32) / 255.0
    return arrays


def _part(part: Part) -> dict[str, Any]:
    material = part.material
    color = decode_srgb(np.array(material.base_color[:3]))
    tint = tint_of(part).tolist() if material.transmission > 0.0 else None
    look = {"color": color.tolist(), "tint": tint, "metallic": material.metallic, "roughness": material.roughness}
    return {"name": part.name, **look}


def summarise(laps: list[dict[str, Lap]]) -> dict[str, Any]:
    """Milliseconds of processor a view, and our views for each view of Cycles, over scenes."""
    sides = {name: [lap[name] for lap in laps] for name in laps[0]}
    ms = {name: asdict(Spread.of([1e3 * by_processor(lap) for lap in own])) for name, own in sides.items()}
    both = [n for n in SAMPLES if f"cycles {n}" in sides]
    ratio = {str(n): asdict(slope_ratio(sides[f"cycles {n}"], sides[f"ours {n}"], by_processor)) for n in both}
    return {"cpu_ms_per_view": ms, "ratio_cpu": ratio}


def describe(figures: dict[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    lines = [
        *describe_head(figures),
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
        lines.append(f"at {samples:>2} samples: {format_spread(ratio)} views while Cycles makes one")
    return lines
