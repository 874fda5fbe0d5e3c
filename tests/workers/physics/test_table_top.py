"""What a table offers to stand on."""

import numpy as np
import pytest
import trimesh

from schemas.errors import StartError
from schemas.scene.shape import Mesh
from tests.kit.shapes import asset_of, box, shape_of, table
from workers.physics.support import find_table_top, inside_margin, place_table, split_by_side, support_height


def test_the_top_is_the_top_and_not_a_shelf_or_a_rim():
    shelf = box(1.0, 1.0, 0.02, (0, 0, 0.3))
    slab = box(1.2, 0.8, 0.03, (0.1, 0, 0.7))
    rim = box(0.02, 0.8, 0.1, (0.69, 0, 0.765))
    top = find_table_top(shape_of(shelf, slab, rim))
    assert top.height_m == pytest.approx(0.715)
    assert top.centre == pytest.approx([0.1, 0.0])
    assert not top.convex  # the rim stands above it


def test_a_plain_top_is_convex_and_a_top_with_a_hole_is_not():
    assert find_table_top(table().shape).convex
    ring = trimesh.creation.annulus(r_min=0.2, r_max=0.6, height=0.03)
    assert not find_table_top(shape_of(ring)).convex


def test_a_table_that_is_wound_inside_out_has_the_same_top():
    inside_out = box(1, 1, 0.1)
    inside_out.invert()
    assert find_table_top(shape_of(inside_out)).height_m == pytest.approx(0.05)


@pytest.mark.parametrize(("degrees", "level"), [(0.0, True), (0.003, True), (1.0, False), (2.5, False)])
def test_a_face_that_leans_by_more_than_a_tenth_of_a_millimetre_is_no_level_to_drop_things_on(degrees, level):
    slope = box(1, 1, 0.1)
    slope.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 1, 0]))
    assert find_table_top(shape_of(slope)).convex == level


def test_a_table_without_a_level_face_is_refused():
    slope = box(1, 1, 0.1)
    slope.apply_transform(trimesh.transformations.rotation_matrix(0.3, [1, 0.2, 0]))
    with pytest.raises(StartError) as caught:
        find_table_top(shape_of(slope))
    assert caught.value.reason == "no_table_top"


def test_a_table_stands_on_the_floor_with_its_top_over_the_origin():
    placed = place_table(asset_of(box(1.0, 0.6, 0.04, (0.4, -0.2, 3.0)), box(0.1, 0.1, 0.5, (0.4, -0.2, 2.73))))
    assert placed.mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-15)
    assert placed.top.height_m == pytest.approx(0.54)
    assert placed.top.outline.min(axis=0) == pytest.approx([-0.5, -0.3])
    assert placed.top.outline.max(axis=0) == pytest.approx([0.5, 0.3])


def test_distance_inside_a_polygon_is_signed():
    triangle = np.array([[0, 0], [4, 0], [0, 3.0]])
    points = np.array([[1, 1], [-1, 1], [4, 3]])
    # The hypotenuse 3x + 4y = 12 has length 5.
    assert inside_margin(points, triangle) == pytest.approx([min(1, 1, (12 - 7) / 5), -1, (12 - 24) / 5])


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
