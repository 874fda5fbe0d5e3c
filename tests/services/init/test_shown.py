"""The files as their job has them."""

import pytest

from schemas.job.assets import Assets, FolderSource
from services.init.collection import Candidate, read_folder
from services.init.shown import show_items
from tests.own_meshes import cup, write_mesh
from workers.assets.catalogue import open_catalogue


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


def test_a_source_that_resizes_shows_the_size_that_comes_of_it(tmp_path):
    path = write_mesh(tmp_path / "cup.stl", cup())
    (item,) = read_folder(tmp_path, [Candidate(path.name, "cup")], lambda *_: None).items
    source = FolderSource(source="urdf", folder=str(tmp_path), category_map={"*.stl": "cup"}, diagonal_m=0.25)
    ((shown, _),) = show_items(open_catalogue(Assets(objects=(source,)), tmp_path, ("cup",)), [item])
    assert sum(extent**2 for extent in shown.size_m) ** 0.5 == pytest.approx(0.25)
