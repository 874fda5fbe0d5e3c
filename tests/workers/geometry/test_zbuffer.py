"""The small rasteriser, held against the ray caster."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.shape import Mesh
from tests.kit.shapes import shape_of
from workers.geometry.camera import look_at
from workers.geometry.raycast import Placed, cast_view
from workers.geometry.zbuffer import draw_depth

K = Intrinsics(width=160, height=120, fx=200.0, fy=205.0, cx=81.0, cy=57.5)


@pytest.mark.parametrize("seed", range(3))
def test_depth_is_that_of_the_nearest_face_at_each_pixel_centre(seed):
    rng = np.random.default_rng(seed)
    knot = trimesh.creation.torus(0.1, 0.035, major_sections=40, minor_sections=16)
    knot.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
    camera = Camera(K, frozen_array(look_at(np.array([0.3, -0.2, 0.35]), rng.normal(0, 0.02, 3))))
    drawn = draw_depth(Mesh(np.array(knot.vertices), np.array(knot.faces, np.int32)), camera)
    truth, _, _ = cast_view([Placed(3, shape_of(knot), np.eye(4))], camera)
    assert ((drawn > 0) != (truth > 0)).sum() <= 2  # rays through an edge, in the caster's float32
    both = (drawn > 0) & (truth > 0)
    # On a silhouette float32 may take the one face or the other.
    assert both.sum() > 2000 and np.quantile(np.abs(drawn - truth)[both], 0.999) < 1e-6


def test_faces_behind_the_camera_are_left_out():
    mesh = Mesh(np.array([[0.0, 0, -1], [1, 0, 1], [0, 1, 1]]), np.array([[0, 1, 2]], np.int32))
    assert not draw_depth(mesh, Camera(K, frozen_array(np.eye(4)))).any()
