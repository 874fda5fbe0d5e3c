"""Meshes mended, weighed and placed: winding, bodies and voids, mass by the textbook, and the axis that is up."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from shapely import Polygon

from schemas.job.assets import CATEGORIES, TABLE, MeshLimits, ProceduralSource
from tests.kit.shapes import shape_of
from tests.workers.assets.libraries import open_folder
from tests.workers.door.oracles import CUBE, support_margin, welded, write
from workers.assets.builtin.make import make_asset
from workers.assets.library.placement import Upright, find_upright, measure_stand, rests
from workers.assets.library.reading import UP_AXES, place_asset
from workers.assets.library.table import Row
from workers.assets.mass import mass_properties, shell_mass, weigh
from workers.door.meshes.formats import load_shape
from workers.door.meshes.mesh import LoadedMesh, find_flips, is_solid, transform_shape
from workers.geometry.frames import pose
from workers.geometry.hull import convex_hull

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "meshes"


def soup(mesh):
    """Every face with corners of its own."""
    return mesh.vertices[mesh.faces.ravel()], np.arange(3 * len(mesh.faces)).reshape(-1, 3)


def load(path, mesh=None):
    """What is read of a file; `mesh`: written there first."""
    if mesh is not None:
        mesh.export(path)
    return load_shape(path, MeshLimits())


def solid(shape) -> bool:
    return is_solid(shape.vertices, shape.faces)


def test_turning_the_faces_that_disagree_takes_the_fewest_flips_and_leaves_a_moebius_strip_alone():
    mesh = trimesh.creation.icosphere(3)
    for share in (0.1, 0.4):
        wrong = np.random.default_rng(0).random(len(mesh.faces)) < share
        faces = np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces)
        assert find_flips(faces).tolist() == wrong.tolist()
    lower, upper = np.arange(20), np.arange(20, 40)
    next_lower, next_upper = np.append(lower[1:], upper[0]), np.append(upper[1:], lower[0])
    strip = np.concatenate([np.stack([lower, next_lower, next_upper], 1), np.stack([lower, next_upper, upper], 1)])
    assert not find_flips(strip).any()


def test_only_a_closed_and_consistent_mesh_with_volume_is_solid():
    vertices, faces = soup(trimesh.creation.icosphere(2))
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert is_solid(vertices, faces)
    assert not any(is_solid(vertices, other) for other in (faces[1:], turned, faces[:, ::-1]))
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert not is_solid(flat, np.array([[0, 1, 2], [2, 1, 0]])), "closed, but two sides of nothing"


# ------------------------------------------------------------------------------------------------ what becomes of a file


def test_a_cube_comes_in_as_twelve_faces_and_what_is_doubled_collapsed_or_unused_goes(tmp_path):
    text = CUBE + "v 50 50 50\nf 1 4 3\nf 3 4 1\nf 1 1 2\n"
    for content, mended in ((CUBE, ()), (text, ("3 doubled or empty faces dropped",))):
        loaded = load(write(tmp_path / "cube.obj", content))
        assert len(loaded.shape.faces) == 12 and solid(loaded.shape) and loaded.notes == mended
        assert loaded.shape.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    (part,) = loaded.shape.parts
    assert (part.vertices.dtype, part.faces.dtype) == (np.float64, np.int32)
    assert not part.vertices.flags.writeable and not part.faces.flags.writeable


def test_bodies_come_out_facing_outwards_but_a_void_stays_one(tmp_path):
    ball = trimesh.creation.icosphere(2)
    wrong = np.random.default_rng(1).random(len(ball.faces)) < 0.5
    mixed = trimesh.Trimesh(ball.vertices, np.where(wrong[:, None], ball.faces[:, ::-1], ball.faces), process=False)
    outer, void, aside = (trimesh.creation.box((s, s, s)) for s in (1.0, 0.5, 0.2))
    void.invert()
    aside.apply_translation((3, 0, 0))
    aside.invert()
    bodies = trimesh.util.concatenate([outer, void, aside])
    for name, mesh, volume in (("ball.ply", mixed, ball.volume), ("bodies.stl", bodies, 1.0 - 0.125 + 0.008)):
        shape = load(tmp_path / name, mesh).shape
        assert solid(shape) and welded(shape).volume == pytest.approx(volume, rel=1e-6)


def test_two_solids_that_touch_keep_both_faces_between_them_and_a_sheet_of_two_sides_is_one(tmp_path):
    one, two = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    across = np.diag([-1.0, 1.0, 1.0, 1.0])
    across[0, 3] = 1.0
    two.apply_transform(across)  # mirrored in the plane x = 0.5, so that the faces between them are the same triangles
    shape = load(tmp_path / "pair.stl", trimesh.util.concatenate([one, two])).shape
    assert solid(shape) and len(shape.faces) == 24
    sheet = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\nf 3 2 1\nf 4 3 1\n"
    shape = load(write(tmp_path / "sheet.obj", sheet)).shape
    assert len(shape.faces) == 2 and not solid(shape)


def test_slivers_without_area_go_where_they_close_nothing(tmp_path):
    sheet = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.5 0 0\nf 1 2 3\nf 1 4 2\n"
    assert len(load(write(tmp_path / "sheet.obj", sheet)).shape.faces) == 1


def test_a_mirroring_transform_keeps_a_solid_the_right_way_out():
    shape = shape_of(trimesh.creation.box((1, 2, 3)))
    mirrored = transform_shape(shape, pose(np.diag([-1.0, 1.0, 2.0]), np.array([1.0, 0, 0])))
    assert welded(mirrored).volume == pytest.approx(12.0)
    assert mirrored.bounds == pytest.approx(np.array([[0.5, -1, -3], [1.5, 1, 3]]))


def test_shading_normals_of_the_file_follow_the_surface_and_point_outwards(tmp_path):
    mesh = trimesh.creation.icosphere(2)  # the file has its normals inside out
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"vn {-x} {-y} {-z}" for x, y, z in mesh.vertices]
    lines += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in face) for face in mesh.faces]
    part = load(write(tmp_path / "ball.obj", "\n".join(lines) + "\n")).shape.parts[0]
    assert part.normals == pytest.approx(part.vertices, abs=1e-6)


@pytest.mark.minute
@pytest.mark.shared_data
def test_scanned_things_come_in_closed_with_a_volume_that_their_own_collision_meshes_confirm():
    for name in ("blue_cup", "bowl", "cracker_box", "mug", "shampoo"):
        scanned, coarse = (load(SHARED / name / f"{kind}.obj") for kind in ("textured", "collision"))
        assert solid(scanned.shape)
        hulls = [trimesh.Trimesh(x.shape.vertices, x.shape.faces).convex_hull.volume for x in (scanned, coarse)]
        assert hulls[0] == pytest.approx(hulls[1], rel=0.2)
        assert welded(scanned.shape).volume <= hulls[0]
        missing = [note for note in scanned.notes if "texture_map.png is missing" in note]
        assert missing or name != "mug"
        assert [note[:11] for note in scanned.notes] == ["a grey Kd o"] or name != "blue_cup"


# ------------------------------------------------------------------------------------------------ mass


def test_a_box_has_the_inertia_of_the_textbook_wherever_it_lies_and_however_it_is_turned():
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.7, 0.1]))
    shift = trimesh.transformations.translation_matrix((10.0, -20.0, 30.0))
    for T in (np.eye(4), shift, turn):
        mass = mass_properties(shape_of(trimesh.creation.box((0.2, 0.3, 0.5), transform=T)), 600.0, 3.0)
        assert mass.solid and mass.mass_kg == pytest.approx(18.0, rel=1e-12)
        assert mass.com == pytest.approx(T[:3, 3], rel=1e-12, abs=1e-15)
        inertia = 18.0 / 12.0 * np.diag([0.3**2 + 0.5**2, 0.2**2 + 0.5**2, 0.2**2 + 0.3**2])
        expected = T[:3, :3] @ inertia @ T[:3, :3].T
        assert mass.inertia == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_a_hidden_body_and_a_cut_weigh_nothing_and_a_void_is_taken_away():
    outer, void = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((0.8, 0.8, 0.8))
    void.apply_translation((0, 0, 0.05))
    void.invert()
    vessel = mass_properties(shape_of(outer, void), 10.0, 3.0)
    assert vessel.solid and vessel.mass_kg == pytest.approx(10.0 * (1.0 - 0.512), rel=1e-12)
    assert vessel.com[2] == pytest.approx(-0.05 * 0.512 / (1.0 - 0.512), rel=1e-9)
    hidden = trimesh.creation.box((0.2, 0.2, 0.2))
    hidden.apply_translation((0.3, 0, 0))
    assert mass_properties(shape_of(outer, hidden), 1.0, 3.0).com == pytest.approx([0, 0, 0], abs=1e-12)
    ball = trimesh.creation.icosphere(3, 0.2)
    upper = ball.triangles_center[:, 2] > 0
    halves = [ball.submesh([np.flatnonzero(side)], append=True) for side in (upper, ~upper)]
    cut, whole = mass_properties(shape_of(*halves), 600.0, 3.0), mass_properties(shape_of(ball), 600.0, 3.0)
    assert cut.solid and cut.mass_kg == pytest.approx(whole.mass_kg, rel=1e-12)
    assert cut.inertia == pytest.approx(whole.inertia, rel=1e-12, abs=1e-12)


def spike(at, way, size=0.8):
    """A square pyramid with its point at `at`, 45 degrees wide, its axis along `way`."""
    base = size * np.array([[-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1]])
    R = trimesh.geometry.align_vectors([0, 0, 1], way)[:3, :3]
    faces = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
    return trimesh.Trimesh(np.concatenate([[[0, 0, 0]], base]) @ R.T + at, faces, process=False)


def cube(low, high, inside_out=False):
    made = trimesh.creation.box(bounds=(low, high))
    if inside_out:
        made.invert()
    return made


MEETING = {
    "one point": (cube((0, 0, 0), (1, 1, 1)), spike((1, 1, 1), (-1, -1, -1))),
    "one point, inside and outside": (cube((0, 0, 0), (1, 1, 1)), spike((1, 1, 1), (-1, 0.3, 0.2))),
    "two points": (cube((0, 0, 0), (1, 1, 1)), spike((1, 1, 1), (-1, -1, -1)), spike((0, 0, 0), (1, 1, 1))),
    "an edge": (cube((0, 0, 0), (1, 1, 1)), cube((0, 0, 0), (0.5, 0.5, 1))),
    "an edge, inside and outside": (
        cube((0, 0, 0), (1, 1, 1)),
        trimesh.Trimesh(
            np.array([[0, 0, 0], [0, 0, 1], [0.9, 0.4, 0], [0.9, 0.4, 1], [0.4, -0.9, 0], [0.4, -0.9, 1]]),
            np.array([[0, 2, 4], [1, 5, 3], [0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 0], [5, 1, 0]]),
        ),
    ),
    "an edge of three": (*(cube((0, 0, 0), (1, 1, 1)), cube((0, 0, 0), (0.5, 2, 1)), cube((0, 0, 0), (2, 0.5, 1))),),
}


def test_bodies_that_share_points_or_edges_and_overlap_weigh_as_their_union_and_say_so():
    """Held to the union of the bodies, each a mesh of its own, and for boxes to their measures."""
    for name, bodies in MEETING.items():
        for body in bodies:
            body.fix_normals()
        shape = shape_of(*bodies)
        mass, common = weigh(shape, 10.0, 3.0)
        union = trimesh.boolean.union(bodies)
        assert mass.solid and mass.mass_kg == pytest.approx(10.0 * union.volume, rel=1e-6), name  # in float32
        assert mass.com == pytest.approx(union.center_mass, abs=1e-6), name
        assert common == pytest.approx(sum(body.volume for body in bodies) - union.volume, rel=1e-6), name
        one = shape_of(trimesh.util.concatenate(bodies))
        assert weigh(one, 10.0, 3.0)[0].mass_kg == pytest.approx(mass.mass_kg, rel=1e-12), f"{name}, in one part"
    assert weigh(shape_of(*MEETING["an edge"]), 1.0, 3.0)[0].mass_kg == pytest.approx(1.0, rel=1e-12)
    assert weigh(shape_of(*MEETING["an edge of three"]), 1.0, 3.0)[0].mass_kg == pytest.approx(2.0, rel=1e-12)
    # A hollow vessel with a handle that reaches into its wall, and one that reaches into the hollow.
    hollow = cube((0, 0, 0), (1, 1, 1)), cube((0.1, 0.1, 0.1), (0.9, 0.9, 0.9), inside_out=True)
    for reach, inside in ((0.05, 0.05), (0.3, 0.1)):
        handle = cube((1 - reach, 0.4, 0.4), (1.5, 0.6, 0.6))
        mass, common = weigh(shape_of(*hollow, handle), 1.0, 3.0)
        assert mass.mass_kg == pytest.approx(1 - 0.512 + 0.04 * (0.5 + reach - inside), rel=1e-9)
        assert common == pytest.approx(0.04 * inside, rel=1e-6)
    for apart in (cube((1, 1, 1), (2, 2, 2)), cube((1, 1, 0), (2, 2, 1)), cube((1, 0, 0), (2, 1, 1))):
        mass, common = weigh(shape_of(hollow[0], apart), 1.0, 3.0)
        assert mass.mass_kg == pytest.approx(2.0, rel=1e-12) and common == 0.0
    asset = place(trimesh.util.concatenate(MEETING["an edge"]), unit=0.1)
    assert asset.notes == ("bodies overlap: 250 cm^3 that they share weigh once",)
    assert asset.mass.mass_kg == pytest.approx(0.6, rel=1e-9) and not place(hollow[0]).notes


@pytest.mark.minute
def test_bodies_shown_more_than_once_weigh_once_and_very_many_that_meet_are_said():
    """A body repeated in the same place is one; crossing bodies are joined, or the note says that they are not."""
    one, far = cube((0, 0, 0), (1, 1, 1)), cube((0.5, 0.5, 0.5), (3, 1, 1))
    for bodies, weight in (([one] * 2, 1.0), ([one] * 900, 1.0), ([one] * 3 + [far] * 2, 1.0 + 0.625 - 0.125)):
        mass, common = weigh(shape_of(*bodies), 1.0, 3.0)
        assert mass.mass_kg == pytest.approx(weight, rel=1e-9), len(bodies)
        assert common == pytest.approx(sum(body.volume for body in bodies) - weight, rel=1e-9)
    ball = trimesh.creation.icosphere(4, 0.5)
    rng = np.random.default_rng(5)
    crossing = [ball.copy().apply_translation(rng.uniform(-0.1, 0.1, 3)) for _ in range(120)]
    mass, common = weigh(shape_of(*crossing), 1.0, 3.0)
    assert common is None and mass.mass_kg == pytest.approx(120 * ball.volume, rel=1e-6)
    crossing = trimesh.util.concatenate(crossing)
    assert place(crossing, scale=0.1).notes == (
        "bodies weigh twice what they share, if anything: they are too many to look for it",
    )


def test_shells_weigh_as_their_plates_and_a_spherical_one_has_two_thirds_m_r_squared():
    exact, ball = 3.0 * 4 * math.pi * 0.1**2, trimesh.creation.icosphere(5, 0.1)
    mass = shell_mass(ball.vertices, ball.faces, 3.0)
    assert not mass.solid and mass.mass_kg == pytest.approx(exact, rel=1e-3)
    assert mass.inertia == pytest.approx(np.eye(3) * 2 / 3 * exact * 0.01, rel=2e-3, abs=1e-6)
    open_box = trimesh.creation.box((2.0, 2.0, 2.0))
    open_box.update_faces(open_box.triangles_center[:, 2] <= 0.999)
    mass, plate = mass_properties(shape_of(open_box), 600.0, 3.0), 3.0 * 4.0
    assert not mass.solid and mass.mass_kg == pytest.approx(5 * plate, rel=1e-12)
    assert mass.com == pytest.approx([0, 0, -0.2], abs=1e-12)
    # About z: the bottom m (a^2 + b^2)/12, four walls m (a^2/12 + 1) with a = b = 2; about z the shift does nothing.
    assert mass.inertia[2, 2] == pytest.approx(plate * (8 / 12 + 4 * (4 / 12 + 1)), rel=1e-12)


# ------------------------------------------------------------------------------------------------ placing, and up


def place(mesh, **placement):
    return place_asset(LoadedMesh(shape_of(mesh), ()), Row("a.obj", category="mug", **placement), MeshLimits())


def test_an_asset_is_centred_scaled_and_weighed_and_its_matrix_takes_scaled_source_points_there():
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.apply_translation((7, 8, 9))
    asset = place(mesh, up="y", unit=0.1)
    assert asset.shape.bounds == pytest.approx(np.array([[-0.05, -0.15, -0.1], [0.05, 0.15, 0.1]]))
    scaled = np.c_[0.1 * mesh.vertices, np.ones(8)]
    assert (asset.T_source_to_object @ scaled.T).T[:, :3] == pytest.approx(asset.shape.vertices, abs=1e-12)
    assert asset.watertight and asset.mass.mass_kg == pytest.approx(3.6)
    assert welded(asset.shape).volume == pytest.approx(0.006), "still the right way out"
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.update_faces(np.arange(12) > 1)
    asset = place(mesh)
    assert not asset.watertight, "an open mesh weighs as a shell"
    assert asset.mass.mass_kg == pytest.approx(15.0)


def test_a_can_that_lies_as_the_job_has_it_names_the_axis_of_its_file_that_it_stands_on(tmp_path):
    can = trimesh.creation.cylinder(0.04, 0.1, sections=48)
    can.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    write(tmp_path / "can.stl", can.export(file_type="stl"))
    for up, doubt in (("y", None), ("z", "y"), ("x", "y")):
        catalogue = open_folder(tmp_path, "can", up=up)
        assert dict(catalogue.objects[0].doubts) == ({"can.stl": doubt} if doubt else {})
        stands = catalogue.load(catalogue.refer(0, "can", 0)).extents_m[2] == pytest.approx(0.1)
        assert stands == (doubt is None)
        assert ("can.stl on y" in "".join(catalogue.describe_doubts())) == (doubt is not None)


def upright(mesh, up="z"):
    """The answer on a mesh with z up, turned so that `up` of its file is."""
    turn = np.asarray(UP_AXES[up])
    return find_upright(mesh.convex_hull.vertices @ turn, mesh.center_mass @ turn)


@pytest.mark.minute
def test_who_is_sure_is_right_and_who_finds_it_likely_is_so_nine_times_in_ten():
    likely, sure, seeds = [], dict.fromkeys((*CATEGORIES, TABLE), 0), 12
    for category in sure:
        for index in range(seeds):
            asset = make_asset(category, ProceduralSource(source="procedural", seed=5), index, 600.0)
            vertices = convex_hull(asset.shape.vertices).vertices
            for up, turn in UP_AXES.items():
                found = find_upright(vertices @ turn, asset.mass.com @ turn)
                if found is not None and found.confidence == "sure":
                    assert found.axis == up, f"{category} {index}"
                    sure[category] += 1
                elif found is not None:
                    likely.append(found.axis == up)
    assert sum(likely) >= 0.9 * len(likely) > 10
    assert all(sure[name] >= 0.6 * 3 * seeds for name in ("mug", "bowl", "jar", "bottle", "can", TABLE)), sure


def test_round_bodies_stand_on_their_flat_end_and_nothing_is_said_of_what_stands_on_any_side_or_on_none():
    for up in "xyz":
        assert upright(trimesh.creation.cylinder(0.04, 0.1, sections=64), up) == Upright(up, "sure")
    dome = trimesh.creation.icosphere(4, 0.1).slice_plane((0, 0, 0), (0, 0, 1), cap=True)
    assert upright(dome) == Upright("z", "sure"), "a bowl that stands upside down alone still tells its axis"
    assert upright(trimesh.creation.torus(0.1, 0.03)) == Upright("z", "sure"), "a ring lies flat"
    prism = trimesh.creation.extrude_polygon(Polygon([(0, 0), (3, 0), (1.5, 1.2)]), 2.0)
    prism.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    assert upright(prism) == Upright("z", "likely")
    boxes = trimesh.creation.box((0.2, 0.1, 0.3)), trimesh.creation.box((0.1, 0.1, 0.1))
    for mesh in (*boxes, trimesh.creation.icosphere(3, 0.1), trimesh.creation.capsule(0.2, 0.05)):
        assert upright(mesh) is None


def test_what_neither_tips_nor_rolls_away_rests_whatever_its_foot_is():
    """A remote control on its rounded back and a laptop do; a can or a mug on its side does not, nor a plate on its rim."""
    back = trimesh.creation.cylinder(0.1, 0.16, sections=256)
    back = back.slice_plane((0.09, 0, 0), (1, 0, 0), cap=True)
    lid = trimesh.creation.box((0.3, 0.005, 0.25), trimesh.transformations.translation_matrix((0, 0.12, 0.13)))
    laptop = trimesh.util.concatenate([trimesh.creation.box((0.3, 0.24, 0.02)), lid])
    handle = trimesh.creation.box((0.02, 0.02, 0.08), trimesh.transformations.translation_matrix((0.05, 0, 0)))
    tube = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    for name, mesh, up, so in (
        ("remote on its flat side", back, (-1, 0, 0), True),
        ("remote on its back", back, (1, 0, 0), True),
        ("remote on its end", back, (0, 0, 1), False),
        ("laptop", laptop, (0, 0, 1), True),
        ("laptop on its lid's end", laptop, (0, 0, -1), False),
        ("can", tube, (0, 0, 1), True),
        ("can on its side", tube, (1, 0, 0), False),
        ("mug on its side", trimesh.util.concatenate([tube, handle]), (0, 1, 0), False),
        ("plate on its rim", trimesh.creation.box((0.3, 0.3, 0.01)), (1, 0, 0), False),
    ):
        for axis in ("x", "y", "z"):
            turn = trimesh.geometry.align_vectors(up, np.eye(3)["xyz".index(axis)])[:3, :3]
            assert rests(mesh.convex_hull.vertices @ turn.T, mesh.center_mass @ turn.T, axis) == so, (name, axis)


def test_the_angle_of_tipping_is_that_of_the_foot_and_the_centre_of_mass():
    cone = trimesh.creation.cone(0.05, 0.2, sections=256)
    stand = measure_stand(cone.convex_hull.vertices, cone.center_mass, "z")
    assert stand.smooth_deg == pytest.approx(np.degrees(np.arctan2(support_margin(cone), 0.05)), rel=1e-3)
    assert stand.smooth == pytest.approx(1.0, abs=1e-6) and stand.verdict == "stands"
    assert measure_stand(cone.convex_hull.vertices, cone.center_mass, "-z").verdict == "rolls"
