"""The projected view, on planes whose depth is known in closed form."""

import numpy as np
import pytest

from schemas.job.views import Distortion, Projection
from schemas.scene.scene import EffectPlan
from schemas.scene.view import Camera
from tests.workers.labels.planes import HERE, IMAGES, THERE, K, plane_view
from workers.geometry.camera import orbit_pose
from workers.geometry.distortion import distort
from workers.scene.labels import carry_depth, derive_projected, pixels_behind, projection_shares

NO_EFFECTS = EffectPlan((), {})


def test_projected_colours_come_from_the_pixels_that_the_depth_came_from():
    source = plane_view("input", HERE)
    rgb, depth = derive_projected(source, THERE, IMAGES, None, NO_EFFECTS)
    projected = carry_depth(source, THERE, IMAGES, NO_EFFECTS)
    filled = projected.source >= 0
    assert filled.sum() > 2000
    assert np.array_equal(rgb[filled], source.rgb.reshape(-1, 3)[projected.source[filled]])
    assert (rgb[~filled] == 0).all()
    assert (depth[~filled] == 0).all()
    exact = plane_view("mirror", THERE).depth.astype(int)
    # The source pixel's centre lands anywhere in its target pixel, so depths differ by the plane's slope over a pixel.
    assert np.abs(depth.astype(int) - exact)[filled].max() < 5000 * 0.05


def test_hidden_point_removal_drops_what_faces_away():
    removal = EffectPlan(("hidden_point_removal",), {})
    below = Camera(K, orbit_pose(np.zeros(3), -0.8, 0.7, 2.5))
    source = plane_view("input", HERE)
    assert (carry_depth(source, below, IMAGES, NO_EFFECTS).source >= 0).any()
    assert not (carry_depth(source, below, IMAGES, removal).source >= 0).any()
    assert (carry_depth(source, THERE, IMAGES, removal).source >= 0).sum() > 2000


def test_a_splat_is_as_wide_as_the_job_says_where_the_plan_has_it_and_one_pixel_elsewhere():
    wide = IMAGES.model_copy(update={"projection": Projection(splat=3)})
    source = plane_view("input", HERE)
    plain = carry_depth(source, THERE, IMAGES, NO_EFFECTS).source >= 0
    splatted = carry_depth(source, THERE, wide, EffectPlan(("splat",), {})).source >= 0
    assert np.array_equal(carry_depth(source, THERE, wide, NO_EFFECTS).source >= 0, plain)
    assert (plain <= splatted).all() and splatted.sum() > 1.2 * plain.sum()


def test_behind_a_lens_a_depth_pixel_has_the_colour_of_the_pixel_that_its_centre_is_drawn_in():
    """A radial lens leaves the centre of the image where it is, moves the corner, and may move it out of the image."""
    centre = K.height // 2 * K.width + K.width // 2
    found = pixels_behind(Distortion(k1=-0.2), np.array([centre, 0, -1]), K)
    u, v = distort(np.array([0.5]), np.array([0.5]), Distortion(k1=-0.2), K)
    assert found.tolist() == [centre, int(v[0]) * K.width + int(u[0]), -1]
    assert found[1] > K.width
    assert pixels_behind(Distortion(k1=0.2), np.array([0]), K).tolist() == [-1]


def test_a_lens_that_the_plan_leaves_out_moves_no_colour():
    source, lens = plane_view("input", HERE), Distortion(k1=-0.2)
    plain, _ = derive_projected(source, THERE, IMAGES, None, NO_EFFECTS)
    left_out, _ = derive_projected(source, THERE, IMAGES, lens, NO_EFFECTS)
    drawn, _ = derive_projected(source, THERE, IMAGES, lens, EffectPlan(("sensor_distortion",), {}))
    assert np.array_equal(left_out, plain)
    assert not np.array_equal(drawn, plain)


def test_shares_count_what_is_filled_and_what_lies_behind():
    projected = np.array([[0, 5000, 5100, 5040]], np.uint16)
    mirror = np.array([[5000, 5000, 5000, 5000]], np.uint16)
    assert projection_shares(projected, mirror, IMAGES) == (0.75, pytest.approx(1 / 3))
