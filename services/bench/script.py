"""The script that we compare with (baseline.py): its looks, a scene as files for it, and its process.

The script says `{"ready": true}`, then reads one line of JSON for each scene (`scene`: the `scene.json` that `hand_over` wrote
beside its meshes; `out`: a folder; `look`) and answers with one line: `wall_s`, `cpu_s`, `stages_s` by stage, and `load_s`,
the seconds of reading files before its clock.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from schemas.environment import FOR_SPEED
from schemas.errors import MachineError
from schemas.job.job import Job
from schemas.scene.scene import Placed
from schemas.scene.shape import Mesh, Shape
from schemas.scene.view import Pair
from services.bench.figures import Lap
from workers.assets.glb import asset_glb
from workers.geometry.colour import SRGB_STEPS, decode_srgb, encode_srgb
from workers.scene.make_scene import Scene
from workers.scene.rows import image_boxes, object_labels
from workers.store.images import encode_png


@dataclass(frozen=True)
class Look:
    """A look of the script: its name in JSON and in the text, and what it makes."""

    name: str
    title: str
    makes: str
    only_raster: bool = False
    """Whether its images are comparable with those of the raster tier only."""


LOOKS = {
    "plain": Look(
        "script_plain",
        "the script, plain look",
        "same files; RGB with a floor of one colour, one light, no shadows",
    ),
    "same": Look(
        "script_same_look",
        "the script, same look",
        "same files; RGB with the floor's texture, the scene's lights and pyrender's shadows",
        only_raster=True,
    ),
}
"""By the word that the script is asked with."""


def looks_of(job: Job) -> dict[str, Look]:
    """The looks that are comparable with a job's images."""
    return {word: look for word, look in LOOKS.items() if job.render.tier == "raster" or not look.only_raster}


URDF = """<robot name="{name}"><link name="base">
<inertial><origin xyz="{com}"/><mass value="{mass}"/>
<inertia ixx="{i[0]}" iyy="{i[1]}" izz="{i[2]}" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="{name}.obj"/></geometry></collision>
</link></robot>
"""


def hand_over(scene: Scene, job: Job, folder: Path) -> Path:
    """Write `scene.json` and the files that it names, outside any clock. Returns its path."""
    folder.mkdir(parents=True)
    start, table = scene.plan.objects[0], scene.plan.table
    for name, asset in (("object", start.asset), ("table", table.asset)):
        (folder / f"{name}.glb").write_bytes(asset_glb(asset))
        (folder / f"{name}.obj").write_text(_obj(asset.shape.mesh))
        com = " ".join(f"{x:.9g}" for x in asset.mass.com)
        urdf = URDF.format(name=name, com=com, mass=asset.mass.mass_kg, i=np.diag(asset.mass.inertia).tolist())
        (folder / f"{name}.urdf").write_text(urdf)
    sensor, mass, lights = job.cameras.sensor, start.asset.mass, scene.posed.appearance.lights
    described = {
        "T_world_table": table.T_world_table.tolist(),
        "T_world_obj": start.T_world_obj.tolist(),
        # In the object's frame; the inertia is the principal moments.
        "object": {"mass_kg": mass.mass_kg, "com": mass.com.tolist(), "inertia": np.diag(mass.inertia).tolist()},
        "floor": _floor(scene.posed.things[0], folder),
        "lights": [{"towards": light.direction.tolist(), "color": list(light.color)} for light in lights],
        "intrinsics": {key: getattr(sensor, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "depth_units_per_m": job.images.depth_units_per_m,
        "pairs": [_pair(pair, job) for pair in scene.pairs],
    }
    path = folder / "scene.json"
    path.write_text(json.dumps(described))
    return path


def _pair(pair: Pair, job: Job) -> dict[str, object]:
    """Poses of the three cameras, and the path, view, kind of pixels and crop (or none) of every image."""
    cameras = {view.role: view.camera.T_world_cam.tolist() for view in pair.views if view.role != "projected"}
    images = []
    for view in pair.views:
        objects = object_labels(view, pair)
        for path, kind, box in image_boxes(view, objects, objects[0].category, job.images.patch):
            crop = None if box is None else [box[0].start, box[0].stop, box[1].start, box[1].stop]
            images.append({"path": path, "view": view.role, "pixels": kind, "crop": crop})
    return {"cameras": cameras, "images": images}


def _floor(placed: Placed, folder: Path) -> dict[str, object]:
    """The floor's geometry and mean colour, and its texture, if any, as `floor.png` with coordinates."""
    shape: Shape = placed.shape
    part = shape.parts[0]
    described: dict[str, object] = {
        "vertices": shape.vertices.tolist(),
        "faces": shape.faces.tolist(),
        "color": list(part.material.base_color),
        "roughness": part.material.roughness,
    }
    if part.material.texture is None or part.uv is None:
        return described
    tint = decode_srgb(np.array(part.material.base_color[:3]))
    picture = np.rint(255.0 * encode_srgb(SRGB_STEPS[part.material.texture[..., :3]] * tint)).astype(np.uint8)
    (folder / "floor.png").write_bytes(encode_png(np.ascontiguousarray(picture)))
    return described | {"uv": part.uv.tolist(), "color": [*(picture.mean(axis=(0, 1)) / 255.0).tolist(), 1.0]}


def _obj(mesh: Mesh) -> str:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    return "\n".join(lines) + "\n"


class ScriptProcess:
    """The running script. It inherits our core and our environment, and never shares our OpenGL context.

    Only what is set for our own speed (`FOR_SPEED`) it does not inherit: few people who write such scripts set it.
    """

    def __init__(self, process: subprocess.Popen[str], errors: IO[str]) -> None:
        self._process, self._errors = process, errors
        self.ask()  # its first answer, given before any question: it is ready

    def run(self, scenes: Sequence[Path], out: Path, look: str) -> Lap:
        """Makes these scenes in one of `LOOKS`, one after another, into one folder."""
        answers = [self.ask({"scene": str(scene), "out": str(out), "look": look}) for scene in scenes]
        wall, cpu, load = (sum(answer[key] for answer in answers) for key in ("wall_s", "cpu_s", "load_s"))
        names = dict.fromkeys(name for answer in answers for name in answer["stages_s"])
        stages = {name: sum(answer["stages_s"].get(name, 0.0) for answer in answers) for name in names}
        return Lap(len(scenes), wall, cpu, stages, load)

    def ask(self, question: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """The next answer. Raises MachineError with the process's last lines where it died."""
        assert self._process.stdin is not None and self._process.stdout is not None
        line = ""
        with contextlib.suppress(BrokenPipeError):
            if question is not None:
                print(json.dumps(question), file=self._process.stdin, flush=True)
            line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._errors.seek(0)
            last = " | ".join(self._errors.read().strip().splitlines()[-5:])
            raise MachineError(f"the script ended ({self._process.returncode}): {last}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextlib.contextmanager
def start_script() -> Iterator[ScriptProcess]:
    """The script after its first answer. Raises MachineError where it cannot run."""
    command, pipe = [sys.executable, "-W", "ignore", "-m", "services.bench.baseline"], subprocess.PIPE
    root = Path(__file__).resolve().parents[2]
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            command, cwd=root, env=_plain_environment(), stdin=pipe, stdout=pipe, stderr=errors, text=True
        )
        try:
            yield ScriptProcess(process, errors)
        finally:
            process.kill()
            process.communicate()


def _plain_environment() -> dict[str, str]:
    """This process's environment without what is set for our own speed."""
    inherited = os.environ  # noqa: TID251 - a child's environment is all of it
    return {name: value for name, value in inherited.items() if FOR_SPEED.get(name) != value}
