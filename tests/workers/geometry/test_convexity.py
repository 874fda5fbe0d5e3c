"""Welding, pieces, depth below the hull and solids, on bodies of known measure."""

from typing import Any

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from workers.geometry.mesh import (
    components,
    concavity_m,
    face_areas,
    face_planes,
    has_rim,
    mesh_of,
    solid_of,
    triangle_corners,
    weld,
)


def as_mesh(*bodies: trimesh.Trimesh) -> Mesh:
    whole: Any = trimesh.util.concatenate(list(bodies))
    return Mesh(np.asarray(whole.vertices), np.asarray(whole.faces, dtype=np.int32))


def box(size, at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def soup_of(mesh: Mesh) -> Mesh:
    """The same triangles, none of which shares a vertex with another."""
    return Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3))


def test_a_welded_soup_has_one_vertex_at_each_place():
    whole = as_mesh(box((1, 2, 3)))
    welded = weld(soup_of(whole))
    assert len(welded.vertices) == 8 and len(welded.faces) == 12
    assert np.concatenate(triangle_corners(welded)) == pytest.approx(np.concatenate(triangle_corners(whole)))


def test_the_corners_of_a_face_lie_in_its_plane_and_a_face_without_area_has_none():
    ball = trimesh.creation.icosphere(2, 0.3)
    ball.apply_translation((1.0, -2.0, 0.5))
    mesh = as_mesh(ball)
    flat = Mesh(mesh.vertices, np.concatenate([mesh.faces, [[0, 1, 1]]]).astype(np.int32))
    normals, offsets = face_planes(flat)
    assert normals[:-1] == pytest.approx(ball.face_normals, abs=1e-12)
    for corner in triangle_corners(mesh):
        assert (normals[:-1] * corner).sum(axis=1) == pytest.approx(offsets[:-1], abs=1e-12)
    assert (*normals[-1], offsets[-1]) == (0.0, 0.0, 0.0, 0.0)


def test_the_areas_of_a_box_are_half_of_its_sides_and_a_face_of_one_line_has_none():
    mesh = as_mesh(box((1, 2, 3)))
    lined = np.concatenate([mesh.faces, [[0, 1, 1]]])
    assert sorted(face_areas(mesh.vertices, lined)) == pytest.approx([0.0] + 4 * [1.0] + 4 * [1.5] + 4 * [3.0])


def weld_by_records(mesh: Mesh) -> Mesh:
    """The plain reference: rows compared as records by `np.unique`."""
    used = np.unique(mesh.faces)
    vertices, inverse = np.unique(mesh.vertices[used], axis=0, return_inverse=True)
    place = np.zeros(len(mesh.vertices), dtype=np.int32)
    place[used] = inverse.reshape(-1)
    faces = place[mesh.faces]
    faces = faces[[len(set(face)) == 3 for face in faces.tolist()]]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh(vertices, faces[np.sort(first)])


@pytest.mark.parametrize("seed", range(8))
def test_triangles_of_few_places_are_welded_as_the_plain_reference_does(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.choice([-1.0, -0.0, 0.0, 0.5], (60, 3))
    faces = rng.integers(0, 50, (200, 3)).astype(np.int32)
    expected, welded = weld_by_records(Mesh(vertices, faces)), weld(Mesh(vertices, faces))
    assert np.array_equal(welded.vertices, expected.vertices)
    assert np.array_equal(welded.faces, expected.faces) and welded.faces.dtype == expected.faces.dtype


def test_repeated_and_collapsed_triangles_and_loose_vertices_are_left_out():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0), (5, 5, 5)], dtype=np.float64)
    welded = weld(Mesh(vertices, np.array([(0, 1, 2), (1, 2, 3), (0, 1, 3)], dtype=np.int32)))
    assert len(welded.vertices) == 3 and len(welded.faces) == 1


def test_pieces_that_share_no_vertex_are_told_apart():
    pieces = components(weld(as_mesh(box((1, 1, 1)), box((2, 1, 1), (5, 0, 0)))))
    assert [np.ptp(piece.vertices[:, 0]) for piece in pieces] == pytest.approx([1.0, 2.0])
    assert [len(piece.faces) for piece in pieces] == [12, 12]


def test_a_solid_has_its_volume_however_it_is_wound():
    mesh = weld(as_mesh(box((1, 2, 3))))
    for faces in (mesh.faces, mesh.faces[:, ::-1]):
        solid = solid_of(Mesh(mesh.vertices, faces))
        assert solid is not None and solid.volume() == pytest.approx(6.0)
        assert np.ptp(mesh_of(solid).vertices, axis=0) == pytest.approx([1.0, 2.0, 3.0])
    assert solid_of(Mesh(mesh.vertices, mesh.faces[1:])) is None


def test_the_depth_of_a_dent_is_found_and_a_convex_body_has_none():
    assert concavity_m(as_mesh(box((1, 1, 1)))) == pytest.approx(0.0, abs=1e-12)
    dented = trimesh.creation.box((1, 1, 1)).subdivide()
    vertices = np.asarray(dented.vertices).copy()
    top = int(np.flatnonzero((np.abs(vertices[:, :2]) < 1e-9).all(axis=1) & (vertices[:, 2] > 0))[0])
    vertices[top, 2] -= 0.1
    depth = concavity_m(Mesh(vertices, np.asarray(dented.faces, dtype=np.int32)))
    assert 0.05 < depth <= 0.1


def test_a_mesh_has_a_rim_where_a_face_is_missing():
    faces = np.asarray(trimesh.creation.box().faces)
    assert not has_rim(faces, 8)
    assert not has_rim(np.concatenate([faces, faces]), 8)
    for missing in range(len(faces)):
        assert has_rim(np.delete(faces, missing, axis=0), 8)
    assert has_rim(np.array([[0, 1, 2]]), 3)
    assert not has_rim(np.empty((0, 3), np.int64), 3)
