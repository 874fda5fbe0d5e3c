"""Whole assets that the fuzzing starts from: one of every format, with what it refers to."""

import io
import json
from collections.abc import Mapping

import numpy as np
import trimesh
from PIL import Image

from tests.workers.assets.oracles import CUBE

Files = Mapping[str, bytes]
"""The files of an asset by name; the first is the mesh or URDF."""


def picture(kind: str, size: tuple[int, int] = (16, 12)) -> bytes:
    """A PNG or JPEG of noise."""
    stream = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    Image.fromarray(noise).save(stream, kind)
    return stream.getvalue()


def textured_obj(image: str) -> bytes:
    corners = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\n"
    lines = [
        "f " + " ".join(f"{v}/{k + 1}/1" for k, v in enumerate(line.split()[1:])) if line.startswith("f ") else line
        for line in CUBE.splitlines()
    ]
    return ("mtllib skin.mtl\n" + corners + "usemtl skin\n" + "\n".join(lines) + "\n").encode()


def material(image: str) -> bytes:
    return f"newmtl skin\nKa 0 0 0\nKd 0.8 0.7 0.6\nKs 0 0 0\nNs 10\nd 1.0\nillum 2\nmap_Kd {image}\n".encode()


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((0.1, 0.2, 0.3))


def exported(kind: str, **more: str) -> bytes:
    data = box().export(file_type=kind, **more)
    assert isinstance(data, bytes | str)
    return data.encode() if isinstance(data, str) else data


def textured_ply() -> bytes:
    return exported("ply", encoding="ascii").replace(
        b"element vertex", b"comment TextureFile skin.png\nelement vertex", 1
    )


def coloured_ply() -> bytes:
    colors = np.random.default_rng(1).integers(0, 255, (8, 4), dtype=np.uint8)
    mesh = trimesh.Trimesh(box().vertices, box().faces, vertex_colors=colors, process=False)
    data = mesh.export(file_type="ply")
    assert isinstance(data, bytes)
    return data


def textured_scene() -> trimesh.Scene:
    scene = trimesh.Scene()
    for k in range(3):
        mesh = trimesh.creation.icosphere(1, 0.05)
        skin = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.open(io.BytesIO(picture("PNG"))))
        uv = np.random.default_rng(k).random((len(mesh.vertices), 2))
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=skin)
        T = np.eye(4)
        T[0, 3] = 0.1
        scene.add_geometry(mesh, node_name=f"n{k}", parent_node_name=f"n{k - 1}" if k else None, transform=T)
    return scene


def textured_glb() -> bytes:
    data = textured_scene().export(file_type="glb")
    assert isinstance(data, bytes)
    return data


def textured_gltf() -> Files:
    """One picture beside it, the others in its buffer."""
    files = trimesh.exchange.gltf.export_gltf(textured_scene(), merge_buffers=True)
    tree = json.loads(files["model.gltf"])
    tree["images"][0] = {"uri": "skin.png"}
    tree["buffers"][0]["uri"] = "a.bin"
    return {"a.gltf": json.dumps(tree).encode(), "a.bin": files["gltf_buffer.bin"], "skin.png": picture("PNG")}


URDF = b"""<?xml version="1.0"?>
<robot name="thing">
  <material name="red"><color rgba="0.9 0.1 0.1 1"/></material>
  <link name="base"><visual><origin xyz="0 0 0.1" rpy="0 0.2 0"/><geometry><box size="0.2 0.1 0.1"/></geometry>
    <material name="red"/></visual></link>
  <joint name="a" type="fixed"><parent link="base"/><child link="arm"/><origin xyz="0 0.1 0" rpy="0.1 0 0"/></joint>
  <link name="arm"><visual><geometry><cylinder radius="0.05" length="0.2"/></geometry></visual>
    <visual><geometry><mesh filename="mesh/cube.obj" scale="0.1 0.1 0.1"/></geometry></visual></link>
  <joint name="b" type="fixed"><parent link="arm"/><child link="ball"/><origin xyz="0 0 0.1"/></joint>
  <link name="ball"><visual><geometry><sphere radius="0.04"/></geometry></visual></link>
</robot>
"""

_SKIN = {"skin.png": picture("PNG")}

SEEDS: Mapping[str, Files] = {
    "obj": {"a.obj": CUBE.encode()},
    "obj_png": {"a.obj": textured_obj("skin.png"), "skin.mtl": material("skin.png"), **_SKIN},
    "obj_jpg": {"a.obj": textured_obj("skin.jpg"), "skin.mtl": material("skin.jpg"), "skin.jpg": picture("JPEG")},
    "ply": {"a.ply": textured_ply(), **_SKIN},
    "ply_binary": {"a.ply": coloured_ply()},
    "stl": {"a.stl": exported("stl")},
    "stl_ascii": {"a.stl": exported("stl_ascii")},
    "glb": {"a.glb": textured_glb()},
    "gltf": textured_gltf(),
    "urdf": {
        "a.urdf": URDF,
        "mesh/cube.obj": textured_obj("skin.png"),
        "mesh/skin.mtl": material("skin.png"),
        "mesh/skin.png": picture("PNG"),
    },
}
