"""Features of meshes whose corners, edges and sides are known; what is near, against FCL; and pieces, by what is inside."""

import fcl
import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.kit import shapes
from tests.kit.contacts import box, mesh_of
from workers.physics.contact_surface import Surface, crop, faces_within, is_closed, skin_of, surface_of

DEEP_M = 1e-3


def test_a_box_has_eight_corners_twelve_edges_and_its_body_below_every_face():
    surface = surface_of(box((0.1, 0.2, 0.3)), True)
    assert (len(surface.corners), len(surface.edges), len(surface.faces)) == (8, 12, 12)
    assert (surface.side == 1).all()


def test_inside_out_the_body_lies_above_every_face():
    cube = box((0.1, 0.1, 0.1))
    assert (surface_of(Mesh(cube.vertices, np.ascontiguousarray(cube.faces[:, ::-1])), True).side == -1).all()


def test_corners_that_are_stored_for_each_face_are_one():
    cube = box((0.1, 0.1, 0.1))
    loose = Mesh(cube.vertices[cube.faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3))
    assert len(surface_of(loose, True).vertices) == 8


def test_what_lies_within_a_plane_touches_nothing():
    fine = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide()
    surface = surface_of(mesh_of(fine), True)
    assert len(surface.vertices) > 50
    ends = surface.vertices[surface.corners]
    assert (np.isclose(np.abs(ends), 0.05).sum(axis=1) >= 2).all()  # on the box's twelve edges


def test_about_the_faces_of_a_hollow_the_body_is_neither_above_nor_below():
    ring = trimesh.boolean.difference([trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.06, 0.06, 0.2))])
    surface = surface_of(mesh_of(ring), True)
    centres = surface.vertices[surface.faces].mean(axis=1)
    inner = (np.abs(centres[:, :2]).max(axis=1) < 0.04) & (np.abs(centres[:, 2]) < 0.05 - 1e-9)
    assert (surface.side[inner] <= 0).all() and inner.any()


def test_a_sheet_is_bound_by_edges_with_one_vertex_across():
    sheet = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    surface = surface_of(sheet, False)
    assert len(surface.edges) == 4 and (surface.across[:, 0] == surface.across[:, 1]).all()


def test_a_part_has_all_that_shares_a_corner_with_what_overlaps_the_box():
    ball = mesh_of(trimesh.creation.icosphere(3, 0.05))
    low, high = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, -0.045])
    part = crop(ball, low, high)
    assert 0 < len(part.faces) < len(ball.faces) / 2
    touched = np.unique(ball.faces[(ball.vertices[ball.faces][:, :, 2].min(axis=1) <= -0.045)])
    sharing = np.isin(ball.faces, touched).any(axis=1)
    assert {tuple(face) for face in ball.faces[sharing].tolist()} <= {tuple(face) for face in part.faces.tolist()}


def test_far_from_the_box_there_is_nothing():
    assert len(crop(box((0.1, 0.1, 0.1)), np.full(3, 1.0), np.full(3, 2.0)).faces) == 0


@pytest.mark.parametrize("faces", [np.empty((0, 3), np.int32), np.array([[0, 0, 1]], np.int32)], ids=["none", "thin"])
def test_a_mesh_without_area_has_no_features(faces):
    surface = surface_of(Mesh(np.eye(3), faces), True)
    assert (len(surface.faces), len(surface.edges), len(surface.corners)) == (0, 0, 0)


def test_a_surface_without_an_inside_has_its_body_on_neither_side():
    cube = box((0.1, 0.1, 0.1))
    open_box = Mesh(cube.vertices, cube.faces[2:])
    assert is_closed(cube) and not is_closed(open_box)
    assert (surface_of(open_box, is_closed(open_box)).side == 0).all()


def surface(mesh: trimesh.Trimesh, closed: bool = True) -> Surface:
    return surface_of(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), closed)


def distance_m(one: np.ndarray, other: np.ndarray) -> float:
    bodies = []
    for triangle in (one, other):
        model = fcl.BVHModel()
        model.beginModel(3, 1)
        model.addSubModel(triangle, np.array([[0, 1, 2]]))
        model.endModel()
        bodies.append(fcl.CollisionObject(model))
    return fcl.distance(*bodies)


