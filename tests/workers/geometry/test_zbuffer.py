"""The small rasteriser, held against the ray caster.

Registered depth against planes and spheres whose depth in the colour camera is known exactly. Pixels that a shape
covers by itself: against ray casting, and by rectangles whose pixels are known.
"""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.shape import Mesh, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from tests.kit.shapes import shape_of as shape_of_meshes
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
from workers.geometry.camera import look_at
from workers.geometry.frames import pose, rotation_about, translation, uniform_rotation
from workers.geometry.lens import project_points
from workers.geometry.raycast import Placed, cast_view
from workers.geometry.zbuffer import LARGEST_PX, NEAREST_M, count_covered, draw_depth, register_depth

K = Intrinsics(width=160, height=120, fx=200.0, fy=205.0, cx=81.0, cy=57.5)


@pytest.mark.parametrize("seed", range(3))
def test_depth_is_that_of_the_nearest_face_at_each_pixel_centre(seed):
    rng = np.random.default_rng(seed)
    knot = trimesh.creation.torus(0.1, 0.035, major_sections=40, minor_sections=16)
    knot.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
    camera = Camera(K, frozen_array(look_at(np.array([0.3, -0.2, 0.35]), rng.normal(0, 0.02, 3))))
    drawn = draw_depth(Mesh(np.array(knot.vertices), np.array(knot.faces, np.int32)), camera)
    truth, _, _ = cast_view([Placed(3, shape_of_meshes(knot), np.eye(4))], camera)
    assert ((drawn > 0) != (truth > 0)).sum() <= 2  # rays through an edge, in the caster's float32
    both = (drawn > 0) & (truth > 0)
    # On a silhouette float32 may take the one face or the other.
    assert both.sum() > 2000 and np.quantile(np.abs(drawn - truth)[both], 0.999) < 1e-6


SMALL_COLOR = smaller(COLOR, 0.25)
SMALL = dataclasses.replace(CAMERA, intrinsics=smaller(DEPTH, 0.25))
DEPTH_RAYS = opencv_rays(SMALL.intrinsics, DEPTH_LENS)
PLANE_MM = 0.2
"""The lens of the colour image is taken as straight over a triangle; its error falls with the square of the resolution."""


def unit(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z]) / np.linalg.norm([x, y, z])


@pytest.mark.parametrize("lens", [COLOR_LENS, None], ids=["stored with its lens", "pinhole"])
@pytest.mark.parametrize("normal", [unit(0, 0, 1), unit(0.5, -0.3, 1), unit(0, 1.5, 1)])
def test_a_plane_stays_the_plane(normal, lens):
    depth = plane_depth(DEPTH_RAYS, *plane_in_depth_camera(T_COLOR_DEPTH, normal, 0.7))
    seen = register_depth(depth, SMALL, SMALL_COLOR, lens)
    true = plane_depth(opencv_rays(SMALL_COLOR, np.zeros(8) if lens is None else lens), normal, 0.7)
    filled = seen > 0
    assert np.abs(seen - true)[filled].max() * 1e3 < PLANE_MM
    assert filled.mean() > 0.4
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    middle = filled[rows[0] + 30 : rows[-1] - 29, columns[0] + 40 : columns[-1] - 39]
    assert middle.all(), "no holes and no cracks"


