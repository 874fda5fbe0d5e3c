"""Transforms, the pinhole camera, meshes, hulls and distances, against scipy, OpenCV, trimesh, Qhull and closed forms."""

import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from schemas.job.assets import CATEGORIES, ProceduralSource
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from tests.kit.contacts import box, mesh_of
from workers.assets.builtin.make import make_asset
from workers.geometry import mesh as meshes
from workers.geometry.camera import (
    is_cut,
    is_outside_views,
    project,
    project_bounds,
    spread_evenly,
    unproject,
)
from workers.geometry.distance import distance_to_mesh, nearest_on_segments
from workers.geometry.frames import (
    half_turn,
    invert,
    pose,
    quaternion_from_rotation,
    rotation_about,
    rotation_between,
    rotation_from_quaternion,
    transform,
    uniform_rotation,
)
from workers.geometry.hull import MOST_VERTICES, convex_hull, depth_m, least_width_m
from workers.geometry.mesh import concavity_m, face_planes, solid_of, weld

ROOT = Path(__file__).resolve().parents[3]


def test_turns_agree_with_scipy():
    rng = np.random.default_rng(0)
    for seed in range(6):
        a, b = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        angle, q = rng.uniform(-3, 3), rng.standard_normal(4)
        assert rotation_about(a, angle) == pytest.approx(Rotation.from_rotvec(angle * a).as_matrix(), abs=1e-12)
        assert half_turn(a) == pytest.approx(Rotation.from_rotvec(np.pi * a).as_matrix(), abs=1e-12)
        assert rotation_from_quaternion(q) == pytest.approx(Rotation.from_quat(q).as_matrix(), abs=1e-12)
        R = rotation_between(a, b)
        assert R @ a == pytest.approx(b, abs=1e-12)
        assert Rotation.from_matrix(R).magnitude() == pytest.approx(np.arccos(a @ b), abs=1e-7)
        for turn in (Rotation.random(random_state=seed), Rotation.from_rotvec(math.pi * np.eye(3)[seed % 3])):
            back = Rotation.from_quat(quaternion_from_rotation(turn.as_matrix()))
            assert back.as_matrix() == pytest.approx(turn.as_matrix(), abs=1e-12)


def test_uniform_rotations_have_no_favourite_direction():
    rng = np.random.default_rng(2)
    images = np.stack([uniform_rotation(rng)[:, 0] for _ in range(4000)])
    # Each coordinate of a uniform direction is uniform on [-1, 1]: mean 0, variance 1/3, four standard errors.
    assert np.abs(images.mean(axis=0)).max() < 4 / np.sqrt(3 * 4000)
    assert images.var(axis=0) == pytest.approx(1 / 3, abs=4 * np.sqrt(4 / 45 / 4000))


# ---------------------------------------------------------------------------------------------- the camera

K = Intrinsics(width=640, height=480, fx=525.0, fy=520.0, cx=320.0, cy=240.0)


