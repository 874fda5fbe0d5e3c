"""Points, winding and bodies, against trimesh and by hand; and what becomes of a broken mesh."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import CUBE, shape_of, welded, write
from workers.assets.external.formats import load_shape
from workers.assets.external.mesh import (
    find_bodies,
    find_collapsed,
    find_flips,
    find_repeated,
    is_solid,
    merge_points,
    transform_shape,
)
from workers.geometry.frames import pose


def soup(mesh):
    """Every face with corners of its own."""
    return mesh.vertices[mesh.faces.ravel()], np.arange(3 * len(mesh.faces)).reshape(-1, 3)


def test_points_at_one_place_get_one_number_and_others_do_not():
    vertices, _ = soup(trimesh.creation.icosphere(2))
    assert len(np.unique(merge_points(vertices))) == 162
    assert len(np.unique(merge_points(np.array([[0.0, 0, 0], [1e-10, 0, 0], [1e-4, 0, 0], [1, 1, 1]])))) == 3


def test_a_collapsed_face_and_a_doubled_face_are_found():
    faces = np.array([[0, 1, 2], [1, 2, 0], [2, 1, 0], [3, 3, 1], [0, 1, 3]])
    assert find_collapsed(faces).tolist() == [False, False, False, True, False]
    assert find_repeated(faces, oriented=True).tolist() == [False, True, False, False, False]
    assert find_repeated(faces, oriented=False).tolist() == [False, True, True, False, False]


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_turning_the_faces_that_disagree_makes_a_sphere_consistent_with_the_fewest_flips(share):
    mesh = trimesh.creation.icosphere(3)
    wrong = np.random.default_rng(0).random(len(mesh.faces)) < share
    faces = np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces)
    assert find_flips(faces).tolist() == wrong.tolist()


def test_a_moebius_strip_is_left_alone():
    n = 20
    lower, upper = np.arange(n), np.arange(n, 2 * n)
    nxt_lower, nxt_upper = np.append(lower[1:], upper[0]), np.append(upper[1:], lower[0])
    faces = np.concatenate([np.stack([lower, nxt_lower, nxt_upper], 1), np.stack([lower, nxt_upper, upper], 1)])
    assert not find_flips(faces).any()


def test_bodies_are_told_apart_with_the_volume_of_each():
    one, two = trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(3, 0.5)
    two.apply_translation((5, 0, 0))
    sheet = trimesh.Trimesh([[9, 0, 0], [9, 1, 0], [9, 0, 1]], [[0, 1, 2]], process=False)
    whole = trimesh.util.concatenate([one, two, sheet])
    bodies = find_bodies(whole.vertices, whole.faces, whole.faces)
    assert bodies.closed.tolist() == [True, True, False]
    assert bodies.volume[:2] == pytest.approx([one.volume, two.volume], rel=1e-12)
    assert np.bincount(bodies.body).tolist() == [12, len(two.faces), 1]


def test_only_a_closed_and_consistent_mesh_with_volume_is_solid():
    mesh = trimesh.creation.icosphere(2)
    vertices, faces = soup(mesh)
    assert is_solid(vertices, faces)
    assert not is_solid(vertices, faces[1:])
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert not is_solid(vertices, turned)
    assert not is_solid(vertices, faces[:, ::-1])  # inside out
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert not is_solid(flat, np.array([[0, 1, 2], [2, 1, 0]]))  # closed, but two sides of nothing


LIMITS = MeshLimits()
SHARED = Path(__file__).resolve().parents[5] / "shared" / "data" / "meshes"


def load(path, **limits):
    return load_shape(path, MeshLimits(**limits))


def refused(path, **limits):
    with pytest.raises(MeshError) as error:
        load(path, **limits)
    return error.value.reason


def test_a_cube_comes_in_as_twelve_faces_around_a_volume_of_one(tmp_path):
    loaded = load(write(tmp_path / "cube.obj", CUBE))
    assert len(loaded.shape.faces) == 12
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert welded(loaded.shape).volume == pytest.approx(1.0)
    assert loaded.notes == ()


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb"])
def test_every_format_gives_the_same_geometry(tmp_path, suffix):
    mesh = trimesh.creation.icosphere(2, 0.1)
    mesh.export(tmp_path / f"ball.{suffix}")
    loaded = load(tmp_path / f"ball.{suffix}")
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert welded(loaded.shape).volume == pytest.approx(mesh.volume, rel=1e-5)
    assert len(loaded.shape.faces) == len(mesh.faces)


def test_arrays_are_read_only_and_of_the_types_that_the_schema_names(tmp_path):
    part = load(write(tmp_path / "cube.obj", CUBE)).shape.parts[0]
    assert part.vertices.dtype == np.float64
    assert part.faces.dtype == np.int32
    with pytest.raises(ValueError, match="read-only"):
        part.vertices[0] = 1


def test_doubled_and_collapsed_faces_go_and_unused_vertices_with_them(tmp_path):
    text = CUBE + "v 50 50 50\nf 1 4 3\nf 3 4 1\nf 1 1 2\n"
    loaded = load(write(tmp_path / "cube.obj", text))
    assert len(loaded.shape.faces) == 12
    assert loaded.shape.bounds[1] == pytest.approx([1, 1, 1])
    assert "doubled or empty" in loaded.notes[0]


def test_faces_wound_every_which_way_come_out_facing_outwards(tmp_path):
    mesh = trimesh.creation.icosphere(2)
    wrong = np.random.default_rng(1).random(len(mesh.faces)) < 0.5
    mesh = trimesh.Trimesh(mesh.vertices, np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces), process=False)
    mesh.export(tmp_path / "ball.ply")
    loaded = load(tmp_path / "ball.ply")
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert welded(loaded.shape).volume == pytest.approx(trimesh.creation.icosphere(2).volume, rel=1e-6)


def test_a_body_that_is_inside_out_is_turned_but_a_void_stays_one(tmp_path):
    outer, void, aside = (trimesh.creation.box((s, s, s)) for s in (1.0, 0.5, 0.2))
    void.invert()
    aside.apply_translation((3, 0, 0))
    aside.invert()
    trimesh.util.concatenate([outer, void, aside]).export(tmp_path / "bodies.stl")
    loaded = load(tmp_path / "bodies.stl")
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert welded(loaded.shape).volume == pytest.approx(1.0 - 0.125 + 0.008, rel=1e-6)


def test_two_solids_that_touch_keep_both_of_the_faces_between_them(tmp_path):
    one, two = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    across = np.diag([-1.0, 1.0, 1.0, 1.0])
    across[0, 3] = 1.0
    two.apply_transform(across)  # mirrored in the plane x = 0.5, so that the faces between them are the same triangles
    trimesh.util.concatenate([one, two]).export(tmp_path / "pair.stl")
    loaded = load(tmp_path / "pair.stl")
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert len(loaded.shape.faces) == 24


def test_a_sheet_drawn_from_both_sides_is_one_sheet(tmp_path):
    loaded = load(
        write(tmp_path / "sheet.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\nf 3 2 1\nf 4 3 1\n")
    )
    assert len(loaded.shape.faces) == 2
    assert not is_solid(loaded.shape.vertices, loaded.shape.faces)


def test_every_geometry_of_a_scene_stands_where_its_node_puts_it_and_mirrored_ones_face_outwards(tmp_path):
    scene = trimesh.Scene()
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[:3, 3] = (-5, 0, 0)
    scene.add_geometry(trimesh.creation.box((1, 2, 3)), node_name="a", geom_name="g")
    scene.graph.update(frame_to="b", frame_from="world", matrix=mirror, geometry="g")
    write(tmp_path / "scene.glb", scene.export(file_type="glb"))
    loaded = load(tmp_path / "scene.glb")
    assert is_solid(loaded.shape.vertices, loaded.shape.faces)
    assert welded(loaded.shape).volume == pytest.approx(12.0, rel=1e-6)
    assert loaded.shape.bounds == pytest.approx(np.array([[-5.5, -1, -1.5], [0.5, 1, 1.5]]))


def test_a_mirrored_sheet_still_faces_the_same_way(tmp_path):
    scene = trimesh.Scene()
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    scene.add_geometry(sheet, transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    part = load(write(tmp_path / "sheet.glb", scene.export(file_type="glb"))).shape.parts[0]
    a, b, c = part.vertices[part.faces[0]]
    assert np.cross(b - a, c - a) == pytest.approx([0, 0, 1])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "index_out_of_range"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not_finite"),
        ("v 0 0 inf\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not_finite"),
        ("v 0 0 1e30\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not_finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no_faces"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 1 2\n", "no_faces"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no_faces"),
        ("", "no_faces"),
        ("v 0 0 0\nf a b c\n", "unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\n", "unreadable"),
    ],
)
def test_a_broken_obj_is_refused_with_a_word_that_says_why(tmp_path, text, reason):
    assert refused(write(tmp_path / "broken.obj", text)) == reason


def test_other_broken_files_are_refused_and_never_crash(tmp_path):
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(1)
    for suffix in ("obj", "stl", "ply", "glb"):
        good = ball.export(file_type=suffix)
        data = good.encode() if isinstance(good, str) else good
        for trial in range(25):
            bad = bytearray(data[: int(rng.integers(1, len(data)))] if trial % 2 else data)
            for position in rng.integers(0, len(bad), 6):
                bad[position] = int(rng.integers(256))
            path = write(tmp_path / f"bad{trial}.{suffix}", bytes(bad))
            try:
                loaded = load(path)
            except MeshError:
                continue
            assert np.isfinite(loaded.shape.vertices).all()
            assert loaded.shape.faces.max() < len(loaded.shape.vertices)


def test_a_file_over_a_cap_is_refused_before_it_is_parsed(tmp_path):
    path = write(tmp_path / "cube.obj", CUBE)
    assert refused(path, max_vertices=7) == "too_large"
    assert refused(path, max_faces=5) == "too_large"
    assert refused(path, max_file_mb=1e-5) == "too_large"
    trimesh.creation.icosphere(3).export(tmp_path / "ball.stl")
    assert refused(tmp_path / "ball.stl", max_faces=1279) == "too_large"
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n"
    assert refused(write(tmp_path / "huge.ply", header)) == "unreadable"


def test_a_missing_file_and_a_foreign_format_are_refused(tmp_path):
    assert refused(tmp_path / "none.obj") == "missing"
    assert refused(write(tmp_path / "a.dae", "<x/>")) == "format"


def test_slivers_without_area_go_unless_they_close_a_gap(tmp_path):
    # The lower edge of the front has a point in its middle on one side only; a face without area joins the two.
    text = CUBE.replace("f 1 2 6 5", "v 0.5 0 0\nf 1 9 5\nf 9 2 6\nf 9 6 5\nf 1 2 9")
    closed = load(write(tmp_path / "closed.obj", text))
    assert is_solid(closed.shape.vertices, closed.shape.faces)
    assert welded(closed.shape).is_watertight
    sheet = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.5 0 0\nf 1 2 3\nf 1 4 2\n"
    assert len(load(write(tmp_path / "sheet.obj", sheet)).shape.faces) == 1


def test_a_glb_that_shows_a_mesh_too_often_is_refused_unparsed(tmp_path, monkeypatch):
    scene = trimesh.Scene()
    for k in range(20):
        scene.add_geometry(trimesh.creation.box((1, 1, 1)), node_name=f"n{k}", geom_name="same") if k == 0 else (
            scene.graph.update(frame_to=f"n{k}", frame_from="world", matrix=np.eye(4), geometry="same")
        )
    path = write(tmp_path / "many.glb", scene.export(file_type="glb"))
    with monkeypatch.context() as patch:
        patch.setattr(trimesh, "load_scene", None)
        assert refused(path, max_faces=20 * 12 - 1) == "too_large"
    assert len(load(path, max_faces=20 * 12).shape.faces) == 12  # and what lies in one place is one


def test_a_mirroring_transform_keeps_a_solid_the_right_way_out():
    shape = shape_of(trimesh.creation.box((1, 2, 3)))
    mirrored = transform_shape(shape, pose(np.diag([-1.0, 1.0, 2.0]), np.array([1.0, 0, 0])))
    assert welded(mirrored).volume == pytest.approx(12.0)
    assert mirrored.bounds == pytest.approx(np.array([[0.5, -1, -3], [1.5, 1, 3]]))


def test_shading_normals_of_the_file_follow_the_surface_and_point_outwards(tmp_path):
    mesh = trimesh.creation.icosphere(2)
    normals = -mesh.vertices  # the file has them inside out
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"vn {x} {y} {z}" for x, y, z in normals]
    lines += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in face) for face in mesh.faces]
    part = load(write(tmp_path / "ball.obj", "\n".join(lines) + "\n")).shape.parts[0]
    assert part.normals == pytest.approx(part.vertices, abs=1e-6)


@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["blue_cup", "bowl", "cracker_box", "mug", "shampoo"])
def test_a_scanned_thing_comes_in_closed_with_a_volume_that_its_own_collision_mesh_confirms(name):
    scanned = load_shape(SHARED / name / "textured.obj", LIMITS)
    coarse = load_shape(SHARED / name / "collision.obj", LIMITS)
    assert is_solid(scanned.shape.vertices, scanned.shape.faces)
    hulls = [trimesh.Trimesh(x.shape.vertices, x.shape.faces).convex_hull.volume for x in (scanned, coarse)]
    assert hulls[0] == pytest.approx(hulls[1], rel=0.2)
    assert welded(scanned.shape).volume <= hulls[0]


@pytest.mark.shared_data
def test_scanned_things_without_their_texture_come_in_plain_with_a_note():
    notes = {name: load_shape(SHARED / name / "textured.obj", LIMITS).notes for name in ("mug", "blue_cup")}
    assert any("texture_map.png is missing" in note for note in notes["mug"])
    assert notes["blue_cup"] == ()
