"""The agreement of two views of planes."""

import numpy as np
import pytest

from tests.workers.labels.planes import HERE, IMAGES, THERE, K, plane_view
from workers.geometry.camera import unproject
from workers.geometry.normals import facing_cosine
from workers.labels.agreement import compare_views


def test_two_views_of_one_plane_agree_to_the_quantisation():
    agreement = compare_views(plane_view("input", HERE), plane_view("mirror", THERE), IMAGES, 1.0)
    assert agreement.points > 3000
    # Each stored depth is off by up to 0.1 mm, evenly: the median of the difference of the two stays below that.
    assert agreement.median_mm < 0.1
    assert agreement.share == 1.0


def test_views_of_planes_three_millimetres_apart_disagree_by_their_distance():
    agreement = compare_views(plane_view("input", HERE), plane_view("mirror", THERE, -0.003), IMAGES, 1.0)
    assert agreement.median_mm > 2.0
    assert agreement.share == 0.0


def test_too_few_points_of_the_object_give_no_figure_for_it():
    views = [plane_view(role, camera, region=2) for role, camera in (("input", HERE), ("mirror", THERE))]
    agreement = compare_views(*views, IMAGES, 1.0)
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
