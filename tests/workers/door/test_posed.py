"""MJCF and SDF beside URDF: what is seen of them, where it lies and how it looks; MuJoCo itself is the judge of MJCF."""

import re
import struct

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.door.oracles import CUBE, picture, textured_obj, urdf, visual, write, write_all
from tests.workers.door.test_statements import dae, geometry, seen
from workers.assets.library.reading import list_files
from workers.door.meshes.dae import find_up
from workers.door.meshes.formats import load_shape
from workers.door.meshes.posed import Source
from workers.door.meshes.urdf import list_named, list_seen, load_posed

LIMITS = MeshLimits()

BODY = """
<mujoco><compiler {compiler}/>
<default><geom rgba="0.2 0.4 0.6 1"/><default class="seen"><geom contype="0" conaffinity="0" group="2"/></default>
<default class="small"><mesh scale="0.1 0.2 0.3"/></default></default>
<asset><mesh name="m" file="cube.obj" class="small"/><mesh name="r" file="cube.obj" scale="0.3 0.2 0.1" refpos="0.1 0.2 0.3"
refquat="0.9 0.1 0.2 0.3"/></asset>
<worldbody><body pos="0.3 0.1 0.2" {turn}><freejoint/>
<geom type="mesh" mesh="m" class="seen" pos="0.5 0 0" {turn}/><geom type="mesh" mesh="r" class="seen" quat="0.5 0.1 0.7 0.2"/>
<geom type="box" size="0.9 0.9 0.9"/><geom type="box" size="0.8 0.8 0.8" group="3"/>
<body childclass="seen" {turn} pos="1 2 3"><geom type="cylinder" size="0.1 0.2" {turn}/><geom type="capsule" size="0.1"
fromto="1 0 0 1.5 0.4 0.7"/><geom type="ellipsoid" size="0.1 0.2 0.3"/><geom size="0.2" pos="2 2 2"/></body>
<body><geom type="box" size="0.1 0.2 0.3" fromto="3 0 0 3 0 -1"/></body></body></worldbody></mujoco>"""

TURNS = (
    ("", ""),
    ('angle="radian"', 'euler="0.3 0.5 0.7"'),
    ("", 'euler="30 -50 70"'),
    ('eulerseq="zyX"', 'euler="30 -50 70"'),
    ("", 'axisangle="1 2 3 40"'),
    ("", 'xyaxes="1 2 0 -1 1 1"'),
    ("", 'zaxis="1 -2 0.5"'),
    ("", 'zaxis="0 0 -1"'),
    ("", 'quat="1 2 3 4"'),
)


