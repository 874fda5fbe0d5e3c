"""Errors of poses, surfaces and views, against errors that were made on purpose."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.capture import Reconstruction, SynthesizedView
from schemas.errors import CaptureError
from schemas.scene.shape import Mesh
from schemas.scene.view import Camera
from tests.workers.capture.analytic_capture import kinect
from workers.capture.surface.evaluate import (
    compare_poses,
    compare_surface,
    compare_view,
    measured_points,
    sample_surface,
    true_view,
)
from workers.capture.surface.posed_view import PosedView
from workers.geometry.camera import look_at
from workers.geometry.frames import pose, rotation_about, translation

BOX = trimesh.creation.box((0.2, 0.1, 0.06))
MESH = Mesh(np.array(BOX.vertices), np.array(BOX.faces, np.int32))


def test_pose_errors_are_distances_and_angles():
    turned = pose(rotation_about(np.array([0.0, 1.0, 0.0]), np.radians(0.3)), np.zeros(3))
    errors = compare_poses([translation(0.003, 0.004, 0), turned, np.eye(4)], [np.eye(4)] * 3)
    assert (errors.worst_mm, errors.views) == (pytest.approx(5.0), 3)
    assert errors.median_mm == 0.0 and errors.worst_deg == pytest.approx(0.3)
    with pytest.raises(CaptureError, match="no view has a pose"):
        compare_poses([], [])


def test_samples_are_even_over_the_area_with_outward_normals():
    points, normals = sample_surface(MESH, 20_000)
    top = normals[:, 2] > 0.5
    area = 2 * (0.2 * 0.1 + 0.2 * 0.06 + 0.1 * 0.06)
    assert top.mean() == pytest.approx(0.2 * 0.1 / area, abs=0.005)
    assert np.allclose(points[top][:, 2], 0.03) and (np.sum(points * normals, axis=1) > 0).all()
    assert abs(points[top][:, 0].mean()) < 0.002
    assert np.array_equal(points, sample_surface(MESH, 20_000)[0])


def test_surface_errors_are_the_distances_that_were_made():
    samples, normals = sample_surface(MESH, 5000)
    shifted = samples + 0.002 * normals
    shape = np.zeros((len(samples), 3), np.uint8)
    found = Reconstruction(shifted, normals, shape, np.ones(len(samples), np.int32), MESH.vertices, MESH.faces, shape)
    visible = normals[:, 2] > -0.5
    far = np.where(samples[:, 0] > 0, 0.0, 0.01)
    errors = compare_surface(found, MESH, samples, visible, far)
    assert errors.cloud_median_mm == pytest.approx(2.0) and errors.cloud_p95_mm == pytest.approx(2.0)
    assert errors.surface_median_mm == pytest.approx(0.0, abs=1e-9)
    assert errors.completeness == pytest.approx(0.5, abs=0.03)
    assert errors.visible_share == pytest.approx(visible.mean())


def test_view_errors_count_what_is_off_missing_and_too_much():
    camera = Camera(kinect(0.25), frozen_array(look_at(np.array([0.4, 0.1, 0.4]), np.zeros(3))))
    depth = true_view(MESH, camera)
    mask = depth > 0
    assert depth[mask].min() > 0.4 and mask.sum() > 3000
    rows, columns = np.nonzero(mask)
    shown = mask.copy()
    shown[rows[: len(rows) // 4], columns[: len(rows) // 4]] = False
    extra = np.zeros_like(mask)
    extra[:10, :30] = True
    rgb = np.full((*mask.shape, 3), 100, np.uint8)
    view = SynthesizedView(rgb, np.where(shown | extra, depth + 0.001, 0), shown | extra, shown, 0.9, (1, 2))
    errors = compare_view(view, depth, mask, rgb + 7)
    assert errors.depth_median_mm == pytest.approx(1.0) and errors.color_error == pytest.approx(7.0)
    assert errors.covered == pytest.approx(0.75, abs=0.001)
    assert errors.beyond == pytest.approx(300 / (300 + shown.sum()))
    with pytest.raises(CaptureError, match="nothing of the object"):
        compare_view(SynthesizedView(rgb, depth, extra, shown, 0.9, ()), depth, mask)


def test_points_are_measured_where_a_pixel_has_their_depth():
    camera = Camera(kinect(0.25), frozen_array(look_at(np.array([0.4, 0.1, 0.4]), np.zeros(3))))
    depth = true_view(MESH, camera).astype(np.float32)
    points, normals = sample_surface(MESH, 4000)
    view = PosedView(0, camera, camera, np.zeros((*depth.shape, 3), np.uint8), depth)
    towards = ((camera.position - points) * normals).sum(axis=1) > 0.02
    measured = measured_points(points, normals, view)
    assert measured[towards].mean() > 0.97 and not measured[~towards].any()
    for spoilt in (np.zeros_like(depth), np.where(depth > 0, depth + np.float32(0.1), 0)):
        gone = PosedView(0, camera, camera, view.rgb, spoilt.astype(np.float32))
        assert measured_points(points, normals, gone).mean() < 0.01
