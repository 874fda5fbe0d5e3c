"""Antialiasing of colour: smooth edges with it, the colour of pixel centres without it."""

import numpy as np
import pytest

from schemas.scene.scene import Placed
from schemas.scene.shape import Appearance, Material
from tests.workers.render.looks import BLACK, FLAT, FOUR, RASTER, without
from tests.workers.render.random_scenes import camera, quad, small
from workers.geometry.frames import translation
from workers.render.raster.antialiasing import find_edges


@pytest.mark.parametrize("render", [RASTER, FOUR])
def test_a_slanted_edge_is_smooth_and_its_labels_are_not_touched(renderer, render):
    """White on black: along each row brightness never falls, and every third row has something in between."""
    slope = 0.3
    shape = quad(
        [[0.0, -2.0, 2.0], [3.0, -2.0, 2.0], [3.0, 2.0, 2.0], [slope * 4, 2.0, 2.0]], material=Material((1, 1, 1, 1))
    )
    white = Appearance((0.7,) * 3, (), BLACK, (0.7,) * 3)
    views = [
        renderer.draw([Placed(3, shape, translation(-0.6, 0, 0))], white, camera(small(80, 80)), *one)
        for one in (FLAT, render)
    ]
    assert views[0].region.tobytes() == views[1].region.tobytes()
    rows = views[1].rgb[4:-4, :, 1].astype(int)
    assert (np.diff(rows, axis=1)[:, 4:-4] >= -1).all()
    top = rows.max()
    between = ((rows > 0.1 * top) & (rows < 0.9 * top)).any(axis=1)
    assert between.mean() > 0.5
    flat_rows = views[0].rgb[4:-4, :, 1].astype(int)
    assert not ((flat_rows > 0.1 * flat_rows.max()) & (flat_rows < 0.9 * flat_rows.max())).any()


@pytest.mark.parametrize("look", [RASTER, FOUR], ids=["smoothed", "four samples"])
def test_without_antialiasing_a_pixel_has_the_colour_of_its_centre(renderer, look):
    """A white square in front of black: each pixel is one of the two, by the region of its centre."""
    corners = [[-0.5, -0.4, 1.0], [0.5, -0.2, 1.0], [0.4, 0.5, 1.0], [-0.3, 0.4, 1.0]]
    white = Placed(3, quad(corners, material=Material((1, 1, 1, 1))), np.eye(4))
    sky = Appearance((0.7,) * 3, (), BLACK, (0.7,) * 3)
    seen = renderer.draw([white], sky, camera(small(80, 80)), *without(look, "antialiasing"))
    inside = seen.region == 3
    assert 1000 < inside.sum() < 6400
    assert (seen.rgb[~inside] == 0).all()
    assert len(np.unique(seen.rgb[inside], axis=0)) == 1
    smooth = renderer.draw([white], sky, camera(small(80, 80)), *look)
    assert len(np.unique(smooth.rgb, axis=0)) > 2
    assert smooth.region.tobytes() == seen.region.tobytes() and smooth.depth_m.tobytes() == seen.depth_m.tobytes()


def test_the_floor_has_no_edges_amid_its_texture():
    rgb = np.zeros((6, 6, 3), np.uint8)
    rgb[:, 3:] = 100
    assert (find_edges(rgb, np.ones((6, 6), np.uint8)) == 0).all()
    edges = find_edges(rgb, np.full((6, 6), 2, np.uint8))
    assert (edges[:, 2:4] == 255).all() and edges.sum() == 12 * 255
