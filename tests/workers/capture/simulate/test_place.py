"""Objects stand on the print, neither above nor in it."""

import numpy as np
import pytest

from schemas.job.assets import CATEGORIES, ProceduralSource
from schemas.job.captures import Board, Simulate
from workers.assets.builtin.make import make_asset
from workers.capture.board.layout import marker_corners
from workers.capture.simulate.photograph import place_object, true_board
from workers.geometry.frames import transform


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_lowest_point_is_exactly_on_the_print(category):
    for index in range(3):
        asset = make_asset(category, ProceduralSource(source="procedural"), index, 600.0)
        T = place_object(asset, np.random.default_rng(index))
        placed = transform(T, asset.shape.vertices)
        assert placed[:, 2].min() == 0.0
        assert np.abs(placed[:, :2]).max() < 0.2  # on the board


def test_a_print_scale_overrules_what_a_ruler_is_said_to_show():
    board = Board(measured_ruler_m=0.21)
    assert true_board(board, Simulate()).scale == 1.0
    large = true_board(board, Simulate(print_scale=1.02))
    assert np.allclose(marker_corners(large), 1.02 * marker_corners(Board()))
