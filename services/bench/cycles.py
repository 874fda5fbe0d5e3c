"""The path-traced tier beside Blender's Cycles: the same meshes, materials, lights, cameras and samples, in turn."""

import contextlib
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import Array
from schemas.job.render import Render
from schemas.scene.camera import Camera
from schemas.scene.effects import EffectPlan
from schemas.scene.scene import PosedScene
from schemas.scene.shape import Part
from services.bench.ratios import Lap
from services.bench.side_process import SideProcess, start_side
from workers.geometry.frames import transform
from workers.geometry.srgb import decode_srgb
from workers.render.pathtraced.lights import GLOW, SKY_PX, sky_directions, sky_picture
from workers.render.pathtraced.materials import tint_of
from workers.render.pathtraced.tracer import Tracer, encode_light
from workers.render.raster.baking import LAMP_RAD

SCRIPT = Path(__file__).with_name("cycles_script.py")


def hand_over(posed: PosedScene, cameras: Sequence[Camera], render: Render, folder: Path) -> Path:
    """Write the scene for the script, outside any clock. Returns the path of its description."""
    folder.mkdir(parents=True)
    parts: list[dict[str, Any]] = []
    for thing in posed.things:
        for part in thing.shape.parts:
            name = f"{len(parts)}.npz"
            np.savez(folder / name, **_arrays(part, thing.T_world_shape))
            parts.append(_part(part, name))
    np.save(folder / "sky.npy", _blenders_sky(posed))
    keys = posed.appearance.lights[:1]
    described = {
        "parts": parts,
        "suns": [
            {
                "angle_rad": LAMP_RAD,
                "irradiance": [np.pi * (1.0 - GLOW) * c for c in light.color],
                "T_world_light": _facing(light.direction).tolist(),
            }
            for light in keys
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


def _part(part: Part, arrays: str) -> dict[str, Any]:
    material = part.material
    color = decode_srgb(np.array(material.base_color[:3]))
    tint = tint_of(part).tolist() if material.transmission > 0.0 else None
    look = {"color": color.tolist(), "tint": tint, "metallic": material.metallic, "roughness": material.roughness}
    return {"name": part.name, "arrays": arrays, **look}


def _blenders_sky(posed: PosedScene) -> Array:
    """The sky in Blender's projection: the same columns as ours, and centred rows."""
    directions = sky_directions((np.arange(SKY_PX[1]) + 0.5) / SKY_PX[1])
    return np.asarray(sky_picture(posed.appearance, directions).astype(np.float32))


def _facing(towards: Array) -> Array:
    """[4, 4]: a lamp that shines along its -z, from the direction `towards`."""
    x = np.cross([0.0, 1.0, 0.0] if abs(towards[1]) < 0.9 else [1.0, 0.0, 0.0], towards)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(towards, x), towards], axis=1)
    return T


def trace_lap(posed: PosedScene, cameras: Sequence[Camera], render: Render, effects: EffectPlan) -> Lap:
    """Our side: builds the scene anew and traces every view."""
    tracer = Tracer()
    wall, cpu = time.perf_counter(), time.process_time()
    for camera in cameras:
        encode_light(tracer.radiance(posed.things, posed.appearance, camera, render, effects, 0))
    return Lap(len(cameras), time.perf_counter() - wall, time.process_time() - cpu, {})


class CyclesProcess:
    """A running script under an interpreter that has bpy; it inherits our core."""

    def __init__(self, side: SideProcess) -> None:
        self._side = side
        self.version: str = side.greeting["version"]

    def lap(self, scene: Path, views: int, samples: int, out: Path | None = None) -> Lap:
        """Every view of a scene with these samples, building it included; `out`: where its images are left."""
        question = {"scene": str(scene), "samples": [samples], "out": None if out is None else str(out)}
        wall_s, cpu_s = self._side.ask(question)["seconds"][str(samples)]
        return Lap(views, wall_s, cpu_s, {})


@contextlib.contextmanager
def cycles_process(python: str = sys.executable) -> Iterator[CyclesProcess]:
    """The script, ready for its first scene. Raises MachineError where that interpreter has no bpy that loads."""
    with start_side([python, "-I", str(SCRIPT)], "Blender's script") as side:
        yield CyclesProcess(side)
