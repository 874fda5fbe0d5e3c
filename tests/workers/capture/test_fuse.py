"""The merged surface, held against a sphere and a box in closed form."""

import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from tests.workers.capture.analytic_capture import BOARD, Thing, capture
from workers.capture.surface.fusion import fuse_views
from workers.capture.surface.object_mask import find_object


def fuse(views, spec=None):
    spec = spec or Fusion()
    return fuse_views(views, find_object(views, BOARD, spec), spec)


@pytest.mark.parametrize(("sigma_m", "seed"), [(0.0, 0), (0.002, 0), (0.002, 1), (0.004, 2)])
def test_the_cloud_lies_on_the_object(sigma_m, seed, record_figure):
    thing = Thing()
    found = fuse(capture(thing, sigma_m=sigma_m, seed=seed))
    off_mm = thing.distance(found.points) * 1e3
    record_figure(f"merged cloud, noise {sigma_m * 1e3:g} mm", "median, mm", float(np.median(off_mm)), 0.6)
    # A quarter of the resolution of a Kinect: depth pixels are 6 mm apart, and its bars are 1 and 3 mm.
    assert np.median(off_mm) < 0.6 and np.quantile(off_mm, 0.95) < 2.5
    assert (found.views >= Fusion().min_views).all() and np.median(found.views) > 5


def test_normals_point_outwards_and_colours_are_the_parts():
    found = fuse(capture(sigma_m=0.001))
    sphere = np.linalg.norm(found.points - [-0.06, 0.0, 0.07], axis=1) < 0.062
    sphere &= found.points[:, 0] < -0.07
    outwards = (found.points - [-0.06, 0.0, 0.07])[sphere]
    outwards /= np.linalg.norm(outwards, axis=1)[:, None]
    assert sphere.sum() > 1000
    assert np.median((found.normals[sphere] * outwards).sum(axis=1)) > 0.98
    red, green, blue = found.colors[sphere].mean(axis=0)
    assert red > green > blue and abs(red - 180) < 30


def test_the_same_views_give_the_same_bytes():
    views = capture(count=12, sigma_m=0.002)
    one, two = fuse(views), fuse(views)
    for name in ("points", "normals", "colors", "views", "vertices", "faces", "vertex_colors"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def test_what_one_view_alone_shows_is_left_out():
    views = capture(count=12)
    ghost = views[3].depth_m
    ghost[:] = np.where((ghost > 0) & (np.arange(ghost.shape[1]) % 40 < 20), ghost - 0.03, ghost)
    off_mm = Thing().distance(fuse(views).points) * 1e3
    assert np.quantile(off_mm, 0.95) < 2.0 and off_mm.max() < 12.0


def test_one_view_is_refused_unless_one_is_enough():
    views = capture(count=1)
    with pytest.raises(CaptureError, match=r"fusion\.min_views is 2") as refusal:
        fuse(views)
    assert refusal.value.reason == "too_few_views"
    found = fuse(views, Fusion(min_views=1))
    assert len(found.points) > 1000 and np.quantile(Thing().distance(found.points), 0.95) < 0.003


def test_an_object_without_depth_is_refused_although_the_board_has_some():
    views = capture(count=8)
    for n, view in enumerate(views):
        view.depth_m[view.depth_m < 0.62 + 0.002 * n] = 0.0
    flat = Thing(sphere=None, boxes=[])
    assert flat.distance(np.zeros((1, 3)))[0] == np.inf
    for view in views:
        view.depth_m[:] = 0.0
    with pytest.raises(CaptureError) as refusal:
        fuse(views)
    assert refusal.value.reason == "no_depth"