def seen_by_mujoco(path, group=2):
    """The middle, mean square and extents [3, 3] of all that MuJoCo has in a group, from points of its own surfaces."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for geom in range(model.ngeom):
        kind, size = model.geom_type[geom], model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            start = model.mesh_vertadr[mesh]
            points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
        else:
            made = {
                mujoco.mjtGeom.mjGEOM_BOX: lambda s: trimesh.creation.box(2 * s),
                mujoco.mjtGeom.mjGEOM_CYLINDER: lambda s: trimesh.creation.cylinder(s[0], 2 * s[1], sections=48),
                mujoco.mjtGeom.mjGEOM_CAPSULE: lambda s: trimesh.creation.capsule(radius=s[0], height=2 * s[1]),
                mujoco.mjtGeom.mjGEOM_SPHERE: lambda s: trimesh.creation.uv_sphere(s[0], count=[48, 48]),
                mujoco.mjtGeom.mjGEOM_ELLIPSOID: lambda s: trimesh.creation.uv_sphere(1.0, count=[48, 48]).apply_scale(
                    s
                ),
            }[mujoco.mjtGeom(kind)](size)
            points = made.vertices
        in_body = model.geom_contype[geom] == 0 or model.body_geomnum[model.geom_bodyid[geom]] == 1
        if in_body and model.geom_group[geom] < 3:
            found.append(points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return [np.stack([points.min(axis=0), points.max(axis=0)]) for points in found]


def boxes(shape):
    return [np.stack([part.vertices.min(axis=0), part.vertices.max(axis=0)]) for part in shape.parts]


@pytest.mark.parametrize(("compiler", "turn"), TURNS)
def test_bodies_of_an_mjcf_lie_where_mujoco_has_them_and_collision_shapes_are_not_seen(tmp_path, compiler, turn):
    write(tmp_path / "cube.obj", CUBE)
    path = write(tmp_path / "a.xml", BODY.format(compiler=compiler, turn=turn))
    ours, theirs = boxes(load_posed(path, LIMITS, tmp_path).shape), seen_by_mujoco(path)
    assert len(ours) == len(theirs) == 7
    for mine, its in zip(ours, theirs, strict=True):
        assert mine == pytest.approx(its, abs=2e-3), "capsules and spheres have other facets"
    assert ours[0] == pytest.approx(theirs[0], abs=1e-6) and ours[1] == pytest.approx(theirs[1], abs=1e-6)


def test_a_body_with_a_look_has_its_picture_or_colour_and_one_without_coordinates_says_so(tmp_path):
    write_all(tmp_path / "m", textured_obj())
    write(tmp_path / "m/plain.obj", CUBE)
    write(tmp_path / "m/t/green.png", picture(colour=(0, 200, 0)))
    assets = """<mujoco><compiler meshdir="m" texturedir="m/t"/><asset><mesh file="{}.obj"/>{}<material name="k" texture="green"
    rgba="1 1 0.5 0.5"/></asset><worldbody><geom type="mesh" mesh="{}" {}/></worldbody></mujoco>"""
    flat = '<texture type="2d" file="green.png"/>'
    about = '<texture type="cube" name="green" file="green.png"/>'
    sides = '<texture type="cube" name="green" file="green.png" gridsize="3 4" gridlayout=".U..LFRB.D.."/>'
    drawn = '<texture name="green" builtin="{}" rgb1="0.2 0.4 0.6" rgb2="0.6 0 0.6" width="9" height="9"/>'
    sdf = """<sdf><model><link><visual><geometry><mesh><uri>model://any/m/plain.obj</uri></mesh></geometry><material>
    <diffuse>0 0 1</diffuse></material></visual></link></model></sdf>"""
    of_urdf = urdf(
        visual('<mesh filename="package://a/m/cube.obj"/>', material='<material name="green"/>'),
        more=('<material name="green"><texture filename="package://a/m/t/green.png"/></material>'),
    )
    bare = textured_obj()["cube.obj"].replace(b"mtllib cube.mtl\n", b"").replace(b"usemtl skin\n", b"")
    for name, text, colour, green, note in (
        ("a.xml", assets.format("cube", flat, "cube", 'material="k"'), (1.0, 1.0, 0.5, 0.5), True, ""),
        ("b.xml", assets.format("cube", about, "cube", 'material="k" rgba="1 0 0 1"'), (1.0, 0.0, 0.0, 1.0), True, ""),
        ("f.xml", assets.format("plain", about, "plain", 'material="k"'), (1.0, 1.0, 0.5, 0.5), True, ""),
        ("g.xml", assets.format("plain", sides, "plain", 'material="k"'), (1.0, 1.0, 0.5, 0.5), False, ""),
        (
            "h.xml",
            assets.format("plain", drawn.format("flat"), "plain", 'material="k"'),
            (0.2, 0.4, 0.3, 0.5),
            False,
            "",
        ),
        (
            "i.xml",
            assets.format("plain", drawn.format("checker"), "plain", 'material="k"'),
            (0.4, 0.2, 0.3, 0.5),
            False,
            "",
        ),
        (
            "c.xml",
            assets.format("plain", flat, "plain", 'material="k"'),
            (1.0, 1.0, 0.5, 0.5),
            False,
            "needs texture coord",
        ),
        ("d.sdf", sdf, (0.0, 0.0, 1.0, 1.0), False, ""),
        ("e.urdf", of_urdf, (1.0, 1.0, 1.0, 1.0), True, ""),
    ):
        if name == "e.urdf":
            write(tmp_path / "m/cube.obj", bare)
        path = write(tmp_path / name, text)
        loaded = load_posed(path, LIMITS, tmp_path)
        (part,) = loaded.shape.parts
        assert part.material.base_color == pytest.approx(colour), name
        assert (part.material.texture is not None and part.material.texture[0, 0].tolist() == [0, 200, 0]) == green, (
            name
        )
        assert note in "; ".join(loaded.notes), name
        meshes, pictures = list_seen(path, tmp_path, LIMITS)
        assert len(meshes) == 1 and len(pictures) == (name[0] in "abcef")


@pytest.mark.parametrize("body", ['type="mesh" mesh="m"', 'size="1.5"', 'type="cylinder" size="1 2"'], ids=str.split)
def test_a_picture_without_coordinates_of_its_own_lies_on_six_sides_once_and_not_mirrored(body, tmp_path):
    write(tmp_path / "m.obj", CUBE)
    write(tmp_path / "green.png", picture(colour=(0, 200, 0)))
    asset = '<mesh file="m.obj"/><texture name="t" file="green.png"/><material name="k" texture="t"/>'
    world = f'<worldbody><geom pos="5 0 0" {body} material="k"/></worldbody>'
    path = write(tmp_path / "a.xml", f"<mujoco><asset>{asset}</asset>{world}</mujoco>")
    (part,) = load_posed(path, LIMITS, tmp_path).shape.parts
    corners, uv = part.vertices[part.faces], part.uv[part.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert (a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0]).mean() > 0.95, "not mirrored; few faces bend away from their side"
    assert part.uv.min() >= 0.0 and part.uv.max() <= 1.0 and np.ptp(part.uv, axis=0).min() > 0.7
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lateral = np.abs(normal[:, 2]) < 0.1 * np.linalg.norm(normal, axis=1)
    up = np.polyfit(corners[lateral][..., 2].ravel(), uv[lateral][..., 1].ravel(), 1)
    assert lateral.any() and up[0] > 0.0, "upright on the sides"


SCRIPTED = """<sdf><model><link><visual><geometry>{}</geometry><material><script><uri>model://m/materials/scripts</uri>
<uri>model://m/materials/textures</uri><name>M/{}</name></script></material></visual></link></model></sdf>"""
SCRIPTS = """material M/Blue // as M/Red
{ technique { pass { ambient 1 0 0
   diffuse 0 0 1.0 1
} } }
/* material M/Gone {
 diffuse 1 0 0 } */
material "M/Bands" : M/Blue
{
 technique { pass {
   diffuse 1 1 1
   texture_unit {
     texture bands.png
   } } }
}
material M/Lost { pass { texture_unit {
 texture lost.png
} } }
material M/Shaded {
}
"""


