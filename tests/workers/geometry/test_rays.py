"""The ray caster against closed forms, and the small rasteriser against it; pixels that a shape covers by itself."""

from dataclasses import replace

import numpy as np
import trimesh

from schemas.base import frozen_array
from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Camera, Intrinsics
from tests.kit.contacts import mesh_of
from tests.workers.geometry.made_up_kinect import (
    CAMERA,
    COLOR,
    COLOR_LENS,
    DEPTH,
    DEPTH_LENS,
    T_COLOR_DEPTH,
    opencv_rays,
    plane_depth,
    plane_in_depth_camera,
    smaller,
    sphere_depth,
)
from tests.workers.render.random_scenes import facing, quad
from workers.geometry.camera import NEAR_M, look_at, orbit_pose, project
from workers.geometry.frames import pose, rotation_about, transform, translation, uniform_rotation
from workers.geometry.pixels import project_points
from workers.geometry.raycast import cast_view, edge_distance_px, first_hit
from workers.geometry.zbuffer import LARGEST_PX, NEAREST_M, count_covered, draw_depth, register_depth

K = Intrinsics(width=160, height=120, fx=130.0, fy=140.0, cx=77.3, cy=62.1)
EYE = np.eye(4)


def shape_of(vertices: object, faces: object, closed: bool = False) -> Shape:
    return Shape((Part("part", frozen_array(vertices), frozen_array(faces, np.int32)),), closed)


def body(mesh: trimesh.Trimesh, closed: bool = False) -> Shape:
    return shape_of(mesh.vertices, mesh.faces, closed)


def rays(k: Intrinsics):
    """[H, W, 3] float64: directions with z = 1 through the pixel centres."""
    v, u = np.mgrid[0 : k.height, 0 : k.width] + 0.5
    return np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=2)


def cast(*things: Placed, k: Intrinsics = K, T=EYE):
    return cast_view(things, Camera(k, T))


def test_depth_of_a_tilted_plane_is_exact_to_ten_picometres():
    """Embree's own float32 distance would be off by ten thousand times as much."""
    T = orbit_pose(np.array([0.1, -0.2, 0.8]), 0.75, 2.0, 2.5)
    depth, region, cosine = cast(Placed(1, facing(0.0, 30.0), EYE), T=T)
    across = rays(K) @ T[2, :3]
    assert (region == 1).all()
    assert np.abs(depth - -T[2, 3] / across).max() < 1e-11
    np.testing.assert_allclose(cosine, np.abs(across) / np.linalg.norm(rays(K), axis=2), rtol=1e-6)


def test_of_coplanar_faces_the_lowest_region_id_wins_in_any_order():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T = pose(uniform_rotation(rng), np.array([0.0, 0.0, 2.5])) @ translation(0, 0, -2.0)
        things = [Placed(9, facing(2.0, 0.3), T), Placed(4, facing(2.0, 0.4), T)]
        for order in (things, things[::-1]):
            region = cast(*order)[1]
            assert set(np.unique(region)) <= {0, 4} and (region == 4).any()


def test_what_lies_before_the_near_plane_is_passed_through_and_what_is_partly_behind_the_camera_is_seen_in_front():
    """A wall along the line of sight, 0.3 m to the right: its depth at column u is 0.3 fx / (u - cx)."""
    depth, region, _ = cast(Placed(3, facing(NEAR_M - 1e-3), EYE), Placed(4, facing(1.0), EYE))
    assert (region == 4).all()
    np.testing.assert_allclose(depth, 1.0, atol=1e-12)
    wall = quad([[0.3, -9, -5], [0.3, -9, 50], [0.3, 9, 50], [0.3, 9, -5]])
    depth, region, _ = cast(Placed(3, wall, EYE))
    with np.errstate(divide="ignore"):
        z = 0.3 / rays(K)[60, :, 0]
    expected = np.where((z > 0) & (z < 50), z, 0.0)
    np.testing.assert_allclose(depth[60], expected, rtol=1e-9)
    assert ((region[60] == 3) == (expected > 0)).all()


def test_a_closed_mesh_lets_no_ray_through():
    """20,480 triangles, most under a pixel: inside the outline there is no hole."""
    region = cast(Placed(3, body(trimesh.creation.icosphere(5, 0.5)), translation(0, 0, 1.5)))[1]
    inside = np.arctan(np.linalg.norm(rays(K)[:, :, :2], axis=2)) < np.arcsin(0.5 / 1.5) - 0.01
    assert (region[inside] == 3).all()


