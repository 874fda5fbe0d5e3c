"""Verdicts on assets: kept in a file, across torn lines, without a home."""

import multiprocessing

import pytest

from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.verdicts import Verdicts, verdict_key

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


def test_the_axis_that_a_file_stands_on_is_kept_too(tmp_path):
    Verdicts(tmp_path).put([("a", "y"), ("b", None)], "/one")
    kept = Verdicts(tmp_path)
    assert (kept.get("a", "/two"), kept.get("b", "/two")) == ("y", None)