def test_an_ogre_script_gives_colour_and_picture_to_meshes_and_to_simple_bodies_or_is_named(tmp_path):
    bands = Image.fromarray(np.repeat(np.array([[[200, 0, 0], [0, 200, 0]]], np.uint8), 2, axis=0).repeat(8, axis=1))
    (tmp_path / "m/materials/textures").mkdir(parents=True)
    bands.save(tmp_path / "m/materials/textures/bands.png")
    write(tmp_path / "m/materials/scripts/a.material", SCRIPTS)
    box, tube = "<box><size>1 2 3</size></box>", "<cylinder><radius>1</radius><length>2</length></cylinder>"
    for name, body, colours, note in (
        ("Blue", box, {(0, 0, 255)}, ""),
        ("Bands", box, {(200, 0, 0), (0, 200, 0)}, ""),
        ("Bands", tube, {(200, 0, 0), (0, 200, 0)}, ""),
        ("Lost", box, {(178, 178, 178)}, "lost.png is missing"),
        ("Gone", box, {(178, 178, 178)}, "the material script M/Gone is not had"),
        ("Shaded", box, {(178, 178, 178)}, "the material script M/Shaded is not had"),
    ):
        path = write(tmp_path / "m/model.sdf", SCRIPTED.format(body, name))
        loaded = load_posed(path, LIMITS, tmp_path)
        (part,) = loaded.shape.parts
        assert {tuple(c) for c in seen(loaded.shape)} == colours and note in "; ".join(loaded.notes), (
            name,
            loaded.notes,
        )
        assert ({file.name for file in list_files(tmp_path, path, LIMITS)} >= {"a.material"}) == (name != "Gone")
        if name == "Bands":  # from outside the left half of each side is red, with z up
            a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
            level = np.abs(np.cross(b - a, c - a)[:, 2]) < 1e-9
            right = np.cross([0.0, 0.0, 1.0], np.cross(b - a, c - a))
            u = part.uv[part.faces][..., 0]
            grows = ((b - a) * right).sum(axis=1) * (u[:, 1] - u[:, 0]) + ((c - a) * right).sum(axis=1) * (
                u[:, 2] - u[:, 0]
            )
            assert level.sum() >= 8 and (grows[level] > 0.0).all() and np.ptp(u, axis=1).max() <= 1.0


def test_the_materials_that_come_with_gazebo_have_their_colours(tmp_path):
    of_gazebo = SCRIPTED.replace("model://m/materials/scripts", "file://media/materials/scripts/gazebo.material")
    for name, colour in (("Orange", (255, 130, 12)), ("Wood", (178, 178, 178))):
        body = of_gazebo.format("<box><size>1 2 3</size></box>", name).replace("M/", "Gazebo/")
        loaded = load_posed(write(tmp_path / "model.sdf", body), LIMITS, tmp_path)
        assert {tuple(c) for c in seen(loaded.shape)} == {colour}
        assert ("Gazebo/Wood is not had" in "; ".join(loaded.notes)) == (name == "Wood"), "its picture is not here"


