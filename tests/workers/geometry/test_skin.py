"""Which faces are near, and the pieces below them: against distances by FCL, and by what is inside a mesh."""

import fcl
import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.shapes import box
from workers.geometry.contact_surface import Surface, surface_of
from workers.geometry.skin import faces_within, skin_of

DEEP_M = 1e-3


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
    pieces = skin_of(surface(box(0.2, 0.1, 0.06)), np.arange(12), DEEP_M)
    assert len(pieces) == 6
    for piece in pieces:
        corners, below = piece[:-1], piece[-1]
        assert len(corners) == 4
        (axis,) = np.flatnonzero(np.ptp(corners, axis=0) == 0.0)
        assert below[axis] == pytest.approx(corners[0, axis] - np.sign(corners[0, axis]) * DEEP_M)
        assert np.allclose(np.delete(below, axis), 0.0)


def test_a_mesh_inside_out_has_the_same_pieces():
    right = box(0.2, 0.1, 0.06)
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
