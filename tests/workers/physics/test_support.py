"""Vertical distances, against closed forms.

How an object stands: support margins and the turn onto a face, against closed forms. What a table offers to stand on.
"""

import numpy as np
import pytest
import trimesh

from schemas.errors import StartError
from schemas.scene.shape import Mesh
from tests.kit.shapes import asset_of, box, shape_of
from workers.geometry.frames import angle_between, pose, rotation_about, transform
from workers.geometry.hull import convex_hull
from workers.physics.support import (
    find_table_top,
    place_table,
    sample_elevation,
    snap_to_face,
    split_by_side,
    support_height,
    support_margin,
    vertical_gap,
)


def mesh(m: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(m.vertices), np.asarray(m.faces, dtype=np.int32))


BOX = trimesh.creation.box((2, 2, 0.1))


def test_a_point_on_a_shared_edge_is_not_missed():
    assert np.isfinite(sample_elevation(np.array([[0.3, 0.3], [0.0, 0.0], [1.0, 1.0]]), mesh(BOX))).all()


@pytest.mark.parametrize("gap", [-0.003, 0.0, 0.02])
def test_the_gap_of_a_sphere_above_a_box_is_known(gap):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.apply_translation([0.2, 0.1, 0.05 - ball.bounds[0, 2] + gap])
    assert vertical_gap(mesh(ball), mesh(BOX)) == pytest.approx(gap, abs=1e-12)


X = np.array([1.0, 0.0, 0.0])
CUBE = convex_hull(np.asarray(box(0.1, 0.1, 0.1).vertices))
CENTRE = np.zeros(3)


def test_the_margin_of_a_square_is_the_distance_to_its_nearest_side():
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2], [1, 1.0]])
    assert support_margin(square, np.array([1.2, 0.7])) == pytest.approx(0.7)
    assert support_margin(square, np.array([2.5, 1.0])) == pytest.approx(-0.5)


@pytest.mark.parametrize("tilt", [0.0, 0.001, -0.01, 0.019])
def test_a_slightly_tilted_cube_is_turned_flat_about_its_centre(tilt):
    T = pose(rotation_about(X, tilt), np.array([0.3, 0.2, 0.9]))
    snapped = snap_to_face(T, CUBE, CENTRE)
    assert snapped is not None
    low = transform(snapped, CUBE.vertices)[:, 2]
    assert np.sort(low)[:4] == pytest.approx(0.85, abs=1e-12)
    assert snapped[:3, 3] == pytest.approx(T[:3, 3], abs=1e-15)
    assert angle_between(T[:3, :3], snapped[:3, :3]) == pytest.approx(abs(tilt), abs=1e-12)


def test_a_face_without_the_centre_of_mass_over_it_is_not_chosen():
    slab = convex_hull(np.asarray(trimesh.creation.box((0.1, 0.1, 0.3)).vertices))
    com = np.array([0.08, 0.0, 0.0])  # beyond the small face's side at 0.05
    T = pose(np.eye(3), np.zeros(3))
    assert snap_to_face(T, slab, com) is None
    assert snap_to_face(T, slab, np.array([0.04, 0.0, 0.0])) == pytest.approx(T)


def test_the_top_is_the_top_and_not_a_shelf_or_a_rim():
    shelf = box(1.0, 1.0, 0.02, (0, 0, 0.3))
    slab = box(1.2, 0.8, 0.03, (0.1, 0, 0.7))
    rim = box(0.02, 0.8, 0.1, (0.69, 0, 0.765))
    top = find_table_top(shape_of(shelf, slab, rim))
    assert top.height_m == pytest.approx(0.715)
    assert top.centre == pytest.approx([0.1, 0.0])
    assert not top.convex  # the rim stands above it


def test_a_table_without_a_level_face_is_refused():
    slope = box(1, 1, 0.1)
    slope.apply_transform(trimesh.transformations.rotation_matrix(0.3, [1, 0.2, 0]))
    with pytest.raises(StartError) as caught:
        find_table_top(shape_of(slope))
    assert caught.value.reason == "no_table_top"


def test_the_support_is_the_highest_thing_below_also_between_the_points():
    spike = box(0.02, 0.02, 0.1, (0, 0, 0.05))
    plate = box(1, 1, 0.02, (0, 0, -0.01))
    both = trimesh.util.concatenate([plate, spike])
    mesh = Mesh(np.asarray(both.vertices), np.asarray(both.faces, np.int32))
    around = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    assert support_height(around, mesh) == pytest.approx(0.1)
    assert support_height(around + 0.3, mesh) == pytest.approx(0.0)
    assert support_height(around + 5.0, mesh) == -np.inf


def test_the_sides_of_a_mesh_have_each_of_its_faces_once_and_one_direction_each():
    mesh = place_table(asset_of(box(0.4, 0.4, 0.03), box(0.02, 0.4, 0.1, (0.19, 0, 0.065)))).mesh
    flat = Mesh(mesh.vertices, np.concatenate([mesh.faces, [[0, 0, 1]]]).astype(np.int32))  # and one without area
    sides = [each.vertices[each.faces] for each in split_by_side(flat)]
    assert len(sides) == 6
    for corners in sides:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        assert normals == pytest.approx(np.tile(normals[0], (len(normals), 1)))
    assert sorted(map(tuple, np.concatenate(sides).reshape(-1, 9))) == sorted(
        map(tuple, mesh.vertices[mesh.faces].reshape(-1, 9))
    )