MESH, BOX = "<mesh><uri>cube.obj</uri></mesh>", "<box><size>1 1 1</size></box>"
GREY = "<script><uri>file://media/materials/scripts/gazebo.material</uri><name>Gazebo/Grey</name></script>"
LOST = "<script><uri>lost.material</uri><name>M/Lost</name></script>"
STATED = "<diffuse>0 1 0 1</diffuse>"


@pytest.mark.parametrize(
    ("geometry", "own", "material", "colour"),
    [
        (BOX, "", STATED, (0, 255, 0)),
        (BOX, "", GREY + STATED, (0, 255, 0)),  # as Gazebo's editor of models writes it
        (BOX, "", LOST + STATED, (0, 255, 0)),
        (MESH, "Kd 0 0 1", "", (0, 0, 255)),
        (MESH, "Kd 0 0 1", STATED, (0, 255, 0)),
        (MESH, "Kd 0 0 1", GREY + STATED, (0, 255, 0)),
        (MESH, "Kd 0 0 1", GREY, (178, 178, 178)),
        (MESH, "map_Kd skin.png", STATED, (200, 0, 0)),
        (MESH, "map_Kd skin.png", GREY + STATED, (0, 255, 0)),
        (MESH, "map_Kd skin.png", "<pbr><metal><albedo_map>other.png</albedo_map></metal></pbr>", (0, 0, 200)),
    ],
)
def test_a_colour_that_an_sdf_states_is_over_a_script_s_and_over_the_one_colour_of_a_mesh(
    geometry, own, material, colour, tmp_path
):
    for name, shown in (("skin.png", (200, 0, 0)), ("other.png", (0, 0, 200))):
        Image.fromarray(np.full((16, 16, 3), shown, np.uint8)).save(tmp_path / name)
    files = textured_obj()
    write_all(tmp_path, {**files, "cube.mtl": f"newmtl skin\n{own}\n".encode()})
    sdf = f'<sdf version="1.6"><model name="m"><link name="l"><visual name="v"><geometry>{geometry}</geometry>'
    sdf += f"<material>{material}</material>{{}}</visual></link></model></sdf>"
    loaded = load_posed(write(tmp_path / "model.sdf", sdf.format("")), LIMITS, tmp_path)
    assert {tuple(c) for c in seen(loaded.shape)} == {colour} and not loaded.notes
    faded = write(tmp_path / "model.sdf", sdf.format("<transparency>0.4</transparency>"))
    (part,) = load_posed(faded, LIMITS, tmp_path).shape.parts
    assert part.material.base_color[3] == pytest.approx(0.6)
    with pytest.raises(MeshError, match="no visual geometry"):
        load_posed(write(tmp_path / "model.sdf", sdf.format("<transparency>1</transparency>")), LIMITS, tmp_path)


def _strip_materials(tree):
    del tree["materials"], tree["meshes"][0]["primitives"][0]["material"]


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "dae"])
def test_a_picture_dresses_a_mesh_that_has_coordinates_and_no_picture_of_its_own(suffix, tmp_path):
    """As parts of Gazebo's have it: their picture is of a script, and the mesh names one that is not defined."""
    bands = np.repeat(np.array([[[200, 0, 0], [0, 200, 0]]], np.uint8), 2, axis=0)
    Image.fromarray(bands.repeat(8, axis=1).repeat(8, axis=0)).save(tmp_path / "bands.png")
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    left = np.array([[0.1, 0.1], [0.3, 0.1], [0.3, 0.9], [0.1, 0.9]])
    mesh = trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]], process=False, visual=trimesh.visual.TextureVisuals(uv=left))
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in square) + "".join(f"vt {u} {v}\n" for u, v in left)
    heads = "".join(f"property float {name}\n" for name in "xyzst")
    rows = "".join(f"{x} {y} {z} {u} {v}\n" for (x, y, z), (u, v) in zip(square, left, strict=True))
    data = {
        "obj": f"{corners}f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n",
        "ply": f"ply\nformat ascii 1.0\nelement vertex 4\n{heads}element face 1\nproperty list uchar int vertex_indices\n"
        f"end_header\n{rows}4 0 1 2 3\n",
        "glb": mesh.export(file_type="glb", tree_postprocessor=_strip_materials),
        "dae": dae(image="")["a.dae"].replace(b"<init_from></init_from>", b""),
    }
    write(tmp_path / f"m.{suffix}", data[suffix])
    dressed = visual(
        f'<mesh filename="m.{suffix}"/>', material='<material name="k"><texture filename="bands.png"/></material>'
    )
    loaded = load_posed(write(tmp_path / "a.urdf", urdf(dressed)), LIMITS, tmp_path)
    if suffix != "dae":  # which has a material of its own, and a URDF leaves that
        assert {tuple(c) for c in seen(loaded.shape)} == {(200, 0, 0)}, loaded.notes
    write(tmp_path / "a.material", "material M/Bands\n{ pass { texture_unit { texture bands.png\n } } }")
    body = SCRIPTED.format(f"<mesh><uri>m.{suffix}</uri></mesh>", "Bands").replace(
        "model://m/materials/scripts", "a.material"
    )
    loaded = load_posed(write(tmp_path / "model.sdf", body), LIMITS, tmp_path)
    colours = {(200, 0, 0), (0, 200, 0)} if suffix == "dae" else {(200, 0, 0)}
    assert {tuple(c) for c in seen(loaded.shape)} == colours and "plain base" not in "; ".join(loaded.notes)


