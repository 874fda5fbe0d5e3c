"""The ray caster's loops against polygons cut by shapely and the same formulas in numpy, to the last bit.

The ray caster against planes, spheres and segments in closed form.
"""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.camera import orbit_pose, project
from workers.geometry.frames import pose, transform, translation, uniform_rotation
from workers.geometry.raycast import (
    NEAR_M,
    cast_view,
    edge_distance_px,
    first_hit,
)

K = Intrinsics(width=160, height=120, fx=130.0, fy=140.0, cx=77.3, cy=62.1)
EYE = np.eye(4)


def shape_of(vertices: object, faces: object) -> Shape:
    return Shape((Part("part", frozen_array(vertices), frozen_array(faces, np.int32)),))


def square(z: float, half: float = 50.0) -> Shape:
    return shape_of([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]], [[0, 1, 2], [0, 2, 3]])


def mesh(body: trimesh.Trimesh) -> Shape:
    return shape_of(body.vertices, body.faces)


def rays(k: Intrinsics):
    """[H, W, 3] float64: directions with z = 1 through the pixel centres."""
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    return np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=2)


def test_depth_of_a_tilted_plane_is_exact_to_ten_picometres():
    """Embree's own float32 distance would be off by ten thousand times as much."""
    h = 30.0
    floor = Placed(1, shape_of([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]], [[0, 1, 2], [0, 2, 3]]), EYE)
    T = orbit_pose(np.array([0.1, -0.2, 0.8]), 0.75, 2.0, 2.5)
    depth, region, cosine = cast_view([floor], Camera(K, T))
    normal = T[:3, :3].T @ [0.0, 0.0, 1.0]
    across = rays(K) @ normal
    assert (region == 1).all()
    assert np.abs(depth - -T[2, 3] / across).max() < 1e-11
    np.testing.assert_allclose(cosine, np.abs(across) / np.linalg.norm(rays(K), axis=2), rtol=1e-6)


def test_rays_go_through_pixel_centres():
    k = Intrinsics(width=8, height=6, fx=1.0, fy=1.0, cx=0.0, cy=0.0)  # at z = 1 a metre is a pixel
    tile = Placed(
        5, shape_of([[2.6, 1.4, 1], [5.4, 1.4, 1], [5.4, 3.6, 1], [2.6, 3.6, 1]], [[0, 1, 2], [0, 2, 3]]), EYE
    )
    expected = np.zeros((6, 8), np.uint8)
    expected[1:4, 3:5] = 5
    np.testing.assert_array_equal(cast_view([tile], Camera(k, EYE))[1], expected)


def test_of_coplanar_faces_the_lowest_region_id_wins_in_any_order():
    low, high = square(2.0, 0.4), square(2.0, 0.3)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T = pose(uniform_rotation(rng), np.array([0.0, 0.0, 2.5])) @ translation(0, 0, -2.0)
        things = [Placed(9, high, T), Placed(4, low, T)]
        for order in (things, things[::-1]):
            region = cast_view(order, Camera(K, EYE))[1]
            assert set(np.unique(region)) <= {0, 4}
            assert (region == 4).any()


def test_what_lies_before_the_near_plane_is_passed_through():
    things = [Placed(3, square(NEAR_M - 1e-3), EYE), Placed(4, square(1.0), EYE)]
    depth, region, _ = cast_view(things, Camera(K, EYE))
    assert (region == 4).all()
    np.testing.assert_allclose(depth, 1.0, atol=1e-12)


def test_a_thing_partly_behind_the_camera_is_seen_where_it_is_in_front():
    """A wall along the line of sight, 0.3 m to the right: its depth at column u is 0.3 fx / (u - cx)."""
    wall = shape_of([[0.3, -9, -5], [0.3, -9, 50], [0.3, 9, 50], [0.3, 9, -5]], [[0, 1, 2], [0, 2, 3]])
    depth, region, _ = cast_view([Placed(3, wall, EYE)], Camera(K, EYE))
    u = np.arange(K.width) + 0.5 - K.cx
    expected = np.where(
        (u > 0) & (0.3 * K.fx / np.where(u > 0, u, 1.0) < 50),
        0.3 * K.fx / np.where(u > 0, u, 1.0),
        0.0,
    )
    np.testing.assert_allclose(depth[60], expected, rtol=1e-9)
    assert ((region[60] == 3) == (expected > 0)).all()


