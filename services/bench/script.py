"""The script that people write today (baseline.py), as a process that is handed the same scenes.

It reads one line of JSON for each scene (`scene`: the `scene.json` that `hand_over` wrote beside its meshes; `out`: a
folder; `look`) and answers with one line: `wall_s`, `cpu_s`, `stages_s` by stage, and `load_s`, of reading files before.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import IO, Any

import numpy as np
import trimesh

from schemas.dataset.layout import view_name
from schemas.environment import FOR_SPEED
from schemas.errors import MachineError
from schemas.job.job import Job
from schemas.scene.view import Pair, View
from services.bench.figures import Lap
from workers.assets.glb import asset_glb, mesh_of_part
from workers.scene.make_scene import Scene
from workers.scene.rows import image_boxes, object_labels

LOOKS = {
    "plain": "a floor of one colour, one light, no shadows",
    "same": "the floor's texture, the scene's lights, pyrender's shadows",
}
"""What the script makes by the word that it is asked with."""


URDF = """<robot name="{name}"><link name="base">
<inertial><origin xyz="{com}"/><mass value="{mass}"/>
<inertia ixx="{i[0]}" iyy="{i[1]}" izz="{i[2]}" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="{name}.obj"/></geometry></collision>
</link></robot>
"""


def hand_over(scene: Scene, job: Job, parent: Path) -> Path:
    """Write `scene.json` and the files that belong to it into a new folder, outside any clock. Returns its path."""
    folder = parent / str(scene.plan.scene_id)
    folder.mkdir(parents=True)
    start, ground = scene.plan.objects[0], scene.plan.ground
    assets = {"object": start.asset} | ({} if ground is None else {"table": ground.table.asset})
    for name, asset in assets.items():
        (folder / f"{name}.glb").write_bytes(asset_glb(asset))
        mesh = trimesh.Trimesh(asset.shape.mesh.vertices, asset.shape.mesh.faces, process=False)
        mesh.export(folder / f"{name}.obj", include_normals=False)
        com = " ".join(f"{x:.9g}" for x in asset.mass.com)
        urdf = URDF.format(name=name, com=com, mass=asset.mass.mass_kg, i=np.diag(asset.mass.inertia).tolist())
        (folder / f"{name}.urdf").write_text(urdf)
    if ground is not None:
        mesh_of_part(ground.floor.parts[0]).export(folder / "floor.glb")
    sensor, lights = scene.plan.input_cameras[0].intrinsics, scene.posed.appearance.lights
    described = {
        "T_world_table": None if ground is None else ground.table.T_world_table.tolist(),
        "T_world_obj": start.T_world_obj.tolist(),
        "lights": [{"towards": light.direction.tolist(), "color": list(light.color)} for light in lights],
        "intrinsics": {key: getattr(sensor, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "depth_units_per_m": job.images.depth_units_per_m,
        "pairs": [_views(group, job) for _, group in groupby(scene.views(), key=itemgetter(0))],
    }
    path = folder / "scene.json"
    path.write_text(json.dumps(described))
    return path


def _views(views: Iterable[tuple[Pair, View]], job: Job) -> dict[str, object]:
    """Poses of a pair's cameras by name, and the path, view, kind of pixels and crop (or none) of every image."""
    cameras, images = {}, []
    for pair, view in views:
        name = view_name(view.role, view.number)
        if view.role != "projected":
            cameras[name] = view.camera.T_world_cam.tolist()
        objects = object_labels(view, pair)
        for path, kind, box in image_boxes(view, objects, objects[0].category, job.images.patch):
            crop = [end for side in box if isinstance(side, slice) for end in (side.start, side.stop)] or None
            images.append({"path": path, "view": name, "pixels": kind, "crop": crop})
    return {"cameras": cameras, "images": images}


class ScriptProcess:
    """The running script. It inherits our core and our environment, and never shares our OpenGL context.

    Only what is set for our own speed (`FOR_SPEED`) it does not inherit: few people who write such scripts set it.
    """

    def __init__(self, process: subprocess.Popen[str], errors: IO[str]) -> None:
        self._process, self._errors = process, errors

    def run(self, scenes: Sequence[Path], out: Path, look: str) -> Lap:
        """Makes these scenes in one of `LOOKS`, one after another, into one folder."""
        answers = [self.ask({"scene": str(scene), "out": str(out), "look": look}) for scene in scenes]
        wall, cpu, load = (sum(answer[key] for answer in answers) for key in ("wall_s", "cpu_s", "load_s"))
        stages = {name: sum(answer["stages_s"][name] for answer in answers) for name in answers[0]["stages_s"]}
        return Lap(len(scenes), wall, cpu, stages, load)

    def ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Its answer. Raises MachineError with the process's last lines where it died."""
        assert self._process.stdin is not None and self._process.stdout is not None
        line = ""
        with contextlib.suppress(BrokenPipeError):
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
    """The script, ended with the block."""
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