SDF = """<sdf version="1.6"><model name="m"><pose>0 0 1 0 0 0</pose><link name="l"><pose degrees="true">1 0 0 0 0 90</pose>
<collision name="c"><geometry><mesh><uri>hull.obj</uri></mesh></geometry></collision>
<visual name="v"><pose>1 0 0 0 0 0</pose><geometry><mesh><uri>model://mug/meshes/cube.obj</uri><scale>0.1 0.2 0.3</scale></mesh>
</geometry></visual>
<visual name="w"><geometry><cylinder><radius>0.1</radius><length>0.4</length></cylinder></geometry></visual>
<visual name="x"><geometry><plane><normal>0 0 1</normal></plane></geometry></visual></link>
<model name="inner"><pose>5 0 0 0 0 0</pose><link name="k"><visual name="y"><geometry><box><size>1 2 3</size></box></geometry>
</visual></link></model></model></sdf>"""


def test_an_sdf_is_read_as_its_poses_say_and_what_it_does_not_hold_is_named(tmp_path):
    for name in ("meshes/cube.obj", "hull.obj"):
        write(tmp_path / name, CUBE)
    path = write(tmp_path / "model.sdf", SDF)
    mesh, cylinder, box = boxes(load_posed(path, LIMITS, tmp_path).shape)
    remarked = write(tmp_path / "remarked.sdf", f"<!-- of <?xml?> -->\n<!-- ours -->\n<?xml version='1.0'?>\n{SDF}")
    assert np.array_equal(boxes(load_posed(remarked, LIMITS, tmp_path).shape), [mesh, cylinder, box])
    # A quarter turn about z takes the mesh's x in [0, 0.1] and y in [0, 0.2] to y and -x, from the link's place at (1, 1, 1).
    assert mesh == pytest.approx(np.array([[0.8, 1.0, 1.0], [1.0, 1.1, 1.3]]))
    assert cylinder == pytest.approx(np.array([[0.9, -0.1, 0.8], [1.1, 0.1, 1.2]]), abs=1e-3)
    assert box == pytest.approx(np.array([[4.5, -1.0, -0.5], [5.5, 1.0, 2.5]]))
    named = {file.name for file in list_named(path, tmp_path, LIMITS)}
    assert named == {"cube.obj", "hull.obj"}, "collision shapes are parts too"


OUTLINED = """<sdf version="1.6"><model name="m"><link name="l"><pose>0 0 1 0 0 0</pose>
<collision name="c"><geometry><heightmap><uri>ground.png</uri></heightmap></geometry></collision>
<visual name="v"><geometry>{}</geometry></visual></link></model></sdf>"""


def outline(*points: tuple[float, float]) -> str:
    return f"<polyline><height>0.5</height>{''.join(f'<point>{x} {y}</point>' for x, y in points)}</polyline>"


def ring(half: float) -> list[tuple[float, float]]:
    return [(-half, -half), (half, -half), (half, half), (-half, half)]