def test_a_closed_mesh_lets_no_ray_through():
    """20,480 triangles, most under a pixel: inside the outline there is no hole."""
    ball = trimesh.creation.icosphere(5, 0.5)
    region = cast_view([Placed(3, mesh(ball), translation(0, 0, 1.5))], Camera(K, EYE))[1]
    d = rays(K)
    inside = np.arctan(np.linalg.norm(d[:, :, :2], axis=2)) < np.arcsin(0.5 / 1.5) - 0.01
    assert (region[inside] == 3).all()


def test_pixels_that_a_thing_cannot_reach_are_left_out_and_no_others():
    """Through every pixel: things within the image, over its border, one edge-on, and one that the near plane cuts."""
    ball, every = mesh(trimesh.creation.icosphere(2, 0.5)), rays(K).reshape(-1, 3)
    slab = shape_of([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    for seed in range(30):
        rng = np.random.default_rng(seed)
        places = [np.array([*rng.uniform(-1.5, 1.5, 2), z]) for z in (2.5, 4.0, 0.4)]
        things = [Placed(3 + n, (ball, slab, ball)[n], pose(uniform_rotation(rng), at)) for n, at in enumerate(places)]
        things.append(Placed(9, slab, pose(uniform_rotation(rng), np.array([0.0, 0.0, 1e3]))))
        depth, region, cosine = cast_view(things, Camera(K, EYE))
        hits = first_hit(things, NEAR_M * every, every)
        np.testing.assert_array_equal(region.ravel(), hits.region)
        np.testing.assert_array_equal(cosine.ravel(), hits.incidence_cos)
        expected = np.where(hits.region > 0, hits.distance + NEAR_M, 0.0)
        np.testing.assert_allclose(depth.ravel(), expected, rtol=1e-14)


# ---------------------------------------------------------------------------------------------------------- edges


@pytest.mark.parametrize("split", [False, True], ids=["shared-vertices", "split-vertices"])
def test_the_outline_of_a_sphere_is_its_circle(split):
    """Seams split vertices; the edges along them are no outline."""
    k = Intrinsics(width=160, height=160, fx=130.0, fy=130.0, cx=80.0, cy=80.0)
    ball = trimesh.creation.icosphere(5, 0.5)
    faces = np.arange(3 * len(ball.faces)).reshape(-1, 3)
    thing = Placed(3, shape_of(ball.triangles.reshape(-1, 3), faces) if split else mesh(ball), translation(0, 0, 2.5))
    pixels = np.array([[80, 80], [80, 100], [30, 82], [5, 150]])
    circle = 130.0 * np.tan(np.arcsin(0.5 / 2.5))
    expected = np.abs(np.linalg.norm(pixels + 0.5 - 80.0, axis=1) - circle)
    found = edge_distance_px([thing], Camera(k, EYE), pixels, outline_only=True)
    assert np.abs(found - expected).max() < 0.1
    assert edge_distance_px([thing], Camera(k, EYE), pixels)[:2].max() < 0.3, "inside, other edges are near"


def test_the_distance_is_that_to_the_nearest_of_all_projected_edges():
    ball = Placed(3, mesh(trimesh.creation.icosphere(3, 0.5)), translation(0.1, 0.0, 2.5))
    pixels = np.argwhere(np.ones((20, 20)))
    seen = transform(ball.T_world_shape, ball.shape.vertices)
    u, v = project(seen, K)
    start, end = (np.stack([u, v], axis=1)[ball.shape.faces[:, k]].reshape(-1, 2) for k in ([0, 1, 2], [1, 2, 0]))
    along, away = end - start, pixels[:, None, ::-1] + 0.5 - start
    share = np.clip((away * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    expected = np.linalg.norm(away - share[:, :, None] * along, axis=2).min(axis=1)
    for some in (slice(None), slice(0, 1), slice(200, 212)):  # many and few are searched in different ways
        found = edge_distance_px([ball], Camera(K, EYE), pixels[some])
        np.testing.assert_allclose(found, expected[some], atol=1e-9)
