"""Bounding boxes of points, against numpy.

Equal rows, against a sort of them. manifold3d starts no threads in a worker. Welding, pieces, depth below the hull
and solids, on bodies of known measure. Convex hulls, against Qhull and closed forms.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from schemas.job.assets import CATEGORIES, ProceduralSource
from schemas.scene.shape import Mesh
from workers.assets.builtin.make import make_asset
from workers.geometry.hull import MOST_VERTICES, convex_hull, depth_m, least_width_m
from workers.geometry.mesh import (
    concavity_m,
    face_planes,
    mesh_of,
    solid_of,
    triangle_corners,
    weld,
)

COUNT = """
import os, re
import numpy as np
from workers.assets.builtin.make import make_model
from workers.geometry.hull import convex_hull
threads = lambda: int(re.search(r"Threads:\\s+(\\d+)", open("/proc/self/status").read()).group(1))
before, cores = threads(), os.sched_getaffinity(0)
for index in range(3):
    convex_hull(np.random.default_rng(index).random((50_000, 3)))
    convex_hull(make_model("camera", 0, index).solid.vertices)
print(threads() - before, os.sched_getaffinity(0) == cores)
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_booleans_and_hulls_start_no_threads_and_leave_the_process_its_cores():
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", COUNT], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "True"]


def as_mesh(*bodies: trimesh.Trimesh) -> Mesh:
    whole: Any = trimesh.util.concatenate(list(bodies))
    return Mesh(np.asarray(whole.vertices), np.asarray(whole.faces, dtype=np.int32))


def box(size, at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


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


SOURCE = ProceduralSource(source="procedural")


def farthest_outside(points, hull):
    """Metres that a point lies beyond the plane of a face of the hull, at most."""
    support = (hull.vertices @ hull.normals.T).max(axis=0)
    return float((points @ hull.normals.T - support).max())


@pytest.mark.parametrize("category", [*CATEGORIES, "table"])
def test_the_hull_of_a_shape_is_the_one_that_qhull_finds(category):
    for index in range(5):
        points = make_asset(category, SOURCE, index, 600.0).shape.vertices
        hull, qhull = convex_hull(points), ConvexHull(points)
        assert ConvexHull(hull.vertices).volume == pytest.approx(qhull.volume, rel=1e-12)
        assert {tuple(p) for p in hull.vertices} <= {tuple(p) for p in points}
        assert farthest_outside(points, hull) < 1e-7 * 0.25, "1e-7 of its size"
        assert np.linalg.norm(hull.normals, axis=1) == pytest.approx(np.ones(len(hull.normals)))
        # Every direction of a face is one that Qhull has, and the other way round.
        agreement = hull.normals @ qhull.equations[:, :3].T
        assert agreement.max(axis=1).min() > 1.0 - 1e-9
        areas = np.linalg.norm(
            np.cross(*(points[qhull.simplices[:, k]] - points[qhull.simplices[:, 0]] for k in (1, 2))), axis=1
        )
        assert agreement.max(axis=0)[areas > 1e-9].min() > 1.0 - 1e-9


@pytest.mark.parametrize("thick", [0.0, 1e-8, 1e-6, 1e-5, 1e-3])
def test_a_thin_sheet_keeps_its_thickness(thick):
    points = np.random.default_rng(1).random((200, 3)) * [1.0, 1.0, thick]
    hull = convex_hull(points)
    assert len(hull.vertices) >= 4
    assert np.ptp(hull.vertices[:, 2]) == pytest.approx(thick, rel=0.2, abs=1e-12)
    assert farthest_outside(points, hull) < 1e-9 + 1e-7 * thick


def test_a_hull_with_too_many_vertices_is_made_coarser_by_little():
    """PyBullet fails beyond 131,072. An ellipsoid, every point of which is on its hull."""
    points = np.random.default_rng(2).normal(size=(150_000, 3))
    points *= np.array([0.2, 0.1, 0.15]) / np.linalg.norm(points, axis=1)[:, None]
    hull = convex_hull(points)
    assert 1000 < len(hull.vertices) <= MOST_VERTICES
    assert {tuple(p) for p in hull.vertices} <= {tuple(p) for p in points}
    directions = np.random.default_rng(3).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    out = (points @ directions.T).max(axis=0) - (hull.vertices @ directions.T).max(axis=0)
    assert 0.0 <= out.max() < 2e-4 * 0.54


def test_the_least_width_of_a_plate_is_its_thickness():
    assert least_width_m(convex_hull(trimesh.creation.box((0.2, 0.3, 0.0005)).vertices)) == pytest.approx(
        5e-4, rel=1e-12
    )
    tilted = trimesh.creation.cylinder(0.004, 0.1, sections=360)
    tilted.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    assert least_width_m(convex_hull(np.asarray(tilted.vertices))) == pytest.approx(
        0.008 * np.cos(np.pi / 360), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_depth_of_a_point_in_a_hull_is_its_least_distance_from_a_plane_of_a_face(seed):
    rng = np.random.default_rng(seed)
    hull = convex_hull(rng.standard_normal((200, 3)))
    qhull = ConvexHull(hull.vertices)
    point = 0.3 * rng.standard_normal(3)
    expected = -(qhull.equations[:, :3] @ point + qhull.equations[:, 3]).max()
    assert depth_m(hull.vertices - point, hull.normals) == pytest.approx(expected, rel=1e-12)
