"""A made-up folder of meshes as people have them: y up and z up, metres and millimetres, whole and broken."""

import json
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

Y_UP = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))


def cup(height=0.1, radius=0.04):
    """A cup that stands on z, metres."""
    profile = [[0, 0], [0.8, 0], [1, 1], [0.93, 1], [0.74, 0.06], [0, 0.06]]
    return trimesh.creation.revolve(np.array(profile) * (radius, height), sections=32)


def write_mesh(path: Path, mesh, turned=False, scale=1.0):
    """The mesh in a file of its own; `turned`: with y up."""
    path.parent.mkdir(parents=True, exist_ok=True)
    copy = mesh.copy()
    copy.apply_scale(scale)
    if turned:
        copy.apply_transform(Y_UP)
    copy.export(path)
    return path


def write_gltf(folder: Path, mesh):
    """The mesh as a .gltf with its buffers beside it, y up."""
    folder.mkdir(parents=True)
    copy = mesh.copy()
    copy.apply_transform(Y_UP)
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(copy)).items():
        (folder / name).write_bytes(data)


def write_textured(path: Path, mesh):
    """The mesh with a picture, as OBJ."""
    copy = mesh.copy()
    uv = np.random.default_rng(0).random((len(copy.vertices), 2))
    skin = trimesh.visual.material.SimpleMaterial(image=Image.new("RGB", (16, 16), (30, 160, 90)))
    copy.visual = trimesh.visual.TextureVisuals(uv=uv, material=skin)
    path.parent.mkdir(parents=True, exist_ok=True)
    copy.export(path)
    return path


def write_urdf(folder: Path, mesh):
    """A URDF beside its visual and its collision mesh."""
    write_mesh(folder / "textured.obj", mesh)
    write_mesh(folder / "collision.obj", mesh.convex_hull)
    link = "".join(
        f'<{kind}><geometry><mesh filename="{name}.obj"/></geometry></{kind}>'
        for kind, name in (("visual", "textured"), ("collision", "collision"))
    )
    (folder / "model.urdf").write_text(f'<robot name="r"><link name="l">{link}</link></robot>')


def mixed_folder(folder: Path) -> Path:
    """Ten objects in seven categories, and eight files that are left out."""
    for number in range(3):
        write_mesh(folder / f"mugs/mug_{number}.glb", cup(0.08 + 0.02 * number), turned=True)
    write_mesh(folder / "standing.glb", cup(0.09))
    for number in range(2):
        write_mesh(folder / f"bottles/bottle {number}.stl", cup(0.2 + 0.1 * number, 0.05), scale=1000)
    textured = write_textured(folder / "002_can/google_16k/textured.obj", trimesh.creation.box((70, 70, 150)))
    write_mesh(folder / "002_can/google_16k/nontextured.ply", trimesh.creation.box((70, 70, 150)))
    (folder / "002_can/copy").mkdir()
    for name in ("textured.obj", "material.mtl", "material_0.png"):
        (folder / "002_can/copy" / name).write_bytes((textured.parent / name).read_bytes())
    write_gltf(folder / "gltf cup", cup(0.1, 0.045))
    write_urdf(folder / "robot", cup(0.13))
    write_mesh(folder / "table/1.stl", trimesh.creation.cylinder(50, 90))
    write_mesh(folder / "huge.stl", trimesh.creation.box((1e6, 1e6, 1e6)))
    (folder / "broken.obj").write_text("v 0 0 0\nf 1 2 3\n")
    (folder / "scene.fbx").write_text("x")
    (folder / "torn.gltf").write_text(
        json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": "gone.bin", "byteLength": 4}]})
    )
    (folder / "mugs/out.glb").symlink_to("/etc/hostname")
    (folder / ".hidden.obj").write_text("no mesh")
    return folder