def test_an_sdf_s_outline_stands_on_its_plane_with_its_holes_and_what_is_in_them(tmp_path):
    """Three squares in one another, one that ends where it began, and an L beside them that goes round the other way."""
    corner = [(9.0, 0.0), (9.0, 2.0), (10.0, 2.0), (10.0, 1.0), (11.0, 1.0), (11.0, 0.0)]
    drawn = [outline(*ring(3.0), ring(3.0)[0]), outline(*ring(2.0)), outline(*ring(1.0)), outline(*corner)]
    path = write(tmp_path / "model.sdf", OUTLINED.format("".join(drawn)))
    (part,) = load_posed(path, LIMITS, tmp_path).shape.parts
    mesh = trimesh.Trimesh(part.vertices, part.faces)
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.5 * (36 - 16 + 4 + 3))
    assert mesh.bounds == pytest.approx(np.array([[-3.0, -3.0, 1.0], [11.0, 3.0, 1.5]]))
    points = [(0.0, 0.0, 1.2), (1.5, 0.0, 1.2), (2.5, 0.0, 1.2), (10.5, 1.5, 1.2), (9.5, 1.5, 1.2)]
    assert mesh.contains(points).tolist() == [True, False, True, False, True]


def test_an_mjcf_is_read_with_what_it_includes_as_mujoco_has_it(tmp_path):
    write(tmp_path / "m/cube.obj", CUBE)
    write(
        tmp_path / "parts/bodies.xml",
        """<mujocoinclude><body pos="1 0 0"><geom type="mesh" mesh="c"/><include file="parts/tip.xml"/>
    </body></mujocoinclude>""",
    )
    write(tmp_path / "parts/tip.xml", '<mujoco><body pos="0 2 0"><geom type="box" size="0.1 0.2 0.3"/></body></mujoco>')
    write(
        tmp_path / "assets.xml",
        '<mujoco><compiler meshdir="m"/><asset><mesh name="c" file="cube.obj"/></asset></mujoco>',
    )
    path = write(
        tmp_path / "a.xml",
        """<mujoco><include file="assets.xml"/><worldbody><include file="parts/bodies.xml"/>
    </worldbody></mujoco>""",
    )
    ours = boxes(load_posed(path, LIMITS, tmp_path).shape)
    assert np.allclose(ours, seen_by_mujoco(path), atol=1e-6) and len(ours) == 2
    files = {file.name for file in list_files(tmp_path, path, LIMITS)}
    assert files == {"a.xml", "assets.xml", "bodies.xml", "tip.xml", "cube.obj"}
    assert files - {"a.xml"} == {file.name for file in list_named(path, tmp_path, LIMITS)}, "parts, and no objects"


STANDING = """<visual><origin xyz="0 0 0.5"/><geometry><mesh filename="stick.glb" scale=".5"/></geometry></visual>
<visual><geometry><sphere radius="0"/></geometry></visual><collision><origin xyz="0 0 0.5"/><geometry>{}</geometry></collision>"""


def test_a_gltf_in_a_urdf_or_sdf_is_turned_as_its_collision_shapes_say_or_else_as_its_programs_do(tmp_path):
    trimesh.creation.box(bounds=[[0, 0, 0], [0.1, 1.0, 0.2]]).export(tmp_path / "stick.glb")  # y up
    trimesh.creation.box(bounds=[[0, -0.2, 0], [0.1, 0, 1.0]]).export(tmp_path / "upright.stl")
    lying, standing = [[0, 0, 0.5], [0.05, 0.5, 0.6]], [[0, -0.1, 0.5], [0.05, 0, 1.0]]
    sdf = "<sdf><model><link>{}</link></model></sdf>"
    for name, collides, expected in (
        ("a.urdf", '<mesh filename="upright.stl" scale=".5 .5 .5"/>', standing),
        ("b.urdf", '<box size="0.05 1 0.2"/>', lying),
        ("c.urdf", '<mesh filename="stick.glb" scale="0.5"/>', standing),
        ("d.urdf", '<mesh filename="lost.stl"/>', standing),
        ("e.urdf", '<box size="nothing"/>', standing),
        ("f.sdf", '<mesh filename="stick.glb"/>', lying),
        ("h.sdf", '<mesh filename="package://all/stick.glb"/>', standing),
        ("g.sdf", '<mesh filename="upright.stl" scale=".5 .5 .5"/>', standing),
    ):
        links = STANDING.format(collides)
        if name.endswith("sdf"):
            links = re.sub(r'<origin xyz="([^"]*)"/>', r"<pose>\1 0 0 0</pose>", links)
            links = re.sub(
                r'<mesh filename="([^"]*)"(?: scale="[^"]*")?/>', r"<mesh><uri>\1</uri><scale>.5</scale></mesh>", links
            )
            links = links.replace('<sphere radius="0"/>', "<sphere><radius>0</radius></sphere>")
        path = write(tmp_path / name, urdf(links) if name.endswith("urdf") else sdf.format(links))
        (box,) = boxes(load_posed(path, LIMITS, tmp_path).shape)
        assert box == pytest.approx(np.array(expected), abs=1e-6), name
    read = {file.name for file in list_files(tmp_path, tmp_path / "a.urdf", LIMITS)}
    assert read == {"a.urdf", "stick.glb", "upright.stl"}, "what decides is part of what was read"


