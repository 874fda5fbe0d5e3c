"""How near objects come, against distances worked out by hand and by separating axes."""

import itertools
import math

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Mesh
from tests.shapes import box
from workers.geometry.convexity import solid_of, weld
from workers.geometry.elevation import prepare_terrain
from workers.geometry.frames import pose, rotation_about, transform, uniform_rotation
from workers.physics.separation import NEAR_M, between, clearances, find_gaps_m


def mesh_of(body, T=None) -> Mesh:
    vertices = np.asarray(body.vertices, dtype=np.float64)
    return Mesh(vertices if T is None else transform(T, vertices), np.asarray(body.faces, dtype=np.int32))


def solid(mesh: Mesh):
    return solid_of(weld(mesh))


CUBE = box(0.1, 0.1, 0.1)
GROUND = prepare_terrain(mesh_of(box(2.0, 2.0, 0.1, (0, 0, -0.05))))


@pytest.mark.parametrize("gap_m", [1e-5, 0.003, 0.015, -1e-5, -0.002, -0.03])
@pytest.mark.parametrize("axis", range(3))
def test_two_boxes_are_as_near_or_as_deep_as_they_were_put(axis, gap_m):
    other = box(0.1, 0.1, 0.1, tuple(np.eye(3)[axis] * (0.1 + gap_m)))
    assert between(solid(mesh_of(CUBE)), solid(mesh_of(other))) == pytest.approx(gap_m, abs=1e-9)


def test_two_edges_across_one_another_are_as_near_as_their_heights():
    """A cube on its edge along x over one on its edge along y."""
    low = mesh_of(CUBE, pose(rotation_about(np.array([0.0, 1, 0]), math.pi / 4), np.zeros(3)))
    up = np.array([0.0, 0.0, 0.1 * math.sqrt(2.0) + 0.004])
    high = mesh_of(CUBE, pose(rotation_about(np.array([1.0, 0, 0]), math.pi / 4), up))
    assert between(solid(low), solid(high)) == pytest.approx(0.004, abs=1e-9)


def test_what_is_further_than_is_looked_at_is_as_far_as_that():
    assert between(solid(mesh_of(CUBE)), solid(mesh_of(box(0.1, 0.1, 0.1, (0.2, 0, 0))))) == pytest.approx(NEAR_M)


@pytest.mark.parametrize("seed", range(12))
def test_no_two_tilted_boxes_are_apart_where_no_axis_separates_them_nor_the_other_way_round(seed):
    """Two convex bodies are apart if and only if one of their normals, or of their edges' products, separates them."""
    rng = np.random.default_rng(seed)
    turns = [uniform_rotation(rng) for _ in range(2)]
    places = np.zeros(3), rng.uniform(-0.1, 0.1, 3)
    a, b = (mesh_of(CUBE, pose(R, at)) for R, at in zip(turns, places, strict=True))
    axes = [*turns[0].T, *turns[1].T, *(np.cross(u, v) for u, v in itertools.product(turns[0].T, turns[1].T))]
    apart = [
        max(
            float((b.vertices @ n).min() - (a.vertices @ n).max()),
            float((a.vertices @ n).min() - (b.vertices @ n).max()),
        )
        for n in (axis / np.linalg.norm(axis) for axis in axes)
    ]
    found = between(solid(a), solid(b))
    if max(apart) > 0.0:
        assert found >= min(max(apart), NEAR_M) - 1e-9  # no less than along any axis
    else:
        assert -0.1 <= found < 0.0


def test_a_ball_in_a_hollow_is_as_near_as_the_radii_leave_it():
    """A hollow half ball of 50 mm, a ball of 20 mm put 27 mm below its centre: 3 mm are left, but for the facets."""
    outer = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    block = trimesh.boolean.difference([box(0.14, 0.14, 0.06, (0, 0, -0.03)), outer], engine="manifold")
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.02).apply_translation((0, 0, -0.027))
    assert between(solid(mesh_of(block)), solid(mesh_of(ball))) == pytest.approx(0.003, abs=5e-5)


def test_each_object_is_told_of_what_is_nearest_to_it_the_ground_or_another():
    meshes = [
        mesh_of(box(0.1, 0.1, 0.1, (0, 0, 0.05 + 0.001))),  # 1 mm over the ground, 2 mm below the next
        mesh_of(box(0.1, 0.1, 0.1, (0, 0, 0.153))),
        mesh_of(box(0.1, 0.1, 0.1, (0.099, 0, 0.154))),  # 1 mm deep in the second
        mesh_of(box(0.1, 0.1, 0.1, (0.5, 0, 0.05 - 0.0005))),  # in the ground
        mesh_of(box(0.1, 0.1, 0.1, (-0.5, 0, 0.3))),  # alone in the air
    ]
    assert clearances(meshes, GROUND) == pytest.approx([0.001, -0.001, -0.001, -0.0005, 0.25], abs=1e-9)


def test_an_overlap_is_the_depth_and_nothing_where_two_bodies_only_touch_or_are_apart():
    for way, expected in ((0.098, 0.002), (0.1, 0.0), (0.11, 0.0), (3.0, 0.0)):
        pair = [mesh_of(CUBE), mesh_of(box(0.1, 0.1, 0.1, (0, way, 0)))]
        depths = [-gap for _, _, gap in find_gaps_m(pair, near_m=0.0)]
        assert max(0.0, *depths, 0.0) == pytest.approx(expected, abs=1e-9)


def test_what_touches_the_side_of_a_wall_is_as_deep_in_it_as_it_reaches_and_not_as_the_wall_is_high():
    walled = prepare_terrain(
        mesh_of(trimesh.util.concatenate([box(2.0, 2.0, 0.1, (0, 0, -0.05)), box(0.02, 1.0, 0.3, (0.06, 0, 0.1))]))
    )
    for way in (1e-6, 3e-5, 4e-4):
        assert clearances([mesh_of(box(0.1, 0.1, 0.1, (way, 0, 0.05)))], walled)[0] == pytest.approx(-way, abs=2e-7)
    assert clearances([mesh_of(box(0.1, 0.1, 0.1, (-1e-6, 0, 0.051)))], walled)[0] == pytest.approx(0.001, abs=1e-9)


def test_what_encloses_no_body_stands_for_its_hull():
    walls = CUBE.faces[CUBE.face_normals[:, 2] < 0.5]  # an open box
    open_box = Mesh(np.asarray(CUBE.vertices) + np.array([0, 0, 0.05]), np.asarray(walls, dtype=np.int32))
    inside = mesh_of(box(0.01, 0.01, 0.01, (0, 0, 0.09)))
    assert clearances([open_box, inside], GROUND)[1] == pytest.approx(-0.01, abs=1e-9)
