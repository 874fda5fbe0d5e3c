"""The script that people write today with Blender: stock bpy, Cycles on one thread of the CPU.

Run by an interpreter that has `bpy`, as a process of its own. It reads one line of JSON for each scene, `{"scene": FILE,
"samples": 16}`, renders its views, and answers with one line, `wall_s` and `cpu_s`. It imports none of our code; traced.py
writes its input.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

OPTICAL_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


def build(described: dict[str, Any], folder: Path) -> Any:
    """Everything but the camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for part in described["parts"]:
        add_part(scene, part, np.load(folder / part["arrays"]))
    for light in described["suns"]:
        lamp = bpy.data.lights.new("sun", "SUN")
        lamp.energy, lamp.color, lamp.angle = 1.0, (1.0, 1.0, 1.0), light["angle_rad"]
        lamp.use_nodes = True
        emission = lamp.node_tree.nodes["Emission"]
        emission.inputs["Color"].default_value = (*light["irradiance"], 1.0)
        placed = bpy.data.objects.new("sun", lamp)
        placed.matrix_world = Matrix(light["T_world_light"])
        scene.collection.objects.link(placed)
    add_sky(scene, np.load(folder / described["sky"]))
    settings(scene, described)
    return scene


def add_part(scene: Any, part: dict[str, Any], arrays: Any) -> None:
    """One mesh with its material."""
    mesh = bpy.data.meshes.new(part["name"])
    faces = arrays["faces"]
    mesh.vertices.add(len(arrays["vertices"]))
    mesh.vertices.foreach_set("co", arrays["vertices"].ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3))
    mesh.polygons.foreach_set("loop_total", np.full(len(faces), 3))
    if "uv" in arrays:
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", arrays["uv"][faces.ravel()].ravel())
    mesh.update(calc_edges=True)
    if "normals" in arrays:
        mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
        mesh.normals_split_custom_set_from_vertices(arrays["normals"].tolist())
    mesh.materials.append(make_material(part, arrays))
    scene.collection.objects.link(bpy.data.objects.new(part["name"], mesh))


def make_material(part: dict[str, Any], arrays: Any) -> Any:
    """Principled, or where it transmits a clear sheet that mirrors by Fresnel."""
    material = bpy.data.materials.new(part["name"])
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    body = nodes["Principled BSDF"]
    body.inputs["Metallic"].default_value = part["metallic"]
    body.inputs["Roughness"].default_value = part["roughness"]
    body.inputs["Base Color"].default_value = (*part["color"], 1.0)
    if "texture" in arrays:
        picture = nodes.new("ShaderNodeTexImage")
        picture.image = image_of("texture", arrays["texture"], False)
        links.new(picture.outputs["Color"], body.inputs["Base Color"])
    if part["tint"] is not None:
        links.new(sheet(material.node_tree, part, arrays, body), nodes["Material Output"].inputs["Surface"])
    return material


def sheet(tree: Any, part: dict[str, Any], arrays: Any, body: Any) -> Any:
    """The output of a thin sheet of glass, and of the body where its map says so."""
    nodes, links = tree.nodes, tree.links
    clear, mirror = nodes.new("ShaderNodeBsdfTransparent"), nodes.new("ShaderNodeBsdfGlossy")
    clear.inputs["Color"].default_value = (*part["tint"], 1.0)
    mirror.inputs["Roughness"].default_value = 0.0
    fresnel, mix = nodes.new("ShaderNodeFresnel"), nodes.new("ShaderNodeMixShader")
    links.new(fresnel.outputs["Fac"], mix.inputs["Fac"])
    links.new(clear.outputs["BSDF"], mix.inputs[1])
    links.new(mirror.outputs["BSDF"], mix.inputs[2])
    if "opaque" not in arrays:
        return mix.outputs["Shader"]
    where, both = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeMixShader")
    where.image = image_of("opaque", np.repeat(arrays["opaque"][..., None], 3, axis=2), True)
    links.new(where.outputs["Color"], both.inputs["Fac"])
    links.new(mix.outputs["Shader"], both.inputs[1])
    links.new(body.outputs["BSDF"], both.inputs[2])
    return both.outputs["Shader"]


def image_of(name: str, pixels: Any, raw: bool) -> Any:
    """Pixels [h, w, 3], row 0 at the top: uint8 sRGB, or float32 linear where `raw`."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, float_buffer=raw)
    image.colorspace_settings.name = "Non-Color" if raw else "sRGB"
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = pixels[::-1] if raw else pixels[::-1] / 255.0
    image.pixels.foreach_set(values.ravel())
    image.update()
    image.pack()
    return image


def add_sky(scene: Any, picture: Any) -> None:
    """A picture [h, w, 3] of linear radiance around the scene, in Blender's own projection."""
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    scene.world = world
    nodes, links = world.node_tree.nodes, world.node_tree.links
    around = nodes.new("ShaderNodeTexEnvironment")
    around.image = image_of("sky", picture, True)
    links.new(around.outputs["Color"], nodes["Background"].inputs["Color"])


def settings(scene: Any, described: dict[str, Any]) -> None:
    """Cycles on one thread, every sample taken, nothing smoothed afterwards; the rest as it comes."""
    k = described["intrinsics"]
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = described["bounces"]
    scene.cycles.pixel_filter_type = "BOX"
    scene.render.use_persistent_data = True
    scene.render.threads_mode = "FIXED"
    scene.render.threads = 1
    scene.render.resolution_x, scene.render.resolution_y = k["width"], k["height"]
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"


def look(scene: Any, described: dict[str, Any], T_world_cam: list[list[float]]) -> None:
    """The camera at one pose."""
    k = described["intrinsics"]
    data = bpy.data.cameras.new("camera")
    wide = max(k["width"], k["height"])
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = 36.0 * k["fx"] / k["width"]
    data.shift_x, data.shift_y = (0.5 * k["width"] - k["cx"]) / wide, (k["cy"] - 0.5 * k["height"]) / wide
    data.clip_start, data.clip_end = 0.05, 1000.0
    placed = bpy.data.objects.new("camera", data)
    placed.matrix_world = Matrix((np.array(T_world_cam) @ OPTICAL_TO_BLENDER).tolist())
    scene.collection.objects.link(placed)
    scene.camera = placed


def render(described: dict[str, Any], folder: Path, samples: int) -> dict[str, float]:
    """Seconds by the clock and of the processor for all views, building the scene included."""
    wall, cpu = time.perf_counter(), time.process_time()
    scene = build(described, folder)
    scene.cycles.samples = samples
    for T_world_cam in described["cameras"]:
        look(scene, described, T_world_cam)
        bpy.ops.render.render()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def main() -> None:
    """Answer one line with one line until there are no more. Blender talks on standard output, so that is moved."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    print(json.dumps({"version": bpy.app.version_string}), file=answers)
    for line in sys.stdin:
        asked = json.loads(line)
        path = Path(asked["scene"])
        print(json.dumps(render(json.loads(path.read_text()), path.parent, asked["samples"])), file=answers)


if __name__ == "__main__":
    main()