@pytest.mark.parametrize("joint", ["<freejoint/>", '<joint type="free"/>'])
def test_of_an_mjcf_s_world_the_one_body_that_moves_freely_is_the_object(tmp_path, joint):
    alone = f"""<body pos="0 0 0.5" euler="0 0 30">{joint}<geom type="box" size="0.1 0.2 0.3"/>
        <frame pos="1 0 0"><body><joint/><geom type="box" size="0.1 0.1 0.1"/></body></frame></body>"""
    table = """<geom type="plane" size="1 1 1"/><geom type="box" size="1 1 0.1"/>
        <body><geom type="box" size="3 3 0.1"/><body><joint/><geom type="box" size="2 2 2"/></body></body>"""
    bare = write(tmp_path / "bare.xml", f"<mujoco><worldbody>{alone}</worldbody></mujoco>")
    write(tmp_path / "table.xml", f"<mujoco><worldbody>{table}</worldbody></mujoco>")
    for name, inside in (("around", table + alone), ("frame", f'<frame pos="0 0 0">{alone}<geom size="1"/></frame>')):
        path = write(tmp_path / f"{name}.xml", f"<mujoco><worldbody>{inside}</worldbody></mujoco>")
        ours = load_posed(path, LIMITS, tmp_path)
        assert np.allclose(boxes(ours.shape), seen_by_mujoco(bare, group=0)) and len(ours.shape.parts) == 2
        assert ours.notes == ("only its free body is used, and not the world around it",)
    assert load_posed(bare, LIMITS, tmp_path).notes == ()
    assert len(load_posed(tmp_path / "table.xml", LIMITS, tmp_path).shape.parts) == 3


WRONG = (
    (
        "a.xml",
        f"<mujoco><worldbody>{'<body><freejoint/><geom/></body>' * 2}</worldbody></mujoco>",
        "format",
        "is a world of 2 bodies that move freely, and no object: write each into a file of its own",
    ),
    ("a.sdf", "<sdf><world><model/></world></sdf>", "format", "is a world, and no object"),
    (
        "a.sdf",
        SDF.replace("<pose>1 0 0 0 0 0", '<pose relative_to="k">1 0 0 0 0 0'),
        "format",
        "relative to other frames",
    ),
    (
        "a.sdf",
        SDF.replace("<cylinder>", "<torus>").replace("</cylinder>", "</torus>"),
        "unreadable",
        "<torus> is not known",
    ),
    ("a.sdf", OUTLINED.format(outline((0, 0), (1, 1), (1, 0), (0, 1))), "unreadable", "crosses itself"),
    ("a.sdf", OUTLINED.format(outline(*ring(1)) + outline((0, 0), (2, 0), (2, 2))), "unreadable", "or another one"),
    ("a.sdf", OUTLINED.format(outline((0, 0), (1, 1))), "unreadable", "encloses nothing"),
    ("a.sdf", OUTLINED.format("<heightmap/>"), "format", "has <heightmap>, which is not read"),
    ("a.sdf", "<sdf/>", "no_faces", "no visual geometry"),
    ("a.xml", "<mujoco/>", "no_faces", "no visual geometry"),
    ("a.xml", '<mujoco><include file="b.xml"/></mujoco>', "missing", "names 'b.xml'"),
    ("a.xml", '<mujoco><include file="a.xml"/></mujoco>', "unreadable", "includes a.xml twice"),
    ("a.xml", '<mujoco><attach file="b.xml"/></mujoco>', "format", "has <attach>"),
    (
        "a.xml",
        '<mujoco><worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>',
        "unreadable",
        "no file of the mesh 'm'",
    ),
    (
        "a.xml",
        '<mujoco><worldbody><geom type="box" size="1 1"/></worldbody></mujoco>',
        "unreadable",
        "is not 3 positive",
    ),
    ("a.xml", '<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>', "no_faces", "no visual"),
    (
        "a.xml",
        f"<mujoco><worldbody>{'<body>' * 300}{'</body>' * 300}</worldbody></mujoco>",
        "unreadable",
        "more than 256 bodies",
    ),
    ("a.xml", "<robot/>", "unreadable", "its root is <robot>"),
    ("a.xml", f"<mujoco><worldbody>{'<geom/>' * 9000}</worldbody></mujoco>", "too_large", "9000 geoms, over max_nodes"),
    ("a.msh", b"$MeshFormat\n4.1 0 8", "format", "a mesh of Gmsh"),
    ("a.msh", struct.pack("<4i", 3, 0, 0, 1), "unreadable", "does not tell its length"),
    ("a.msh", struct.pack("<4i", -3, 0, 0, 1), "unreadable", "does not tell its length"),
)


