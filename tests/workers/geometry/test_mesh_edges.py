"""Edges of meshes, and neighbours of vertices, against a plain reference that goes from face to face."""

from collections import defaultdict

import numpy as np
import pytest

from schemas.scene.shape import Mesh
from workers.geometry.convexity import face_normals, weld
from workers.geometry.mesh_edges import FLAT, bent_edges, half_edges, neighbours_of


def triangles(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Welded triangles between few places of a lattice: many are in one plane, folded, loose or meet at one edge."""
    rng = np.random.default_rng(seed)
    places = rng.integers(0, 3, (12, 3)) * [1.0, 1.0, 0.5]
    places[3:, 2] = 0.0
    mesh = weld(Mesh(places, rng.integers(0, 12, (40, 3)).astype(np.int32)))
    faces = mesh.faces.astype(np.int64)
    normals = face_normals(mesh.vertices, faces)
    solid = normals.any(axis=1)
    return mesh.vertices, faces[solid], normals[solid]


def sides_by_edge(faces: np.ndarray) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """(face, vertex across) of each side, in order, by the two vertices of the edge, ascending."""
    sides = defaultdict(list)
    for number, face in enumerate(faces.tolist()):
        for k in range(3):
            a, b = sorted((face[k], face[(k + 1) % 3]))
            sides[a, b].append((number, face[(k + 2) % 3]))
    return sides


@pytest.mark.parametrize("seed", range(6))
def test_the_neighbours_of_each_vertex_are_the_ends_of_its_edges(seed):
    vertices, faces, _ = triangles(seed)
    starts, members = neighbours_of(faces, len(vertices))
    edges = sides_by_edge(faces)
    for vertex in range(len(vertices)):
        wanted = sorted({a + b - vertex for a, b in edges if vertex in (a, b)})
        assert members[starts[vertex] : starts[vertex + 1]].tolist() == wanted
    assert starts[-1] == len(members) == 2 * len(edges)


@pytest.mark.parametrize("seed", range(6))
def test_edges_bend_between_two_faces_that_are_not_in_one_plane_or_lie_on_one_another(seed):
    vertices, faces, normals = triangles(seed)
    found = bent_edges(vertices, faces, normals, *half_edges(faces, len(vertices)))
    edges, across = [], []
    for (a, b), sides in sorted(sides_by_edge(faces).items()):
        (one, p), (other, q) = sides[0], sides[-1]
        along = vertices[b] - vertices[a]
        beside = [np.cross(along, vertices[each] - vertices[a]) for each in (p, q)]
        flat = (
            len(sides) == 2
            and abs(normals[one] @ normals[other]) > 1.0 - FLAT
            and (p == q or beside[0] @ beside[1] < 0)
        )
        if not flat:
            edges.append([a, b])
            across.append([p, q])
    assert found[0].tolist() == edges and found[1].tolist() == across
    assert edges
