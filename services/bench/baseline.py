"""The script that people write today: stock PyBullet, stock pyrender, plain numpy, `cv2.imwrite`.

Run as a process of its own (`python -m services.bench.baseline`), because stock pyrender ends EGL for its whole process
when it is done. It reads one line of JSON for each scene, `{"scene": FILE, "out": FOLDER, "look": LOOK}`, makes the
scene's images, and answers with one line of seconds by stage. It uses none of the code under test.

It has two looks. `plain` is what such scripts do: a floor of one colour, one light, no shadows. `same` is what one has to
write to get images like those of the raster tier: the floor's texture, each of the scene's distant lights, and pyrender's
own shadows of them. All other settings are pyrender's defaults.

A scene without a table is of one object alone: nothing falls, pictures have alpha, the mask is where there is depth, and normals
are drawn by a second pass with normals as colours, as such scripts do.
"""

import json
import os
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

vars(np)["infty"] = np.inf  # pyrender 0.1.45 was written before numpy 2

import pybullet  # noqa: E402
import pyrender  # noqa: E402
import trimesh  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

STEP_HZ, SECONDS = 240, 3.0
"""The simulation, as such scripts have it."""

FLOOR, TABLE, OBJECT = 1, 2, 3
"""Region ids."""

FLOOR_COLOR = (150, 140, 130, 255)
"""In the plain look."""

OPTICAL_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Images = dict[str, NDArray]


def load_meshes(folder: Path, look: str) -> dict[str, Any]:
    """The meshes of a scene for pyrender."""
    files = {name: folder / f"{name}.glb" for name in ("floor", "table", "object")}
    loaded: dict[str, Any] = {name: trimesh.load(file) for name, file in files.items() if file.exists()}
    meshes = {name: scene.dump() for name, scene in loaded.items()}
    if look == "plain" and "floor" in meshes:
        for mesh in meshes["floor"]:
            mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=FLOOR_COLOR)
    return meshes


def simulate(description: dict[str, Any], folder: Path) -> NDArray:
    """Drop the object onto the table for three seconds; its pose [4, 4] afterwards."""
    pybullet.resetSimulation()
    pybullet.setGravity(0, 0, -9.81)
    pybullet.setTimeStep(1.0 / STEP_HZ)
    _load_urdf(folder / "table.urdf", np.array(description["T_world_table"]), fixed=True)
    body = _load_urdf(folder / "object.urdf", np.array(description["T_world_obj"]))
    for _ in range(round(STEP_HZ * SECONDS)):
        pybullet.stepSimulation()
    position, quaternion = pybullet.getBasePositionAndOrientation(body)
    T = np.eye(4)
    T[:3, :3] = np.array(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
    com = np.array(pybullet.getDynamicsInfo(body, -1)[3])
    T[:3, 3] = np.array(position) - T[:3, :3] @ com
    return T


def _load_urdf(path: Path, T: NDArray, fixed: bool = False) -> int:
    quaternion = trimesh.transformations.quaternion_from_matrix(T)
    place = (T[:3, 3].tolist(), [*quaternion[1:], quaternion[0]])
    body: int = pybullet.loadURDF(str(path), *place, useFixedBase=fixed)
    return body


def build(
    description: dict[str, Any], meshes: dict[str, Any], T_world_obj: NDArray, look: str
) -> tuple[Any, dict[Any, Any]]:
    """The pyrender scene, and the colour of each node in a segmentation pass."""
    alone = description["T_world_table"] is None
    scene = pyrender.Scene(ambient_light=[0.3, 0.3, 0.3], bg_color=[0.0] * 4 if alone else [0.8, 0.85, 0.9])
    poses = {"object": T_world_obj}
    if not alone:
        poses |= {"floor": np.eye(4), "table": np.array(description["T_world_table"])}
    colors = {}
    for region, name in ((FLOOR, "floor"), (TABLE, "table"), (OBJECT, "object")):
        if name not in poses:
            continue
        mesh = pyrender.Mesh.from_trimesh(meshes[name], smooth=False)
        colors[scene.add(mesh, pose=poses[name])] = (region, region, region)
    if look == "same":
        for light in description["lights"]:
            lamp = pyrender.DirectionalLight(color=np.array(light["color"]), intensity=np.pi)
            scene.add(lamp, pose=trimesh.geometry.align_vectors([0.0, 0.0, 1.0], light["towards"]))
    else:
        scene.add(pyrender.DirectionalLight(intensity=3.0), pose=trimesh.transformations.euler_matrix(0.6, 0.3, 0.0))
    return scene, colors


def render(scene: Any, colors: dict, renderer: Any, k: dict[str, float], T_world_cam: NDArray, look: str) -> Images:
    """Colour, depth and segmentation from one camera."""
    flags = pyrender.RenderFlags.SHADOWS_DIRECTIONAL if look == "same" else pyrender.RenderFlags.NONE
    camera = pyrender.IntrinsicsCamera(k["fx"], k["fy"], k["cx"], k["cy"], znear=0.05, zfar=100.0)
    node = scene.add(camera, pose=T_world_cam @ OPTICAL_TO_OPENGL)
    rgb, depth = renderer.render(scene, flags=flags)
    region, _ = renderer.render(scene, flags=pyrender.RenderFlags.SEG, seg_node_map=colors)
    scene.remove_node(node)
    return {"rgb": rgb, "depth": depth, "region": np.ascontiguousarray(region[..., 0])}


def build_normals(meshes: dict[str, Any], T_world_obj: NDArray) -> Any:
    """A pyrender scene of the object alone whose colours are its vertex normals."""
    scene = pyrender.Scene(ambient_light=[1.0, 1.0, 1.0], bg_color=[0.0] * 4)
    for mesh in meshes["object"]:
        colors = np.rint(255.0 * (0.5 + 0.5 * mesh.vertex_normals)).astype(np.uint8)
        plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, vertex_colors=colors)
        scene.add(pyrender.Mesh.from_trimesh(plain, smooth=True), pose=T_world_obj)
    return scene


