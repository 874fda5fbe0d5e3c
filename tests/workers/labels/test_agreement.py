"""The agreement of two views of planes."""

from tests.workers.labels.planes import HERE, IMAGES, THERE, plane_view
from workers.scene.labels import compare_views


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
