"""Features of meshes whose corners, edges and sides are known."""

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.contacts import box, mesh_of
from workers.geometry.contact_surface import crop, is_closed, surface_of


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
