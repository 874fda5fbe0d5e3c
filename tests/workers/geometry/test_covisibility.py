"""What two cameras both see of planes, and where one of them does not."""

import numpy as np
import pytest

from tests.workers.labels.planes import HERE, IMAGES, THERE, plane_view
from workers.geometry.projection import Bounds, Seen, compare_covisible

BOUNDS = Bounds(facing=0.1, smooth_m=(0.002, 0.001), hidden_m=0.01)
UNITS = IMAGES.depth_units_per_m


def seen(camera, height_m=0.0, region=3):
    view = plane_view("input", camera, height_m, region)
    return Seen(view.depth, view.region, camera)


def compare(source, target, bounds=BOUNDS):
    everywhere = np.arange(source.depth.size)
    return compare_covisible(source, target, everywhere, bounds, UNITS)


def test_a_plane_is_seen_by_both_where_both_images_have_it():
    difference_m, region = compare(seen(HERE), seen(THERE))
    assert len(difference_m) > 3000
    assert np.median(difference_m) < 1e-4
    assert set(region.tolist()) == {3}


def test_a_difference_is_along_the_targets_axis_and_as_large_as_the_planes_are_apart():
    """Along an axis that meets the planes at an angle they are further apart than along their normal."""
    near, far = (np.median(compare(seen(HERE), seen(THERE, height_m=-m))[0]) for m in (0.002, 0.004))
    assert near > 0.002
    assert far == pytest.approx(2.0 * near, rel=0.05)


@pytest.mark.parametrize(
    ("source", "target", "bounds"),
    [
        (seen(HERE), seen(THERE, region=4), BOUNDS),
        (seen(HERE), seen(THERE, height_m=0.1), BOUNDS),
        (seen(HERE), seen(THERE), BOUNDS._replace(facing=1.0)),
        (seen(HERE), seen(THERE), BOUNDS._replace(smooth_m=(0.0, 0.001))),
        (seen(HERE), seen(THERE), BOUNDS._replace(smooth_m=(0.002, 0.0))),
        (seen(HERE)._replace(depth=np.zeros_like(seen(HERE).depth)), seen(THERE), BOUNDS),
    ],
    ids=["another region", "hidden", "turned away", "rough source", "rough target", "no depth"],
)
def test_nothing_else_is_compared(source, target, bounds):
    difference_m, region = compare(source, target, bounds)
    assert len(difference_m) == len(region) == 0


def test_only_the_pixels_that_were_asked_for_are_compared():
    source, target = seen(HERE), seen(THERE)
    all_of_them, _ = compare(source, target)
    half = np.arange(0, source.depth.size, 2)
    some, _ = compare_covisible(source, target, half, BOUNDS, UNITS)
    assert 0.4 < len(some) / len(all_of_them) < 0.6
    assert np.isin(some, all_of_them).all()