def render_alone(scene: Any, normals: Any | None, renderer: Any, k: dict[str, float], T_world_cam: NDArray) -> Images:
    """Colour with alpha, depth, mask and, of a scene of normals, normals from one camera."""
    camera = pyrender.IntrinsicsCamera(k["fx"], k["fy"], k["cx"], k["cy"], znear=0.05, zfar=100.0)
    images = {}
    for what, where, flags in (
        ("rgb", scene, pyrender.RenderFlags.RGBA),
        ("normals", normals, pyrender.RenderFlags.FLAT),
    ):
        if where is not None:
            node = where.add(camera, pose=T_world_cam @ OPTICAL_TO_OPENGL)
            images[what], depth = renderer.render(where, flags=flags)
            where.remove_node(node)
    return images | {"depth": depth, "region": np.where(depth > 0.0, OBJECT, 0).astype(np.uint8)}


def project(view: Images, k: dict[str, float], T_target_source: NDArray) -> Images:
    """The input cloud seen from another camera: the farthest points first, so that the nearest stay."""
    height, width = view["depth"].shape
    v, u = np.mgrid[0:height, 0:width]
    z = view["depth"].astype(np.float64)
    x, y = (u + 0.5 - k["cx"]) / k["fx"] * z, (v + 0.5 - k["cy"]) / k["fy"] * z
    valid = z > 0
    points = np.stack([x, y, z], axis=-1)[valid] @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    colors = view["rgb"][valid]
    keep = points[:, 2] > 0
    points, colors = points[keep], colors[keep]
    column = np.floor(k["fx"] * points[:, 0] / points[:, 2] + k["cx"]).astype(int)
    row = np.floor(k["fy"] * points[:, 1] / points[:, 2] + k["cy"]).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, points, colors = column[inside], row[inside], points[inside], colors[inside]
    order = np.argsort(-points[:, 2])
    depth, rgb = np.zeros((height, width)), np.zeros((height, width, 3), np.uint8)
    depth[row[order], column[order]] = points[order, 2]
    rgb[row[order], column[order]] = colors[order]
    return {"rgb": rgb, "depth": depth}


def write(views: dict[str, Images], images: list[dict[str, Any]], units: float, out: Path) -> None:
    """Every image and its patch, as PNG with OpenCV's defaults."""
    for image in images:
        pixels = views[image["view"]][image["pixels"]]
        if image["crop"]:
            top, bottom, left, right = image["crop"]
            pixels = pixels[top:bottom, left:right]
        if image["pixels"] == "depth":
            pixels = np.clip(pixels * units, 0, 65535).astype(np.uint16)
        elif image["pixels"] in ("rgb", "normals"):
            pixels = cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR)
        path = out / image["path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), pixels)


renderer_of = cache(pyrender.OffscreenRenderer)
"""Pyrender's renderer by width and height, made in the first scene."""


def make(description: dict[str, Any], folder: Path, meshes: dict[str, Any], out: Path, look: str) -> dict[str, float]:
    """One scene's images; seconds by stage."""
    seconds = dict.fromkeys(("physics", "scene", "render", "projection", "write"), 0.0)
    k, last = description["intrinsics"], time.perf_counter()

    def count(stage: str) -> None:
        nonlocal last
        seconds[stage] += time.perf_counter() - last
        last = time.perf_counter()

    alone = description["T_world_table"] is None
    T_world_obj = np.array(description["T_world_obj"]) if alone else simulate(description, folder)
    count("physics")
    scene, colors = build(description, meshes, T_world_obj, look)
    wanted = {image["pixels"] for pair in description["pairs"] for image in pair["images"]}
    normals = build_normals(meshes, T_world_obj) if "normals" in wanted else None
    renderer = renderer_of(k["width"], k["height"])
    count("scene")
    for pair in description["pairs"]:
        cameras = {role: np.array(T) for role, T in pair["cameras"].items()}
        views = {}
        for name, T in cameras.items():
            if alone:
                views[name] = render_alone(scene, normals, renderer, k, T)
            else:
                views[name] = render(scene, colors, renderer, k, T, look)
        count("render")
        if "mirror" not in cameras:
            write(views, pair["images"], description["depth_units_per_m"], out)
            count("write")
            continue
        views["projected"] = project(views["input"], k, np.linalg.inv(cameras["mirror"]) @ cameras["input"])
        count("projection")
        write(views, pair["images"], description["depth_units_per_m"], out)
        count("write")
    return seconds


def answer_scenes() -> None:
    """Answers one line of JSON with one line until there are no more."""
    # Libraries talk on standard output, so that is moved.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    pybullet.connect(pybullet.DIRECT)
    for line in sys.stdin:
        asked = json.loads(line)
        path, before = Path(asked["scene"]), time.perf_counter()
        description = json.loads(path.read_text())
        meshes = load_meshes(path.parent, asked["look"])
        wall, cpu = time.perf_counter(), time.process_time()
        stages = make(description, path.parent, meshes, Path(asked["out"]), asked["look"])
        answer = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu, "stages_s": stages}
        print(json.dumps(answer | {"load_s": wall - before}), file=answers)


if __name__ == "__main__":
    answer_scenes()