@pytest.mark.parametrize("within_m", [0.1, 0.15, 0.3])
def test_faces_are_near_where_fcl_finds_their_triangles_within_the_distance(within_m):
    """Triangles with two corners at one place are left to nobody: surfaces have none."""
    chance = np.random.default_rng(7)
    here, there = (chance.uniform(0.0, 1.0, (60, 3, 3)) * [1, 1, 0.5] + [0, 0, z] for z in (0.0, 0.4))
    here, there = (middles(each) for each in (here, there))
    numbers = np.arange(180).reshape(60, 3)
    near = faces_within((here.reshape(-1, 3), numbers), (there.reshape(-1, 3), numbers), within_m)
    true = np.array([[distance_m(a, b) for b in there] for a in here])
    assert np.abs(true - within_m).min() > 1e-6
    assert near[0].tolist() == np.flatnonzero((true <= within_m).any(axis=1)).tolist()
    assert near[1].tolist() == np.flatnonzero((true <= within_m).any(axis=0)).tolist()
    assert 0 < len(near[0]) < 60


def middles(triangles: np.ndarray) -> np.ndarray:
    """The triangles at a third of their size, about their middles."""
    middle = triangles.mean(axis=1, keepdims=True)
    return np.ascontiguousarray(middle + (triangles - middle) / 3.0)


def test_a_side_of_a_box_is_one_piece_with_its_four_corners_and_a_point_below():
    pieces = skin_of(surface(shapes.box(0.2, 0.1, 0.06)), np.arange(12), DEEP_M)
    assert len(pieces) == 6
    for piece in pieces:
        corners, below = piece[:-1], piece[-1]
        assert len(corners) == 4
        (axis,) = np.flatnonzero(np.ptp(corners, axis=0) == 0.0)
        assert below[axis] == pytest.approx(corners[0, axis] - np.sign(corners[0, axis]) * DEEP_M)
        assert np.allclose(np.delete(below, axis), 0.0)


def test_a_mesh_inside_out_has_the_same_pieces():
    right = shapes.box(0.2, 0.1, 0.06)
    wrong = trimesh.Trimesh(right.vertices, right.faces[:, ::-1], process=False)
    for one, other in zip(*(skin_of(surface(mesh), np.arange(12), DEEP_M) for mesh in (right, wrong)), strict=True):
        assert np.allclose(sorted(one.tolist()), sorted(other.tolist()))


def test_faces_in_a_plane_that_fill_no_convex_outline_are_a_piece_each():
    """The ends of a tube are rings; its sides are quadrilaterals, one piece each."""
    tube = trimesh.creation.annulus(0.03, 0.05, 0.1, sections=24)
    pieces = skin_of(surface(tube), np.arange(len(tube.faces)), DEEP_M)
    assert sorted({len(one) for one in pieces}) == [4, 5]
    assert sum(len(one) == 5 for one in pieces) == 2 * 24
    assert sum(len(one) == 4 for one in pieces) == 2 * 2 * 24


def wedge(angle_deg: float) -> trimesh.Trimesh:
    """A prism of 100 mm with an edge of this angle along y."""
    rise = 0.05 * np.tan(np.radians(angle_deg) / 2.0)
    points = [[x, y, z] for y in (0.0, 0.1) for x, z in ((0.0, 0.0), (0.05, rise), (0.05, -rise))]
    return trimesh.convex.convex_hull(np.array(points))


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.annulus(0.03, 0.05, 0.1, sections=24),
        wedge(60.0),
        wedge(10.0),
        wedge(1.0),
        trimesh.creation.icosphere(2, 0.05),
    ],
    ids=["tube", "wedge of 60 degrees", "wedge of 10 degrees", "wedge of 1 degree", "ball"],
)
def test_no_piece_reaches_out_of_the_mesh(mesh):
    whole = manifold3d.Manifold(manifold3d.Mesh64(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.uint64)))
    assert whole.volume() > 0.0
    for piece in skin_of(surface(mesh), np.arange(len(mesh.faces)), DEEP_M):
        assert (manifold3d.Manifold.hull_points(np.ascontiguousarray(piece)) - whole).volume() < 1e-15


def test_what_has_no_inside_has_flat_pieces():
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
    (piece,) = skin_of(surface(sheet, closed=False), np.arange(2), DEEP_M)
    assert len(piece) == 5 and np.all(piece[:, 2] == 0.0)


def test_only_the_faces_that_are_asked_for_have_pieces():
    ball = trimesh.creation.icosphere(2, 0.05)
    asked = np.array([3, 50, 51])
    pieces = skin_of(surface(ball), asked, DEEP_M)
    assert len(pieces) == 3
    assert skin_of(surface(ball), np.array([], dtype=np.int64), DEEP_M) == ()
