"""The page of pictures."""

import numpy as np
import pytest

from schemas.job.assets import ProceduralSource
from services.init import shown as sheet
from services.init.shown import TILE, Tile, draw_object, draw_sheet
from workers.assets.builtin.make import make_asset
from workers.assets.external.mesh import transform_shape
from workers.geometry.frames import pose
from workers.render.raster.gbuffer import shared_renderer


def asset(scale=1.0, turned=False):
    from dataclasses import replace

    made = make_asset("bottle", ProceduralSource(source="procedural"), 0, 600.0)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if turned else np.eye(3)
    return replace(made, shape=transform_shape(made.shape, pose(scale * turn, np.zeros(3))))


def differs(a, b):
    """[H, W] bool: pixels that are clearly another colour."""
    return (np.abs(np.asarray(a, float) - np.asarray(b, float)).max(axis=2)) > 40


@pytest.mark.parametrize("scale", [0.001, 1.0, 50.0])
def test_an_object_of_any_size_fills_its_picture_and_stands_in_it(scale):
    picture = draw_object(asset(scale), shared_renderer())
    assert picture.size == TILE
    ground = np.asarray(picture)[5, 5].astype(float)
    rows, columns = np.nonzero(np.abs(np.asarray(picture, float) - ground).max(axis=2) > 45)
    assert rows.max() - rows.min() > 0.5 * TILE[1]
    assert rows.min() > 2 and rows.max() < TILE[1] - 2, "nothing is cut off"
    assert abs(np.median(columns) - TILE[0] / 2) < 0.2 * TILE[0]


def test_a_bottle_that_lies_is_seen_to_lie():
    standing, lying = (draw_object(asset(turned=turned), shared_renderer()) for turned in (False, True))
    assert differs(standing, lying).mean() > 0.05


def test_as_many_as_fit_are_drawn_and_the_rest_is_counted(monkeypatch):
    monkeypatch.setattr(sheet, "MOST", 2)
    loaded = []

    def load():
        loaded.append(1)
        return asset()

    tiles = [Tile(load, ("näme", "mug"), ("a warning " * 20,)) for _ in range(5)]
    page = draw_sheet("title", tiles, ["left out: x"], shared_renderer())
    assert len(loaded) == 2
    two = draw_sheet("title", tiles[:2], ["left out: x"], shared_renderer())
    assert page.height > two.height, "a line says how many are not drawn"
    assert page.width >= 2 * TILE[0] and (np.asarray(page) < 128).any()
