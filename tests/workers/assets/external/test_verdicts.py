"""A source of files listed, checked once and loaded; verdicts kept in a file, across torn lines, without a home."""

import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from tests.workers.assets.oracles import CUBE, textured_cube, write
from workers.assets.external import verdicts as opening
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.placement import load_entry
from workers.assets.external.verdicts import Verdicts, check_listing, load_asset_file, read_listing, verdict_key

ENTRY = Entry("a", (SourceFile("a.obj", 3, "e" * 64),), "MIT")
SETTINGS = FolderSource(source="urdf", folder="x")


def key(settings=SETTINGS, assets=None, category="mug", entry=ENTRY):
    return verdict_key(settings, assets or Assets(), category, entry)


def test_a_verdict_depends_on_files_settings_and_limits_and_not_on_folder_weight_or_licence():
    others = [
        key(settings=SETTINGS.model_copy(update={"scale": 2.0})),
        key(assets=Assets(limits={"max_faces": 7})),
        key(category="table"),
        key(entry=Entry("a", (SourceFile("a.obj", 3, "f" * 64),), "MIT")),
    ]
    assert len({key(), *others}) == 5
    assert key(settings=SETTINGS.model_copy(update={"folder": "y", "weight": 2.0, "licence": "MIT"})) == key()
    assert key(category="can") == key()


def test_what_was_found_out_is_read_again_and_names_the_folder_that_it_is_asked_for(tmp_path):
    kept = Verdicts(tmp_path)
    kept.put([("a", None), ("b", MeshError("no_faces", "/one/b.obj has no triangles"))], "/one")
    for verdicts in (kept, Verdicts(tmp_path)):
        assert "a" in verdicts and "c" not in verdicts
        assert verdicts.get("a", "/two") is None
        assert verdicts.get("b", "/two").detail == "/two/b.obj has no triangles"


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_a_torn_line_is_found_out_again_and_the_next_is_whole(tmp_path, cut):
    Verdicts(tmp_path).put([("a", None), ("b", MeshError("no_faces", "none"))], "/one")
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-cut])
    torn = Verdicts(tmp_path)
    assert "b" not in torn or cut == 1
    torn.put([("c", None)], "/one")
    assert "c" in Verdicts(tmp_path)


def test_a_flipped_bit_is_no_verdict(tmp_path):
    Verdicts(tmp_path).put([("good", MeshError("no_faces", "none"))], "/one")
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes().replace(b"none", b"nOne"))
    assert "good" not in Verdicts(tmp_path)


def _put(folder, name):
    verdicts = Verdicts(folder)
    for number in range(50):
        verdicts.put([(f"{name}{number}", None)], "/one")


def test_processes_that_write_at_once_lose_nothing(tmp_path):
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.starmap(_put, [(tmp_path, "a"), (tmp_path, "b")])
    verdicts = Verdicts(tmp_path)
    assert all(f"{name}{number}" in verdicts for name in "ab" for number in range(50))


def test_without_a_folder_that_can_be_written_verdicts_are_kept_in_memory(tmp_path):
    (tmp_path / "file").write_text("no folder")
    for folder in (None, tmp_path / "file" / "verdicts"):
        verdicts = Verdicts(folder)
        verdicts.put([("a", None)], "/one")
        assert "a" in verdicts


MIT = FolderSource(source="urdf", folder=".", licence="MIT")


def listed(folder, *names, limits=None):
    return read_listing(MIT, folder, {"mug": [folder / name for name in names]}, limits or MeshLimits())


def test_refused_candidates_are_counted_by_reason_and_others_keep_their_order(tmp_path):
    for name in ("c.obj", "d.obj", "b.obj"):
        write(tmp_path / name, CUBE)
    candidates = {"mug": [tmp_path / name for name in ("none.obj", "d.obj", "b.obj")], "can": [tmp_path / "a.dae"]}
    listing = read_listing(MIT, tmp_path, candidates, MeshLimits())
    found = {name: [entry.files[0].path for entry in entries] for name, entries in listing.entries.items()}
    assert found == {"mug": ["d.obj", "b.obj"], "can": []}
    assert list(listing.skipped.items()) == [("format", 1), ("missing", 1)]
    assert listing.examples[0].startswith("none.obj (missing: cannot be read")


def test_what_cannot_be_used_is_marked_and_what_was_found_out_is_not_found_out_again(tmp_path, monkeypatch):
    write(tmp_path / "a.obj", CUBE)
    write(tmp_path / "b.obj", "v 0 0 0\n")
    listing, verdicts = listed(tmp_path, "a.obj", "b.obj"), Verdicts(tmp_path / "kept")
    checked = check_listing(MIT, listing, Assets(), verdicts)
    assert (checked.refused, checked.skipped) == ({"mug": frozenset({1})}, {"no_faces": 1})
    assert checked.examples == ("b.obj (no_faces: has no triangles)",)
    asked = []
    monkeypatch.setattr(opening, "ask_all", lambda request, watch: asked.extend(request.tasks) or iter(()))
    assert check_listing(MIT, listing, Assets(), verdicts) == checked
    assert check_listing(MIT, listing, Assets(), Verdicts(tmp_path / "kept")) == checked, "from the file"
    assert asked == []


def test_a_file_that_changes_while_it_is_checked_is_no_verdict(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    listing, verdicts = listed(tmp_path, "a.obj"), Verdicts(None)
    write(path, CUBE + "#")
    with pytest.raises(AssetSourceError, match="has changed"):
        check_listing(MIT, listing, Assets(), verdicts)


def test_an_asset_read_by_another_process_is_the_one_that_is_read_here(tmp_path):
    textured_cube(tmp_path)
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(tmp_path / "skin.png")
    (entry,) = listed(tmp_path, "cube.obj").entries["mug"]
    there = load_asset_file(MIT, tmp_path, entry, "mug", Assets())
    here = load_entry(MIT, tmp_path, entry, "mug", Assets())
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
    assets = [load_asset_file(MIT, tmp_path, entry, "mug", Assets()) for _ in range(5)]
    assert len(list(Path("/proc/self/fd").iterdir())) == files
    for array in (assets[0].shape.parts[0].vertices, assets[0].shape.parts[0].faces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_file_that_changes_after_it_was_listed_is_refused_when_it_is_loaded(tmp_path):
    path = write(tmp_path / "a.obj", CUBE)
    (entry,) = listed(tmp_path, "a.obj").entries["mug"]
    write(path, CUBE + "#")
    with pytest.raises(MeshError, match="changed") as error:
        load_asset_file(MIT, tmp_path, entry, "mug", Assets())
    assert error.value.kind == "environmental"
