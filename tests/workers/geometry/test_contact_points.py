"""Contact points of boxes, whose places and normals are known; the compiled loops are tested with them."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.geometry.contact_points import find_contact_points

WITHIN_M = 1e-5


def box(size, at=(0.0, 0.0, 0.0), yaw_rad: float = 0.0) -> Mesh:
    T = trimesh.transformations.translation_matrix(at) @ trimesh.transformations.rotation_matrix(yaw_rad, (0, 0, 1))
    body = trimesh.creation.box(size, T)
    return Mesh(np.asarray(body.vertices), np.asarray(body.faces, dtype=np.int32))


GROUND = box((2.0, 2.0, 0.1), (0.0, 0.0, -0.05))


def rows(points) -> set[tuple[float, ...]]:
    return {tuple(row) for row in np.round(points, 6) + 0.0}


@pytest.mark.parametrize("gap_m", [0.0, 5e-6])
def test_a_box_on_the_ground_touches_it_with_its_four_corners(gap_m):
    points, normals = find_contact_points(box((0.2, 0.1, 0.3), (0.0, 0.0, 0.15 + gap_m)), GROUND, WITHIN_M)
    assert rows(points[:, :2]) == {(x, y) for x in (-0.1, 0.1) for y in (-0.05, 0.05)}
    assert normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (len(normals), 1)))


def test_a_plate_on_a_post_touches_the_posts_corners():
    points, normals = find_contact_points(box((1.0, 1.0, 0.1), (0.0, 0.0, 0.15)), box((0.2, 0.2, 0.2)), WITHIN_M)
    assert rows(points) == {(x, y, 0.1) for x in (-0.1, 0.1) for y in (-0.1, 0.1)}
    assert normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (len(normals), 1)))


def test_a_plank_across_another_touches_it_where_their_edges_cross():
    lower, upper = box((1.0, 0.1, 0.1)), box((1.0, 0.1, 0.1), (0.0, 0.0, 0.1), np.pi / 2)
    points, normals = find_contact_points(upper, lower, WITHIN_M)
    assert rows(points) == {(x, y, 0.05) for x in (-0.05, 0.05) for y in (-0.05, 0.05)}
    assert normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (len(normals), 1)))


def test_many_contacts_are_all_found():
    """More than the sixty-four pairs that the loops begin with."""
    feet = [box((0.01, 0.01, 0.02), (x, y, 0.01)) for x in np.arange(-5, 5) * 0.1 for y in np.arange(-5, 5) * 0.1]
    starts = np.arange(len(feet)) * len(feet[0].vertices)
    faces = np.concatenate([foot.faces + start for foot, start in zip(feet, starts, strict=True)])
    comb = Mesh(np.concatenate([foot.vertices for foot in feet]), faces.astype(np.int32))
    assert len(find_contact_points(comb, GROUND, WITHIN_M)[0]) == 400


def test_bodies_apart_and_meshes_without_faces_touch_nowhere():
    assert len(find_contact_points(box((0.1, 0.1, 0.1), (0.0, 0.0, 0.0502)), GROUND, WITHIN_M)[0]) == 0
    nothing = Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))
    assert len(find_contact_points(nothing, GROUND, WITHIN_M)[0]) == 0
