"""What was read of a folder, as a table and as a page of pictures."""

import numpy as np
import pytest

from schemas.job.assets import Assets, FolderSource, ProceduralSource
from services.init import shown as sheet
from services.init.collection import Candidate, LeftOut, read_folder
from services.init.shown import (
    MOST_ROWS,
    TILE,
    Tile,
    draw_left_out,
    draw_object,
    draw_sheet,
    draw_table,
    show_items,
)
from tests.own_meshes import cup, write_mesh
from workers.assets.builtin.make import make_asset
from workers.assets.catalogue import open_catalogue
from workers.assets.external.mesh import transform_shape
from workers.geometry.frames import pose
from workers.render.raster.gbuffer import shared_renderer

ROW = (
    "a_folder/of_a_long_name/and_a_mesh.obj",
    "category",
    "12.3 x 4.5 x 67.8",
    "20000",
    "yes",
    "1",
    "y sure",
    "note " * 30,
)


@pytest.mark.parametrize("width", [60, 80, 100, 140, 400])
def test_it_fits_the_terminal_and_what_is_cut_shows_it(width):
    lines = draw_table([ROW, ROW], width)
    assert len(lines) == 3 and all(len(line) <= width for line in lines)
    assert ("…" in lines[1]) == (width < 400)
    assert lines[0].split()[0] == "file"


def test_what_is_not_shown_is_counted():
    assert draw_table([ROW] * (MOST_ROWS + 5), 100)[-1] == "and 5 more: --json lists all"
    left = [LeftOut(f"{k}.obj", "format", "why") for k in range(MOST_ROWS + 3)]
    lines = draw_left_out([*left, LeftOut("p.obj", "part", "is a part of x.urdf")], 100)
    assert lines[0] == f"left out: {MOST_ROWS + 3} files" and lines[1] == "  0.obj (format): why"
    assert lines[-2:] == ["  and 3 more: --json lists all", "1 mesh not offered by themselves: parts of the URDFs"]
    assert draw_left_out([], 100) == []


@pytest.mark.parametrize(
    ("up", "size"), [("x", (0.06, 0.06, 0.12)), ("y", (0.06, 0.06, 0.12)), ("z", (0.06, 0.06, 0.12))]
)
def test_sizes_are_those_of_the_asset_that_is_loaded(tmp_path, up, size):
    """The loaded asset is the judge."""
    mesh = cup(0.12, 0.03)
    mesh.apply_scale((1, 0.8, 1))
    path = write_mesh(tmp_path / "cup.stl", mesh, turned=up == "y", scale=1000)
    (item,) = read_folder(tmp_path, [Candidate(path.name, "cup")], lambda *_: None).items
    source = FolderSource(source="urdf", folder=str(tmp_path), category_map={"*.stl": "cup"}, up=up, scale=0.001)
    catalogue = open_catalogue(Assets(objects=(source,)), tmp_path, ("cup",))
    ((shown, ref),) = show_items(catalogue, [item])
    assert shown.size_m == pytest.approx(tuple(catalogue.load(ref).extents_m))
    assert shown.up == up and shown.shape_says == ("y" if up == "y" else "z")
    assert shown.row[:2] == ("cup.stl", "cup") and shown.row[4] == "yes"
    assert any("up: " in line for line in shown.caption)


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