def test_pixels_that_a_thing_cannot_reach_are_left_out_and_no_others():
    """Through every pixel: things within the image, over its border, one edge-on, and one that the near plane cuts."""
    ball, every, slab = body(trimesh.creation.icosphere(2, 0.5)), rays(K).reshape(-1, 3), facing(0.0, 1.0)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        places = [np.array([*rng.uniform(-1.5, 1.5, 2), z]) for z in (2.5, 4.0, 0.4)]
        things = [Placed(3 + n, (ball, slab, ball)[n], pose(uniform_rotation(rng), at)) for n, at in enumerate(places)]
        things.append(Placed(9, slab, pose(uniform_rotation(rng), np.array([0.0, 0.0, 1e3]))))
        depth, region, cosine = cast(*things)
        hits = first_hit(things, NEAR_M * every, every)
        np.testing.assert_array_equal(region.ravel(), hits.region)
        np.testing.assert_array_equal(cosine.ravel(), hits.incidence_cos)
        np.testing.assert_allclose(depth.ravel(), np.where(hits.region > 0, hits.distance + NEAR_M, 0.0), rtol=1e-14)


def test_the_outline_of_a_sphere_is_its_circle():
    """Seams split vertices; the edges along them are no outline."""
    k = Intrinsics(width=160, height=160, fx=130.0, fy=130.0, cx=80.0, cy=80.0)
    ball = trimesh.creation.icosphere(5, 0.5)
    split = shape_of(ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    pixels = np.array([[80, 80], [80, 100], [30, 82], [5, 150]])
    circle = 130.0 * np.tan(np.arcsin(0.5 / 2.5))
    expected = np.abs(np.linalg.norm(pixels + 0.5 - 80.0, axis=1) - circle)
    for shape in (body(ball), split):
        thing = Placed(3, shape, translation(0, 0, 2.5))
        found = edge_distance_px([thing], Camera(k, EYE), pixels, outline_only=True)
        assert np.abs(found - expected).max() < 0.1
        assert edge_distance_px([thing], Camera(k, EYE), pixels)[:2].max() < 0.3, "inside, other edges are near"


def test_the_distance_is_that_to_the_nearest_of_all_projected_edges():
    ball = Placed(3, body(trimesh.creation.icosphere(3, 0.5)), translation(0.1, 0.0, 2.5))
    pixels = np.argwhere(np.ones((20, 20)))
    corners = np.stack(project(transform(ball.T_world_shape, ball.shape.vertices), K), axis=1)[ball.shape.faces]
    start, end = corners.reshape(-1, 2), corners[:, [1, 2, 0]].reshape(-1, 2)
    along, away = end - start, pixels[:, None, ::-1] + 0.5 - start
    share = np.clip((away * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    expected = np.linalg.norm(away - share[:, :, None] * along, axis=2).min(axis=1)
    for some in (slice(None), slice(0, 1), slice(200, 212)):  # many and few are searched in different ways
        found = edge_distance_px([ball], Camera(K, EYE), pixels[some])
        np.testing.assert_allclose(found, expected[some], atol=1e-9)


# ---------------------------------------------------------------------------------------------- depth that is drawn


def test_depth_is_that_of_the_nearest_face_at_each_pixel_centre():
    k = Intrinsics(width=160, height=120, fx=200.0, fy=205.0, cx=81.0, cy=57.5)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        knot = trimesh.creation.torus(0.1, 0.035, major_sections=40, minor_sections=16)
        knot.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
        camera = Camera(k, frozen_array(look_at(np.array([0.3, -0.2, 0.35]), rng.normal(0, 0.02, 3))))
        drawn, (truth, _, _) = draw_depth(mesh_of(knot), camera), cast_view([Placed(3, body(knot), EYE)], camera)
        assert ((drawn > 0) != (truth > 0)).sum() <= 2  # rays through an edge, in the caster's float32
        both = (drawn > 0) & (truth > 0)
        # On a silhouette float32 may take the one face or the other.
        assert both.sum() > 2000 and np.quantile(np.abs(drawn - truth)[both], 0.999) < 1e-6


SMALL_COLOR = smaller(COLOR, 0.25)
SMALL = replace(CAMERA, intrinsics=smaller(DEPTH, 0.25))
DEPTH_RAYS = opencv_rays(SMALL.intrinsics, DEPTH_LENS)


def unit(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z]) / np.linalg.norm([x, y, z])


def test_a_plane_stays_the_plane_whether_or_not_the_colour_image_is_stored_with_its_lens():
    """The lens of the colour image is taken as straight over a triangle; its error falls with the square of the resolution."""
    for normal in (unit(0, 0, 1), unit(0.5, -0.3, 1), unit(0, 1.5, 1)):
        for lens in (COLOR_LENS, None):
            depth = plane_depth(DEPTH_RAYS, *plane_in_depth_camera(T_COLOR_DEPTH, normal, 0.7))
            seen = register_depth(depth, SMALL, SMALL_COLOR, lens)
            true = plane_depth(opencv_rays(SMALL_COLOR, np.zeros(8) if lens is None else lens), normal, 0.7)
            filled = seen > 0
            assert np.abs(seen - true)[filled].max() * 1e3 < 0.2
            assert filled.mean() > 0.4
            rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
            middle = filled[rows[0] + 30 : rows[-1] - 29, columns[0] + 40 : columns[-1] - 39]
            assert middle.all(), "no holes and no cracks"


def test_a_sphere_before_a_wall_hides_it():
    """The nearest wins; what neither camera's edge touches is exact to the sag of a triangle."""
    wall, radius, colour_rays = unit(0.1, 0.1, 1), 0.12, opencv_rays(SMALL_COLOR, COLOR_LENS)
    R, t, k = T_COLOR_DEPTH[:3, :3], T_COLOR_DEPTH[:3, 3], SMALL.intrinsics
    for seed in range(2):
        centre = np.random.default_rng(seed).uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8])
        near = sphere_depth(DEPTH_RAYS, R.T @ (centre - t), radius)
        far = plane_depth(DEPTH_RAYS, *plane_in_depth_camera(T_COLOR_DEPTH, wall, 1.2))
        seen = register_depth(np.where(near > 0, near, far), SMALL, SMALL_COLOR, COLOR_LENS)
        ball, plane = sphere_depth(colour_rays, centre, radius), plane_depth(colour_rays, wall, 1.2)
        points = ball[:, :, None] * colour_rays
        core = ball > 0
        for eye in (np.zeros(3), t):  # both cameras see it at less than 60 degrees
            to_eye = eye - points
            core &= ((points - centre) * to_eye).sum(axis=2) > 0.5 * radius * np.linalg.norm(to_eye, axis=2)
        at = project_points((points.reshape(-1, 3) - t) @ R, k, DEPTH_LENS).reshape(*ball.shape, 2)
        core &= (abs(at - (80, 72)) < (79, 71)).all(axis=2)
        assert core.sum() > 1000
        sag_m = (0.8 / k.fx / 0.5) ** 2 / (4 * radius) / 0.5  # a diagonal's square over 8 r, over the slant
        assert np.abs(seen - ball)[core].max() < sag_m
        wrong = (seen > 0) & (np.abs(seen - ball) > 0.01) & (np.abs(seen - plane) > 1e-5)
        assert wrong.sum() < 0.02 * (ball > 0).sum(), "nothing floats between the sphere and the wall"


