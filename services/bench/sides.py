"""The sides that we are compared with: the script that people write today, and the lower bound of time for the same files.

The script (baseline.py) says `{"ready": true}`, then reads one line of JSON for each scene (`scene`: the `scene.json` that
`hand_over` wrote beside its meshes; `out`: a folder; `look`) and answers with one line: `wall_s`, `cpu_s`, `stages_s` by
stage, and `load_s`, the seconds of reading files before its clock. The lower bound is bare draws, the fastest lossless
encoder, and a durable write.
"""

import contextlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import fpng
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
from workers.render.raster.gbuffer import FLAT, Renderer
from workers.scene.make_scene import Scene
from workers.scene.rows import image_boxes, object_labels
from workers.store.file_system import sync_path, sync_tree
from workers.store.images import Pixels, decode_png, encode_png


@dataclass(frozen=True)
class Look:
    """A look of the script: its name in JSON and in the text, and what it makes."""

    name: str
    title: str
    makes: str
    only_raster: bool = False
    """Whether its images are comparable with those of the raster tier only."""


_PLAIN = "same files; RGB with a floor of one colour, one light, no shadows"
_SAME = "same files; RGB with the floor's texture, the scene's lights and pyrender's shadows"

LOOKS = {
    "plain": Look("script_plain", "the script, plain look", _PLAIN),
    "same": Look("script_same_look", "the script, same look", _SAME, only_raster=True),
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
    sensor, lights = job.cameras.sensor, scene.posed.appearance.lights
    described = {
        "T_world_table": table.T_world_table.tolist(),
        "T_world_obj": start.T_world_obj.tolist(),
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
            crop = [end for side in box if isinstance(side, slice) for end in (side.start, side.stop)] or None
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


# ---------------------------------------------------------------------------------------------- the lower bound

Encoder = Callable[[Pixels], bytes]

NO_LARGER = 2.0
"""An encoder may make at most this many times our bytes; a faster one that hardly compresses is no lower bound."""


def encoders() -> dict[str, Encoder]:
    """Encoders by name; ours is one of them, so that the lower bound is never above it. OpenCV's take 3 to 7 times as long."""
    levels = {f"isal {level}": partial(encode_isal, level=level) for level in (0, 1)}
    return {"ours": encode_png, "fpng": encode_fpng, **levels}


def encode_fpng(pixels: Pixels) -> bytes:
    """PNG of colour by fpng, also where it has holes and becomes twice as large; ours for what fpng does not encode."""
    return bytes(fpng.from_ndarray(np.ascontiguousarray(pixels))) if pixels.ndim == 3 else encode_png(pixels)


def encode_isal(pixels: Pixels, level: int) -> bytes:
    """PNG (ISO/IEC 15948) without filters, deflated by ISA-L in one piece."""
    from isal import isal_zlib  # of the extra `study`

    height, width = pixels.shape[:2]
    depth, color = (16, 0) if pixels.dtype == np.uint16 else (8, 2 if pixels.ndim == 3 else 0)
    rows = np.ascontiguousarray(pixels.astype(">u2") if depth == 16 else pixels).view(np.uint8).reshape(height, -1)
    lines = np.zeros((height, rows.shape[1] + 1), np.uint8)
    lines[:, 1:] = rows
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    data = isal_zlib.compress(lines, level)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", isal_zlib.crc32(body, zlib.crc32(kind)))
        for kind, body in ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
    )


def kind_of(pixels: Pixels) -> str:
    """`rgb`, `uint16` or `uint8`."""
    return "rgb" if pixels.ndim == 3 else str(pixels.dtype)


def choose_encoders(images: Sequence[tuple[Pixels, int]]) -> dict[str, tuple[str, Encoder]]:
    """Name and function of the fastest encoder for each kind of image, measured on `images` and the bytes of each now."""
    chosen = {}
    for kind in sorted({kind_of(pixels) for pixels, _ in images}):
        own = [pixels for pixels, _ in images if kind_of(pixels) == kind]
        allowed = NO_LARGER * sum(size for pixels, size in images if kind_of(pixels) == kind)
        timed = {
            name: min(_encode_s(encode, own) for _ in range(3))
            for name, encode in encoders().items()
            if sum(len(encode(pixels)) for pixels in own) <= allowed
        }
        name = min(timed, key=timed.__getitem__)
        chosen[kind] = (name, encoders()[name])
    return chosen


def _encode_s(encode: Encoder, images: Sequence[Pixels]) -> float:
    begun = time.process_time()
    for pixels in images:
        encode(pixels)
    return time.process_time() - begun


def images_of(files: Mapping[str, bytes]) -> list[tuple[Pixels, int]]:
    """Pixels and size of every PNG among the files."""
    return [(decode_png(data, path), len(data)) for path, data in files.items() if path.endswith(".png")]


def run_lower_bound(
    renderer: Renderer,
    scenes: Sequence[Scene],
    files: Mapping[str, bytes],
    chosen: Mapping[str, tuple[str, Encoder]],
    folder: Path,
) -> Lap:
    """Draw every view, encode every image, and write every byte so that it survives a loss of power. `folder` is new.

    The lap's `apart_s` is a first draw of each scene, which uploads its shapes.
    """
    upload, draw, draw_cpu = _draw(renderer, scenes)
    images = images_of(files)
    begun, cpu = time.perf_counter(), time.process_time()
    for pixels, _ in images:
        chosen[kind_of(pixels)][1](pixels)
    encoded = time.perf_counter()
    write_durably(files, folder)
    written = time.perf_counter()
    stages = {"draw": draw, "encode": encoded - begun, "write": written - encoded}
    return Lap(len(scenes), sum(stages.values()), draw_cpu + time.process_time() - cpu, stages, upload)


def _draw(renderer: Renderer, scenes: Sequence[Scene]) -> tuple[float, float, float]:
    """Seconds of uploading every scene's shapes, then of the clock and of the processor for bare passes.

    A bare pass draws and reads back colour without shadows, depth and region, as tier flat does, whatever the job's tier.
    """
    upload, wall, cpu = 0.0, 0.0, 0.0
    for scene in scenes:
        views = [view.camera for pair in scene.pairs for view in pair.views if view.role != "projected"]
        things, appearance = scene.posed.things, scene.posed.appearance
        begun = time.perf_counter()
        renderer.draw(things, appearance, views[0], FLAT)
        drawn, drawn_cpu = time.perf_counter(), time.process_time()
        for camera in views:
            renderer.draw(things, appearance, camera, FLAT)
        upload, wall = upload + drawn - begun, wall + time.perf_counter() - drawn
        cpu += time.process_time() - drawn_cpu
    return upload, wall, cpu


def write_durably(files: Mapping[str, bytes], folder: Path) -> int:
    """Write the files beside `folder`, flush them, and rename them into place at once. Returns the bytes written."""
    staging = folder.with_name(f".{folder.name}")
    for parent in {(staging / path).parent for path in files}:
        parent.mkdir(parents=True, exist_ok=True)
    written = sum((staging / path).write_bytes(data) for path, data in files.items())
    sync_tree(staging)
    os.rename(staging, folder)
    sync_path(folder.parent)
    return written
