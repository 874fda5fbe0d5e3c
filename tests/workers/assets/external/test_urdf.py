"""URDF files: where their geometry stands, and what is refused."""

import math

import numpy as np
import pytest
import trimesh

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import CUBE, welded, write
from workers.assets.external.urdf import find_mesh, load_urdf, parse_urdf


def urdf(folder, body, name="a.urdf"):
    return write(folder / name, f'<?xml version="1.0"?><robot name="r">{body}</robot>')


def visual(geometry, origin="", material=""):
    return f"<visual>{origin}<geometry>{geometry}</geometry>{material}</visual>"


def link(inside):
    return f'<link name="l">{inside}</link>'


def load(path, **limits):
    return load_urdf(path, MeshLimits(**limits), path.parent).shape


def refused(path, **limits):
    with pytest.raises(MeshError) as error:
        load(path, **limits)
    return error.value.reason


def test_a_mesh_is_scaled_then_turned_then_shifted(tmp_path):
    write(tmp_path / "cube.obj", CUBE)
    origin = f'<origin xyz="10 0 0" rpy="0 0 {math.pi / 2}"/>'
    body = link(visual('<mesh filename="cube.obj" scale="1 2 3"/>', origin))
    shape = load(urdf(tmp_path, body))
    # x goes to y and y to -x: [0, 1] x [0, 2] x [0, 3] becomes [-2, 0] x [0, 1] x [0, 3], then x is moved by 10.
    assert shape.bounds == pytest.approx(np.array([[8, 0, 0], [10, 1, 3]]))
    assert welded(shape).volume == pytest.approx(6.0)


def test_roll_pitch_yaw_turn_about_the_fixed_axes_in_this_order(tmp_path):
    body = link(visual('<box size="2 4 6"/>', '<origin rpy="0.3 0.5 0.7"/>'))
    expected = trimesh.creation.box((2, 4, 6), transform=trimesh.transformations.euler_matrix(0.3, 0.5, 0.7, "sxyz"))
    assert load(urdf(tmp_path, body)).bounds == pytest.approx(expected.bounds)


def test_primitives_have_the_volumes_of_the_textbook(tmp_path):
    cylinder = '<cylinder radius="0.5" length="2"/>'
    for geometry, volume in (
        ('<box size="1 2 3"/>', 6.0),
        (cylinder, math.pi * 0.25 * 2),
        ('<sphere radius="0.5"/>', math.pi / 6),
    ):
        shape = load(urdf(tmp_path, f'<link name="l">{visual(geometry)}</link>'))
        assert welded(shape).volume == pytest.approx(volume, rel=0.01)
    tall = load(urdf(tmp_path, f'<link name="l">{visual(cylinder)}</link>'))
    assert tall.bounds[:, 2] == pytest.approx([-1, 1])


def test_links_stand_where_their_joints_put_them(tmp_path):
    box = visual('<box size="1 1 1"/>')
    joint = (
        '<joint name="{0}{1}" type="fixed"><parent link="{0}"/><child link="{1}"/>'
        '<origin xyz="0 0 2" rpy="{2} 0 0"/></joint>'
    )
    links = "".join(f'<link name="{name}">{box}</link>' for name in "abc")
    shape = load(urdf(tmp_path, links + joint.format("b", "c", 0) + joint.format("a", "b", math.pi / 2)))
    # b stands 2 above a and is turned about x: its own up, along which c stands 2 further, is -y.
    middles = np.array([part.vertices.mean(axis=0) for part in shape.parts])
    assert middles == pytest.approx(np.array([[0, 0, 0], [0, 0, 2], [0, -2, 2]]), abs=1e-12)


def test_joints_that_go_round_in_a_circle_are_refused(tmp_path):
    joint = '<joint name="{0}{1}"><parent link="{0}"/><child link="{1}"/></joint>'
    body = '<link name="a"/><link name="b"/>' + joint.format("a", "b") + joint.format("b", "a")
    assert refused(urdf(tmp_path, body)) == "unreadable"


def test_the_colour_of_the_urdf_goes_on_what_brings_none(tmp_path):
    own = '<material name="m"><color rgba="1 0.2 0 1"/></material>'
    body = link(visual('<box size="1 1 1"/>', material=own))
    assert load(urdf(tmp_path, body)).parts[0].material.base_color == (1.0, 0.2, 0.0, 1.0)
    named = '<material name="m"/>'
    body = own + link(visual('<box size="1 1 1"/>', material=named))
    assert load(urdf(tmp_path, body)).parts[0].material.base_color == (1.0, 0.2, 0.0, 1.0)


def test_a_document_type_or_an_entity_is_refused(tmp_path):
    bomb = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="r"><link name="&b;"/></robot>'
    assert refused(write(tmp_path / "bomb.urdf", bomb)) == "unreadable"
    assert refused(write(tmp_path / "wide.urdf", bomb.encode("utf-16"))) == "unreadable"
    comment = '<!-- fine --><link name="l">' + visual('<box size="1 1 1"/>') + "</link>"
    assert load(urdf(tmp_path, comment)).parts


def test_a_mesh_outside_the_folder_is_not_read(tmp_path):
    write(tmp_path / "cube.obj", CUBE)
    inner = urdf(tmp_path / "inner", "")
    for name in ("../cube.obj", str(tmp_path / "cube.obj"), "file://" + str(tmp_path / "cube.obj"), "bad\0.obj"):
        with pytest.raises(MeshError, match="not inside"):
            find_mesh(name, inner, tmp_path / "inner")
    assert find_mesh("../cube.obj", inner, tmp_path) == tmp_path / "cube.obj"
    assert find_mesh("package://thing/cube.obj", inner, tmp_path) == tmp_path / "cube.obj"


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('<link name="l"/>', "no_faces"),
        ('<link name="l"><visual><geometry/></visual></link>', "unreadable"),
        ('<link name="l">' + visual('<box size="1 x 1"/>') + "</link>", "unreadable"),
        ('<link name="l">' + visual('<box size="1 -1 1"/>') + "</link>", "unreadable"),
        ('<link name="l">' + visual('<mesh filename="none.obj"/>') + "</link>", "missing"),
        ('<link name="l">' + visual("<torus/>") + "</link>", "unreadable"),
    ],
)
def test_a_broken_urdf_is_refused_with_a_word_that_says_why(tmp_path, body, reason):
    assert refused(urdf(tmp_path, body)) == reason


def test_the_caps_hold_for_all_visuals_together(tmp_path):
    body = '<link name="l">' + 3 * visual('<box size="1 1 1"/>') + "</link>"
    assert refused(urdf(tmp_path, body), max_faces=35) == "too_large"
    assert load(urdf(tmp_path, body), max_faces=36).parts


def test_what_is_no_urdf_is_refused(tmp_path):
    for text in ("<sdf/>", "no xml", "<robot>"):
        with pytest.raises(MeshError):
            parse_urdf(write(tmp_path / "x.urdf", text), MeshLimits())
