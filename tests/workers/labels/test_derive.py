"""What follows from rendered views, on views whose depth is known in closed form."""

import dataclasses

import numpy as np
import pytest

from schemas.job.images import Images, Patch, Projection
from schemas.scene.camera import Camera, Intrinsics, Role
from schemas.scene.view import ObjectLabel, View
from workers.cameras.mirror import mirror_pose
from workers.geometry.camera import orbit_pose, unproject
from workers.geometry.frames import translation
from workers.geometry.normals import facing_cosine
from workers.geometry.pixels import Extent
from workers.geometry.stored_depth import quantise_depth
from workers.labels.derive import (
    agree_across,
    carry_depth,
    crop_box,
    derive_projected,
    label_region,
    projection_shares,
)

K = Intrinsics(width=160, height=120, fx=131.0, fy=131.0, cx=80.0, cy=60.0)
IMAGES = Images()
HERE = Camera(K, orbit_pose(np.array([0, 0, 0.0]), 0.8, 0.7, 2.5))
THERE = Camera(K, mirror_pose(HERE.T_world_cam, 2.5))


def plane_view(role: Role, camera: Camera, height_m: float = 0.0, region: int = 3) -> View:
    """A view of the plane z = height, exact at pixel centres."""
    rows, columns = np.mgrid[0 : K.height, 0 : K.width]
    rays = unproject(rows.ravel(), columns.ravel(), np.ones(rows.size), K) @ camera.T_world_cam[:3, :3].T
    depth = ((height_m - camera.position[2]) / rays[:, 2]).reshape(K.height, K.width)
    depth = np.where((depth > 0) & (depth < 8), depth, 0)
    rgb = np.random.default_rng(1).integers(0, 255, (K.height, K.width, 3)).astype(np.uint8)
    ids = np.where(depth > 0, region, 0).astype(np.uint8)
    return View(role, 0, 0, camera, rgb, quantise_depth(depth, IMAGES), ids, ())


def test_two_views_of_one_plane_agree_to_the_quantisation():
    agreement = agree_across(plane_view("input", HERE), plane_view("mirror", THERE), IMAGES, 1.0, 3)
    assert agreement.points > 3000
    # Each stored depth is off by up to 0.1 mm, evenly: the median of the difference of the two stays below that.
    assert agreement.median_mm < 0.1
    assert agreement.share == 1.0


def test_views_of_planes_three_millimetres_apart_disagree_by_their_distance():
    agreement = agree_across(plane_view("input", HERE), plane_view("mirror", THERE, -0.003), IMAGES, 1.0, 3)
    assert agreement.median_mm > 2.0
    assert agreement.share == 0.0


def test_too_few_points_of_the_object_give_no_figure_for_it():
    views = [plane_view(role, camera, region=2) for role, camera in (("input", HERE), ("mirror", THERE))]
    agreement = agree_across(*views, IMAGES, 1.0, 3)
    assert agreement.median_mm is None
    assert agreement.points == 0
    assert agreement.scene_median_mm < 0.1


def test_a_surface_faces_the_side_it_is_seen_from():
    view = plane_view("input", HERE)
    depth = view.depth / 5000
    everywhere = np.arange(depth.size)
    above = facing_cosine(depth, view.region, everywhere, HERE, HERE.position + np.array([0, 0, 3.0])).reshape(120, 160)
    below = facing_cosine(depth, view.region, everywhere, HERE, np.array([0.3, 0.2, -2.0]))
    assert np.nanmin(above) > 0.3
    assert np.nanmax(below) < 0
    rows, columns = 60, 80
    p = (
        HERE.position
        + HERE.T_world_cam[:3, :3]
        @ unproject(np.array([rows]), np.array([columns]), depth[rows : rows + 1, columns], K)[0]
    )
    towards = HERE.position + np.array([0, 0, 3.0]) - p
    assert above[rows, columns] == pytest.approx(towards[2] / np.linalg.norm(towards), abs=2e-3)
    assert np.isnan(above[0, 0])


def test_projected_colours_come_from_the_pixels_that_the_depth_came_from():
    source = plane_view("input", HERE)
    rgb, depth = derive_projected(source, THERE, IMAGES)
    projected = carry_depth(source, THERE, IMAGES)
    filled = projected.source >= 0
    assert filled.sum() > 2000
    assert np.array_equal(rgb[filled], source.rgb.reshape(-1, 3)[projected.source[filled]])
    assert (rgb[~filled] == 0).all()
    assert (depth[~filled] == 0).all()
    exact = plane_view("mirror", THERE).depth.astype(int)
    # The source pixel's centre lands anywhere in its target pixel, so depths differ by the plane's slope over a pixel.
    assert np.abs(depth.astype(int) - exact)[filled].max() < 5000 * 0.05


def test_hidden_point_removal_drops_what_faces_away():
    images = IMAGES.model_copy(update={"projection": Projection(hidden_point_removal=True)})
    below = Camera(K, orbit_pose(np.zeros(3), -0.8, 0.7, 2.5))
    source = plane_view("input", HERE)
    assert (carry_depth(source, below, IMAGES).source >= 0).any()
    assert not (carry_depth(source, below, images).source >= 0).any()
    assert (carry_depth(source, THERE, images).source >= 0).sum() > 2000


def test_shares_count_what_is_filled_and_what_lies_behind():
    projected = np.array([[0, 5000, 5100, 5040]], np.uint16)
    mirror = np.array([[5000, 5000, 5000, 5000]], np.uint16)
    assert projection_shares(projected, mirror, IMAGES) == (0.75, pytest.approx(1 / 3))


def label(u: int, v: int) -> ObjectLabel:
    return ObjectLabel(3, "mug", "m", np.eye(4), u, v, (0, 0, 0, 0), 1, 1.0)


def test_a_patch_is_centred_on_the_object_and_left_out_where_it_would_leave_the_image():
    patch = Patch(width=128, height=96)
    assert crop_box(label(80, 60), HERE, patch) == (slice(12, 108), slice(16, 144))
    assert crop_box(label(64, 48), HERE, patch) == (slice(0, 96), slice(0, 128))
    assert crop_box(label(63, 60), HERE, patch) is None
    assert crop_box(label(97, 60), HERE, patch) is None
    assert crop_box(label(80, 73), HERE, patch) is None
    assert crop_box(label(-1, -1), HERE, patch) is None


def test_an_object_that_the_view_does_not_see_has_no_patch():
    hidden = dataclasses.replace(label(80, 60), pixels=0)
    assert crop_box(hidden, HERE, Patch(width=128, height=96)) is None


def test_a_label_counts_boxes_and_shares_its_own_pixels():
    T = HERE.T_world_cam @ translation(0.001, 0.001, 2.0)
    made = label_region((3, "mug", "m", T), HERE, Extent(50, (30, 10, 5, 10)), lambda: 100)
    assert (made.u, made.v) == (80, 60)
    assert made.bbox_xywh == (30, 10, 5, 10)
    assert (made.pixels, made.visible_fraction) == (50, 0.5)
    unseen = label_region(
        (4, "mug", "m", T), HERE, Extent(0, (0, 0, 0, 0)), lambda: pytest.fail("asked although nothing is seen")
    )
    assert (unseen.pixels, unseen.visible_fraction, unseen.bbox_xywh) == (0, 0.0, (0, 0, 0, 0))
