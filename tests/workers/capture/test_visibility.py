"""What cameras see of a mesh, against cases in closed form."""

import numpy as np
import trimesh

from schemas.base import frozen_array
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera, Intrinsics
from workers.capture.surface.posed_view import UNSEEN, facing_cosine, visible_points
from workers.geometry.camera import look_at

K = Intrinsics(width=200, height=150, fx=200.0, fy=200.0, cx=100.0, cy=75.0)


def ball(centre):
    made = trimesh.creation.icosphere(4, 0.1)
    return np.array(made.vertices) + centre, np.array(made.faces, np.int32), np.array(made.vertices) / 0.1


def camera_at(*position, target=(0.0, 0.0, 0.0)):
    return Camera(K, frozen_array(look_at(np.array(position), np.array(target))))


def test_a_camera_sees_the_cap_of_a_sphere_that_faces_it():
    vertices, faces, normals = ball([0, 0, 0])
    seen = visible_points(Mesh(vertices, faces), vertices, normals, [camera_at(1.0, 0.0, 0.0)])
    # The cap ends where the rays touch the sphere: x = r^2 / d.
    clear = np.abs(vertices[:, 0] - 0.01) > 0.003
    assert np.array_equal(seen[clear], (vertices[:, 0] > 0.01)[clear])
    both = visible_points(Mesh(vertices, faces), vertices, normals, [camera_at(1.0, 0, 0), camera_at(-1.0, 0, 0)])
    assert both.sum() > 1.8 * seen.sum()


def test_what_another_part_hides_is_not_seen_unless_another_camera_sees_it():
    front, faces, _ = ball([0.5, 0, 0])
    back, _, normals = ball([0, 0, 0])
    mesh = Mesh(np.concatenate([front, back]), np.concatenate([faces, faces + len(front)]).astype(np.int32))
    assert not visible_points(mesh, back, normals, [camera_at(1.2, 0, 0)])[back[:, 0] > 0.05].any()
    many = [camera_at(1.2, 0, 0), camera_at(0, 0, 1), camera_at(0, 1, 0.2), camera_at(1, 1, 0.1), camera_at(0, -1, 0)]
    assert visible_points(mesh, back, normals, many)[back[:, 0] > 0.05].mean() > 0.9


def test_the_cosine_is_that_of_incidence_and_unseen_outside_the_image():
    points, normals = (
        np.array([[0.0, 0, 0], [0.0, 0, 0], [5.0, 0, 0]]),
        np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 0, 1.0]]),
    )
    cosine = facing_cosine(points, normals, camera_at(0.6, 0.0, 0.8))
    assert np.allclose(cosine, [0.8, 0.6, UNSEEN])


def test_no_points_and_no_cameras_see_nothing():
    vertices, faces, normals = ball([0, 0, 0])
    assert not visible_points(Mesh(vertices, faces), vertices, normals, []).any()
    assert len(visible_points(Mesh(vertices, faces), vertices[:0], normals[:0], [camera_at(1, 0, 0)])) == 0
