"""The sources that the card names; the card of whole datasets is in tests/services/run/test_switches.py."""

from pathlib import Path

from schemas.job.assets import Assets
from services.merge.dataset_card import describe_sources
from workers.assets.catalogue import Catalogue
from workers.assets.external.listing import Listing

OBJECTS = [
    {"source": "procedural", "weight": 2.0, "seed": 7},
    {"source": "urdf", "folder": "meshes", "licence": "CC-BY-4.0"},
]


def test_every_source_is_named_with_its_weight_and_licence_and_what_was_left_out_of_it():
    assets = Assets.model_validate({"objects": OBJECTS})
    catalogue = Catalogue(assets, (None, None), (None,), "d" * 64, {"meshes": {"too large": 2, "torn": 1}})
    lines = describe_sources(catalogue)
    assert lines[:2] == [
        "objects, weight 2: made from seed 7, licence CC0-1.0",
        "objects, weight 1: urdf folder meshes, licence CC-BY-4.0",
    ]
    assert lines[2].startswith("tables, weight 1: made from seed")
    assert lines[3:] == ["left out of meshes: 2 too large, 1 torn"] == catalogue.describe_left_out()


def test_the_first_files_that_were_left_out_are_named():
    listing = Listing(
        Path("/meshes"), {}, {"no_faces": 4}, examples=("a.obj (no_faces: has no triangles)", "b.obj (...)")
    )
    catalogue = Catalogue(Assets(), (listing,), (None,), "d" * 64, {"/meshes": {"no_faces": 4}})
    said = "left out of /meshes: 4 no_faces; a.obj (no_faces: has no triangles); b.obj (...)"
    assert catalogue.describe_left_out() == [said]


def test_files_that_stand_on_another_axis_are_named_with_the_remedy():
    doubts = {f"{name}.glb": "y" for name in "dcba"}
    listing = Listing(Path("/meshes"), {}, doubts=doubts)
    (line,) = Catalogue(Assets(), (listing, None), (None,), "d" * 64).describe_doubts()
    assert line.startswith(
        "/meshes: files stand on another axis than `up` says: a.glb on y, b.glb on y, c.glb on y and 1 more"
    )
    assert 'such as {"a.glb": y}' in line
    assert Catalogue(Assets(), (None,), (None,), "d" * 64).describe_doubts() == []
