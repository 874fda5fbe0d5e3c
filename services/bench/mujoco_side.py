"""The same scenes by MuJoCo: physics, and RGB, depth and segmentation of three views, in memory.

Run as a process of its own (see others.py) where the `mujoco` wheel is installed; it is in no lock file. Written as a user
of MuJoCo would: one model a scene, its renderer's defaults (four samples, one light and the head light, shadows).
"""

import importlib
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.answers import FLOOR, OBJECT, OPTICAL_TO_OPENGL, SECONDS, STEP_HZ, TABLE, answer_scenes

MODEL = """<mujoco>
<option timestep="{step_s}"/>
<visual><global offwidth="{width}" offheight="{height}"/><map znear="0.025" zfar="50"/></visual>
<statistic extent="2" center="0 0 0.5"/>
<asset><mesh name="table" file="table.obj"/><mesh name="object" file="object.obj"/></asset>
<worldbody>
<light directional="true" pos="-0.9 -1.5 3" dir="0.3 0.5 -1"/>
<geom name="floor" type="plane" size="30 30 1" rgba="{floor}"/>
<body name="table" {table_at}><geom name="table" type="mesh" mesh="table" rgba="0.6 0.45 0.3 1"/></body>
<body name="object" {object_at}><freejoint/>
<inertial pos="{com}" mass="{mass}" diaginertia="{inertia}"/>
<geom name="object" type="mesh" mesh="object" rgba="0.3 0.5 0.7 1"/></body>
{cameras}
</worldbody></mujoco>
"""

CAMERA = """<camera name="{name}" {at} resolution="{width} {height}" sensorsize="{width} {height}"
 focalpixel="{fx} {fy}" principalpixel="{px} {py}"/>"""


def describe(scene: Mapping[str, Any]) -> str:
    """The scene's MJCF: table and object as meshes (in contact their convex hulls), a plane, and every camera."""
    k, body = scene["intrinsics"], scene["object"]
    # MuJoCo counts the principal point from the image's middle, up and to the left.
    lens = {**k, "px": k["width"] / 2 - k["cx"], "py": k["cy"] - k["height"] / 2}
    cameras = [
        CAMERA.format(name=f"{role}{number}", at=_at(np.array(T) @ OPTICAL_TO_OPENGL), **lens)
        for number, pair in enumerate(scene["pairs"])
        for role, T in pair["cameras"].items()
    ]
    return MODEL.format(
        step_s=1.0 / STEP_HZ,
        width=k["width"],
        height=k["height"],
        floor=" ".join(map(str, scene["floor"]["color"])),
        table_at=_at(np.array(scene["T_world_table"])),
        object_at=_at(np.array(scene["T_world_obj"])),
        com=" ".join(map(str, body["com"])),
        mass=body["mass_kg"],
        inertia=" ".join(map(str, body["inertia"])),
        cameras="\n".join(cameras),
    )


def _at(T: NDArray[np.float64]) -> str:
    """A pose [4, 4] as MJCF's attributes."""
    axes = " ".join(f"{x:.9g}" for x in (*T[:3, 0], *T[:3, 1]))
    return f'pos="{T[0, 3]:.9g} {T[1, 3]:.9g} {T[2, 3]:.9g}" xyaxes="{axes}"'


Loaded = tuple[str, dict[str, bytes], tuple[int, int]]
"""A scene's MJCF, the files that it names, and the height and width of its images."""


class Simulator:
    """The state between scenes: the module, and the last scene's images by camera (`rgb`, `depth` in metres, `region`)."""

    def __init__(self) -> None:
        os.environ["MUJOCO_GL"] = "egl"  # noqa: TID251 - read at import, there is no other way to say it
        self._mujoco: Any = importlib.import_module("mujoco")
        self._images: dict[str, dict[str, NDArray]] = {}

    def load(self, scene: dict[str, Any], folder: Path, asked: dict[str, str]) -> Loaded:
        """What MuJoCo is given of a scene."""
        files = {name: (folder / name).read_bytes() for name in ("table.obj", "object.obj")}
        return describe(scene), files, (scene["intrinsics"]["height"], scene["intrinsics"]["width"])

    def make(self, loaded: Loaded, asked: dict[str, str]) -> dict[str, float]:
        """Make the images; seconds by stage."""
        (description, files, size), mujoco, marks = loaded, self._mujoco, [time.perf_counter()]
        model = mujoco.MjModel.from_xml_string(description, assets=files)
        data = mujoco.MjData(model)
        marks.append(time.perf_counter())
        for _ in range(round(STEP_HZ * SECONDS)):
            mujoco.mj_step(model, data)
        marks.append(time.perf_counter())
        with mujoco.Renderer(model, *size) as renderer:
            # By a geom's id, plus one for what is no geom.
            regions = np.zeros(model.ngeom + 1, np.uint8)
            for name, region in (("floor", FLOOR), ("table", TABLE), ("object", OBJECT)):
                regions[model.geom(name).id] = region
            self._images = {model.camera(i).name: self._look(renderer, data, i, regions) for i in range(model.ncam)}
        marks.append(time.perf_counter())
        return dict(zip(("scene", "physics", "render"), np.diff(marks).tolist(), strict=True))

    def keep(self, asked: dict[str, str]) -> None:
        """Write the images to the file that `keep` names, if any."""
        if asked.get("keep"):
            flat: dict[str, Any] = {f"{n}_{kind}": a for n, view in self._images.items() for kind, a in view.items()}
            np.savez(asked["keep"], **flat)

    def _look(self, renderer: Any, data: Any, camera: int, regions: NDArray[np.uint8]) -> dict[str, NDArray]:
        renderer.update_scene(data, camera=camera)
        rgb = renderer.render()
        renderer.enable_depth_rendering()
        depth = renderer.render()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        region = regions[renderer.render()[..., 0]]
        renderer.disable_segmentation_rendering()
        return {"rgb": rgb, "depth": depth, "region": region}


if __name__ == "__main__":
    simulator = Simulator()
    answer_scenes(simulator.load, simulator.make, simulator.keep)