@pytest.mark.parametrize("seed", range(3))
def test_a_sphere_before_a_wall_hides_it(seed):
    """The nearest wins; what neither camera's edge touches is exact to the sag of a triangle."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8]), 0.12
    wall = unit(0.1, 0.1, 1)
    R, t = T_COLOR_DEPTH[:3, :3], T_COLOR_DEPTH[:3, 3]
    near = sphere_depth(DEPTH_RAYS, R.T @ (centre - t), radius)
    far = plane_depth(DEPTH_RAYS, *plane_in_depth_camera(T_COLOR_DEPTH, wall, 1.2))
    seen = register_depth(np.where(near > 0, near, far), SMALL, SMALL_COLOR, COLOR_LENS)
    rays = opencv_rays(SMALL_COLOR, COLOR_LENS)
    ball, plane = sphere_depth(rays, centre, radius), plane_depth(rays, wall, 1.2)
    points = ball[:, :, None] * rays
    core = ball > 0
    for camera_at in (np.zeros(3), t):  # both cameras see it at less than 60 degrees
        to_camera = camera_at - points
        core &= ((points - centre) * to_camera).sum(axis=2) > 0.5 * radius * np.linalg.norm(to_camera, axis=2)
    u, v = np.moveaxis(
        project_points((points.reshape(-1, 3) - t) @ R, SMALL.intrinsics, DEPTH_LENS).reshape(*ball.shape, 2), 2, 0
    )
    core &= (abs(u - 80) < 79) & (abs(v - 72) < 71)
    assert core.sum() > 1000
    sag_mm = (
        (0.8 / SMALL.intrinsics.fx / 0.5) ** 2 / (4 * radius) / 0.5 * 1e3
    )  # a diagonal's square over 8 r, over the slant
    assert np.abs(seen - ball)[core].max() * 1e3 < sag_mm
    filled = seen > 0
    wrong = filled & (np.abs(seen - ball) > 0.01) & (np.abs(seen - plane) > 1e-5)
    assert wrong.sum() < 0.02 * (ball > 0).sum(), "nothing floats between the sphere and the wall"


def test_a_square_across_an_edge_is_left_out_and_a_steep_plane_is_not():
    k = SMALL.intrinsics
    camera = dataclasses.replace(SMALL, lens=np.zeros(8), T_color_depth=frozen_array(np.eye(4)))
    depth = np.full((k.height, k.width), 0.7)
    depth[:, 80:] = 0.8
    turned = pose(np.eye(3), np.array([-0.05, 0.0, 0.0]))
    seen = register_depth(depth, dataclasses.replace(camera, T_color_depth=frozen_array(turned)), k)
    assert np.unique(seen[seen > 0].round(9)).tolist() == [0.7, 0.8]
    slanted = rotation_about(np.array([0.0, 1.0, 0.0]), np.radians(80)) @ np.array([0.0, 0.0, 1.0])
    rays = opencv_rays(k, np.zeros(8))
    steep = plane_depth(rays, slanted, 0.12)
    assert (register_depth(steep, camera, k)[:, 80:] > 0).mean() > 0.95


SQUARE = Intrinsics(width=160, height=120, fx=128.0, fy=128.0, cx=80.0, cy=60.0)
ONE_PIXEL_M = 1.0 / 128.0
"""Side of a pixel at a distance of one metre."""


def shape_of(mesh: trimesh.Trimesh, closed: bool = True) -> Shape:
    return Shape((Part("all", np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)),), closed)


def rectangle(left, top, right, bottom, faces=((0, 1, 2), (0, 2, 3))):
    """Two triangles a metre ahead, whose corners are at these pixel coordinates."""
    corners = np.array([[left, top], [left, bottom], [right, bottom], [right, top]], float)
    points = np.column_stack([(corners - (80.0, 60.0)) * ONE_PIXEL_M, np.ones(4)])
    return Shape((Part("all", points, np.array(faces, np.int32)),))


@pytest.mark.parametrize("seed", range(8))
def test_as_many_pixels_as_rays_that_hit(seed):
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.annulus(0.05, 0.1, 0.08) if seed % 2 else trimesh.creation.capsule(0.1, 0.05)
    shape, T = shape_of(mesh), pose(uniform_rotation(rng), np.array([0.03, -0.02, 0.6]))
    _, region, _ = cast_view([Placed(3, shape, T)], Camera(SQUARE, np.eye(4)))
    assert count_covered(shape, T, SQUARE) == pytest.approx((region == 3).sum(), abs=2)


@pytest.mark.parametrize(
    ("corners", "pixels"),
    [
        ((10.0, 20.0, 30.0, 50.0), 20 * 30),
        ((10.5, 20.5, 30.5, 50.5), 20 * 30),
        ((10.5, 20.5, 30.25, 50.25), 20 * 30),
        ((10.75, 20.75, 30.5, 50.5), 19 * 29),
        ((10.75, 20.75, 11.25, 50.5), 0),
        ((-40.0, -30.0, 190.0, 140.0), 230 * 170),
    ],
    ids=["whole pixels", "through centres", "from centres", "up to centres", "between centres", "beyond the image"],
)
def test_a_centre_on_an_edge_belongs_to_what_is_on_its_right_or_below(corners, pixels):
    assert count_covered(rectangle(*corners), np.eye(4), SQUARE) == pixels


def test_the_front_of_a_closed_body_covers_what_the_whole_of_it_does():
    rng = np.random.default_rng(1)
    for _ in range(20):
        shape = shape_of(trimesh.creation.annulus(0.05, 0.1, 0.08, sections=40))
        T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.2, 0.2, 2), 0.6]))
        assert count_covered(shape, T, SQUARE) == count_covered(replace(shape, closed=False), T, SQUARE) > 100


def test_what_is_too_near_too_far_aside_or_too_large_is_left_to_the_renderer():
    ball = shape_of(trimesh.creation.icosphere(2, 0.1))
    assert count_covered(ball, translation(0.0, 0.0, NEAREST_M + 0.11), SQUARE) is not None
    assert count_covered(ball, translation(0.0, 0.0, NEAREST_M + 0.09), SQUARE) is None
    assert count_covered(ball, translation(0.0, 0.0, -1.0), SQUARE) is None
    assert count_covered(ball, translation(1.6, 0.0, 1.0), SQUARE) is not None
    assert count_covered(ball, translation(1.8, 0.0, 1.0), SQUARE) is None
    assert count_covered(ball, translation(0.0, 1.4, 1.0), SQUARE) is None
    wide = SQUARE.model_copy(update={"width": 2 * LARGEST_PX, "fx": 8.0 * LARGEST_PX})
    assert count_covered(ball, translation(0.0, 0.0, 1.0), wide) is None
