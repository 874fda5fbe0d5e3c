"""Pixels that a shape covers by itself: against ray casting, and by rectangles whose pixels are known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from schemas.scene.view import Camera, Intrinsics
from workers.geometry.frames import pose, translation, uniform_rotation
from workers.geometry.raycast import cast_view
from workers.geometry.zbuffer import LARGEST_PX, NEAREST_M, count_covered

K = Intrinsics(width=160, height=120, fx=128.0, fy=128.0, cx=80.0, cy=60.0)
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
    _, region, _ = cast_view([Placed(3, shape, T)], Camera(K, np.eye(4)))
    assert count_covered(shape, T, K) == pytest.approx((region == 3).sum(), abs=2)


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
    assert count_covered(rectangle(*corners), np.eye(4), K) == pixels


def test_triangles_that_overlap_count_once_and_their_winding_does_not_matter():
    twice = rectangle(10, 20, 30, 50, faces=((0, 1, 2), (2, 1, 0), (0, 2, 3), (1, 3, 0), (3, 3, 1)))
    assert count_covered(twice, np.eye(4), K) == 20 * 30


def test_the_front_of_a_closed_body_covers_what_the_whole_of_it_does():
    rng = np.random.default_rng(1)
    for _ in range(20):
        shape = shape_of(trimesh.creation.annulus(0.05, 0.1, 0.08, sections=40))
        T = pose(uniform_rotation(rng), np.array([*rng.uniform(-0.2, 0.2, 2), 0.6]))
        assert count_covered(shape, T, K) == count_covered(replace(shape, closed=False), T, K) > 100


def test_what_is_too_near_too_far_aside_or_too_large_is_left_to_the_renderer():
    ball = shape_of(trimesh.creation.icosphere(2, 0.1))
    assert count_covered(ball, translation(0.0, 0.0, NEAREST_M + 0.11), K) is not None
    assert count_covered(ball, translation(0.0, 0.0, NEAREST_M + 0.09), K) is None
    assert count_covered(ball, translation(0.0, 0.0, -1.0), K) is None
    assert count_covered(ball, translation(1.6, 0.0, 1.0), K) is not None
    assert count_covered(ball, translation(1.8, 0.0, 1.0), K) is None
    assert count_covered(ball, translation(0.0, 1.4, 1.0), K) is None
    wide = K.model_copy(update={"width": 2 * LARGEST_PX, "fx": 8.0 * LARGEST_PX})
    assert count_covered(ball, translation(0.0, 0.0, 1.0), wide) is None