def test_projection_agrees_with_opencv_and_unprojection_undoes_it():
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (50, 3))
    matrix = np.array([[K.fx, 0, K.cx_opencv], [0, K.fy, K.cy_opencv], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)
    # OpenCV's pixel (i, j) is centred on (i, j); ours on (i + 0.5, j + 0.5).
    assert np.stack(project(points, K), axis=1) - 0.5 == pytest.approx(expected[:, 0], abs=1e-9)
    rows, columns = np.array([0, 17, 479]), np.array([0, 333, 639])
    u, v = project(unproject(rows, columns, np.array([0.5, 2.0, 7.0]), K), K)
    assert (u, v) == (pytest.approx(columns + 0.5), pytest.approx(rows + 0.5))
    points = np.array([(0.0, 0.0, 1.0), (-1.0, 0.5, 1.0), (0.1, -0.2, 2.0)])
    assert project_bounds(points, K, 0.05) == pytest.approx((320.0 - 525.0, 240.0 - 52.0, 320.0 + 26.25, 240.0 + 260.0))
    assert project_bounds(np.array([(0.0, 0.0, 1.0), (0.0, 0.0, 0.05)]), K, 0.05) == (0.0, 0.0, 640.0, 480.0)


def test_no_camera_on_the_way_sees_a_point_of_what_is_outside():
    k, rng, outside = Intrinsics(width=64, height=48, fx=60.0, fy=55.0, cx=30.0, cy=26.0), np.random.default_rng(4), 0
    for _ in range(1_500):
        T = pose(uniform_rotation(rng), rng.normal(size=3))
        ahead = pose(T[:3, :3], T[:3, 3] + rng.normal() * T[:3, 2])
        points = rng.normal(size=3) * 2.0 + rng.uniform(0.01, 1.0) * rng.normal(size=(6, 3))
        if not is_outside_views(points, [Camera(k, T), Camera(k, ahead)]):
            continue
        outside += 1
        inner = rng.dirichlet(np.ones(6), 50) @ points
        for share in (0.0, 0.3, 0.7, 1.0):
            between = pose(T[:3, :3], (1.0 - share) * T[:3, 3] + share * ahead[:3, 3])
            seen = transform(invert(between), np.concatenate([points, inner]))
            u, v = project(seen[seen[:, 2] > 0.0], k)
            assert not ((u > 0.0) & (u < k.width) & (v > 0.0) & (v < k.height)).any()
    assert outside > 500


def test_the_near_plane_cuts_a_face_where_a_linear_program_finds_a_point_that_is_nearer_and_in_the_picture():
    """Weights of the corners, of sum 1, so that 0 <= z <= 0.05 and the sides hold: 0 <= fx x + cx z <= width z, and for y."""
    k, rng, found = (
        Intrinsics(width=64, height=48, fx=60.0, fy=55.0, cx=30.0, cy=26.0),
        np.random.default_rng(6),
        [0, 0],
    )

    def has_point(corners: np.ndarray, beside_px: float) -> bool:
        x, y, z = corners.T
        u, v = k.fx * x + k.cx * z, k.fy * y + k.cy * z
        sides = [-u - beside_px * z, u - (k.width + beside_px) * z, -v - beside_px * z, v - (k.height + beside_px) * z]
        return linprog(
            np.zeros(3), [*sides, z, -z], [0.0] * 4 + [0.05, 0.0], np.ones((1, 3)), [1.0], (0.0, None)
        ).success

    for _ in range(300):
        corners = rng.normal(size=(3, 3)) * rng.uniform(0.01, 0.3) + rng.normal(size=3) * 0.04
        cut = is_cut(corners[None], k)
        assert has_point(corners, 0.0) <= cut <= has_point(corners, 3.0)
        found[int(cut)] += 1
    assert min(found) > 40


def test_of_many_views_the_first_the_last_and_others_evenly_between_are_chosen():
    assert [spread_evenly(count, 4).tolist() for count in (0, 2, 10)] == [[], [0, 1], [0, 3, 6, 9]]
    for most, count in ((2, 7), (3, 100), (40, 199)):
        gaps = np.diff(spread_evenly(count, most))
        assert len(gaps) == most - 1 and gaps.min() > 0 and np.ptp(gaps) <= 1


# ---------------------------------------------------------------------------------------------- meshes

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
    done = subprocess.run([sys.executable, "-c", COUNT], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "True"]


def test_the_corners_of_a_face_lie_in_its_plane_and_a_face_without_area_has_none():
    ball = trimesh.creation.icosphere(2, 0.3).apply_translation((1.0, -2.0, 0.5))
    normals, offsets = face_planes(Mesh(ball.vertices, np.concatenate([ball.faces, [[0, 1, 1]]]).astype(np.int32)))
    assert normals[:-1] == pytest.approx(ball.face_normals, abs=1e-12)
    for corner in range(3):
        along = (normals[:-1] * ball.triangles[:, corner]).sum(axis=1)
        assert along == pytest.approx(offsets[:-1], abs=1e-12)
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


def test_triangles_of_few_places_are_welded_as_the_plain_reference_does():
    for seed in range(8):
        rng = np.random.default_rng(seed)
        vertices, faces = rng.choice([-1.0, -0.0, 0.0, 0.5], (60, 3)), rng.integers(0, 50, (200, 3)).astype(np.int32)
        expected, welded = weld_by_records(Mesh(vertices, faces)), weld(Mesh(vertices, faces))
        assert np.array_equal(welded.vertices, expected.vertices)
        assert np.array_equal(welded.faces, expected.faces) and welded.faces.dtype == expected.faces.dtype


def test_a_solid_has_its_volume_however_it_is_wound():
    mesh = weld(box((1, 2, 3)))
    for faces in (mesh.faces, mesh.faces[:, ::-1]):
        solid = solid_of(Mesh(mesh.vertices, faces))
        assert solid is not None and solid.volume() == pytest.approx(6.0)
        assert np.ptp(meshes.mesh_of(solid).vertices, axis=0) == pytest.approx([1.0, 2.0, 3.0])
    assert solid_of(Mesh(mesh.vertices, mesh.faces[1:])) is None


def test_the_depth_of_a_dent_is_found_and_a_convex_body_has_none():
    assert concavity_m(box((1, 1, 1))) == pytest.approx(0.0, abs=1e-12)
    dented = trimesh.creation.box((1, 1, 1)).subdivide()
    vertices = np.array(dented.vertices)
    vertices[(np.abs(vertices[:, :2]) < 1e-9).all(axis=1) & (vertices[:, 2] > 0), 2] -= 0.1
    assert 0.05 < concavity_m(Mesh(vertices, np.asarray(dented.faces, dtype=np.int32))) <= 0.1


# ---------------------------------------------------------------------------------------------- hulls


def farthest_outside(points, hull):
    """Metres that a point lies beyond the plane of a face of the hull, at most."""
    return float((points @ hull.normals.T - (hull.vertices @ hull.normals.T).max(axis=0)).max())


def test_the_hull_of_a_shape_is_the_one_that_qhull_finds():
    for index, category in enumerate([*CATEGORIES, "table"]):
        points = make_asset(category, ProceduralSource(source="procedural"), index, 600.0).shape.vertices
        hull, qhull = convex_hull(points), ConvexHull(points)
        assert ConvexHull(hull.vertices).volume == pytest.approx(qhull.volume, rel=1e-12)
        assert {tuple(p) for p in hull.vertices} <= {tuple(p) for p in points}
        assert farthest_outside(points, hull) < 1e-7 * 0.25, "1e-7 of its size"
        assert np.linalg.norm(hull.normals, axis=1) == pytest.approx(np.ones(len(hull.normals)))
        # Every direction of a face is one that Qhull has, and the other way round.
        agreement = hull.normals @ qhull.equations[:, :3].T
        assert agreement.max(axis=1).min() > 1.0 - 1e-9
        a, b, c = (points[qhull.simplices[:, k]] for k in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        assert agreement.max(axis=0)[areas > 1e-9].min() > 1.0 - 1e-9
        point = 0.3 * hull.vertices.mean(axis=0) + 0.01
        deep_m = -(qhull.equations[:, :3] @ point + qhull.equations[:, 3]).max()
        assert depth_m(hull.vertices - point, hull.normals) == pytest.approx(deep_m, rel=1e-6)


def test_a_thin_sheet_keeps_its_thickness():
    for thick in (0.0, 1e-8, 1e-6, 1e-5, 1e-3):
        points = np.random.default_rng(1).random((200, 3)) * [1.0, 1.0, thick]
        hull = convex_hull(points)
        assert len(hull.vertices) >= 4
        assert np.ptp(hull.vertices[:, 2]) == pytest.approx(thick, rel=0.2, abs=1e-12)
        assert farthest_outside(points, hull) < 1e-9 + 1e-7 * thick


def test_a_hull_with_too_many_vertices_is_made_coarser_by_little():
    """PyBullet fails beyond 131,072 vertices. An ellipsoid, every point of which is on its hull."""
    points = np.random.default_rng(2).normal(size=(60_000, 3))
    points *= np.array([0.2, 0.1, 0.15]) / np.linalg.norm(points, axis=1)[:, None]
    hull = convex_hull(points)
    assert 1000 < len(hull.vertices) <= MOST_VERTICES
    assert {tuple(p) for p in hull.vertices} <= {tuple(p) for p in points}
    directions = np.random.default_rng(3).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    out = (points @ directions.T).max(axis=0) - (hull.vertices @ directions.T).max(axis=0)
    assert 0.0 <= out.max() < 2e-4 * 0.54


def test_the_least_width_of_a_plate_is_its_thickness():
    assert least_width_m(convex_hull(box((0.2, 0.3, 0.0005)).vertices)) == pytest.approx(5e-4, rel=1e-12)
    tilted = trimesh.creation.cylinder(0.004, 0.1, sections=360)
    tilted.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    width = 0.008 * np.cos(np.pi / 360)
    assert least_width_m(convex_hull(np.asarray(tilted.vertices))) == pytest.approx(width, rel=1e-9)


# ---------------------------------------------------------------------------------------------- distances


def test_distances_to_a_mesh_are_those_that_trimesh_finds():
    body = trimesh.creation.torus(0.05, 0.02, major_sections=12, minor_sections=7)
    points = np.random.default_rng(0).normal(size=(400, 3)) * 0.05
    pairs = np.repeat(points, len(body.faces), axis=0)
    nearest = trimesh.triangles.closest_point(np.tile(body.triangles, (len(points), 1, 1)), pairs)
    every = np.linalg.norm(nearest - pairs, axis=1).reshape(len(points), -1)
    distance, face = distance_to_mesh(points, mesh_of(body))
    assert distance == pytest.approx(every.min(axis=1), abs=1e-12)
    assert every[np.arange(len(points)), face] == pytest.approx(distance, abs=1e-12)


def test_the_nearest_points_of_two_segments_are_as_near_as_any_of_many():
    """Against all pairs of 400 points of each; and parallel segments and points as segments, in closed form."""
    chance, here, there = np.random.default_rng(5), np.empty(3), np.empty(3)
    share = np.linspace(0.0, 1.0, 400)[:, None]
    for a, b, c, d in chance.uniform(-1.0, 1.0, (60, 4, 3)):
        nearest_on_segments(a, b, c, d, here, there)
        points, others = a + share * (b - a), c + share * (d - c)
        least = np.linalg.norm(points[:, None] - others[None], axis=2).min()
        assert least - 0.004 < np.linalg.norm(there - here) <= least + 1e-12
        assert max(np.linalg.norm(np.cross(here - a, b - a)), np.linalg.norm(np.cross(there - c, d - c))) < 1e-12
    x, y, _ = np.eye(3)
    for segments in (
        (0 * x, x, y, x + y),
        (0 * x, x, 3 * x, 2 * x),
        (0 * x, 0 * x, y, y),
        (0 * x, 0 * x, y - x, y + x),
        (y - x, y + x, 0 * x, 0 * x),
    ):
        nearest_on_segments(*segments, here, there)
        assert np.linalg.norm(there - here) == pytest.approx(1.0)