def test_a_square_across_an_edge_is_left_out_and_a_steep_plane_is_not():
    k, straight = SMALL.intrinsics, replace(SMALL, lens=np.zeros(8), T_color_depth=frozen_array(EYE))
    depth = np.full((k.height, k.width), 0.7)
    depth[:, 80:] = 0.8
    seen = register_depth(depth, replace(straight, T_color_depth=frozen_array(translation(-0.05, 0.0, 0.0))), k)
    assert np.unique(seen[seen > 0].round(9)).tolist() == [0.7, 0.8]
    slanted = rotation_about(np.array([0.0, 1.0, 0.0]), np.radians(80)) @ np.array([0.0, 0.0, 1.0])
    steep = plane_depth(opencv_rays(k, np.zeros(8)), slanted, 0.12)
    assert (register_depth(steep, straight, k)[:, 80:] > 0).mean() > 0.95


# ---------------------------------------------------------------------------------------------- pixels that are covered

EVEN = Intrinsics(width=160, height=120, fx=128.0, fy=128.0, cx=80.0, cy=60.0)
"""A pixel is 1/128 m wide at a distance of one metre."""


def test_a_centre_on_an_edge_belongs_to_what_is_on_its_right_or_below():
    for (left, top, right, bottom), pixels in (
        ((10.0, 20.0, 30.0, 50.0), 20 * 30),
        ((10.5, 20.5, 30.5, 50.5), 20 * 30),  # through centres
        ((10.5, 20.5, 30.25, 50.25), 20 * 30),  # from centres
        ((10.75, 20.75, 30.5, 50.5), 19 * 29),  # up to centres
        ((10.75, 20.75, 11.25, 50.5), 0),  # between centres
        ((-40.0, -30.0, 190.0, 140.0), 230 * 170),  # beyond the image
    ):
        corners = (left, top), (left, bottom), (right, bottom), (right, top)
        shape = quad([[(u - 80.0) / 128.0, (v - 60.0) / 128.0, 1.0] for u, v in corners])
        assert count_covered(shape, EYE, EVEN) == pixels


def test_what_is_too_near_too_far_aside_or_too_large_is_left_to_the_renderer():
    ball = body(trimesh.creation.icosphere(2, 0.1), closed=True)
    wide = EVEN.model_copy(update={"width": 2 * LARGEST_PX, "fx": 8.0 * LARGEST_PX})
    for at, k, counted in (
        ((0.0, 0.0, NEAREST_M + 0.11), EVEN, True),
        ((0.0, 0.0, NEAREST_M + 0.09), EVEN, False),
        ((0.0, 0.0, -1.0), EVEN, False),
        ((1.6, 0.0, 1.0), EVEN, True),
        ((1.8, 0.0, 1.0), EVEN, False),
        ((0.0, 1.4, 1.0), EVEN, False),
        ((0.0, 0.0, 1.0), wide, False),
    ):
        assert (count_covered(ball, translation(*at), k) is not None) == counted, (at, k)
