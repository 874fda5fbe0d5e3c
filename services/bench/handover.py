"""A scene as files for the other systems: the same shapes, start and cameras."""

import json
from pathlib import Path

import numpy as np

from schemas.job.job import Job
from schemas.scene.scene import Placed
from schemas.scene.shape import Mesh, Shape
from schemas.scene.view import Pair
from workers.assets.glb import asset_glb
from workers.geometry.colour import SRGB_STEPS, decode_srgb, encode_srgb
from workers.scene.make_scene import Scene
from workers.scene.rows import image_boxes, object_labels
from workers.store.images import encode_png

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
