"""A source of files as it is opened: listed, checked once, loaded in a limited process."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.external import verdicts as opening
from workers.assets.external.placement import load_entry
from workers.assets.external.verdicts import Verdicts, check_listing, load_asset_file, read_listing

SETTINGS = FolderSource(source="urdf", folder=".", licence="MIT")


def listed(folder, *names, limits=None):
    return read_listing(SETTINGS, folder, {"mug": [folder / name for name in names]}, limits or MeshLimits())


def test_refused_candidates_are_counted_by_reason_and_others_keep_their_order(tmp_path):
    for name in ("c.obj", "d.obj", "b.obj"):
        write(tmp_path / name, CUBE)
    candidates = {"mug": [tmp_path / name for name in ("none.obj", "d.obj", "b.obj")], "can": [tmp_path / "a.dae"]}
    listing = read_listing(SETTINGS, tmp_path, candidates, MeshLimits())
    found = {name: [entry.files[0].path for entry in entries] for name, entries in listing.entries.items()}
    assert found == {"mug": ["d.obj", "b.obj"], "can": []}
    assert list(listing.skipped.items()) == [("format", 1), ("missing", 1)]
    assert listing.examples[0].startswith("none.obj (missing: cannot be read")


def test_what_cannot_be_used_is_marked_and_what_was_found_out_is_not_found_out_again(tmp_path, monkeypatch):
    write(tmp_path / "a.obj", CUBE)
    write(tmp_path / "b.obj", "v 0 0 0\n")
    listing, verdicts = listed(tmp_path, "a.obj", "b.obj"), Verdicts(tmp_path / "kept")
    checked = check_listing(SETTINGS, listing, Assets(), verdicts)
    assert (checked.refused, checked.skipped) == ({"mug": frozenset({1})}, {"no_faces": 1})
    assert checked.examples == ("b.obj (no_faces: has no triangles)",)
    asked = []
    monkeypatch.setattr(opening, "ask_all", lambda request, watch: asked.extend(request.tasks) or iter(()))
    assert check_listing(SETTINGS, listing, Assets(), verdicts) == checked
    assert check_listing(SETTINGS, listing, Assets(), Verdicts(tmp_path / "kept")) == checked, "from the file"
    assert asked == []


def test_a_file_that_changes_while_it_is_checked_is_no_verdict(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    listing, verdicts = listed(tmp_path, "a.obj"), Verdicts(None)
    write(path, CUBE + "#")
    with pytest.raises(AssetSourceError, match="has changed"):
        check_listing(SETTINGS, listing, Assets(), verdicts)


def test_an_asset_read_by_another_process_is_the_one_that_is_read_here(tmp_path):
    textured_cube(tmp_path)
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(tmp_path / "skin.png")
    (entry,) = listed(tmp_path, "cube.obj").entries["mug"]
    there = load_asset_file(SETTINGS, tmp_path, entry, "mug", Assets())
    here = load_entry(SETTINGS, tmp_path, entry, "mug", Assets())
    assert (there.instance_id, there.notes, there.scale) == (here.instance_id, here.notes, here.scale)
    assert there.mass.inertia.tobytes() == here.mass.inertia.tobytes()
    for one, two in zip(there.shape.parts, here.shape.parts, strict=True):
        assert one.vertices.tobytes() == two.vertices.tobytes()
        assert one.vertices.strides == two.vertices.strides and not one.vertices.flags.writeable
        assert (one.faces == two.faces).all() and one.faces.dtype == two.faces.dtype
        assert (one.material.texture == two.material.texture).all()


def test_an_asset_holds_no_open_file_and_its_arrays_cannot_be_written(tmp_path):
    write(tmp_path / "a.obj", CUBE)
    (entry,) = listed(tmp_path, "a.obj").entries["mug"]
    files = len(list(Path("/proc/self/fd").iterdir()))
    assets = [load_asset_file(SETTINGS, tmp_path, entry, "mug", Assets()) for _ in range(5)]
    assert len(list(Path("/proc/self/fd").iterdir())) == files
    for array in (assets[0].shape.parts[0].vertices, assets[0].shape.parts[0].faces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            array.setflags(write=True)


def test_a_file_that_changes_after_it_was_listed_is_refused_when_it_is_loaded(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    (entry,) = listed(tmp_path, "a.obj").entries["mug"]
    write(path, CUBE + "#")
    with pytest.raises(MeshError, match="changed") as error:
        load_asset_file(SETTINGS, tmp_path, entry, "mug", Assets())
    assert error.value.kind == "environmental"
