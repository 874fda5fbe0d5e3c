"""Silhouettes down to the board, held against exact ones."""

import numpy as np
import pytest

from schemas.job.captures import Fusion
from schemas.scene.shape import Mesh
from tests.workers.capture.analytic_capture import BOARD, Thing, capture, cast
from workers.capture.surface.fusion import fuse_views
from workers.capture.surface.object_mask import down_to_board, find_object, silhouette


@pytest.mark.parametrize("sigma_m", [0.0, 0.002])
def test_the_silhouette_of_the_merged_surface_is_the_objects(sigma_m):
    thing = Thing()
    views = capture(thing, count=16, sigma_m=sigma_m)
    region = find_object(views, BOARD, Fusion())
    found = fuse_views(views, region, Fusion())
    mesh = down_to_board(Mesh(found.vertices, found.faces), region)
    for view in views[:6]:
        truth = cast(thing, view.camera)[1]
        mask = silhouette(mesh, view.camera)
        # One pixel of the outline, some 250 pixels long, is 10 % of the 2,600 pixels.
        assert (mask & truth).sum() / (mask | truth).sum() > 0.9


def test_walls_reach_the_board_and_no_farther():
    views = capture(count=16)
    region = find_object(views, BOARD, Fusion())
    found = fuse_views(views, region, Fusion())
    mesh = Mesh(found.vertices, found.faces)
    closed = down_to_board(mesh, region)
    assert region.height_m(mesh.vertices).min() == pytest.approx(region.clearance_m, abs=1e-6)
    added = closed.vertices[len(mesh.vertices) :]
    assert len(added) > 50 and np.abs(region.height_m(added)).max() < 1e-12
    assert np.array_equal(closed.faces[: len(mesh.faces)], mesh.faces)