@pytest.mark.parametrize(("name", "text", "reason", "words"), WRONG)
def test_what_cannot_be_read_of_them_is_one_reason(tmp_path, name, text, reason, words):
    path = write(tmp_path / name, text)
    with pytest.raises(MeshError, match=words) as caught:
        load_posed(path, LIMITS, tmp_path) if name != "a.msh" else load_shape(path, LIMITS)
    assert caught.value.reason == reason


def test_names_are_found_by_every_tail_of_them_in_the_folders_above_and_never_outside(tmp_path):
    root, path = tmp_path / "in", tmp_path / "in/robot/urdf/r.urdf"
    for name in ("robot/meshes/a.obj", "robot/urdf/b.obj", "c.obj", "textures/d.png", "my robot/e.stl", "100%20.obj"):
        write(root / name, "")
    write(tmp_path / "out.obj", "")
    for name, found in (
        ("package://robot/meshes/a.obj", "robot/meshes/a.obj"),
        ("package://other_name/meshes/a.obj", "robot/meshes/a.obj"),
        ("/home/me/robot/meshes/a.obj", "robot/meshes/a.obj"),
        ("..\\meshes\\a.obj", "robot/meshes/a.obj"),
        ("b.obj", "robot/urdf/b.obj"),
        ("model://x/y/c.obj", "c.obj"),
        ("../../textures/d.png", "textures/d.png"),
        ("package://pkg/my%20robot/e.stl", "my robot/e.stl"),
        ("100%20.obj", "100%20.obj"),
    ):
        assert Source(path, root, LIMITS).demand(name) == root / found
    for name in ("../../../out.obj", str(tmp_path / "out.obj"), "", "x" * 9999, "a" + "/x" * 500, "gone.obj"):
        with pytest.raises(MeshError, match="is not inside"):
            Source(path, root, LIMITS).demand(name)


def test_mujocos_own_meshes_are_read(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    uv = np.random.default_rng(0).random((8, 2))
    head = struct.pack("<4i", 8, 8, 8, 12)
    blocks = (box.vertices, box.vertex_normals, uv, box.faces)
    kinds = ("<f4", "<f4", "<f4", "<i4")
    data = head + b"".join(np.asarray(b).astype(kind).tobytes() for b, kind in zip(blocks, kinds, strict=True))
    shape = load_shape(write(tmp_path / "a.msh", data), LIMITS).shape
    assert shape.closed and np.ptp(shape.vertices, axis=0) == pytest.approx([0.1, 0.2, 0.3])
    (part,) = shape.parts
    theirs = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="a" file="a.msh"/></asset><worldbody><geom type="mesh" mesh="a"/></worldbody></mujoco>',
        {"a.msh": data},
    )
    assert theirs.mesh_facenum[0] == len(part.faces) == 12
    near = np.linalg.norm(part.vertices[:, None] - box.vertices, axis=2).argmin(axis=1)
    assert part.uv == pytest.approx(np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])[near], abs=1e-6)


def test_collada_in_a_urdf_is_in_metres_and_not_turned_up(tmp_path):
    """As RViz has it: its unit holds, and `up_axis`, which is y here, does not. The picture is found beside the mesh."""
    files = dae(asset='<unit meter="0.5"/><up_axis>Y_UP</up_axis>', shapes=geometry(size=2.0, stretch=(1, 2, 3)))
    write_all(tmp_path / "meshes/visual", files)
    path = write(tmp_path / "a.urdf", urdf(visual('<mesh filename="package://r/meshes/visual/a.dae" scale="1 1 2"/>')))
    assert [file.name for file in list_files(tmp_path, path, LIMITS)] == ["a.urdf", "a.dae", "t.png"]
    shape = load_posed(path, LIMITS, tmp_path).shape
    assert np.ptp(shape.vertices, axis=0) == pytest.approx([0.2, 0.4, 1.2])
    assert shape.parts[0].material.texture is not None
    heads = {"<up_axis>Y_UP</up_axis>": "y", "<up_axis>\n Z_UP</up_axis>": "z", "<up_axis>X_UP</up_axis>": "x", "": "y"}
    assert {head: find_up(head.encode()) for head in heads} == heads
